//! The helicopter's own sensors: GPS position and velocity, compass heading and tilt.

#![expect(clippy::needless_range_loop, reason = "matrix arithmetic reads by its indices")]

use nalgebra::{Matrix3, Rotation3, Vector3};

use windhover_base::geo::{Geodetic, ned_from_body_321, skew, tilt_from_down, wrap_angle};
use windhover_base::msg::{AttitudeSample, Disposition, FixKind, FusionSource, GnssEpoch};
use windhover_base::time::MonoTime;

use super::core::Core;
use super::learn::{GPS_FACTORS, LEARN_RATIO, Learnt, blend_factor, blend_noise};
use super::models::Models;
use super::state::{Own, Rejections, State, at};
use super::update::{Measurement, Outcome};

/// What an epoch measures, metres and metres a second in NED.
struct GnssValues {
    position: Option<Vector3<f64>>,
    has_height: bool,
    velocity: Option<Vector3<f64>>,
    has_down: bool,
}

fn values(epoch: &GnssEpoch, models: &Models) -> GnssValues {
    let with_fix = epoch.fix != FixKind::None;
    let has_height = epoch.fix != FixKind::TwoD && epoch.alt_msl_m.is_some();
    let height_m = epoch.alt_msl_m.unwrap_or(0.0) + epoch.geoid_m.unwrap_or(0.0);
    let height_m = if has_height { height_m } else { models.frame.datum().height_m };
    let position = epoch
        .lat_deg
        .zip(epoch.lon_deg)
        .filter(|_| with_fix)
        .map(|(lat_deg, lon_deg)| models.frame.ned(Geodetic { lat_deg, lon_deg, height_m }));
    let from_course = || {
        let (speed, course) = (epoch.speed_mps?, epoch.course_deg?.to_radians());
        Some(Vector3::new(speed * course.cos(), speed * course.sin(), 0.0))
    };
    let velocity = epoch.vel_ned_mps.or_else(from_course).filter(|_| with_fix);
    let has_down = epoch.vel_ned_mps.is_some() && epoch.vel_has_down;
    GnssValues { position, has_height, velocity, has_down }
}

/// Farthest from the datum that a position can be meant, m: the tangent plane ends somewhere.
const FARTHEST_M: f64 = 2.0e5;
/// Fastest a helicopter can be meant to fly, m/s.
const FASTEST_MPS: f64 = 150.0;

impl Core {
    /// Fuses one epoch.
    pub(super) fn fuse_gnss(&mut self, epoch: &GnssEpoch) {
        let seen = values(epoch, &self.models);
        match seen.velocity {
            Some(v) if v.norm() < FASTEST_MPS => self.fuse_gps_velocity(&v, seen.has_down),
            Some(_) => self.refuse(FusionSource::GpsVelocity, Disposition::Invalid),
            None => {}
        }
        match seen.position {
            Some(p) if p.norm() < FARTHEST_M => self.fuse_gps_position(&p, seen.has_height),
            Some(_) => self.refuse(FusionSource::GpsPosition, Disposition::Invalid),
            None => {}
        }
    }

    /// Writes a fix into `z`: `z = p + R l + b − v τ + ½ a τ²`, with the antenna's velocity v and the delay τ.
    pub(super) fn expect_gps_position(&mut self, position: &Vector3<f64>, has_height: bool) {
        let (own, models) = (&self.state.own, &self.models);
        let m = if has_height { 3 } else { 2 };
        let arm = own.ned_from_body * models.antenna_at;
        let velocity = antenna_velocity(own, models);
        let tau = own.gps_delay_s;
        let expected =
            own.position + arm + own.gps_bias - velocity * tau + own.acceleration() * (0.5 * tau * tau);
        let z = &mut self.z;
        z.begin(m);
        let p = z.columns(at::POSITION, 3);
        let v = z.columns(at::VELOCITY, 3);
        let attitude = z.columns(at::ATTITUDE, 3);
        let bias = z.columns(at::GPS_BIAS, 3);
        let delay = z.columns(at::GPS_DELAY, 1);
        let d_attitude = -skew(&arm);
        let d_delay = -velocity + own.acceleration() * tau;
        let noise_var = models.gps_noise_var * self.state.learnt.gps_factor;
        for i in 0..m {
            z.residual[i] = position[i] - expected[i];
            z.set(i, p + i, 1.0);
            z.set(i, v + i, -tau);
            z.set(i, bias + i, 1.0);
            z.set(i, delay, d_delay[i]);
            set_row(z, i, attitude, &d_attitude);
            z.noise[i][i] = noise_var * if i == 2 { 4.0 } else { 1.0 };
        }
    }

