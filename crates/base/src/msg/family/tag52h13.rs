//! Code words of tagStandard52h13 (facts published by AprilRobotics), cells row by row, the first in the highest bit;
//! little-endian words of eight bytes in the data file beside this one.

/// 52 bits.
pub(super) static CODES: [u64; 48714] = super::words(include_bytes!("tag52h13.bin"));
