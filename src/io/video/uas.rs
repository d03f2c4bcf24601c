//! One packet for each frame: MISB ST 0601.19, the platform, the sensor, the ground in view.

use super::klv::{LocalSet, sealed, signed, unsigned};
use windhover_base::geo::Geodetic;

/// UAS Datalink Local Set.
const KEY: [u8; 16] = [6, 0x0e, 0x2b, 0x34, 2, 0x0b, 1, 1, 0x0e, 1, 3, 1, 1, 0, 0, 0];
/// Version of ST 0601.
const VERSION: u8 = 19;
/// Heights, metres.
const HEIGHT: (f64, f64) = (-900.0, 19_000.0);
/// Slant ranges, metres.
const RANGE: (f64, f64) = (0.0, 5_000_000.0);
/// Widths of the area in view, metres.
const WIDTH: (f64, f64) = (0.0, 10_000.0);

/// A frame as the camera sees it. Angles are degrees, heights above the ellipsoid.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct SensorView {
    /// Name of the flight.
    pub mission: String,
    /// The camera's core identifier.
    pub core_id: Vec<u8>,
    /// Microseconds since 1970.
    pub unix_us: u64,
    /// Heading, pitch, roll of the platform, where known.
    pub platform_deg: Option<[f64; 3]>,
    /// Position of the camera.
    pub sensor: Option<Geodetic>,
    /// Angles of view, across and down.
    pub field_deg: Option<[f64; 2]>,
    /// Azimuth, elevation, roll of the optical axis relative to the platform.
    pub relative_deg: [f64; 3],
    /// Distance to the ground along the optical axis.
    pub slant_m: Option<f64>,
    /// Width of the ground along the middle row of the frame.
    pub width_m: Option<f64>,
    /// The ground at the middle of the frame.
    pub center: Option<Geodetic>,
    /// The ground at the corners: top left, top right, bottom right, bottom left.
    pub corners: [Option<Geodetic>; 4],
    /// The ellipsoid relative to the sea, metres, where the receiver reported it.
    pub geoid_m: Option<f64>,
}

/// The characters of a name that the standard allows, up to its limit.
fn ascii(name: &str) -> Vec<u8> {
    name.bytes().filter(|byte| (0x20..0x7f).contains(byte)).take(127).collect()
}

/// An angle within one turn; just below a whole turn becomes zero.
fn turn_deg(angle: f64) -> f64 {
    let within = angle.rem_euclid(360.0);
    if within > 360.0 - 1e-7 { 0.0 } else { within }
}

/// The packet of a frame, with its checksum.
pub fn sensor_packet(view: &SensorView) -> Vec<u8> {
    let mut set = LocalSet::default();
    set.item(2, &view.unix_us.to_be_bytes());
    set.item(3, &ascii(&view.mission));
    if let Some([heading, pitch, roll]) = view.platform_deg {
        set.known(5, unsigned::<2>(turn_deg(heading), 0.0, 360.0));
        set.known(6, signed::<2>(pitch, 20.0));
        set.known(7, signed::<2>(roll, 50.0));
    }
    set.item(10, b"windhover");
    set.item(11, b"EO");
    set.item(12, b"Geodetic WGS84");
    let height = |m: f64| unsigned::<2>(m, HEIGHT.0, HEIGHT.1);
    let above_sea = |place: &Geodetic| view.geoid_m.and_then(|geoid| height(place.height_m - geoid));
    if let Some(at) = &view.sensor {
        set.known(13, signed::<4>(at.lat_deg, 90.0));
        set.known(14, signed::<4>(at.lon_deg, 180.0));
        set.known(15, above_sea(at));
    }
    if let Some([across, down]) = view.field_deg {
        set.known(16, unsigned::<2>(across, 0.0, 180.0));
        set.known(17, unsigned::<2>(down, 0.0, 180.0));
    }
    let [azimuth, elevation, turn] = view.relative_deg;
    set.known(18, unsigned::<4>(turn_deg(azimuth), 0.0, 360.0));
    set.known(19, signed::<4>(elevation, 180.0));
    set.known(20, unsigned::<4>(turn_deg(turn), 0.0, 360.0));
    set.known(21, view.slant_m.and_then(|m| unsigned::<4>(m, RANGE.0, RANGE.1)));
    set.known(22, view.width_m.and_then(|m| unsigned::<2>(m, WIDTH.0, WIDTH.1)));
    if let Some(at) = &view.center {
        set.known(23, signed::<4>(at.lat_deg, 90.0));
        set.known(24, signed::<4>(at.lon_deg, 180.0));
        set.known(25, above_sea(at));
    }
    set.item(65, &[VERSION]);
    set.known(75, view.sensor.and_then(|at| height(at.height_m)));
    set.known(78, view.center.and_then(|at| height(at.height_m)));
    for (corner, tag) in view.corners.iter().zip([82, 84, 86, 88]) {
        if let Some(at) = corner {
            set.known(tag, signed::<4>(at.lat_deg, 90.0));
            set.known(tag + 1, signed::<4>(at.lon_deg, 180.0));
        }
    }
    if let Some([_, pitch, roll]) = view.platform_deg {
        set.known(90, signed::<4>(pitch, 90.0));
        set.known(91, signed::<4>(roll, 90.0));
    }
    set.item(94, &view.core_id);
    sealed(&KEY, set)
}
