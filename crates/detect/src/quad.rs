//! Quadrilaterals from the outlines of dark regions, and quick tests that refuse most of them.

use super::components::{Component, Outline};
use windhover_base::msg::ImageView;

/// A point (u, v), pixels.
pub(super) type Point = [f32; 2];

/// Corners of a quadrilateral, clockwise as seen (u right, v down).
pub(super) type Quad = [Point; 4];

/// Range of sizes that are searched in one level, pixels of that level.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct SizeLimits {
    /// Smallest mean edge.
    pub least: f32,
    /// Largest mean edge.
    pub most: f32,
}

/// Shortest side over longest with which a square can still be decoded: 80° off its normal, and blur.
const LEAST_ASPECT: f32 = 0.13;

/// Narrowest width across a border, pixels of a level, that is accepted whatever the least edge is, for tags seen at an
/// angle.
const LEAST_SHORT: f32 = 5.0;

/// Largest share of its hull that a border, with the dark cells connected to it, covers.
const MOST_FILL: f32 = 0.93;

/// Fewest times that a row of a border is crossed, in the mean: it is twice except in the rows above and below the
/// inside.
const LEAST_CROSSINGS: f32 = 1.3;

/// Whether a component can be a tag's border, by box and area alone.
pub(super) fn may_be_border(c: &Component, limits: SizeLimits, width: usize, height: usize) -> bool {
    let (w, h) = (c.width() as f32, c.height() as f32);
    let (short, long) = (w.min(h), w.max(h));
    // A square's box is 1 to √2 of its edge; blur and threshold may remove a pixel. A tag of the least size seen at an
    // angle is shorter in one direction and longer in the other.
    let size_fits = long + 1.0 >= limits.least && short <= 1.5 * limits.most;
    let is_wide = short + 1.0 >= 0.55 * limits.least || (short >= LEAST_SHORT && long >= 1.6 * limits.least);
    let shape_fits = is_wide && short >= 0.6 * LEAST_ASPECT * long;
    // A border is a quarter to a half of its tag; of a large one only a rim is dark compared with its surroundings.
    let area = c.area as f32;
    let fill_fits = area >= (0.17 * w * h).min(2.0 * (w + h)) && area <= MOST_FILL * w * h;
    // Pebbles are crossed once.
    let is_open = c.runs as f32 >= LEAST_CROSSINGS * h;
    let inside =
        c.left > 0 && c.top > 0 && usize::from(c.right) + 1 < width && usize::from(c.bottom) + 1 < height;
    size_fits && shape_fits && fill_fits && is_open && inside
}

/// Finds quadrilaterals in outlines; reuses its buffers.
#[derive(Clone, Debug, Default)]
pub(super) struct QuadFinder {
    hull: Vec<Point>,
}

impl QuadFinder {
    /// The quadrilateral that approximates a component's hull, half a pixel outside the centres of its outermost
    /// pixels; `None` where the hull has another shape.
    pub fn quad(&mut self, component: &Component, outline: Outline<'_>, limits: SizeLimits) -> Option<Quad> {
        // Most components are solid; their rows alone show it: a tag has light cells inside, at least a seventh of its
        // square.
        let rows: u32 = outline.iter().map(|(left, right)| u32::from(right - left) + 1).sum();
        if component.area as f32 > MOST_FILL * rows as f32 {
            return None;
        }
        self.find_hull(component, outline);
        let hull_area = polygon_area(&self.hull);
        // The area that its pixels cover, not only that between their centres.
        let perimeter = perimeter(&self.hull);
        let covered = hull_area + 1.0 + 0.5 * perimeter;
        if covered < 0.5 * limits.least * limits.least {
            return None;
        }
        // Corners are rounded by about a pixel, acute ones by more: allow for their area, and a tenth for bent edges.
        let blunt = 0.375 * perimeter * perimeter / hull_area.max(1.0);
        let enough = (0.9 * hull_area - blunt).max(6.0);
        let inscribed = largest_quad(&self.hull).filter(|quad| polygon_area(quad) >= enough);
        let quad = grow(&inscribed.or_else(|| blunt_rectangle(&self.hull, hull_area))?, 0.5)?;
        let sides: [f32; 4] = std::array::from_fn(|i| distance(quad[i], quad[(i + 1) % 4]));
        let longest = sides.iter().fold(0.0, |a: f32, &b| a.max(b));
        let shortest = sides.iter().fold(f32::MAX, |a, &b| a.min(b));
        (shortest >= LEAST_ASPECT * longest).then_some(quad)
    }

