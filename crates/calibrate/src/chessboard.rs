//! The inner corners of a chessboard in an image, found automatically.

use nalgebra::Vector2;

use super::grid::{Grid, extent, grids};
use super::saddle::{FloatImage, saddles};
use super::subpixel::{Window, refine};
use windhover_base::msg::ImageView;

/// Why an image gave no board.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
pub enum BoardError {
    /// No board was found.
    #[error("no chessboard is found ({corners} corner-like points, the largest grid has {in_grid})")]
    NotSeen {
        /// Points where two edges cross.
        corners: usize,
        /// Number of those in the largest grid.
        in_grid: usize,
    },
    /// A part is hidden, outside the image, in glare or in deep shadow.
    #[error("only a part of the board is visible: {columns}x{rows} with {found} of {wanted} corners")]
    Partial {
        /// Columns seen.
        columns: usize,
        /// Rows seen.
        rows: usize,
        /// Corners seen.
        found: usize,
        /// Corners of the board.
        wanted: usize,
    },
    /// A grid of another size.
    #[error("the board has {columns}x{rows} inner corners: is --board right?")]
    OtherSize {
        /// Columns seen.
        columns: usize,
        /// Rows seen.
        rows: usize,
    },
}

/// Corners row by row; `None` where one could not be located.
pub type Corners = Vec<Option<Vector2<f64>>>;

/// Largest distance of an inner corner from the middle of its neighbours, as a share of the distance to the nearest:
/// perspective and distortion of a usable photograph stay below it.
const STRAY_SHARE: f64 = 0.06;
/// Smallest share of the corners with which a board is used.
const LEAST_SHARE: f64 = 0.8;
/// Blur and ring radius, pixels, of each attempt: sharp first, then blurred or noisy images, then
/// small squares.
const ATTEMPTS: [(f64, f64); 4] = [(1.4, 4.5), (2.2, 6.5), (1.0, 3.2), (0.8, 2.4)];
/// Most grids that are examined in each attempt; a photograph may show other boards too.
const MOST_GRIDS: usize = 4;
/// Corners are first searched for in an image of at most this many pixels across; larger images are halved.
const COARSE_PX: usize = 1_000;
/// When it is located exactly, a corner moves by less than this share of the distance to the nearest neighbour.
const REACH_SHARE: f64 = 0.5;
/// Default half-width of the window of exact location, pixels: that of OpenCV's calibration programs, so that results
/// can be compared. Where the window would reach more than half-way to the next corner, only the part is used that is
/// nearer to the corner's own edges than to the next ones.
pub const WINDOW_PX: f64 = 11.0;

/// The `columns × rows` inner corners, row by row, to a fraction of a pixel; `None` for the few (at most a fifth) that
/// cannot be located because of glare, the edge of a shadow or the border of the image.
///
/// Rows run so that columns to rows turn clockwise in the image, as on the printed side; of the remaining two or four
/// orders, the one is used whose first corner is nearest the top-left of the image. The choice of the first corner does
/// not affect calibration.
///
/// `window_px` is half the width of the window in which each corner is located ([`WINDOW_PX`]).
///
/// ```
/// use windhover_base::msg::GrayImage;
/// use windhover_calibrate::{BoardError, WINDOW_PX, find_corners};
///
/// // A board of 6 by 5 squares of 40 pixels on white: 5 by 4 inner corners.
/// let mut image = GrayImage::from_vec(320, 280, vec![255; 320 * 280]).expect("as many pixels as rows and columns");
/// for (v, u) in (0..200).flat_map(|v| (0..240).map(move |u| (v, u))) {
///     if (u / 40 + v / 40) % 2 == 0 {
///         image.data[(v + 40) * 320 + u + 40] = 0;
///     }
/// }
/// let corners = find_corners(image.view(), 5, 4, WINDOW_PX).expect("the board is in view");
/// let first = corners[0].expect("no corner is hidden");
/// // Between the squares: pixel centres are at whole numbers.
/// assert!((first.x - 79.5).abs() < 0.1 && (first.y - 79.5).abs() < 0.1, "{first}");
///
/// let blank = GrayImage::new(320, 280);
/// assert!(matches!(find_corners(blank.view(), 5, 4, WINDOW_PX), Err(BoardError::NotSeen { .. })));
/// ```
///
/// # Errors
/// Where no board of this size is found, or too many of its corners are hidden.
pub fn find_corners(
    image: ImageView<'_>,
    columns: usize,
    rows: usize,
    window_px: f64,
) -> Result<Corners, BoardError> {
    let full = FloatImage::of(image);
    let mut levels = vec![full.clone()];
    while let Some(last) = levels.last()
        && last.width.max(last.height) > COARSE_PX
    {
        let next = last.halved();
        levels.push(next);
    }
    let mut best: Option<BoardError> = None;
    for (power, level) in levels.iter().enumerate().rev() {
        for (blur, radius) in ATTEMPTS {
            let at_full = |p: Vector2<f64>| {
                let scale = f64::from(1u32 << power);
                p * scale + Vector2::repeat(0.5 * (scale - 1.0))
            };
            match attempt(level, blur, radius, columns, rows) {
                Ok(corners) => {
                    let corners = corners.into_iter().map(|c| c.map(at_full)).collect();
                    return place(&full, corners, columns, window_px);
                }
                Err(error) => best = Some(best.map_or(error, |b| b.nearer(error))),
            }
        }
    }
    Err(best.unwrap_or(BoardError::NotSeen { corners: 0, in_grid: 0 }))
}

