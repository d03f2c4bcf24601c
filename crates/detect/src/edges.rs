//! Straight edges of a quadrilateral, fitted to where the image steps from dark to light.

use super::quad::{Line, Point, Quad, bilinear, corners_of, distance};
use windhover_base::msg::ImageView;

/// Most points taken along a side.
const MOST_POINTS: usize = 24;

/// Parameters of the search for an edge.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct EdgeSearch {
    /// How far from the side given, pixels.
    pub reach: f32,
    /// Smallest step that is accepted, grey levels.
    pub least_step: f32,
}

/// Fits all four sides; `None` where one has too few steps or the sides no longer make a quadrilateral.
pub(super) fn fit_sides(image: ImageView<'_>, quad: &Quad, search: EdgeSearch) -> Option<Quad> {
    let mut lines = [Line { n: [0.0; 2], c: 0.0 }; 4];
    for i in 0..4 {
        lines[i] = fit_side(image, quad[i], quad[(i + 1) % 4], search)?;
    }
    let fitted = corners_of(&lines)?;
    let far = 2.0 * search.reach + 1.0;
    (0..4).all(|i| distance(fitted[i], quad[i]) <= far).then_some(fitted)
}

/// One step: how far along the side, how far outside it, how strong.
#[derive(Clone, Copy, Default)]
struct Step {
    t: f32,
    offset: f32,
    weight: f32,
}

fn fit_side(image: ImageView<'_>, a: Point, b: Point, search: EdgeSearch) -> Option<Line> {
    let length = distance(a, b);
    let count = ((length * 0.8) as usize).clamp(6, MOST_POINTS);
    let n = Line::through(a, b).n;
    let mut steps = [Step::default(); MOST_POINTS];
    let mut found = 0;
    for k in 0..count {
        let t = 0.1 + 0.8 * (k as f32 + 0.5) / count as f32;
        let at = [a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])];
        if let Some((offset, weight)) = step_across(image, at, n, search) {
            steps[found] = Step { t: t - 0.5, offset, weight };
            found += 1;
        }
    }
    if found * 2 < count {
        return None;
    }
    let steps = &mut steps[..found];
    let (mut at_middle, mut slope) = fit(steps)?;
    for _ in 0..2 {
        // Cauchy weights at half a pixel: an object that touches a side must not move it.
        let weighed = |s: &Step| {
            let r = (s.offset - at_middle - slope * s.t) * 2.0;
            Step { weight: s.weight / (1.0 + r * r), ..*s }
        };
        let mut again = [Step::default(); MOST_POINTS];
        again.iter_mut().zip(steps.iter()).for_each(|(to, s)| *to = weighed(s));
        (at_middle, slope) = fit(&again[..found])?;
    }
    let offset = |end: f32, p: Point| {
        let d = at_middle + slope * end;
        [p[0] + d * n[0], p[1] + d * n[1]]
    };
    Some(Line::through(offset(-0.5, a), offset(0.5, b)))
}

/// Weighted line `offset = c + s t`.
fn fit(steps: &[Step]) -> Option<(f32, f32)> {
    let (mut w, mut wt, mut wtt, mut wo, mut wto) = (0.0f32, 0.0f32, 0.0f32, 0.0f32, 0.0f32);
    for s in steps {
        w += s.weight;
        wt += s.weight * s.t;
        wtt += s.weight * s.t * s.t;
        wo += s.weight * s.offset;
        wto += s.weight * s.t * s.offset;
    }
    let det = w * wtt - wt * wt;
    (det > 1e-6 * w * w).then(|| ((wo * wtt - wto * wt) / det, (w * wto - wt * wo) / det))
}

/// Where along `n` the image steps up most, and by how much: the centre of mass of the three gradients
/// around the strongest.
fn step_across(image: ImageView<'_>, at: Point, n: Point, search: EdgeSearch) -> Option<(f32, f32)> {
    const MOST: usize = 18;
    let half = (search.reach.ceil() as usize + 1).min(MOST / 2 - 1);
    let mut values = [0.0f32; MOST];
    let count = 2 * half + 1;
    for (k, value) in values.iter_mut().enumerate().take(count) {
        let d = k as f32 - half as f32;
        *value = bilinear(image, [at[0] + d * n[0], at[1] + d * n[1]]);
    }
    let gradient = |k: usize| values[k + 1] - values[k];
    let (mut best, mut most) = (0, 0.0);
    for k in 1..count - 2 {
        // Two pixels wide, so that a blurred edge is not lost in noise.
        let g = gradient(k) + 0.5 * (gradient(k - 1) + gradient(k + 1));
        if g > most {
            (best, most) = (k, g);
        }
    }
    if most < search.least_step {
        return None;
    }
    let g = [gradient(best - 1).max(0.0), gradient(best).max(0.0), gradient(best + 1).max(0.0)];
    let mass = g[0] + g[1] + g[2];
    let offset = best as f32 + 0.5 + (g[2] - g[0]) / mass - half as f32;
    Some((offset, mass))
}
