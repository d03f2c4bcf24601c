//! Errors of each sensor of a simulated flight, as numbers.

/// Errors of the GPS receiver.
#[derive(Clone, PartialEq, Debug)]
pub struct GpsSim {
    /// Fixes a second.
    pub rate_hz: f64,
    /// Slowly wandering error, metres one-sigma an axis, horizontally (first-order Gauss–Markov).
    pub bias_sigma_m: f64,
    /// Its correlation time, seconds.
    pub bias_tau_s: f64,
    /// White error, metres one-sigma an axis, horizontally.
    pub noise_m: f64,
    /// Vertical errors are this many times the horizontal ones.
    pub vertical_factor: f64,
    /// Velocity error, m/s one-sigma an axis.
    pub velocity_noise_mps: f64,
    /// The true latency lies this far around the configured one, ms (uniform, one draw a flight).
    pub latency_spread_ms: f64,
    /// Added to the latency on top, ms.
    pub latency_offset_ms: f64,
    /// Added to that, ms one-sigma (normal, one draw a flight).
    pub latency_sigma_ms: f64,
    /// Time constant of a filter on the position it reports, seconds (first order; 0 for none).
    pub position_filter_s: f64,
    /// And on the velocity.
    pub velocity_filter_s: f64,
    /// Jitter of the arrival, ms one-sigma.
    pub jitter_ms: f64,
    /// Jitter that the fit of arrival times leaves in a stamp, ms one-sigma (values only: with bytes, the fit itself
    /// does this).
    pub stamp_noise_ms: f64,
    /// Probability that an epoch is not sent at all.
    pub dropout: f64,
    /// From and to, seconds: no fix.
    pub outages_s: Vec<(f64, f64)>,
    /// Digits of velocity behind the point in `$PGRMV`.
    pub velocity_decimals: u32,
}

/// Errors of the compass.
#[derive(Clone, PartialEq, Debug)]
pub struct CompassSim {
    /// Samples a second.
    pub rate_hz: f64,
    /// Constant heading error, degrees one-sigma (one draw a flight).
    pub bias_sigma_deg: f64,
    /// Added to that, degrees.
    pub bias_offset_deg: f64,
    /// Heading noise, degrees one-sigma.
    pub heading_noise_deg: f64,
    /// Tilt noise, degrees one-sigma an axis.
    pub tilt_noise_deg: f64,
    /// How much of the true tilt it reads: 1 is perfect, 0.15 what an accelerometer sees on a
    /// rotorcraft (geometry of thrust: see ARCHITECTURE).
    pub tilt_gain: f64,
    /// Whether it measures the direction of specific force instead of the vertical, as a fluid or an accelerometer
    /// does.
    pub feels_force: bool,
    /// Time constant of its tilt, seconds (first order; 0 for none).
    pub tilt_lag_s: f64,
    /// Slow error of its tilt, degrees one-sigma an axis (first-order Gauss–Markov), as an AHRS has it.
    pub slow_tilt_deg: f64,
    /// Its correlation time, seconds.
    pub slow_tilt_tau_s: f64,
    /// Iron: amplitude of a heading error that turns with the heading, degrees.
    pub iron_deg: f64,
    /// Magnetic dip, degrees: where given, wrong tilt also enters the heading, as in a real
    /// tilt-compensated magnetic compass.
    pub dip_deg: Option<f64>,
    /// The true latency lies this far around the configured one, ms (uniform, one draw a flight).
    pub latency_spread_ms: f64,
    /// Added to the latency on top, ms.
    pub latency_offset_ms: f64,
    /// Jitter of the arrival, ms one-sigma.
    pub jitter_ms: f64,
    /// From and to, seconds: silent.
    pub outages_s: Vec<(f64, f64)>,
    /// Probability that a sample carries an error flag and no valid heading.
    pub flagged: f64,
}

