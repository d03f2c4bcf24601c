//! A grid of tags as calibration target: which detected corner is which point of the sheet.

use nalgebra::Vector2;

use super::zhang::{PlaneView, homography};
use windhover_base::msg::{ImageView, TagFamily};
use windhover_detect::{Detector, Limits, TagDetection, TagLayout};

/// Smallest edge of a tag that is used, pixels: corners of smaller ones are too rough.
pub(super) const LEAST_PX: f64 = 14.0;
/// Fewest tags with which an image is used: fewer tell little of the lens.
const FEWEST: usize = 3;

/// Tags numbered row by row from 0, all upright, a gap between neighbours.
///
/// ```
/// use windhover_base::msg::{GrayImage, TagFamily};
/// use windhover_calibrate::{TagGrid, TagGridError};
///
/// let grid = TagGrid { family: TagFamily::Tag36h11, columns: 6, rows: 6, tag_m: 0.088, gap_m: 0.0264 };
/// let blank = GrayImage::new(320, 280);
/// assert_eq!(grid.find(blank.view()), Err(TagGridError::TooFew { found: 0, wanted: 36 }));
/// ```
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct TagGrid {
    /// Family of the tags.
    pub family: TagFamily,
    /// Tags in a row.
    pub columns: usize,
    /// Rows.
    pub rows: usize,
    /// Edge of a tag's border, the same square as in the configuration, metres.
    pub tag_m: f64,
    /// From a tag's border to the next one's, metres.
    pub gap_m: f64,
}

/// Why an image gave no grid.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
pub enum TagGridError {
    /// No tag, or too few.
    #[error("{found} of the grid's {wanted} tags are visible, at least {FEWEST} are needed")]
    TooFew {
        /// Tags of the grid seen.
        found: usize,
        /// Tags of the grid.
        wanted: usize,
    },
    /// The arrangement of the tags is not that of the grid.
    #[error("the visible tags are not in a grid of {columns}x{rows}: is --board right?")]
    OtherGrid {
        /// Requested columns.
        columns: usize,
        /// Requested rows.
        rows: usize,
    },
}

impl TagGrid {
    /// The corners of every visible tag, with their places on the sheet (x right, y down, origin at the first corner of
    /// the tag at top left). A part of the grid is sufficient.
    ///
    /// Borders of one cell and of two, as Kalibr prints them, are both tried: more tags of a sheet are found with its
    /// own border.
    ///
    /// Numbers may count from the top row down or, as Kalibr prints them, from the bottom row up: the one that agrees
    /// with the image is used.
    ///
    /// # Errors
    /// Too few tags of the grid are visible, or their arrangement is not that of the grid.
    pub fn find(&self, image: ImageView<'_>) -> Result<PlaneView, TagGridError> {
        let limits = Limits { min_px: LEAST_PX, max_hamming: 1 };
        let [narrow, wide] = [1, 2].map(|border| {
            let layout = TagLayout { border, ..self.family.into() };
            Detector::new(&[layout], limits).detect(image).to_vec()
        });
        let seen = if wide.len() > narrow.len() { wide } else { narrow };
        let wanted = self.columns * self.rows;
        let tags: Vec<(usize, [Vector2<f64>; 4])> = seen.iter().filter_map(|m| self.tag_of(m)).collect();
        let mut numbers: Vec<usize> = tags.iter().map(|t| t.0).collect();
        numbers.sort_unstable();
        numbers.dedup();
        if numbers.len() < FEWEST || numbers.len() < tags.len() {
            return Err(TagGridError::TooFew { found: numbers.len(), wanted });
        }
        let other = TagGridError::OtherGrid { columns: self.columns, rows: self.rows };
        let ways = [false, true].map(|from_below| self.view(&tags, from_below));
        let misfits = ways.each_ref().map(misfit_px);
        let best = usize::from(misfits[1] < misfits[0]);
        // Half a tag away is another place on the sheet; distortion of a lens stays far below that.
        let size = seen.iter().map(|m| m.size_px).fold(f64::INFINITY, f64::min);
        if !(misfits[best] < 0.25 * size) {
            return Err(other);
        }
        let [down, up] = ways;
        Ok(if best == 0 { down } else { up })
    }

    fn tag_of(&self, seen: &TagDetection) -> Option<(usize, [Vector2<f64>; 4])> {
        let number = seen.id as usize;
        (number < self.columns * self.rows).then_some((number, seen.corners_px))
    }

    fn view(&self, tags: &[(usize, [Vector2<f64>; 4])], from_below: bool) -> PlaneView {
        let pitch = self.tag_m + self.gap_m;
        let mut view = PlaneView { plane_m: Vec::new(), px: Vec::new() };
        for (number, corners) in tags {
            let (column, row) = (number % self.columns, number / self.columns);
            let row = if from_below { self.rows - 1 - row } else { row };
            let origin = Vector2::new(column as f64, row as f64) * pitch;
            // Top-left, top-right, bottom-right, bottom-left, as detections list them.
            let places = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)];
            view.plane_m.extend(places.map(|(x, y)| origin + Vector2::new(x, y) * self.tag_m));
            view.px.extend(corners);
        }
        view
    }
}

