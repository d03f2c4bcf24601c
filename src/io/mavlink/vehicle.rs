//! Which state of a vehicle may be sent: a fresh and accurate one of a vehicle that was seen a moment ago; no other.

use super::motion::SpeedRate;
use windhover_base::msg::{TargetEstimate, TargetState, TrackStatus};
use windhover_base::time::{MonoTime, Span};

/// Limits for sending a state as a position.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Limits {
    /// Greatest age of the estimate.
    pub max_age: Span,
    /// Greatest one-sigma of the position relative to the helicopter, metres.
    pub max_sigma_m: f64,
    /// Longest time that a vehicle out of sight is predicted.
    pub coast: Span,
}

/// The state of a vehicle for its messages.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Reportable {
    /// It is seen, in this state.
    Seen(MonoTime, TargetState),
    /// It was seen a moment ago; this state is predicted.
    Predicted(MonoTime, TargetState),
    /// No position is sent.
    Nothing,
}

/// The pipeline's last state of a vehicle.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Vehicle {
    latest: Option<TargetEstimate>,
    /// When it was last seen with a settled estimate.
    seen: Option<MonoTime>,
    rate: SpeedRate,
}

impl Vehicle {
    /// Takes an estimate; one that is older than the known one is ignored.
    pub fn take(&mut self, estimate: &TargetEstimate) {
        if self.latest.is_some_and(|latest| estimate.t_valid < latest.t_valid) {
            return;
        }
        match (estimate.status, &estimate.state) {
            (TrackStatus::Tracking, Some(state)) => {
                self.seen = Some(estimate.t_valid);
                self.rate.take(estimate.t_valid, state);
            }
            _ => self.rate.clear(),
        }
        self.latest = Some(*estimate);
    }

    /// Rate of its speed, m/s²; 0 while it is not seen.
    pub fn rate_mps2(&self) -> f64 {
        self.rate.mps2()
    }

    /// Its state for messages at `now`.
    pub fn reportable(&self, now: MonoTime, limits: &Limits) -> Reportable {
        let Some(TargetEstimate { t_valid, status, state: Some(state), .. }) = self.latest else {
            return Reportable::Nothing;
        };
        let fresh = (now - t_valid).abs() <= limits.max_age;
        // A sigma that cannot be compared does not pass.
        let sure = state.relative_sigma_m.is_some_and(|sigma_m| sigma_m <= limits.max_sigma_m);
        let lately = self.seen.is_some_and(|seen| now.max(t_valid) - seen <= limits.coast);
        match status {
            _ if !(fresh && sure) => Reportable::Nothing,
            TrackStatus::Tracking => Reportable::Seen(t_valid, state),
            TrackStatus::Coasting if lately => Reportable::Predicted(t_valid, state),
            TrackStatus::Coasting | TrackStatus::Acquiring | TrackStatus::Lost => Reportable::Nothing,
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    const LIMITS: Limits =
        Limits { max_age: Span::from_ns(500_000_000), max_sigma_m: 2.0, coast: Span::from_ns(1_000_000_000) };

    fn at(s: f64) -> MonoTime {
        MonoTime::default() + Span::from_s(s)
    }

    /// A state at this height, with this sigma relative to the helicopter.
    pub(in crate::io::mavlink) fn state_of(height_m: f64, relative_sigma_m: Option<f64>) -> TargetState {
        TargetState {
            north_m: 1.0,
            east_m: 2.0,
            heading_rad: 0.1,
            speed_mps: 1.0,
            yaw_rate_radps: 0.0,
            lat_deg: 30.0,
            lon_deg: -85.0,
            height_m,
            covariance: None,
            relative_sigma_m,
        }
    }

    fn estimate(s: f64, status: TrackStatus, relative_sigma_m: Option<f64>) -> TargetEstimate {
        let state = state_of(6.0, relative_sigma_m);
        TargetEstimate { t_valid: at(s), frame: 1, target: 0, status, state: Some(state) }
    }

    fn after(estimates: &[TargetEstimate], s: f64) -> &'static str {
        let mut vehicle = Vehicle::default();
        estimates.iter().for_each(|estimate| vehicle.take(estimate));
        match vehicle.reportable(at(s), &LIMITS) {
            Reportable::Seen(..) => "seen",
            Reportable::Predicted(..) => "predicted",
            Reportable::Nothing => "nothing",
        }
    }

    #[test]
    fn an_estimate_is_said_while_it_is_fresh_and_sure() {
        use TrackStatus::{Acquiring, Lost, Tracking};
        assert_eq!(after(&[], 1.0), "nothing");
        let tracking = [estimate(1.0, Tracking, Some(0.1))];
        assert_eq!(
            (after(&tracking, 1.1), after(&tracking, 1.5), after(&tracking, 1.6)),
            ("seen", "seen", "nothing")
        );
        for sigma_m in [None, Some(2.1), Some(f64::NAN), Some(f64::INFINITY)] {
            assert_eq!(after(&[estimate(1.0, Tracking, sigma_m)], 1.0), "nothing", "{sigma_m:?}");
        }
        for status in [Acquiring, Lost] {
            assert_eq!(after(&[estimate(1.0, status, Some(0.1))], 1.0), "nothing", "{status:?}");
        }
        // A state of the future is not a present one.
        assert_eq!(after(&tracking, 0.4), "nothing");
    }

    #[test]
    fn a_vehicle_out_of_sight_is_predicted_for_a_moment() {
        use TrackStatus::{Coasting, Tracking};
        let seen = estimate(1.0, Tracking, Some(0.1));
        let coasting = |s| [seen, estimate(s, Coasting, Some(0.2))];
        assert_eq!(after(&coasting(1.9), 1.9), "predicted");
        assert_eq!(after(&coasting(2.1), 2.1), "nothing", "however small the filter's sigma is");
        assert_eq!(after(&[estimate(1.0, Coasting, Some(0.1))], 1.0), "nothing", "never seen");
        // A late estimate changes nothing.
        assert_eq!(after(&[coasting(1.9)[1], seen], 1.9), "nothing");
    }
}
