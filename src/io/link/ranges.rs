//! Sets of sequence numbers, kept as ranges.

/// A set of `u32` as sorted, disjoint, non-adjacent half-open ranges.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct RangeSet {
    ranges: Vec<(u32, u32)>,
}

impl RangeSet {
    /// Nothing.
    pub const fn new() -> Self {
        Self { ranges: Vec::new() }
    }

    /// The numbers `first..end`.
    pub fn of(first: u32, end: u32) -> Self {
        let mut set = Self::new();
        set.insert_range(first, end);
        set
    }

    /// Index of the first range that ends after `n`.
    fn at(&self, n: u32) -> usize {
        self.ranges.partition_point(|&(_, end)| end <= n)
    }

    /// Whether `n` is in it.
    pub fn contains(&self, n: u32) -> bool {
        self.ranges.get(self.at(n)).is_some_and(|&(first, _)| first <= n)
    }

    /// Adds one number; returns whether it was new.
    pub fn insert(&mut self, n: u32) -> bool {
        if self.contains(n) || n == u32::MAX {
            return false;
        }
        self.insert_range(n, n + 1);
        true
    }

    /// Adds `first..end`.
    pub fn insert_range(&mut self, first: u32, end: u32) {
        if first >= end {
            return;
        }
        // Ranges that touch or overlap the new one are merged into it.
        let from = self.ranges.partition_point(|&(_, e)| e < first);
        let to = self.ranges.partition_point(|&(f, _)| f <= end);
        let mut merged = (first, end);
        if from < to {
            merged = (first.min(self.ranges[from].0), end.max(self.ranges[to - 1].1));
        }
        self.ranges.splice(from..to, [merged]);
    }

    /// Removes `first..end`.
    pub fn remove_range(&mut self, first: u32, end: u32) {
        if first >= end {
            return;
        }
        let from = self.at(first);
        let to = self.ranges.partition_point(|&(f, _)| f < end);
        if from >= to {
            return;
        }
        let left = (self.ranges[from].0, first);
        let right = (end, self.ranges[to - 1].1);
        let rest = [left, right].into_iter().filter(|(f, e)| f < e);
        self.ranges.splice(from..to, rest);
    }

    /// The numbers of `first..end` that are not in it, ascending.
    pub fn missing(&self, first: u32, end: u32) -> impl Iterator<Item = (u32, u32)> + '_ {
        let mut at = first;
        let from = self.at(first);
        let covered = self.ranges[from..].iter().copied().chain([(end, end)]);
        covered
            .map_while(move |(f, e)| {
                if at >= end {
                    return None;
                }
                let gap = (at, f.min(end));
                at = at.max(e);
                Some(gap)
            })
            .filter(|(f, e)| f < e)
    }

    /// The ranges, ascending.
    pub fn iter(&self) -> impl Iterator<Item = (u32, u32)> + '_ {
        self.ranges.iter().copied()
    }

    /// How many ranges.
    pub fn ranges(&self) -> usize {
        self.ranges.len()
    }

    /// How many numbers.
    pub fn len(&self) -> u64 {
        self.ranges.iter().map(|&(first, end)| u64::from(end - first)).sum()
    }

    /// Whether it is empty.
    pub fn is_empty(&self) -> bool {
        self.ranges.is_empty()
    }

    /// One more than the greatest number; 0 when empty.
    pub fn end(&self) -> u32 {
        self.ranges.last().map_or(0, |&(_, end)| end)
    }

    /// Adds everything of another set.
    pub fn union(&mut self, other: &Self) {
        for (first, end) in other.iter() {
            self.insert_range(first, end);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use proptest::prelude::*;

    use super::*;

    #[derive(Clone, Debug)]
    enum Step {
        Insert(u32),
        InsertRange(u32, u32),
        RemoveRange(u32, u32),
    }

    fn step() -> impl Strategy<Value = Step> {
        prop_oneof![
            (0_u32..60).prop_map(Step::Insert),
            (0_u32..60, 0_u32..60).prop_map(|(a, b)| Step::InsertRange(a, b)),
            (0_u32..60, 0_u32..60).prop_map(|(a, b)| Step::RemoveRange(a, b)),
        ]
    }

    proptest! {
        #[test]
        fn behaves_as_a_set_of_numbers(steps in prop::collection::vec(step(), 0..60)) {
            let (mut set, mut model) = (RangeSet::new(), BTreeSet::new());
            for step in steps {
                match step {
                    Step::Insert(n) => prop_assert_eq!(set.insert(n), model.insert(n)),
                    Step::InsertRange(a, b) => {
                        set.insert_range(a, b);
                        model.extend(a..b);
                    }
                    Step::RemoveRange(a, b) => {
                        set.remove_range(a, b);
                        model.retain(|n| !(a..b).contains(n));
                    }
                }
                prop_assert_eq!(set.len(), model.len() as u64);
                let flat: BTreeSet<u32> = set.iter().flat_map(|(f, e)| f..e).collect();
                prop_assert_eq!(&flat, &model);
                let apart = set.ranges.windows(2).all(|w| w[0].1 < w[1].0);
                prop_assert!(apart, "{:?}", set);
                let gaps: Vec<u32> = set.missing(5, 50).flat_map(|(f, e)| f..e).collect();
                let want: Vec<u32> = (5..50).filter(|n| !model.contains(n)).collect();
                prop_assert_eq!(gaps, want);
            }
        }
    }
}
