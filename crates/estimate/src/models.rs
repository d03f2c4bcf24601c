//! The configuration and site in the form the filter computes with: radians, metres, matrices.

use nalgebra::{Matrix3, Rotation3, Vector3};

use windhover_base::geo::{CameraModel, Ground, LocalFrame, TiltConvention, rot_z};
use windhover_base::msg::MarkerId;
use windhover_base::settings::{EstimatorConfig, MarkerConfig, MarkerKind, Rig, TargetConfig, TargetModel};

use super::Site;
use super::matrix::chi_square_quantile;
use super::motion::Motion;

/// Correlation times.
#[derive(Clone, Debug)]
pub(crate) struct Taus {
    pub(crate) rate_s: f64,
    pub(crate) gust_s: f64,
    pub(crate) thrust_s: f64,
    pub(crate) gps_bias_s: f64,
}

/// A marker in its vehicle's frame.
#[derive(Clone, Debug)]
pub(crate) struct Marker {
    pub(crate) id: MarkerId,
    /// Centre, forward-right-down, m.
    pub(crate) center: Vector3<f64>,
    /// A tag's corners in the order of [`windhover_base::msg::MarkerDetection::corners_px`].
    pub(crate) corners: Option<[Vector3<f64>; 4]>,
    /// Edge or diameter, m.
    pub(crate) size_m: f64,
    /// Where a tag's top points in the vehicle frame, rad.
    pub(crate) yaw: f64,
    /// Which of the fitted tags it is (`tag_fit.rs`).
    pub(crate) fit: Option<usize>,
}

/// A target as configured.
#[derive(Clone, Debug)]
pub(crate) struct TargetModels {
    /// As configured: the paper's estimator takes one kind only.
    pub(crate) kind: TargetModel,
    pub(crate) motion: Motion,
    pub(crate) reference_m: f64,
    pub(crate) markers: Vec<Marker>,
    /// Around the middle of its markers, what the vehicle may cover, m.
    pub(crate) radius_m: f64,
    /// Mean height of its markers over the ground, m.
    pub(crate) markers_height_m: f64,
}

impl TargetModels {
    /// Whether it moves at all.
    pub(crate) fn moves(&self) -> bool {
        self.motion.model().moves()
    }
}

/// Everything the filter computes with.
#[derive(Clone, Debug)]
pub(crate) struct Models {
    pub(crate) frame: LocalFrame,
    pub(crate) ground: Ground,
    pub(crate) camera: CameraModel,
    pub(crate) image_px: (f64, f64),
    /// From the first row's exposure to the last one's, s.
    pub(crate) readout_s: f64,
    pub(crate) camera_from_body: Matrix3<f64>,
    pub(crate) camera_at: Vector3<f64>,
    pub(crate) antenna_at: Vector3<f64>,
    pub(crate) convention: TiltConvention,
    pub(crate) declination: f64,
    pub(crate) yaw_offset: f64,
    pub(crate) pitch_offset: f64,
    pub(crate) roll_offset: f64,
    pub(crate) gps_bias_var: Vector3<f64>,
    pub(crate) gps_noise_var: f64,
    pub(crate) gps_velocity_var: f64,
    pub(crate) gps_delay_var: f64,
    /// Of the compass and of the second source of attitude.
    pub(crate) heading_bias_var: [f64; 2],
    /// Of gyros and accelerometers, their axes, the variances of noise and of constant error.
    pub(crate) body_from_imu: Rotation3<f64>,
    pub(crate) rate_var: f64,
    pub(crate) force_var: f64,
    pub(crate) rate_bias_var: f64,
    pub(crate) force_bias_var: f64,
    /// What the second source of attitude means by pitch and roll.
    pub(crate) second_convention: TiltConvention,
    pub(crate) tau: Taus,
    /// Intensity of a side slip, m²/s.
    pub(crate) slip_q: f64,
    /// Intensities of a target's speed and yaw rate walks as configured.
    pub(crate) target_walks: [f64; 2],
    pub(crate) targets: Vec<TargetModels>,
    pub(crate) marker_var_px2: f64,
    pub(crate) feature_factor2: f64,
    /// Chi-square gate by number of components.
    pub(crate) gates: [f64; 9],
}

/// Tags of a target whose size, place and turn are states; those beyond are taken as configured.
const MOST_FITTED: usize = 4;

/// GPS height errs about twice as much as position: satellites are only above.
const GPS_DOWN_FACTOR: f64 = 2.0;

