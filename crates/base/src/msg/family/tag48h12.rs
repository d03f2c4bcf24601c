//! Code words of tagCustom48h12 (facts published by AprilRobotics), cells row by row, the first in the highest bit;
//! little-endian words of eight bytes in the data file beside this one.

/// 48 bits.
pub(super) static CODES: [u64; 42211] = super::words(include_bytes!("tag48h12.bin"));