/// Root of the mean squared distance to where the best homography puts the points, pixels.
pub(super) fn misfit_px(view: &PlaneView) -> f64 {
    let Some(h) = homography(view) else { return f64::INFINITY };
    let squared = view.plane_m.iter().zip(&view.px).map(|(p, px)| {
        let at = h * p.push(1.0);
        (at.xy() / at.z - px).norm_squared()
    });
    (squared.sum::<f64>() / view.px.len().max(1) as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use std::sync::LazyLock;

    use nalgebra::Vector3;

    use super::*;
    use crate::intrinsics::{Wanted, calibrate};
    use crate::photographed_sheet::{self, camera};
    use windhover_base::geo::{LensModel, ned_from_body_321};
    use windhover_base::msg::GrayImage;
    use windhover_detect::{TagPattern, tag_pattern};

    const GRID: TagGrid =
        TagGrid { family: TagFamily::Tag36h11, columns: 5, rows: 4, tag_m: 0.04, gap_m: 0.012 };

    static PATTERNS: LazyLock<Vec<TagPattern>> =
        LazyLock::new(|| (0..20).map(|id| tag_pattern(GRID.family, id)).collect());

    /// Whether the sheet is dark at a point; with `from_below` numbers count from the bottom row up.
    fn is_dark(at: Vector2<f64>, from_below: bool) -> bool {
        let pitch = GRID.tag_m + GRID.gap_m;
        let (c, r) = ((at.x / pitch).floor(), (at.y / pitch).floor());
        if !(0.0..GRID.columns as f64).contains(&c) || !(0.0..GRID.rows as f64).contains(&r) {
            return false;
        }
        let row = if from_below { GRID.rows - 1 - r as usize } else { r as usize };
        let pattern = &PATTERNS[row * GRID.columns + c as usize];
        let inside = (at - Vector2::new(c, r) * pitch) / GRID.tag_m * pattern.border as f64;
        let pad = (pattern.side() - pattern.border) as f64 / 2.0;
        let cell = inside.add_scalar(pad);
        let reach = 0.0..pattern.side() as f64;
        let on_print = reach.contains(&cell.x) && reach.contains(&cell.y);
        on_print && !pattern.white(cell.x as usize, cell.y as usize)
    }

    fn photograph(yaw: f64, pitch: f64, roll: f64, shift: Vector2<f64>, from_below: bool) -> GrayImage {
        let rotation = ned_from_body_321(yaw, pitch, roll);
        let middle = Vector3::new(0.124, 0.098, 0.0);
        let translation = Vector3::new(shift.x, shift.y, 0.44) - rotation * middle;
        photographed_sheet::photograph(&rotation, &translation, &[-0.5, 0.0, 0.5], |at| {
            is_dark(at, from_below)
        })
    }

    #[test]
    fn a_grid_calibrates_the_camera_whichever_way_it_is_numbered_and_only_partly_seen() {
        // Given photographs of both kinds of print, one with the sheet partly outside.
        let photos = [
            photograph(0.1, 0.5, 0.0, Vector2::zeros(), false),
            photograph(1.6, -0.5, 0.1, Vector2::zeros(), false),
            photograph(-0.4, 0.1, 0.5, Vector2::new(0.02, 0.0), true),
            photograph(3.0, 0.0, -0.5, Vector2::zeros(), true),
            photograph(0.2, 0.4, 0.4, Vector2::new(0.15, 0.08), true),
        ];
        // When the camera is calibrated with them.
        let views: Vec<PlaneView> = photos.iter().map(|p| GRID.find(p.view()).expect("tags")).collect();
        let found =
            calibrate(&views, 640.0, 480.0, Wanted { model: LensModel::Brown, k3: false, skew: false })
                .expect("tilted enough");
        // Then it is found within its own sigmas.
        assert!(views[4].px.len() < views[0].px.len(), "the last is partly outside");
        let truth = camera();
        let (c, s) = (&found.camera, &found.sigma);
        for (k, (a, b)) in
            [(c.fx, truth.fx), (c.fy, truth.fy), (c.cx, truth.cx), (c.cy, truth.cy)].into_iter().enumerate()
        {
            assert!((a - b).abs() < 4.0 * s[k] && s[k] < 3.0, "{k}: {a} ± {}, truly {b}", s[k]);
        }
        assert!(found.rms_px < 0.15, "{}", found.rms_px);
    }

    #[test]
    fn other_boards_and_empty_images_are_refused_with_the_reason() {
        let blank = GrayImage::new(320, 240);
        assert_eq!(GRID.find(blank.view()), Err(TagGridError::TooFew { found: 0, wanted: 20 }));
        let photo = photograph(0.1, 0.3, 0.0, Vector2::zeros(), false);
        let other = TagGrid { columns: 4, rows: 5, ..GRID };
        assert_eq!(other.find(photo.view()), Err(TagGridError::OtherGrid { columns: 4, rows: 5 }));
    }
}
