//! Label counts of square cells, at a base size and at its doublings.

use std::ops::Range;

use rayon::prelude::*;
use samsod_segment::Runs;

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
    /// Summed-area table, `columns + 1` a row, of the cells that hold several labels or differ from the cell to the
    /// right or below.
    changes: Vec<u32>,
}

/// One row of cells: the entries of cell x are `entries[start[x] .. start[x + 1]]`.
#[derive(Debug, Default)]
pub(crate) struct CellRow {
    start: Vec<u32>,
    pub(crate) entries: Vec<Entry>,
    /// The row from left to right: stretches of cells of one label, and cells of several labels.
    spans: Vec<Span>,
    /// The span of every cell.
    span_of: Vec<u32>,
}

/// Neighbouring cells that hold one label only, or a single cell of several labels (then `label` is none).
#[derive(Debug, Clone, Copy)]
pub(crate) struct Span {
    pub(crate) first_cell: u32,
    pub(crate) end_cell: u32,
    pub(crate) label: Option<u32>,
}

impl CellRow {
    /// The labels of cell `x`.
    pub(crate) fn cell(&self, x: usize) -> &[Entry] {
        &self.entries[self.start[x] as usize..self.start[x + 1] as usize]
    }

    /// The spans from the one that holds cell `x` on.
    pub(crate) fn spans_from(&self, x: usize) -> &[Span] {
        &self.spans[self.span_of[x] as usize..]
    }

    /// Where label is in cell `x`, as an index into `entries`.
    pub(crate) fn find(&self, x: usize, label: u32) -> Option<usize> {
        let start = self.start[x] as usize;
        self.cell(x).iter().position(|e| e.label == label).map(|i| start + i)
    }
}

impl CellRow {
    fn only_label(&self, x: usize) -> Option<u32> {
        self.spans[self.span_of[x] as usize].label
    }

    fn join_spans(&mut self) {
        self.spans.clear();
        self.span_of.clear();
        for x in 0..self.start.len() - 1 {
            let label = match self.cell(x) {
                [only] => Some(only.label),
                _ => None,
            };
            match self.spans.last_mut() {
                Some(last) if label.is_some() && last.label == label => last.end_cell += 1,
                _ => self.spans.push(Span { first_cell: x as u32, end_cell: x as u32 + 1, label }),
            }
            self.span_of.push(self.spans.len() as u32 - 1);
        }
    }
}

impl CellGrid {
    fn sum_changes(&mut self) {
        let columns = self.columns;
        self.changes.clear();
        self.changes.resize((columns + 1) * (self.rows.len() + 1), 0);
        for (y, row) in self.rows.iter().enumerate() {
            let below = self.rows.get(y + 1);
            let mut sum = 0;
            for x in 0..columns {
                let label = row.only_label(x);
                let changes = label.is_none()
                    || (x + 1 < columns && row.only_label(x + 1) != label)
                    || below.is_some_and(|b| b.only_label(x) != label);
                sum += u32::from(changes);
                self.changes[(y + 1) * (columns + 1) + x + 1] = self.changes[y * (columns + 1) + x + 1] + sum;
            }
        }
    }

    /// The label of all cells in these columns and rows, if it is one only.
    pub(crate) fn only_label(&self, columns: Range<usize>, rows: Range<usize>) -> Option<u32> {
        let at = |x: usize, y: usize| self.changes[y * (self.columns + 1) + x];
        let (x0, x1, y0, y1) = (columns.start, columns.end, rows.start, rows.end);
        let changes = at(x1, y1) + at(x0, y0) - at(x0, y1) - at(x1, y0);
        if changes == 0 { self.rows[y0].only_label(x0) } else { None }
    }

    /// Whether all cells within `radius` px of an entry hold its label only.
    pub(crate) fn holds_only(&self, entry: &Entry, radius: usize) -> bool {
        let range = |c: f32, end: usize| {
            let (first, last) = ((c as usize).saturating_sub(radius), c as usize + 1 + radius);
            first / self.side..(last / self.side + 1).min(end)
        };
        self.only_label(range(entry.x, self.columns), range(entry.y, self.rows.len())) == Some(entry.label)
    }

    pub(crate) fn rows(&self) -> &[CellRow] {
        &self.rows
    }

    /// Counts the labels of cells of `side` px.
    pub(crate) fn fill(&mut self, runs: &Runs, width: usize, side: usize) {
        let height = runs.rows().len();
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
        self.sum_changes();
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
        self.sum_changes();
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
        row.join_spans();
    }
}
