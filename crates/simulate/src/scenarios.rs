//! The named scenarios.

use super::misfit::Misfit;
use super::scenario::{
    Clock, Helicopter, HelicopterPath, Route, Scenario, Scene, SpeedPlan, VehiclePlan, Wind,
};
use super::sensor_errors::{CameraSim, CompassSim, GpsSim, HiddenMarker};
use windhover_base::geo::{Geodetic, ImageTop, TiltConvention};
use windhover_base::settings::{CompassFormat, Rig, TargetConfig, TargetModel};
use windhover_base::time::MonoTime;

/// What every scenario flies with unless it says otherwise.
const RIG: &str = r#"
[gps]
device = "/dev/ttyS0"
baud = 38400
antenna_position_m = [-0.35, 0.0, -0.25]

[compass]
device = "/dev/ttyS1"
baud = 38400
format = "tcm2"
angles = "euler321"
declination_deg = -3.4

[camera]
device = "/dev/video0"
width = 1280
height = 1024
fps = 15.0

[camera.intrinsics]
fx = 1019.52796
fy = 1022.12290
cx = 645.66333
cy = 527.72943
distortion = [-0.17892, 0.13875, -0.00128, 0.00560, 0.0]

[camera.mount]
image_top = "forward"
position_m = [0.15, 0.0, 0.12]

[[target]]
name = "ugv"
model = "ackermann"
wheelbase_m = 1.2

[[target.marker]]
kind = "apriltag"
family = "36h11"
id = 0
size_m = 0.48
position_m = [0.0, 0.0, -0.55]

[[target.marker]]
kind = "apriltag"
family = "36h11"
id = 1
size_m = 0.48
position_m = [1.0, 0.0, -0.55]
"#;

/// Two discs instead of the tags.
const DISCS: &str = r##"
name = "ugv"
model = "ackermann"
wheelbase_m = 1.2

[[marker]]
kind = "disc"
diameter_m = 0.42
brightness = "light"
position_m = [0.0, 0.0, -0.55]

[[marker]]
kind = "disc"
diameter_m = 0.60
brightness = "light"
position_m = [1.0, 0.0, -0.55]
"##;

/// A tag on the ground.
const SURVEY_POINT: &str = r#"
name = "point"
model = "static"

[[marker]]
kind = "apriltag"
family = "36h11"
id = 7
size_m = 0.6
position_m = [0.0, 0.0, 0.0]
"#;

/// A second vehicle, which turns on the spot and carries one tag.
const ROVER: &str = r#"
name = "rover"
model = "unicycle"

[[marker]]
kind = "apriltag"
family = "36h11"
id = 2
size_m = 0.48
position_m = [0.0, 0.0, -0.4]
"#;

/// Every named scenario: name, what it is for.
const NAMES: [(&str, &str); 29] = [
    ("hover10", "hover 10 m over a parked vehicle, the condition of the paper's error analysis"),
    ("follow", "follow a driving vehicle at 15 m"),
    ("hover20", "hover at 20 m over a vehicle driving figures of eight"),
    ("circle20", "circle at 20 m over a circling vehicle"),
    ("stop-and-go", "follow at 12 m a vehicle that stops and starts"),
    ("reversing", "follow at 12 m a vehicle that also reverses"),
    ("figure-eight", "hover at 15 m over tight figures of eight"),
    ("fast-turns", "follow at 12 m a fast vehicle that turns hard"),
    ("leave-and-return", "hover at 15 m; the vehicle leaves the view and comes back"),
    ("gps-outage", "follow; no GPS fix from 20 s to 25 s"),
    ("compass-outage", "follow; the compass is silent from 20 s to 25 s"),
    ("blackout", "follow; no frames from 20 s to 30 s"),
    ("noisy", "follow with doubled sensor noise, wrong and missed markers, lost frames"),
    ("compass-bias", "follow with a compass 6 degrees off"),
    ("tilt15", "follow with a compass that reads 15 % of the tilt"),
    ("late-gps", "follow with GPS 100 ms later than configured"),
    ("crooked-mount", "follow with a turned and tilted camera and long lever arms"),
    ("elevation-compass", "follow in strong wind: large tilts, read as axis elevations"),
    ("hidden-marker", "follow; one of the two tags is covered from 15 s to 30 s"),
    ("discs", "follow at 10 m a vehicle with two discs instead of tags"),
    ("static-survey", "hover at 12 m over a tag on the ground to be surveyed"),
    (
        "half-hidden",
        "follow; one of the two tags is half covered from 12 s to 30 s, the other wholly from 35 s to 40 s",
    ),
    ("half-hidden-discs", "the same with two discs instead of tags, at 10 m"),
    ("motion-blur", "follow a fast vehicle restlessly with exposures of 15 ms"),
    ("low", "follow at 5 m"),
    ("high", "follow at 25 m"),
    ("outliers", "follow; 3 of 100 markers are tens of pixels off"),
    ("wrong-latencies", "follow; GPS and compass 20 ms later than configured"),
    ("two-vehicles", "hover at 20 m over a car and a rover"),
];

