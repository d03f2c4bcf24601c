//! The paper's Monte Carlo analysis of geo-positioning (its condition 35), with the closed form.
//!
//! Every sample draws an error for each source, runs the real [`locate`] on the
//! wrong pose, pixel and camera, and compares with the true ground point.

use nalgebra::{Matrix2, Matrix3, Rotation3, Vector2, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

pub use super::spread::{moments, radii};
use windhover_base::geo::{
    CameraModel, Ground, LocateError, PoseSigmas, body_from_camera, locate, locate_with_covariance,
    ned_from_body_321, rot_y, rot_z,
};
use windhover_base::settings::{CameraConfig, CameraMount, Distribution, MonteCarloConfig};

/// Sources of error, in the order of [`Setup::sigmas`].
pub const SOURCES: [&str; SOURCE_COUNT] = [
    "gps north",
    "gps east",
    "gps down",
    "heading",
    "pitch",
    "roll",
    "pixel u",
    "pixel v",
    "ground elevation",
    "mount yaw",
    "mount pitch",
    "mount roll",
    "focal length x",
    "focal length y",
    "principal point u",
    "principal point v",
];
const SOURCE_COUNT: usize = 16;
/// Largest accepted slant range; far beyond any camera that could see a vehicle.
const LIMIT_M: f64 = 1e5;

/// One value per source of [`SOURCES`]; metres, radians, pixels.
pub type PerSource = [f64; SOURCE_COUNT];

/// The setup of an analysis.
#[derive(Clone, PartialEq, Debug)]
pub struct Setup {
    /// The lens.
    pub camera: CameraModel,
    /// The camera's mounting.
    pub mount: CameraMount,
    /// Camera position, north-east-down, metres; ground at down = 0.
    pub position_ned_m: Vector3<f64>,
    /// Heading, pitch, roll of the aircraft (3-2-1), radians.
    pub attitude_rad: [f64; 3],
    /// The pixel.
    pub pixel: Vector2<f64>,
    /// Height of the point over the ground, metres.
    pub above_m: f64,
    /// One-sigma of each source.
    pub sigmas: PerSource,
    /// Shape of every source.
    pub distribution: Distribution,
}

/// The result. Errors are estimated minus true, metres.
#[derive(Clone, PartialEq, Debug)]
pub struct Analysis {
    /// (north, east) error of each sample that met the ground.
    pub errors_m: Vec<[f64; 2]>,
    /// Samples whose ray missed the ground.
    pub missed: usize,
    /// Mean error, north and east.
    pub mean_m: Vector2<f64>,
    /// Covariance of the samples about their mean, m².
    pub sample_m2: Matrix2<f64>,
    /// First-order covariance, m².
    pub closed_m2: Matrix2<f64>,
    /// Radii about the true point that contain 50 % and 95 % of the samples.
    pub r50_m: f64,
    /// 95 %.
    pub r95_m: f64,
    /// The largest error.
    pub max_m: f64,
    /// First-order effect of each source alone, largest first.
    pub budget: Vec<BudgetLine>,
}

/// One source's contribution to the error.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct BudgetLine {
    /// Its name.
    pub source: &'static str,
    /// Its one-sigma in its own unit: metres, radians or pixels.
    pub sigma: f64,
    /// Its effect on north, one-sigma, metres.
    pub north_m: f64,
    /// Its effect on east, one-sigma, metres.
    pub east_m: f64,
    /// Its share of the total variance, 0 to 1.
    pub share: f64,
}

impl Setup {
    /// A setup from `[montecarlo]`, and `[camera.intrinsics]` and `[camera.mount]` of a camera.
    pub fn new(mc: &MonteCarloConfig, camera: &CameraConfig) -> Self {
        let CameraConfig { intrinsics: camera, mount: camera_mount, .. } = *camera;
        let on_axis = Vector2::new(camera.cx, camera.cy);
        let (mount, pixel, focal, principal) =
            (mc.mount_sigma_deg.to_radians(), mc.pixel_sigma_px, mc.focal_sigma_px, mc.principal_sigma_px);
        Self {
            camera,
            mount: camera_mount,
            position_ned_m: Vector3::from(mc.position_ned_m),
            attitude_rad: [mc.heading_deg, mc.pitch_deg, mc.roll_deg].map(f64::to_radians),
            pixel: mc.pixel.map_or(on_axis, Vector2::from),
            above_m: mc.above_ground_m,
            sigmas: [
                mc.gps_horizontal_sigma_m,
                mc.gps_horizontal_sigma_m,
                mc.gps_vertical_sigma_m,
                mc.heading_sigma_deg.to_radians(),
                mc.pitch_sigma_deg.to_radians(),
                mc.roll_sigma_deg.to_radians(),
                pixel,
                pixel,
                mc.ground_sigma_m,
                mount,
                mount,
                mount,
                focal,
                focal,
                principal,
                principal,
            ],
            distribution: mc.distribution,
        }
    }

