//! The result of segmentation: a label image and what is known of every label.

use image::{ImageBuffer, Rgb};
use rayon::prelude::*;
use serde::Serialize;

use crate::penumbrae::Penumbrae;
use crate::runs::{Run, Runs, for_each_contact};
use crate::table::background_of;

/// A borrowed, packed 8-bit RGB image: `width * height * 3` bytes, rows from top to bottom without padding.
pub type RgbView<'a> = ImageBuffer<Rgb<u8>, &'a [u8]>;

/// An axis-parallel box of whole pixels: columns `x .. x + width`, rows `y .. y + height`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct BoundingBox {
    /// Leftmost column, px.
    pub x: u32,
    /// Topmost row, px.
    pub y: u32,
    /// Number of columns, px; at least 1.
    pub width: u32,
    /// Number of rows, px; at least 1.
    pub height: u32,
}

impl BoundingBox {
    /// Rightmost column that belongs to the box.
    pub fn right(&self) -> u32 {
        self.x + self.width - 1
    }

    /// Bottommost row that belongs to the box.
    pub fn bottom(&self) -> u32 {
        self.y + self.height - 1
    }

    /// The smallest box that holds both.
    pub fn union(&self, other: &Self) -> Self {
        let (x, y) = (self.x.min(other.x), self.y.min(other.y));
        let (right, bottom) = (self.right().max(other.right()), self.bottom().max(other.bottom()));
        Self { x, y, width: right - x + 1, height: bottom - y + 1 }
    }
}

/// One proto-object partition `P_i` (eq 1).
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ProtoObject {
    /// Number of pixels.
    pub area: u32,
    /// Mean colour of the image over the partition, RGB, each in 0..=255.
    pub mean: [f32; 3],
    /// Extent in the image.
    pub bbox: BoundingBox,
    /// Centre of area (x, y), px, pixel centres at integers.
    pub centroid: [f32; 2],
}

/// A decomposition of an image into disjoint partitions that cover it (eq 1).
///
/// ```text
/// 0 0 0 1      labels of a 4 x 3 image with three partitions:
/// 0 2 2 1      areas 6, 3, 3; partition 2 has the neighbours 0 and 1
/// 0 0 2 1
/// ```
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Partition {
    pub(crate) width: u32,
    pub(crate) height: u32,
    pub(crate) labels: Vec<u32>,
    pub(crate) runs: Runs,
    pub(crate) objects: Vec<ProtoObject>,
    pub(crate) penumbrae: Penumbrae,
    /// `neighbours[neighbour_start[i] .. neighbour_start[i + 1]]` are those of partition i, ascending.
    neighbour_start: Vec<u32>,
    neighbours: Vec<u32>,
    /// Scratch of `measure`, kept so that a stream of frames does not allocate it anew.
    pairs: Vec<u64>,
}

/// Why a label image is not a partition of an image.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum LabelError {
    /// The label image and the colour image differ in size.
    #[error("{labels} labels for an image of {width} x {height} = {pixels} pixels; there must be one label a pixel")]
    Size {
        /// Number of labels given.
        labels: usize,
        /// Width of the image, px.
        width: u32,
        /// Height of the image, px.
        height: u32,
        /// Number of pixels of the image.
        pixels: usize,
    },
    /// Labels must be dense: every value in `0..count` occurs.
    #[error("label {missing} does not occur although {largest} does; labels must be dense, 0 to n - 1")]
    NotDense {
        /// The smallest value that does not occur.
        missing: u32,
        /// The largest value that occurs.
        largest: u32,
    },
}

impl Partition {
    /// Builds a partition from a label image, row by row, and the colours under it.
    ///
    /// Labels must be dense (`0..n`, each used); they need not be connected, although those of
    /// [`Segmenter`](crate::Segmenter) are.
    ///
    /// # Errors
    /// [`LabelError`] when sizes differ or a label is missing.
    pub fn from_labels(image: &RgbView<'_>, labels: Vec<u32>) -> Result<Self, LabelError> {
        let (width, height) = image.dimensions();
        let pixels = width as usize * height as usize;
        if labels.len() != pixels {
            return Err(LabelError::Size { labels: labels.len(), width, height, pixels });
        }
        let largest = labels.iter().copied().max().unwrap_or(0);
        // More labels than pixels cannot be dense: without this check a stray value would cost gigabytes.
        let count = (largest as usize).saturating_add(1).min(pixels);
        let mut seen = vec![false; count];
        for &label in &labels {
            if let Some(slot) = seen.get_mut(label as usize) {
                *slot = true;
            }
        }
        let missing = seen.iter().position(|&s| !s).or((largest as usize >= pixels && pixels > 0).then_some(pixels));
        if let Some(missing) = missing {
            return Err(LabelError::NotDense { missing: missing as u32, largest });
        }
        let mut partition = Self { width, height, labels, ..Self::default() };
        if pixels > 0 {
            partition.runs.fill(&partition.labels, width as usize);
        }
        partition.measure(image, count);
        Ok(partition)
    }

