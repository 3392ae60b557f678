//! Where a shadow ends: at a share of the table's light, and not where its colour leaves that of the table by a bandwidth.
//!
//! At a soft shadow on a plain table that is far out, where nobody would call the table dark; of a faint shadow on a table with grain
//! it is nowhere, for the bandwidth is as wide as the grain. So the table's light is estimated under everything, in linear light, in
//! which a shadow is a factor `b`:
//!
//! ```text
//! colour = b * table + rest        b by least squares, d = |rest| / |table|
//! ```
//!
//! 1. *Penumbra.* From the table on, pixels with `light <= b <= 1.05` whose `d` is no more than the table itself varies are table,
//!    too. A part of another tone stops that. Of a part that has the table's own tone (steel on steel) most would go: a group of
//!    pixels that would lose more than three fifths stays as it is.
//! 2. *Umbra.* From what is left on, pixels of the table with `b < light`, averaged over 5 x 5 against the grain, are a shadow: a
//!    partition of their own for every connected group of them. Gaps of up to four pixels between are closed.
//! 3. *Border.* All that at working size; [`border`] settles it at full resolution.
//!
//! What becomes table in 1 is still told apart ([`Penumbrae`](crate::penumbrae::Penumbrae)): that it fades out is what tells a shadow from a
//! dark part later on.

mod border;

use std::sync::LazyLock;

use rayon::prelude::*;

use crate::disjoint_sets::DisjointSets;
use crate::partition::Partition;
use crate::penumbrae::NOTHING;
use crate::runs::Runs;
use crate::table::{background_of, fill_from_table, filter3, neighbours, set_in};
use crate::working_image::{UNITS_PER_LEVEL, WorkingImage};

/// Side of the cells in which the mean colour of the table is taken, working pixels.
const CELL: usize = 16;
/// Every so many pixels of every so many rows one is read for that: neighbours say the same.
const STRIDE: usize = 2;
/// Table whose light is farther from that around is not counted: it may be in shadow.
const MOST_DEVIATION: f32 = 0.25;
/// Light from which on it is no table but something bright on it.
const MOST_LIGHT: f32 = 1.05;
/// How far a tone may be from the table's, in medians of what the table itself has.
const NOISE_GAIN: f32 = 4.0;
/// What the table varies at least, and what is allowed at most.
const LEAST_NOISE: f32 = 0.01;
const MOST_REST: f32 = 0.06;
/// Farthest tone from the table's that is still its shadow.
const MOST_REST_OF_SHADOW: f32 = 0.1;
/// Half the side of the square over which light is averaged against the grain, working pixels.
const AGAINST_GRAIN: usize = 2;
/// How far from something a shadow may begin, working pixels.
const REACH: usize = 3;
/// A group of pixels that would lose more than this share is a part of the table's tone.
const MOST_LOST: f32 = 0.6;

/// The tone where something lies on the table.
const COVERED: (f32, f32) = (f32::INFINITY, f32::INFINITY);
/// Whether it is dark has not been asked.
const UNASKED: u8 = 2;
/// The tone of table that has not been looked at.
const UNSEEN: (f32, f32) = (f32::NAN, 0.0);

/// Linear light in [0, 1] of every sixteenth of an sRGB level (IEC 61966-2-1).
static LINEAR: LazyLock<Vec<f32>> = LazyLock::new(|| {
    let light = |units: u16| {
        let v = f32::from(units) / f32::from(255 * UNITS_PER_LEVEL);
        if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
    };
    (0..=255 * UNITS_PER_LEVEL).map(light).collect()
});

fn linear(rgb: [u16; 3]) -> [f32; 3] {
    rgb.map(|units| LINEAR.get(usize::from(units)).copied().unwrap_or(1.0))
}

/// A sum of colours in linear light, and of how many.
#[derive(Debug, Clone, Copy, Default)]
struct Sum {
    colour: [f32; 3],
    weight: f32,
}

