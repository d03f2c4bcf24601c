//! Where the derivatives are taken: random states of a filter whose targets and features all lie in view.

use std::sync::Arc;

use nalgebra::{Vector2, Vector3, Vector4};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use windhover_base::geo::{Geodetic, Ground, LocalFrame, Terrain, Tile, ned_from_body_321};
use windhover_base::settings::{AttitudeConfig, EstimatorConfig, ImuConfig, Rig};
use windhover_base::time::MonoTime;

use crate::Site;
use crate::blocks::{Block, SHAKE, own};
use crate::core::Core;
use crate::own::GRAVITY;
use crate::shake::Shake;
use crate::state::State;
use crate::sway::Sway;
use crate::track::{Evidence, Life};

/// A car with a tag and a disc, a rover, a tag on the ground; lever arms, lens and mount as crooked as a real one's.
const RIG: &str = r#"
[gps]
device = "/dev/ttyS0"
baud = 38400
antenna_position_m = [0.4, -0.3, -0.6]
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
fy = 1000.0
cx = 640.0
cy = 512.0
distortion = [-0.2, 0.1, 0.001, -0.002, 0.0]
[camera.mount]
image_top = "forward"
position_m = [0.2, 0.1, 0.3]
roll_deg = 2.0
pitch_deg = -3.0
yaw_deg = 4.0
[[target]]
name = "car"
model = "ackermann"
wheelbase_m = 1.2
[[target.marker]]
kind = "apriltag"
family = "36h11"
id = 0
size_m = 0.48
yaw_deg = 20.0
position_m = [0.8, -0.2, -0.5]
[[target.marker]]
kind = "disc"
brightness = "dark"
diameter_m = 0.2
position_m = [-0.3, 0.2, -0.4]
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

/// Most of what is drawn here: the bounds of [`Omitted`] are made of these.
pub(crate) mod most {
    pub(crate) const SPEED: f64 = 8.0;
    pub(crate) const RATE: f64 = 1.0;
    /// Thrust over mass, by its derivative toward tilt.
    pub(crate) const FORCE: f64 = 1.3 * (super::GRAVITY + 1.5);
    pub(crate) const DELAY_S: f64 = 0.15;
    pub(crate) const COMPASS_DELAY_S: f64 = 0.05;
    pub(crate) const DRAG: f64 = 0.4;
    pub(crate) const ARM: f64 = 0.8;
    /// Longest step of the prediction, s.
    pub(crate) const DT: f64 = 0.05;
}

fn site(ground: Ground) -> Site {
    Site { frame: frame(), ground, declination_rad: 0.0 }
}

fn frame() -> LocalFrame {
    LocalFrame::new(Geodetic { lat_deg: 47.0, lon_deg: 8.0, height_m: 0.0 })
}

/// A slope that falls by some 8 % to the north and rises by 5 % to the east.
pub(crate) fn slope() -> Ground {
    let (step_deg, frame) = (0.01, frame());
    let height = |row: usize, column: usize| {
        let place = Geodetic {
            lat_deg: 47.01 - step_deg * row as f64,
            lon_deg: 7.99 + step_deg * column as f64,
            height_m: 0.0,
        };
        let ned = frame.ned(place);
        (-0.08 * ned.x + 0.05 * ned.y) as f32
    };
    let heights = (0..9).map(|i| height(i / 3, i % 3)).collect();
    let tile = Tile::new((47.01, 7.99), [step_deg; 2], (3, 3), heights).expect("a whole tile");
    Ground::Terrain(Arc::new(Terrain::new(Arc::new(tile), &frame, 0.0)))
}

