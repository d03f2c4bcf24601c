//! Targets in a frame: MISB ST 0903.6, a separate packet beside that of ST 0601 (readers that know only 0601 skip it).

use super::klv::{LocalSet, imapb, length, oid, sealed, shortest};

/// Video Moving Target Indicator Local Set.
const KEY: [u8; 16] = [6, 0x0e, 0x2b, 0x34, 2, 0x0b, 1, 1, 0x0e, 1, 3, 3, 6, 0, 0, 0];
/// Version of ST 0903.
const VERSION: u8 = 6;
/// Ranges of IMAPB, after ST 0903: heights, one-sigmas, speeds.
const HEIGHT: (f64, f64) = (-900.0, 19_000.0);
const SIGMA: (f64, f64) = (0.0, 650.0);
const SPEED: (f64, f64) = (-900.0, 900.0);

/// State of a target, in ST 0903's numbers.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum TargetLife {
    /// Seen and moving.
    Moving = 1,
    /// Seen and stationary.
    Stopped = 3,
    /// Not seen for a moment; predicted.
    Coasting = 4,
}

/// A target at a frame.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct SeenTarget {
    /// Number, from 1.
    pub id: u32,
    /// Its state.
    pub life: TargetLife,
    /// Its pixel, from the centre of the top-left one; absent outside the image.
    pub pixel: Option<(f64, f64)>,
    /// Degrees.
    pub lat_deg: f64,
    /// Degrees.
    pub lon_deg: f64,
    /// Above the ellipsoid.
    pub height_m: f64,
    /// One-sigma east and north, and their correlation, where known.
    pub place_sigma: Option<(f64, f64, f64)>,
    /// East and north, m/s.
    pub velocity_mps: (f64, f64),
    /// One-sigma east and north, and their correlation, where known.
    pub velocity_sigma: Option<(f64, f64, f64)>,
}

/// The packet of the targets in a frame, with its checksum: time, size and angles of view of the frame (across and
/// down, degrees), and the core identifier of the camera.
pub fn targets_packet(
    unix_us: u64,
    targets: &[SeenTarget],
    (width, height): (u32, u32),
    field_deg: Option<[f64; 2]>,
    core_id: &[u8],
) -> Vec<u8> {
    let mut set = LocalSet::default();
    set.item(2, &unix_us.to_be_bytes());
    set.item(3, b"windhover");
    set.item(4, &[VERSION]);
    set.item(5, &shortest(targets.len() as u64));
    set.item(6, &shortest(targets.len() as u64));
    set.item(8, &shortest(width.into()));
    set.item(9, &shortest(height.into()));
    for (tag, angle) in field_deg.iter().flatten().enumerate() {
        set.item(11 + tag as u32, &imapb::<2>(*angle, 0.0, 180.0));
    }
    set.item(13, core_id);
    let mut series = Vec::new();
    for target in targets {
        let pack = pack(target, width, height);
        length(pack.len(), &mut series);
        series.extend(pack);
    }
    if !series.is_empty() {
        set.item(101, &series);
    }
    sealed(&KEY, set)
}

/// A VTarget pack: number, then a local set.
fn pack(target: &SeenTarget, width: u32, height: u32) -> Vec<u8> {
    let mut number = Vec::new();
    oid(target.id, &mut number);
    let mut set = LocalSet(number);
    // Rows and columns are counted from 1.
    let inside =
        |at: f64, size: u32| (-0.5..f64::from(size) - 0.5).contains(&at).then(|| at.round() as u64 + 1);
    let pixel = target.pixel.and_then(|(u, v)| inside(u, width).zip(inside(v, height)));
    if let Some((column, row)) = pixel {
        set.item(1, &shortest(column + (row - 1) * u64::from(width)));
    }
    let mut place = Vec::new();
    place.extend(imapb::<4>(target.lat_deg, -90.0, 90.0));
    place.extend(imapb::<4>(target.lon_deg, -180.0, 180.0));
    place.extend(imapb::<2>(target.height_m, HEIGHT.0, HEIGHT.1));
    place.extend(spread(target.place_sigma));
    set.item(17, &place);
    if let Some((column, row)) = pixel {
        set.item(19, &shortest(row));
        set.item(20, &shortest(column));
    }
    set.item(23, &[target.life as u8]);
    // The track so far: the place of this frame.
    let mut tracker = LocalSet::default();
    let mut history = Vec::new();
    length(place.len(), &mut history);
    history.extend(&place);
    tracker.item(9, &history);
    let (east, north) = target.velocity_mps;
    let mut velocity: Vec<u8> =
        [east, north, 0.0].into_iter().flat_map(|speed| imapb::<2>(speed, SPEED.0, SPEED.1)).collect();
    velocity.extend(spread(target.velocity_sigma));
    tracker.item(10, &velocity);
    set.item(104, &tracker.0);
    set.0
}

/// One-sigmas of east, north, up and the correlations east-north, east-up, north-up. The vertical is not estimated.
fn spread(sigma: Option<(f64, f64, f64)>) -> Vec<u8> {
    let Some((east, north, correlation)) = sigma else { return Vec::new() };
    let sigmas = [east, north, f64::NAN].into_iter().flat_map(|sigma| imapb::<2>(sigma, SIGMA.0, SIGMA.1));
    let correlations = [correlation, 0.0, 0.0].into_iter().flat_map(|rho| imapb::<2>(rho, -1.0, 1.0));
    sigmas.chain(correlations).collect()
}
