//! State of the helicopter: its recent states, and its autopilot's position and time.

use std::collections::VecDeque;

use nalgebra::{UnitQuaternion, Vector3};

use windhover_base::geo::LocalFrame;
use windhover_base::msg::{AutopilotPosition, Ownship, Stamped};
use windhover_base::time::{MonoTime, Span};

/// How long states are kept.
const KEPT: Span = Span::from_ns(3_000_000_000);
/// Between two states that are farther apart than this, the state is not known.
const GAP: Span = Span::from_ns(500_000_000);
/// Averaging time of the difference between the autopilot's position and ours, s: longer than noise and tilt vary,
/// shorter than the drift of receivers.
const AVERAGED_S: f64 = 2.0;
/// The autopilot's position is known while it was received within this time.
const FRESH: Span = Span::from_ns(2_000_000_000);

/// The helicopter at one time.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct OwnAt {
    /// North, east, down of the datum, metres.
    pub position_ned_m: Vector3<f64>,
    /// Height above the ellipsoid, metres.
    pub height_m: f64,
    /// Attitude.
    pub ned_from_body: UnitQuaternion<f64>,
    /// One-sigma of its height, metres.
    pub sigma_down_m: f64,
}

/// The autopilot's position minus ours, and its clock minus ours.
#[derive(Clone, Copy, PartialEq, Debug)]
struct Difference {
    at: MonoTime,
    /// North and east, metres; and altitude above mean sea level minus height above the ellipsoid.
    place_m: Vector3<f64>,
    clock: Span,
}

/// The helicopter.
#[derive(Clone, Debug, Default)]
pub struct Helicopter {
    own: VecDeque<Ownship>,
    latest: Option<Stamped<AutopilotPosition>>,
    difference: Option<Difference>,
}

impl Helicopter {
    /// Takes a state.
    pub fn own(&mut self, own: &Ownship, frame: Option<&LocalFrame>) {
        let place = self.own.iter().rposition(|at| at.t_valid <= own.t_valid).map_or(0, |i| i + 1);
        self.own.insert(place, *own);
        let latest = self.own.back().map_or(own.t_valid, |last| last.t_valid);
        self.own.retain(|at| latest - at.t_valid <= KEPT);
        if let Some(frame) = frame {
            self.compare(frame);
        }
    }

    /// Takes a position of its autopilot.
    pub fn autopilot_position(&mut self, position: &Stamped<AutopilotPosition>) {
        self.latest = Some(*position);
    }

    /// The helicopter at `t`, interpolated between states; for a short time after the last, that one.
    pub fn at(&self, t: MonoTime) -> Option<OwnAt> {
        let after = self.own.iter().find(|own| own.t_valid >= t);
        let before = self.own.iter().rev().find(|own| own.t_valid <= t);
        let (a, b) = match (before, after) {
            (Some(a), Some(b)) if b.t_valid - a.t_valid <= GAP => (a, b),
            (Some(a), None) if t - a.t_valid <= GAP => (a, a),
            _ => return None,
        };
        let between = (b.t_valid - a.t_valid).s();
        let share = if between > 0.0 { (t - a.t_valid).s() / between } else { 0.0 };
        let on = if between > 0.0 { Vector3::zeros() } else { a.velocity_ned_mps * (t - a.t_valid).s() };
        Some(OwnAt {
            position_ned_m: a.position_ned_m.lerp(&b.position_ned_m, share) + on,
            height_m: a.height_m + share * (b.height_m - a.height_m) - on.z,
            ned_from_body: a.ned_from_body.slerp(&b.ned_from_body, share),
            sigma_down_m: a.position_sigma_m().z,
        })
    }

    /// Updates the difference between the autopilot's position and ours, once both are known for the same time.
    fn compare(&mut self, frame: &LocalFrame) {
        let Some(latest) = self.latest else { return };
        let known = self.own.back().is_some_and(|last| last.t_valid >= latest.t_valid);
        let Some(own) = self.at(latest.t_valid).filter(|_| known) else { return };
        self.latest = None;
        let place = windhover_base::geo::Geodetic {
            lat_deg: latest.value.lat_deg,
            lon_deg: latest.value.lon_deg,
            height_m: own.height_m,
        };
        let apart = frame.ned(place) - own.position_ned_m;
        let place_m = Vector3::new(apart.x, apart.y, latest.value.alt_msl_m - own.height_m);
        let clock = latest.value.boot - (latest.t_valid - MonoTime::default());
        let place_m = match self.difference {
            Some(last) if latest.t_valid > last.at && latest.t_valid - last.at <= FRESH => {
                let share = 1.0 - (-(latest.t_valid - last.at).s() / AVERAGED_S).exp();
                last.place_m + (place_m - last.place_m) * share
            }
            _ => place_m,
        };
        self.difference = Some(Difference { at: latest.t_valid, place_m, clock });
    }

    /// The autopilot's position minus ours (north, east; altitude above mean sea level minus our height above the
    /// ellipsoid), metres: the last known difference, and whether it is recent.
    pub fn difference(&self, now: MonoTime) -> Option<(Vector3<f64>, bool)> {
        self.difference.map(|d| (d.place_m, now - d.at <= FRESH))
    }

    /// `t` on the autopilot's clock, since its start.
    pub fn on_its_clock(&self, t: MonoTime) -> Option<Span> {
        self.difference.map(|d| (t - MonoTime::default()) + d.clock)
    }
}