/// A filter in a random state over its targets, which all lie in view; without covariance, so that fusing moves nothing.
pub(crate) fn random_core(seed: u64, ground: Ground) -> Core {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let rig: Rig = toml::from_str(RIG).expect("the rig is valid");
    let mut core = Core::new(&rig, &EstimatorConfig::default(), &site(ground));
    let mut within = |most: f64| rng.random_range(-most..most);
    let mut vector = |most: f64| Vector3::new(within(most), within(most), within(most));
    let state = &mut core.state;
    state.alive = true;
    state.t = MonoTime::from_ns(1_000_000_000_000);
    let own = &mut state.own;
    own.position = vector(20.0);
    own.velocity = vector(most::SPEED / 3f64.sqrt());
    own.rate = vector(most::RATE / 3f64.sqrt());
    (own.gust, own.wind) = (vector(1.0).xy(), vector(1.5).xy());
    (own.trim, own.tilt_error) = (vector(0.1).xy(), vector(0.05).xy());
    own.thrust = vector(1.5).x;
    own.gps_bias = vector(2.0);
    own.heading_bias = within(0.1);
    own.tilt_gain = 0.6 + within(0.5);
    own.tilt_bias = Vector2::new(within(0.02), within(0.02));
    own.gps_delay_s = within(most::DELAY_S);
    own.velocity_delay_s = within(most::DELAY_S);
    own.drag_per_s = 0.2 + within(0.2);
    own.compass_delay_s = within(most::COMPASS_DELAY_S);
    own.lens = Vector4::new(within(0.1), within(0.1), within(0.005), within(0.005));
    own.arm = Vector2::new(within(0.3), within(0.3));
    own.ned_from_body = ned_from_body_321(within(3.1), within(0.2), within(0.2));
    own.position.z = core.models.ground.down_m(own.position.x, own.position.y) - 12.0 + within(4.0);
    let below = own.position;
    for target in &mut state.targets {
        target.life = Life::Tracking(Evidence::default());
        target.last_seen = state.t;
        target.mean = [below.x + within(2.0), below.y + within(2.0), within(3.1), within(8.0), within(1.5)];
    }
    for (id, feature) in state.features.iter_mut().enumerate() {
        feature.id = Some(id as u64);
        feature.mean = [below.x + within(2.0), below.y + within(2.0)];
    }
    for tag in &mut state.tags {
        tag.mean = [within(0.05), within(0.05), within(0.05), within(0.1)];
    }
    for target in &mut state.targets {
        target.sway = Sway::presumed();
        target.sway.mean = [within(0.05), within(0.05), within(0.05)];
    }
    state.shake = Shake::presumed(&core.models);
    state.begin_shake(0.02, &core.models);
    state.renew(state.layout().shake(), &[0.0; SHAKE]);
    state.shake.mean = std::array::from_fn(|_| within(0.003));
    core
}

/// The same filter with gyros, accelerometers and a second source of attitude besides.
pub(crate) fn with_every_sensor(core: Core) -> Core {
    let mut rig: Rig = toml::from_str(RIG).expect("the rig is valid");
    (rig.imu, rig.attitude) = (Some(ImuConfig::default()), Some(AttitudeConfig::default()));
    let mut other = Core::new(&rig, &EstimatorConfig::default(), &site(Ground::Flat { down_m: 0.0 }));
    other.state.own = core.state.own;
    other.state.own.rate_bias = Vector3::new(0.01, -0.02, 0.03);
    other.state.own.force_bias = Vector3::new(0.1, -0.2, 0.3);
    other.state.own.second.heading_bias = 0.05;
    other.state.own.second.tilt_bias = Vector2::new(0.01, -0.02);
    (other.state.alive, other.state.t) = (true, core.state.t);
    other
}

/// The state moved by a step along one column.
pub(crate) fn moved(core: &Core, column: usize, by: f64) -> Core {
    let mut core = core.clone();
    let mut dx = vec![0.0; core.state.layout().len()];
    dx[column] = by;
    core.state.inject(&dx);
    core
}

/// The error state that leads from `from` to `to`: what `inject` would have to be given.
pub(crate) fn difference(to: &State, from: &State) -> Vec<f64> {
    let layout = to.layout();
    let mut dx = vec![0.0; layout.len()];
    let mut put = |columns: std::ops::Range<usize>, value: &[f64]| dx[columns].copy_from_slice(value);
    let (a, b) = (&to.own, &from.own);
    let turn = (a.ned_from_body * b.ned_from_body.inverse()).scaled_axis();
    let vectors: [(Block<3>, Vector3<f64>); 4] = [
        (own::POSITION, a.position - b.position),
        (own::VELOCITY, a.velocity - b.velocity),
        (own::ATTITUDE, turn),
        (own::RATE, a.rate - b.rate),
    ];
    vectors.iter().for_each(|(block, vector)| put(block.range(), vector.as_slice()));
    let less = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a - b).collect::<Vec<_>>();
    put(layout.slow(), &less(&a.slow(), &b.slow())[..layout.slow().len()]);
    for i in 0..layout.targets {
        put(layout.target(i).all().range(), &less(&to.targets[i].mean, &from.targets[i].mean));
    }
    for i in 0..layout.features {
        put(layout.feature(i).range(), &less(&to.features[i].mean, &from.features[i].mean));
    }
    for i in 0..layout.tags {
        put(layout.tag(i).all().range(), &less(&to.tags[i].mean, &from.tags[i].mean));
    }
    for i in 0..layout.targets {
        put(layout.sway(i).range(), &less(&to.targets[i].sway.mean, &from.targets[i].sway.mean));
    }
    put(layout.shake().range(), &less(&to.shake.mean, &from.shake.mean));
    dx
}