    fn ned_from_camera(&self, error: &PerSource) -> Rotation3<f64> {
        let [heading, pitch, roll] = self.attitude_rad;
        let mount = &self.mount;
        ned_from_body_321(heading + error[3], pitch + error[4], roll + error[5])
            * body_from_camera(
                mount.image_top,
                mount.yaw_deg.to_radians() + error[9],
                mount.pitch_deg.to_radians() + error[10],
                mount.roll_deg.to_radians() + error[11],
            )
    }

    /// The geo-positioned point with these errors in the inputs: (north, east).
    fn located(&self, error: &PerSource) -> Result<Vector2<f64>, LocateError> {
        let mut camera = self.camera;
        camera.fx += error[12];
        camera.fy += error[13];
        camera.cx += error[14];
        camera.cy += error[15];
        let at = locate(
            &camera,
            &(self.position_ned_m + Vector3::new(error[0], error[1], error[2])),
            &self.ned_from_camera(error),
            self.pixel + Vector2::new(error[6], error[7]),
            &Ground::Flat { down_m: -error[8] },
            self.above_m,
            LIMIT_M,
        )?;
        Ok(at.ned_m.xy())
    }

    /// First-order covariance of (north, east) from the given sigmas, m², by
    /// [`locate_with_covariance`].
    ///
    /// At (35): `σ_N² = σ_pN² + h² (σ_θ² + σ_u²)`, `σ_E² = σ_pE² + h² (σ_φ² + σ_v²)` with u and v
    /// along the body axes. An error of focal length or principal point acts as one of the pixel.
    ///
    /// ```
    /// use windhover_base::settings::MonteCarloConfig;
    /// use windhover_calibrate::montecarlo::Setup;
    /// use windhover_simulate::Scenario;
    ///
    /// let camera = Scenario::named("hover10").expect("a named scenario").rig.camera;
    /// let setup = Setup::new(&MonteCarloConfig::default(), &camera);
    /// let drawn = setup.run(20_000, 1).expect("it looks at the ground");
    /// let (north, east) = (drawn.closed_m2[(0, 0)].sqrt(), drawn.sample_m2[(0, 0)].sqrt());
    /// // Draws and closed form agree.
    /// assert!((north / east - 1.0).abs() < 0.05);
    /// ```
    ///
    /// # Errors
    /// Where the ray of the pixel does not meet the ground.
    pub fn closed_form(&self, sigmas: &PerSource) -> Result<Matrix2<f64>, LocateError> {
        let square = |k: usize| sigmas[k] * sigmas[k];
        let xd = {
            let yd = (self.pixel.y - self.camera.cy) / self.camera.fy;
            Vector2::new((self.pixel.x - self.camera.cx) / self.camera.fx - self.camera.skew * yd, yd)
        };
        let of_u = square(6) + square(14) + square(12) * (xd.x + self.camera.skew * xd.y).powi(2);
        let of_v = square(7) + square(15) + square(13) * xd.y * xd.y;
        let pose = PoseSigmas {
            position_m2: Matrix3::from_diagonal(&Vector3::new(square(0), square(1), square(2))),
            attitude_rad2: self.attitude_covariance(sigmas),
            pixel_px2: Matrix2::new(of_u, 0.0, 0.0, of_v),
            ground_m: sigmas[8],
        };
        let at = locate_with_covariance(
            &self.camera,
            &self.position_ned_m,
            &self.ned_from_camera(&[0.0; SOURCE_COUNT]),
            self.pixel,
            &Ground::Flat { down_m: 0.0 },
            self.above_m,
            LIMIT_M,
            &pose,
        )?;
        Ok(at.covariance_m2)
    }