    /// Convex hull, clockwise: down the right side, up the left.
    fn find_hull(&mut self, component: &Component, outline: Outline<'_>) {
        self.hull.clear();
        let rows = outline.iter().enumerate();
        let points = |pick: fn(&(u16, u16)) -> u16| {
            rows.clone().map(move |(i, lr)| [f32::from(pick(lr)), (usize::from(component.top) + i) as f32])
        };
        for point in points(|lr| lr.1) {
            push_hull(&mut self.hull, 0, point);
        }
        let turn = self.hull.len();
        for point in points(|lr| lr.0).rev() {
            push_hull(&mut self.hull, turn, point);
        }
    }
}

/// Adds a point to a convex chain that starts at `from`.
fn push_hull(hull: &mut Vec<Point>, from: usize, point: Point) {
    while hull.len() >= from + 2 && cross(hull[hull.len() - 2], hull[hull.len() - 1], point) <= 0.0 {
        hull.pop();
    }
    hull.push(point);
}

/// Twice the signed area of a triangle: positive where `c` is to the right of `a → b` as seen.
fn cross(a: Point, b: Point, c: Point) -> f32 {
    (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
}

pub(super) fn distance(a: Point, b: Point) -> f32 {
    let (du, dv) = (a[0] - b[0], a[1] - b[1]);
    (du * du + dv * dv).sqrt()
}

/// Area of a polygon, positive where its points run clockwise as seen.
pub(super) fn polygon_area(points: &[Point]) -> f32 {
    let Some(&last) = points.last() else { return 0.0 };
    let mut previous = last;
    let mut sum = 0.0;
    for &p in points {
        sum += previous[0] * p[1] - previous[1] * p[0];
        previous = p;
    }
    0.5 * sum
}

fn perimeter(points: &[Point]) -> f32 {
    let Some(&last) = points.last() else { return 0.0 };
    let mut previous = last;
    points.iter().map(|&p| distance(std::mem::replace(&mut previous, p), p)).sum()
}

/// The largest quadrilateral with corners among hull points: the farthest point from the middle, the farthest from
/// that, the farthest to either side; then each corner in turn moves to where it adds the largest area.
fn largest_quad(hull: &[Point]) -> Option<Quad> {
    if hull.len() < 4 {
        return None;
    }
    let n = hull.len() as f32;
    let middle = hull.iter().fold([0.0, 0.0], |m: Point, p| [m[0] + p[0] / n, m[1] + p[1] / n]);
    let a = farthest(hull, |p| distance(p, middle));
    let c = farthest(hull, |p| distance(p, a));
    let b = farthest(hull, |p| -cross(a, c, p));
    let d = farthest(hull, |p| cross(a, c, p));
    let mut quad = [a, b, c, d];
    for _ in 0..2 {
        for i in 0..4 {
            let (before, after) = (quad[(i + 3) % 4], quad[(i + 1) % 4]);
            quad[i] = farthest(hull, |p| -cross(before, after, p));
        }
    }
    let convex = (0..4).all(|i| cross(quad[i], quad[(i + 1) % 4], quad[(i + 2) % 4]) > 0.0);
    convex.then_some(quad)
}

/// Area that blur takes off the four corners of a small tag, px², and the largest share of the whole that it may be.
const BLUNT_AREA: f32 = 24.0;
const BLUNT_SHARE: f32 = 0.25;

/// Square of the least length, relative to the longest, of a hull's side that may be a rectangle's side.
const LONG_SQUARED: f32 = 0.3;

/// The smallest rectangle around a hull, where the hull fills it except its corners: motion and blur round those of a
/// small tag off by several pixels, and no four points of the hull are near them.
fn blunt_rectangle(hull: &[Point], hull_area: f32) -> Option<Quad> {
    let mut best: Option<(f32, Quad)> = None;
    // One of its sides is along one of the hull's; short sides of the hull belong to corners.
    let side = |i: usize| (hull[i], hull[(i + 1) % hull.len()]);
    let square = |(a, b): (Point, Point)| (a[0] - b[0]) * (a[0] - b[0]) + (a[1] - b[1]) * (a[1] - b[1]);
    let longest = (0..hull.len()).map(|i| square(side(i))).fold(0.0, f32::max);
    for (a, b) in (0..hull.len()).map(side).filter(|&ab| square(ab) >= LONG_SQUARED * longest) {
        let n = Line::through(a, b).n;
        // `n` points out of the side, and the next side of a clockwise rectangle out along this one.
        let t = [-n[1], n[0]];
        let dot = |p: Point, d: Point| p[0] * d[0] + p[1] * d[1];
        let (out, mut inner) = (dot(a, n), f32::MAX);
        let (mut back, mut ahead) = (f32::MAX, f32::MIN);
        for &p in hull {
            inner = inner.min(dot(p, n));
            (back, ahead) = (back.min(dot(p, t)), ahead.max(dot(p, t)));
        }
        let area = (out - inner) * (ahead - back);
        if best.is_none_or(|b| area < b.0) {
            let corner = |x: f32, y: f32| [x * t[0] + y * n[0], x * t[1] + y * n[1]];
            best = Some((
                area,
                [corner(back, out), corner(ahead, out), corner(ahead, inner), corner(back, inner)],
            ));
        }
    }
    let (area, quad) = best?;
    let lost = area - hull_area;
    (area > 6.0 && lost <= BLUNT_AREA + 0.05 * area && lost <= BLUNT_SHARE * area).then_some(quad)
}

fn farthest(hull: &[Point], measure: impl Fn(Point) -> f32) -> Point {
    let mut best = (hull[0], f32::MIN);
    for &p in hull {
        let m = measure(p);
        if m > best.1 {
            best = (p, m);
        }
    }
    best.0
}

/// Moves every side outwards by `by` pixels.
pub(super) fn grow(quad: &Quad, by: f32) -> Option<Quad> {
    let lines = std::array::from_fn(|i| {
        let line = Line::through(quad[i], quad[(i + 1) % 4]);
        Line { c: line.c + by, ..line }
    });
    corners_of(&lines)
}

/// `n · p = c` with a unit normal that points out of a clockwise quadrilateral.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct Line {
    pub n: Point,
    pub c: f32,
}

