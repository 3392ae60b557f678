//! The penumbra as table: where a shadow fades out, the table has nearly all of its light, and goes back to it.
//!
//! The border of a partition lies where the colour leaves that of the table by a bandwidth; at a soft shadow that is far out, where
//! nobody would call the table dark. So the table's light is estimated under everything that is not table, in linear light, in which
//! a shadow is a factor `b`:
//!
//! ```text
//! colour = b * table + rest        b by least squares, d = |rest| / |table|
//! ```
//!
//! From the table on, pixels with `light <= b <= 1.05` whose `d` is no more than the table itself varies are table, too. A part of
//! another tone stops that. Of a part that has the table's own tone (steel on steel) most would go: a group of pixels that would
//! lose more than three fifths stays as it is.

use std::sync::LazyLock;

use crate::disjoint_sets::DisjointSets;
use crate::runs::Runs;
use crate::table::{background_of, fill_from_table, filter3};
use crate::working_image::{UNITS_PER_LEVEL, WorkingImage};

/// Side of the cells in which the mean colour of the table is taken, working pixels.
const CELL: usize = 16;
/// Every so many pixels of every so many rows one is read for that: neighbours say the same.
const STRIDE: usize = 2;
/// Light from which on it is no table but something bright on it.
const MOST_LIGHT: f32 = 1.05;
/// How far a tone may be from the table's, in medians of what the table itself has.
const NOISE_GAIN: f32 = 4.0;
/// What the table varies at least, and what is allowed at most.
const LEAST_NOISE: f32 = 0.01;
const MOST_REST: f32 = 0.06;
/// A group of pixels that would lose more than this share is a part of the table's tone.
const MOST_LOST: f32 = 0.6;

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
    /// Gives penumbrae back to the table. `labels` holds `count` dense labels, some of which may not occur; `light` is the share of
    /// its light, 0 to 1, from which on the table is table.
    pub(crate) fn absorb(&mut self, image: &WorkingImage, labels: &mut [u32], count: usize, light: f32) {
        let (width, height) = (image.width, image.height);
        if light >= 1.0 || width < 5 || height < 5 {
            return;
        }
        let table = background_of(labels, width, count);
        self.raised.clear();
        self.raised.extend(labels.iter().map(|&l| u8::from(!table[l as usize])));
        // Mixed pixels and the foot of the penumbra itself do not tell the colour of the table.
        filter3(&self.raised, &mut self.rows, &mut self.scratch, width, height, |a, b| a | b);
        filter3(&self.scratch, &mut self.rows, &mut self.near, width, height, |a, b| a | b);
        if !self.measure_table(image) {
            return;
        }
        let most_rest = self.most_rest(image);
        self.find_faint(image, light, most_rest);
        self.reach(width, height);
        self.spare_groups(width);
        self.kept.clear();
        self.kept.extend(self.raised.iter().zip(&self.faint).map(|(&raised, &faint)| raised & u8::from(faint != 2)));
        filter3(&self.kept, &mut self.rows, &mut self.scratch, width, height, |a, b| a & b);
        filter3(&self.scratch, &mut self.rows, &mut self.kept, width, height, |a, b| a | b);
        fill_from_table(&mut self.raised, &self.kept, &mut self.queue, labels, width);
    }

    /// Fills `cells` with the colour of the table, under what lies on it from coarser and coarser means. Returns whether there is any.
    fn measure_table(&mut self, image: &WorkingImage) -> bool {
        let (columns, rows) = (image.width.div_ceil(CELL), image.height.div_ceil(CELL));
        self.levels.resize_with(1, Level::default);
        let finest = &mut self.levels[0];
        (finest.columns, finest.rows) = (columns, rows);
        finest.sums.clear();
        finest.sums.resize(columns * rows, Sum::default());
        for y in (0..image.height).step_by(STRIDE) {
            let line = &mut finest.sums[y / CELL * columns..][..columns];
            for x in (0..image.width).step_by(STRIDE) {
                let i = y * image.width + x;
                if self.near[i] == 0 {
                    line[x / CELL].add(linear(image.rgb[i]), 1.0);
                }
            }
        }
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
        let at = |p: usize| (p as f32 + 0.5) / CELL as f32 - 0.5;
        between(&self.cells, self.levels[0].columns, self.levels[0].rows, at(x), at(y))
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
        faint.clear();
        faint.extend((0..self.raised.len()).map(|i| {
            if self.raised[i] == 0 {
                return 0;
            }
            let table = self.table_at(i % image.width, i / image.width);
            let (brightness, rest) = against(linear(image.rgb[i]), table);
            u8::from((light..=MOST_LIGHT).contains(&brightness) && rest <= most_rest)
        }));
        self.faint = faint;
    }

    /// Marks by 2 what can be reached from the table.
    fn reach(&mut self, width: usize, height: usize) {
        let Self { raised, faint, queue, .. } = self;
        queue.clear();
        let neighbours = |i: usize| {
            let (x, y) = (i % width, i / width);
            let sides = [
                (x > 0).then(|| i - 1),
                (x + 1 < width).then_some(i + 1),
                (y > 0).then(|| i - width),
                (y + 1 < height).then_some(i + width),
            ];
            sides.into_iter().flatten()
        };
        for i in 0..faint.len() {
            if faint[i] == 1 && neighbours(i).any(|j| raised[j] == 0) {
                faint[i] = 2;
                queue.push(i as u32);
            }
        }
        while let Some(i) = queue.pop() {
            for j in neighbours(i as usize) {
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
        for (row, faint) in self.groups.rows().iter().zip(self.faint.chunks_exact_mut(width)) {
            for run in row {
                let group = run.label as usize;
                if lost[group] as f32 > MOST_LOST * area[group] as f32 {
                    faint[run.start as usize..run.end as usize].fill(0);
                }
            }
        }
    }
}

impl Level {
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

/// `(b, d)` of a colour against the table's, see the module documentation.
fn against(colour: [f32; 3], table: [f32; 3]) -> (f32, f32) {
    let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let whole = dot(table, table).max(1e-9);
    let brightness = dot(colour, table) / whole;
    let rest: [f32; 3] = std::array::from_fn(|k| colour[k] - brightness * table[k]);
    (brightness, (dot(rest, rest) / whole).sqrt())
}
