//! Fast evaluation: everything in M_sigma(c) but the centre partition's own term varies slowly with c.
//!
//! At nodes about sigma / 2.5 apart, F(g) = sum over all partitions i of w_i A_i [m_i, 1] is summed from the label counts
//! of cells, and the own term w_i of every partition in the disc is kept. For a pixel in partition i0, F is interpolated
//! bilinearly, the interpolated own term of i0 is subtracted and G(0) A_i0 [m_i0, 1] is added.
//!
//! The pixels of one label in one base cell (a *site*) share their value; between sites of the same label S is
//! interpolated, so boundaries stay those of the partitions.

use rayon::prelude::*;
use samsod_segment::Partition;

use crate::cells::{CellGrid, Entry};
use crate::exact::extent_measure;

/// Area and colour of one partition; the colour relative to the image mean, which cancels in S and saves digits.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Mass {
    pub(crate) area: f32,
    pub(crate) colour: [f32; 3],
}

/// One node: the sum over all partitions, and where its own terms are.
#[derive(Debug, Clone, Copy, Default)]
struct Node {
    /// `sum w_i A_i (m_i - m)` and `sum w_i A_i`.
    sum: [f32; 4],
    own_start: u32,
    own_end: u32,
}

/// The nodes of one scale.
#[derive(Debug, Default)]
pub(crate) struct NodeGrid {
    step: f32,
    columns: usize,
    rows: Vec<NodeRow>,
}

#[derive(Debug, Default)]
struct NodeRow {
    nodes: Vec<Node>,
    /// (label, w_i) of the partitions in the disc of each node, ascending by label.
    own: Vec<(u32, f32)>,
}

/// A Gaussian tabulated over squared distance.
struct Table {
    values: Vec<f32>,
    per_px2: f32,
    limit: f32,
}

impl Table {
    /// Up to 3 sigma (or a cell beyond, for the centres of cells that reach into the disc).
    fn new(sigma: f32) -> Self {
        const SIZE: usize = 2048;
        let limit = 9.0 * sigma * sigma;
        let per_px2 = SIZE as f32 / limit;
        let value = |i: usize| (-((i as f32 + 0.5) / per_px2) / (2.0 * sigma * sigma)).exp();
        Self { values: (0..=SIZE).map(value).collect(), per_px2, limit }
    }

    fn at(&self, squared_distance: f32) -> Option<f32> {
        // Beyond the limit is outside of the disc E(c).
        (squared_distance <= self.limit).then(|| self.values[(squared_distance * self.per_px2) as usize])
    }
}

/// Weight and count of every label in the disc of the current node.
struct Slots {
    slots: Vec<(f32, f32)>,
    used: Vec<u32>,
}

impl Slots {
    fn add(&mut self, label: u32, count: f32, weight: f32) {
        let slot = &mut self.slots[label as usize];
        if slot.1 == 0.0 {
            self.used.push(label);
        }
        slot.0 += weight;
        slot.1 += count;
    }
}

impl NodeGrid {
    /// Evaluates the nodes of scale `sigma` from `cells`.
    pub(crate) fn fill(&mut self, partition: &Partition, masses: &[Mass], cells: &CellGrid, sigma: f32, step: f32) {
        let (w, h) = (partition.width() as usize, partition.height() as usize);
        self.step = step;
        self.columns = ((w as f32 - 1.0) / step).ceil() as usize + 1;
        self.rows.resize_with(((h as f32 - 1.0) / step).ceil() as usize + 1, NodeRow::default);
        let (columns, table) = (self.columns, Table::new(sigma));
        let new_slots = || Slots { slots: vec![(0.0, 0.0); masses.len()], used: Vec::new() };
        self.rows.par_iter_mut().enumerate().for_each_init(new_slots, |slots, (row, out)| {
            out.nodes.clear();
            out.own.clear();
            let y = row as f32 * step;
            for column in 0..columns {
                let x = column as f32 * step;
                sum_disc(cells, &table, sigma, x, y, slots);
                out.close_node(partition, masses, slots, x, y);
            }
        });
    }