impl Line {
    /// Through two corners that follow each other clockwise.
    pub fn through(a: Point, b: Point) -> Self {
        let length = distance(a, b).max(1e-6);
        let n = [(b[1] - a[1]) / length, -(b[0] - a[0]) / length];
        Self { n, c: n[0] * a[0] + n[1] * a[1] }
    }

    fn meet(&self, other: &Self) -> Option<Point> {
        let det = self.n[0] * other.n[1] - self.n[1] * other.n[0];
        (det.abs() > 0.05).then(|| {
            [
                (self.c * other.n[1] - other.c * self.n[1]) / det,
                (self.n[0] * other.c - other.n[0] * self.c) / det,
            ]
        })
    }
}

/// The corners at which side `i − 1` meets side `i`.
pub(super) fn corners_of(lines: &[Line; 4]) -> Option<Quad> {
    let mut quad = [[0.0; 2]; 4];
    for i in 0..4 {
        quad[i] = lines[(i + 3) % 4].meet(&lines[i])?;
    }
    Some(quad)
}

/// Whether a quadrilateral looks like a tag in a quick test: 13 of 16 pairs of pixels across its sides are darker
/// inside, by `least_step` and by `least_share` of what the outer one is, and among 36 pixels further in some are about
/// as light as outside and some about as dark as the border.
///
/// `reach` is how far inside and outside the side the pairs lie, pixels.
pub(super) fn looks_like_tag(
    image: ImageView<'_>,
    quad: &Quad,
    reach: f32,
    least_step: f32,
    least_share: f32,
) -> bool {
    let (mut wrong, mut dark, mut light) = (0, 0.0, 0.0);
    for i in 0..4 {
        let (a, b) = (quad[i], quad[(i + 1) % 4]);
        let n = Line::through(a, b).n;
        for t in [0.2, 0.4, 0.6, 0.8] {
            let at = [a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])];
            // At the image's rim the last pixel is used for what is outside.
            let pixel = |d: f32| f32::from(nearest_inside(image, [at[0] + d * n[0], at[1] + d * n[1]]));
            let (inside, outside) = (pixel(-reach), pixel(reach));
            wrong += u32::from(outside - inside < least_step.max(least_share * outside));
            dark += inside / 16.0;
            light += outside / 16.0;
        }
        if wrong > 3 {
            return false;
        }
    }
    let (low, high) = (dark + 0.6 * (light - dark), dark + 0.4 * (light - dark));
    let (mut lights, mut darks) = (0, 0);
    for k in 0..36 {
        let (x, y) = (0.19 + 0.124 * (k % 6) as f32, 0.19 + 0.124 * (k / 6) as f32);
        let mix = |c: usize| {
            let (top, bottom) =
                (quad[0][c] + x * (quad[1][c] - quad[0][c]), quad[3][c] + x * (quad[2][c] - quad[3][c]));
            top + y * (bottom - top)
        };
        let value = f32::from(nearest_inside(image, [mix(0), mix(1)]));
        lights += u32::from(value > high);
        darks += u32::from(value < low);
    }
    lights >= 4 && darks >= 4
}

