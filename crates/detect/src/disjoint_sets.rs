//! Disjoint sets as a forest of parents.

/// Joins two sets; the earlier root stays root.
#[inline(always)]
pub(super) fn union(parents: &mut [u32], a: u32, b: u32) {
    let (a, b) = (root(parents, a), root(parents, b));
    parents[a.max(b) as usize] = a.min(b);
}

/// The root of a set; the path to it is halved.
#[inline(always)]
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