impl BoardError {
    /// Of two failed attempts the one that found more.
    fn nearer(self, other: Self) -> Self {
        if other.seen() > self.seen() { other } else { self }
    }

    fn seen(self) -> usize {
        match self {
            Self::NotSeen { in_grid, .. } => in_grid,
            Self::Partial { found, .. } => found,
            Self::OtherSize { columns, rows } => columns * rows,
        }
    }
}

fn attempt(
    level: &FloatImage,
    blur: f64,
    radius: f64,
    columns: usize,
    rows: usize,
) -> Result<Corners, BoardError> {
    let blurred = level.blurred(blur);
    let points = saddles(&blurred, radius);
    let mut best = BoardError::NotSeen { corners: points.len(), in_grid: 0 };
    for grid in grids(&blurred, &points, radius, MOST_GRIDS) {
        match judge(&grid, columns, rows, points.len()) {
            Ok(()) => return Ok(in_order(&grid, columns, rows)),
            Err(error) => best = best.nearer(error),
        }
    }
    Err(best)
}

/// Whether a grid is the whole board.
fn judge(grid: &Grid, columns: usize, rows: usize, corners: usize) -> Result<(), BoardError> {
    let missing = BoardError::NotSeen { corners, in_grid: grid.len() };
    let (low, high) = extent(grid).ok_or(missing)?;
    let (wide, tall) = ((high.0 - low.0 + 1) as usize, (high.1 - low.1 + 1) as usize);
    let fits = (wide, tall) == (columns, rows) || (wide, tall) == (rows, columns);
    if fits && grid.len() as f64 >= LEAST_SHARE * (columns * rows) as f64 {
        return Ok(());
    }
    if grid.len() < 6 || wide.min(tall) < 2 {
        return Err(missing);
    }
    let larger = wide.max(tall) > columns.max(rows) || wide.min(tall) > columns.min(rows);
    if larger {
        return Err(BoardError::OtherSize { columns: wide.max(tall), rows: wide.min(tall) });
    }
    Err(BoardError::Partial { columns: wide, rows: tall, found: grid.len(), wanted: columns * rows })
}

/// The corners row by row; the grid has exactly this size, in either orientation.
fn in_order(grid: &Grid, columns: usize, rows: usize) -> Corners {
    let Some((low, high)) = extent(grid) else { return Vec::new() };
    let along_columns = (high.0 - low.0 + 1) as usize == columns;
    let square = columns == rows;
    // Quarter turns of the board that keep its handedness; a square board can have all four.
    let mut best: Option<(f64, Corners)> = None;
    for turn in 0..4 {
        if !square && (turn % 2 == 0) != along_columns {
            continue;
        }
        let cell = |c: i32, r: i32| match turn {
            0 => (low.0 + c, low.1 + r),
            1 => (high.0 - r, low.1 + c),
            2 => (high.0 - c, high.1 - r),
            _ => (low.0 + r, high.1 - c),
        };
        let corners: Corners = (0..rows as i32)
            .flat_map(|r| (0..columns as i32).map(move |c| (c, r)))
            .map(|(c, r)| grid.get(&cell(c, r)).copied())
            .collect();
        let to_origin = corners.iter().flatten().next().map_or(f64::INFINITY, |p| p.norm());
        if best.as_ref().is_none_or(|(least, _)| to_origin < *least) {
            best = Some((to_origin, corners));
        }
    }
    best.map(|(_, corners)| corners).unwrap_or_default()
}

