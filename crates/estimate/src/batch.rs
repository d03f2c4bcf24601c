//! The filter's models for who estimates a whole flight at once: measurements and forces linearised at a state that is put
//! there. There is one copy of each model; the filter and the batch both use it.

use std::ops::Range;

use nalgebra::{Matrix3, Rotation3, SMatrix, Vector2, Vector3};

use windhover_base::geo::CameraModel;
use windhover_base::msg::{
    AttitudeSample, FeltTilt, FixKind, GnssEpoch, MarkerDetection, MarkerId, TargetState,
};
use windhover_base::settings::{EstimatorConfig, Rig};

use super::Site;
use super::aid::disc::Disc;
use super::aid::feature::FeaturePixel;
use super::aid::heading::Heading;
use super::aid::tag::{Tag, TagCorner};
use super::aid::tilt::TiltReading;
use super::aid::{compass, gnss};
use super::blocks::{SHAKE_NODES as NODES, TARGET, own};
use super::core::Core;
use super::force::{D_WIND, Force};
use super::kind::Felt;
use super::measurement::Measurement;
use super::output::target_state;
use super::own::{COMPASS, Own};
use super::shake::Shake;
use super::sway::Sway;

/// Columns of the filter's error state, by name.
pub mod columns {
    use super::{Range, own};

    /// Position of the body frame's origin, NED, m.
    pub const POSITION: Range<usize> = own::POSITION.range();
    /// Velocity, NED, m/s.
    pub const VELOCITY: Range<usize> = own::VELOCITY.range();
    /// Attitude error: small rotation about the NED axes, `R = exp(δ) R̂`, rad.
    pub const ATTITUDE: Range<usize> = own::ATTITUDE.range();
    /// Angular rate, body axes, rad/s.
    pub const RATE: Range<usize> = own::RATE.range();
    /// Force of gusts over mass, north and east, m/s².
    pub const GUST: Range<usize> = own::GUST.range();
    /// Thrust beyond the weight, m/s².
    pub const THRUST: Range<usize> = own::THRUST.range();
    /// Slow error of the tilt reading, rad.
    pub const TILT_ERROR: Range<usize> = own::TILT_ERROR.range();
    /// Slow force of the wind over mass, north and east, m/s².
    pub const WIND: Range<usize> = own::WIND.range();
    /// Trim of the thrust's direction in the body.
    pub const TRIM: Range<usize> = own::TRIM.range();
    /// Bias of the receiver's position, NED, m.
    pub const GPS_BIAS: Range<usize> = own::GPS_BIAS.range();
    /// Bias of the compass's heading, rad.
    pub const HEADING_BIAS: Range<usize> = own::HEADING_BIAS.range();
    /// Share of what it feels that the tilt sensor reads.
    pub const TILT_GAIN: Range<usize> = own::TILT_GAIN.range();
    /// Bias of the tilt reading, rad.
    pub const TILT_BIAS: Range<usize> = own::TILT_BIAS.range();
    /// How much older the receiver's fixes are than configured, s.
    pub const GPS_DELAY: Range<usize> = own::GPS_DELAY.range();
    /// Time constant of the low-pass that the receiver applies to velocity, s.
    pub const VELOCITY_DELAY: Range<usize> = own::VELOCITY_DELAY.range();
    /// Drag, 1/s.
    pub const DRAG: Range<usize> = own::DRAG.range();
    /// Errors of the lens's first four distortion terms.
    pub const LENS: Range<usize> = own::LENS.range();
}

/// Length of a target's part of the error state: north, east, heading, speed, yaw rate.
pub const TARGET_COLUMNS: usize = TARGET;
/// What a tag may be beside its configuration: ln of its size, place forward and right (m), turn (rad).
pub const TAG_COLUMNS: usize = super::blocks::TAG_FIT;
/// How a vehicle sways on its springs: roll and pitch of its body, rad, and how much lower it is, m.
pub const SWAY_COLUMNS: usize = super::blocks::SWAY;
/// Displacement of a frame whose camera shakes: along x and y at so many nodes each, and its roll.
pub const SHAKE_COLUMNS: usize = super::blocks::SHAKE;
/// Nodes of an axis.
pub const SHAKE_NODES: usize = super::blocks::SHAKE_NODES;
/// Correlation time of sway, s.
pub const SWAY_TAU_S: f64 = super::sway::CORRELATION_S;

/// A measurement linearised: `z − h(x)`, its noise, and `∂h/∂x` in the columns that it touches.
#[derive(Clone, Copy, Debug)]
pub struct Linear<'a>(&'a Measurement);

