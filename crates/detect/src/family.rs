//! Tag families: where their cells lie and which word a grid of bits is nearest to.
//!
//! A tag is a grid of unit cells. Its border, the square that is found in the image, is `width`
//! cells on a side and cell (0, 0) is the border's top-left one. Around it lies a ring of the other
//! colour; tagStandard41h12 has its data outside that ring as well, and its border is the light
//! square inside a dark ring: it is looked for in the inverted image.

use windhover_base::msg::{FamilySpec, Form, TagFamily};

/// How a tag is printed: its family, how many cells wide its border is, and whether it was turned over or negated.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct TagLayout {
    /// Family of the code words.
    pub family: TagFamily,
    /// Width of the border, cells: 1 as the families' authors print it, 2 as Kalibr does. The corners are those of the
    /// border's outer square in either case.
    pub border: u8,
    /// Left and right are exchanged: seen in a mirror or through the sheet's back. The corners are those of what is
    /// seen: its top-left, then clockwise.
    pub mirrored: bool,
    /// Black and white are exchanged: print on dark ground, or as near infrared shows some inks.
    pub inverted: bool,
}

impl From<TagFamily> for TagLayout {
    fn from(family: TagFamily) -> Self {
        Self { family, border: 1, mirrored: false, inverted: false }
    }
}

/// What a grid of bits was recognised as.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) struct Word {
    /// Identity.
    pub id: u32,
    /// Wrong bits.
    pub hamming: u8,
    /// The tag's corner `i` is the quadrilateral's corner `(i + turns) % 4`.
    pub turns: usize,
}

/// A cell of a tag and whether it is light.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Cell {
    /// Of the code word.
    Data(bool),
    /// Of the border, or of the ring around it.
    Frame(bool),
    /// Of what is beside or within the print.
    Other,
}

/// One family, ready for lookup.
#[derive(Clone, Debug)]
pub(super) struct Family {
    /// Which.
    pub family: TagFamily,
    /// Cells on a side of the border's outer square.
    pub width: usize,
    /// How many cells wide the border is.
    pub border: usize,
    /// Cells sampled around the border: 1, or more where data lie outside.
    pub pad: usize,
    /// Whether the border is light inside a dark ring, so that the tag is looked for in the negative.
    pub in_negative: bool,
    /// Whether a set bit is dark in the image that is looked at.
    set_is_dark: bool,
    /// Data cells (x, y), first in the word's top bit.
    pub cells: Vec<(i32, i32)>,
    codes: &'static [u64],
    /// For each of four turns, the grid index of every data cell.
    turned: [Vec<u16>; 4],
    index: ChunkIndex,
}

impl Family {
    /// The tables of a family; `max_hamming` is cut to what the family allows.
    pub fn new(layout: TagLayout, max_hamming: u8) -> Self {
        let TagLayout { family, border, mirrored, inverted } = layout;
        let &FamilySpec {
            border: square, pad, form, inverted: set_is_dark, correctable: limit, codes, ..
        } = family.spec();
        let border = usize::from(border.max(1));
        let width = square + 2 * (border - 1);
        let mut cells = data_cells(width, pad, border as i32, form);
        if mirrored {
            cells.iter_mut().for_each(|(x, _)| *x = width as i32 - 1 - *x);
        }
        let turned = std::array::from_fn(|turns| {
            cells.iter().map(|&cell| grid_index(turn(cell, width, turns), width, pad)).collect()
        });
        let max_hamming = max_hamming.min(limit);
        let index = ChunkIndex::new(codes, cells.len(), max_hamming);
        let in_negative = set_is_dark != inverted;
        Self { family, width, border, pad, in_negative, set_is_dark, cells, codes, turned, index }
    }

    /// Cells on a side of the sampled grid.
    pub fn grid_side(&self) -> usize {
        self.width + 2 * self.pad
    }

    /// The bit of data cell `cell` of tag `id`: true for white in the image that is looked at.
    pub fn bit(&self, id: u32, cell: usize) -> bool {
        let bit = self.codes[id as usize] >> (self.cells.len() - 1 - cell) & 1 == 1;
        bit != self.set_is_dark
    }