/// Locates every corner exactly on the full image.
fn place(full: &FloatImage, corners: Corners, columns: usize, window_px: f64) -> Result<Corners, BoardError> {
    let placed: Corners = (0..corners.len())
        .map(|k| {
            let start = corners[k]?;
            let half_way = REACH_SHARE * to_nearest(&corners, columns, k);
            let room = window_px.min(full.to_border(start) - 2.0);
            let next = to_next(&corners, columns, k, 1).zip(to_next(&corners, columns, k, columns));
            let window = match next {
                _ if room <= half_way => Window::square(room),
                Some((along, across)) => Window::square(room).within(along, across),
                None => Window::square(half_way),
            };
            // Half a square away is another corner.
            let close = |p: &Vector2<f64>| (p - start).norm() < half_way;
            (room.min(half_way) >= 2.0).then(|| refine(full, start, window)).flatten().filter(close)
        })
        .collect();
    let placed = without_strays(placed, columns);
    let (wanted, found) = (placed.len(), placed.iter().flatten().count());
    if (found as f64) < LEAST_SHARE * wanted as f64 {
        return Err(BoardError::Partial { columns, rows: wanted / columns, found, wanted });
    }
    Ok(placed)
}

/// Leaves out inner corners that do not lie between their neighbours: the edge of a shadow or a glint
/// drew them aside. Corners along the border of the board have no neighbours to tell.
pub(super) fn without_strays(corners: Corners, columns: usize) -> Corners {
    let rows = corners.len() / columns;
    let at = |c: i64, r: i64| {
        let inside = c >= 0 && r >= 0 && c < columns as i64 && r < rows as i64;
        inside.then(|| corners[r as usize * columns + c as usize]).flatten()
    };
    // By the neighbours along a row or column: as the inner ones have it, and beside the board's edge as those on one side.
    let between = |c: i64, r: i64, step: (i64, i64)| {
        let neighbour = |k: i64| at(c + k * step.0, r + k * step.1);
        let (before, after) = (neighbour(-1)?, neighbour(1)?);
        // The cubic through four neighbours follows perspective and distortion better than the line through two.
        let one_sided = |near: Vector2<f64>, next: Vector2<f64>, beyond: Vector2<f64>, far: Vector2<f64>| {
            (near * 6.0 - next * 4.0 + beyond + far) / 4.0
        };
        let line = (before + after) / 2.0;
        Some(match (neighbour(-2), neighbour(2)) {
            (Some(first), Some(last)) => [((before + after) * 4.0 - first - last) / 6.0; 2],
            (None, Some(last)) => {
                [line, neighbour(3).map_or(line, |third| one_sided(after, last, third, before))]
            }
            (Some(first), None) => {
                [line, neighbour(-3).map_or(line, |third| one_sided(before, first, third, after))]
            }
            (None, None) => [line; 2],
        })
    };
    let stays = |k: usize, p: Vector2<f64>| {
        let (c, r) = ((k % columns) as i64, (k / columns) as i64);
        let limit = (STRAY_SHARE * to_nearest(&corners, columns, k)).max(1.0);
        match [between(c, r, (1, 0)), between(c, r, (0, 1))] {
            // One neighbour may itself be displaced: either guess will do.
            [Some(a), Some(b)] => (0..2).any(|way| ((a[way] + b[way]) / 2.0 - p).norm() < limit),
            _ => true,
        }
    };
    (0..corners.len()).map(|k| corners[k].filter(|p| stays(k, *p))).collect()
}

/// From a corner to the next one along its row (`step` 1) or column (`step` the number of columns), the nearer of the
/// two neighbours.
fn to_next(corners: &Corners, columns: usize, k: usize, step: usize) -> Option<Vector2<f64>> {
    let own = corners[k]?;
    let same_row = |n: &usize| step != 1 || n / columns == k / columns;
    let neighbours = [k.checked_sub(step), Some(k + step)].into_iter().flatten().filter(same_row);
    let found = neighbours.filter_map(|n| Some(corners.get(n).copied().flatten()? - own));
    found.min_by(|a, b| a.norm().total_cmp(&b.norm()))
}

