//! Fast evaluation: everything in M_sigma(c) but the centre partition's own term varies slowly with c.
//!
//! At nodes sigma / 1.75 apart, F(g) = sum over all partitions i of w_i A_i [m_i, 1] is summed from the label counts
//! of cells, and the own term w_i of every partition in the disc is kept. For a pixel in partition i0, F is interpolated
//! bilinearly, the interpolated own term of i0 is subtracted and G(0) A_i0 [m_i0, 1] is added.
//!
//! The pixels of one label in one base cell (a *site*) share their value; between sites of the same label S is
//! interpolated, so boundaries stay those of the partitions.

use rayon::prelude::*;
use samsod_segment::{Partition, ProtoObject};

use crate::cells::CellGrid;

/// What a node needs of one partition, side by side in memory.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Mass {
    area: f32,
    /// Relative to the image mean, which cancels in S and saves digits.
    pub(crate) colour: [f32; 3],
    /// First and last column and row.
    columns: [f32; 2],
    rows: [f32; 2],
}

impl Mass {
    pub(crate) fn new(object: &ProtoObject, image_mean: [f32; 3]) -> Self {
        let b = &object.bbox;
        Self {
            area: object.area as f32,
            colour: [0, 1, 2].map(|c| object.mean[c] - image_mean[c]),
            columns: [b.x as f32, b.right() as f32],
            rows: [b.y as f32, b.bottom() as f32],
        }
    }

    /// Extent measure D_i of eq 9 for a centre (x, y). Nodes at the right and lower edge lie up to a step outside of
    /// the image, where it would fall below 0.
    fn extent_measure(&self, x: f32, y: f32, width_plus_height: f32) -> f32 {
        let far = |c: f32, [low, high]: [f32; 2]| (c - low).abs().max((c - high).abs());
        (1.0 - (far(x, self.columns) + far(y, self.rows)) / width_plus_height).max(0.0)
    }
}

/// One node: the sum over all partitions, and where its own terms are.
#[derive(Debug, Clone, Copy, Default)]
struct Node {
    /// `sum w_i A_i (m_i - m)` and `sum w_i A_i`.
    sum: [f32; 4],
    own_start: u32,
    own_end: u32,
    /// The label of the whole disc if it is one only, else [`SEVERAL`].
    only: u32,
}

const SEVERAL: u32 = u32::MAX;

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
    slices: Vec<Slice>,
}

/// The Gaussian of one scale, tabulated.
struct Table {
    sigma: f32,
    /// `exp(-d / 2 sigma^2)` over squared distance d, `per_px2` entries a squared pixel.
    values: Vec<f32>,
    per_px2: f32,
    /// Integral of `exp(-t^2 / 2 sigma^2)` from `-reach` on, `per_px` entries a pixel.
    integral: Vec<f32>,
    per_px: f32,
    reach: f32,
}

impl Table {
    /// The disc ends at 3 sigma; the integral reaches a cell of `side` px farther, for rows of cells cut by the disc.
    fn new(sigma: f32, side: f32) -> Self {
        const SIZE: usize = 2048;
        let per_px2 = SIZE as f32 / (9.0 * sigma * sigma);
        let value = |i: usize| (-((i as f32 + 0.5) / per_px2) / (2.0 * sigma * sigma)).exp();
        let reach = 3.0 * sigma + side;
        let per_px = SIZE as f32 / (2.0 * reach);
        let mut sum = 0f64;
        let step = f64::from(1.0 / per_px);
        let integral = (0..=SIZE + 1).map(|i| {
            let before = sum;
            let t = (i as f64 + 0.5) * step - f64::from(reach);
            sum += step * (-t * t / (2.0 * f64::from(sigma).powi(2))).exp();
            before as f32
        });
        Self { sigma, values: (0..=SIZE).map(value).collect(), per_px2, integral: integral.collect(), per_px, reach }
    }

    /// The Gaussian at a squared distance; none outside of the disc E(c).
    fn at(&self, squared_distance: f32) -> Option<f32> {
        (squared_distance <= 9.0 * self.sigma * self.sigma)
            .then(|| self.values[(squared_distance * self.per_px2) as usize])
    }

    /// Its integral from far below to offset `t` on one axis.
    fn up_to(&self, t: f32) -> f32 {
        let at = ((t + self.reach) * self.per_px).clamp(0.0, (self.integral.len() - 2) as f32);
        let i = at as usize;
        let fraction = at - i as f32;
        self.integral[i] * (1.0 - fraction) + self.integral[i + 1] * fraction
    }
}

