//! The truth beside a capture: a row a frame for each vehicle and for the helicopter.

use std::fmt::Write as _;

use super::camera::FrameTruth;
use super::world::World;

/// Header of the helicopter's truth: position, velocity (NED), heading, `ned_from_body` row by row.
pub const OWNSHIP_HEADER: &str = "frame,time_ns,n,e,d,vn,ve,vd,yaw,r00,r01,r02,r10,r11,r12,r20,r21,r22";

/// Columns that every vehicle's truth has.
pub const VEHICLE_COLUMNS: &str =
    "frame,time_ns,north_m,east_m,heading_rad,speed_mps,yaw_rate_radps,lat_deg,lon_deg";

/// Header of a vehicle's truth: its reference point, and visibility and centre of each marker.
pub fn vehicle_header(world: &World, target: usize) -> String {
    let mut header = VEHICLE_COLUMNS.to_owned();
    for k in 0..world.scenario().rig.target[target].marker.len() {
        let _ = write!(header, ",m{k}_visible,m{k}_u,m{k}_v");
    }
    header
}

/// A vehicle's row at a frame: what was true in the middle of the exposure, under the frame's stamp.
/// Speed is that of the rear axle. A marker behind the camera has no centre.
///
/// ```
/// use std::sync::Arc;
/// use windhover_simulate::{Sample, Scenario, SensorSuite, World, truth};
///
/// let world = Arc::new(World::new(Scenario::named("hover10").expect("a named scenario"), 7));
/// let first = SensorSuite::new(Arc::clone(&world)).find_map(|sample| match sample {
///     Sample::Frame { truth, .. } => Some(truth),
///     _ => None,
/// });
/// let row = truth::vehicle_row(&world, 0, &first.expect("there are frames"));
/// assert_eq!(row.split(',').count(), truth::vehicle_header(&world, 0).split(',').count());
/// ```
pub fn vehicle_row(world: &World, target: usize, frame: &FrameTruth) -> String {
    let vehicle = world.vehicle(target, frame.t_true);
    let config = &world.scenario().rig.target[target];
    let at = vehicle.reference(config.reference_m);
    let place = world.frame().geodetic(&nalgebra::Vector3::new(at.x, at.y, 0.0));
    let mut row = format!(
        "{},{},{:.6},{:.6},{:.6},{:.6},{:.6},{:.10},{:.10}",
        frame.frame,
        frame.t_stamp.ns(),
        at.x,
        at.y,
        vehicle.heading_rad,
        vehicle.speed_mps,
        vehicle.yaw_rate_radps,
        place.lat_deg,
        place.lon_deg
    );
    for marker in 0..config.marker.len() {
        match world.marker(target, marker, frame.t_true) {
            Some(seen) => {
                let (visible, px) = (u8::from(seen.visible), seen.center_px);
                let _ = write!(row, ",{visible},{:.3},{:.3}", px.x, px.y);
            }
            None => row.push_str(",0,,"),
        }
    }
    row
}

/// The helicopter's row at a frame: its body frame's origin.
pub fn ownship_row(world: &World, frame: &FrameTruth) -> String {
    let own = world.ownship(frame.t_true);
    let (p, v) = (own.position_ned_m, own.velocity_ned_mps);
    let mut row = format!(
        "{},{},{:.6},{:.6},{:.6},{:.6},{:.6},{:.6},{:.6}",
        frame.frame,
        frame.t_stamp.ns(),
        p.x,
        p.y,
        p.z,
        v.x,
        v.y,
        v.z,
        own.heading_rad
    );
    let r = own.ned_from_body.matrix();
    for (i, j) in (0..3).flat_map(|i| (0..3).map(move |j| (i, j))) {
        let _ = write!(row, ",{:.9}", r[(i, j)]);
    }
    row
}