/// Distance from a corner to the nearest known neighbour.
fn to_nearest(corners: &Corners, columns: usize, k: usize) -> f64 {
    let in_row = k % columns;
    let neighbours = [
        (in_row > 0).then(|| k - 1),
        (in_row + 1 < columns).then_some(k + 1),
        k.checked_sub(columns),
        Some(k + columns),
    ];
    let known = neighbours.into_iter().flatten().filter_map(|n| corners.get(n).copied().flatten());
    let distance = |p: Vector2<f64>| corners[k].map_or(f64::INFINITY, |own| (p - own).norm());
    known.map(distance).fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drawn_board::{DrawnBoard, Shadow};
    use windhover_base::geo::{CameraModel, LensModel, rot_z};

    fn camera() -> CameraModel {
        CameraModel {
            fx: 610.0,
            fy: 605.0,
            cx: 330.0,
            cy: 236.0,
            model: LensModel::Brown,
            distortion: [-0.22, 0.06, 0.001, -0.0005, 0.0],
            skew: 0.0,
        }
    }

    fn board(turn: f64, pitch: f64, roll: f64) -> DrawnBoard {
        DrawnBoard::new(camera(), (640, 480), (9, 6), 0.025).posed(turn, pitch, roll, 0.42)
    }

    /// Largest distance from the true corners, in whichever order was used.
    fn worst(found: &Corners, truth: &[Vector2<f64>]) -> f64 {
        let off = |a: &mut dyn Iterator<Item = &Option<Vector2<f64>>>| {
            a.zip(truth).filter_map(|(f, t)| Some((f.as_ref()? - t).norm())).fold(0.0, f64::max)
        };
        off(&mut found.iter()).min(off(&mut found.iter().rev()))
    }

    #[test]
    fn any_orientation_is_found_and_placed() {
        for step in 0..8 {
            let turn = f64::from(step) * std::f64::consts::FRAC_PI_4 + 0.1;
            let drawn = board(turn, 0.35, -0.3);
            let found = find_corners(drawn.image(None).view(), 9, 6, 8.0).expect("in full view");
            assert!(
                worst(&found, &drawn.corners()) < 0.2,
                "turn {turn}: {}",
                worst(&found, &drawn.corners())
            );
        }
    }

    #[test]
    fn a_shadow_across_the_board_does_not_matter() {
        let drawn = board(0.2, 0.3, 0.2);
        let shadow = Shadow { direction: rot_z(0.8), edge_px: 20.0, depth: 0.2 };
        let found = find_corners(drawn.image(Some(shadow)).view(), 9, 6, 8.0).expect("in full view");
        // Where the shadow's edge runs through a corner itself, it may be left out.
        assert!(found.iter().flatten().count() >= 50);
        assert!(worst(&found, &drawn.corners()) < 0.2, "{}", worst(&found, &drawn.corners()));
    }

    /// Boards that fill most of a lens of 130°, squares at the rim a third as wide as those in the middle.
    #[test]
    fn whole_boards_that_fill_a_wide_lens_are_found() {
        let fisheye = CameraModel {
            fx: 262.0,
            fy: 262.0,
            model: LensModel::Fisheye,
            distortion: [-0.02, 0.004, 0.0, 0.0, 0.0],
            ..camera()
        };
        let barrel =
            CameraModel { fx: 330.0, fy: 330.0, distortion: [-0.26, 0.085, 0.0, 0.0, -0.012], ..camera() };
        for (lens, distance) in [(fisheye, 0.075), (fisheye, 0.1), (barrel, 0.13), (barrel, 0.16)] {
            for (turn, pitch, roll) in
                [(0.0, 0.0, 0.0), (0.1, 0.2, -0.1), (-0.15, -0.15, 0.25), (3.1, 0.1, 0.2)]
            {
                let drawn =
                    DrawnBoard::new(lens, (640, 480), (9, 6), 0.025).posed(turn, pitch, roll, distance);
                let truth = drawn.corners();
                let is_inside = |p: &&Vector2<f64>| p.x > 8.0 && p.y > 8.0 && p.x < 631.0 && p.y < 471.0;
                if truth.iter().filter(is_inside).count() < 54 {
                    continue;
                }
                let name = format!("{:?} at {distance} m, {turn} {pitch} {roll}", lens.model);
                let found = find_corners(drawn.image(None).view(), 9, 6, WINDOW_PX);
                let found = found.unwrap_or_else(|e| panic!("{name}: {e}"));
                assert!(found.iter().flatten().count() >= 52, "{name}: {}", found.iter().flatten().count());
                assert!(worst(&found, &truth) < 0.5, "{name}: {}", worst(&found, &truth));
            }
        }
    }

    #[test]
    fn what_cannot_be_used_says_why() {
        let blank = windhover_base::msg::GrayImage::new(320, 240);
        assert!(matches!(find_corners(blank.view(), 9, 6, 8.0), Err(BoardError::NotSeen { corners: 0, .. })));
        let drawn = board(0.0, 0.0, 0.0).image(None);
        assert_eq!(find_corners(drawn.view(), 7, 6, 8.0), Err(BoardError::OtherSize { columns: 9, rows: 6 }));
        let cut = drawn.view().crop(0, 0, 380, 480);
        let error = find_corners(cut, 9, 6, 8.0).expect_err("half of it is outside");
        assert!(matches!(error, BoardError::Partial { wanted: 54, .. }), "{error}");
    }

    #[test]
    fn a_large_photograph_is_found_and_placed_at_full_size() {
        let lens = CameraModel { fx: 1220.0, fy: 1220.0, cx: 635.0, cy: 480.0, ..camera() };
        let drawn = DrawnBoard::new(lens, (1280, 960), (8, 5), 0.03).posed(0.4, 0.2, -0.4, 0.5);
        let found = find_corners(drawn.image(None).view(), 8, 5, WINDOW_PX).expect("in full view");
        assert!(worst(&found, &drawn.corners()) < 0.2, "{}", worst(&found, &drawn.corners()));
    }
}
