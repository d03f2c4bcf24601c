//! Connected dark regions from runs of bits: no per-pixel labels, no hash maps.

use super::binarise::Bitmap;

/// Dark pixels `start..end` of a row, and the label they were given first.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
struct Run {
    start: u16,
    end: u16,
    label: u32,
}

/// A connected dark region: its box (inclusive) and area, pixels.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) struct Component {
    pub left: u16,
    pub right: u16,
    pub top: u16,
    pub bottom: u16,
    pub area: u32,
}

impl Component {
    pub fn width(&self) -> usize {
        usize::from(self.right - self.left) + 1
    }

    pub fn height(&self) -> usize {
        usize::from(self.bottom - self.top) + 1
    }

    fn add(&mut self, start: u16, end: u16, v: u16) {
        self.left = self.left.min(start);
        self.right = self.right.max(end - 1);
        self.bottom = v;
        self.area += u32::from(end - start);
    }

    fn merge(&mut self, other: &Self) {
        self.left = self.left.min(other.left);
        self.right = self.right.max(other.right);
        self.top = self.top.min(other.top);
        self.bottom = self.bottom.max(other.bottom);
        self.area += other.area;
    }
}

/// Leftmost and rightmost pixel of each row of a component, top row first.
pub(super) type Outline<'a> = &'a [(u16, u16)];

/// Labels bitmaps; keeps its buffers.
#[derive(Clone, Debug, Default)]
pub(super) struct Labeller {
    runs: Vec<Run>,
    /// Where each row's runs start, and where the last row's end. Each row is closed by `SENTINEL`.
    rows: Vec<u32>,
    /// Label above each label; a root is its own.
    parents: Vec<u32>,
    components: Vec<Component>,
    /// Where a label's outline starts, `NOT_KEPT` where its component is not kept.
    outline_at: Vec<u32>,
    kept: Vec<(u32, u32)>,
    outlines: Vec<(u16, u16)>,
}

const NOT_KEPT: u32 = u32::MAX;

/// Ends every row of runs: touches nothing and is passed by nothing.
const SENTINEL: Run = Run { start: u16::MAX, end: u16::MAX, label: 0 };

impl Labeller {
    /// Finds the components of a bitmap (pixels that touch by a side or a corner) and outlines those that
    /// `keep` accepts. Bitmaps are less than 65 000 pixels wide and high.
    pub fn label(&mut self, bits: &Bitmap, keep: impl Fn(&Component) -> bool) {
        self.find_runs(bits);
        self.gather(keep);
        self.outline();
    }

    /// The kept components with their outlines.
    pub fn kept(&self) -> impl Iterator<Item = (&Component, Outline<'_>)> {
        self.kept.iter().map(|&(label, at)| {
            let component = &self.components[label as usize];
            (component, &self.outlines[at as usize..at as usize + component.height()])
        })
    }

    /// Splits rows into runs and labels them by what they touch in the row above.
    fn find_runs(&mut self, bits: &Bitmap) {
        for buffer in [&mut self.rows, &mut self.parents] {
            buffer.clear();
        }
        self.components.clear();
        self.runs.clear();
        self.runs.push(SENTINEL);
        let mut above = 0;
        for v in 0..bits.height {
            let first = self.runs.len();
            self.rows.push(first as u32);
            split_row(bits.row(v), &mut self.runs);
            self.runs.push(SENTINEL);
            self.label_row(above, first, v as u16);
            above = first;
        }
        self.rows.push(self.runs.len() as u32);
    }

    /// Labels the runs from `first` on; those of the row above start at `above`.
    fn label_row(&mut self, above: usize, first: usize, v: u16) {
        let (upper, lower) = self.runs.split_at_mut(first);
        let upper = &upper[above..];
        let mut up = 0;
        for run in lower.iter_mut() {
            let (start, end) = (run.start, run.end);
            if start == u16::MAX {
                break;
            }
            // Runs that end before this one starts, even diagonally, touch none further right either.
            while upper[up].end < start {
                up += 1;
            }
            if upper[up].start > end {
                run.label = self.parents.len() as u32;
                self.parents.push(run.label);
                self.components.push(Component {
                    left: start,
                    right: end - 1,
                    top: v,
                    bottom: v,
                    area: u32::from(end - start),
                });
                continue;
            }
            let mut label = root(&mut self.parents, upper[up].label);
            while upper[up + 1].start <= end {
                up += 1;
                label = union(&mut self.parents, label, upper[up].label);
            }
            run.label = label;
            self.components[label as usize].add(start, end, v);
        }
    }

