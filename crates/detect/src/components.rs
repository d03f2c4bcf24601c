//! Connected dark regions from runs of bits: no per-pixel labels, no hash maps.
//!
//! What a run touches in the row above is counted, not searched: the runs above that ended before it and
//! those that have begun by its end are population counts of the row's words. That has no branches to
//! mispredict, which on textured ground is where the time goes.

use std::ops::Range;

use super::binarise::Bitmap;
use super::disjoint_sets::union;
use super::simd::{Kernel, Simd};

/// Dark pixels `start..end` of a row.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
struct Run {
    start: u16,
    end: u16,
}

/// A connected dark region: its box (inclusive) and area, pixels.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub(super) struct Component {
    pub left: u16,
    pub right: u16,
    pub top: u16,
    pub bottom: u16,
    pub area: u32,
    /// How many runs it is made of.
    pub runs: u32,
}

impl Component {
    pub fn width(&self) -> usize {
        usize::from(self.right - self.left) + 1
    }

    pub fn height(&self) -> usize {
        usize::from(self.bottom - self.top) + 1
    }
}

/// What a component adds up to so far.
#[derive(Clone, Copy, Debug)]
struct Sums {
    left: u16,
    right: u16,
    top: u16,
    bottom: u16,
    /// Area in the lower half, runs in the upper.
    counts: u64,
}

impl Sums {
    /// No pixel as yet, from row `v` on.
    #[inline(always)]
    fn from_row(v: u16) -> Self {
        Self { left: u16::MAX, right: 0, top: v, bottom: v, counts: 0 }
    }

    /// Adds a run of a row that is not above any before.
    #[inline(always)]
    fn add(&mut self, run: &Run, v: u16) {
        self.left = self.left.min(run.start);
        self.right = self.right.max(run.end);
        self.bottom = v;
        self.counts += u64::from(run.end - run.start) | 1 << 32;
    }

    fn merge(&mut self, other: &Self) {
        self.left = self.left.min(other.left);
        self.right = self.right.max(other.right);
        self.top = self.top.min(other.top);
        self.bottom = self.bottom.max(other.bottom);
        self.counts += other.counts;
    }

    fn component(&self) -> Component {
        let &Self { left, right, top, bottom, counts } = self;
        let (area, runs) = (counts as u32, (counts >> 32) as u32);
        Component { left, right: right - 1, top, bottom, area, runs }
    }
}

/// Leftmost and rightmost pixel of each row of a component, top row first.
pub(super) type Outline<'a> = &'a [(u16, u16)];

/// Where runs start and end in 64 pixels of a row, and how many have before.
#[derive(Clone, Copy, Debug, Default)]
struct Marks {
    starts: u64,
    ends: u64,
    started: u32,
    ended: u32,
}

impl Marks {
    /// Runs that end before column `u`.
    #[inline(always)]
    fn ended_before(row: &[Self], u: u16) -> usize {
        let m = &row[usize::from(u >> 6)];
        m.ended as usize + (m.ends & ((1 << (u & 63)) - 1)).count_ones() as usize
    }

    /// Runs that end at column `u` or before.
    #[inline(always)]
    fn ended_by(row: &[Self], u: u16) -> usize {
        let m = &row[usize::from(u >> 6)];
        m.ended as usize + (m.ends & (u64::MAX >> (63 - (u & 63)))).count_ones() as usize
    }

    /// Runs that start before column `u`.
    #[inline(always)]
    fn started_before(row: &[Self], u: u16) -> usize {
        let m = &row[usize::from(u >> 6)];
        m.started as usize + (m.starts & ((1 << (u & 63)) - 1)).count_ones() as usize
    }

    /// Runs that start at column `u` or before.
    #[inline(always)]
    fn started_by(row: &[Self], u: u16) -> usize {
        let m = &row[usize::from(u >> 6)];
        m.started as usize + (m.starts & (u64::MAX >> (63 - (u & 63)))).count_ones() as usize
    }
}