    /// Most wrong bits that are corrected.
    pub fn max_hamming(&self) -> u8 {
        self.index.max_hamming
    }

    /// What cell (x, y) of the sampled grid of tag `id` is in the image that is looked at.
    pub fn cell(&self, id: u32, x: i32, y: i32) -> Cell {
        let w = self.width as i32;
        match self.cells.iter().position(|&c| c == (x, y)) {
            Some(cell) => Cell::Data(self.bit(id, cell)),
            None if inside(w, 0, (x, y)) && !inside(w, self.border as i32, (x, y)) => Cell::Frame(false),
            None if inside(w, -1, (x, y)) && !inside(w, 0, (x, y)) => Cell::Frame(true),
            None => Cell::Other,
        }
    }

    /// Whether cell (x, y) of tag `id` is light in the image that is looked at: data, border (dark) or the
    /// ring around it (light). `None` beyond the ring and where it is not known.
    pub fn is_light(&self, id: u32, x: i32, y: i32) -> Option<bool> {
        match self.cell(id, x, y) {
            Cell::Data(light) | Cell::Frame(light) if inside(self.width as i32, -1, (x, y)) => Some(light),
            _ => None,
        }
    }

    /// The word nearest to a grid of bits (`grid_side²`, row by row, true for white), if any is near
    /// enough.
    pub fn find(&self, grid: &[bool]) -> Option<Word> {
        let mut best: Option<Word> = None;
        for (turns, order) in self.turned.iter().enumerate() {
            let word = order
                .iter()
                .fold(0, |word, &i| word << 1 | u64::from(grid[usize::from(i)] != self.set_is_dark));
            if let Some((id, hamming)) = self.index.nearest(word, self.codes)
                && best.is_none_or(|b| hamming < b.hamming)
            {
                best = Some(Word { id, hamming, turns });
            }
        }
        best
    }
}

/// Whether a cell lies in a square of `w` cells a side less a margin.
fn inside(w: i32, margin: i32, (x, y): (i32, i32)) -> bool {
    (margin..w - margin).contains(&x) && (margin..w - margin).contains(&y)
}

/// Data cells row by row: those inside the border and outside the ring, as far as the family's form has them.
fn data_cells(width: usize, pad: usize, border: i32, form: Form) -> Vec<(i32, i32)> {
    let (w, p) = (width as i32, pad as i32);
    let has_data = |cell: (i32, i32)| {
        // Twice the distance of a cell's middle from the print's, and of the outermost row's.
        let from_middle = [cell.0, cell.1].map(|c| 2 * c + 1 - w);
        let outermost = w + 2 * p - 1;
        let fits = match form {
            Form::Square => true,
            Form::Nested => from_middle.iter().any(|d| d.abs() > 1),
            Form::Round => {
                from_middle.iter().map(|d| d * d).sum::<i32>() <= outermost * outermost + outermost
            }
        };
        fits && (inside(w, border, cell) || !inside(w, -1, cell))
    };
    (-p..w + p).flat_map(|y| (-p..w + p).map(move |x| (x, y))).filter(|&cell| has_data(cell)).collect()
}

/// A cell after `turns` quarter turns, clockwise as seen, about the tag's centre.
fn turn((x, y): (i32, i32), width: usize, turns: usize) -> (i32, i32) {
    (0..turns).fold((x, y), |(x, y), _| (width as i32 - 1 - y, x))
}

fn grid_index((x, y): (i32, i32), width: usize, pad: usize) -> u16 {
    let side = width + 2 * pad;
    ((y + pad as i32) as usize * side + (x + pad as i32) as usize) as u16
}

/// Exact-chunk index: of `h + 1` chunks of a word with at most `h` wrong bits, one is exact.
#[derive(Clone, Debug)]
struct ChunkIndex {
    max_hamming: u8,
    chunks: Vec<Chunk>,
}

#[derive(Clone, Debug)]
struct Chunk {
    shift: u32,
    mask: u64,
    /// Where the ids of each chunk value start in `ids`.
    starts: Vec<u32>,
    ids: Vec<u32>,
}