impl Scenario {
    /// Name and purpose of every scenario that its configuration fits but for what the filter's own states take up.
    pub fn names() -> &'static [(&'static str, &'static str)] {
        &NAMES
    }

    /// The scenario of this name: one of [`Scenario::names`], of [`Scenario::composed`], or a
    /// [`Deviation`](super::Deviation) by its name, at its usual figure.
    pub fn named(name: &str) -> Option<Self> {
        let Some((name, about)) = NAMES.iter().find(|(known, _)| *known == name) else {
            return Self::deviating(name);
        };
        let mut scenario = Self::base(name, about);
        scenario.set_motion(name);
        scenario.set_sensors(name);
        Some(scenario)
    }

    /// Following a driving vehicle at 15 m with every figure at its default.
    fn base(name: &str, about: &str) -> Self {
        let rig: Rig = toml::from_str(RIG).expect("the built-in rig is valid");
        Self {
            name: name.to_owned(),
            about: about.to_owned(),
            duration_s: 60.0,
            declination_deg: rig.compass.declination_deg.unwrap_or(0.0),
            rig,
            origin: Geodetic { lat_deg: 30.0696, lon_deg: -85.5754, height_m: 6.0 },
            geoid_m: -27.0,
            start: MonoTime::from_ns(1_795_014_245_000_000_000),
            clock: Clock::default(),
            helicopter: Helicopter { path: HelicopterPath::Follow { target: 0 }, ..Helicopter::default() },
            wind: Wind::default(),
            vehicles: vec![VehiclePlan {
                start: (0.0, 0.0, None),
                speed: SpeedPlan::Cruise { mean_mps: 2.0, wander_mps: 0.5 },
                route: Route::Free { curvature_per_m: 0.09 },
            }],
            gps: GpsSim::default(),
            compass: CompassSim::default(),
            camera: CameraSim::default(),
            scene: Scene::default(),
            misfit: Misfit::default(),
        }
    }

    fn set_motion(&mut self, name: &str) {
        let hover = HelicopterPath::Hover { north_m: 0.0, east_m: 0.0 };
        let vehicle = &mut self.vehicles[0];
        let cruise = |mean_mps| SpeedPlan::Cruise { mean_mps, wander_mps: 0.2 * mean_mps };
        let stop_and_go =
            |reverse_mps| SpeedPlan::StopAndGo { speed_mps: 2.0, go_s: 6.0, stop_s: 3.0, reverse_mps };
        let (path, height_m) = match name {
            "hover10" | "static-survey" => {
                vehicle.speed = SpeedPlan::Parked;
                (hover, if name == "hover10" { 10.0 } else { 12.0 })
            }
            "hover20" => {
                (vehicle.speed, vehicle.route) = (cruise(1.8), Route::Eight { a_m: 6.0, b_m: 3.5 });
                (hover, 20.0)
            }
            "circle20" => {
                (vehicle.speed, vehicle.route) =
                    (cruise(1.5), Route::Circle { north_m: 0.0, east_m: 0.0, radius_m: 3.5 });
                (HelicopterPath::Circle { radius_m: 3.0, speed_mps: 1.5 }, 20.0)
            }
            "figure-eight" => {
                (vehicle.speed, vehicle.route) = (cruise(1.8), Route::Eight { a_m: 4.0, b_m: 2.5 });
                (hover, 15.0)
            }
            "leave-and-return" => {
                (vehicle.speed, vehicle.route) =
                    (cruise(2.0), Route::Circle { north_m: 5.0, east_m: 0.0, radius_m: 7.0 });
                (hover, 15.0)
            }
            "two-vehicles" => {
                (vehicle.speed, vehicle.route) = (cruise(1.8), Route::Eight { a_m: 6.0, b_m: 3.5 });
                self.vehicles.push(VehiclePlan {
                    start: (0.0, 0.0, None),
                    speed: SpeedPlan::Cruise { mean_mps: 0.8, wander_mps: 0.15 },
                    route: Route::Circle { north_m: -1.0, east_m: 4.0, radius_m: -2.0 },
                });
                (hover, 20.0)
            }
            "stop-and-go" => {
                vehicle.speed = stop_and_go(0.0);
                (self.helicopter.path, 12.0)
            }
            "reversing" => {
                vehicle.speed = stop_and_go(1.2);
                (self.helicopter.path, 12.0)
            }
            "fast-turns" => {
                vehicle.speed = SpeedPlan::Cruise { mean_mps: 2.8, wander_mps: 0.6 };
                vehicle.route = Route::Free { curvature_per_m: 0.15 };
                (self.helicopter.position_gain, self.helicopter.velocity_gain) = (1.0, 1.7);
                (self.helicopter.path, 12.0)
            }
            "motion-blur" => {
                vehicle.speed = SpeedPlan::Cruise { mean_mps: 3.0, wander_mps: 0.6 };
                self.helicopter.agitation_mps2 = 0.8;
                (self.helicopter.path, 12.0)
            }
            "low" => (self.helicopter.path, 5.0),
            "high" => (self.helicopter.path, 25.0),
            "discs" | "half-hidden-discs" => (self.helicopter.path, 10.0),
            _ => (self.helicopter.path, 15.0),
        };
        (self.helicopter.path, self.helicopter.height_m) = (path, height_m);
    }

    fn set_sensors(&mut self, name: &str) {
        match name {
            "gps-outage" => self.gps.outages_s = vec![(20.0, 25.0)],
            "compass-outage" => self.compass.outages_s = vec![(20.0, 25.0)],
            "blackout" => self.camera.outages_s = vec![(20.0, 30.0)],
            "compass-bias" => (self.compass.bias_sigma_deg, self.compass.bias_offset_deg) = (0.0, 6.0),
            "tilt15" => self.compass.tilt_gain = 0.15,
            "late-gps" => {
                (self.gps.latency_offset_ms, self.gps.latency_spread_ms) = (100.0, 0.0);
                self.vehicles[0].route = Route::Free { curvature_per_m: 0.15 };
                self.helicopter.agitation_mps2 = 0.8;
            }
            "hidden-marker" => {
                self.camera.hidden = vec![covered(1, 15.0, 30.0, 1.0)];
            }
            "half-hidden" | "half-hidden-discs" => {
                self.camera.hidden = vec![covered(1, 12.0, 30.0, 0.5), covered(0, 35.0, 40.0, 1.0)];
                if name == "half-hidden-discs" {
                    self.rig.target = vec![target(DISCS)];
                }
            }
            "motion-blur" => self.scene.exposure_ms = 15.0,
            "outliers" => self.camera.marker_outlier = 0.03,
            "wrong-latencies" => {
                (self.gps.latency_offset_ms, self.gps.latency_spread_ms) = (20.0, 0.0);
                (self.compass.latency_offset_ms, self.compass.latency_spread_ms) = (20.0, 0.0);
            }
            "discs" => self.rig.target = vec![target(DISCS)],
            "static-survey" => self.rig.target = vec![target(SURVEY_POINT)],
            "two-vehicles" => self.rig.target.push(target(ROVER)),
            "noisy" => self.set_noisy(),
            "crooked-mount" => self.set_crooked(),
            "elevation-compass" => self.set_large_tilts(),
            _ => {}
        }
        debug_assert_eq!(self.rig.target.len(), self.vehicles.len());
    }

    fn set_noisy(&mut self) {
        let gps = &mut self.gps;
        (gps.bias_sigma_m, gps.noise_m, gps.velocity_noise_mps) = (3.0, 0.3, 0.1);
        (gps.jitter_ms, gps.dropout) = (10.0, 0.05);
        let compass = &mut self.compass;
        (compass.bias_sigma_deg, compass.heading_noise_deg, compass.tilt_noise_deg) = (2.0, 1.0, 0.6);
        compass.flagged = 0.02;
        let camera = &mut self.camera;
        (camera.marker_noise_px, camera.feature_noise_px) = (1.0, 1.0);
        (camera.marker_outlier, camera.marker_missed, camera.dropped) = (0.03, 0.1, 0.05);
        self.wind.gust_mps = 1.6;
    }

    fn set_crooked(&mut self) {
        let mount = &mut self.rig.camera.mount;
        mount.image_top = ImageTop::Right;
        (mount.yaw_deg, mount.pitch_deg, mount.roll_deg) = (7.0, -5.0, 4.0);
        mount.position_m = [0.6, -0.2, 0.3];
        self.rig.gps.antenna_position_m = [-0.9, 0.1, -0.4];
        self.rig.compass.yaw_offset_deg = 3.0;
        (self.rig.compass.pitch_offset_deg, self.rig.compass.roll_offset_deg) = (1.5, -2.0);
    }

    fn set_large_tilts(&mut self) {
        self.rig.compass.format = CompassFormat::Hmr3000;
        self.rig.compass.angles = TiltConvention::Elevation;
        self.compass.rate_hz = 20.0;
        (self.wind.mean_mps, self.wind.gust_mps) = (9.0, 2.0);
        (self.helicopter.agitation_mps2, self.helicopter.limit_mps2) = (1.2, 6.0);
    }

    /// The same flight with a camera of `factor` times the resolution, for quick tests.
    #[must_use]
    pub fn with_resolution(mut self, factor: f64) -> Self {
        let camera = &mut self.rig.camera;
        let scaled = |pixels: u32| ((f64::from(pixels) * factor).round() as u32).max(16);
        (camera.width, camera.height) = (scaled(camera.width), scaled(camera.height));
        let lens = &mut camera.intrinsics;
        (lens.fx, lens.fy) = (lens.fx * factor, lens.fy * factor);
        // Pixel centres are at whole numbers, so the frame's corner lies at −0.5.
        (lens.cx, lens.cy) = ((lens.cx + 0.5) * factor - 0.5, (lens.cy + 0.5) * factor - 0.5);
        self
    }

    /// Whether vehicle `target` can move at all.
    pub fn moves(&self, target: usize) -> bool {
        self.rig.target.get(target).is_some_and(|t| t.model != TargetModel::Static)
            && self.vehicles.get(target).is_some_and(|v| v.speed != SpeedPlan::Parked)
    }
}

fn covered(marker: usize, from_s: f64, to_s: f64, share: f64) -> HiddenMarker {
    HiddenMarker { target: 0, marker, from_s, to_s, share }
}

fn target(text: &str) -> TargetConfig {
    toml::from_str(text).expect("the built-in target is valid")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_name_gives_a_valid_scenario() {
        for (name, _) in Scenario::names() {
            let scenario = Scenario::named(name).expect("it is listed");
            assert_eq!(scenario.rig.target.len(), scenario.vehicles.len(), "{name}");
        }
        assert!(Scenario::named("no such").is_none());
    }
}