impl Models {
    pub(crate) fn new(rig: &Rig, estimator: &EstimatorConfig, site: &Site) -> Self {
        let Rig { gps, compass, camera, target, .. } = rig;
        let (imu, second) = (rig.imu.unwrap_or_default(), rig.attitude.unwrap_or_default());
        let mount = &camera.mount;
        let across = gps.bias_sigma_m.powi(2);
        let mut gates = [f64::INFINITY; 9];
        for (m, gate) in gates.iter_mut().enumerate().skip(1) {
            *gate = chi_square_quantile(estimator.gate_probability, m);
        }
        let mut targets: Vec<TargetModels> =
            target.iter().enumerate().map(|(i, t)| target_models(i, t)).collect();
        let tags = targets
            .iter_mut()
            .flat_map(|t| t.markers.iter_mut().filter(|m| m.corners.is_some()).take(MOST_FITTED));
        tags.enumerate().for_each(|(slot, tag)| tag.fit = Some(slot));
        Self {
            frame: site.frame,
            ground: site.ground.clone(),
            camera: camera.intrinsics,
            image_px: (f64::from(camera.width), f64::from(camera.height)),
            readout_s: camera.readout_ms * 1e-3,
            camera_from_body: mount.body_from_camera().matrix().transpose(),
            camera_at: mount.position(),
            antenna_at: Vector3::from(gps.antenna_position_m),
            convention: compass.angles,
            declination: site.declination_rad,
            yaw_offset: compass.yaw_offset_deg.to_radians(),
            pitch_offset: compass.pitch_offset_deg.to_radians(),
            roll_offset: compass.roll_offset_deg.to_radians(),
            gps_bias_var: Vector3::new(across, across, across * GPS_DOWN_FACTOR.powi(2)),
            gps_noise_var: gps.noise_m.powi(2),
            gps_velocity_var: gps.velocity_noise_mps.powi(2),
            gps_delay_var: (gps.latency_sigma_ms * 1e-3).powi(2),
            heading_bias_var: [compass.heading_bias_sigma_deg, second.heading_bias_sigma_deg]
                .map(|deg| deg.to_radians().powi(2)),
            body_from_imu: imu.body_from_imu(),
            rate_var: imu.rate_noise_dps.to_radians().powi(2),
            force_var: imu.force_noise_mps2.powi(2),
            rate_bias_var: imu.rate_bias_dps.to_radians().powi(2),
            force_bias_var: imu.force_bias_mps2.powi(2),
            second_convention: second.angles,
            tau: Taus {
                rate_s: RATE_TAU_S,
                gust_s: estimator.force_tau_s,
                thrust_s: THRUST_TAU_S,
                gps_bias_s: gps.bias_tau_s,
            },
            slip_q: estimator.target_slip_walk.powi(2),
            target_walks: [estimator.target_speed_walk.powi(2), estimator.target_yaw_rate_walk.powi(2)],
            targets,
            marker_var_px2: estimator.marker_noise_px.powi(2),
            feature_factor2: estimator.feature_sigma_factor.powi(2),
            gates,
        }
    }

    /// How many tags are fitted.
    pub(crate) fn fitted_tags(&self) -> usize {
        self.targets.iter().flat_map(|t| &t.markers).filter(|m| m.fit.is_some()).count()
    }

    /// Which marker of which target a detection is of.
    pub(crate) fn find(&self, id: MarkerId) -> Option<(usize, usize)> {
        self.targets
            .iter()
            .enumerate()
            .find_map(|(t, target)| target.markers.iter().position(|marker| marker.id == id).map(|m| (t, m)))
    }
}

/// Correlation time of the helicopter's angular rate, s: a rotor's body answers within a second.
const RATE_TAU_S: f64 = 1.0;
/// Correlation time of the thrust beyond the weight, s: a climb begins or ends within seconds.
const THRUST_TAU_S: f64 = 2.0;

/// Markers are taken to be no lower than this where their height divides, m.
const LOWEST_M: f64 = 0.1;

fn target_models(index: usize, config: &TargetConfig) -> TargetModels {
    let markers: Vec<Marker> =
        config.marker.iter().enumerate().map(|(m, marker)| marker_model(index, m, marker)).collect();
    let wheelbase = config.wheelbase_m.unwrap_or(0.0);
    let reach = markers.iter().map(|m| m.center.xy().norm() + m.size_m).fold(wheelbase, f64::max);
    let height: f64 = markers.iter().map(|m| -m.center.z).sum();
    TargetModels {
        kind: config.model,
        motion: Motion::new(config),
        reference_m: config.reference_m,
        radius_m: reach + 0.5,
        markers_height_m: (height / markers.len().max(1) as f64).max(LOWEST_M),
        markers,
    }
}

fn marker_model(target: usize, marker: usize, config: &MarkerConfig) -> Marker {
    let center = Vector3::from(config.position_m);
    let yaw = config.yaw_deg.to_radians();
    let tag = (config.kind == MarkerKind::Apriltag).then_some(()).and(config.family.zip(config.id));
    let Some((family, id)) = tag else {
        let size_m = config.diameter_m.unwrap_or(0.0);
        return Marker {
            id: MarkerId::Disc { target, marker },
            center,
            corners: None,
            size_m,
            yaw,
            fit: None,
        };
    };
    let size_m = config.size_m.unwrap_or(0.0);
    let half = 0.5 * size_m;
    // Seen from above with its top toward `yaw`: up in the print is forward, right is right.
    let corner = |up: f64, right: f64| center + rot_z(yaw) * Vector3::new(up * half, right * half, 0.0);
    let corners = [corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0), corner(-1.0, -1.0)];
    Marker { id: MarkerId::Tag { family, id }, center, corners: Some(corners), size_m, yaw, fit: None }
}
