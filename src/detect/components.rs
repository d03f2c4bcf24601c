//! Connected dark regions from runs of bits: no per-pixel labels, no hash maps.

use super::binarise::Bitmap;

/// Dark pixels `start..end` of row `v`.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
struct Run {
    v: u16,
    start: u16,
    end: u16,
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
}

/// Leftmost and rightmost pixel of each row of a component, top row first.
pub(super) type Outline<'a> = &'a [(u16, u16)];

/// Labels bitmaps; keeps its buffers.
#[derive(Clone, Debug, Default)]
pub(super) struct Labeller {
    runs: Vec<Run>,
    parents: Vec<u32>,
    components: Vec<Component>,
    /// Where a kept component's outline starts, `NOT_KEPT` otherwise.
    outline_at: Vec<u32>,
    outlines: Vec<(u16, u16)>,
}

const NOT_KEPT: u32 = u32::MAX;

impl Labeller {
    /// Finds the components of a bitmap (pixels that touch by a side or a corner) and outlines those that
    /// `keep` accepts.
    pub fn label(&mut self, bits: &Bitmap, keep: impl Fn(&Component) -> bool) {
        self.find_runs(bits);
        self.gather();
        self.outline_at.clear();
        let mut total = 0u32;
        for component in &self.components {
            let kept = keep(component);
            self.outline_at.push(if kept { total } else { NOT_KEPT });
            total += if kept { component.height() as u32 } else { 0 };
        }
        self.outlines.clear();
        self.outlines.resize(total as usize, (u16::MAX, 0));
        for (run, &component) in self.runs.iter().zip(&self.parents) {
            let at = self.outline_at[component as usize];
            if at != NOT_KEPT {
                let row = run.v - self.components[component as usize].top;
                let (left, right) = &mut self.outlines[at as usize + usize::from(row)];
                *left = run.start.min(*left);
                *right = (run.end - 1).max(*right);
            }
        }
    }

    /// The kept components with their outlines.
    pub fn kept(&self) -> impl Iterator<Item = (&Component, Outline<'_>)> {
        self.components.iter().zip(&self.outline_at).filter(|(_, at)| **at != NOT_KEPT).map(|(c, &at)| {
            let at = at as usize;
            (c, &self.outlines[at..at + c.height()])
        })
    }

    /// Splits rows into runs and joins those that touch a run of the row above.
    fn find_runs(&mut self, bits: &Bitmap) {
        self.runs.clear();
        self.parents.clear();
        let (mut above, mut above_end) = (0, 0);
        for v in 0..bits.height {
            let first = self.runs.len();
            self.runs_of_row(bits.row(v), v as u16);
            let mut up = above;
            for here in first..self.runs.len() {
                let run = self.runs[here];
                // Runs above that end before this one starts, even diagonally, touch none further right.
                while up < above_end && self.runs[up].end < run.start {
                    up += 1;
                }
                let mut next = up;
                while next < above_end && self.runs[next].start <= run.end {
                    union(&mut self.parents, next as u32, here as u32);
                    next += 1;
                }
                // The last one may reach over the next run of this row too.
                up = next.saturating_sub(1).max(up);
            }
            (above, above_end) = (first, self.runs.len());
        }
    }

    fn runs_of_row(&mut self, words: &[u64], v: u16) {
        let (mut carry, mut start) = (0, None);
        for (index, &word) in words.iter().enumerate() {
            // A set bit where a pixel differs from the one before it.
            let mut changes = word ^ (word << 1 | carry);
            carry = word >> 63;
            while changes != 0 {
                let u = (index * 64) as u16 + changes.trailing_zeros() as u16;
                changes &= changes - 1;
                start = match start {
                    None => Some(u),
                    Some(start) => {
                        self.push(Run { v, start, end: u });
                        None
                    }
                };
            }
        }
        if let Some(start) = start {
            self.push(Run { v, start, end: (words.len() * 64) as u16 });
        }
    }

    fn push(&mut self, run: Run) {
        self.parents.push(self.runs.len() as u32);
        self.runs.push(run);
    }

    /// Turns `parents` into component numbers and sums up the components. Roots come before the runs they
    /// stand for, so that one pass does it.
    fn gather(&mut self) {
        self.components.clear();
        for (i, run) in self.runs.iter().enumerate() {
            let parent = self.parents[i] as usize;
            if parent == i {
                self.parents[i] = self.components.len() as u32;
                self.components.push(Component {
                    left: run.start,
                    right: run.end - 1,
                    top: run.v,
                    bottom: run.v,
                    area: u32::from(run.end - run.start),
                });
                continue;
            }
            let number = self.parents[parent];
            self.parents[i] = number;
            let component = &mut self.components[number as usize];
            component.left = component.left.min(run.start);
            component.right = component.right.max(run.end - 1);
            component.bottom = run.v;
            component.area += u32::from(run.end - run.start);
        }
    }
}

/// Joins two sets; the earlier root stays root.
fn union(parents: &mut [u32], a: u32, b: u32) {
    let (a, b) = (root(parents, a), root(parents, b));
    let (first, second) = (a.min(b), a.max(b));
    parents[second as usize] = first;
}

fn root(parents: &mut [u32], mut i: u32) -> u32 {
    while parents[i as usize] != i {
        let grandparent = parents[parents[i as usize] as usize];
        parents[i as usize] = grandparent;
        i = grandparent;
    }
    i
}
