//! The rows of a label image as runs of one label: all later stages walk runs, not pixels.

use std::ops::Range;

use rayon::prelude::*;

use crate::disjoint_sets::DisjointSets;

/// Columns `start .. end` of a row carry `label`; `end` is the start of the next run or the width.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Run {
    /// First column.
    pub start: u32,
    /// One past the last column.
    pub end: u32,
    /// The label of all of them.
    pub label: u32,
}

/// The runs of every row, from top to bottom.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Runs {
    rows: Vec<Vec<Run>>,
}

impl Runs {
    /// Reads the runs of a label image of `width` columns.
    pub(crate) fn fill(&mut self, labels: &[u32], width: usize) {
        self.rows.resize_with(labels.len() / width, Vec::new);
        self.rows.par_iter_mut().zip(labels.par_chunks_exact(width)).with_min_len(16).for_each(|(runs, line)| {
            runs.clear();
            let mut start = 0;
            while start < line.len() {
                let end = start + equal_at_start(&line[start..]);
                runs.push(Run { start: start as u32, end: end as u32, label: line[start] });
                start = end;
            }
        });
    }

    /// Reads the runs of pixels that are `alike` with their left neighbour; `label` of the first pixel becomes theirs.
    pub(crate) fn fill_alike<P: Sync>(
        &mut self,
        pixels: &[P],
        width: usize,
        alike: impl Fn(&P, &P) -> bool + Sync,
        label: impl Fn(&P) -> u32 + Sync,
    ) {
        self.rows.resize_with(pixels.len() / width, Vec::new);
        self.rows.par_iter_mut().zip(pixels.par_chunks_exact(width)).with_min_len(16).for_each(|(runs, line)| {
            runs.clear();
            let mut start = 0;
            for run in line.chunk_by(|a, b| alike(a, b)) {
                let end = start + run.len() as u32;
                runs.push(Run { start, end, label: label(&run[0]) });
                start = end;
            }
        });
    }

    /// Becomes an image without rows.
    pub(crate) fn clear(&mut self) {
        self.rows.clear();
    }

    /// The runs of row `y`, from left to right; none for a row outside of the image.
    pub fn row(&self, y: usize) -> &[Run] {
        self.rows.get(y).map_or(&[], Vec::as_slice)
    }

    /// All rows from top to bottom.
    pub fn rows(&self) -> &[Vec<Run>] {
        &self.rows
    }

    /// Gives every 4-connected component of equal label a label of its own, dense, in order of first appearance, and
    /// returns their number.
    pub(crate) fn split_components(&mut self, sets: &mut DisjointSets) -> usize {
        self.split_where(sets, |_, above, below, _| above.label == below.label)
    }

    /// As [`Runs::split_components`], where a run belongs to one above when `joined(y, above, below, columns)`, with y
    /// the row of the lower run and the columns that both share.
    pub(crate) fn split_where(
        &mut self,
        sets: &mut DisjointSets,
        joined: impl Fn(usize, &Run, &Run, Range<u32>) -> bool + Sync,
    ) -> usize {
        let contacts: Vec<Vec<(u32, u32)>> = self
            .rows
            .par_windows(2)
            .enumerate()
            .with_min_len(16)
            .map(|(y, rows)| {
                let mut contacts = Vec::new();
                for_each_contact(&rows[0], &rows[1], |i, j, columns| {
                    if joined(y + 1, &rows[0][i], &rows[1][j], columns) {
                        contacts.push((i as u32, j as u32));
                    }
                });
                contacts
            })
            .collect();
        sets.reset(self.rows.iter().map(Vec::len).sum());
        let mut first_above = 0;
        for (above, contacts) in self.rows.iter().zip(&contacts) {
            let first = first_above + above.len() as u32;
            for &(i, j) in contacts {
                sets.union(first_above + i, first + j);
            }
            first_above = first;
        }
        let numbers = sets.numbers();
        for (run, &number) in self.rows.iter_mut().flatten().zip(&numbers.labels) {
            run.label = number;
        }
        numbers.count
    }

    /// Replaces label l by `new[l]` and joins neighbours that thereby become one run.
    pub(crate) fn relabel(&mut self, new: &[u32]) {
        self.rows.par_iter_mut().with_min_len(64).for_each(|row| {
            for run in row.iter_mut() {
                run.label = new[run.label as usize];
            }
            row.dedup_by(|next, kept| {
                let same = next.label == kept.label;
                if same {
                    kept.end = next.end;
                }
                same
            });
        });
    }

    /// Writes the label image.
    pub(crate) fn write(&self, labels: &mut [u32], width: usize) {
        labels.par_chunks_exact_mut(width).zip(&self.rows).with_min_len(16).for_each(|(line, row)| {
            for run in row {
                line[run.start as usize..run.end as usize].fill(run.label);
            }
        });
    }
}

/// How many labels at the beginning are equal; at least one of a line that has any.
fn equal_at_start(line: &[u32]) -> usize {
    // Most runs are long: so many labels are compared at once.
    const BLOCK: usize = 16;
    let Some(first) = line.first() else { return 0 };
    let differs = |block: &[u32; BLOCK]| block.iter().fold(0, |any, label| any | (label ^ first)) != 0;
    let whole = line.as_chunks::<BLOCK>().0.iter().take_while(|block| !differs(block)).count() * BLOCK;
    whole + line[whole..].iter().take_while(|label| *label == first).count()
}

/// Calls `f(i, j, columns)` for every run i of `above` and j of `below` that share columns.
pub(crate) fn for_each_contact(above: &[Run], below: &[Run], mut f: impl FnMut(usize, usize, Range<u32>)) {
    let (mut i, mut j) = (0, 0);
    while let (Some(a), Some(b)) = (above.get(i), below.get(j)) {
        let (from, to) = (a.start.max(b.start), a.end.min(b.end));
        if to > from {
            f(i, j, from..to);
        }
        if a.end <= b.end {
            i += 1;
        }
        if b.end <= a.end {
            j += 1;
        }
    }
}
