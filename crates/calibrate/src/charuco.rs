//! Chessboards with tags in their white squares (ChArUco): the tags say which corner is which, so that a part of the
//! board is enough; the chessboard's corners are what is measured.

use nalgebra::Vector2;

use super::chessboard::without_strays;
use super::saddle::{FloatImage, Saddle};
use super::subpixel::{Window, refine};
use super::tag_grid::{LEAST_PX, misfit_px};
use super::zhang::{PlaneView, homography};
use windhover_base::msg::{ImageView, TagFamily};
use windhover_detect::{Detector, Limits};

/// Fewest corners with which an image is used.
const FEWEST: usize = 8;
/// How far a corner may be from where the tags beside it have it, over the edge of a square.
const MOST_ASIDE: f64 = 0.15;
/// Blur with which a corner is checked to be one, pixels.
const BLUR_PX: f64 = 1.0;

/// A chessboard whose white squares hold tags, numbered row by row from 0 (OpenCV's `CharucoBoard`).
///
/// ```
/// use windhover_base::msg::{GrayImage, TagFamily};
/// use windhover_calibrate::{CharucoBoard, CharucoError, WINDOW_PX};
///
/// let board = CharucoBoard { family: TagFamily::Tag36h11, columns: 6, rows: 4, square_m: 0.04, tag_m: 0.03 };
/// assert_eq!(board.tags(), 17);
/// let blank = GrayImage::new(320, 280);
/// assert_eq!(board.find(blank.view(), WINDOW_PX), Err(CharucoError::TooFew { corners: 0, tags: 0 }));
/// ```
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct CharucoBoard {
    /// Family of the tags.
    pub family: TagFamily,
    /// Inner corners in a row: one fewer than squares.
    pub columns: usize,
    /// Rows of inner corners.
    pub rows: usize,
    /// Edge of a square, metres.
    pub square_m: f64,
    /// Edge of a tag's black square, metres.
    pub tag_m: f64,
}

/// Why an image gave no corners.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
pub enum CharucoError {
    /// No tag of the board, or too few corners near tags that are seen.
    #[error("{corners} of the board's corners are seen beside {tags} tags, at least {FEWEST} are needed")]
    TooFew {
        /// Corners found.
        corners: usize,
        /// Tags of the board seen.
        tags: usize,
    },
    /// The tags do not lie as on this board.
    #[error(
        "the tags seen do not lie as on this board: are --board, --square-m, --tag-m and --family right?"
    )]
    OtherBoard,
}

/// A tag seen and where its corners are on the board, metres from the outer corner at top left.
struct Placed {
    square: (usize, usize),
    plane_m: [Vector2<f64>; 4],
    px: [Vector2<f64>; 4],
    size_px: f64,
}

impl CharucoBoard {
    /// How many tags the board has.
    pub fn tags(&self) -> usize {
        (self.columns + 1) * (self.rows + 1) / 2
    }

    /// Squares with tags, in the order of their numbers. The first square of the board is black; with `first_white` it is
    /// white, as OpenCV drew boards with an even number of rows before its version 4.6.
    pub fn squares(&self, first_white: bool) -> impl Iterator<Item = (usize, usize)> {
        let (across, down) = (self.columns + 1, self.rows + 1);
        (0..across * down)
            .map(move |k| (k % across, k / across))
            .filter(move |(x, y)| ((x + y) % 2 == 0) == first_white)
    }

    /// The inner corners seen, with their places on the board (x right, y down, origin at the first inner corner), each in a
    /// window of at most `window_px` to each side. A part of the board will do.
    ///
    /// # Errors
    /// Where too few corners are seen, or the tags do not lie as on this board.
    pub fn find(&self, image: ImageView<'_>, window_px: f64) -> Result<PlaneView, CharucoError> {
        let limits = Limits { min_px: LEAST_PX, max_hamming: 1 };
        let seen: Vec<_> = Detector::new(&[self.family], limits).detect(image).to_vec();
        let mut best: Option<(f64, Vec<Placed>)> = None;
        for first_white in [false, true] {
            let squares: Vec<(usize, usize)> = self.squares(first_white).collect();
            let tags: Vec<Placed> = seen
                .iter()
                .filter_map(|t| {
                    let square = *squares.get(t.id as usize)?;
                    let plane_m = self.tag_corners(square);
                    Some(Placed { square, plane_m, px: t.corners_px, size_px: t.size_px })
                })
                .collect();
            let misfit = misfit_px(&view_of(tags.iter()));
            if best.as_ref().is_none_or(|b| misfit < b.0) {
                best = Some((misfit, tags));
            }
        }
        let (misfit, tags) = best.unwrap_or((f64::INFINITY, Vec::new()));
        if tags.is_empty() {
            return Err(CharucoError::TooFew { corners: 0, tags: 0 });
        }
        let smallest = tags.iter().map(|t| t.size_px).fold(f64::INFINITY, f64::min);
        // Tags elsewhere are whole squares off; a lens distorts by less.
        if !(misfit < 0.5 * smallest) {
            return Err(CharucoError::OtherBoard);
        }
        let corners = self.corners(image, &tags, window_px);
        let mut view = PlaneView { plane_m: Vec::new(), px: Vec::new() };
        for (k, px) in corners.iter().enumerate().filter_map(|(k, c)| Some((k, (*c)?))) {
            let at = Vector2::new((k % self.columns) as f64, (k / self.columns) as f64);
            view.plane_m.push(at * self.square_m);
            view.px.push(px);
        }
        if view.px.len() < FEWEST || homography(&view).is_none() {
            return Err(CharucoError::TooFew { corners: view.px.len(), tags: tags.len() });
        }
        Ok(view)
    }