    /// Covariance of the camera's attitude as small rotations about north, east and down, rad²: each Euler angle
    /// rotates about its own axis of the sequence.
    fn attitude_covariance(&self, sigmas: &PerSource) -> Matrix3<f64> {
        let turn_axes = |yaw: f64, pitch: f64| {
            [Vector3::z(), rot_z(yaw) * Vector3::y(), rot_z(yaw) * rot_y(pitch) * Vector3::x()]
        };
        let [heading, pitch, roll] = self.attitude_rad;
        let body = turn_axes(heading, pitch);
        let ned_from_body = ned_from_body_321(heading, pitch, roll);
        let mount = turn_axes(self.mount.yaw_deg.to_radians(), self.mount.pitch_deg.to_radians())
            .map(|axis| ned_from_body * axis);
        let sources = body.into_iter().zip(&sigmas[3..6]).chain(mount.into_iter().zip(&sigmas[9..12]));
        sources.map(|(axis, sigma)| axis * axis.transpose() * (sigma * sigma)).sum()
    }

    /// Runs the analysis over `samples` draws; the same seed gives the same results.
    ///
    /// # Errors
    /// Where the ray of the pixel, without any error, does not meet the ground.
    pub fn run(&self, samples: usize, seed: u64) -> Result<Analysis, LocateError> {
        let truth = self.located(&[0.0; SOURCE_COUNT])?;
        let closed_m2 = self.closed_form(&self.sigmas)?;
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut errors_m = Vec::with_capacity(samples);
        for _ in 0..samples {
            let error = self.sigmas.map(|sigma| sigma * draw(self.distribution, &mut rng));
            if let Ok(at) = self.located(&error) {
                errors_m.push([at.x - truth.x, at.y - truth.y]);
            }
        }
        let missed = samples - errors_m.len();
        let (mean_m, sample_m2) = moments(&errors_m);
        let (r50_m, r95_m, max_m) = radii(&errors_m);
        let budget = self.budget(&closed_m2)?;
        Ok(Analysis { errors_m, missed, mean_m, sample_m2, closed_m2, r50_m, r95_m, max_m, budget })
    }

    fn budget(&self, total: &Matrix2<f64>) -> Result<Vec<BudgetLine>, LocateError> {
        let mut lines = Vec::new();
        for (k, source) in SOURCES.into_iter().enumerate().filter(|(k, _)| self.sigmas[*k] > 0.0) {
            let mut alone = [0.0; SOURCE_COUNT];
            alone[k] = self.sigmas[k];
            let covariance = self.closed_form(&alone)?;
            lines.push(BudgetLine {
                source,
                sigma: self.sigmas[k],
                north_m: covariance[(0, 0)].sqrt(),
                east_m: covariance[(1, 1)].sqrt(),
                share: if total.trace() > 0.0 { covariance.trace() / total.trace() } else { 0.0 },
            });
        }
        lines.sort_by(|a, b| b.share.total_cmp(&a.share));
        Ok(lines)
    }
}

/// A draw of zero mean and unit sigma.
fn draw(distribution: Distribution, rng: &mut ChaCha8Rng) -> f64 {
    match distribution {
        Distribution::Normal => rng.sample(StandardNormal),
        // Uniform over ±√3 has unit variance.
        Distribution::Uniform => (2.0 * rng.random::<f64>() - 1.0) * 3f64.sqrt(),
    }
}

#[cfg(test)]
mod tests {
    use windhover_base::geo::LensModel;
    use windhover_base::settings::PixelFormat;

    use super::*;

    const SAMPLES: usize = 40_000;

    fn paper_setup() -> Setup {
        let intrinsics = CameraModel {
            fx: 1019.52796,
            fy: 1022.1229,
            cx: 645.66333,
            cy: 527.72943,
            model: LensModel::Brown,
            distortion: [-0.17892, 0.13875, -0.00128, 0.0056, 0.0],
            skew: 0.0,
        };
        let camera = CameraConfig {
            device: String::new(),
            width: 1280,
            height: 1024,
            fps: 15.0,
            pixel_format: PixelFormat::Grey,
            exposure_offset_ms: 0.0,
            readout_ms: 0.0,
            exposure_us: None,
            auto_max_us: None,
            gain: None,
            trigger_line: None,
            intrinsics,
            mount: CameraMount::default(),
        };
        Setup::new(&MonteCarloConfig::default(), &camera)
    }

    fn row(gps_m: f64, tilt_deg: f64, distribution: Distribution) -> Setup {
        let mut setup = paper_setup();
        setup.sigmas[..2].fill(gps_m);
        // Receivers have about 1.6 times larger errors in height.
        setup.sigmas[2] = 1.6 * gps_m;
        setup.sigmas[4..6].fill(tilt_deg.to_radians());
        setup.distribution = distribution;
        setup
    }

