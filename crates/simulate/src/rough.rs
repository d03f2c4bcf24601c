//! What a vehicle does beside driving along: it sways on its springs, and slides sideways.

use super::instant::VehicleTruth;
use super::misfit::Driving;
use super::random::{Purpose, SmoothNoise, Stream};

/// Periods of the sway of a sprung body and of sliding, seconds.
const SWAY_S: (f64, f64) = (0.5, 2.0);
const SLIP_S: (f64, f64) = (3.0, 12.0);

/// A vehicle's sway and slip over the flight.
#[derive(Clone, Debug)]
pub(super) struct Rough {
    /// Pitch and roll, radians, and lift, metres.
    sway: Option<[SmoothNoise; 3]>,
    slip: Option<SmoothNoise>,
}

impl Rough {
    pub(super) fn new(driving: &Driving, index: usize, seed: u64) -> Self {
        let mut stream = Stream::new(seed, Purpose::Rough as u64 + index as u64);
        // A sine that reaches `a` has an rms of a/√2.
        let mut wander = |reaches: f64| {
            SmoothNoise::new(reaches * std::f64::consts::FRAC_1_SQRT_2, SWAY_S.0, SWAY_S.1, &mut stream)
        };
        let angle = driving.sway_deg.to_radians();
        let sway = [wander(angle), wander(angle), wander(driving.bounce_m)];
        let slip = SmoothNoise::new(driving.slip_deg.to_radians(), SLIP_S.0, SLIP_S.1, &mut stream);
        Self {
            sway: (driving.sway_deg != 0.0 || driving.bounce_m != 0.0).then_some(sway),
            slip: (driving.slip_deg != 0.0).then_some(slip),
        }
    }

    /// Rates of change of north and east at this heading and speed.
    pub(super) fn course(&self, t_s: f64, heading: f64, speed: f64) -> (f64, f64) {
        let (s, c) = heading.sin_cos();
        let Some(slip) = &self.slip else { return (speed * c, speed * s) };
        let across = speed * slip.at(t_s).tan();
        (speed * c - across * s, speed * s + across * c)
    }

    /// The vehicle with its sway.
    pub(super) fn swayed(&self, t_s: f64, vehicle: VehicleTruth) -> VehicleTruth {
        let Some([pitch, roll, lift]) = &self.sway else { return vehicle };
        VehicleTruth { pitch_rad: pitch.at(t_s), roll_rad: roll.at(t_s), lift_m: lift.at(t_s), ..vehicle }
    }
}
