//! Code words of tagStandard52h13 (facts published by AprilRobotics), cells row by row, first in the top bit: eight bytes a word,
//! the lowest first, in the file beside.

/// 52 bits.
pub(super) static CODES: [u64; 48714] = super::words(include_bytes!("tag52h13.bin"));