impl Sum {
    fn add(&mut self, colour: [f32; 3], weight: f32) {
        for (s, c) in self.colour.iter_mut().zip(colour) {
            *s += c * weight;
        }
        self.weight += weight;
    }

    fn mean(self) -> [f32; 3] {
        self.colour.map(|c| c / self.weight)
    }
}

/// Reused memory.
#[derive(Debug, Default)]
pub(crate) struct PenumbraFinder {
    /// Whether there was a table in the image that was looked at last.
    absorbed: bool,
    /// 1 where a pixel is not table.
    raised: Vec<u8>,
    rows: Vec<u8>,
    scratch: Vec<u8>,
    /// 1 within two pixels of that.
    near: Vec<u8>,
    /// The mean colour of the table in cells, the levels of a pyramid one after another.
    levels: Vec<Level>,
    cells: Vec<[f32; 3]>,
    rests: Vec<f32>,
    /// 1 where it is table by its tone; 2 once the table has been reached from there.
    faint: Vec<u8>,
    kept: Vec<u8>,
    /// Where tones of the table are looked at from the beginning.
    seen: Vec<u8>,
    /// Tones of the table, [`COVERED`] or [`UNSEEN`].
    tones: Vec<(f32, f32)>,
    /// 1 in groups that would have lost too much.
    spared: Vec<u8>,
    /// Which labels are table.
    table: Vec<bool>,
    /// For working pixels near the border of table and shadow the label beyond it, for penumbrae the one they fade from.
    beyond: Vec<u32>,
    groups: Runs,
    sets: DisjointSets,
    queue: Vec<u32>,
}

#[derive(Debug, Default)]
struct Level {
    columns: usize,
    rows: usize,
    sums: Vec<Sum>,
}

impl PenumbraFinder {
    /// Gives penumbrae back to the table, and takes shadows from it. `labels` holds labels below `count`, some of which may not
    /// occur, and gets further ones; `light` is the share of its light, 0 to 1, from which on the table is table. Modes stay: the
    /// refinement, which compares with them, would otherwise move the border halfway to the full light of the table.
    pub(crate) fn absorb(&mut self, image: &WorkingImage, labels: &mut [u32], count: usize, light: f32) {
        let (width, height) = (image.width, image.height);
        self.absorbed = false;
        if light >= 1.0 || labels.is_empty() || width < 5 || height < 5 {
            return;
        }
        self.table = background_of(labels, width, count);
        self.raised.clear();
        self.raised.extend(labels.iter().map(|&l| u8::from(!self.table[l as usize])));
        // Mixed pixels and the foot of the penumbra itself do not tell the colour of the table.
        filter3(&self.raised, &mut self.rows, &mut self.scratch, width, height, |a, b| a | b);
        filter3(&self.scratch, &mut self.rows, &mut self.near, width, height, |a, b| a | b);
        if !self.measure_table(image) {
            return;
        }
        self.absorbed = true;
        let most_rest = self.most_rest(image);
        self.find_faint(image, light, most_rest);
        self.reach(width, height);
        self.spare_groups(width);
        self.kept.clear();
        self.kept.extend(self.raised.iter().zip(&self.faint).map(|(&raised, &faint)| raised & u8::from(faint != 2)));
        filter3(&self.kept, &mut self.rows, &mut self.scratch, width, height, |a, b| a & b);
        filter3(&self.scratch, &mut self.rows, &mut self.kept, width, height, |a, b| a | b);
        // `raised` stays as it was: what was not table does not tell of grain.
        self.scratch.clone_from(&self.raised);
        fill_from_table(&mut self.scratch, &self.kept, &mut self.queue, width, |i, from| labels[i] = labels[from]);
        self.kept.clone_from(&self.scratch);
        self.find_shadows(image, labels, count, light);
        self.close(labels, count, width);
    }

