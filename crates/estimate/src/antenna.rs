//! The receiver's antenna where it is not as configured.
//!
//! Where it is forward and right of its configured place are states ([`own::ARM`]): turning swings it, which the receiver's
//! velocity shows against what is seen of vehicles and ground. A place that comes out beyond what a careful measurement
//! may be off was measured wrongly, and may be anywhere on the helicopter.

use windhover_base::msg::{FusionSource, MisfitCause};

use super::blocks::own;
use super::core::Core;
use super::slow::ARM_SIGMA_M;

/// Sigmas of a careful measurement beyond which the place was measured wrongly; what it may be off by then, m.
const BEYOND: f64 = 3.5;
const ANYWHERE_M: f64 = 0.5;
/// It is reported from this many of its sigmas on, and this far from its configured place, m.
const REPORTED_SIGMAS: f64 = 4.0;
const REPORTED_M: f64 = 0.15;

impl Core {
    /// After a velocity of the receiver: whether the antenna's place was measured wrongly.
    pub(crate) fn judge_antenna(&mut self) {
        let beyond = self.state.own.arm.norm() > BEYOND * ARM_SIGMA_M && self.antenna_misfit().is_some();
        if !self.at_truth && !self.state.antenna_anywhere && beyond {
            self.state.antenna_anywhere = true;
            self.state.cov.add_diagonal(own::ARM, &[ANYWHERE_M * ANYWHERE_M; 2]);
        }
    }

    /// The antenna's place, where it is not as configured beyond doubt: by how much, m.
    pub(crate) fn antenna_misfit(&self) -> Option<(FusionSource, MisfitCause, f64)> {
        let (off, cov) = (self.state.own.arm, self.state.cov.block(own::ARM, own::ARM));
        let square = off.dot(&(cov.try_inverse()? * off));
        let beyond = off.norm() > REPORTED_M && square > REPORTED_SIGMAS.powi(2);
        beyond.then(|| (FusionSource::GpsVelocity, MisfitCause::AntennaPlace, off.norm()))
    }
}
