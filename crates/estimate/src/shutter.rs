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
/// Where it comes out beyond these by so many of its sigmas, it is doubted by so much, s.
const BEYOND_SIGMAS: f64 = 0.5;
const DOUBT_S: f64 = 0.006;
/// It is reported from this many of its sigmas and from this on, s, where it is known so well, s.
const REPORTED_SIGMAS: f64 = 5.0;
const REPORTED_S: f64 = 0.004;
const WELL_KNOWN_S: f64 = 0.002;

impl Core {
    /// After a frame: keeps the time from the first row to the last within what a camera does.
    pub(crate) fn bound_readout(&mut self) {
        let configured_s = self.models.readout_s;
        let found_s = self.state.own.whole_readout_s(configured_s);
        let readout_s = found_s.clamp(LIMITS_S.0, LIMITS_S.1);
        self.state.own.readout_s = readout_s - configured_s;
        // What no camera does was drawn from something else: another tag than configured, a vehicle that sways.
        let beyond_s = (found_s - readout_s).abs();
        if beyond_s > BEYOND_SIGMAS * self.state.cov.sigma(own::READOUT, 0) && !self.at_truth {
            self.state.cov.add_diagonal(own::READOUT, &[DOUBT_S * DOUBT_S]);
        }
    }

    /// The time from the first row to the last, s, where it is another than configured beyond doubt.
    pub(crate) fn readout_misfit(&self) -> Option<(FusionSource, MisfitCause, f64)> {
        let (found_s, sigma_s) = (self.state.own.readout_s, self.state.cov.sigma(own::READOUT, 0));
        let beyond = found_s.abs() > REPORTED_S.max(REPORTED_SIGMAS * sigma_s) && sigma_s < WELL_KNOWN_S;
        let readout_s = self.state.own.whole_readout_s(self.models.readout_s);
        beyond.then_some((FusionSource::Marker, MisfitCause::Readout, readout_s))
    }
}