    fn fuse_gps_position(&mut self, position: &Vector3<f64>, has_height: bool) {
        self.expect_gps_position(position, has_height);
        let error = self.receiver_error();
        let outcome = self.fuse_gated(FusionSource::GpsPosition);
        self.learn_gps(outcome, |learnt| &mut learnt.gps_factor);
        let rejections = &mut self.state.rejections;
        rejections.gps_position = counted(rejections.gps_position, outcome.ratio);
        let before = std::mem::replace(&mut rejections.gps_error, error);
        if rejections.gps_position >= self.restart_after {
            self.follow_jump(position, has_height, &before);
        }
    }

    /// `z = v + R (ω × l) − a τ`
    fn fuse_gps_velocity(&mut self, velocity: &Vector3<f64>, has_down: bool) {
        let (own, models) = (&self.state.own, &self.models);
        let m = if has_down { 3 } else { 2 };
        let tau = own.gps_delay_s;
        let acceleration = own.acceleration();
        let expected = antenna_velocity(own, models) - acceleration * tau;
        let swing = own.ned_from_body * own.rate.cross(&models.antenna_at);
        let d_rate = -own.rotation() * skew(&models.antenna_at);
        let d_attitude = -skew(&swing) + skew(&(own.ned_from_body * own.force)) * tau;
        let d_force = -own.rotation() * tau;
        let d_drag = own.velocity * tau;
        let z = &mut self.z;
        z.begin(m);
        let v = z.columns(at::VELOCITY, 3);
        let attitude = z.columns(at::ATTITUDE, 3);
        let rate = z.columns(at::RATE, 3);
        let force = z.columns(at::FORCE, 3);
        let delay = z.columns(at::GPS_DELAY, 1);
        let drag = z.columns(at::DRAG, 1);
        for i in 0..m {
            z.residual[i] = velocity[i] - expected[i];
            z.set(i, v + i, 1.0);
            set_row(z, i, attitude, &d_attitude);
            set_row(z, i, rate, &d_rate);
            set_row(z, i, force, &d_force);
            z.set(i, delay, -acceleration[i]);
            z.set(i, drag, d_drag[i]);
            z.noise[i][i] = models.gps_velocity_var * self.state.learnt.gps_velocity_factor;
        }
        let outcome = self.fuse_gated(FusionSource::GpsVelocity);
        self.learn_gps(outcome, |learnt| &mut learnt.gps_velocity_factor);
        self.state.rejections.gps_velocity = counted(self.state.rejections.gps_velocity, outcome.ratio);
        if self.state.rejections.gps_velocity >= self.restart_after {
            self.state.rejections.gps_velocity = 0;
            self.state.renew(at::VELOCITY, &[4.0; 3]);
            self.state.own.velocity = *velocity;
        }
    }

    /// Fits a factor on the receiver's noise to what became of a measurement.
    fn learn_gps(&mut self, outcome: Outcome, factor: impl Fn(&mut Learnt) -> &mut f64) {
        if self.learning.on && outcome.ratio < LEARN_RATIO {
            blend_factor(factor(&mut self.state.learnt), outcome.misfit, GPS_SAMPLES, GPS_FACTORS);
        }
    }

    /// Fuses one compass reading.
    pub(super) fn fuse_attitude(&mut self, sample: &AttitudeSample) {
        if let Some(heading) = sample.heading {
            self.fuse_heading(true_heading(heading, sample.heading_is_true, &self.models));
        }
        if let Some(tilt) = sample.tilt {
            let tilt = windhover_base::geo::Tilt {
                pitch: tilt.pitch - self.models.pitch_offset,
                roll: tilt.roll - self.models.roll_offset,
            };
            match self.models.convention.down_in_body(tilt) {
                Some(down) => self.fuse_tilt(&down),
                None => self.refuse(FusionSource::CompassTilt, Disposition::Invalid),
            }
        }
    }

