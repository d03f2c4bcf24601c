//! The filter in a made-up scene: a helicopter that hangs over a parked car, a rover that turns on the spot and a
//! tag on the ground. What it does when its numbers go wrong, and when a vehicle is not where it was expected.

use nalgebra::{Matrix2, Vector3};

use super::aid::pixel::{target_point, view};
use super::blocks::{TARGET, own};
use super::models::Models;
use super::own::Own;
use super::state::State;
use super::*;
use windhover_base::geo::{Geodetic, Tilt};
use windhover_base::msg::{
    AttitudeSample, FixKind, FrameObservations, GnssEpoch, MarkerDetection, Stamped, TargetEstimate,
    TrackStatus,
};
use windhover_base::settings::{EstimatorConfig, Rig};
use windhover_base::time::{MonoTime, Span};

const RIG: &str = r#"
[gps]
device = "/dev/ttyS0"
baud = 38400
[compass]
device = "/dev/ttyS1"
baud = 38400
format = "tcm2"
angles = "euler321"
declination_deg = 0.0
[camera]
device = "/dev/video0"
width = 1280
height = 1024
fps = 15.0
[camera.intrinsics]
fx = 1020.0
fy = 1020.0
cx = 640.0
cy = 512.0
distortion = [0.0, 0.0, 0.0, 0.0, 0.0]
[camera.mount]
image_top = "forward"
[[target]]
name = "car"
model = "ackermann"
wheelbase_m = 1.2
[[target.marker]]
kind = "apriltag"
family = "36h11"
id = 0
size_m = 0.48
position_m = [0.0, 0.0, -0.5]
[[target.marker]]
kind = "apriltag"
family = "36h11"
id = 1
size_m = 0.48
position_m = [1.0, 0.0, -0.5]
[[target]]
name = "rover"
model = "unicycle"
[[target.marker]]
kind = "apriltag"
family = "36h11"
id = 2
size_m = 0.48
position_m = [0.0, 0.0, -0.3]
[[target]]
name = "point"
model = "static"
[[target.marker]]
kind = "apriltag"
family = "36h11"
id = 7
size_m = 0.48
position_m = [0.0, 0.0, 0.0]
"#;

const TURN_RADPS: f64 = 0.5;
const HEIGHT_M: f64 = 12.0;

struct Scene {
    filter: Estimator,
    models: Models,
    step: u32,
    /// Where the rover is: north, east; added to its heading.
    rover: [f64; 3],
    /// Stated accuracy of the receiver, position and velocity.
    stated: Option<(f64, f64)>,
}

impl Scene {
    fn new() -> Self {
        let rig: Rig = toml::from_str(RIG).expect("the rig is valid");
        let estimator = EstimatorConfig::default();
        let datum = Geodetic { lat_deg: 47.0, lon_deg: 8.0, height_m: 0.0 };
        let ground = Ground::Flat { down_m: 0.0 };
        let site = Site { frame: LocalFrame::new(datum), ground, declination_rad: 0.0 };
        let filter = Estimator::new(&rig, &estimator, &site);
        Self {
            filter,
            models: Models::new(&rig, &estimator, &site),
            step: 0,
            rover: [-2.0, -3.0, 0.0],
            stated: None,
        }
    }

    fn truth(&self, target: usize) -> [f64; TARGET] {
        let t_s = f64::from(self.step) / 15.0;
        let [north, east, turned] = self.rover;
        match target {
            0 => [2.0, 1.0, 0.5, 0.0, 0.0],
            1 => [north, east, TURN_RADPS * t_s + turned, 0.0, TURN_RADPS],
            _ => [1.0, -4.0, -1.0, 0.0, 0.0],
        }
    }