impl Linear<'_> {
    /// Number of components.
    pub fn len(&self) -> usize {
        self.0.m
    }

    /// Whether it has no component.
    pub fn is_empty(&self) -> bool {
        self.0.m == 0
    }

    /// Measured minus predicted, in the measurement's unit.
    pub fn residual(&self, component: usize) -> f64 {
        self.0.residual[component]
    }

    /// Covariance of the noise between two components.
    pub fn noise(&self, a: usize, b: usize) -> f64 {
        self.0.noise[a][b]
    }

    /// The columns that it touches.
    pub fn columns(&self) -> &[usize] {
        self.0.columns()
    }

    /// A component's derivatives by these columns.
    pub fn row(&self, component: usize) -> &[f64] {
        self.0.row(component)
    }

    /// Whether every figure is a number.
    pub fn is_finite(&self) -> bool {
        self.0.is_finite()
    }
}

/// What of the camera and the antenna may be beside its configuration.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct RigOffsets {
    /// Small rotation of the camera on the body, body axes, rad: `body_from_camera = exp(ε) configured`.
    pub mount: Vector3<f64>,
    /// Of the camera's place in the body, m.
    pub camera_at: Vector3<f64>,
    /// Of the antenna's place in the body, m.
    pub antenna_at: Vector3<f64>,
    /// Logarithm of the focal length over that configured.
    pub ln_focal: f64,
    /// Of the time from the first row's exposure to the last one's, s.
    pub readout_s: f64,
}

/// The models at a state.
#[derive(Clone, Debug)]
pub struct Predictor {
    core: Core,
    configured: RigAsConfigured,
}

#[derive(Clone, Debug)]
struct RigAsConfigured {
    camera: CameraModel,
    camera_from_body: Matrix3<f64>,
    camera_at: Vector3<f64>,
    antenna_at: Vector3<f64>,
    readout_s: f64,
}

impl Predictor {
    /// The models of a rig, at no state yet.
    pub fn new(rig: &Rig, estimator: &EstimatorConfig, site: &Site) -> Self {
        // The factor on the pixels of features covers what a filter gains by linearising once; a batch does not.
        let estimator =
            EstimatorConfig { features: 1, feature_sigma_factor: 1.0, learn: false, ..estimator.clone() };
        let core = Core::new(rig, &estimator, site);
        let m = &core.models;
        let configured = RigAsConfigured {
            camera: m.camera,
            camera_from_body: m.camera_from_body,
            camera_at: m.camera_at,
            antenna_at: m.antenna_at,
            readout_s: m.readout_s,
        };
        Self { core, configured }
    }

    /// Length of the error state.
    pub fn len(&self) -> usize {
        self.core.state.layout().len()
    }

    /// Whether the error state has no columns; it always has.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Columns of a target.
    pub fn target_columns(&self, target: usize) -> Range<usize> {
        self.core.state.layout().target(target).all().range()
    }

    /// Columns of the ground feature that [`Self::feature`] predicts.
    pub fn feature_columns(&self) -> Range<usize> {
        self.core.state.layout().feature(0).range()
    }

    /// Columns of what a tag is beside its configuration.
    pub fn tag_columns(&self, tag: usize) -> Range<usize> {
        self.core.state.layout().tag(tag).all().range()
    }

    /// Columns of a target's sway; of a target that does not sway they have no effect.
    pub fn sway_columns(&self, target: usize) -> Range<usize> {
        self.core.state.layout().sway(target).range()
    }

    /// Sets whether a target sways on its springs.
    pub fn set_sways(&mut self, target: usize, sways: bool) {
        self.core.state.targets[target].sway = if sways { Sway::presumed() } else { Sway::default() };
    }

    /// Height of a target's markers over the ground, m.
    pub fn markers_height_m(&self, target: usize) -> f64 {
        self.core.models.targets[target].markers_height_m
    }

    /// Tags whose size, place and turn are columns: target and marker of each.
    pub fn tags(&self) -> Vec<(usize, usize)> {
        let mut tags = vec![(0, 0); self.core.models.fitted_tags()];
        for (t, target) in self.core.models.targets.iter().enumerate() {
            for (m, marker) in target.markers.iter().enumerate() {
                if let Some(slot) = marker.fit {
                    tags[slot] = (t, m);
                }
            }
        }
        tags
    }

    /// Which marker of which target a detection is of.
    pub fn find(&self, id: MarkerId) -> Option<(usize, usize)> {
        self.core.models.find(id)
    }