    /// A tag's corners on the board: top-left, top-right, bottom-right, bottom-left, as detections list them.
    fn tag_corners(&self, (x, y): (usize, usize)) -> [Vector2<f64>; 4] {
        let margin = 0.5 * (self.square_m - self.tag_m);
        let origin = Vector2::new(x as f64, y as f64) * self.square_m + Vector2::repeat(margin);
        [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
            .map(|(x, y)| origin + Vector2::new(x, y) * self.tag_m)
    }

    /// Every inner corner beside a tag that is seen.
    fn corners(&self, image: ImageView<'_>, tags: &[Placed], window_px: f64) -> Vec<Option<Vector2<f64>>> {
        let full = FloatImage::of(image);
        let blurred = full.blurred(BLUR_PX);
        let placed = (0..self.columns * self.rows).map(|k| {
            let (column, row) = (k % self.columns, k / self.columns);
            // Of the four squares around a corner two hold tags.
            let beside = tags.iter().filter(|t| {
                (column..=column + 1).contains(&t.square.0) && (row..=row + 1).contains(&t.square.1)
            });
            let to_image = homography(&view_of(beside))?;
            let at = |x: f64, y: f64| {
                let p = to_image * (Vector2::new(x, y) * self.square_m).push(1.0);
                p.xy() / p.z
            };
            let (x, y) = ((column + 1) as f64, (row + 1) as f64);
            let expected = at(x, y);
            let (along, across) = (at(x + 0.5, y) - at(x - 0.5, y), at(x, y + 0.5) - at(x, y - 0.5));
            let square_px = along.norm().min(across.norm());
            // White to either side up to the tags' borders.
            let white = 1.0 - self.tag_m / self.square_m;
            let window = Window::square(window_px.min(full.to_border(expected) - 2.0))
                .within(along * white, across * white);
            let px = refine(&full, expected, window)?;
            let radius = (0.4 * white * square_px).max(2.0);
            let is_corner = Saddle::at(&blurred, px, radius).is_some();
            ((px - expected).norm() < MOST_ASIDE * square_px && is_corner).then_some(px)
        });
        without_strays(placed.collect(), self.columns)
    }
}

fn view_of<'a>(tags: impl Iterator<Item = &'a Placed>) -> PlaneView {
    let (plane_m, px) = tags.flat_map(|t| t.plane_m.into_iter().zip(t.px)).unzip();
    PlaneView { plane_m, px }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Rotation3, Vector3};

    use super::*;
    use crate::WINDOW_PX;
    use crate::intrinsics::{Wanted, calibrate};
    use crate::photographed_sheet::{self, camera};
    use windhover_base::geo::{LensModel, ned_from_body_321};
    use windhover_base::msg::GrayImage;
    use windhover_detect::{TagPattern, tag_pattern};

    const BOARD: CharucoBoard =
        CharucoBoard { family: TagFamily::Aruco4x4N50, columns: 7, rows: 5, square_m: 0.03, tag_m: 0.022 };

    /// Light at a point of the board, metres from its outer corner.
    fn is_dark(at: Vector2<f64>, patterns: &[(usize, usize, TagPattern)]) -> bool {
        let cell = at / BOARD.square_m;
        if !(0.0..8.0).contains(&cell.x) || !(0.0..6.0).contains(&cell.y) {
            return false;
        }
        let square = (cell.x as usize, cell.y as usize);
        let Some((_, _, pattern)) = patterns.iter().find(|(x, y, _)| (*x, *y) == square) else { return true };
        let share = BOARD.tag_m / BOARD.square_m;
        let inside = cell.map(|c| (c.fract() - 0.5) / share + 0.5) * pattern.border as f64;
        let ring = (pattern.side() - pattern.border) as f64 / 2.0;
        let inside = inside.add_scalar(ring);
        let reach = ring..pattern.side() as f64 - ring;
        let on_tag = reach.contains(&inside.x) && reach.contains(&inside.y);
        on_tag && !pattern.white(inside.x as usize, inside.y as usize)
    }

    /// A photograph of the board, and its true inner corners.
    fn photograph(
        (yaw, pitch, roll): (f64, f64, f64),
        shift: (f64, f64),
        first_white: bool,
    ) -> (GrayImage, Vec<Vector2<f64>>) {
        let patterns: Vec<(usize, usize, TagPattern)> = BOARD
            .squares(first_white)
            .enumerate()
            .map(|(id, (x, y))| (x, y, tag_pattern(BOARD.family, id as u32)))
            .collect();
        let camera = camera();
        let rotation: Rotation3<f64> = ned_from_body_321(yaw, pitch, roll);
        let translation = Vector3::new(shift.0, shift.1, 0.36) - rotation * Vector3::new(0.12, 0.09, 0.0);
        let image = photographed_sheet::photograph(&rotation, &translation, &[-0.6, -0.2, 0.2, 0.6], |at| {
            is_dark(at, &patterns)
        });
        let truth = (0..35).map(|k| {
            let at = Vector3::new((k % 7 + 1) as f64, (k / 7 + 1) as f64, 0.0) * BOARD.square_m;
            camera.project(&(rotation * at + translation)).expect("in front").px
        });
        (image, truth.collect())
    }

    #[test]
    fn a_part_of_the_board_calibrates_the_camera() {
        // Given boards of which some lie half outside the image, one drawn as older programs did.
        let poses = [
            ((0.1, 0.5, 0.0), (0.0, 0.0), false),
            ((1.6, -0.5, 0.1), (0.0, 0.0), true),
            ((-0.4, 0.1, 0.5), (0.13, 0.0), false),
            ((3.0, 0.0, -0.5), (0.0, 0.1), false),
            ((0.2, 0.4, 0.4), (-0.14, -0.08), false),
        ];
        let mut views = Vec::new();
        for (angles, shift, first_white) in poses {
            let (image, truth) = photograph(angles, shift, first_white);
            // When their corners are looked for.
            let view = BOARD.find(image.view(), WINDOW_PX).expect("a part of the board");
            // Then each is where it is, and most of those in the image are there.
            for (p, px) in view.plane_m.iter().zip(&view.px) {
                let k = (p.y / BOARD.square_m).round() * 7.0 + (p.x / BOARD.square_m).round();
                let off = (px - truth[k as usize]).norm();
                assert!(off < 0.35, "corner {k} is {off} px off");
            }
            let inside = |p: &&Vector2<f64>| p.x > 8.0 && p.y > 8.0 && p.x < 631.0 && p.y < 471.0;
            let in_image = truth.iter().filter(inside).count();
            assert!(view.px.len() * 10 >= in_image * 7, "{} of {in_image}", view.px.len());
            views.push(view);
        }
        assert!(views.iter().any(|v| v.px.len() < 25), "some are partly outside");
        let wanted = Wanted { model: LensModel::Brown, k3: false, skew: false };
        let found = calibrate(&views, 640.0, 480.0, wanted).expect("tilted enough");
        let (c, s, truth) = (&found.camera, &found.sigma, camera());
        for (k, (a, b)) in
            [(c.fx, truth.fx), (c.fy, truth.fy), (c.cx, truth.cx), (c.cy, truth.cy)].into_iter().enumerate()
        {
            assert!((a - b).abs() < 4.0 * s[k] && s[k] < 4.0, "{k}: {a} ± {}, truly {b}", s[k]);
        }
        assert!(found.rms_px < 0.15, "{}", found.rms_px);
    }

    #[test]
    fn other_boards_and_empty_images_are_refused_with_the_reason() {
        let none = CharucoError::TooFew { corners: 0, tags: 0 };
        assert_eq!(BOARD.find(GrayImage::new(320, 240).view(), WINDOW_PX), Err(none));
        let (image, _) = photograph((0.1, 0.3, 0.0), (0.0, 0.0), false);
        let other = CharucoBoard { columns: 5, rows: 7, ..BOARD };
        assert_eq!(other.find(image.view(), WINDOW_PX), Err(CharucoError::OtherBoard));
    }
}
