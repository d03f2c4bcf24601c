//! Code words of tagCircle49h12 (facts published by AprilRobotics), cells row by row, first in the top bit: eight bytes a word,
//! the lowest first, in the file beside.

/// 49 bits.
pub(super) static CODES: [u64; 65535] = super::words(include_bytes!("circle49h12.bin"));