    /// Puts the state: the attitude, and every other mean in its column (those of the attitude must be zero).
    pub fn put(&mut self, ned_from_body: &Rotation3<f64>, means: &[f64]) {
        let layout = self.core.state.layout();
        let own = &mut self.core.state.own;
        *own = Own { ned_from_body: *ned_from_body, tilt_gain: 0.0, ..Own::default() };
        own.second.tilt_gain = 0.0;
        own.inject(means, layout);
        for (i, target) in self.core.state.targets.iter_mut().enumerate() {
            target.mean.copy_from_slice(&means[layout.target(i).all().range()]);
            target.sway.mean.copy_from_slice(&means[layout.sway(i).range()]);
        }
        if self.core.state.shake.is_open() {
            self.core.state.shake.mean.copy_from_slice(&means[layout.shake().range()]);
        }
        self.core.state.features[0].mean.copy_from_slice(&means[layout.feature(0).range()]);
        for (i, tag) in self.core.state.tags.iter_mut().enumerate() {
            tag.mean.copy_from_slice(&means[layout.tag(i).all().range()]);
        }
    }

    /// Sets whether the camera shakes, with the time from the first row to the last by which displacement lasts from row to row, s:
    /// each frame is displaced at its rows then.
    pub fn set_shakes(&mut self, readout_s: Option<f64>) {
        let models = &self.core.models;
        self.core.state.shake =
            readout_s.map_or_else(Shake::default, |readout_s| Shake::of_batch(readout_s, models));
    }

    /// Columns of a frame's displacement: along x and along y at its nodes, in normalised coordinates, and its roll, rad.
    pub fn shake_columns(&self) -> Range<usize> {
        self.core.state.layout().shake().range()
    }

    /// Covariance between the nodes of one axis over the variance.
    pub fn shake_kernel(&self) -> SMatrix<f64, NODES, NODES> {
        self.core.state.shake.kernel()
    }

    /// Puts camera and antenna beside their configuration. All rows are exposed at once: the caller puts each point's state at
    /// the time of its row.
    pub fn put_rig(&mut self, by: &RigOffsets) {
        let (m, c) = (&mut self.core.models, &self.configured);
        m.camera_from_body = c.camera_from_body * Rotation3::new(by.mount).matrix().transpose();
        m.camera_at = c.camera_at + by.camera_at;
        m.antenna_at = c.antenna_at + by.antenna_at;
        m.readout_s = 0.0;
        let factor = by.ln_focal.exp();
        (m.camera.fx, m.camera.fy) = (c.camera.fx * factor, c.camera.fy * factor);
    }

    /// What the compass's tilt sensor is taken to feel; as attitude where it is not known.
    pub fn set_felt(&mut self, felt: Option<FeltTilt>) {
        let watch = &mut self.core.state.tilt[COMPASS];
        (watch.felt, watch.share) = match felt {
            None | Some(FeltTilt::Attitude) => (Felt::Attitude, 1.0),
            Some(FeltTilt::Force) => (Felt::Force, 1.0),
            Some(FeltTilt::Share(share)) => (Felt::Share, share),
        };
    }

    /// Variance (rad²) and correlation time (s) of the slow error of the tilt reading.
    pub fn tilt_error(&self) -> (f64, f64) {
        self.core.state.tilt[COMPASS].reading_error()
    }

    /// Variances of the receiver's position bias, NED, m², at this kind of fix, and its correlation time, s.
    pub fn gps_bias(&mut self, fix: FixKind) -> ([f64; 3], f64) {
        self.core.state.senses.of_fix(fix, None, 1.0, &self.core.models);
        (self.core.state.senses.gps_bias_var, self.core.models.tau.gps_bias_s)
    }

    /// Variance of the compass's heading bias, rad².
    pub fn heading_bias_var(&self) -> f64 {
        self.core.models.heading_bias_var[COMPASS]
    }

    /// Intensity of the vehicles' side slip, m²/s.
    pub fn slip_q(&self) -> f64 {
        self.core.models.slip_q
    }

    /// Acceleration of the helicopter, NED, m/s², with its derivatives by the columns that it depends on.
    pub fn acceleration(&self) -> (Vector3<f64>, [(usize, Vector3<f64>); 14]) {
        let own = &self.core.state.own;
        let force = Force::of(own);
        let drag = |i: usize| Vector3::ith(i, -own.drag_per_s);
        let across = |i: usize| D_WIND.column(i).into_owned();
        let by = [
            (own::ATTITUDE.column(0), force.d_attitude.column(0).into_owned()),
            (own::ATTITUDE.column(1), force.d_attitude.column(1).into_owned()),
            (own::ATTITUDE.column(2), force.d_attitude.column(2).into_owned()),
            (own::VELOCITY.column(0), drag(0)),
            (own::VELOCITY.column(1), drag(1)),
            (own::VELOCITY.column(2), drag(2)),
            (own::GUST.column(0), across(0)),
            (own::GUST.column(1), across(1)),
            (own::THRUST.column(0), force.d_thrust),
            (own::WIND.column(0), across(0)),
            (own::WIND.column(1), across(1)),
            (own::TRIM.column(0), force.d_trim.column(0).into_owned()),
            (own::TRIM.column(1), force.d_trim.column(1).into_owned()),
            (own::DRAG.column(0), force.d_drag),
        ];
        (force.acceleration(), by)
    }

