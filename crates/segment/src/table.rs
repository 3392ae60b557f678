//! The table as background: texture that the mean shift left standing on it goes back to it.
//!
//! Ruled lines, grain, speckles and scratches are partitions of their own where they differ enough from the table. What
//! tells them from parts is width. *Table* are the components along the border of the image. What is not table is
//! opened by a 3 x 3 square, which cuts lines off the parts that they run into. The connected groups that remain go
//! back to the table when no disc of two thirds of the spatial bandwidth fits into them and they are small, or many: a
//! few thin groups may be pins, many are a pattern.

use crate::disjoint_sets::DisjointSets;
use crate::runs::{Run, Runs};

/// Share of the border of the image from which on a component is table.
const BORDER_SHARE: f32 = 0.1;
/// Groups into which no disc of this radius fits, in spatial bandwidths, are thin.
const THIN_RADIUS: f32 = 2.0 / 3.0;
/// Thin groups up to this area, in squared spatial bandwidths, are texture even when there are few.
const SPECK_AREA: f32 = 4.0;
/// This many thin groups are a pattern.
const PATTERN: usize = 6;

/// Reused memory.
#[derive(Debug, Default)]
pub(crate) struct TableFinder {
    /// 1 where a pixel is not table.
    raised: Vec<u8>,
    rows: Vec<u8>,
    eroded: Vec<u8>,
    opened: Vec<u8>,
    /// Chamfer distance to the table, in thirds of a pixel.
    depth: Vec<u16>,
    groups: Runs,
    sets: DisjointSets,
    queue: Vec<u32>,
}

/// Which of `count` labels hold at least [`BORDER_SHARE`] of the border of the image, or the largest share of it.
pub(crate) fn background_of(labels: &[u32], width: usize, count: usize) -> Vec<bool> {
    let mut border = vec![0u32; count];
    let height = labels.len().checked_div(width).unwrap_or(0);
    for (y, line) in labels.chunks_exact(width.max(1)).enumerate() {
        let whole = y == 0 || y + 1 == height;
        let ends = [line[0], line[width - 1]];
        for &label in if whole { line } else { &ends } {
            border[label as usize] += 1;
        }
    }
    let largest = border.iter().copied().max().unwrap_or(0);
    let share = ((2 * (width + height)) as f32 * BORDER_SHARE) as u32;
    border.iter().map(|&b| b >= share.min(largest).max(1)).collect()
}

impl TableFinder {
    /// Gives texture back to the table. `labels` holds `count` dense labels; some may not occur any more afterwards.
    /// `bandwidth` is the spatial bandwidth in pixels of the label image.
    pub(crate) fn absorb_texture(&mut self, labels: &mut [u32], width: usize, count: usize, bandwidth: f32) {
        let height = labels.len() / width;
        if width < 5 || height < 5 {
            return;
        }
        let table = background_of(labels, width, count);
        self.raised.clear();
        self.raised.extend(labels.iter().map(|&l| u8::from(!table[l as usize])));
        self.open(width, height);
        self.remove_thin_groups(width, height, bandwidth);
        fill_from_table(&mut self.raised, &self.opened, &mut self.queue, width, |i, from| labels[i] = labels[from]);
    }

    /// `opened`: erosion and dilation of `raised` by a 3 x 3 square.
    fn open(&mut self, width: usize, height: usize) {
        filter3(&self.raised, &mut self.rows, &mut self.eroded, width, height, |a, b| a & b);
        filter3(&self.eroded, &mut self.rows, &mut self.opened, width, height, |a, b| a | b);
    }

    /// Clears from `opened` the connected groups that are thin and small, or thin and many.
    fn remove_thin_groups(&mut self, width: usize, height: usize, bandwidth: f32) {
        self.groups.fill_alike(&self.opened, width, |a, b| a == b, |&pixel| u32::from(pixel));
        let count = self.groups.split_components(&mut self.sets);
        chamfer_depth(&self.opened, &self.groups, &mut self.depth, width, height);
        let mut deepest = vec![0u16; count];
        let mut area = vec![0u32; count];
        for (row, depth) in self.groups.rows().iter().zip(self.depth.chunks_exact(width)) {
            for run in row {
                let group = run.label as usize;
                let depth = &depth[run.start as usize..run.end as usize];
                deepest[group] = depth.iter().copied().fold(deepest[group], u16::max);
                area[group] += run.end - run.start;
            }
        }
        // A group of the table has depth 0.
        let thin_depth = (bandwidth * THIN_RADIUS * f32::from(CHAMFER_UNIT)).round() as u16;
        let thin: Vec<bool> = deepest.iter().map(|&d| d > 0 && d <= thin_depth).collect();
        let many = thin.iter().filter(|&&t| t).count() >= PATTERN;
        let small = (SPECK_AREA * bandwidth * bandwidth) as u32;
        for (row, pixels) in self.groups.rows().iter().zip(self.opened.chunks_exact_mut(width)) {
            for run in row {
                let group = run.label as usize;
                if thin[group] && (many || area[group] < small) {
                    pixels[run.start as usize..run.end as usize].fill(0);
                }
            }
        }
    }
}