/// By what pixels of one component touch.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Touch {
    /// By a side: two squares that touch by a corner are two.
    Sides,
    /// By a side or a corner: a thin border seen aslant holds together by corners.
    Corners,
}

/// Labels bitmaps; keeps its buffers.
#[derive(Clone, Debug, Default)]
pub(super) struct Labeller {
    runs: Vec<Run>,
    labels: Vec<u32>,
    /// Where each row's runs start.
    rows: Vec<u32>,
    /// Marks of every row that has runs, a row without before the first.
    marks: Vec<Marks>,
    /// Label above each label; a root is its own.
    parents: Vec<u32>,
    /// How many labels there are; buffers only grow.
    count: usize,
    /// Labels found to be of one component, and how many pairs there are.
    joins: Vec<(u32, u32)>,
    joined: usize,
    sums: Vec<Sums>,
    /// Components kept and the labels of their roots.
    kept: Vec<(Component, u32)>,
    outlines: Vec<(u16, u16)>,
}

impl Labeller {
    /// Finds the components of a bitmap and outlines those that `keep` accepts. Bitmaps are less than 65 000 pixels
    /// wide and high.
    pub fn label(&mut self, bits: &Bitmap, touch: Touch, simd: Simd, keep: impl Fn(&Component) -> bool) {
        match touch {
            Touch::Sides => simd.run(FindRuns::<false> { labeller: self, bits }),
            Touch::Corners => simd.run(FindRuns::<true> { labeller: self, bits }),
        }
        self.gather(keep);
        simd.run(FindOutlines { labeller: self, words: bits.width.div_ceil(64) });
    }

    /// The kept components with their outlines.
    pub fn kept(&self) -> impl Iterator<Item = (&Component, Outline<'_>)> {
        let mut at = 0;
        self.kept.iter().map(move |(component, _)| {
            let from = at;
            at += component.height();
            (component, &self.outlines[from..at])
        })
    }

    /// Splits rows into runs and labels them by what they touch in the row above.
    #[inline(always)]
    fn find_runs<const BY_CORNERS: bool>(&mut self, bits: &Bitmap) {
        self.rows.clear();
        // One more than there are words: a run may end just behind the last.
        let marks = bits.width.div_ceil(64) + 1;
        self.marks.resize((bits.height + 1) * marks, Marks::default());
        self.marks[..marks].fill(Marks::default());
        // Where the marks of the row above are: of a row without runs those before the first.
        let (mut above, mut first, mut above_marks) = (0, 0, 0);
        (self.count, self.joined) = (0, 0);
        for v in 0..bits.height {
            self.rows.push(first as u32);
            let words = bits.row(v);
            if words.iter().fold(0, |any, word| any | word) == 0 {
                (above, above_marks) = (first, 0);
                continue;
            }
            let after = first + self.split_row(words, first, (v + 1) * marks);
            self.label_row::<BY_CORNERS>(above, first..after, v as u16, above_marks..above_marks + marks);
            (above, first, above_marks) = (first, after, (v + 1) * marks);
        }
        for &(a, b) in &self.joins[..self.joined] {
            union(&mut self.parents, a, b);
        }
    }

    /// Writes the runs of a row from `first` on, and its marks from `marks` on; how many there are.
    #[inline(always)]
    fn split_row(&mut self, words: &[u64], first: usize, marks: usize) -> usize {
        // A pixel may start or end a run: in the worst case every second one starts one.
        let most = first + words.len() * 32 + 8;
        if self.runs.len() < most {
            self.runs.resize(most, Run::default());
        }
        let marks = &mut self.marks[marks..marks + words.len() + 1];
        let (mut carry, mut started, mut ended) = (0, first, first);
        for (index, (&word, mark)) in words.iter().zip(marks.iter_mut()).enumerate() {
            let before = word << 1 | carry;
            carry = word >> 63;
            let (mut starts, mut ends) = (word & !before, before & !word);
            *mark = Marks { starts, ends, started: (started - first) as u32, ended: (ended - first) as u32 };
            let base = (index * 64) as u16;
            let (next_started, next_ended) =
                (started + starts.count_ones() as usize, ended + ends.count_ones() as usize);
            while starts | ends != 0 {
                // Four at a time, whether they are there or not: what is too much is written over.
                let a = &mut self.runs[started..started + 4];
                for run in a {
                    run.start = base.wrapping_add(starts.trailing_zeros() as u16);
                    starts &= starts.wrapping_sub(1);
                }
                let b = &mut self.runs[ended..ended + 4];
                for run in b {
                    run.end = base.wrapping_add(ends.trailing_zeros() as u16);
                    ends &= ends.wrapping_sub(1);
                }
                started += 4;
                ended += 4;
            }
            (started, ended) = (next_started, next_ended);
        }
        if ended < started {
            self.runs[ended].end = (words.len() * 64) as u16;
        }
        marks[words.len()] =
            Marks { starts: 0, ends: 0, started: (started - first) as u32, ended: (ended - first) as u32 };
        started - first
    }

