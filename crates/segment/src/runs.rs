//! The rows of a label image as runs of one label: all later stages walk runs, not pixels.

use rayon::prelude::*;

use crate::components::{DisjointSets, compact_of};

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
            for run in line.chunk_by(|a, b| a == b) {
                let end = start + run.len() as u32;
                runs.push(Run { start, end, label: run[0] });
                start = end;
            }
        });
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
        sets.reset(self.rows.iter().map(Vec::len).sum());
        let mut first_above = 0;
        for y in 1..self.rows.len() {
            let (above, row) = (&self.rows[y - 1], &self.rows[y]);
            let first = first_above + above.len();
            for_each_contact(above, row, |i, j, _| {
                if above[i].label == row[j].label {
                    sets.union((first_above + i) as u32, (first + j) as u32);
                }
            });
            first_above = first;
        }
        let numbers = compact_of(sets);
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

/// Calls `f(i, j, length)` for every run i of `above` and j of `below` that share `length` columns.
pub(crate) fn for_each_contact(above: &[Run], below: &[Run], mut f: impl FnMut(usize, usize, u32)) {
    let (mut i, mut j) = (0, 0);
    while let (Some(a), Some(b)) = (above.get(i), below.get(j)) {
        let (from, to) = (a.start.max(b.start), a.end.min(b.end));
        if to > from {
            f(i, j, to - from);
        }
        if a.end <= b.end {
            i += 1;
        }
        if b.end <= a.end {
            j += 1;
        }
    }
}