    /// Gives the pixels of the table in shadow labels of their own, from `count` on, and marks them in `kept`.
    fn find_shadows(&mut self, image: &WorkingImage, labels: &mut [u32], count: usize, light: f32) {
        let (width, height) = (image.width, image.height);
        self.near.clone_from(&self.kept);
        for _ in 0..REACH {
            filter3(&self.near, &mut self.rows, &mut self.scratch, width, height, |a, b| a | b);
            std::mem::swap(&mut self.near, &mut self.scratch);
        }
        // What a pixel is averaged with is looked at, too.
        self.seen.clone_from(&self.near);
        for _ in 0..AGAINST_GRAIN {
            filter3(&self.seen, &mut self.rows, &mut self.scratch, width, height, |a, b| a | b);
            std::mem::swap(&mut self.seen, &mut self.scratch);
        }
        self.find_tones(image);
        // Where one may begin: on all cores. How it goes on from there is asked as it grows.
        let (near, scratch) = (&mut self.near, &mut self.scratch);
        scratch.resize(near.len(), 0);
        let (tones, taken) = (&self.tones, &self.kept);
        scratch.par_chunks_exact_mut(width).enumerate().with_min_len(8).for_each(|(y, begins)| {
            for (i, begins) in (y * width..).zip(begins) {
                let is_asked = near[i] == 1 && taken[i] == 0;
                *begins = if !is_asked { UNASKED } else { u8::from(is_dark(tones, width, i, light)) };
            }
        });
        std::mem::swap(near, scratch);
        let mut dark = std::mem::take(near);
        let mut queue = std::mem::take(&mut self.queue);
        let mut label = count as u32;
        for start in 0..dark.len() {
            if dark[start] != 1 || self.kept[start] == 1 {
                continue;
            }
            queue.clear();
            queue.push(start as u32);
            self.kept[start] = 1;
            while let Some(i) = queue.pop() {
                labels[i as usize] = label;
                for j in neighbours(i as usize, width, height) {
                    if self.kept[j] == 1 {
                        continue;
                    }
                    if dark[j] == UNASKED {
                        self.see_around(image, j);
                        dark[j] = u8::from(is_dark(&self.tones, width, j, light));
                    }
                    if dark[j] == 1 {
                        self.kept[j] = 1;
                        queue.push(j as u32);
                    }
                }
            }
            label += 1;
        }
        (self.near, self.queue) = (dark, queue);
    }

    /// The tones of the table where it is `seen`.
    fn find_tones(&mut self, image: &WorkingImage) {
        let mut tones = std::mem::take(&mut self.tones);
        tones.resize(self.raised.len(), UNSEEN);
        let (width, this) = (image.width, &*self);
        tones.par_chunks_exact_mut(width).enumerate().with_min_len(8).for_each_init(
            TableRow::default,
            |table, (y, tones)| {
                table.fill(&this.cells, this.levels[0].columns, y);
                let row = y * width..(y + 1) * width;
                let masks = this.raised[row.clone()].iter().zip(&this.seen[row.clone()]);
                for (x, ((tone, colour), masks)) in tones.iter_mut().zip(&image.rgb[row]).zip(masks).enumerate() {
                    *tone = match masks {
                        (1, _) => COVERED,
                        (_, 1) => against(linear(*colour), table.at(x)),
                        _ => UNSEEN,
                    };
                }
            },
        );
        self.tones = tones;
    }

    /// Finds the tones that are averaged at a pixel.
    fn see_around(&mut self, image: &WorkingImage, i: usize) {
        let (x, y) = (i % image.width, i / image.width);
        for y in y.saturating_sub(AGAINST_GRAIN)..(y + AGAINST_GRAIN + 1).min(image.height) {
            for x in x.saturating_sub(AGAINST_GRAIN)..(x + AGAINST_GRAIN + 1).min(image.width) {
                let j = y * image.width + x;
                if self.tones[j].0.is_nan() {
                    self.tones[j] = against(linear(image.rgb[j]), self.table_at(x, y));
                }
            }
        }
    }

