//! Label counts of square cells, at a base size and at its doublings.

use rayon::prelude::*;

use crate::runs::Runs;

/// The pixels of one label in one cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Entry {
    pub(crate) label: u32,
    pub(crate) count: u32,
    /// Centre of these pixels, px of the image.
    pub(crate) x: f32,
    pub(crate) y: f32,
}

/// A grid of square cells, each with the labels in it, ascending.
#[derive(Debug, Default)]
pub(crate) struct CellGrid {
    pub(crate) columns: usize,
    /// Side of a cell, px.
    pub(crate) side: usize,
    rows: Vec<CellRow>,
}

/// One row of cells: the entries of cell x are `entries[start[x] .. start[x + 1]]`.
#[derive(Debug, Default)]
pub(crate) struct CellRow {
    pub(crate) start: Vec<u32>,
    pub(crate) entries: Vec<Entry>,
}

impl CellRow {
    /// The labels of cell `x`.
    pub(crate) fn cell(&self, x: usize) -> &[Entry] {
        &self.entries[self.start[x] as usize..self.start[x + 1] as usize]
    }

    /// Where label is in cell `x`, as an index into `entries`.
    pub(crate) fn find(&self, x: usize, label: u32) -> Option<usize> {
        let start = self.start[x] as usize;
        self.cell(x).iter().position(|e| e.label == label).map(|i| start + i)
    }
}

impl CellGrid {
    pub(crate) fn rows(&self) -> &[CellRow] {
        &self.rows
    }

    /// Counts the labels of cells of `side` px.
    pub(crate) fn fill(&mut self, runs: &Runs, width: usize, side: usize) {
        let height = runs.height();
        self.side = side;
        self.columns = width.div_ceil(side);
        self.rows.resize_with(height.div_ceil(side), CellRow::default);
        let columns = self.columns;
        self.rows.par_iter_mut().enumerate().with_min_len(4).for_each_init(Chains::default, |chains, (cy, row)| {
            chains.clear(columns);
            for y in cy * side..((cy + 1) * side).min(height) {
                for run in runs.row(y) {
                    let (start, end) = (run.start as usize, run.end as usize);
                    for cx in start / side..=(end - 1) / side {
                        let (from, to) = (start.max(cx * side), end.min((cx + 1) * side));
                        let n = (to - from) as f32;
                        let middle = (from + to - 1) as f32 * 0.5;
                        chains.add(cx, run.label, (to - from) as u32, middle * n, y as f32 * n);
                    }
                }
            }
            chains.write(row);
        });
    }

    /// Joins 2 x 2 cells of `finer`.
    pub(crate) fn fill_doubled(&mut self, finer: &Self) {
        self.side = finer.side * 2;
        self.columns = finer.columns.div_ceil(2);
        self.rows.resize_with(finer.rows.len().div_ceil(2), CellRow::default);
        let columns = self.columns;
        self.rows.par_iter_mut().enumerate().with_min_len(4).for_each_init(Chains::default, |chains, (cy, row)| {
            chains.clear(columns);
            for fine in &finer.rows[cy * 2..(cy * 2 + 2).min(finer.rows.len())] {
                for cx in 0..finer.columns {
                    for e in fine.cell(cx) {
                        let n = e.count as f32;
                        chains.add(cx / 2, e.label, e.count, e.x * n, e.y * n);
                    }
                }
            }
            chains.write(row);
        });
    }
}

/// Entries of one row of cells while they are counted: a linked list a cell, one or two links long for most.
#[derive(Default)]
struct Chains {
    first: Vec<u32>,
    links: Vec<(Entry, u32)>,
}

const END: u32 = u32::MAX;

impl Chains {
    fn clear(&mut self, columns: usize) {
        self.first.clear();
        self.first.resize(columns, END);
        self.links.clear();
    }

    fn add(&mut self, cell: usize, label: u32, count: u32, sum_x: f32, sum_y: f32) {
        let mut at = self.first[cell];
        while at != END {
            let (entry, next) = &mut self.links[at as usize];
            if entry.label == label {
                entry.count += count;
                entry.x += sum_x;
                entry.y += sum_y;
                return;
            }
            at = *next;
        }
        self.links.push((Entry { label, count, x: sum_x, y: sum_y }, self.first[cell]));
        self.first[cell] = self.links.len() as u32 - 1;
    }

    fn write(&self, row: &mut CellRow) {
        row.start.clear();
        row.entries.clear();
        for &first in &self.first {
            let start = row.entries.len();
            row.start.push(start as u32);
            let mut at = first;
            while at != END {
                let (entry, next) = self.links[at as usize];
                let n = entry.count as f32;
                row.entries.push(Entry { x: entry.x / n, y: entry.y / n, ..entry });
                at = next;
            }
            row.entries[start..].sort_unstable_by_key(|e| e.label);
        }
        row.start.push(row.entries.len() as u32);
    }
}
