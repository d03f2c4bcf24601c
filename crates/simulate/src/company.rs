//! Other moving things in view: people on foot, other vehicles, vehicles with the same markers.

use nalgebra::Vector3;

use super::instant::VehicleTruth;
use super::misfit::Company;
use super::random::{Purpose, SmoothNoise, Stream};
use super::vehicle::VehicleMotion;
use windhover_base::geo::wrap_angle;

/// How near to the vehicle people walk, metres.
const NEAR_M: (f64, f64) = (1.8, 3.2);
/// How far they stray from there, metres rms an axis, and the periods of that, seconds.
const STRAY: (f64, f64, f64) = (0.6, 3.0, 12.0);
/// How much later than the first vehicle others drive, seconds.
const BEHIND_S: f64 = 1.5;
/// Where they drive beside its path, metres ahead and right, one after the other.
const BESIDE_M: [(f64, f64); 4] = [(-1.0, 2.8), (-1.0, -2.8), (3.5, 3.0), (3.5, -3.0)];

/// The appearance of one of them.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Appearance {
    /// A person from above.
    Person,
    /// A vehicle with a painted roof.
    Painted,
    /// The first target, including its markers.
    Double,
}

/// One of them.
#[derive(Clone, Debug)]
pub(super) struct Companion {
    pub(super) looks: Appearance,
    way: Way,
}

#[derive(Clone, Debug)]
enum Way {
    /// Beside the first vehicle: offset from it, north and east, and how it strays.
    Walks { offset_m: (f64, f64), stray: Box<[SmoothNoise; 2]> },
    /// Along the first vehicle's path, this far ahead and right of it.
    Drives { beside_m: (f64, f64) },
}

impl Companion {
    /// All companions of a flight.
    pub(super) fn all(company: &Company, seed: u64) -> Vec<Self> {
        let people =
            (0..company.people).map(|k| Self { looks: Appearance::Person, way: Way::on_foot(k, seed) });
        let drives = |looks: Appearance, k: usize| {
            let beside_m = BESIDE_M[k % BESIDE_M.len()];
            Self { looks, way: Way::Drives { beside_m } }
        };
        let convoy = (0..company.convoy).map(|k| drives(Appearance::Painted, k));
        let doubles = (0..company.doubles).map(|k| drives(Appearance::Double, company.convoy + k));
        people.chain(convoy).chain(doubles).collect()
    }

    /// Its state, given the first vehicle's motion.
    pub(super) fn at(&self, first: &VehicleMotion, t_s: f64) -> VehicleTruth {
        match &self.way {
            Way::Walks { offset_m, stray } => {
                let vehicle = first.at(t_s);
                let (s, c) = vehicle.heading_rad.sin_cos();
                let north = vehicle.speed_mps * c + stray[0].rate(t_s);
                let east = vehicle.speed_mps * s + stray[1].rate(t_s);
                VehicleTruth {
                    north_m: vehicle.north_m + offset_m.0 + stray[0].at(t_s),
                    east_m: vehicle.east_m + offset_m.1 + stray[1].at(t_s),
                    heading_rad: east.atan2(north),
                    speed_mps: north.hypot(east),
                    ..VehicleTruth::default()
                }
            }
            Way::Drives { beside_m } => {
                let leader = first.at(t_s - BEHIND_S);
                let at = leader.ned_of(&Vector3::new(beside_m.0, beside_m.1, 0.0));
                VehicleTruth {
                    north_m: at.x,
                    east_m: at.y,
                    heading_rad: wrap_angle(leader.heading_rad),
                    speed_mps: leader.speed_mps,
                    yaw_rate_radps: leader.yaw_rate_radps,
                    ..VehicleTruth::default()
                }
            }
        }
    }
}

impl Way {
    fn on_foot(index: usize, seed: u64) -> Self {
        let mut stream = Stream::new(seed, Purpose::Company as u64 + index as u64);
        // Spread around the vehicle.
        let bearing = stream.uniform(0.0, 1.0) + index as f64 * 2.4;
        let (s, c) = bearing.sin_cos();
        let far_m = stream.uniform(NEAR_M.0, NEAR_M.1);
        let (rms, short_s, long_s) = STRAY;
        let stray = Box::new([(); 2].map(|()| SmoothNoise::new(rms, short_s, long_s, &mut stream)));
        Self::Walks { offset_m: (far_m * c, far_m * s), stray }
    }
}