    /// Gives narrow gaps beside shadows, whose labels are from `count` on, to what is beside them.
    fn close(&mut self, labels: &mut [u32], count: usize, width: usize) {
        let height = labels.len() / width;
        let Self { kept, rows, scratch, near, queue, faint, .. } = self;
        near.clear();
        near.extend(labels.iter().map(|&label| u8::from(label as usize >= count)));
        filter3(near, rows, scratch, width, height, |a, b| a | b);
        filter3(scratch, rows, faint, width, height, |a, b| a | b);
        filter3(kept, rows, scratch, width, height, |a, b| a | b);
        filter3(scratch, rows, near, width, height, |a, b| a | b);
        filter3(near, rows, scratch, width, height, |a, b| a & b);
        filter3(scratch, rows, near, width, height, |a, b| a & b);
        for ((closed, &kept), &beside) in near.iter_mut().zip(kept.iter()).zip(faint.iter()) {
            *closed &= kept | beside;
        }
        // The same as with the table, the other way round.
        let flip = |mask: &mut Vec<u8>| mask.iter_mut().for_each(|m| *m = 1 - *m);
        flip(kept);
        flip(near);
        fill_from_table(kept, near, queue, width, |i, from| labels[i] = labels[from]);
    }

    /// Tells the partition which of its table fades out from which label: what was not table before [`PenumbraFinder::absorb`].
    /// The working image of `coarse`, the labels that have been absorbed, has `width` columns and `reduction`.
    pub(crate) fn attribute(&mut self, coarse: &[u32], (width, reduction): (usize, usize), partition: &mut Partition) {
        let penumbrae = &mut partition.penumbrae;
        penumbrae.clear();
        if !self.absorbed {
            return;
        }
        let height = coarse.len() / width;
        let (mut from, mut queue) = (std::mem::take(&mut self.beyond), std::mem::take(&mut self.queue));
        let is_table = |label: u32| self.table.get(label as usize).copied().unwrap_or(false);
        from.clear();
        from.resize(coarse.len(), NOTHING);
        queue.clear();
        let fades = |i: usize| self.raised[i] == 1 && is_table(coarse[i]);
        let stride = partition.width as usize;
        for i in set_in(&self.raised).filter(|&i| fades(i)) {
            if let Some(j) = neighbours(i, width, height).find(|&j| !is_table(coarse[j])) {
                from[i] = partition.labels[j / width * reduction * stride + j % width * reduction];
                queue.push(i as u32);
            }
        }
        let mut next = 0;
        while let Some(&i) = queue.get(next) {
            next += 1;
            for j in neighbours(i as usize, width, height) {
                if from[j] == NOTHING && fades(j) {
                    from[j] = from[i as usize];
                    queue.push(j as u32);
                }
            }
        }
        penumbrae.fill(&from, (width, reduction), (partition.width, partition.height), partition.objects.len());
        (self.beyond, self.queue) = (from, queue);
    }

    /// Fills `cells` with the colour of the table, under what lies on it from coarser and coarser means. Returns whether there is any.
    ///
    /// Twice: faint shadows on it, which are still table here, are left out the second time.
    fn measure_table(&mut self, image: &WorkingImage) -> bool {
        self.measure_where(image, None) && {
            let first = std::mem::take(&mut self.cells);
            self.measure_where(image, Some(&first))
        }
    }

