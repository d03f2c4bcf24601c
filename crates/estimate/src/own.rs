//! The helicopter and its sensors' slow errors.
//!
//! A force or slow error more is a field of [`Own`], a block in `blocks.rs` and a row of the table in `slow.rs`: where it starts and how
//! it wanders. Everything else (injection, prediction, start, warm start) goes by the table. The measurement models in
//! `aid` that it explains take it from there; what the forces do is in `force.rs`.

use nalgebra::{Matrix3, Rotation3, Vector2, Vector3, Vector4};

use windhover_base::msg::FixKind;
use windhover_base::time::MonoTime;

use super::blocks::{Block, Layout, own};

/// Standard gravity, m/s².
pub(crate) const GRAVITY: f64 = 9.806_65;

/// The means.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Own {
    /// Of the body frame's origin, NED, m.
    pub(crate) position: Vector3<f64>,
    pub(crate) velocity: Vector3<f64>,
    pub(crate) ned_from_body: Rotation3<f64>,
    pub(crate) rate: Vector3<f64>,
    /// Force of gusts over mass, north and east, m/s².
    pub(crate) gust: Vector2<f64>,
    /// Vertical part of the thrust beyond the weight, m/s².
    pub(crate) thrust: f64,
    /// Slow error of the tilt reading (pitch, roll), rad.
    pub(crate) tilt_error: Vector2<f64>,
    /// Slow force of the wind over mass, north and east, m/s².
    pub(crate) wind: Vector2<f64>,
    /// The thrust's direction in the body is against (ε1, ε2, 1).
    pub(crate) trim: Vector2<f64>,
    pub(crate) gps_bias: Vector3<f64>,
    pub(crate) heading_bias: f64,
    pub(crate) tilt_gain: f64,
    pub(crate) tilt_bias: Vector2<f64>,
    pub(crate) gps_delay_s: f64,
    pub(crate) drag_per_s: f64,
    pub(crate) compass_delay_s: f64,
    /// By how much the antenna is elsewhere than configured, forward and right, m.
    pub(crate) arm: Vector2<f64>,
    /// By how much the lens's distortion (k1, k2, p1, p2) is more than configured.
    pub(crate) lens: Vector4<f64>,
    /// How much longer than configured the camera takes from its first row to its last, s.
    pub(crate) readout_s: f64,
    /// Time constant of the low-pass that the receiver applies to velocity, s.
    pub(crate) velocity_delay_s: f64,
    /// Of the gyros, rad/s, and of the accelerometers, m/s², body axes.
    pub(crate) rate_bias: Vector3<f64>,
    pub(crate) force_bias: Vector3<f64>,
    /// Of the second source of attitude.
    pub(crate) second: AttitudeErrors,
}

/// The two sources of attitude, where there are figures of both.
pub(crate) const COMPASS: usize = 0;
pub(crate) const SECOND: usize = 1;

/// Where the errors of the compass and of the second source of attitude stand.
pub(crate) const PLACES: [AttitudePlaces; 2] = [
    AttitudePlaces {
        heading_bias: own::HEADING_BIAS,
        tilt_gain: own::TILT_GAIN,
        tilt_bias: own::TILT_BIAS,
        tilt_error: own::TILT_ERROR,
    },
    AttitudePlaces {
        heading_bias: own::SECOND_HEADING_BIAS,
        tilt_gain: own::SECOND_TILT_GAIN,
        tilt_bias: own::SECOND_TILT_BIAS,
        tilt_error: own::SECOND_TILT_ERROR,
    },
];

/// Where the errors of a source of attitude stand.
#[derive(Clone, Copy, Debug)]
pub(crate) struct AttitudePlaces {
    pub(crate) heading_bias: Block<1>,
    pub(crate) tilt_gain: Block<1>,
    pub(crate) tilt_bias: Block<2>,
    pub(crate) tilt_error: Block<2>,
}

/// Errors of a source of attitude.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(crate) struct AttitudeErrors {
    pub(crate) heading_bias: f64,
    pub(crate) tilt_gain: f64,
    pub(crate) tilt_bias: Vector2<f64>,
    pub(crate) tilt_error: Vector2<f64>,
}

impl Default for AttitudeErrors {
    fn default() -> Self {
        Self { heading_bias: 0.0, tilt_gain: 1.0, tilt_bias: Vector2::zeros(), tilt_error: Vector2::zeros() }
    }
}

