//! Code words of tagCircle49h12 (facts published by AprilRobotics), cells row by row, the first in the highest bit;
//! little-endian words of eight bytes in the data file beside this one.

/// 49 bits.
pub(super) static CODES: [u64; 65535] = super::words(include_bytes!("circle49h12.bin"));