    fn markers(&self) -> Vec<MarkerDetection> {
        let own = Own { position: Vector3::new(0.0, 0.0, -HEIGHT_M), ..Own::default() };
        let targets = self.models.targets.iter().enumerate();
        let all = targets.flat_map(|(i, target)| target.markers.iter().map(move |marker| (i, marker)));
        let seen = all.map(|(i, marker)| {
            let px = |point: &Vector3<f64>| {
                let (world, _) = target_point(&self.truth(i), &self.models, point);
                view(&own, &self.models, &world).expect("it lies below").px
            };
            MarkerDetection {
                marker: marker.id,
                center_px: px(&marker.center),
                center_cov_px2: Matrix2::identity() * 0.01,
                corners_px: marker.corners.as_ref().map(|corners| corners.each_ref().map(px)),
                corner_cov_px2: [Matrix2::identity() * 0.04; 4],
                hamming: 0,
                margin: 100.0,
                size_px: 40.0,
            }
        });
        seen.collect()
    }

    /// All sensors deliver for `frames` frames.
    fn hear(&mut self, frames: u32) -> Vec<EstimatorOutput> {
        let mut out = Vec::new();
        for _ in 0..frames {
            let t = MonoTime::from_ns(1_000_000_000_000) + Span::from_s(f64::from(self.step) / 15.0);
            let seq = 3 * u64::from(self.step);
            let tilt = Some(Tilt { pitch: 0.0, roll: 0.0 });
            let compass = AttitudeSample { heading: Some(0.0), heading_is_true: true, tilt };
            self.filter.attitude(&Stamped { t_valid: t, t_recv: t, seq, value: compass }, &mut out);
            let value = FrameObservations { frame: self.step, markers: self.markers(), features: Vec::new() };
            self.filter.frame(&Stamped { t_valid: t, t_recv: t, seq: seq + 1, value }, &mut out);
            if self.step.is_multiple_of(3) {
                let value = GnssEpoch {
                    fix: FixKind::ThreeD,
                    lat_deg: Some(47.0),
                    lon_deg: Some(8.0),
                    alt_msl_m: Some(HEIGHT_M),
                    geoid_m: Some(0.0),
                    vel_ned_mps: Some(Vector3::zeros()),
                    vel_has_down: true,
                    position_sigma_m: self.stated.map(|(position_m, _)| Vector3::repeat(position_m)),
                    velocity_sigma_mps: self.stated.map(|(_, velocity_mps)| Vector3::repeat(velocity_mps)),
                    ..GnssEpoch::default()
                };
                self.filter.gnss(&Stamped { t_valid: t, t_recv: t, seq: seq + 2, value }, &mut out);
            }
            self.step += 1;
        }
        out
    }

    /// The estimates of a target.
    fn estimates(out: &[EstimatorOutput], target: usize) -> Vec<TargetEstimate> {
        let of = |o: &EstimatorOutput| match o {
            EstimatorOutput::Estimate(e) if e.target == target => Some(*e),
            _ => None,
        };
        out.iter().filter_map(of).collect()
    }

    /// Every target is tracked where it is and as it moves.
    fn assert_right(&self, out: &[EstimatorOutput], after: &str) {
        for target in 0..3 {
            let last = *Self::estimates(out, target).last().expect("frames were taken");
            assert_eq!(last.status, TrackStatus::Tracking, "{after}: {last:?}");
            let state = last.state.expect("it is tracked");
            // The last frame was one step ago.
            let [north, east, heading, speed, yaw_rate] = self.truth(target);
            assert!((state.north_m - north).hypot(state.east_m - east) < 0.1, "{after}: {state:?}");
            let ahead = yaw_rate / 15.0;
            assert!(wrap(state.heading_rad + ahead - heading).abs() < 0.03, "{after}: {state:?}");
            assert!((state.speed_mps - speed).abs() < 0.05, "{after}: {state:?}");
            assert!((state.yaw_rate_radps - yaw_rate).abs() < 0.05, "{after}: {state:?}");
        }
    }
}

fn wrap(angle: f64) -> f64 {
    windhover_base::geo::wrap_angle(angle)
}

fn resets(out: &[EstimatorOutput]) -> usize {
    out.iter().filter(|o| matches!(o, EstimatorOutput::Reset { .. })).count()
}

#[test]
fn three_kinds_of_targets_at_once() {
    let mut scene = Scene::new();
    let out = scene.hear(60);
    scene.assert_right(&out, "the start");
    let point = Scene::estimates(&out, 2).last().and_then(|e| e.state).expect("it is tracked");
    assert!(
        point.speed_mps == 0.0 && point.yaw_rate_radps == 0.0,
        "a static target has no motion: {point:?}"
    );
}