    /// From all of the table, or from what has about the light of an earlier measurement.
    fn measure_where(&mut self, image: &WorkingImage, first: Option<&[[f32; 3]]>) -> bool {
        let (columns, rows) = (image.width.div_ceil(CELL), image.height.div_ceil(CELL));
        self.levels.truncate(1);
        self.levels.resize_with(1, Level::default);
        let finest = &mut self.levels[0];
        (finest.columns, finest.rows) = (columns, rows);
        finest.sums.clear();
        finest.sums.resize(columns * rows, Sum::default());
        let near = &self.near;
        finest.sums.par_chunks_exact_mut(columns).enumerate().for_each_init(TableRow::default, |table, (row, line)| {
            for y in (row * CELL..((row + 1) * CELL).min(image.height)).step_by(STRIDE) {
                if let Some(first) = first {
                    table.fill(first, columns, y);
                }
                for x in (0..image.width).step_by(STRIDE) {
                    let i = y * image.width + x;
                    if near[i] == 0 {
                        let colour = linear(image.rgb[i]);
                        let deviates = || (brightness(colour, table.at(x)) - 1.0).abs() >= MOST_DEVIATION;
                        if first.is_none() || !deviates() {
                            line[x / CELL].add(colour, 1.0);
                        }
                    }
                }
            }
        });
        finest.smooth(&[1.0 / 16.0, 4.0 / 16.0, 6.0 / 16.0, 4.0 / 16.0, 1.0 / 16.0]);
        finest.smooth(&[0.25, 0.5, 0.25]);
        loop {
            let last = &self.levels[self.levels.len() - 1];
            if last.columns * last.rows <= 1 {
                break;
            }
            let coarser = last.halved();
            self.levels.push(coarser);
        }
        if self.levels.last().is_none_or(|whole| whole.sums.iter().all(|sum| sum.weight == 0.0)) {
            return false;
        }
        // A cell that has a quarter of its samples speaks for itself; the less it has, the more the coarser ones around it do.
        let full = ((CELL / STRIDE) * (CELL / STRIDE)) as f32 / 4.0;
        let mut coarse: Vec<[f32; 3]> = Vec::new();
        for (depth, level) in self.levels.iter().enumerate().rev() {
            let parent = self.levels.get(depth + 1);
            let fine = (0..level.sums.len()).map(|i| {
                let (x, y) = (i % level.columns, i / level.columns);
                let mut sum = level.sums[i];
                if let Some(parent) = parent
                    && sum.weight < full
                {
                    let around =
                        between(&coarse, parent.columns, parent.rows, x as f32 / 2.0 - 0.25, y as f32 / 2.0 - 0.25);
                    sum.add(around, full - sum.weight);
                }
                sum.mean()
            });
            coarse = fine.collect();
        }
        self.cells = coarse;
        true
    }

    /// Colour of the table at a pixel.
    fn table_at(&self, x: usize, y: usize) -> [f32; 3] {
        between(&self.cells, self.levels[0].columns, self.levels[0].rows, cell_of(x), cell_of(y))
    }

    /// How far from the table's a tone may be.
    fn most_rest(&mut self, image: &WorkingImage) -> f32 {
        let mut rests = std::mem::take(&mut self.rests);
        rests.clear();
        for y in (0..image.height).step_by(4 * STRIDE) {
            for x in (0..image.width).step_by(4 * STRIDE) {
                let i = y * image.width + x;
                if self.near[i] == 0 {
                    rests.push(against(linear(image.rgb[i]), self.table_at(x, y)).1);
                }
            }
        }
        let middle = rests.len() / 2;
        let noise = if rests.is_empty() { 0.0 } else { *rests.select_nth_unstable_by(middle, f32::total_cmp).1 };
        self.rests = rests;
        (NOISE_GAIN * noise.max(LEAST_NOISE)).min(MOST_REST)
    }