/// Errors of the camera and of what is seen in its frames.
#[derive(Clone, PartialEq, Debug)]
pub struct CameraSim {
    /// Jitter of the exposure times, ms one-sigma.
    pub period_jitter_ms: f64,
    /// Error of the driver's stamp, ms one-sigma.
    pub stamp_noise_ms: f64,
    /// The driver's stamp is this much later than the configuration makes of it, ms.
    pub stamp_late_ms: f64,
    /// From the exposure of the first row to that of the last, ms. The stamp is the middle row's.
    pub readout_ms: f64,
    /// Vibration of the camera on its mount, degrees rms an axis.
    pub vibration_deg: f64,
    /// From exposure to dequeuing, ms.
    pub transfer_ms: f64,
    /// Jitter of that, ms one-sigma.
    pub transfer_jitter_ms: f64,
    /// Probability that a frame is lost.
    pub dropped: f64,
    /// From and to, seconds: no frames.
    pub outages_s: Vec<(f64, f64)>,
    /// Mounting error against the configured mount, degrees: yaw, pitch, roll.
    pub mount_error_deg: [f64; 3],
    /// Noise of a marker's corners (values only), pixels one-sigma an axis.
    pub marker_noise_px: f64,
    /// Probability that a marker in view is missed (values only).
    pub marker_missed: f64,
    /// Probability that a marker is grossly wrong, tens of pixels off (values only).
    pub marker_outlier: f64,
    /// Markers covered for a while.
    pub hidden: Vec<HiddenMarker>,
    /// Ground features followed (values only).
    pub features: usize,
    /// Noise of a ground feature (values only), pixels one-sigma an axis.
    pub feature_noise_px: f64,
    /// Mean time until a ground feature is lost though still in view (values only), seconds.
    pub feature_life_s: f64,
}

/// A marker covered for a while.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct HiddenMarker {
    /// Which target.
    pub target: usize,
    /// Which of its markers.
    pub marker: usize,
    /// From, seconds.
    pub from_s: f64,
    /// To, seconds.
    pub to_s: f64,
    /// Share of it that is covered, from its right: 1 is all of it.
    pub share: f64,
}

impl Default for GpsSim {
    fn default() -> Self {
        Self {
            rate_hz: 5.0,
            bias_sigma_m: 1.5,
            bias_tau_s: 100.0,
            noise_m: 0.15,
            vertical_factor: 1.5,
            velocity_noise_mps: 0.05,
            latency_spread_ms: 25.0,
            latency_offset_ms: 0.0,
            latency_sigma_ms: 0.0,
            position_filter_s: 0.0,
            velocity_filter_s: 0.0,
            jitter_ms: 4.0,
            stamp_noise_ms: 1.0,
            dropout: 0.002,
            outages_s: Vec::new(),
            velocity_decimals: 2,
        }
    }
}

impl Default for CompassSim {
    fn default() -> Self {
        Self {
            rate_hz: 30.0,
            bias_sigma_deg: 1.0,
            bias_offset_deg: 0.0,
            heading_noise_deg: 0.5,
            tilt_noise_deg: 0.3,
            tilt_gain: 1.0,
            feels_force: false,
            tilt_lag_s: 0.0,
            slow_tilt_deg: 0.0,
            slow_tilt_tau_s: 30.0,
            iron_deg: 0.0,
            dip_deg: None,
            latency_spread_ms: 4.0,
            latency_offset_ms: 0.0,
            jitter_ms: 0.7,
            outages_s: Vec::new(),
            flagged: 0.0,
        }
    }
}

impl Default for CameraSim {
    fn default() -> Self {
        Self {
            period_jitter_ms: 0.5,
            stamp_noise_ms: 0.05,
            stamp_late_ms: 0.0,
            readout_ms: 0.0,
            vibration_deg: 0.0,
            transfer_ms: 45.0,
            transfer_jitter_ms: 3.0,
            dropped: 0.005,
            outages_s: Vec::new(),
            mount_error_deg: [0.0; 3],
            marker_noise_px: 0.5,
            marker_missed: 0.0,
            marker_outlier: 0.0,
            hidden: Vec::new(),
            features: 8,
            feature_noise_px: 0.5,
            feature_life_s: 10.0,
        }
    }
}
