//! 4-connected components of a label or mode image, by runs and union-find.

/// Disjoint sets of dense integers; the smallest member is the root, so results do not depend on the order of unions.
#[derive(Debug, Default)]
pub(crate) struct DisjointSets {
    parent: Vec<u32>,
}

impl DisjointSets {
    /// Forgets everything and makes `count` sets of one member.
    pub(crate) fn reset(&mut self, count: usize) {
        self.parent.clear();
        self.parent.extend(0..count as u32);
    }

    /// Adds a set of one member and returns it.
    pub(crate) fn add(&mut self) -> u32 {
        let new = self.parent.len() as u32;
        self.parent.push(new);
        new
    }

    /// Number of members of all sets.
    pub(crate) fn len(&self) -> usize {
        self.parent.len()
    }

    /// The root of the set of `i`.
    pub(crate) fn find(&mut self, mut i: u32) -> u32 {
        while self.parent[i as usize] != i {
            let grandparent = self.parent[self.parent[i as usize] as usize];
            self.parent[i as usize] = grandparent;
            i = grandparent;
        }
        i
    }

    /// Joins two sets and returns the root.
    pub(crate) fn union(&mut self, a: u32, b: u32) -> u32 {
        let (a, b) = (self.find(a), self.find(b));
        let (low, high) = (a.min(b), a.max(b));
        self.parent[high as usize] = low;
        low
    }
}

/// Labels the 4-connected components of pixels that are `alike` with their left or upper neighbour.
///
/// `alike(i, j)` is asked for indices of neighbouring pixels. `labels` receives dense labels in the order in which
/// components first appear; the number of components is returned.
pub(crate) fn label_components(
    width: usize,
    height: usize,
    alike: impl Fn(usize, usize) -> bool,
    sets: &mut DisjointSets,
    labels: &mut Vec<u32>,
) -> usize {
    sets.reset(0);
    labels.clear();
    labels.reserve(width * height);
    for y in 0..height {
        let mut above_joined = u32::MAX;
        for x in 0..width {
            let i = y * width + x;
            let left = x > 0 && alike(i, i - 1);
            let up = y > 0 && alike(i, i - width);
            let label = match (left, up) {
                (true, true) => {
                    let (l, u) = (labels[i - 1], labels[i - width]);
                    // Along a run the same pair repeats.
                    if l != u && u != above_joined {
                        sets.union(l, u);
                        above_joined = u;
                    }
                    l
                }
                (true, false) => labels[i - 1],
                (false, true) => {
                    above_joined = u32::MAX;
                    labels[i - width]
                }
                (false, false) => {
                    above_joined = u32::MAX;
                    sets.add()
                }
            };
            labels.push(label);
        }
    }
    compact(sets, labels)
}

/// Dense numbers of sets, by member, in order of first appearance.
pub(crate) struct Numbers {
    pub(crate) labels: Vec<u32>,
    pub(crate) count: usize,
}

/// Numbers the sets densely in the order of their smallest members.
pub(crate) fn compact_of(sets: &mut DisjointSets) -> Numbers {
    let mut labels = vec![u32::MAX; sets.len()];
    let mut count = 0;
    for i in 0..sets.len() {
        // The smallest member is the root, so it comes first.
        let root = sets.find(i as u32) as usize;
        if labels[root] == u32::MAX {
            labels[root] = count;
            count += 1;
        }
        labels[i] = labels[root];
    }
    Numbers { labels, count: count as usize }
}

/// Replaces every label by the dense number of its set; returns the number of sets.
pub(crate) fn compact(sets: &mut DisjointSets, labels: &mut [u32]) -> usize {
    let numbers = compact_of(sets);
    for label in labels.iter_mut() {
        *label = numbers.labels[*label as usize];
    }
    numbers.count
}