    fn find_faint(&mut self, image: &WorkingImage, light: f32, most_rest: f32) {
        let mut faint = std::mem::take(&mut self.faint);
        faint.resize(self.raised.len(), 0);
        let (width, this) = (image.width, &*self);
        let rows = faint.par_chunks_exact_mut(width).zip(this.raised.par_chunks_exact(width)).enumerate();
        rows.with_min_len(8).for_each_init(TableRow::default, |table, (y, (faint, raised))| {
            table.fill(&this.cells, this.levels[0].columns, y);
            for (x, (faint, &raised)) in faint.iter_mut().zip(raised).enumerate() {
                *faint = u8::from(
                    raised == 1 && {
                        let (brightness, rest) = against(linear(image.rgb[y * width + x]), this.table_at(x, y));
                        (light..=MOST_LIGHT).contains(&brightness) && rest <= most_rest
                    },
                );
            }
        });
        self.faint = faint;
    }

    /// Marks by 2 what can be reached from the table.
    fn reach(&mut self, width: usize, height: usize) {
        let Self { raised, faint, queue, .. } = self;
        queue.clear();
        let begins = set_in(faint).filter(|&i| neighbours(i, width, height).any(|j| raised[j] == 0));
        queue.extend(begins.map(|i| i as u32));
        for &i in &*queue {
            faint[i as usize] = 2;
        }
        while let Some(i) = queue.pop() {
            for j in neighbours(i as usize, width, height) {
                if faint[j] == 1 {
                    faint[j] = 2;
                    queue.push(j as u32);
                }
            }
        }
    }

    /// Takes the marks from connected groups that would lose most of their pixels.
    fn spare_groups(&mut self, width: usize) {
        self.groups.fill_alike(&self.raised, width, |a, b| a == b, |&pixel| u32::from(pixel));
        let count = self.groups.split_components(&mut self.sets);
        let (mut area, mut lost) = (vec![0u32; count], vec![0u32; count]);
        for (row, faint) in self.groups.rows().iter().zip(self.faint.chunks_exact(width)) {
            for run in row {
                area[run.label as usize] += run.end - run.start;
                let marked = faint[run.start as usize..run.end as usize].iter().filter(|&&f| f == 2).count();
                lost[run.label as usize] += marked as u32;
            }
        }
        self.spared.clear();
        self.spared.resize(self.raised.len(), 0);
        let rows = self.faint.chunks_exact_mut(width).zip(self.spared.chunks_exact_mut(width));
        for (row, (faint, spared)) in self.groups.rows().iter().zip(rows) {
            for run in row {
                let group = run.label as usize;
                if lost[group] as f32 > MOST_LOST * area[group] as f32 {
                    faint[run.start as usize..run.end as usize].fill(0);
                    spared[run.start as usize..run.end as usize].fill(1);
                }
            }
        }
    }
}

/// Whether a pixel is of the table and dark, by the mean of the table around it.
fn is_dark(tones: &[(f32, f32)], width: usize, i: usize, light: f32) -> bool {
    if tones[i].1 > MOST_REST_OF_SHADOW {
        return false;
    }
    let (x, y) = (i % width, i / width);
    let columns = x.saturating_sub(AGAINST_GRAIN)..(x + AGAINST_GRAIN + 1).min(width);
    let (mut sum, mut n) = (0.0, 0.0);
    for y in y.saturating_sub(AGAINST_GRAIN)..(y + AGAINST_GRAIN + 1).min(tones.len() / width) {
        for &(brightness, _) in &tones[y * width + columns.start..y * width + columns.end] {
            if brightness.is_finite() {
                sum += brightness;
                n += 1.0;
            }
        }
    }
    sum < light * n
}

/// Where a pixel lies among the centres of cells.
fn cell_of(pixel: usize) -> f32 {
    (pixel as f32 + 0.5) / CELL as f32 - 0.5
}

