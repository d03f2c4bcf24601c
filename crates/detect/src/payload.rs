//! Decoding of a quadrilateral: its cells are sampled, separated into white and black, and looked up.

use super::family::{Cell, Family, Word};
use super::homography::{Homography, narrow, wide};
use super::pyramid::Pyramid;
use super::quad::{Quad, bilinear, distance, polygon_area};
use windhover_base::msg::ImageView;

/// Largest grid side: tag36h11 with a border of two cells and its ring.
const MOST: usize = 12;

/// A code word read from a quadrilateral.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct Reading {
    pub word: Word,
    /// Mean distance of the cells from the threshold, of the white or the black ones, whichever is smaller.
    pub margin: f32,
    /// Whether most white cells are as light as a pixel can be: light spreads from them over the black ones.
    pub is_over_exposed: bool,
}

/// From this grey level on a cell is as light as a pixel can be.
const OVER_EXPOSED: f32 = 250.0;

/// Least step from black border to white ring, grey levels.
const LEAST_CONTRAST: f32 = 5.0;

/// Share of border and ring cells that may lie on the wrong side of the threshold; less for families with few bits,
/// whose code words often occur by chance.
const MOST_WRONG_BORDER: f32 = 0.2;
const MOST_WRONG_OF_FEW: f32 = 0.04;
const FEW_BITS: usize = 20;

/// For those families: the least distance of every cell from the threshold, relative to the mean.
const CLEAR_OF_FEW: f32 = 0.45;

fn most_wrong(family: &Family) -> f32 {
    if family.cells.len() < FEW_BITS { MOST_WRONG_OF_FEW } else { MOST_WRONG_BORDER }
}

/// Grey values of the grid of cells of a tag.
struct Grid {
    side: usize,
    pad: usize,
    values: [f32; MOST * MOST],
}

impl Grid {
    fn sample(image: ImageView<'_>, pyramid: &Pyramid, quad: &Quad, family: &Family) -> Option<Self> {
        let h = Homography::of_square(family.width as f64, &wide(quad))?;
        let longest = (0..4).map(|i| distance(quad[i], quad[(i + 1) % 4])).fold(1.0, f32::max);
        // Averaging over the cell: the level in which a cell is two to four pixels wide, across the narrow direction
        // where the tag is seen at an angle.
        let cell = polygon_area(quad) / longest / family.width as f32;
        let level = pyramid.for_size(image, cell, 2.0);
        let (side, pad) = (family.grid_side(), family.pad);
        let mut values = [0.0; MOST * MOST];
        for y in 0..side {
            for x in 0..side {
                let centre = |k: usize| k as f64 + 0.5 - pad as f64;
                let p = narrow(h.apply(centre(x), centre(y)));
                values[y * side + x] = bilinear(level.image, p.map(|c| level.of_frame(c)));
            }
        }
        Some(Self { side, pad, values })
    }

    /// Grid indices of the ring of cells `out` cells outside the border; 0 is the border itself.
    fn ring(&self, out: usize) -> impl Iterator<Item = usize> + use<> {
        let (side, low) = (self.side, self.pad - out);
        let high = side - 1 - low;
        (low..=high).flat_map(move |y| (low..=high).map(move |x| (x, y))).filter_map(move |(x, y)| {
            (x == low || x == high || y == low || y == high).then_some(y * side + x)
        })
    }

    /// Plane `a + b x + c y` through the values of a ring, x and y from the grid's middle.
    fn plane(&self, out: usize) -> [f32; 3] {
        let middle = (self.side - 1) as f32 / 2.0;
        let (mut n, mut sum, mut sx, mut sy, mut sxx) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for i in self.ring(out) {
            let (x, y) = ((i % self.side) as f32 - middle, (i / self.side) as f32 - middle);
            let value = self.values[i];
            n += 1.0;
            sum += value;
            sx += x * value;
            sy += y * value;
            sxx += x * x;
        }
        [sum / n, sx / sxx, sy / sxx]
    }

    /// Threshold halfway between a plane through the black border and one through the white ring.
    fn plane_threshold(&self) -> Option<[f32; MOST * MOST]> {
        let (black, white) = (self.plane(0), self.plane(1));
        if white[0] - black[0] < LEAST_CONTRAST {
            return None;
        }
        let middle = (self.side - 1) as f32 / 2.0;
        let mut thresholds = [0.0; MOST * MOST];
        for (i, t) in thresholds.iter_mut().enumerate().take(self.side * self.side) {
            let (x, y) = ((i % self.side) as f32 - middle, (i / self.side) as f32 - middle);
            let at = |p: [f32; 3]| p[0] + p[1] * x + p[2] * y;
            *t = 0.5 * (at(black) + at(white));
        }
        Some(thresholds)
    }