    /// The mask-weighted mean colour at (x, y) as if in partition `label`, relative to the image mean.
    pub(crate) fn mean_colour(&self, x: f32, y: f32, label: u32, mass: Mass) -> [f32; 3] {
        let (gx, gy) = (x / self.step, y / self.step);
        let column = (gx as usize).min(self.columns.saturating_sub(2));
        let row = (gy as usize).min(self.rows.len().saturating_sub(2));
        let (fx, fy) = (gx - column as f32, gy - row as f32);
        let (mut sum, mut own) = ([0.0f32; 4], 0.0);
        for (r, wy) in [(row, 1.0 - fy), (row + 1, fy)] {
            let Some(line) = self.rows.get(r) else { continue };
            for (c, wx) in [(column, 1.0 - fx), (column + 1, fx)] {
                let Some(node) = line.nodes.get(c) else { continue };
                let weight = wx * wy;
                for (s, n) in sum.iter_mut().zip(node.sum) {
                    *s += weight * n;
                }
                own += weight * line.own_term(node, label);
            }
        }
        let own_mass = (1.0 - own) * mass.area;
        let total = sum[3] + own_mass;
        [0, 1, 2].map(|c| (sum[c] + own_mass * mass.colour[c]) / total)
    }
}

impl NodeRow {
    fn own_term(&self, node: &Node, label: u32) -> f32 {
        let terms = &self.own[node.own_start as usize..node.own_end as usize];
        match terms {
            [(only, weight)] if *only == label => *weight,
            _ => terms.binary_search_by_key(&label, |t| t.0).map_or(0.0, |i| terms[i].1),
        }
    }

    fn close_node(&mut self, partition: &Partition, masses: &[Mass], slots: &mut Slots, x: f32, y: f32) {
        let size = f64::from(partition.width()) + f64::from(partition.height());
        let own_start = self.own.len() as u32;
        let mut sum = [0.0f32; 4];
        slots.used.sort_unstable();
        for label in slots.used.drain(..) {
            let (weight, count) = std::mem::take(&mut slots.slots[label as usize]);
            let object = &partition.objects()[label as usize];
            // Nodes at the right and lower edge lie up to a step outside of the image.
            let d = extent_measure(object, f64::from(x), f64::from(y), size).max(0.0) as f32;
            let w = weight / count * d;
            let mass = masses[label as usize];
            for c in 0..3 {
                sum[c] += w * mass.area * mass.colour[c];
            }
            sum[3] += w * mass.area;
            self.own.push((label, w));
        }
        self.nodes.push(Node { sum, own_start, own_end: self.own.len() as u32 });
    }
}

fn sum_disc(cells: &CellGrid, table: &Table, sigma: f32, x: f32, y: f32, slots: &mut Slots) {
    let side = cells.side as f32;
    let reach = 3.0 * sigma;
    let range = |c: f32, end: usize| {
        let from = ((c - reach) / side).floor().max(0.0) as usize;
        let to = (((c + reach) / side).floor().max(-1.0) + 1.0) as usize;
        from..to.min(end)
    };
    for row in &cells.rows()[range(y, cells.rows().len())] {
        for entry in row_entries(row, range(x, cells.columns)) {
            let (dx, dy) = (entry.x - x, entry.y - y);
            if let Some(g) = table.at(dx * dx + dy * dy) {
                let n = entry.count as f32;
                slots.add(entry.label, n, n * g);
            }
        }
    }
}

fn row_entries(row: &crate::cells::CellRow, columns: std::ops::Range<usize>) -> &[Entry] {
    if columns.is_empty() {
        return &[];
    }
    &row.entries[row.start[columns.start] as usize..row.start[columns.end] as usize]
}