/// Weight and count of every label in the disc of the current node.
struct Slots {
    slots: Vec<(f32, f32)>,
    used: Vec<u32>,
}

impl Slots {
    /// Brings `used` into ascending order; where most labels are in use, by asking them one by one.
    fn sort_used(&mut self) {
        if self.used.len() * 8 < self.slots.len() {
            self.used.sort_unstable();
        } else {
            self.used.clear();
            self.used.extend((0..).zip(&self.slots).filter(|(_, slot)| slot.1 > 0.0).map(|(label, _)| label));
        }
    }

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
        let (columns, table) = (self.columns, Table::new(sigma, cells.side as f32));
        let new_slots = || Slots { slots: vec![(0.0, 0.0); masses.len()], used: Vec::new() };
        self.rows.par_iter_mut().enumerate().for_each_init(new_slots, |slots, (row, out)| {
            out.nodes.clear();
            out.own.clear();
            let y = row as f32 * step;
            out.slices = slices_of_disc(cells, &table, h as f32, y);
            for column in 0..columns {
                let x = column as f32 * step;
                match label_of_disc(cells, &out.slices, w as f32, x) {
                    Some(label) => {
                        let weight = out.slices.iter().map(|s| s.along * s.across).sum();
                        slots.add(label, out.slices.iter().map(|s| 2.0 * s.half_width * s.height).sum(), weight);
                    }
                    None => sum_disc(cells, &table, w as f32, (x, y), &out.slices, slots),
                }
                out.close_node(partition, masses, slots, x, y);
            }
        });
    }

    /// Evaluates M at points one after the other; neighbours with the same label share most of the work.
    pub(crate) fn cursor(&self) -> Cursor<'_> {
        Cursor { grid: self, at: (usize::MAX, usize::MAX, 0), corners: [[0.0; 5]; 4], alone: false }
    }
}

/// The four nodes around the last point asked for.
pub(crate) struct Cursor<'a> {
    grid: &'a NodeGrid,
    /// Column and row of the upper left node, and the label.
    at: (usize, usize, u32),
    /// Sum and own term of upper left, upper right, lower left and lower right; where there is no such node, its
    /// weight is 0.
    corners: [[f32; 5]; 4],
    /// Whether all four discs hold this label only.
    alone: bool,
}

impl Cursor<'_> {
    /// The mask-weighted mean colour at (x, y) as if in partition `label`, relative to the image mean.
    pub(crate) fn mean_colour(&mut self, x: f32, y: f32, label: u32, mass: Mass) -> [f32; 3] {
        let grid = self.grid;
        let (gx, gy) = (x / grid.step, y / grid.step);
        let column = (gx as usize).min(grid.columns.saturating_sub(2));
        let row = (gy as usize).min(grid.rows.len().saturating_sub(2));
        if self.at != (column, row, label) {
            self.at = (column, row, label);
            self.load();
        }
        if self.alone {
            // The mask is this partition alone, and so is its mean.
            return mass.colour;
        }
        let (fx, fy) = (gx - column as f32, gy - row as f32);
        let weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
        let [r, g, b, all, own] = [0, 1, 2, 3, 4].map(|i| (0..4).map(|c| weights[c] * self.corners[c][i]).sum::<f32>());
        let own_mass = (1.0 - own) * mass.area;
        let scale = 1.0 / (all + own_mass);
        [
            (r + own_mass * mass.colour[0]) * scale,
            (g + own_mass * mass.colour[1]) * scale,
            (b + own_mass * mass.colour[2]) * scale,
        ]
    }

    fn load(&mut self) {
        let (column, row, label) = self.at;
        self.alone = true;
        for (i, corner) in self.corners.iter_mut().enumerate() {
            let line = self.grid.rows.get(row + i / 2);
            *corner = match line.and_then(|line| Some((line, line.nodes.get(column + i % 2)?))) {
                Some((line, node)) => {
                    self.alone &= node.only == label;
                    let [r, g, b, all] = node.sum;
                    [r, g, b, all, line.own_term(node, label)]
                }
                None => [0.0; 5],
            };
        }
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
        let size = partition.width() as f32 + partition.height() as f32;
        let own_start = self.own.len() as u32;
        let mut sum = [0.0f32; 4];
        let only = if let [only] = slots.used[..] { only } else { SEVERAL };
        slots.sort_used();
        for label in slots.used.drain(..) {
            let (weight, count) = std::mem::take(&mut slots.slots[label as usize]);
            let mass = &masses[label as usize];
            let w = weight / count * mass.extent_measure(x, y, size);
            let [r, g, b] = mass.colour;
            for (sum, part) in sum.iter_mut().zip([r, g, b, 1.0]) {
                *sum += w * mass.area * part;
            }
            self.own.push((label, w));
        }
        self.nodes.push(Node { sum, own_start, own_end: self.own.len() as u32, only });
    }
}

