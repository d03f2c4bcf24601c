//! Rows that are exposed one after the other: a rolling shutter.
//!
//! How much longer than configured a frame takes from its first row to its last is a state ([`own::READOUT`]). A point at the
//! share s of the frame's height, −½ at the top, is seen `s` times that later: pixels of what moves through the picture
//! show it.

use windhover_base::msg::{FusionSource, MisfitCause};

use super::blocks::own;
use super::core::Core;

/// Limits of the whole time, s: rows are exposed from above, and within the time of a frame.
const LIMITS_S: (f64, f64) = (-0.001, 0.04);
/// It is reported from this many of its sigmas and from this on, s, where it is known so well, s.
const REPORTED_SIGMAS: f64 = 5.0;
const REPORTED_S: f64 = 0.004;
const WELL_KNOWN_S: f64 = 0.002;

impl Core {
    /// After a frame: keeps the time from the first row to the last within what a camera does.
    pub(crate) fn bound_readout(&mut self) {
        let configured_s = self.models.readout_s;
        let readout_s = self.state.own.whole_readout_s(configured_s).clamp(LIMITS_S.0, LIMITS_S.1);
        self.state.own.readout_s = readout_s - configured_s;
    }

    /// The time from the first row to the last, s, where it is another than configured beyond doubt.
    pub(crate) fn readout_misfit(&self) -> Option<(FusionSource, MisfitCause, f64)> {
        let (found_s, sigma_s) = (self.state.own.readout_s, self.state.cov.sigma(own::READOUT, 0));
        let beyond = found_s.abs() > REPORTED_S.max(REPORTED_SIGMAS * sigma_s) && sigma_s < WELL_KNOWN_S;
        let readout_s = self.state.own.whole_readout_s(self.models.readout_s);
        beyond.then_some((FusionSource::Marker, MisfitCause::Readout, readout_s))
    }
}
