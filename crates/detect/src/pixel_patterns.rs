//! Which cells are light near each cell of a tag, packed into bits.

use super::edge_points::{LANES, Lanes};
use super::family::{Cell, Family};

/// Cells around the border that the tables hold.
const MARGIN: i32 = 3;
/// Cells on a side of the neighbourhood whose colours a table's entry packs.
const NEAR: i32 = 5;
/// The neighbourhood's middle cell.
const MIDDLE: u32 = 12;

/// For each cell of a tag and around it, which of the 5×5 cells about it are light, and which are not known, from the
/// lowest bit on row by row.
#[derive(Clone, Debug, Default)]
pub(super) struct Patterns {
    entries: Vec<[u32; 2]>,
    side: usize,
    /// Cells on a side of the border's outer square.
    pub width: f32,
}

impl Patterns {
    pub fn place(&mut self, family: &Family, id: u32) {
        let w = family.width as i32;
        (self.side, self.width) = ((w + 2 * MARGIN) as usize, w as f32);
        let wide = (self.side as i32 + NEAR - 1) as usize;
        let first = -MARGIN - NEAR / 2;
        let mut rows = [[0u32; 2]; 32];
        for (y, row) in (first..).zip(rows.iter_mut().take(wide)) {
            for (k, x) in (first..).enumerate().take(wide) {
                match family.cell(id, x, y) {
                    Cell::Data(light) | Cell::Frame(light) => row[0] |= u32::from(light) << k,
                    Cell::Other => row[1] |= 1 << k,
                }
            }
        }
        let near = |x: usize, y: usize, of: usize| {
            (0..NEAR as usize).fold(0, |sum, k| sum | (rows[y + k][of] >> x & 31) << (5 * k))
        };
        let cells = (0..self.side * self.side).map(|i| (i % self.side, i / self.side));
        self.entries.clear();
        self.entries.extend(cells.map(|(x, y)| [near(x, y, 0), near(x, y, 1)]));
    }

    /// The entry of cell (x, y), or of the nearest there is.
    #[inline(always)]
    fn entry(&self, x: i32, y: i32) -> [u32; 2] {
        let last = self.side as i32 - 1;
        let [x, y] = [x, y].map(|c| (c + MARGIN).clamp(0, last) as usize);
        self.entries[y * self.side + x]
    }

    /// Whether a cell is light, where that is known.
    pub fn is_light(&self, x: i32, y: i32) -> Option<bool> {
        let [light, unknown] = self.entry(x, y);
        (unknown >> MIDDLE & 1 == 0).then_some(light >> MIDDLE & 1 == 1)
    }

    /// Finds the entries of places given in cells from the border's corner; leaves how far they are from their cells'.
    #[inline(always)]
    pub fn look_up(&self, cells: &mut [Lanes; 2], bits: &mut [[u32; LANES]; 2]) {
        let (mut xs, mut ys) = ([0i32; LANES], [0i32; LANES]);
        for lane in 0..LANES {
            let (x, y) = (below(cells[0][lane]), below(cells[1][lane]));
            (xs[lane], ys[lane]) = (x as i32, y as i32);
            cells[0][lane] -= x;
            cells[1][lane] -= y;
        }
        for lane in 0..LANES {
            [bits[0][lane], bits[1][lane]] = self.entry(xs[lane], ys[lane]);
        }
    }

    /// Whether all that is within `clear` cells of a tag point is of known colour.
    pub fn is_known(&self, q: [f32; 2], clear: f32) -> bool {
        let cells = q.map(|c| (c + 1.0) * 0.5 * self.width);
        let [x, y] = cells.map(below);
        let [_, unknown] = self.entry(x as i32, y as i32);
        unknown & within(cells[0] - x, cells[1] - y, clear) == 0
    }
}

/// The largest whole number that is not above a number from −1000 to a million; the same in every instruction set.
#[inline(always)]
fn below(x: f32) -> f32 {
    let whole = (x + 1000.0) as i32 as f32 - 1000.0;
    if whole > x { whole - 1.0 } else { whole }
}

/// Which of the 3×3 cells about a place, given from its cell's corner, are within `reach`.
#[inline(always)]
fn within(x: f32, y: f32, reach: f32) -> u32 {
    let columns = 4 | u32::from(x < reach) << 1 | u32::from(x > 1.0 - reach) << 3;
    columns << 10 | (columns * u32::from(y < reach)) << 5 | (columns * u32::from(y > 1.0 - reach)) << 15
}

#[cfg(test)]
mod tests {
    use windhover_base::msg::TagFamily;

    use super::*;

    #[test]
    fn what_is_beside_the_print_is_unknown() {
        let family = Family::new(TagFamily::Tag36h11.into(), 2);
        let mut patterns = Patterns::default();
        patterns.place(&family, 0);
        // Places in cells from the border's corner.
        let known = |x: f32, y: f32| patterns.is_known([x, y].map(|c| c / 4.0 - 1.0), 0.3);
        assert!(known(0.1, 0.1) && known(-0.6, 4.0) && known(3.0, 8.6));
        assert!(!known(-0.8, 4.0) && !known(-1.5, 4.0) && !known(3.0, 8.8));
        let lights = [(-1, 0), (0, 0), (-2, 0)].map(|(x, y)| patterns.is_light(x, y));
        assert_eq!(lights, [Some(true), Some(false), None]);
    }
}