impl Default for Own {
    fn default() -> Self {
        Self {
            position: Vector3::zeros(),
            velocity: Vector3::zeros(),
            ned_from_body: Rotation3::identity(),
            rate: Vector3::zeros(),
            gust: Vector2::zeros(),
            thrust: 0.0,
            tilt_error: Vector2::zeros(),
            wind: Vector2::zeros(),
            trim: Vector2::zeros(),
            gps_bias: Vector3::zeros(),
            heading_bias: 0.0,
            tilt_gain: 1.0,
            tilt_bias: Vector2::zeros(),
            gps_delay_s: 0.0,
            drag_per_s: 0.0,
            compass_delay_s: 0.0,
            arm: Vector2::zeros(),
            lens: Vector4::zeros(),
            readout_s: 0.0,
            velocity_delay_s: 0.0,
            rate_bias: Vector3::zeros(),
            force_bias: Vector3::zeros(),
            second: AttitudeErrors::default(),
        }
    }
}

/// Number of states that move by themselves, those of sensors that are not there counted.
pub(crate) const SLOW_STATES: usize = own::SLOW.end() - own::SLOW.column(0);
/// Number of those that outlive a restart.
pub(crate) const SENSOR_STATES: usize = own::SENSORS.end() - own::SENSORS.column(0);
/// Number of states whose intensities are fitted in flight.
pub(crate) const MOTION_STATES: usize = own::MOTION.end() - own::MOTION.column(0);

/// What the sensors are taken to be at present.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Senses {
    /// Variance of the tilt reading's slow error, rad², and its correlation time, s, by what the sensor feels.
    pub(crate) tilt_error_var: f64,
    pub(crate) tilt_error_tau_s: f64,
    /// Likewise of the second source of attitude.
    pub(crate) second_error_var: f64,
    pub(crate) second_error_tau_s: f64,
    /// The quality of the receiver's fix, and by it and by what the receiver says of its errors the variances of its bias
    /// and its noise, m².
    pub(crate) fix: FixKind,
    pub(crate) gps_bias_var: [f64; 3],
    pub(crate) gps_noise_var: f64,
    /// What the bias may still be by what was said before, m², and when that was so.
    pub(crate) gps_bias_held_var: [f64; 3],
    pub(crate) gps_bias_held_at: MonoTime,
}

impl Own {
    /// `ned_from_body` as a matrix.
    pub(crate) fn rotation(&self) -> &Matrix3<f64> {
        self.ned_from_body.matrix()
    }

    /// Where the antenna is, body axes, by what is configured, m.
    pub(crate) fn antenna(&self, configured: &Vector3<f64>) -> Vector3<f64> {
        configured + Vector3::new(self.arm.x, self.arm.y, 0.0)
    }

    /// Velocity of a point at `lever_m` in the body frame: `v + R (ω × l)`.
    pub(crate) fn velocity_of(&self, lever_m: &Vector3<f64>) -> Vector3<f64> {
        self.velocity + self.ned_from_body * self.rate.cross(lever_m)
    }

    /// Time from the first row of a frame to the last, of which so much is configured, s.
    pub(crate) fn whole_readout_s(&self, configured_s: f64) -> f64 {
        configured_s + self.readout_s
    }

    /// How much older the receiver's velocity is than configured, s.
    pub(crate) fn velocity_age_s(&self) -> f64 {
        self.gps_delay_s + self.velocity_delay_s
    }

    /// Errors of the compass (0) or of the second source of attitude (1).
    pub(crate) fn errors_of(&self, source: usize) -> AttitudeErrors {
        if source == SECOND {
            return self.second;
        }
        let Self { heading_bias, tilt_gain, tilt_bias, tilt_error, .. } = *self;
        AttitudeErrors { heading_bias, tilt_gain, tilt_bias, tilt_error }
    }

    /// The states of [`own::MOTION`] in the order of their columns.
    pub(crate) fn motion(&self) -> [f64; MOTION_STATES] {
        let (rate, gust, error) = (&self.rate, &self.gust, &self.tilt_error);
        [rate.x, rate.y, rate.z, gust.x, gust.y, self.thrust, error.x, error.y]
    }

    /// Moves it by an error-state step, of which the helicopter's part has this layout.
    pub(crate) fn inject(&mut self, dx: &[f64], layout: Layout) {
        self.position += own::POSITION.of(dx);
        self.velocity += own::VELOCITY.of(dx);
        self.ned_from_body = Rotation3::new(own::ATTITUDE.of(dx)) * self.ned_from_body;
        self.rate += own::RATE.of(dx);
        let slow = &dx[layout.slow()];
        self.change_slow(|i, mean| *mean += slow.get(i).unwrap_or(&0.0));
    }

    /// Whether every mean is a number.
    pub(crate) fn is_finite(&self) -> bool {
        let vectors = [&self.position, &self.velocity, &self.rate];
        vectors.iter().all(|v| v.iter().all(|x| x.is_finite()))
            && self.slow().iter().all(|x| x.is_finite())
            && self.rotation().iter().all(|x| x.is_finite())
    }

    /// The slow states in the order of their columns.
    pub(crate) fn slow(mut self) -> [f64; SLOW_STATES] {
        let mut means = [0.0; SLOW_STATES];
        self.change_slow(|i, mean| means[i] = *mean);
        means
    }
}