    /// Position of an epoch; `None` where it has none that can be meant.
    pub fn gps_position(&mut self, epoch: &GnssEpoch) -> Option<Linear<'_>> {
        let position = gnss::position(epoch, &self.core.models).filter(|position| position.is_credible())?;
        self.core.state.senses.of_fix(epoch.fix, epoch.position_sigma_m, 1.0, &self.core.models);
        self.core.linearise(&position).ok()?;
        Some(Linear(&self.core.z))
    }

    /// Velocity of an epoch; `None` likewise.
    pub fn gps_velocity(&mut self, epoch: &GnssEpoch) -> Option<Linear<'_>> {
        let velocity = gnss::velocity(epoch).filter(|velocity| velocity.is_credible())?;
        self.core.linearise(&velocity).ok()?;
        Some(Linear(&self.core.z))
    }

    /// Heading of a compass reading; `None` where it has none.
    pub fn heading(&mut self, sample: &AttitudeSample) -> Option<Linear<'_>> {
        let heading = compass::true_heading(sample.heading?, sample.heading_is_true, &self.core.models);
        self.core.linearise(&Heading::<COMPASS>(heading)).ok()?;
        Some(Linear(&self.core.z))
    }

    /// Tilt of a compass reading; `None` where it has none that an attitude can have.
    pub fn tilt(&mut self, sample: &AttitudeSample) -> Option<Linear<'_>> {
        let down = compass::down_in_body(sample.tilt?, &self.core.models)?;
        self.core.linearise(&TiltReading::<COMPASS> { down }).ok()?;
        Some(Linear(&self.core.z))
    }

    /// Pixels of a marker: a tag's corners, else a centre; empty where it is none of ours.
    pub fn marker_px<'a>(&self, seen: &'a MarkerDetection) -> &'a [Vector2<f64>] {
        let Some((target, marker)) = self.core.models.find(seen.marker) else { return &[] };
        let corners = self.core.models.targets[target].markers[marker].corners.is_some();
        match &seen.corners_px {
            Some(corners_px) if corners => corners_px,
            _ => std::slice::from_ref(&seen.center_px),
        }
    }

    /// The `i`-th of these pixels. `None` where it cannot be in view.
    pub fn marker_point(&mut self, seen: &MarkerDetection, i: usize) -> Option<Linear<'_>> {
        let (target, marker) = self.core.models.find(seen.marker)?;
        let marker = self.core.models.targets[target].markers[marker].clone();
        let corners = marker.corners.as_ref().zip(seen.corners_px.as_ref());
        let linearised = match corners {
            Some((points, corners_px)) => {
                let (center, fit, cov_px2) = (&marker.center, marker.fit, &seen.corner_cov_px2);
                let tag = Tag { target, center, points, fit, corners_px, cov_px2 };
                self.core.linearise(&TagCorner(tag, i))
            }
            None => self.core.linearise(&Disc {
                target,
                point: &marker.center,
                center_px: &seen.center_px,
                cov_px2: &seen.center_cov_px2,
            }),
        };
        linearised.ok()?;
        Some(Linear(&self.core.z))
    }

    /// A ground feature seen at a pixel, at the place that stands in [`Self::feature_columns`].
    pub fn feature(&mut self, px: &Vector2<f64>, sigma_px: f64) -> Option<Linear<'_>> {
        self.core.linearise(&FeaturePixel { slot: 0, px: *px, sigma_px, slack_m: 0.0 }).ok()?;
        Some(Linear(&self.core.z))
    }

    /// The principal point, px: where a pixel does not move with the focal length.
    pub fn principal_point(&self) -> Vector2<f64> {
        Vector2::new(self.core.models.camera.cx, self.core.models.camera.cy)
    }

    /// Height of a frame, px.
    pub fn image_height_px(&self) -> f64 {
        self.core.models.image_px.1
    }

    /// Configured time from the first row's exposure to the last one's, s.
    pub fn readout_s(&self) -> f64 {
        self.configured.readout_s
    }

    /// Focal length, px.
    pub fn focal_px(&self) -> f64 {
        self.configured.camera.fx
    }

    /// A target's state at its reference point.
    pub fn target_state(&self, target: usize, mean: &[f64], covariance: &SMatrix<f64, 5, 5>) -> TargetState {
        target_state(&self.core.models, target, mean, covariance)
    }

    /// How far ahead of the rear axle a target's reference point lies, m.
    pub fn reference_m(&self, target: usize) -> f64 {
        self.core.models.targets[target].reference_m
    }

    /// Whether a target's model lets it move.
    pub fn moves(&self, target: usize) -> bool {
        self.core.models.targets[target].moves()
    }
}