    /// Width of the image, px.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Height of the image, px.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// The label of every pixel, row by row: `height * width` values in `0..len()`.
    pub fn labels(&self) -> &[u32] {
        &self.labels
    }

    /// The labels as runs, row by row.
    pub fn runs(&self) -> &Runs {
        &self.runs
    }

    /// Number of partitions N.
    pub fn len(&self) -> usize {
        self.objects.len()
    }

    /// Whether there is no partition, which only an image without pixels has.
    pub fn is_empty(&self) -> bool {
        self.objects.is_empty()
    }

    /// The partitions; the index is the label.
    pub fn objects(&self) -> &[ProtoObject] {
        &self.objects
    }

    /// Which partitions are background: those that hold at least a tenth of the border of the image, or the largest
    /// share of it. One flag a label.
    pub fn border_background(&self) -> Vec<bool> {
        background_of(&self.labels, self.width as usize, self.len())
    }

    /// Labels of the partitions that share an edge of a pixel with `label`, ascending; empty for an unknown label.
    pub fn neighbours(&self, label: u32) -> &[u32] {
        let i = label as usize;
        match (self.neighbour_start.get(i), self.neighbour_start.get(i + 1)) {
            (Some(&from), Some(&to)) => &self.neighbours[from as usize..to as usize],
            _ => &[],
        }
    }

    /// Where shadows fade out in row `y`, from left to right: columns of the table, each with the label that it fades from. Blocks
    /// of working pixels, so that single pixels of them may belong to a shadow by [`Partition::labels`], which holds. Nothing in a
    /// partition of labels, or one made with a `penumbra_light` of 1.
    pub fn penumbrae(&self, y: u32) -> impl Iterator<Item = Run> {
        self.penumbrae.row(y, self.width)
    }

    /// What the table fades from at a pixel, as [`Partition::penumbrae`] has it.
    pub fn fades_from(&self, x: u32, y: u32) -> Option<u32> {
        self.penumbrae.at(x, y)
    }

    /// The extent of the table that fades from `label`; `None` where there is none.
    pub fn penumbra_box(&self, label: u32) -> Option<BoundingBox> {
        self.penumbrae.bbox(label)
    }

    /// Fills `objects` and the neighbours from `runs`, whose labels must lie in `0..count`, each used.
    pub(crate) fn measure(&mut self, image: &RgbView<'_>, count: usize) {
        let sums = sums_of(&self.runs, image, count);
        self.describe(&sums);
    }

    /// As [`Partition::measure`], from what is known of every label.
    pub(crate) fn describe(&mut self, sums: &[Sums]) {
        self.objects.clear();
        self.objects.extend(sums.iter().map(Sums::object));
        self.find_neighbours(sums.len());
    }

    fn find_neighbours(&mut self, count: usize) {
        self.pairs.clear();
        let pairs = &mut self.pairs;
        let mut touch = |a: u32, b: u32| {
            pairs.push((u64::from(a) << 32) | u64::from(b));
            pairs.push((u64::from(b) << 32) | u64::from(a));
        };
        for (y, row) in self.runs.rows().iter().enumerate() {
            for pair in row.windows(2) {
                touch(pair[0].label, pair[1].label);
            }
            let below = self.runs.row(y + 1);
            for_each_contact(row, below, |i, j, _| {
                if row[i].label != below[j].label {
                    touch(row[i].label, below[j].label);
                }
            });
        }
        self.pairs.sort_unstable();
        self.pairs.dedup();
        self.neighbour_start.clear();
        self.neighbour_start.resize(count + 1, 0);
        self.neighbours.clear();
        for &pair in &self.pairs {
            self.neighbour_start[(pair >> 32) as usize + 1] += 1;
            self.neighbours.push(pair as u32);
        }
        for i in 0..count {
            self.neighbour_start[i + 1] += self.neighbour_start[i];
        }
    }
}

