//! The GPS receiver: a slowly wandering bias, white noise, velocity, latency, gaps.

use nalgebra::Vector3;

use super::lag::filtered;
use super::random::{Purpose, Stream};
use super::scenario::{Scenario, vector, within};
use super::world::World;
use windhover_base::msg::{FixKind, GnssEpoch};
use windhover_base::time::{MonoTime, NS_PER_S, Span, UtcTime};

/// One epoch as the receiver computes it.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct GnssSample {
    /// When it was true, host time.
    pub(super) t_true: MonoTime,
    /// When its first byte arrives.
    pub(super) t_first_byte: MonoTime,
    /// The receiver's report.
    pub(super) epoch: GnssEpoch,
}

/// The receiver.
#[derive(Clone, Debug)]
pub(super) struct GnssReceiver {
    stream: Stream,
    /// A separate stream, so that the same epochs come as values and as bytes.
    stamps: Stream,
    latency: Span,
    bias_m: Vector3<f64>,
    next_utc_ns: i64,
    step_ns: i64,
}

/// Horizontal and vertical errors that the receiver reports, metres (as a WAAS receiver does).
const STATED_ERROR_M: (f64, f64) = (2.6, 4.1);

impl GnssReceiver {
    pub(super) fn new(world: &World) -> Self {
        let scenario = world.scenario();
        let sim = &scenario.gps;
        let mut stream = Stream::of(world.seed(), Purpose::Gnss);
        let drawn_ms = stream.uniform(-1.0, 1.0) * sim.latency_spread_ms;
        let drawn_ms = drawn_ms + sim.latency_sigma_ms * Stream::of(world.seed(), Purpose::Latency).normal();
        let latency_ms = scenario.rig.gps.latency_ms + sim.latency_offset_ms + drawn_ms;
        let bias_m = Vector3::from_fn(|axis, _| stream.normal() * bias_sigma(scenario, axis));
        let step_ns = (NS_PER_S as f64 / sim.rate_hz.max(0.01)).round() as i64;
        let first = world.utc(0.0).unix_ns();
        let next_utc_ns = first.div_euclid(step_ns) * step_ns + step_ns;
        let stamps = Stream::of(world.seed(), Purpose::GnssStamps);
        Self { stream, stamps, latency: Span::from_ms(latency_ms), bias_m, next_utc_ns, step_ns }
    }

    /// True latency minus the configured one.
    pub(super) fn latency_error(&self, scenario: &Scenario) -> Span {
        self.latency - Span::from_ms(scenario.rig.gps.latency_ms)
    }

    /// Time of the next epoch, seconds into the flight.
    pub(super) fn due_s(&self, world: &World) -> f64 {
        world.seconds_at_utc(UtcTime::from_unix_ns(self.next_utc_ns))
    }

    /// The next epoch that is sent; `None` at the flight's end.
    pub(super) fn next(&mut self, world: &World) -> Option<GnssSample> {
        let scenario = world.scenario();
        let sim = &scenario.gps;
        loop {
            let utc = UtcTime::from_unix_ns(self.next_utc_ns);
            let t_s = world.seconds_at_utc(utc);
            if t_s > scenario.duration_s {
                return None;
            }
            self.next_utc_ns += self.step_ns;
            let keep = (-1.0 / (sim.rate_hz * sim.bias_tau_s)).exp();
            let fresh = (1.0 - keep * keep).sqrt();
            let white = Vector3::from_fn(|axis, _| {
                let scale = if axis == 2 { sim.vertical_factor } else { 1.0 };
                self.bias_m[axis] =
                    keep * self.bias_m[axis] + fresh * bias_sigma(scenario, axis) * self.stream.normal();
                scale * sim.noise_m * self.stream.normal()
            });
            let velocity_noise = Vector3::from_fn(|_, _| sim.velocity_noise_mps * self.stream.normal());
            let jitter = Span::from_ms(self.stream.normal() * sim.jitter_ms);
            if self.stream.chance(sim.dropout) {
                continue;
            }
            let t_true = world.time(t_s);
            let epoch = if within(&sim.outages_s, t_s) {
                no_fix(utc)
            } else {
                fix(world, t_true, utc, &(self.bias_m + white), &velocity_noise)
            };
            let t_first_byte = t_true + self.latency + jitter;
            return Some(GnssSample { t_true, t_first_byte, epoch });
        }
    }

    /// The error that the fit of arrival times leaves in a stamp.
    pub(super) fn stamp_noise(&mut self, scenario: &Scenario) -> Span {
        Span::from_ms(self.stamps.normal() * scenario.gps.stamp_noise_ms)
    }
}

fn bias_sigma(scenario: &Scenario, axis: usize) -> f64 {
    let scale = if axis == 2 { scenario.gps.vertical_factor } else { 1.0 };
    scale * scenario.gps.bias_sigma_m
}

fn no_fix(utc: UtcTime) -> GnssEpoch {
    GnssEpoch {
        utc: Some(utc),
        time_of_day_ns: Some(utc.unix_ns().rem_euclid(86_400 * NS_PER_S)),
        fix: FixKind::None,
        sats: Some(2),
        ..GnssEpoch::default()
    }
}

/// `x` in the precision of a field with this many decimals.
fn rounded(x: f64, digits: u32) -> f64 {
    let scale = 10_f64.powi(digits as i32);
    (x * scale).round() / scale
}

/// Position and velocity of the antenna.
fn antenna_at(world: &World, t: MonoTime) -> (Vector3<f64>, Vector3<f64>) {
    let own = world.ownship(t);
    let arm = vector(world.rig().gps.antenna_position_m);
    let swing = own.ned_from_body * own.body_rate_radps.cross(&arm);
    (own.position_ned_m + own.ned_from_body * arm, own.velocity_ned_mps + swing)
}

fn fix(
    world: &World,
    t_true: MonoTime,
    utc: UtcTime,
    error_m: &Vector3<f64>,
    velocity_error: &Vector3<f64>,
) -> GnssEpoch {
    let scenario = world.scenario();
    let antenna = filtered(scenario.gps.position_filter_s, t_true, |t| antenna_at(world, t).0);
    let velocity =
        filtered(scenario.gps.velocity_filter_s, t_true, |t| antenna_at(world, t).1) + velocity_error;
    let position = world.frame().geodetic(&(antenna + error_m));
    // Five digits of a minute, as the 5 Hz units send: 1.9 cm.
    let minutes = |degrees: f64| rounded(degrees * 60.0, 5) / 60.0;
    let vel = velocity.map(|x| rounded(x, scenario.gps.velocity_decimals));
    let speed_mps = vel.x.hypot(vel.y);
    let course_deg = rounded(vel.y.atan2(vel.x).to_degrees().rem_euclid(360.0), 1) % 360.0;
    GnssEpoch {
        utc: Some(utc),
        time_of_day_ns: Some(utc.unix_ns().rem_euclid(86_400 * NS_PER_S)),
        fix: FixKind::ThreeD,
        lat_deg: Some(minutes(position.lat_deg)),
        lon_deg: Some(minutes(position.lon_deg)),
        alt_msl_m: Some(rounded(position.height_m - scenario.geoid_m, 1)),
        geoid_m: Some(rounded(scenario.geoid_m, 1)),
        speed_mps: Some(speed_mps),
        course_deg: Some(course_deg),
        vel_ned_mps: Some(vel),
        vel_has_down: true,
        hpe_m: Some(STATED_ERROR_M.0),
        vpe_m: Some(STATED_ERROR_M.1),
        sats: Some(9),
        hdop: Some(0.9),
        ..GnssEpoch::default()
    }
}