    /// Levels halfway between the border and the ring outside it, one for each border cell of each side: top, right,
    /// bottom, left, by x or y.
    fn border_levels(&self) -> [[f32; MOST]; 4] {
        let (low, high) = (self.pad, self.side - 1 - self.pad);
        let mut levels = [[0.0; MOST]; 4];
        let at = |x: usize, y: usize| self.values[y * self.side + x];
        for k in low..=high {
            let pairs = [
                (at(k, low), at(k, low - 1)),
                (at(high, k), at(high + 1, k)),
                (at(k, high), at(k, high + 1)),
                (at(low, k), at(low - 1, k)),
            ];
            for (level, (inner, outer)) in levels.iter_mut().zip(pairs) {
                level[k] = 0.5 * (inner + outer);
            }
        }
        levels
    }

    /// Whether the border's levels differ by more than a third: a shadow lies across the tag.
    fn is_shaded(&self, border: &[[f32; MOST]; 4]) -> bool {
        let cells = border.iter().flat_map(|side| &side[self.pad..self.side - self.pad]);
        let (least, most) = cells.fold((f32::MAX, f32::MIN), |m, &c| (m.0.min(c), m.1.max(c)));
        most > 1.3 * least
    }

    /// Two levels on either side of a straight line, where the border's levels fall into two groups: a
    /// shadow's edge across the tag. The line is a least-squares discriminant of the border cells.
    fn halves_threshold(&self, border: &[[f32; MOST]; 4]) -> Option<[f32; MOST * MOST]> {
        let (low, high) = (self.pad, self.side - 1 - self.pad);
        let middle = (self.side - 1) as f32 / 2.0;
        let (near, far) = (low as f32 - middle, high as f32 - middle);
        let cells = (low..=high).flat_map(|k| {
            let t = k as f32 - middle;
            [(t, near, border[0][k]), (far, t, border[1][k]), (t, far, border[2][k]), (near, t, border[3][k])]
        });
        let (least, most) = cells.clone().fold((f32::MAX, f32::MIN), |m, c| (m.0.min(c.2), m.1.max(c.2)));
        let split = 0.5 * (least + most);
        let (mut dark, mut lit, mut slope, mut square) = ((0.0, 0.0f32), (0.0, 0.0f32), [0.0f32; 2], 0.0);
        for (x, y, level) in cells.clone() {
            let group = if level > split { &mut lit } else { &mut dark };
            *group = (group.0 + level, group.1 + 1.0);
            let side = if level > split { 1.0 } else { -1.0 };
            slope = [slope[0] + side * x, slope[1] + side * y];
            square += x * x;
        }
        let (dark_level, lit_level) = (dark.0 / dark.1.max(1.0), lit.0 / lit.1.max(1.0));
        let length = (slope[0] * slope[0] + slope[1] * slope[1]).sqrt();
        if length < 0.2 * square / far.max(1.0) {
            return None;
        }
        let n = [slope[0] / length, slope[1] / length];
        let along = |x: f32, y: f32| n[0] * x + n[1] * y;
        // The offset that leaves fewest border cells on the wrong side.
        let wrong = |offset: f32| {
            cells.clone().filter(|&(x, y, level)| (along(x, y) > offset) != (level > split)).count()
        };
        let reach = (1.5 * far * 2.0) as i32;
        let offset = (-reach..=reach).map(|k| 0.5 * k as f32).min_by_key(|&offset| wrong(offset))?;
        let mut thresholds = [0.0; MOST * MOST];
        for (i, t) in thresholds.iter_mut().enumerate().take(self.side * self.side) {
            let (x, y) = ((i % self.side) as f32 - middle, (i / self.side) as f32 - middle);
            let share = (0.5 + along(x, y) - offset).clamp(0.0, 1.0);
            *t = dark_level + share * (lit_level - dark_level);
        }
        Some(thresholds)
    }

    /// The border's levels interpolated inwards: the mean of the levels left and right, above and below, each weighted
    /// by its nearness.
    fn blended_threshold(&self, border: &[[f32; MOST]; 4]) -> [f32; MOST * MOST] {
        let (low, high) = (self.pad, self.side - 1 - self.pad);
        let mut thresholds = [0.0; MOST * MOST];
        for (i, t) in thresholds.iter_mut().enumerate().take(self.side * self.side) {
            let (x, y) = ((i % self.side).clamp(low, high), (i / self.side).clamp(low, high));
            let sides = [
                (border[0][x], y - low),
                (border[1][y], high - x),
                (border[2][x], high - y),
                (border[3][y], x - low),
            ];
            let (sum, weights) = sides.iter().fold((0.0, 0.0), |(sum, weights), &(level, distance)| {
                let weight = 1.0 / (0.3 + distance as f32).powi(2);
                (sum + weight * level, weights + weight)
            });
            *t = sum / weights;
        }
        thresholds
    }

