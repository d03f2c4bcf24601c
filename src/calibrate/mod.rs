//! Calibration: intrinsics, boresight, and the Monte Carlo error analysis.