    /// `z = ψ + b`, where ψ is the azimuth of the body's x axis x: for a small rotation ε about NED,
    /// `δψ = ε_D − (x_N x_D ε_N + x_E x_D ε_E)/(x_N² + x_E²)`.
    fn fuse_heading(&mut self, heading: f64) {
        let own = &self.state.own;
        let x = own.rotation().column(0).into_owned();
        let level2 = x.x * x.x + x.y * x.y;
        let z = &mut self.z;
        z.begin(1);
        let attitude = z.columns(at::ATTITUDE, 3);
        let bias = z.columns(at::HEADING_BIAS, 1);
        z.residual[0] = wrap_angle(heading - x.y.atan2(x.x) - own.heading_bias);
        z.set(0, attitude, -x.x * x.z / level2);
        z.set(0, attitude + 1, -x.y * x.z / level2);
        z.set(0, attitude + 2, 1.0);
        z.set(0, bias, 1.0);
        z.noise[0][0] = self.state.learnt.heading_var;
        let residual = z.residual[0];
        let outcome = self.fuse_gated(FusionSource::CompassHeading);
        if self.learning.on && outcome.ratio < LEARN_RATIO {
            let start = self.learning.start.heading_var;
            let gain = SAMPLE_GAIN_S / self.learning.over_s;
            let value = &mut self.state.learnt.heading_var;
            blend_noise(value, residual, outcome.innovation_var[0], gain, (0.25 * start, 36.0 * start));
        }
        self.state.rejections.heading = counted(self.state.rejections.heading, outcome.ratio);
        if self.state.rejections.heading >= 6 * self.restart_after {
            self.state.rejections.heading = 0;
            self.state.renew(at::HEADING_BIAS, &[9.0 * self.models.heading_bias_var]);
        }
    }

    /// `z = k (−d₁, d₂) + b`, where d is down in the body frame and k how much of the tilt the
    /// sensor reads: 1 on the ground, little on a rotorcraft, whose tilt sensor feels specific force.
    fn fuse_tilt(&mut self, down: &Vector3<f64>) {
        let own = &self.state.own;
        let inverse: Matrix3<f64> = own.rotation().transpose();
        let d = inverse.column(2).into_owned();
        let d_attitude = inverse * skew(&Vector3::z());
        let k = own.tilt_gain;
        let z = &mut self.z;
        z.begin(2);
        let attitude = z.columns(at::ATTITUDE, 3);
        let gain = z.columns(at::TILT_GAIN, 1);
        let bias = z.columns(at::TILT_BIAS, 2);
        for (i, sign) in [-1.0, 1.0].into_iter().enumerate() {
            z.residual[i] = sign * down[i] - k * sign * d[i] - own.tilt_bias[i];
            for j in 0..3 {
                z.set(i, attitude + j, k * sign * d_attitude[(i, j)]);
            }
            z.set(i, gain, sign * d[i]);
            z.set(i, bias + i, 1.0);
            z.noise[i][i] = self.state.learnt.tilt_var + UNTIED * product_var(&self.state, i, &d_attitude);
        }
        let residual = [z.residual[0], z.residual[1]];
        let outcome = self.fuse_gated(FusionSource::CompassTilt);
        if self.learning.on && outcome.ratio < LEARN_RATIO {
            let start = self.learning.start.tilt_var;
            let gain = 0.5 * SAMPLE_GAIN_S / self.learning.over_s;
            let value = &mut self.state.learnt.tilt_var;
            for i in 0..2 {
                blend_noise(
                    value,
                    residual[i],
                    outcome.innovation_var[i],
                    gain,
                    (0.25 * start, 400.0 * start),
                );
            }
        }
        self.state.rejections.tilt = counted(self.state.rejections.tilt, outcome.ratio);
        if self.state.rejections.tilt >= 6 * self.restart_after {
            self.state.rejections.tilt = 0;
            self.state.learnt.tilt_var *= 16.0;
            self.state.renew(at::TILT_GAIN, &[0.25]);
        }
    }
}

/// Fixes the fitted noise of the receiver remembers: ten seconds at 5 Hz.
const GPS_SAMPLES: f64 = 50.0;

/// What one compass reading counts in a sliding mean, s: the interval of a 30 Hz compass.
const SAMPLE_GAIN_S: f64 = 1.0 / 30.0;

/// Readings over which the product of the errors of gain and tilt stays what it is: two seconds of a
/// 30 Hz compass. Its variance counts so many times, since it does not average out.
const UNTIED: f64 = 60.0;

/// Variance of the product of the errors of tilt gain and of `d_i`, which the linear model leaves out:
/// as long as the gain is unknown, a reading near zero does not prove that the aircraft is level.
fn product_var(state: &State, i: usize, d_attitude: &Matrix3<f64>) -> f64 {
    let (mut tilt_var, mut mixed) = (0.0, 0.0);
    for a in 0..3 {
        for b in 0..3 {
            let p = state.cov.at(at::ATTITUDE + a, at::ATTITUDE + b);
            tilt_var += d_attitude[(i, a)] * d_attitude[(i, b)] * p;
        }
        mixed += d_attitude[(i, a)] * state.cov.at(at::ATTITUDE + a, at::TILT_GAIN);
    }
    (state.cov.at(at::TILT_GAIN, at::TILT_GAIN) * tilt_var + mixed * mixed).max(0.0)
}