    /// Labels the runs of a row; those of the row above start at `above` and have these marks. Nothing branches
    /// on what a run touches, save where it touches three or more.
    #[inline(always)]
    fn label_row<const BY_CORNERS: bool>(
        &mut self,
        above: usize,
        row: Range<usize>,
        v: u16,
        marks: Range<usize>,
    ) {
        let marks = &self.marks[marks];
        // One more than there can be: what is too much is written over.
        let most = row.end + 1;
        if self.labels.len() < most {
            self.labels.resize(most, 0);
            self.parents.resize(most, 0);
            self.sums.resize(most, Sums::from_row(0));
            self.joins.resize(most, (0, 0));
        }
        let (mut count, mut joined) = (self.count, self.joined);
        let (runs, labels) = (&self.runs[row.clone()], &mut self.labels[above..most]);
        let (parents, sums) = (&mut self.parents[..most], &mut self.sums[..most]);
        let joins = &mut self.joins[..most];
        for (run, k) in runs.iter().zip(row.start - above..) {
            // By a corner touch one above that ends where this starts, and one that starts where it ends.
            let (from, to) = if BY_CORNERS {
                (Marks::ended_before(marks, run.start), Marks::started_by(marks, run.end))
            } else {
                (Marks::ended_by(marks, run.start), Marks::started_before(marks, run.end))
            };
            let is_new = from >= to;
            parents[count] = count as u32;
            sums[count] = Sums::from_row(v);
            let own = if is_new { count as u32 } else { labels[from] };
            count += usize::from(is_new);
            labels[k] = own;
            sums[own as usize].add(run, v);
            let other = labels[from + 1];
            joins[joined] = (own, other);
            joined += usize::from((to > from + 1) & (own != other));
            if to > from + 2 {
                for &other in &labels[from + 2..to] {
                    union(parents, own, other);
                }
            }
        }
        (self.count, self.joined) = (count, joined);
    }

    /// Sums labels up into components and finds which are kept.
    fn gather(&mut self, keep: impl Fn(&Component) -> bool) {
        for label in 0..self.count {
            let parent = self.parents[label] as usize;
            if parent != label {
                // A parent comes before its children, so it is a root by now.
                let root = self.parents[parent];
                self.parents[label] = root;
                let part = self.sums[label];
                self.sums[root as usize].merge(&part);
            }
        }
        self.kept.clear();
        for (label, &parent) in self.parents[..self.count].iter().enumerate() {
            if parent as usize == label {
                let component = self.sums[label].component();
                if keep(&component) {
                    self.kept.push((component, parent));
                }
            }
        }
    }

    /// Finds the leftmost and the rightmost run of each row of the components kept.
    #[inline(always)]
    fn outline(&mut self, words: usize) {
        let Self { runs, labels, rows, marks, parents, kept, outlines, .. } = self;
        outlines.clear();
        for (component, root) in kept {
            let is_own = |k: &usize| parents[labels[*k] as usize] == *root;
            for v in usize::from(component.top)..=usize::from(component.bottom) {
                let (first, marks) = (rows[v] as usize, &marks[(v + 1) * (words + 1)..(v + 2) * (words + 1)]);
                let mut within = first + Marks::ended_before(marks, component.left)
                    ..first + Marks::started_by(marks, component.right);
                // Every row of a component has a run of it.
                let left = within.find(is_own).unwrap_or(first);
                let right = within.rfind(is_own).unwrap_or(left);
                outlines.push((runs[left].start, runs[right].end - 1));
            }
        }
    }
}

