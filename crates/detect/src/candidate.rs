//! A candidate: a quadrilateral that may be a tag's border. Its sides are fitted, its cells read, its corners refined.

use nalgebra::{Matrix2, Vector2};

use super::detection::TagDetection;
use super::edges::{EdgeSearch, fit_sides};
use super::family::{Family, Word};
use super::payload;
use super::pyramid::{Level, Pyramid};
use super::quad::{Quad, distance, looks_like_tag, polygon_area};
use super::refine::Refiner;
use super::tag_model::Refined;
use windhover_base::msg::{ImageView, TagFamily};

/// A decoded tag.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct Found {
    family: TagFamily,
    word: Word,
    margin: f32,
    /// As found, in the tag's own order.
    pub corners: Quad,
    refined: Refined,
}

/// A quadrilateral of a level, in frame coordinates, with its sides fitted to the image; `None` where the
/// image does not step from dark to light along them.
pub(super) fn straighten(level: Level<'_>, quad: &Quad, gate: u8, least_share: f32) -> Option<Quad> {
    // Seen aslant, a cell is narrower one way than the other.
    let narrow = polygon_area(quad) / longest_edge(quad).max(1.0);
    let least_step = f32::from(gate) / 3.0;
    if !looks_like_tag(level.image, quad, (narrow / 16.0).clamp(0.8, 4.0), least_step, least_share) {
        return None;
    }
    let search = EdgeSearch { reach: (narrow / 8.0).clamp(1.0, 3.0), least_step };
    let quad = fit_sides(level.image, quad, search)?;
    Some(quad.map(|p| p.map(|c| level.to_frame(c))))
}

fn longest_edge(quad: &Quad) -> f32 {
    (0..4).map(|i| distance(quad[i], quad[(i + 1) % 4])).fold(0.0, f32::max)
}

/// The tag that a quadrilateral given in frame coordinates holds, its corners refined; `None` where it holds none, or where
/// the fit shows that its corners are not where the print is. `noise` is that of a pixel, grey levels.
pub(super) fn decode(
    image: ImageView<'_>,
    pyramid: &Pyramid,
    quad: &Quad,
    family: &Family,
    (refiner, noise): (&mut Refiner, f32),
) -> Option<Found> {
    let reading = payload::read(image, pyramid, quad, family)?;
    let word = reading.word;
    let corners: Quad = std::array::from_fn(|i| quad[(i + word.turns) % 4]);
    let spreads = reading.is_over_exposed;
    let refined = match refiner.refine(image, &corners, (family, word.id), spreads, f64::from(noise)) {
        Some(refined) => refined,
        // No fit near these corners, and wrong bits: a corner was drawn to something beside the tag.
        None if word.hamming > 0 => return None,
        None => unrefined(&corners),
    };
    let fitted = refined.corners.map(|c| [c.x as f32, c.y as f32]);
    if !payload::agrees(image, pyramid, &fitted, family, word.id) {
        return None;
    }
    Some(Found { family: family.family, word, margin: reading.margin, corners, refined })
}

/// Corners as the coarse fit left them: good to about a tenth of a cell.
fn unrefined(corners: &Quad) -> Refined {
    let corners = corners.map(|p| Vector2::new(f64::from(p[0]), f64::from(p[1])));
    let sigma = 0.5 + 0.01 * (corners[2] - corners[0]).norm();
    let cov = Matrix2::identity() * sigma * sigma;
    let center = corners.iter().sum::<Vector2<f64>>() / 4.0;
    Refined { corners, corner_cov: [cov; 4], center, center_cov: cov / 2.0 }
}

/// From where on, over the outer one, a tag is no other inside it: 48h12 leaves two of its ten cells free.
const NESTED: f32 = 0.5;

/// Whether two quadrilaterals are of one tag, the first of one that was found: neither one inside it nor one around it.
pub(super) fn same_place(a: &Quad, b: &Quad) -> bool {
    let centre = |q: &Quad| [0, 1].map(|k| q.iter().map(|p| p[k]).sum::<f32>() / 4.0);
    let size = |q: &Quad| distance(q[0], q[2]) + distance(q[1], q[3]);
    distance(centre(a), centre(b)) < 0.2 * distance(a[0], a[2])
        && size(b) > NESTED * size(a)
        && size(a) > NESTED * size(b)
}

/// A tag as it is output.
pub(super) fn detection(found: &Found) -> TagDetection {
    let refined = &found.refined;
    let corners = refined.corners;
    TagDetection {
        family: found.family,
        id: found.word.id,
        hamming: found.word.hamming,
        margin: found.margin,
        center_px: refined.center,
        center_cov_px2: refined.center_cov,
        corners_px: corners,
        corner_cov_px2: refined.corner_cov,
        size_px: (0..4).map(|i| (corners[i] - corners[(i + 1) % 4]).norm()).sum::<f64>() / 4.0,
    }
}

#[cfg(test)]
mod tests {
    use windhover_base::msg::GrayImage;

    use super::*;
    use crate::pyramid::{Base, Rim};
    use crate::simd::Simd;
    use crate::tag_pattern;

    /// Tag 34 with cells of 9 px, its border's corner at (50, 50), and a dark square at each corner of its ring, as on
    /// Kalibr's sheets.
    fn sheet() -> GrayImage {
        let (pattern, side) = (tag_pattern(TagFamily::Tag36h11, 34), 180);
        let is_light = |u: i32, v: i32| {
            let [x, y] = [u, v].map(|c| (c - 41).div_euclid(9));
            let last = pattern.side() as i32 - 1;
            let [in_x, in_y] = [x, y].map(|c| (0..=last).contains(&c));
            let is_square = [x, y].iter().all(|c| [0, last].contains(c));
            !is_square && (!(in_x && in_y) || pattern.white(x as usize, y as usize))
        };
        let pixels = (0..side * side).map(|i| if is_light(i % side, i / side) { 200 } else { 30 });
        GrayImage::from_vec(side as usize, side as usize, pixels.collect()).expect("size")
    }

    #[test]
    fn a_corner_drawn_to_something_beside_the_tag_is_not_output_with_wrong_bits() {
        let (image, mut pyramid) = (sheet(), Pyramid::default());
        pyramid.build(image.view(), Base::Half, Rim::Kept, 16, Simd::best());
        let family = Family::new(TagFamily::Tag36h11.into(), 2);
        let mut refiner = Refiner::new(Simd::best());
        let (near, far) = (49.5, 121.5);
        let mut doubtful = 0;
        for k in 0..40 {
            // One corner farther and farther outwards, its neighbours inwards.
            let out = k as f32;
            let quad = [
                [near + 0.1 * out, near + 0.2 * out],
                [far + out, near - out],
                [far - 0.2 * out, far],
                [near, far - 0.1 * out],
            ];
            let Some(reading) = payload::read(image.view(), &pyramid, &quad, &family) else { continue };
            doubtful += u32::from(reading.word.hamming > 0);
            let Some(found) = decode(image.view(), &pyramid, &quad, &family, (&mut refiner, 1.0)) else {
                continue;
            };
            let tag = detection(&found);
            let true_corners = [[near, near], [far, near], [far, far], [near, far]];
            for (seen, truth) in tag.corners_px.iter().zip(true_corners) {
                let off = (seen.x - f64::from(truth[0])).hypot(seen.y - f64::from(truth[1]));
                assert!(off < 0.2 || tag.hamming == 0, "{off} px off, corner drawn out by {out} px");
            }
        }
        assert!(doubtful > 0, "some are read with wrong bits");
    }
}
