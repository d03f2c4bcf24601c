//! Terrain: heights on a grid of latitude and longitude, and their intersection with rays.

use std::sync::Arc;

use nalgebra::Vector3;

use super::{Geodetic, LocalFrame};

/// Mean radius of the Earth, metres: far away, the tangent plane is above the ground by the Earth's curvature.
const EARTH_M: f64 = 6_371_000.0;
/// Largest distance along a ray, metres.
const FARTHEST_M: f64 = 50_000.0;
/// Most steps along a ray that grazes the ground.
const MOST_STEPS: usize = 400;
/// A ray has met the ground at this distance, metres.
const MET_M: f64 = 1e-7;

/// Why heights do not make a tile.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
pub enum TerrainError {
    /// Fewer than 2 × 2 heights, or another number than rows and columns give.
    #[error("{got} heights are not {rows} rows of {columns}")]
    Size {
        /// Number of heights.
        got: usize,
        /// Rows.
        rows: usize,
        /// Columns.
        columns: usize,
    },
    /// The grid's corner or spacing is impossible.
    #[error("its corner or spacing is not on Earth")]
    Place,
    /// Most heights are missing.
    #[error("most of its heights are missing")]
    Void,
    /// An SRTM file's name does not give its corner.
    #[error("an .hgt file is named after its south-west corner, as N30W086.hgt")]
    Name,
    /// An SRTM file is square, with two bytes for each height.
    #[error("{0} bytes are not an SRTM tile (1201 x 1201 or 3601 x 3601 heights of two bytes)")]
    Srtm(usize),
}

/// Heights above mean sea level on a regular grid; row 0 is the northernmost, column 0 the westernmost.
#[derive(Clone, PartialEq, Debug)]
pub struct Tile {
    north_deg: f64,
    west_deg: f64,
    /// Between rows and between columns, degrees, both positive.
    step_deg: [f64; 2],
    rows: usize,
    columns: usize,
    heights_m: Vec<f32>,
}

impl Tile {
    /// A tile from heights row by row; `north_deg`, `west_deg` are those of the first height itself (not of a pixel's
    /// corner). NaN marks a missing height: it is filled from its neighbours.
    pub fn new(
        (north_deg, west_deg): (f64, f64),
        step_deg: [f64; 2],
        (rows, columns): (usize, usize),
        heights_m: Vec<f32>,
    ) -> Result<Self, TerrainError> {
        if rows < 2 || columns < 2 || rows.checked_mul(columns) != Some(heights_m.len()) {
            return Err(TerrainError::Size { got: heights_m.len(), rows, columns });
        }
        let spaced = step_deg.iter().all(|s| *s > 0.0 && *s < 1.0);
        if !spaced || !(north_deg.abs() <= 90.0) || !(west_deg.abs() <= 360.0) {
            return Err(TerrainError::Place);
        }
        if heights_m.iter().filter(|h| h.is_finite()).count() * 2 < heights_m.len() {
            return Err(TerrainError::Void);
        }
        let mut tile = Self { north_deg, west_deg, step_deg, rows, columns, heights_m };
        tile.fill_voids();
        Ok(tile)
    }

    /// An SRTM `.hgt` file: big-endian heights of two bytes, −32768 where missing, a square that covers one degree and
    /// shares its border with its neighbours (USGS, SRTM documentation). `stem` is its name without extension, which
    /// gives the south-west corner.
    ///
    /// # Errors
    /// Where the name gives no corner, or the bytes are not a square of heights.
    pub fn from_hgt(stem: &str, bytes: &[u8]) -> Result<Self, TerrainError> {
        let (south, west) = hgt_corner(stem).ok_or(TerrainError::Name)?;
        let side = match bytes.len() / 2 {
            n if n == 1201 * 1201 => 1201,
            n if n == 3601 * 3601 => 3601,
            _ => return Err(TerrainError::Srtm(bytes.len())),
        };
        let height = |pair: &[u8]| match i16::from_be_bytes([pair[0], pair[1]]) {
            i16::MIN => f32::NAN,
            h => f32::from(h),
        };
        let heights = bytes.chunks_exact(2).map(height).collect();
        let step = 1.0 / (side - 1) as f64;
        Self::new((south + 1.0, west), [step; 2], (side, side), heights)
    }

