//! The paper's estimator, its equations (20)–(34) corrected: each frame alone, no memory but the frame before. It is
//! kept to compare with.
//!
//! The paper, wherever it is cited here: "Unmanned Ground Vehicle State Estimation using an Unmanned Air Vehicle"
//! (Center for Intelligent Machines and Robotics, University of Florida).
//!
//! Helicopter: the latest fix carried on by its own velocity, the latest compass reading. The first two
//! markers of the configuration that are seen are put on the ground at their height; heading runs from
//! the rear one to the front one; velocity is the difference of their midpoint to the frame before;
//! `v = ẋ cos ψ + ẏ sin ψ`, `ω = (−ẋ sin ψ + ẏ cos ψ)/a` (34), with the midpoint a metres ahead of the
//! rear axle. As printed, (27) and (28) have the midpoint behind the axle, which turns the sign of ω.

use nalgebra::{Rotation3, Vector2, Vector3};

use windhover_base::geo::{Geodetic, Tilt, locate, wrap_angle};
use windhover_base::msg::{
    AttitudeSample, FrameObservations, GnssEpoch, Stamped, TargetEstimate, TargetState, TrackStatus,
};
use windhover_base::settings::{EstimatorConfig, Rig, TargetModel};
use windhover_base::time::MonoTime;

use super::Site;
use super::aid::compass::true_heading;
use super::models::Models;

/// Shortest lever with which (34) gives a yaw rate, m; below it the heading's difference does.
const SHORTEST_LEVER_M: f64 = 0.1;
/// Farthest that a ray is followed, m.
const FARTHEST_M: f64 = 1_000.0;

/// A fix: when, antenna position and velocity in NED.
#[derive(Clone, Copy, Debug)]
struct Fix {
    t: MonoTime,
    position: Vector3<f64>,
    velocity: Vector3<f64>,
}

/// What a frame gave of one target.
#[derive(Clone, Copy, Debug)]
struct Pair {
    t: MonoTime,
    frame: u32,
    markers: (usize, usize),
    midpoint: Vector2<f64>,
    heading: f64,
}

/// The paper's estimator.
#[derive(Clone, Debug)]
pub struct PaperEstimator {
    models: Models,
    fix: Option<Fix>,
    ned_from_body: Option<Rotation3<f64>>,
    before: Vec<Option<Pair>>,
}

impl PaperEstimator {
    /// An estimator that has seen nothing.
    pub fn new(rig: &Rig, estimator: &EstimatorConfig, site: &Site) -> Self {
        let models = Models::new(rig, estimator, site);
        Self { before: vec![None; models.targets.len()], models, fix: None, ned_from_body: None }
    }

    /// Takes a GPS epoch; the latest with a position counts.
    pub fn gnss(&mut self, epoch: &Stamped<GnssEpoch>, _out: &mut Vec<TargetEstimate>) {
        let value = &epoch.value;
        let (Some(lat_deg), Some(lon_deg), Some(alt)) = (value.lat_deg, value.lon_deg, value.alt_msl_m)
        else {
            return;
        };
        if !value.fix.has_position() || self.fix.is_some_and(|fix| fix.t > epoch.t_valid) {
            return;
        }
        let place = Geodetic { lat_deg, lon_deg, height_m: alt + value.geoid_m.unwrap_or(0.0) };
        let position = self.models.frame.ned(place);
        let velocity = value.vel_ned_mps.unwrap_or_default();
        if position.iter().chain(velocity.iter()).all(|x| x.is_finite()) {
            self.fix = Some(Fix { t: epoch.t_valid, position, velocity });
        }
    }

    /// Takes a compass reading; the latest counts.
    pub fn attitude(&mut self, sample: &Stamped<AttitudeSample>, _out: &mut Vec<TargetEstimate>) {
        let models = &self.models;
        let (Some(heading), Some(tilt)) = (sample.value.heading, sample.value.tilt) else { return };
        let heading = true_heading(heading, sample.value.heading_is_true, models);
        let level = Tilt { pitch: tilt.pitch - models.pitch_offset, roll: tilt.roll - models.roll_offset };
        if let Some(attitude) = models.convention.ned_from_body(heading, level) {
            self.ned_from_body = Some(attitude);
        }
    }

