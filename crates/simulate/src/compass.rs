//! The digital compass: heading with bias and noise, tilt by its convention and its gain.

use nalgebra::Vector3;

use super::helicopter::GRAVITY;
use super::instant::OwnshipTruth;
use super::lag::filtered;
use super::random::{Purpose, Stream};
use super::scenario::{Scenario, within};
use super::world::World;
use windhover_base::geo::{Tilt, euler_321, ned_from_body_321, rot_z, wrap_angle};
use windhover_base::msg::AttitudeSample;
use windhover_base::time::{MonoTime, Span};

/// One reading.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct CompassSample {
    /// When it was true, host time.
    pub(super) t_true: MonoTime,
    /// When its first byte arrives.
    pub(super) t_first_byte: MonoTime,
    /// The device's reading, radians.
    pub(super) sample: AttitudeSample,
}

/// The compass.
#[derive(Clone, Debug)]
pub(super) struct Compass {
    stream: Stream,
    latency: Span,
    bias: f64,
    slow: SlowTilt,
    count: u64,
    phase_s: f64,
}

impl Compass {
    pub(super) fn new(world: &World) -> Self {
        let scenario = world.scenario();
        let sim = &scenario.compass;
        let mut stream = Stream::of(world.seed(), Purpose::Compass);
        let drawn_ms = stream.uniform(-1.0, 1.0) * sim.latency_spread_ms;
        let bias_deg = sim.bias_offset_deg + sim.bias_sigma_deg * stream.normal();
        let phase_s = stream.uniform(0.0, 1.0 / sim.rate_hz);
        let latency = Span::from_ms(scenario.rig.compass.latency_ms + sim.latency_offset_ms + drawn_ms);
        let slow = SlowTilt::new(world);
        Self { stream, latency, bias: bias_deg.to_radians(), slow, count: 0, phase_s }
    }

    /// True latency minus the configured one.
    pub(super) fn latency_error(&self, scenario: &Scenario) -> Span {
        self.latency - Span::from_ms(scenario.rig.compass.latency_ms)
    }

    /// The heading's constant error, radians.
    pub(super) fn bias_rad(&self) -> f64 {
        self.bias
    }

    /// Time of the next reading, seconds into the flight.
    pub(super) fn due_s(&self, world: &World) -> f64 {
        self.phase_s + self.count as f64 / world.scenario().compass.rate_hz
    }

    /// The next reading that is sent; `None` at the flight's end.
    pub(super) fn next(&mut self, world: &World) -> Option<CompassSample> {
        let scenario = world.scenario();
        let sim = &scenario.compass;
        loop {
            let t_s = self.phase_s + self.count as f64 / sim.rate_hz;
            if t_s > scenario.duration_s {
                return None;
            }
            self.count += 1;
            let noise = Vector3::from_fn(|_, _| self.stream.normal());
            let jitter = Span::from_ms(self.stream.normal() * sim.jitter_ms);
            let flagged = self.stream.chance(sim.flagged);
            let slow = self.slow.next();
            if within(&sim.outages_s, t_s) {
                continue;
            }
            let t_true = world.time(t_s);
            let mut sample = reading(world, t_true, self.bias, &noise, slow);
            if flagged {
                // The meaning of a PNI device's "inclinometer out of range": neither value can be used.
                sample.heading = None;
                sample.tilt = None;
            }
            return Some(CompassSample { t_true, t_first_byte: t_true + self.latency + jitter, sample });
        }
    }
}

/// The slow error of its tilt, pitch and roll: a Gauss–Markov process, at every reading.
#[derive(Clone, Debug)]
struct SlowTilt {
    stream: Stream,
    error: [f64; 2],
    sigma: f64,
    keep: f64,
}

impl SlowTilt {
    fn new(world: &World) -> Self {
        let sim = &world.scenario().compass;
        let mut stream = Stream::of(world.seed(), Purpose::CompassSlow);
        let sigma = sim.slow_tilt_deg.to_radians();
        let error = [sigma * stream.normal(), sigma * stream.normal()];
        Self { stream, error, sigma, keep: (-1.0 / (sim.rate_hz * sim.slow_tilt_tau_s)).exp() }
    }

    fn next(&mut self) -> [f64; 2] {
        let fresh = self.sigma * (1.0 - self.keep * self.keep).sqrt();
        self.error = self.error.map(|error| self.keep * error + fresh * self.stream.normal());
        self.error
    }
}

/// Pitch and roll that the sensor measures: of the vertical or of specific force, through its lag.
fn felt_tilt(world: &World, t: MonoTime, own: &OwnshipTruth) -> (f64, f64) {
    let sim = &world.scenario().compass;
    if !sim.feels_force && sim.tilt_lag_s == 0.0 {
        let (_, pitch, roll) = euler_321(&own.ned_from_body);
        return (pitch, roll);
    }
    let down = filtered(sim.tilt_lag_s, t, |t| {
        let own = world.ownship(t);
        let specific = own.acceleration_ned_mps2 - Vector3::z() * GRAVITY;
        let vertical = if sim.feels_force { -specific / specific.norm() } else { Vector3::z() };
        own.ned_from_body.inverse() * vertical
    });
    ((-down.x).atan2(down.y.hypot(down.z)), down.y.atan2(down.z))
}

/// The reading at a time; `noise` is standard normal (heading, pitch, roll), `slow` the tilt's slow error.
fn reading(world: &World, t: MonoTime, bias: f64, noise: &Vector3<f64>, slow: [f64; 2]) -> AttitudeSample {
    let (scenario, own) = (world.scenario(), world.ownship(t));
    let (sim, config) = (&scenario.compass, &scenario.rig.compass);
    let (pitch, roll) = felt_tilt(world, t, &own);
    // The tilt as an accelerometer measures it, and the device's reading of it.
    let (seen_pitch, seen_roll) = (sim.tilt_gain * pitch, sim.tilt_gain * roll);
    let seen_level = ned_from_body_321(0.0, seen_pitch, seen_roll);
    let exact = config.angles.tilt_of(&(seen_level.inverse() * Vector3::z()));
    let tilt_noise = sim.tilt_noise_deg.to_radians();
    let tilt = Tilt {
        pitch: exact.pitch + config.pitch_offset_deg.to_radians() + tilt_noise * noise.y + slow[0],
        roll: exact.roll + config.roll_offset_deg.to_radians() + tilt_noise * noise.z + slow[1],
    };
    let magnetic = match sim.dip_deg {
        None => own.heading_rad - scenario.declination_deg.to_radians(),
        Some(dip_deg) => {
            let (s, c) = dip_deg.to_radians().sin_cos();
            let field = rot_z(scenario.declination_deg.to_radians()) * Vector3::new(c, 0.0, s);
            let levelled = seen_level * (own.ned_from_body.inverse() * field);
            (-levelled.y).atan2(levelled.x)
        }
    };
    let iron = sim.iron_deg.to_radians() * own.heading_rad.sin();
    let heading = magnetic + iron - config.yaw_offset_deg.to_radians()
        + bias
        + sim.heading_noise_deg.to_radians() * noise.x;
    AttitudeSample { heading: Some(wrap_angle(heading)), heading_is_true: false, tilt: Some(tilt) }
}