    /// Missing heights become the mean of known neighbours, ring by ring from the known ones inwards. Each is visited a
    /// few times, however large the void is.
    fn fill_voids(&mut self) {
        let is_missing = |tile: &Self, k: usize| !tile.heights_m[k].is_finite();
        let mut ring: Vec<usize> = (0..self.heights_m.len())
            .filter(|k| is_missing(self, *k) && self.mean_around(*k).is_some())
            .collect();
        let mut listed = vec![false; self.heights_m.len()];
        while !ring.is_empty() {
            let filled: Vec<(usize, f32)> =
                ring.iter().filter_map(|k| Some((*k, self.mean_around(*k)?))).collect();
            filled.iter().for_each(|(k, h)| self.heights_m[*k] = *h);
            ring.clear();
            for (k, _) in filled {
                let next = self.around(k).filter(|k| is_missing(self, *k));
                ring.extend(next.filter(|k| !std::mem::replace(&mut listed[*k], true)));
            }
        }
    }

    /// A height and its neighbours, by their indices in the list.
    fn around(&self, k: usize) -> impl Iterator<Item = usize> + use<> {
        let (row, column, columns) = (k / self.columns, k % self.columns, self.columns);
        let beside = |at: usize, count: usize| at.saturating_sub(1)..=(at + 1).min(count - 1);
        let across = beside(column, columns);
        beside(row, self.rows).flat_map(move |r| across.clone().map(move |c| r * columns + c))
    }

    fn mean_around(&self, k: usize) -> Option<f32> {
        let known = self.around(k).map(|k| self.heights_m[k]).filter(|h| h.is_finite());
        let (sum, n) = known.fold((0.0, 0u8), |(sum, n), h| (sum + h, n + 1));
        (n > 0).then(|| sum / f32::from(n))
    }

    /// Whether a place is on the tile.
    pub fn covers(&self, lat_deg: f64, lon_deg: f64) -> bool {
        let (row, column) = self.place(lat_deg, lon_deg);
        (0.0..=(self.rows - 1) as f64).contains(&row) && (0.0..=(self.columns - 1) as f64).contains(&column)
    }

    fn place(&self, lat_deg: f64, lon_deg: f64) -> (f64, f64) {
        ((self.north_deg - lat_deg) / self.step_deg[0], (lon_deg - self.west_deg) / self.step_deg[1])
    }

    /// Height above mean sea level, metres: bilinear; outside the tile that of its border.
    pub fn height_msl_m(&self, lat_deg: f64, lon_deg: f64) -> f64 {
        let (row, column) = self.place(lat_deg, lon_deg);
        let row = row.clamp(0.0, (self.rows - 1) as f64 - 1e-9);
        let column = column.clamp(0.0, (self.columns - 1) as f64 - 1e-9);
        let (r, c) = (row as usize, column as usize);
        let (a, b) = (row - r as f64, column - c as f64);
        let at = |dr: usize, dc: usize| f64::from(self.heights_m[(r + dr) * self.columns + c + dc]);
        let upper = at(0, 0) * (1.0 - b) + at(0, 1) * b;
        let lower = at(1, 0) * (1.0 - b) + at(1, 1) * b;
        upper * (1.0 - a) + lower * a
    }
}

/// South and west of `N30W086`.
fn hgt_corner(stem: &str) -> Option<(f64, f64)> {
    let name = stem.get(..7)?;
    let signed = |part: &str, plus: &str, minus: &str| {
        let (letter, digits) = part.split_at_checked(1)?;
        let figure: f64 = digits.parse().ok()?;
        match letter.to_ascii_uppercase() {
            l if l == plus => Some(figure),
            l if l == minus => Some(-figure),
            _ => None,
        }
    };
    Some((signed(name.get(..3)?, "N", "S")?, signed(name.get(3..)?, "E", "W")?))
}

/// A tile as a surface in a NED frame.
///
/// ```
/// use std::sync::Arc;
/// use windhover_base::geo::{Geodetic, LocalFrame, Terrain, Tile};
///
/// // Four heights, a thousandth of a degree apart: the south is 10 m higher.
/// let tile = Tile::new((47.001, 8.0), [1e-3; 2], (2, 2), vec![400.0, 400.0, 410.0, 410.0])
///     .expect("as many heights as rows and columns");
/// assert!(tile.covers(47.0005, 8.0005) && (tile.height_msl_m(47.0005, 8.0005) - 405.0).abs() < 1e-3);
///
/// let frame = LocalFrame::new(Geodetic { lat_deg: 47.0, lon_deg: 8.0, height_m: 450.0 });
/// let terrain = Terrain::new(Arc::new(tile), &frame, 40.0);
/// // The geoid is 40 m above the ellipsoid: the ground at the datum is at its height.
/// assert!(terrain.down_m(0.0, 0.0).abs() < 1e-3 && terrain.down_m(100.0, 0.0) > 8.0);
/// ```
#[derive(Clone, PartialEq, Debug)]
pub struct Terrain {
    tile: Arc<Tile>,
    datum: Geodetic,
    geoid_m: f64,
    /// Metres north per degree of latitude, metres east per degree of longitude, at the datum.
    metres_per_deg: [f64; 2],
    /// Half a cell, metres: the step for slopes.
    half_cell_m: f64,
    /// The steepest slope between neighbouring heights.
    steepest: f64,
}