    /// Sums labels up into components and finds place for the outlines of those kept.
    fn gather(&mut self, keep: impl Fn(&Component) -> bool) {
        for label in 0..self.parents.len() {
            let parent = self.parents[label] as usize;
            if parent != label {
                // A parent comes before its children, so it is a root by now.
                let root = self.parents[parent];
                self.parents[label] = root;
                let part = self.components[label];
                self.components[root as usize].merge(&part);
            }
        }
        self.kept.clear();
        self.outline_at.clear();
        let mut total = 0;
        for (label, &parent) in self.parents.iter().enumerate() {
            let at = if parent as usize != label {
                self.outline_at[parent as usize]
            } else if keep(&self.components[label]) {
                let at = total;
                self.kept.push((label as u32, at));
                total += self.components[label].height() as u32;
                at
            } else {
                NOT_KEPT
            };
            self.outline_at.push(at);
        }
        self.outlines.clear();
        self.outlines.resize(total as usize, (u16::MAX, 0));
    }

    fn outline(&mut self) {
        if self.kept.is_empty() {
            return;
        }
        for (v, bounds) in self.rows.windows(2).enumerate() {
            for run in &self.runs[bounds[0] as usize..bounds[1] as usize - 1] {
                let at = self.outline_at[run.label as usize];
                if at != NOT_KEPT {
                    let top = self.components[self.parents[run.label as usize] as usize].top;
                    let (left, right) = &mut self.outlines[at as usize + v - usize::from(top)];
                    *left = run.start.min(*left);
                    *right = (run.end - 1).max(*right);
                }
            }
        }
    }
}

/// Appends the runs of a row of bits.
fn split_row(words: &[u64], runs: &mut Vec<Run>) {
    // A set bit where a pixel differs from the one before it; every second one ends a run.
    let (mut carry, mut open, mut start) = (0, false, 0);
    for (index, &word) in words.iter().enumerate() {
        let mut changes = word ^ (word << 1 | carry);
        carry = word >> 63;
        let base = (index * 64) as u16;
        if open && changes != 0 {
            let end = base + changes.trailing_zeros() as u16;
            changes &= changes - 1;
            runs.push(Run { start, end, label: 0 });
            open = false;
        }
        while changes != 0 {
            start = base + changes.trailing_zeros() as u16;
            changes &= changes - 1;
            if changes == 0 {
                open = true;
                break;
            }
            let end = base + changes.trailing_zeros() as u16;
            changes &= changes - 1;
            runs.push(Run { start, end, label: 0 });
        }
    }
    if open {
        runs.push(Run { start, end: (words.len() * 64) as u16, label: 0 });
    }
}

/// Joins two sets, given the first one's root; the earlier root stays root.
fn union(parents: &mut [u32], a: u32, b: u32) -> u32 {
    let b = root(parents, b);
    let (first, second) = (a.min(b), a.max(b));
    parents[second as usize] = first;
    first
}

fn root(parents: &mut [u32], mut i: u32) -> u32 {
    loop {
        let parent = parents[i as usize];
        if parent == i {
            return i;
        }
        let grandparent = parents[parent as usize];
        parents[i as usize] = grandparent;
        i = grandparent;
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Flood fill, the plain way.
    fn flooded(bits: &Bitmap) -> Vec<Component> {
        let dark = |u: usize, v: usize| bits.row(v)[u / 64] >> (u % 64) & 1 == 1;
        let mut seen = vec![false; bits.width * bits.height];
        let mut found = Vec::new();
        for first in 0..seen.len() {
            let (u, v) = (first % bits.width, first / bits.width);
            if seen[first] || !dark(u, v) {
                continue;
            }
            let mut c =
                Component { left: u as u16, right: u as u16, top: v as u16, bottom: v as u16, area: 0 };
            let mut stack = vec![(u, v)];
            seen[first] = true;
            while let Some((u, v)) = stack.pop() {
                c.merge(&Component {
                    left: u as u16,
                    right: u as u16,
                    top: v as u16,
                    bottom: v as u16,
                    area: 1,
                });
                for nv in v.saturating_sub(1)..(v + 2).min(bits.height) {
                    for nu in u.saturating_sub(1)..(u + 2).min(bits.width) {
                        if dark(nu, nv) && !seen[nv * bits.width + nu] {
                            seen[nv * bits.width + nu] = true;
                            stack.push((nu, nv));
                        }
                    }
                }
            }
            found.push(c);
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
            labeller.label(&bits, |_| true);
            let mut labelled: Vec<Component> = labeller.kept().map(|(c, _)| *c).collect();
            let mut expected = flooded(&bits);
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