/// The pixel nearest to a place, which is clamped to the image.
fn nearest_inside(image: ImageView<'_>, [u, v]: Point) -> u8 {
    let (u, v) = ((u + 0.5).max(0.0) as usize, (v + 0.5).max(0.0) as usize);
    image.data[v.min(image.height - 1) * image.stride + u.min(image.width - 1)]
}

/// Bilinear pixel value; coordinates are clamped to the image.
#[inline]
pub(super) fn bilinear(image: ImageView<'_>, [u, v]: Point) -> f32 {
    if image.width < 2 || image.height < 2 {
        return f32::from(nearest_inside(image, [u, v]));
    }
    let (u, v) = (u.clamp(0.0, (image.width - 1) as f32), v.clamp(0.0, (image.height - 1) as f32));
    let (iu, iv) = ((u as usize).min(image.width - 2), (v as usize).min(image.height - 2));
    let (fu, fv) = (u - iu as f32, v - iv as f32);
    let at = iv * image.stride + iu;
    let (above, below) = (&image.data[at..at + 2], &image.data[at + image.stride..at + image.stride + 2]);
    let p = [above[0], above[1], below[0], below[1]].map(f32::from);
    let top = p[0] + fu * (p[1] - p[0]);
    let bottom = p[2] + fu * (p[3] - p[2]);
    top + fv * (bottom - top)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Component and outline of a square with an edge of `edge` pixels, `round` pixels cut off each corner's sides.
    fn blunt_square(edge: usize, round: usize) -> (Component, Vec<(u16, u16)>) {
        let cut = |row: usize| round.saturating_sub(row.min(edge - 1 - row));
        let outline: Vec<(u16, u16)> =
            (0..edge).map(|row| ((20 + cut(row)) as u16, (20 + edge - 1 - cut(row)) as u16)).collect();
        let area = outline.iter().map(|(left, right)| u32::from(right - left) + 1).sum::<u32>() / 2;
        let (first, last) = (20, 19 + edge as u16);
        let runs = 2 * edge as u32;
        (Component { left: first, right: last, top: first, bottom: last, area, runs }, outline)
    }

    #[test]
    fn corners_of_squares_are_found_though_they_are_cut_off() {
        let limits = SizeLimits { least: 8.0, most: f32::MAX };
        for (edge, round) in [(14, 0), (14, 2), (14, 3), (40, 3)] {
            let (component, outline) = blunt_square(edge, round);
            let quad = QuadFinder::default().quad(&component, &outline, limits).expect("a square");
            // Half a pixel outside the centres of the outermost pixels.
            let (low, high) = (19.5, 19.5 + edge as f32);
            for corner in [[low, low], [high, low], [high, high], [low, high]] {
                let nearest = quad.iter().map(|&p| distance(p, corner)).fold(f32::MAX, f32::min);
                let most = if round == 2 { 2.5 } else { 1.0 };
                assert!(nearest < most, "{edge} {round}: {nearest} from {corner:?} in {quad:?}");
            }
        }
        let disc: Vec<(u16, u16)> = (-12i32..=12)
            .map(|v| f64::from(144 - v * v).sqrt() as u16)
            .map(|reach| (30 - reach, 30 + reach))
            .collect();
        let component = Component { left: 18, right: 42, top: 18, bottom: 42, area: 220, runs: 50 };
        assert_eq!(QuadFinder::default().quad(&component, &disc, limits), None, "a disc");
    }
}