#[test]
fn numbers_gone_wrong_reset_the_filter_which_says_so_and_goes_on() {
    type Poison = fn(&mut State);
    let poisons: [(&str, Poison); 8] = [
        ("a velocity that is no number", |s| s.own.velocity.x = f64::NAN),
        ("an infinite bias", |s| s.own.gps_bias.y = f64::INFINITY),
        ("a position beyond reason", |s| s.own.position.x = 1e7),
        ("a variance below zero", |s| s.cov.set_diagonal(own::ATTITUDE, &[-1.0; 3])),
        ("a variance that is no number", |s| s.cov.set_diagonal(own::DRAG, &[f64::NAN])),
        ("the first target's heading", |s| s.targets[0].mean[2] = f64::NAN),
        ("the second target's speed", |s| s.targets[1].mean[3] = f64::NEG_INFINITY),
        ("the third target's variance", |s| {
            let place = s.layout().target(2).place();
            s.cov.set_diagonal(place, &[f64::NAN; 2]);
        }),
    ];
    let mut scene = Scene::new();
    scene.hear(60);
    for (what, poison) in poisons {
        poison(&mut scene.filter.core.state);
        let out = scene.hear(60);
        assert_eq!(resets(&out), 1, "{what}");
        for estimate in (0..3).flat_map(|target| Scene::estimates(&out, target)) {
            let finite = estimate.state.is_none_or(|s| {
                s.north_m.is_finite() && s.covariance.is_some_and(|p| p.iter().all(|x| x.is_finite()))
            });
            assert!(finite, "{what}: {estimate:?}");
        }
        scene.assert_right(&out, what);
    }
}

#[test]
fn a_vehicle_that_comes_back_elsewhere_is_placed_anew_and_never_lost() {
    let mut scene = Scene::new();
    scene.hear(60);
    // Carried a metre and turned while it was out of sight: no motion model explains it.
    scene.rover = [-1.2, -2.4, 1.0];
    let out = scene.hear(30);
    let statuses: Vec<_> = Scene::estimates(&out, 1).iter().map(|e| e.status).collect();
    // In the one frame it is read off anew in, nothing confirms it yet.
    let coasting = statuses.iter().filter(|s| **s == TrackStatus::Coasting).count();
    let tracking = statuses.iter().filter(|s| **s == TrackStatus::Tracking).count();
    assert!(coasting <= 1 && coasting + tracking == statuses.len(), "{statuses:?}");
    scene.assert_right(&out, "being carried");
    assert_eq!(resets(&out), 0);
}

#[test]
fn what_the_receiver_says_of_its_errors_is_believed() {
    // Position and velocity of the helicopter, one sigma, after eight seconds of such a receiver.
    let sigmas = |stated: Option<(f64, f64)>| {
        let mut scene = Scene::new();
        scene.stated = stated;
        let out = scene.hear(120);
        let last = out.iter().rev().find_map(|o| match o {
            EstimatorOutput::Ownship(ownship) => Some(*ownship),
            _ => None,
        });
        let last = last.expect("it is reported");
        (last.position_sigma_m(), last.velocity_sigma_mps().x)
    };
    let (usual, usual_velocity) = sigmas(None);
    let (poor, poor_velocity) = sigmas(Some((12.0, 1.0)));
    let (good, _) = sigmas(Some((0.7, 0.05)));
    let (boast, boast_velocity) = sigmas(Some((0.001, 0.001)));
    assert!((10.0..14.0).contains(&poor.x), "{poor}");
    assert!(good.x < 0.8 * usual.x && good.x > 0.6, "{good} {usual}");
    assert!(boast.x > 0.4, "a fix by codes is not as good as that: {boast}");
    assert!(poor_velocity > 1.5 * usual_velocity, "{poor_velocity} {usual_velocity}");
    assert!((boast_velocity / usual_velocity - 1.0).abs() < 0.2, "{boast_velocity} {usual_velocity}");
}