impl ChunkIndex {
    fn new(codes: &[u64], bits: usize, max_hamming: u8) -> Self {
        let count = usize::from(max_hamming) + 1;
        // At most 14 bits a chunk keep the tables small; more chunks than needed do no harm.
        let count = count.max(bits.div_ceil(14));
        let chunks =
            (0..count).map(|k| Chunk::new(codes, bits * k / count, bits * (k + 1) / count)).collect();
        Self { max_hamming, chunks }
    }

    fn nearest(&self, word: u64, codes: &[u64]) -> Option<(u32, u8)> {
        let mut best: Option<(u32, u8)> = None;
        for chunk in &self.chunks {
            for &id in chunk.sharing(word) {
                let hamming = (codes[id as usize] ^ word).count_ones() as u8;
                if hamming <= self.max_hamming && best.is_none_or(|b| hamming < b.1) {
                    best = Some((id, hamming));
                }
            }
        }
        best
    }
}

impl Chunk {
    fn new(codes: &[u64], low: usize, high: usize) -> Self {
        let (shift, mask) = (low as u32, (1 << (high - low)) - 1);
        let value = |code: u64| (code >> shift & mask) as usize;
        let mut starts = vec![0u32; mask as usize + 2];
        codes.iter().for_each(|&code| starts[value(code) + 1] += 1);
        (1..starts.len()).for_each(|i| starts[i] += starts[i - 1]);
        let mut next = starts.clone();
        let mut ids = vec![0; codes.len()];
        for (id, &code) in codes.iter().enumerate() {
            let slot = &mut next[value(code)];
            ids[*slot as usize] = id as u32;
            *slot += 1;
        }
        Self { shift, mask, starts, ids }
    }

    fn sharing(&self, word: u64) -> &[u32] {
        let value = (word >> self.shift & self.mask) as usize;
        &self.ids[self.starts[value] as usize..self.starts[value + 1] as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid_of(family: &Family, id: u32, turns: usize) -> Vec<bool> {
        let mut grid = vec![false; family.grid_side() * family.grid_side()];
        for (i, &cell) in family.cells.iter().enumerate() {
            let at = grid_index(turn(cell, family.width, turns), family.width, family.pad);
            grid[usize::from(at)] = family.bit(id, i);
        }
        grid
    }

    #[test]
    fn every_word_is_found_in_every_turn() {
        for family in TagFamily::ALL {
            let table = Family::new(family.into(), 3);
            assert_eq!(table.codes.len(), family.codes());
            for id in 0..family.codes() as u32 {
                for turns in 0..4 {
                    let found = table.find(&grid_of(&table, id, turns));
                    assert_eq!(found, Some(Word { id, hamming: 0, turns }), "{}", family.name());
                }
            }
        }
    }

    #[test]
    fn wrong_bits_are_corrected_up_to_the_limit() {
        let table = Family::new(TagFamily::Tag36h11.into(), 2);
        for wrong in [[3usize, 17], [0, 35], [11, 12]] {
            let mut grid = grid_of(&table, 42, 1);
            for w in wrong {
                let at = usize::from(table.turned[1][w]);
                grid[at] = !grid[at];
            }
            assert_eq!(table.find(&grid), Some(Word { id: 42, hamming: 2, turns: 1 }));
            let at = usize::from(table.turned[1][20]);
            grid[at] = !grid[at];
            assert_eq!(table.find(&grid), None);
        }
    }

    #[test]
    fn words_are_as_far_apart_as_their_family_says() {
        for (family, distance) in [
            (TagFamily::Tag36h11, 11),
            (TagFamily::Tag25h9, 9),
            (TagFamily::Tag16h5, 5),
            (TagFamily::Tag41h12, 12),
        ] {
            let codes = Family::new(family.into(), 0).codes;
            let nearest = (0..codes.len().min(400))
                .flat_map(|i| (i + 1..codes.len()).map(move |j| (codes[i] ^ codes[j]).count_ones()))
                .min();
            assert!(nearest.is_some_and(|n| n >= distance), "{}: {nearest:?}", family.name());
        }
    }
}
