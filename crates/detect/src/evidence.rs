//! Whether a tag is where a fit has it: its outline and its cells, looked for in the image once more.
//!
//! Cells can be read right from a quadrilateral that is not the tag's: the border of two cells that Kalibr prints
//! has another square inside it, and a fit may take hold of what is beside a tag. Then the step from ring to border
//! is not where the corners say.

use nalgebra::Vector2;

use super::family::{Family, Word};
use super::homography::{Homography, narrow};
use super::pyramid::{Level, Pyramid};
use super::quad::bilinear;
use windhover_base::msg::ImageView;

/// How far from the border's edge the steps of light are looked at, and from one to the next, cells.
const REACH: f64 = 0.75;
const STEPS: usize = 10;
const SPACING: f64 = 2.0 * REACH / STEPS as f64;

/// Farthest that the steepest step of a side may be from where the corners have it, cells; and inwards where white is
/// over-exposed and has spread.
const FARTHEST: f64 = 0.32;
const FARTHEST_INWARDS: f64 = 0.65;
const OVER_EXPOSED: f32 = 248.0;

/// Least step across a side, as a share of its own light, over that of the tag's cells.
const LEAST_STEP: f32 = 0.3;

/// How far from an edge between cells its two sides are looked at, cells; the least step, over that of the tag's cells;
/// and
/// what share of the edges there must be, more where bits were read wrong.
const BESIDE: f64 = 0.3;
const LEAST_INNER_STEP: f32 = 0.4;
const ENOUGH_EDGES: f32 = 0.7;
const MORE_A_WRONG_BIT: f32 = 0.05;

/// Share of a side's cells into which light must step down.
const ENOUGH_OF_A_SIDE: f32 = 0.7;

/// Whether light steps down into the border along each of its sides, as it does between the tag's own cells and where
/// the corners say.
pub(super) fn is_there(
    image: ImageView<'_>,
    pyramid: &Pyramid,
    corners: &[Vector2<f64>; 4],
    family: &Family,
    word: &Word,
) -> bool {
    let width = family.width as f64;
    let Some(h) = Homography::of_square(width, &corners.map(|c| [c.x, c.y])) else { return false };
    let level = pyramid.for_size(image, narrowest_cell(corners, width), 3.0);
    let (mut light, mut dark) = ((0.0, 0.0f32), (0.0, 0.0f32));
    for (cell, &(x, y)) in family.cells.iter().enumerate() {
        let sum = if family.bit(word.id, cell) { &mut light } else { &mut dark };
        *sum = (sum.0 + sample(level, &h, f64::from(x) + 0.5, f64::from(y) + 0.5), sum.1 + 1.0);
    }
    let (light, dark) = (light.0 / light.1.max(1.0), dark.0 / dark.1.max(1.0));
    let contrast = (light - dark) / light.max(1.0);
    contrast > 0.0
        && (0..4).all(|side| has_edge(&profile(level, &h, family.width, side), LEAST_STEP * contrast))
        && (light > OVER_EXPOSED || {
            // What has bloomed has no edge at its place.
            let least = LEAST_INNER_STEP * contrast;
            (0..4).all(|side| has_steps(level, &h, family.width, side, least))
                && has_cells(level, &h, family, word, least)
        })
}

/// Whether most edges between the border's and the data's cells are where they belong: light steps by a share `least`
/// of itself across them.
fn has_cells(level: Level<'_>, h: &Homography, family: &Family, word: &Word, least: f32) -> bool {
    let w = family.width as i32;
    let (mut seen, mut all) = (0u32, 0u32);
    for (x, y, axis) in (0..w).flat_map(|y| (1..w).flat_map(move |x| [(x, y, 0), (x, y, 1)])) {
        // Between cells x − 1 and x of row y, or where rows and columns change places, of column y.
        let cell = |x: i32| if axis == 0 { (x, y) } else { (y, x) };
        let is_light = |x: i32| family.is_light(word.id, cell(x).0, cell(x).1) == Some(true);
        let (before, after) = (is_light(x - 1), is_light(x));
        if before == after {
            continue;
        }
        let at = |beside: f64| {
            let (along, across) = (f64::from(y) + 0.5, f64::from(x) + beside);
            let (x, y) = if axis == 0 { (across, along) } else { (along, across) };
            sample(level, h, x, y)
        };
        let towards = if after { BESIDE } else { -BESIDE };
        let (light, dark) = (at(towards), at(-towards));
        all += 1;
        seen += u32::from(light - dark > least * light);
    }
    let enough = ENOUGH_EDGES + MORE_A_WRONG_BIT * f32::from(word.hamming);
    seen as f32 >= enough * all as f32
}

/// Light beside border cell `k` of a side, `out` cells outside its edge.
fn beside(level: Level<'_>, h: &Homography, width: usize, side: usize, k: usize, out: f64) -> f32 {
    let (w, along) = (width as f64, k as f64 + 0.5);
    let (x, y) = [(along, -out), (w + out, along), (along, w + out), (-out, along)][side];
    sample(level, h, x, y)
}

/// Mean light along a side, from inside to outside.
fn profile(level: Level<'_>, h: &Homography, width: usize, side: usize) -> [f32; STEPS + 1] {
    std::array::from_fn(|step| {
        let out = step as f64 * SPACING - REACH;
        (0..width).map(|k| beside(level, h, width, side, k, out)).sum::<f32>() / width as f32
    })
}

/// Whether light steps down into most cells of a side by a share `least` of itself: a side that is right at one end
/// only has a mean step too.
fn has_steps(level: Level<'_>, h: &Homography, width: usize, side: usize, least: f32) -> bool {
    let steps = (0..width).filter(|&k| {
        let at = |out: f64| beside(level, h, width, side, k, out);
        at(BESIDE) - at(-BESIDE) > least * at(BESIDE)
    });
    steps.count() as f32 >= ENOUGH_OF_A_SIDE * width as f32
}

/// Whether a profile steps up by a share `least` of its light, most steeply where the edge is.
fn has_edge(profile: &[f32; STEPS + 1], least: f32) -> bool {
    // Two spacings wide: what is between two samples is seen by both.
    let steep = |k: usize| profile[k + 1] - profile[k - 1];
    let (mut at, mut most) = (1, f32::MIN);
    for k in 1..STEPS {
        if steep(k) > most {
            (at, most) = (k, steep(k));
        }
    }
    let offset = at as f64 * SPACING - REACH;
    let inside = profile[..=STEPS / 2].iter().copied().fold(f32::MAX, f32::min);
    let outside = profile[STEPS / 2..].iter().copied().fold(0.0, f32::max);
    let inwards = if outside > OVER_EXPOSED { FARTHEST_INWARDS } else { FARTHEST };
    outside - inside > least * outside && (-inwards..=FARTHEST).contains(&offset)
}

/// The narrow way across a cell, pixels.
fn narrowest_cell(corners: &[Vector2<f64>; 4], width: f64) -> f32 {
    let sides: [Vector2<f64>; 4] = std::array::from_fn(|i| corners[(i + 1) % 4] - corners[i]);
    let area = 0.5 * (corners[2] - corners[0]).perp(&(corners[3] - corners[1])).abs();
    let longest = sides.iter().map(|s| s.norm()).fold(1.0, f64::max);
    (area / longest / width) as f32
}

fn sample(level: Level<'_>, h: &Homography, x: f64, y: f64) -> f32 {
    bilinear(level.image, narrow(h.apply(x, y)).map(|c| level.of_frame(c)))
}
