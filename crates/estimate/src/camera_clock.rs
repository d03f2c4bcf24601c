//! A camera whose frames are stamped late against every other clock.
//!
//! The delays of compass and receiver are estimated against the camera. Where both are early by the same time, it is the
//! camera that is late: from then on its frames are taken to be true earlier by that time. A compass or a receiver that is
//! late by itself keeps its delay as a state.

use windhover_base::msg::{FusionSource, MisfitCause};
use windhover_base::time::Span;

use super::blocks::own;
use super::core::Core;
use super::state::State;

/// Less than this does no harm, s; and how well it must be known, s and in sigmas.
const LEAST_S: f64 = 0.004;
const WELL_KNOWN_S: f64 = 0.005;
const SIGMAS: f64 = 5.0;
/// Share of the compass's time by which the receiver's may differ, beside its sigma.
const AGREES: f64 = 0.3;
/// Less than this is not reported, s: exposure times and drivers have as much.
const LEAST_REPORTED_S: f64 = 0.01;

impl Core {
    /// Moves the camera's clock where it is found to be late.
    pub(crate) fn judge_camera_clock(&mut self) {
        if self.at_truth || self.state.is_blind() {
            return;
        }
        let state = &self.state;
        let sigma_s = state.cov.sigma(own::COMPASS_DELAY, 0);
        let (late_s, receiver_s) = (-state.own.compass_delay_s, -state.own.velocity_age_s());
        let known = sigma_s < WELL_KNOWN_S && late_s > LEAST_S.max(SIGMAS * sigma_s);
        // The receiver must agree with the compass, and its delay be known well enough: two that are early by different
        // times have latencies that are not as configured.
        let spread_s = state.velocity_age_sigma_s();
        let agrees = (receiver_s - late_s).abs() < AGREES * late_s + spread_s;
        let witnessed = agrees && spread_s < 0.5 * late_s;
        if known && witnessed {
            self.state.move_camera_clock(late_s);
        }
    }

    /// The camera's clock as a misfit, where it was moved.
    pub(crate) fn clock_misfit(&self) -> Option<(FusionSource, MisfitCause, f64)> {
        let moved_s = self.state.camera_late_s;
        // What was found since it was moved last counts as well.
        let late_s = moved_s - self.state.own.compass_delay_s;
        (moved_s > 0.0 && late_s > LEAST_REPORTED_S).then_some((
            FusionSource::Marker,
            MisfitCause::Late,
            late_s,
        ))
    }
}

impl State {
    /// One sigma of how much older the receiver's velocity is than configured, s.
    fn velocity_age_sigma_s(&self) -> f64 {
        let (position, more) = (own::GPS_DELAY.column(0), own::VELOCITY_DELAY.column(0));
        let var =
            self.cov.at(position, position) + self.cov.at(more, more) + 2.0 * self.cov.at(position, more);
        var.max(0.0).sqrt()
    }

    /// What stands here of a time by the camera is true of an earlier one.
    fn move_camera_clock(&mut self, late_s: f64) {
        let late = Span::from_s(late_s);
        self.camera_late_s += late_s;
        self.own.compass_delay_s += late_s;
        self.own.gps_delay_s += late_s;
        self.t -= late;
        self.copies_in_use().for_each(|copy| copy.t -= late);
    }
}
