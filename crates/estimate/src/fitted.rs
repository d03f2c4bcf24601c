//! The figures that are fitted in flight: what they are, and how a sample moves them.
//!
//! `learn.rs` fits the motion of helicopter and vehicles; each measurement model fits its own noise (`aid`).

use windhover_base::time::{MonoTime, Span};

use super::receiver_error::Wandering;

/// What is fitted.
#[derive(Clone, Debug, Default)]
pub(crate) struct Learnt {
    /// Intensities of speed and yaw rate walk per target, (m/s)²/s and (rad/s)²/s.
    pub(crate) target_q: Vec<[f64; 2]>,
    /// Intensity of roll and pitch rate walk, (rad/s)²/s.
    pub(crate) tilt_rate_q: f64,
    /// Intensity of yaw rate walk, (rad/s)²/s.
    pub(crate) yaw_rate_q: f64,
    /// Variance of the force of gusts, (m/s²)².
    pub(crate) gust_var: f64,
    /// Variance of the thrust beyond the weight, (m/s²)².
    pub(crate) thrust_var: f64,
    /// Variance of the tilt reading's slow error, rad².
    pub(crate) tilt_error_var: f64,
    /// Variances of a tilt reading of the compass and of the second source of attitude, rad².
    pub(crate) tilt_var: [f64; 2],
    /// Of a heading reading likewise, rad².
    pub(crate) heading_var: [f64; 2],
    /// Factors on the variance of each target's marker pixels, and of ground features.
    pub(crate) marker_factor: Vec<f64>,
    pub(crate) feature_factor: f64,
    /// Factors on the variance of the receiver's position and velocity noise.
    pub(crate) gps_factor: f64,
    /// How far the receiver's slow error wanders.
    pub(crate) receiver: Wandering,
    pub(crate) gps_velocity_factor: f64,
    /// Factor on the variance of the accelerometers' noise.
    pub(crate) force_factor: f64,
    /// Whether no marker was in view when it was last fitted.
    pub(crate) blind: bool,
    /// When the targets' intensities were last fitted.
    pub(crate) t_target: MonoTime,
}

/// Limits of what is fitted, as factors on the configured standard deviation.
pub(crate) const LEAST: f64 = 0.01;
pub(crate) const MOST: f64 = 5.0;

/// Least that is fitted of a vehicle's motion, likewise: one that is parked does not move at all.
pub(crate) const STILL: f64 = 0.005;

/// Farther outside the gate than this a measurement says nothing of the noise of good ones.
pub(crate) const LEARN_RATIO: f64 = 4.0;

/// Shortest increment looked at, s.
pub(crate) const SHORTEST_S: f64 = 0.1;

/// The configured values and how fast to leave them.
#[derive(Clone, Debug)]
pub(crate) struct Learning {
    pub(crate) on: bool,
    pub(crate) over_s: f64,
    /// Interval of the increments looked at, and while no marker is seen.
    pub(crate) interval: Span,
    pub(crate) blind_interval: Span,
    pub(crate) start: Learnt,
}

impl Learnt {
    /// Copies without allocating where the sizes match.
    pub(crate) fn copy_from(&mut self, other: &Self) {
        let (mut target_q, mut marker_factor) =
            (std::mem::take(&mut self.target_q), std::mem::take(&mut self.marker_factor));
        target_q.clone_from(&other.target_q);
        marker_factor.clone_from(&other.marker_factor);
        *self = Self {
            target_q,
            marker_factor,
            tilt_rate_q: other.tilt_rate_q,
            yaw_rate_q: other.yaw_rate_q,
            gust_var: other.gust_var,
            thrust_var: other.thrust_var,
            tilt_error_var: other.tilt_error_var,
            tilt_var: other.tilt_var,
            heading_var: other.heading_var,
            feature_factor: other.feature_factor,
            gps_factor: other.gps_factor,
            receiver: other.receiver,
            gps_velocity_factor: other.gps_velocity_factor,
            force_factor: other.force_factor,
            blind: other.blind,
            t_target: other.t_target,
        };
    }
}

/// Moves `value` toward `sample`, within the limits about `start`.
pub(crate) fn blend(value: &mut f64, sample: f64, gain: f64, start: f64) {
    blend_within(value, sample, gain, (start * LEAST * LEAST, start * MOST * MOST));
}

/// Moves `value` toward `sample`, within limits.
pub(crate) fn blend_within(value: &mut f64, sample: f64, gain: f64, limits: (f64, f64)) {
    if sample.is_finite() {
        *value = (*value + gain * (sample - *value)).clamp(limits.0, limits.1);
    }
}

/// Moves a measurement's variance toward what its residual after fusion shows:
/// `E[(z − h)² | data] = (R/S r)² + R (1 − R/S)`. `R` is the variance times the factor by which it counted in the fusion.
pub(crate) fn blend_noise(
    value: &mut f64,
    factor: f64,
    residual: f64,
    innovation_var: f64,
    gain: f64,
    limits: (f64, f64),
) {
    let used = *value * factor;
    let share = used / innovation_var.max(used);
    let sample = (share * residual).powi(2) + used * (1.0 - share);
    blend_within(value, sample, gain, limits);
}

/// Moves a factor on a measurement's noise toward what its misfit (one where the noise is right) shows.
pub(crate) fn blend_factor(value: &mut f64, misfit: f64, samples: f64, limits: (f64, f64)) {
    if misfit.is_finite() {
        *value = (*value * (1.0 + (misfit - 1.0) / samples)).clamp(limits.0, limits.1);
    }
}
