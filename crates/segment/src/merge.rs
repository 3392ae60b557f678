//! Joining of neighbouring components: those of like colour, and those too small to stand alone.

use crate::components::{DisjointSets, compact};

/// Components of a label image with what is needed to join them.
#[derive(Debug, Default)]
pub(crate) struct Merger {
    area: Vec<u32>,
    colour: Vec<[f32; 3]>,
    /// Ordered pairs (low, high) of touching labels, each once, with the length of their common border.
    borders: Vec<(u64, u32)>,
    pairs: Vec<u64>,
    sets: DisjointSets,
    nearest: Vec<(f32, u32)>,
}

fn squared_distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    (0..3).map(|c| (a[c] - b[c]) * (a[c] - b[c])).sum()
}

impl Merger {
    /// Measures `count` components of `labels`; `colour_of(i)` is the whitened colour of pixel i.
    pub(crate) fn measure(
        &mut self,
        labels: &[u32],
        width: usize,
        count: usize,
        colour_of: impl Fn(usize) -> [i16; 3],
    ) {
        let mut sums = vec![[0i64; 3]; count];
        self.area.clear();
        self.area.resize(count, 0);
        for (i, &label) in labels.iter().enumerate() {
            let l = label as usize;
            self.area[l] += 1;
            for (s, c) in sums[l].iter_mut().zip(colour_of(i)) {
                *s += i64::from(c);
            }
        }
        self.colour.clear();
        self.colour.extend(sums.iter().zip(&self.area).map(|(s, &a)| s.map(|v| v as f32 / a as f32)));
        self.pairs.clear();
        let mut touch = |a: u32, b: u32| {
            if a != b {
                self.pairs.push((u64::from(a.min(b)) << 32) | u64::from(a.max(b)));
            }
        };
        for (y, line) in labels.chunks_exact(width).enumerate() {
            for w in line.windows(2) {
                touch(w[0], w[1]);
            }
            if let Some(next) = labels.get((y + 1) * width..(y + 2) * width) {
                for (&a, &b) in line.iter().zip(next) {
                    touch(a, b);
                }
            }
        }
        self.count_borders();
        self.sets.reset(count);
    }

    fn count_borders(&mut self) {
        self.pairs.sort_unstable();
        self.borders.clear();
        for &pair in &self.pairs {
            match self.borders.last_mut() {
                Some((last, length)) if *last == pair => *length += 1,
                _ => self.borders.push((pair, 1)),
            }
        }
    }

    /// Joins neighbours whose mean colours are at most `distance` units apart, closest first.
    pub(crate) fn join_alike(&mut self, distance: f32) {
        loop {
            let mut candidates: Vec<(f32, u32, u32)> = self
                .borders
                .iter()
                .map(|&(pair, _)| ((pair >> 32) as u32, pair as u32))
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
            for &(pair, _) in &self.borders {
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

    /// Rewrites the borders in terms of the roots.
    fn collapse(&mut self) {
        for (pair, _) in &mut self.borders {
            let (a, b) = (self.sets.find((*pair >> 32) as u32), self.sets.find(*pair as u32));
            *pair = (u64::from(a.min(b)) << 32) | u64::from(a.max(b));
        }
        self.borders.retain(|&(pair, _)| (pair >> 32) as u32 != pair as u32);
        self.borders.sort_unstable_by_key(|&(pair, _)| pair);
        self.borders.dedup_by(|next, kept| {
            let same = next.0 == kept.0;
            if same {
                kept.1 += next.1;
            }
            same
        });
    }

    /// Replaces labels by dense ones of the joined components; returns their number.
    pub(crate) fn relabel(&mut self, labels: &mut [u32]) -> usize {
        compact(&mut self.sets, labels)
    }
}