    #[test]
    fn agrees_with_the_reference_table() {
        // GPS sigma, tilt sigma, closed form, normal R50 and R95, uniform R95 and maximum.
        let table = [
            (3.0 / 2.4477, 0.2, 1.2261, 1.441, 2.997, 2.542, 3.06),
            (3.0 / 1.96, 0.4, 1.5322, 1.801, 3.747, 3.179, 3.88),
            (0.6 / 2.4477, 0.2, 0.2476, 0.291, 0.606, 0.517, 0.67),
            (0.02, 0.3, 0.0563, 0.066, 0.138, 0.123, 0.18),
        ];
        for (gps, tilt, closed, r50, r95, uniform_r95, uniform_max) in table {
            let normal = row(gps, tilt, Distribution::Normal).run(SAMPLES, 7).expect("below");
            for axis in 0..2 {
                assert!((normal.closed_m2[(axis, axis)].sqrt() - closed).abs() < 1e-4, "{closed}");
                // The deviation of a standard deviation is 1/√(2N): 0.35 %; the tolerance is four of them.
                assert!((normal.sample_m2[(axis, axis)].sqrt() / closed - 1.0).abs() < 0.015);
            }
            // Quantiles: 0.7 % deviation each here and in the table, which has three figures.
            assert!((normal.r50_m / r50 - 1.0).abs() < 0.02, "{} {r50}", normal.r50_m);
            assert!((normal.r95_m / r95 - 1.0).abs() < 0.02, "{} {r95}", normal.r95_m);
            let uniform = row(gps, tilt, Distribution::Uniform).run(SAMPLES, 7).expect("below");
            assert!((uniform.r95_m / uniform_r95 - 1.0).abs() < 0.02, "{} {uniform_r95}", uniform.r95_m);
            // A maximum grows with the number of draws, to at most 4 % above; two decimals are given.
            let beyond = (uniform.max_m - uniform_max).abs();
            assert!(beyond < 0.04 * uniform_max + 0.005, "{} {uniform_max}", uniform.max_m);
        }
    }

    #[test]
    fn the_default_is_the_first_row() {
        let setup = paper_setup();
        let sigma = setup.closed_form(&setup.sigmas).expect("below")[(0, 0)].sqrt();
        assert!((sigma - 1.2261).abs() < 1e-4, "{sigma}");
    }

    #[test]
    fn corner_of_the_image_feels_altitude_and_heading() {
        // At normalised (0.5, 0.4): 1 m of altitude 0.64 m, 1° of heading 0.11 m (of 10 m height).
        let mut setup = paper_setup();
        setup.camera.distortion = [0.0; 5];
        setup.pixel = setup.camera.pixel_of(Vector2::new(0.5, 0.4)).0;
        let alone = |k: usize, sigma: f64| {
            let mut sigmas = [0.0; SOURCE_COUNT];
            sigmas[k] = sigma;
            setup.closed_form(&sigmas).expect("below").trace().sqrt()
        };
        assert!((alone(2, 1.0) - 0.64).abs() < 0.005);
        assert!((alone(3, 1f64.to_radians()) - 0.11).abs() < 0.005);
    }

    #[test]
    fn closed_form_matches_samples_of_every_source() {
        // A tilted pose and mount; each source alone, small enough to be linear.
        let mut setup = paper_setup();
        setup.attitude_rad = [0.7, 0.12, -0.2];
        (setup.mount.yaw_deg, setup.mount.pitch_deg, setup.mount.roll_deg) = (4.0, -3.0, 5.0);
        setup.pixel = Vector2::new(980.0, 310.0);
        for (k, source) in SOURCES.into_iter().enumerate() {
            setup.sigmas = [0.0; SOURCE_COUNT];
            setup.sigmas[k] = if (3..6).contains(&k) || (9..12).contains(&k) { 2e-3 } else { 0.1 };
            let analysis = setup.run(4_000, 11).expect("below");
            let difference = (analysis.sample_m2 - analysis.closed_m2).norm();
            assert!(difference < 0.1 * analysis.closed_m2.norm(), "{source}");
            assert_eq!(analysis.budget.len(), 1);
            assert!((analysis.budget[0].share - 1.0).abs() < 1e-9);
        }
    }

    #[test]
    fn the_same_seed_gives_the_same_figures() {
        let setup = paper_setup();
        assert_eq!(setup.run(500, 3), setup.run(500, 3));
        assert_ne!(setup.run(500, 3), setup.run(500, 4));
    }

    #[test]
    fn looking_at_the_sky_is_an_error() {
        let mut setup = paper_setup();
        setup.attitude_rad[1] = 2.0;
        assert_eq!(setup.run(10, 1), Err(LocateError::AboveHorizon));
    }
}