impl Terrain {
    /// The tile in the frame; `geoid_m` is the geoid's height over the ellipsoid there.
    pub fn new(tile: Arc<Tile>, frame: &LocalFrame, geoid_m: f64) -> Self {
        let datum = frame.datum();
        let small = 1e-3;
        let north = frame.ned(Geodetic { lat_deg: datum.lat_deg + small, ..datum }).x / small;
        let east = frame.ned(Geodetic { lon_deg: datum.lon_deg + small, ..datum }).y / small;
        let cell = [tile.step_deg[0] * north, tile.step_deg[1] * east];
        let steepest = steepest(&tile, cell);
        let half_cell_m = 0.5 * cell[0].min(cell[1]);
        Self { tile, datum, geoid_m, metres_per_deg: [north, east], half_cell_m, steepest }
    }

    /// Down coordinate of the surface under a point, metres.
    pub fn down_m(&self, north_m: f64, east_m: f64) -> f64 {
        let lat = self.datum.lat_deg + north_m / self.metres_per_deg[0];
        let lon = self.datum.lon_deg + east_m / self.metres_per_deg[1];
        let height = self.tile.height_msl_m(lat, lon) + self.geoid_m;
        self.datum.height_m - height + (north_m * north_m + east_m * east_m) / (2.0 * EARTH_M)
    }

    /// Slope ∂down/∂(north, east) under a point, over a cell.
    pub fn slope(&self, north_m: f64, east_m: f64) -> [f64; 2] {
        let h = self.half_cell_m;
        [
            (self.down_m(north_m + h, east_m) - self.down_m(north_m - h, east_m)) / (2.0 * h),
            (self.down_m(north_m, east_m + h) - self.down_m(north_m, east_m - h)) / (2.0 * h),
        ]
    }

    /// Distance along a ray (in lengths of `direction`) to the surface raised by `above_m`; `None`
    /// where the ray does not meet it within 50 km or begins below it.
    ///
    /// Each step is as long as the clearance allows even if the ground rose toward the ray as steeply
    /// as it does anywhere on the tile, so that no hill is stepped through.
    pub fn intersect(&self, origin: &Vector3<f64>, direction: &Vector3<f64>, above_m: f64) -> Option<f64> {
        let clearance = |range: f64| {
            let at = origin + direction * range;
            self.down_m(at.x, at.y) - above_m - at.z
        };
        let closing = direction.z + self.steepest * direction.xy().norm();
        if !(closing > 0.0) || !(clearance(0.0) > 0.0) {
            return None;
        }
        let limit = FARTHEST_M / direction.norm();
        let mut range = 0.0;
        for _ in 0..MOST_STEPS {
            let left = clearance(range);
            if left.abs() < MET_M {
                return Some(range);
            }
            range += left / closing;
            if !(range < limit) {
                return None;
            }
        }
        None
    }
}

/// The steepest slope on the tile, with an allowance for the Earth's curvature.
fn steepest(tile: &Tile, cell_m: [f64; 2]) -> f64 {
    let height = |r: usize, c: usize| f64::from(tile.heights_m[r * tile.columns + c]);
    let mut most: f64 = 0.0;
    for r in 0..tile.rows {
        for c in 0..tile.columns {
            let down = if r + 1 < tile.rows { (height(r + 1, c) - height(r, c)) / cell_m[0] } else { 0.0 };
            let right =
                if c + 1 < tile.columns { (height(r, c + 1) - height(r, c)) / cell_m[1] } else { 0.0 };
            most = most.max(down.abs().hypot(right.abs()));
        }
    }
    // Inside a cell both partial slopes may be as steep as the steepest edge.
    most * std::f64::consts::SQRT_2 + 0.01
}

#[cfg(test)]
mod tests {
    use super::*;

    const DATUM: Geodetic = Geodetic { lat_deg: 30.5, lon_deg: -85.5, height_m: 10.0 };

