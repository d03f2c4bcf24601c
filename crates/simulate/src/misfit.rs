//! How a flight differs from its configuration, as numbers. With all of them at their defaults it does not.

use super::scenario::Scenario;
use windhover_base::geo::ImageTop;
use windhover_base::settings::{GroundConfig, GroundSource, MarkerConfig, Rig, TargetModel};

/// Differences between `Scenario::rig`, which the pipeline gets, and the simulated truth.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Misfit {
    /// The markers of the first target.
    pub markers: MarkerMisfit,
    /// The antenna is this far ahead of, right of and below where the configuration has it, metres.
    pub antenna_m: [f64; 3],
    /// The focal length is this share longer.
    pub focal: f64,
    /// The lens has this distortion instead.
    pub distortion: Option<[f64; 5]>,
    /// The camera is mounted this many quarter turns further (forward, right, aft, left).
    pub image_top_turns: usize,
    /// How the vehicles drive.
    pub driving: Driving,
    /// The ground height that the pipeline gets.
    pub ground: GroundMisfit,
    /// Other moving things in view.
    pub company: Company,
}

/// Errors of markers: all of them, or one, the last of the target.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct MarkerMisfit {
    /// All are this share larger.
    pub size: f64,
    /// All are turned clockwise by this, degrees.
    pub turn_deg: f64,
    /// All are this much higher, metres.
    pub higher_m: f64,
    /// One is this share larger.
    pub one_size: f64,
    /// One is turned clockwise by this, degrees.
    pub one_turn_deg: f64,
    /// One is this far ahead and to the right, metres.
    pub one_offset_m: [f64; 2],
}

/// How vehicles drive otherwise than a bicycle on level ground with a gentle driver.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct Driving {
    /// They pitch and roll by this, degrees: what a sine of the same rms reaches.
    pub sway_deg: f64,
    /// They bounce by this, metres: likewise.
    pub bounce_m: f64,
    /// They slide sideways: angle between course and heading, degrees rms.
    pub slip_deg: f64,
    /// They stop every ten seconds and turn on the spot at this rate, rad/s.
    pub spin_radps: f64,
    /// Natural frequency with which speed follows its command, rad/s, where not the drive's own.
    pub drive_rate: Option<f64>,
}

/// The ground height that the pipeline gets.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum GroundMisfit {
    /// Its height plus this, metres: the ground is lower than configured.
    Lower(f64),
    /// The height of the first fixes, although the helicopter is in the air.
    Takeoff,
}

/// Things in view that are not targets.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct Company {
    /// People who walk near the first vehicle.
    pub people: usize,
    /// Vehicles without markers that drive along with it.
    pub convoy: usize,
    /// Vehicles that drive along and carry the same markers.
    pub doubles: usize,
}

impl Default for GroundMisfit {
    fn default() -> Self {
        Self::Lower(0.0)
    }
}

impl Misfit {
    /// The true instruments and targets, where the pipeline gets these.
    pub fn flown(&self, configured: &Rig) -> Rig {
        let mut rig = configured.clone();
        let lens = &mut rig.camera.intrinsics;
        (lens.fx, lens.fy) = (lens.fx * (1.0 + self.focal), lens.fy * (1.0 + self.focal));
        lens.distortion = self.distortion.unwrap_or(lens.distortion);
        rig.camera.mount.image_top = turned(rig.camera.mount.image_top, self.image_top_turns);
        for (arm, off) in rig.gps.antenna_position_m.iter_mut().zip(self.antenna_m) {
            *arm += off;
        }
        for target in &mut rig.target {
            if self.driving.spin_radps != 0.0 && target.model == TargetModel::Ackermann {
                target.model = TargetModel::Unicycle;
            }
        }
        if let Some(first) = rig.target.first_mut() {
            let last = first.marker.len().saturating_sub(1);
            for (k, marker) in first.marker.iter_mut().enumerate() {
                self.markers.apply(marker, k == last);
            }
        }
        rig
    }
}

impl MarkerMisfit {
    fn apply(&self, marker: &mut MarkerConfig, is_the_one: bool) {
        let one = f64::from(u8::from(is_the_one));
        let scale = (1.0 + self.size) * (1.0 + one * self.one_size);
        marker.size_m = marker.size_m.map(|size| size * scale);
        marker.diameter_m = marker.diameter_m.map(|size| size * scale);
        marker.yaw_deg += self.turn_deg + one * self.one_turn_deg;
        marker.position_m[0] += one * self.one_offset_m[0];
        marker.position_m[1] += one * self.one_offset_m[1];
        marker.position_m[2] -= self.higher_m;
    }
}

fn turned(top: ImageTop, turns: usize) -> ImageTop {
    const ROUND: [ImageTop; 4] = [ImageTop::Forward, ImageTop::Right, ImageTop::Aft, ImageTop::Left];
    let at = ROUND.iter().position(|t| *t == top).unwrap_or(0);
    ROUND[(at + turns) % ROUND.len()]
}

impl Scenario {
    /// Height of the ground as configured, metres down from the truth; `None` where it is to be found.
    pub fn configured_ground_down_m(&self) -> Option<f64> {
        match self.misfit.ground {
            GroundMisfit::Lower(by_m) => Some(-by_m),
            GroundMisfit::Takeoff => None,
        }
    }

    /// The ground's section of a configuration: level, at the height of the origin, unless the misfit changes it.
    pub fn ground(&self) -> GroundConfig {
        let section = |elevation_msl_m, source| GroundConfig { elevation_msl_m, source, terrain: None };
        match self.misfit.ground {
            GroundMisfit::Lower(by_m) => section(Some(self.origin.height_m - self.geoid_m + by_m), None),
            GroundMisfit::Takeoff => section(None, Some(GroundSource::Takeoff)),
        }
    }
}