impl Level {
    /// Weighs every cell with its neighbours in its row, then in its column, by `kernel`, whose length is odd.
    fn smooth(&mut self, kernel: &[f32]) {
        let (columns, rows) = (self.columns as isize, self.rows as isize);
        let middle = (kernel.len() / 2) as isize;
        for (across, down) in [(1, 0), (0, 1)] {
            let smoothed = (0..columns * rows).map(|i| {
                let (x, y) = (i % columns, i / columns);
                let mut sum = Sum::default();
                for (k, &weight) in (-middle..).zip(kernel) {
                    let (x, y) = (x + k * across, y + k * down);
                    if (0..columns).contains(&x) && (0..rows).contains(&y) {
                        let other = &self.sums[(y * columns + x) as usize];
                        for (s, c) in sum.colour.iter_mut().zip(other.colour) {
                            *s += c * weight;
                        }
                        sum.weight += other.weight * weight;
                    }
                }
                sum
            });
            self.sums = smoothed.collect();
        }
    }

    /// The next coarser level: cells of 2 x 2 of these.
    fn halved(&self) -> Self {
        let (columns, rows) = (self.columns.div_ceil(2), self.rows.div_ceil(2));
        let mut sums = vec![Sum::default(); columns * rows];
        for (i, sum) in self.sums.iter().enumerate() {
            let to: &mut Sum = &mut sums[i / self.columns / 2 * columns + i % self.columns / 2];
            for (t, c) in to.colour.iter_mut().zip(sum.colour) {
                *t += c;
            }
            to.weight += sum.weight;
        }
        Self { columns, rows, sums }
    }
}

/// Bilinear interpolation between cells whose centres are at integers; beyond the outer centres their own value.
fn between(cells: &[[f32; 3]], columns: usize, rows: usize, x: f32, y: f32) -> [f32; 3] {
    let (x, y) = (x.clamp(0.0, (columns - 1) as f32), y.clamp(0.0, (rows - 1) as f32));
    let (left, top) = (x as usize, y as usize);
    let (right, bottom) = ((left + 1).min(columns - 1), (top + 1).min(rows - 1));
    let (u, v) = (x - left as f32, y - top as f32);
    let at = |column: usize, row: usize| cells[row * columns + column];
    let (a, b, c, d) = (at(left, top), at(right, top), at(left, bottom), at(right, bottom));
    std::array::from_fn(|k| (a[k] * (1.0 - u) + b[k] * u) * (1.0 - v) + (c[k] * (1.0 - u) + d[k] * u) * v)
}

/// The colour of the table along one row of pixels: the cells above and below are weighed once.
#[derive(Debug, Default)]
struct TableRow {
    columns: Vec<[f32; 3]>,
}

impl TableRow {
    fn fill(&mut self, cells: &[[f32; 3]], columns: usize, y: usize) {
        let rows = cells.len() / columns;
        let y = cell_of(y).clamp(0.0, (rows - 1) as f32);
        let top = y as usize;
        let (upper, lower, v) = (top * columns, (top + 1).min(rows - 1) * columns, y - top as f32);
        let pairs = cells[upper..upper + columns].iter().zip(&cells[lower..lower + columns]);
        self.columns.clear();
        self.columns.extend(pairs.map(|(a, b)| -> [f32; 3] { std::array::from_fn(|k| a[k] + (b[k] - a[k]) * v) }));
    }

    fn at(&self, x: usize) -> [f32; 3] {
        let last = self.columns.len() - 1;
        let x = cell_of(x).clamp(0.0, last as f32);
        let left = x as usize;
        let (a, b, u) = (self.columns[left], self.columns[(left + 1).min(last)], x - left as f32);
        std::array::from_fn(|k| a[k] + (b[k] - a[k]) * u)
    }
}

/// `(b, d)` of a colour against the table's, see the module documentation.
fn against(colour: [f32; 3], table: [f32; 3]) -> (f32, f32) {
    let brightness = brightness(colour, table);
    let rest: [f32; 3] = std::array::from_fn(|k| colour[k] - brightness * table[k]);
    (brightness, (dot(rest, rest) / dot(table, table).max(1e-9)).sqrt())
}

/// `b` alone.
fn brightness(colour: [f32; 3], table: [f32; 3]) -> f32 {
    dot(colour, table) / dot(table, table).max(1e-9)
}

fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}