fn antenna_velocity(own: &Own, models: &Models) -> Vector3<f64> {
    own.velocity + own.ned_from_body * own.rate.cross(&models.antenna_at)
}

fn set_row(z: &mut Measurement, i: usize, first: usize, d: &Matrix3<f64>) {
    for j in 0..3 {
        z.set(i, first + j, d[(i, j)]);
    }
}

fn counted(so_far: u32, ratio: f64) -> u32 {
    if ratio <= 1.0 { 0 } else { so_far + 1 }
}

/// True heading of the aircraft from what the device reports.
pub(super) fn true_heading(heading: f64, is_true: bool, models: &Models) -> f64 {
    heading + if is_true { 0.0 } else { models.declination } + models.yaw_offset
}

/// Starts the helicopter's state from a fix and a compass reading; `false` where the fix has no
/// position.
pub(super) fn start(
    state: &mut State,
    t: MonoTime,
    epoch: &GnssEpoch,
    compass: &AttitudeSample,
    models: &Models,
) -> bool {
    let seen = values(epoch, models);
    let (Some(position), Some(heading)) = (seen.position.filter(|p| p.norm() < FARTHEST_M), compass.heading)
    else {
        return false;
    };
    let down = compass.tilt.and_then(|tilt| models.convention.down_in_body(tilt));
    let (pitch, roll) = down.map_or((0.0, 0.0), |d| tilt_from_down(&d));
    let heading = true_heading(heading, compass.heading_is_true, models);
    let attitude: Rotation3<f64> = ned_from_body_321(heading, pitch, roll);
    let velocity = seen.velocity.filter(|v| v.norm() < FASTEST_MPS);
    state.own = Own {
        position: position - attitude * models.antenna_at,
        velocity: velocity.unwrap_or_default(),
        ned_from_body: attitude,
        ..Own::default()
    };
    state.t = t;
    state.alive = true;
    state.rejections = Rejections::default();
    state.targets.fill(Default::default());
    state.features.fill(Default::default());
    state.cov.fill(0.0);
    state.probe.live = false;
    state.echoes.iter_mut().for_each(|echo| echo.live = false);
    let mut variances = [0.0; at::OWN];
    // Position starts wide and is tied to the receiver's bias by the first update.
    variances[at::POSITION..at::POSITION + 3].fill(ANYWHERE_VAR);
    variances[at::VELOCITY..at::VELOCITY + 3].fill(if velocity.is_some() { 1.0 } else { 100.0 });
    variances[at::ATTITUDE..at::ATTITUDE + 2].fill(START_TILT.powi(2));
    variances[at::ATTITUDE + 2] = models.heading_bias_var + START_HEADING.powi(2);
    variances[at::RATE..at::RATE + 3].fill(0.3 * 0.3);
    variances[at::FORCE..at::FORCE + 2].fill(state.learnt.side_force_var);
    variances[at::FORCE + 2] = state.learnt.thrust_var;
    variances[at::GPS_BIAS..at::GPS_BIAS + 3].copy_from_slice(models.gps_bias_var.as_slice());
    variances[at::HEADING_BIAS] = models.heading_bias_var;
    variances[at::TILT_GAIN] = START_TILT_GAIN.powi(2);
    variances[at::TILT_BIAS..at::TILT_BIAS + 2].fill(START_TILT_BIAS.powi(2));
    variances[at::GPS_DELAY] = models.gps_delay_var;
    variances[at::DRAG] = START_DRAG_PER_S.powi(2);
    for (i, variance) in variances.into_iter().enumerate() {
        state.cov.set(i, i, variance);
    }
    // Heading is the reading less the bias: where the one errs, so does the other.
    state.cov.set(at::ATTITUDE + 2, at::HEADING_BIAS, -models.heading_bias_var);
    state.cov.set(at::HEADING_BIAS, at::ATTITUDE + 2, -models.heading_bias_var);
    true
}

/// Variance of a position that is about to be read off the receiver, m².
pub(super) const ANYWHERE_VAR: f64 = 1e4;
/// Tilt at the start, one sigma, rad: what a helicopter may fly with whatever its compass says.
const START_TILT: f64 = 0.1;
/// What a heading reading may have changed since it was taken, one sigma, rad.
pub(super) const START_HEADING: f64 = 0.1;
/// Drag of a small helicopter, one sigma, 1/s: 0.1 to 0.3 is usual.
const START_DRAG_PER_S: f64 = 0.2;
/// Zero offset of a tilt sensor, one sigma, rad (0.4°: data sheets allow 0.2° to 0.5°).
const START_TILT_BIAS: f64 = 0.007;
/// How far from 1 the share of tilt read may be at the start, one sigma.
const START_TILT_GAIN: f64 = 0.5;