/// The sums of `count` labels over their runs.
pub(crate) fn sums_of(runs: &Runs, image: &RgbView<'_>, count: usize) -> Vec<Sums> {
    let (width, bytes): (usize, &[u8]) = (image.width() as usize, image.as_raw());
    // Bands of rows are summed side by side and added up. Sums are integers, so the result does not depend on the
    // number of threads. Every band has sums of its own for all labels: with a label every few pixels that would be many times
    // the image, so then one band does it.
    let rows = runs.rows().len();
    let few_labels = count < width * rows / 64;
    let band = if few_labels { rows.div_ceil(2 * rayon::current_num_threads()).max(32) } else { rows.max(1) };
    let bands = runs.rows().par_chunks(band).enumerate().map(|(i, rows)| {
        let mut sums = vec![Sums::NONE; count];
        for (y, row) in (i * band..).zip(rows) {
            for run in row {
                sums[run.label as usize].add_run(y, run, sum_rgb(bytes, width, y, run));
            }
        }
        sums
    });
    let total = bands.reduce_with(|mut a, b| {
        a.iter_mut().zip(&b).for_each(|(a, b)| a.add(b));
        a
    });
    total.unwrap_or_default()
}

/// Sum of the colours of a run of row `y`; `width` pixels a row.
fn sum_rgb(bytes: &[u8], width: usize, y: usize, run: &Run) -> [u32; 3] {
    let row = y * width;
    // Sixteen pixels side by side: the compiler adds them in registers.
    let (blocks, rest) = bytes[(row + run.start as usize) * 3..(row + run.end as usize) * 3].as_chunks::<48>();
    let mut lanes = [0u32; 48];
    for block in blocks {
        for (lane, &c) in lanes.iter_mut().zip(block) {
            *lane += u32::from(c);
        }
    }
    let mut sum = [0u32; 3];
    for px in lanes.as_chunks::<3>().0 {
        for (s, c) in sum.iter_mut().zip(px) {
            *s += c;
        }
    }
    for px in rest.as_chunks::<3>().0 {
        for (s, &c) in sum.iter_mut().zip(px) {
            *s += u32::from(c);
        }
    }
    sum
}

/// Sums over the pixels of one partition.
#[derive(Clone, Copy)]
pub(crate) struct Sums {
    pub(crate) area: u64,
    pub(crate) rgb: [u64; 3],
    x: u64,
    y: u64,
    left: u32,
    right: u32,
    top: u32,
    bottom: u32,
}

impl Sums {
    pub(crate) const NONE: Self =
        Self { area: 0, rgb: [0; 3], x: 0, y: 0, left: u32::MAX, right: 0, top: u32::MAX, bottom: 0 };

    fn add_run(&mut self, y: usize, run: &Run, rgb: [u32; 3]) {
        let n = u64::from(run.end - run.start);
        self.area += n;
        for (t, c) in self.rgb.iter_mut().zip(rgb) {
            *t += u64::from(c);
        }
        self.x += u64::from(run.start + run.end - 1) * n / 2;
        self.y += y as u64 * n;
        self.left = self.left.min(run.start);
        self.right = self.right.max(run.end - 1);
        self.top = self.top.min(y as u32);
        self.bottom = self.bottom.max(y as u32);
    }

    pub(crate) fn add(&mut self, o: &Self) {
        self.area += o.area;
        for (a, b) in self.rgb.iter_mut().zip(o.rgb) {
            *a += b;
        }
        self.x += o.x;
        self.y += o.y;
        self.left = self.left.min(o.left);
        self.right = self.right.max(o.right);
        self.top = self.top.min(o.top);
        self.bottom = self.bottom.max(o.bottom);
    }

    fn object(&self) -> ProtoObject {
        let n = self.area.max(1) as f64;
        ProtoObject {
            area: self.area as u32,
            mean: self.rgb.map(|c| (c as f64 / n) as f32),
            bbox: BoundingBox {
                x: self.left,
                y: self.top,
                width: self.right.saturating_sub(self.left) + 1,
                height: self.bottom.saturating_sub(self.top) + 1,
            },
            centroid: [(self.x as f64 / n) as f32, (self.y as f64 / n) as f32],
        }
    }
}