/// `Labeller::find_runs`, with the instructions this processor has.
struct FindRuns<'a, const BY_CORNERS: bool> {
    labeller: &'a mut Labeller,
    bits: &'a Bitmap,
}

impl<const BY_CORNERS: bool> Kernel for FindRuns<'_, BY_CORNERS> {
    #[inline(always)]
    fn run(self) {
        self.labeller.find_runs::<BY_CORNERS>(self.bits);
    }
}

/// `Labeller::outline`, likewise.
struct FindOutlines<'a> {
    labeller: &'a mut Labeller,
    words: usize,
}

impl Kernel for FindOutlines<'_> {
    #[inline(always)]
    fn run(self) {
        self.labeller.outline(self.words);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Flood fill, the plain way.
    fn flooded(bits: &Bitmap, touch: Touch) -> Vec<Component> {
        let dark = |u: usize, v: usize| bits.row(v)[u / 64] >> (u % 64) & 1 == 1;
        let mut seen = vec![false; bits.width * bits.height];
        let mut found = Vec::new();
        for first in 0..seen.len() {
            let (u, v) = (first % bits.width, first / bits.width);
            if seen[first] || !dark(u, v) {
                continue;
            }
            let mut c = Sums::from_row(v as u16);
            let mut stack = vec![(u, v)];
            seen[first] = true;
            while let Some((u, v)) = stack.pop() {
                let mut pixel = Sums::from_row(v as u16);
                pixel.add(&Run { start: u as u16, end: u as u16 + 1 }, v as u16);
                c.merge(&pixel);
                for nv in v.saturating_sub(1)..(v + 2).min(bits.height) {
                    for nu in u.saturating_sub(1)..(u + 2).min(bits.width) {
                        let is_near = touch == Touch::Corners || nu == u || nv == v;
                        if is_near && dark(nu, nv) && !seen[nv * bits.width + nu] {
                            seen[nv * bits.width + nu] = true;
                            stack.push((nu, nv));
                        }
                    }
                }
            }
            found.push(Component { runs: 0, ..c.component() });
        }
        found
    }

    proptest! {
        #[test]
        fn components_are_those_of_a_flood_fill(
            width in 1usize..150, seed in prop::collection::vec(any::<bool>(), 1..4000), fill in 0u8..3
        ) {
            let height = seed.len().div_ceil(width);
            let dark: Vec<bool> = (0..width * height)
                .map(|i| match fill {
                    0 => seed[i % seed.len()],
                    1 => seed[i % seed.len()] || seed[(i * 7 + 3) % seed.len()],
                    _ => seed[i % seed.len()] && seed[(i * 5 + 1) % seed.len()],
                })
                .collect();
            let bits = Bitmap::from_pixels(width, height, &dark);
            let mut labeller = Labeller::default();
            for touch in [Touch::Sides, Touch::Corners] {
                labeller.label(&bits, touch, Simd::best(), |_| true);
                let found = labeller.kept().map(|(c, _)| Component { runs: 0, ..*c });
                let (mut labelled, mut expected): (Vec<Component>, _) = (found.collect(), flooded(&bits, touch));
                let key = |c: &Component| (c.top, c.left, c.bottom, c.right, c.area);
                labelled.sort_by_key(key);
                expected.sort_by_key(key);
                prop_assert_eq!(labelled, expected);
                for (c, outline) in labeller.kept() {
                    prop_assert_eq!(outline.iter().map(|lr| lr.0).min(), Some(c.left));
                    prop_assert_eq!(outline.iter().map(|lr| lr.1).max(), Some(c.right));
                }
            }
        }
    }
}