    /// A plane that rises `slope` metres for each metre toward north, 40 m high at the datum; 3″ cells.
    fn rising(slope: f64) -> Terrain {
        let frame = LocalFrame::new(DATUM);
        let step = 1.0 / 1200.0;
        let per_row = slope * frame.ned(Geodetic { lat_deg: DATUM.lat_deg + step, ..DATUM }).x;
        let heights = (0..121 * 121).map(|k| (40.0 + per_row * (60.0 - f64::from(k / 121))) as f32).collect();
        let corner = (DATUM.lat_deg + 60.0 * step, DATUM.lon_deg - 60.0 * step);
        let tile = Tile::new(corner, [step; 2], (121, 121), heights).expect("a whole grid");
        Terrain::new(Arc::new(tile), &frame, -30.0)
    }

    #[test]
    fn a_slope_is_a_slope() {
        let terrain = rising(0.2);
        assert!((terrain.down_m(0.0, 0.0) - 0.0).abs() < 1e-3);
        assert!((terrain.down_m(100.0, 50.0) + 20.0).abs() < 0.01, "{}", terrain.down_m(100.0, 50.0));
        let [north, east] = terrain.slope(30.0, -20.0);
        assert!((north + 0.2).abs() < 1e-3 && east.abs() < 1e-3);
    }

    #[test]
    fn rays_meet_the_slope_where_geometry_says() {
        let terrain = rising(0.2);
        let origin = Vector3::new(0.0, 0.0, -15.0);
        // Toward north, 45° down: −15 + s = −0.2 s.
        let range = terrain.intersect(&origin, &Vector3::new(1.0, 0.0, 1.0), 0.0).expect("it meets the hill");
        assert!((range - 12.5).abs() < 1e-3, "{range}");
        // Flat ground would put the point 2.5 m farther.
        let raised =
            terrain.intersect(&origin, &Vector3::new(1.0, 0.0, 1.0), 0.6).expect("it meets the roof");
        assert!((raised - 12.0).abs() < 1e-3, "{raised}");
        // Level toward the hill: it rises 15 m in 75 m.
        let level = terrain.intersect(&origin, &Vector3::x(), 0.0).expect("the hill is met");
        assert!((level - 75.0).abs() < 0.05, "{level}");
        assert!(terrain.intersect(&origin, &-Vector3::x(), 0.0).is_none());
        assert!(terrain.intersect(&Vector3::new(0.0, 0.0, 1.0), &Vector3::z(), 0.0).is_none());
    }

    #[test]
    fn a_void_is_filled_from_its_border_inwards_however_large_it_is() {
        // Given a tile of the finest resolution, with half of it missing on one side, and a gap in the other half.
        let side = 1201;
        let is_void = |r: usize, c: usize| c < side / 2 || (r == 600 && c == 900);
        let height = |k: usize| if is_void(k / side, k % side) { f32::NAN } else { (k / side) as f32 };
        let step = 1.0 / (side - 1) as f64;
        let heights = (0..side * side).map(height).collect();
        let tile = Tile::new((1.0, 0.0), [step; 2], (side, side), heights).expect("half of it is known");
        let at = |r: usize, c: usize| tile.heights_m[r * side + c];
        assert!(tile.heights_m.iter().all(|h| h.is_finite()));
        assert_eq!((at(600, 900), at(300, 700)), (600.0, 300.0));
        // The first ring is the mean of its neighbours, and so is the next: along a ramp these are values of the ramp.
        assert_eq!((at(600, side / 2 - 1), at(600, side / 2 - 2), at(0, side / 2 - 1)), (600.0, 600.0, 0.5));
        assert!((at(600, 0) - 600.0).abs() < 1.0, "{}", at(600, 0));
    }

    #[test]
    fn an_srtm_tile_is_read_by_its_name() {
        let mut bytes = vec![0u8; 1201 * 1201 * 2];
        // The south-west corner is the first of the last row; one height is missing beside it.
        let at = 1200 * 1201 * 2;
        bytes[at..at + 4].copy_from_slice(&[0x01, 0x00, 0x80, 0x00]);
        let tile = Tile::from_hgt("N30W086", &bytes).expect("whole");
        assert!((tile.height_msl_m(30.0, -86.0) - 256.0).abs() < 1e-6);
        assert!(tile.height_msl_m(30.0, -86.0 + 1.0 / 1200.0) < 255.0);
        assert!(tile.covers(30.5, -85.5) && !tile.covers(31.5, -85.5));
        assert_eq!(Tile::from_hgt("hills", &bytes), Err(TerrainError::Name));
        assert_eq!(Tile::from_hgt("N30W086", &bytes[..100]), Err(TerrainError::Srtm(100)));
    }
}
