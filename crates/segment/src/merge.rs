//! Joining of neighbouring components: those of like colour, and those too small to stand alone.

use crate::disjoint_sets::{DisjointSets, Numbers};
use crate::runs::{Run, Runs, for_each_contact};

/// Components of a label image with what is needed to join them.
#[derive(Debug, Default)]
pub(crate) struct Merger {
    area: Vec<u32>,
    colour: Vec<[f32; 3]>,
    sums: Vec<[i64; 3]>,
    /// Ordered pairs (low << 32 | high) of touching labels, each once.
    pairs: Vec<u64>,
    sets: DisjointSets,
    nearest: Vec<(f32, u32)>,
}

fn squared_distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    (0..3).map(|c| (a[c] - b[c]) * (a[c] - b[c])).sum()
}

impl Merger {
    /// Measures `count` components of a label image given as runs; `colours(y, run)` is the sum of the colours of a
    /// run of row y.
    pub(crate) fn measure(&mut self, runs: &Runs, count: usize, colours: impl Fn(usize, &Run) -> [i32; 3]) {
        self.sums.clear();
        self.sums.resize(count, [0; 3]);
        self.area.clear();
        self.area.resize(count, 0);
        for (y, row) in runs.rows().iter().enumerate() {
            for run in row {
                let label = run.label as usize;
                self.area[label] += run.end - run.start;
                for (s, c) in self.sums[label].iter_mut().zip(colours(y, run)) {
                    *s += i64::from(c);
                }
            }
        }
        self.find_pairs(runs);
    }

    /// Takes the components of a label image, of which area and sum of colours are known.
    pub(crate) fn take(&mut self, runs: &Runs, components: impl Iterator<Item = (u32, [i64; 3])>) {
        self.sums.clear();
        self.area.clear();
        for (area, sum) in components {
            self.area.push(area);
            self.sums.push(sum);
        }
        self.find_pairs(runs);
    }

    /// Colours and neighbours.
    fn find_pairs(&mut self, runs: &Runs) {
        self.pairs.clear();
        let pair = |a: u32, b: u32| (u64::from(a.min(b)) << 32) | u64::from(a.max(b));
        for (y, row) in runs.rows().iter().enumerate() {
            // Neighbours in a row can be one component by way of another row.
            let beside = row.windows(2).filter(|w| w[0].label != w[1].label);
            self.pairs.extend(beside.map(|w| pair(w[0].label, w[1].label)));
            let below = runs.row(y + 1);
            for_each_contact(row, below, |i, j, _| {
                if row[i].label != below[j].label {
                    self.pairs.push(pair(row[i].label, below[j].label));
                }
            });
        }
        self.colour.clear();
        self.colour.extend(self.sums.iter().zip(&self.area).map(|(s, &a)| s.map(|v| v as f32 / a as f32)));
        self.pairs.sort_unstable();
        self.pairs.dedup();
        self.sets.reset(self.area.len());
    }

    /// Joins neighbours whose mean colours are at most `distance` units apart, closest first.
    pub(crate) fn join_alike(&mut self, distance: f32) {
        loop {
            let mut candidates: Vec<(f32, u32, u32)> = self
                .pairs
                .iter()
                .map(|&pair| ((pair >> 32) as u32, pair as u32))
                .map(|(a, b)| (squared_distance(self.colour[a as usize], self.colour[b as usize]), a, b))
                .filter(|&(d, _, _)| d <= distance * distance)
                .collect();
            if candidates.is_empty() {
                return;
            }
            candidates.sort_unstable_by(|p, q| p.0.total_cmp(&q.0).then((p.1, p.2).cmp(&(q.1, q.2))));
            for (_, a, b) in candidates {
                // Colours move as components grow: ask again.
                let (a, b) = (self.sets.find(a), self.sets.find(b));
                if a != b && squared_distance(self.colour[a as usize], self.colour[b as usize]) <= distance * distance {
                    self.join(a, b);
                }
            }
            self.collapse();
        }
    }

    /// Joins every component smaller than `min_area` to its neighbour closest in colour, smallest first.
    pub(crate) fn join_small(&mut self, min_area: u32) {
        loop {
            self.nearest.clear();
            self.nearest.resize(self.area.len(), (f32::INFINITY, u32::MAX));
            for &pair in &self.pairs {
                let (a, b) = ((pair >> 32) as u32, pair as u32);
                let d = squared_distance(self.colour[a as usize], self.colour[b as usize]);
                for (from, to) in [(a, b), (b, a)] {
                    let best = &mut self.nearest[from as usize];
                    if d < best.0 {
                        *best = (d, to);
                    }
                }
            }
            let mut small: Vec<(u32, u32)> = (0..self.area.len() as u32)
                .filter(|&i| self.area[i as usize] < min_area && self.sets.find(i) == i)
                .filter(|&i| self.nearest[i as usize].1 != u32::MAX)
                .map(|i| (self.area[i as usize], i))
                .collect();
            if small.is_empty() {
                return;
            }
            small.sort_unstable();
            for (_, i) in small {
                let a = self.sets.find(i);
                // It may have grown enough in this round.
                if self.area[a as usize] < min_area {
                    let b = self.sets.find(self.nearest[i as usize].1);
                    if a != b {
                        self.join(a, b);
                    }
                }
            }
            self.collapse();
        }
    }

    fn join(&mut self, a: u32, b: u32) {
        let (na, nb) = (self.area[a as usize], self.area[b as usize]);
        let (ca, cb) = (self.colour[a as usize], self.colour[b as usize]);
        let root = self.sets.union(a, b) as usize;
        let (wa, wb) = (na as f32 / (na + nb) as f32, nb as f32 / (na + nb) as f32);
        self.area[root] = na + nb;
        for c in 0..3 {
            self.colour[root][c] = ca[c] * wa + cb[c] * wb;
        }
    }

    /// Rewrites the pairs in terms of the roots.
    fn collapse(&mut self) {
        for pair in &mut self.pairs {
            let (a, b) = (self.sets.find((*pair >> 32) as u32), self.sets.find(*pair as u32));
            *pair = (u64::from(a.min(b)) << 32) | u64::from(a.max(b));
        }
        self.pairs.retain(|&pair| (pair >> 32) as u32 != pair as u32);
        self.pairs.sort_unstable();
        self.pairs.dedup();
    }

    /// Dense numbers of the joined components, by old label.
    pub(crate) fn numbers(&mut self) -> Numbers {
        self.sets.numbers()
    }
}