/// Gives every pixel that is raised but not kept to the table next to it: `take(pixel, from)`, in the order in which the table
/// grows. `queue` is scratch.
pub(crate) fn fill_from_table(
    raised: &mut [u8],
    kept: &[u8],
    queue: &mut Vec<u32>,
    width: usize,
    mut take: impl FnMut(usize, usize),
) {
    let height = raised.len() / width;
    let neighbours = |i: usize| neighbours(i, width, height);
    queue.clear();
    let lost = set_in_first(raised, kept);
    queue.extend(lost.filter(|&i| neighbours(i).any(|j| raised[j] == 0)).map(|i| i as u32));
    let mut next = 0;
    while let Some(&i) = queue.get(next) {
        next += 1;
        let i = i as usize;
        if raised[i] == 0 {
            continue;
        }
        if let Some(j) = neighbours(i).find(|&j| raised[j] == 0) {
            take(i, j);
            raised[i] = 0;
            queue.extend(neighbours(i).filter(|&j| raised[j] == 1 && kept[j] == 0).map(|j| j as u32));
        }
    }
}

/// Pixels of a row that are looked at as one: most have nothing to show.
pub(crate) const BLOCK: usize = 64;

/// The pixels that are 1 in a mask, in their order.
pub(crate) fn set_in(mask: &[u8]) -> impl Iterator<Item = usize> {
    let is_any = |block: &[u8]| block.iter().fold(0, |any, &pixel| any | pixel) & 1 == 1;
    let blocks = mask.chunks(BLOCK).enumerate().filter(move |(_, block)| is_any(block));
    blocks.flat_map(|(k, block)| (k * BLOCK..).zip(block).filter(|(_, pixel)| **pixel == 1).map(|(i, _)| i))
}

/// The pixels that are 1 in a mask and 0 in another, in their order.
pub(crate) fn set_in_first(mask: &[u8], other: &[u8]) -> impl Iterator<Item = usize> {
    let lost = |(&pixel, &kept): (&u8, &u8)| pixel & !kept;
    let is_any =
        move |block: &[u8], other: &[u8]| block.iter().zip(other).map(lost).fold(0, |any, pixel| any | pixel) == 1;
    let blocks = mask.chunks(BLOCK).zip(other.chunks(BLOCK)).enumerate();
    blocks.filter(move |(_, (block, other))| is_any(block, other)).flat_map(move |(k, (block, other))| {
        (k * BLOCK..).zip(block.iter().zip(other)).filter(move |(_, pair)| lost(*pair) == 1).map(|(i, _)| i)
    })
}

/// The pixels beside, above and below a pixel.
pub(crate) fn neighbours(i: usize, width: usize, height: usize) -> impl Iterator<Item = usize> {
    let (x, y) = (i % width, i / width);
    let sides = [
        (x > 0).then(|| i - 1),
        (x + 1 < width).then_some(i + 1),
        (y > 0).then(|| i - width),
        (y + 1 < height).then_some(i + width),
    ];
    sides.into_iter().flatten()
}

/// Length of a step to the side in the chamfer distance; one across is 4.
const CHAMFER_UNIT: u16 = 3;

/// Chamfer distance of every set pixel to the nearest clear one; the image is continued by itself, so that a part cut
/// by the frame is not thin. `groups` are the runs of the mask.
fn chamfer_depth(mask: &[u8], groups: &Runs, depth: &mut Vec<u16>, width: usize, height: usize) {
    const FAR: u16 = u16::MAX / 2;
    depth.clear();
    depth.extend(mask.iter().map(|&m| if m == 1 { FAR } else { 0 }));
    // The set pixels of a row.
    let set = |y: usize| {
        let is_set = move |run: &&Run| mask[y * width + run.start as usize] == 1;
        groups.row(y).iter().filter(is_set).map(|run| run.start as usize..run.end as usize)
    };
    for y in 0..height {
        for x in set(y).flatten() {
            let i = y * width + x;
            let mut d = depth[i];
            if x > 0 {
                d = d.min(depth[i - 1] + 3);
            }
            if y > 0 {
                d = d.min(depth[i - width] + 3);
                if x > 0 {
                    d = d.min(depth[i - width - 1] + 4);
                }
                if x + 1 < width {
                    d = d.min(depth[i - width + 1] + 4);
                }
            }
            depth[i] = d;
        }
    }
    for y in (0..height).rev() {
        for x in set(y).rev().flat_map(Iterator::rev) {
            let i = y * width + x;
            let mut d = depth[i];
            if x + 1 < width {
                d = d.min(depth[i + 1] + 3);
            }
            if y + 1 < height {
                d = d.min(depth[i + width] + 3);
                if x + 1 < width {
                    d = d.min(depth[i + width + 1] + 4);
                }
                if x > 0 {
                    d = d.min(depth[i + width - 1] + 4);
                }
            }
            depth[i] = d;
        }
    }
}

/// A 3 x 3 filter of a binary image by `op` along rows, then along columns; `rows` is scratch.
pub(crate) fn filter3(
    source: &[u8],
    rows: &mut Vec<u8>,
    out: &mut Vec<u8>,
    width: usize,
    height: usize,
    op: impl Fn(u8, u8) -> u8 + Copy,
) {
    rows.resize(source.len(), 0);
    out.resize(source.len(), 0);
    for (line, to) in source.chunks_exact(width).zip(rows.chunks_exact_mut(width)) {
        to.copy_from_slice(line);
        for (t, &right) in to.iter_mut().zip(&line[1..]) {
            *t = op(*t, right);
        }
        for (t, &left) in to[1..].iter_mut().zip(line) {
            *t = op(*t, left);
        }
    }
    for (y, to) in out.chunks_exact_mut(width).enumerate() {
        let line = |y: usize| &rows[y * width..(y + 1) * width];
        let (above, below) = (line(y.saturating_sub(1)), line((y + 1).min(height - 1)));
        for (((t, &a), &m), &b) in to.iter_mut().zip(above).zip(line(y)).zip(below) {
            *t = op(op(a, m), b);
        }
    }
}