    /// The same with each cell's difference from its four neighbours doubled, to undo blur.
    fn sharpened(&self) -> Self {
        let mut values = self.values;
        let side = self.side;
        for i in (1..side - 1).flat_map(|y| (1..side - 1).map(move |x| y * side + x)) {
            let v = &self.values;
            values[i] = 2.0 * v[i] - 0.25 * (v[i - 1] + v[i + 1] + v[i - side] + v[i + side]);
        }
        Self { values, ..*self }
    }

    fn read(&self, thresholds: &[f32; MOST * MOST], family: &Family) -> Option<Reading> {
        let cells = self.side * self.side;
        let mut bits = [false; MOST * MOST];
        for i in 0..cells {
            bits[i] = self.values[i] > thresholds[i];
        }
        let wrong = self.ring(0).filter(|&i| bits[i]).count() + self.ring(1).filter(|&i| !bits[i]).count();
        let all = self.ring(0).count() + self.ring(1).count();
        if wrong as f32 > most_wrong(family) * all as f32 {
            return None;
        }
        let word = family.find(&bits[..cells])?;
        let (mut white, mut black) = ((0.0, 0.0), (0.0, 0.0));
        for i in 0..cells {
            let sum = if bits[i] { &mut white } else { &mut black };
            sum.0 += (self.values[i] - thresholds[i]).abs();
            sum.1 += 1.0f32;
        }
        let mean = |s: (f32, f32)| s.0 / s.1.max(1.0);
        let is_clear =
            |i: usize| (self.values[i] - thresholds[i]).abs() >= CLEAR_OF_FEW * mean(white).min(mean(black));
        if family.cells.len() < FEW_BITS && !(0..cells).all(is_clear) {
            return None;
        }
        let lights = (0..cells).filter(|&i| bits[i]);
        let saturated = lights.filter(|&i| self.values[i] >= OVER_EXPOSED).count() as f32;
        let is_over_exposed = saturated > 0.5 * white.1;
        Some(Reading { word, margin: mean(white).min(mean(black)), is_over_exposed })
    }

    /// Whether the cells are those of tag `id`, as exactly as reading requires.
    fn agrees(&self, thresholds: &[f32; MOST * MOST], family: &Family, id: u32) -> bool {
        let (mut wrong_data, mut wrong, mut all) = (0, 0.0, 0.0);
        for i in 0..self.side * self.side {
            let [x, y] = [i % self.side, i / self.side].map(|c| c as i32 - self.pad as i32);
            let is_light = self.values[i] > thresholds[i];
            match family.cell(id, x, y) {
                Cell::Data(light) => wrong_data += u8::from(light != is_light),
                Cell::Frame(light) => {
                    wrong += f32::from(u8::from(light != is_light));
                    all += 1.0;
                }
                Cell::Other => {}
            }
        }
        wrong_data <= family.max_hamming() && wrong <= most_wrong(family) * all
    }
}

/// Whether a quadrilateral in the tag's own order holds tag `id`: the test that `read` makes of a candidate, repeated
/// for the refined result. A fit to other edges than the tag's fails here: the border of two cells that Kalibr prints
/// has another square inside, without light around it.
pub(super) fn agrees(image: ImageView<'_>, pyramid: &Pyramid, quad: &Quad, family: &Family, id: u32) -> bool {
    let Some(grid) = Grid::sample(image, pyramid, quad, family) else { return false };
    let Some(plane) = grid.plane_threshold() else { return false };
    if grid.agrees(&plane, family, id) || grid.sharpened().agrees(&plane, family, id) {
        return true;
    }
    let border = grid.border_levels();
    grid.is_shaded(&border)
        && (grid.halves_threshold(&border).is_some_and(|t| grid.agrees(&t, family, id))
            || grid.agrees(&grid.blended_threshold(&border), family, id))
}

/// Reads a quadrilateral given in frame coordinates. Illumination is tried as a plane, then as lit and shaded halves,
/// then by the border's levels in each row and column; the first that gives a code word is used.
pub(super) fn read(image: ImageView<'_>, pyramid: &Pyramid, quad: &Quad, family: &Family) -> Option<Reading> {
    let grid = Grid::sample(image, pyramid, quad, family)?;
    let thresholds = grid.plane_threshold()?;
    if let Some(reading) = grid.read(&thresholds, family) {
        return Some(reading);
    }
    if let Some(reading) = grid.sharpened().read(&thresholds, family) {
        return Some(reading);
    }
    let border = grid.border_levels();
    if !grid.is_shaded(&border) {
        return None;
    }
    if let Some(reading) = grid.halves_threshold(&border).and_then(|t| grid.read(&t, family)) {
        return Some(reading);
    }
    grid.read(&grid.blended_threshold(&border), family)
}
