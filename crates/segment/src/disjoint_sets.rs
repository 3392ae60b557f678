//! Disjoint sets of dense integers (union-find).

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

    /// Numbers the sets densely in the order of their smallest members.
    pub(crate) fn numbers(&mut self) -> Numbers {
        let mut labels = vec![u32::MAX; self.parent.len()];
        let mut count = 0;
        for i in 0..labels.len() {
            // The smallest member is the root, so it comes first.
            let root = self.find(i as u32) as usize;
            if labels[root] == u32::MAX {
                labels[root] = count;
                count += 1;
            }
            labels[i] = labels[root];
        }
        Numbers { labels, count: count as usize }
    }
}

/// Dense numbers of sets, by member.
pub(crate) struct Numbers {
    pub(crate) labels: Vec<u32>,
    pub(crate) count: usize,
}