    /// Takes a frame; pushes one estimate a target that has values.
    pub fn frame(&mut self, frame: &Stamped<FrameObservations>, out: &mut Vec<TargetEstimate>) {
        for target in 0..self.models.targets.len() {
            let now = self.pair(target, frame);
            let before = std::mem::replace(&mut self.before[target], now);
            if let (Some(now), Some(before)) = (now, before)
                && now.frame == before.frame.wrapping_add(1)
                && now.markers == before.markers
                && now.t > before.t
            {
                let state = self.state(target, &before, &now);
                let status = TrackStatus::Tracking;
                out.push(TargetEstimate {
                    t_valid: now.t,
                    frame: now.frame,
                    target,
                    status,
                    state: Some(state),
                });
            }
        }
    }

    /// The first two markers of the target that are seen, on the ground.
    fn pair(&self, target: usize, frame: &Stamped<FrameObservations>) -> Option<Pair> {
        let model = &self.models.targets[target];
        if model.kind != TargetModel::Ackermann {
            return None;
        }
        let mut seen = model.markers.iter().enumerate().filter_map(|(index, marker)| {
            let found = frame.value.markers.iter().find(|d| d.marker == marker.id)?;
            Some((index, self.place(frame.t_valid, found.center_px, -marker.center.z)?))
        });
        let (first, second) = (seen.next()?, seen.next()?);
        let x = |index: usize| model.markers[index].center.x;
        let (rear, front) = if x(first.0) <= x(second.0) { (first, second) } else { (second, first) };
        let along = front.1 - rear.1;
        // The line between the markers as it lies in the vehicle: straight ahead for the paper's.
        let built = (model.markers[front.0].center - model.markers[rear.0].center).xy();
        Some(Pair {
            t: frame.t_valid,
            frame: frame.value.frame,
            markers: (rear.0, front.0),
            midpoint: (front.1 + rear.1) * 0.5,
            heading: wrap_angle(along.y.atan2(along.x) - built.y.atan2(built.x)),
        })
    }

    /// North and east of a pixel (paper eq. 11–23, corrected).
    fn place(&self, t: MonoTime, px: Vector2<f64>, above_m: f64) -> Option<Vector2<f64>> {
        let (models, fix, attitude) = (&self.models, self.fix?, self.ned_from_body?);
        let antenna = fix.position + fix.velocity * (t - fix.t).s();
        let camera = antenna + attitude * (models.camera_at - models.antenna_at);
        let ned_from_camera =
            attitude * Rotation3::from_matrix_unchecked(models.camera_from_body.transpose());
        locate(&models.camera, &camera, &ned_from_camera, px, &models.ground, above_m, FARTHEST_M)
            .ok()
            .map(|found| found.ned_m.xy())
    }

    fn state(&self, target: usize, before: &Pair, now: &Pair) -> TargetState {
        let model = &self.models.targets[target];
        let dt = (now.t - before.t).s();
        let rate = (now.midpoint - before.midpoint) / dt;
        let (s, c) = now.heading.sin_cos();
        let center = |index: usize| model.markers[index].center;
        let middle = (center(now.markers.0) + center(now.markers.1)) * 0.5;
        let sideways = -rate.x * s + rate.y * c;
        let turned = wrap_angle(now.heading - before.heading) / dt;
        let yaw_rate = if middle.x.abs() >= SHORTEST_LEVER_M { sideways / middle.x } else { turned };
        // From the midpoint to the reference point, both in the vehicle frame.
        let offset = Vector2::new(model.reference_m - middle.x, -middle.y);
        let north_m = now.midpoint.x + c * offset.x - s * offset.y;
        let east_m = now.midpoint.y + s * offset.x + c * offset.y;
        let down = self.models.ground.down_m(north_m, east_m);
        let place = self.models.frame.geodetic(&Vector3::new(north_m, east_m, down));
        TargetState {
            north_m,
            east_m,
            heading_rad: now.heading,
            speed_mps: rate.x * c + rate.y * s,
            yaw_rate_radps: yaw_rate,
            lat_deg: place.lat_deg,
            lon_deg: place.lon_deg,
            height_m: place.height_m,
            covariance: None,
            relative_sigma_m: None,
        }
    }
}