/// What the disc around any node of one row of nodes takes from one row of cells.
#[derive(Debug, Clone, Copy)]
struct Slice {
    row: usize,
    /// Height of the row of cells, px.
    height: f32,
    /// Integral of the Gaussian over that height.
    across: f32,
    /// Half the width of the disc at the middle of the row, px.
    half_width: f32,
    /// Integral of the Gaussian over that width.
    along: f32,
}

fn slices_of_disc(cells: &CellGrid, table: &Table, height: f32, y: f32) -> Vec<Slice> {
    let side = cells.side as f32;
    let reach = 3.0 * table.sigma;
    let first_row = ((y - reach) / side).floor().max(0.0) as usize;
    let end_row = ((((y + reach) / side).floor() + 2.0).max(0.0) as usize).min(cells.rows().len());
    (first_row..end_row)
        .filter_map(|row| {
            // Pixel i covers i - 1/2 to i + 1/2.
            let top = row as f32 * side - 0.5;
            let bottom = (top + side).min(height - 0.5);
            let middle = (top + bottom) * 0.5 - y;
            let squared = reach * reach - middle * middle;
            (squared > 0.0).then(|| {
                let half_width = squared.sqrt();
                Slice {
                    row,
                    height: bottom - top,
                    across: table.up_to(bottom - y) - table.up_to(top - y),
                    half_width,
                    along: table.up_to(half_width) - table.up_to(-half_width),
                }
            })
        })
        .collect()
}

/// The label of the whole disc around column `x`, if it is one only and the image does not cut the disc at a side.
fn label_of_disc(cells: &CellGrid, slices: &[Slice], width: f32, x: f32) -> Option<u32> {
    let (first, last) = (slices.first()?, slices.last()?);
    let half_width = slices.iter().map(|s| s.half_width).fold(0.0, f32::max);
    let (left, right) = (x - half_width, x + half_width);
    if left < -0.5 || right >= width - 0.5 {
        return None;
    }
    let per_side = 1.0 / cells.side as f32;
    let columns = ((left + 0.5) * per_side) as usize..((right + 0.5) * per_side) as usize + 1;
    cells.only_label(columns, first.row..last.row + 1)
}

/// Sums weights and counts of every label over the disc around (x, y): stretches of one label by the integral of the
/// Gaussian over their rectangle, cells of several labels by the centres of their labels.
fn sum_disc(cells: &CellGrid, table: &Table, width: f32, (x, y): (f32, f32), slices: &[Slice], slots: &mut Slots) {
    let side = cells.side as f32;
    let per_side = 1.0 / side;
    for slice in slices {
        let row = &cells.rows()[slice.row];
        let (left, right) = ((x - slice.half_width).max(-0.5), (x + slice.half_width).min(width - 0.5));
        if left >= right {
            continue;
        }
        let first_cell = ((left + 0.5) * per_side) as usize;
        for span in row.spans_from(first_cell.min(cells.columns - 1)) {
            let (start, end) = (span.first_cell as f32 * side - 0.5, span.end_cell as f32 * side - 0.5);
            if start >= right {
                break;
            }
            match span.label {
                // Mostly the whole slice is table.
                Some(label) if start <= x - slice.half_width && end >= x + slice.half_width => {
                    slots.add(label, 2.0 * slice.half_width * slice.height, slice.along * slice.across);
                }
                Some(label) => {
                    let (from, to) = (start.max(left), end.min(right));
                    let along = table.up_to(to - x) - table.up_to(from - x);
                    slots.add(label, (to - from) * slice.height, along * slice.across);
                }
                None => {
                    for entry in row.cell(span.first_cell as usize) {
                        let (dx, dy) = (entry.x - x, entry.y - y);
                        if let Some(g) = table.at(dx * dx + dy * dy) {
                            let n = entry.count as f32;
                            slots.add(entry.label, n, n * g);
                        }
                    }
                }
            }
        }
    }
}
