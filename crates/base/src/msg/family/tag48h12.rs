//! Code words of tagCustom48h12 (facts published by AprilRobotics), cells row by row, first in the top bit: eight bytes a word,
//! the lowest first, in the file beside.

/// 48 bits.
pub(super) static CODES: [u64; 42211] = super::words(include_bytes!("tag48h12.bin"));
