//! The segmenter: the stages in order, and the memory they reuse.

use crate::disjoint_sets::DisjointSets;
use crate::mean_shift::{BANDWIDTH, MAX_RADIUS, MeanShift, distance_within};
use crate::median::{self, median};
use crate::merge::Merger;
use crate::params::{SegmentParamError, SegmentParams};
use crate::partition::{Partition, RgbView, Sums, sums_of};
use crate::penumbra::PenumbraFinder;
use crate::refine::{Coarse, refine};
use crate::runs::Runs;
use crate::table::TableFinder;
use crate::texture::{Whitening, table_covariance};
use crate::working_image::WorkingImage;

/// Longest side of an image that is accepted, px.
pub const MAX_SIDE_PX: u32 = 16_384;

/// Neighbours whose modes are within a third of the range bandwidth are one component, in units.
const LINK: i16 = BANDWIDTH / 3;

/// Why an image was not segmented.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SegmentError {
    /// The image has no pixels or is too large.
    #[error("image of {width} x {height} px; both sides must be 1 to {MAX_SIDE_PX}")]
    Size {
        /// Width of the image, px.
        width: u32,
        /// Height of the image, px.
        height: u32,
    },
}

/// Mean shift segmentation with memory that is reused from image to image.
///
/// ```
/// use samsod_segment::{RgbView, SegmentParams, Segmenter};
/// // Left half black, right half white.
/// let pixels: Vec<u8> = (0..60 * 40).flat_map(|i| [if i % 60 < 30 { 0 } else { 255 }; 3]).collect();
/// let image = RgbView::from_raw(60, 40, pixels.as_slice()).ok_or("size")?;
/// let partition = Segmenter::new(SegmentParams::default())?.segment(&image)?;
/// assert_eq!(partition.len(), 2);
/// assert_eq!(partition.objects()[0].area, 30 * 40);
/// assert_eq!(partition.neighbours(0), [1]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Segmenter {
    params: SegmentParams,
    working: WorkingImage,
    /// The same less smoothed, for where shadows end.
    sharp: WorkingImage,
    unfiltered: Vec<[u16; 3]>,
    blocks: Vec<[f32; 7]>,
    mean_shift: MeanShift,
    sets: DisjointSets,
    coarse_labels: Vec<u32>,
    coarse_runs: Runs,
    merger: Merger,
    table: TableFinder,
    penumbra: PenumbraFinder,
}

impl Segmenter {
    /// Makes a segmenter.
    ///
    /// # Errors
    /// The parameter that is out of range, with the value and what is allowed.
    pub fn new(params: SegmentParams) -> Result<Self, SegmentParamError> {
        params.check()?;
        Ok(Self {
            params,
            working: WorkingImage::default(),
            sharp: WorkingImage::default(),
            unfiltered: Vec::new(),
            blocks: Vec::new(),
            mean_shift: MeanShift::default(),
            sets: DisjointSets::default(),
            coarse_labels: Vec::new(),
            coarse_runs: Runs::default(),
            merger: Merger::default(),
            table: TableFinder::default(),
            penumbra: PenumbraFinder::default(),
        })
    }

    /// Segments one image.
    ///
    /// # Errors
    /// [`SegmentError::Size`] for an image without pixels or with a side above [`MAX_SIDE_PX`].
    pub fn segment(&mut self, image: &RgbView<'_>) -> Result<Partition, SegmentError> {
        let mut partition = Partition::default();
        self.segment_into(image, &mut partition)?;
        Ok(partition)
    }

    /// Segments one image into a partition whose memory is reused.
    ///
    /// # Errors
    /// As [`Segmenter::segment`]; the partition is then unchanged.
    pub fn segment_into(&mut self, image: &RgbView<'_>, partition: &mut Partition) -> Result<(), SegmentError> {
        let (width, height) = image.dimensions();
        if width == 0 || height == 0 || width > MAX_SIDE_PX || height > MAX_SIDE_PX {
            return Err(SegmentError::Size { width, height });
        }
        let bandwidth = self.params.spatial_bandwidth_for(width, height);
        let min_area = self.params.min_area_for(width, height);
        let penumbra_light = self.params.penumbra_light;
        let reduction = reduction_for(bandwidth);

        self.working.fill(image, reduction);
        if penumbra_light < 1.0 {
            // The median below is as wide as a thin shadow.
            self.sharp.copy_from(&self.working);
        }
        let radius = ((bandwidth / reduction as f32 / 3.0).round() as usize).min(median::MAX_RADIUS);
        median(&mut self.working.rgb, self.working.width, radius, &mut self.unfiltered);
        let covariance = table_covariance(&self.working, &mut self.blocks);
        let whitening = Whitening::new(self.params.range_bandwidth, self.params.texture_gain, covariance);
        self.mean_shift.search(&self.working, &whitening, bandwidth / reduction as f32);

        let (w, h) = (self.working.width, self.working.height);
        let (mut sharp, mut unfiltered) = (std::mem::take(&mut self.sharp), std::mem::take(&mut self.unfiltered));
        // Labels are joined on one core for the most part.
        let (count, ()) = rayon::join(
            || {
                let count = self.label_modes((min_area as usize / (reduction * reduction)).max(1) as u32);
                self.table.absorb_texture(&mut self.coarse_labels, w, count, bandwidth / reduction as f32);
                count
            },
            || {
                if penumbra_light < 1.0 {
                    median(&mut sharp.rgb, sharp.width, 1, &mut unfiltered);
                }
            },
        );
        (self.sharp, self.unfiltered) = (sharp, unfiltered);
        self.penumbra.absorb(&self.sharp, &mut self.coarse_labels, count, penumbra_light);

        let (labels, modes) = (&self.coarse_labels, &self.mean_shift.modes);
        let coarse = Coarse { width: w, height: h, reduction, labels, modes };
        refine(image, &whitening, &coarse, &mut partition.labels);
        self.penumbra.settle(image, &coarse, &mut partition.labels, penumbra_light);
        (partition.width, partition.height) = (width, height);
        self.prune(image, min_area, partition);
        self.penumbra.attribute(&self.coarse_labels, (w, reduction), partition);
        Ok(())
    }

    /// Fills `coarse_labels` with the components of alike modes, joined and pruned; returns their number.
    fn label_modes(&mut self, min_area: u32) -> usize {
        let (w, h) = (self.working.width, self.working.height);
        let modes = &self.mean_shift.modes;
        let alike = |a: &[i16; 3], b: &[i16; 3]| distance_within(*a, *b, LINK);
        self.coarse_runs.fill_alike(modes, w, alike, |_| 0);
        let count = self.coarse_runs.split_where(&mut self.sets, |y, _, _, columns| {
            let (from, to) = (columns.start as usize, columns.end as usize);
            let (above, below) = (&modes[(y - 1) * w..y * w], &modes[y * w..(y + 1) * w]);
            above[from..to].iter().zip(&below[from..to]).any(|(a, b)| alike(a, b))
        });
        self.merger.measure(&self.coarse_runs, count, |y, run| {
            let mut sum = [0; 3];
            for mode in &modes[y * w + run.start as usize..y * w + run.end as usize] {
                for (s, &m) in sum.iter_mut().zip(mode) {
                    *s += i32::from(m);
                }
            }
            sum
        });
        self.merger.join_alike(f32::from(LINK));
        self.merger.join_small(min_area);
        let numbers = self.merger.numbers();
        self.coarse_runs.relabel(&numbers.labels);
        self.coarse_labels.resize(w * h, 0);
        self.coarse_runs.write(&mut self.coarse_labels, w);
        numbers.count
    }

    /// Makes a partition of refined labels: refinement can cut one in pieces or leave single pixels.
    fn prune(&mut self, image: &RgbView<'_>, min_area: u32, partition: &mut Partition) {
        let width = partition.width as usize;
        let Partition { labels, runs, .. } = &mut *partition;
        runs.fill(labels, width);
        let count = runs.split_components(&mut self.sets);
        let of_components = sums_of(runs, image, count);
        self.merger.take(runs, of_components.iter().map(|s| (s.area as u32, s.rgb.map(|c| c as i64))));
        self.merger.join_small(min_area);
        let numbers = self.merger.numbers();
        runs.relabel(&numbers.labels);
        runs.write(labels, width);
        let mut sums = vec![Sums::NONE; numbers.count];
        for (component, &label) in of_components.iter().zip(&numbers.labels) {
            sums[label as usize].add(component);
        }
        partition.describe(&sums);
    }
}

/// The power of two by which the image is reduced so that the bandwidth fits the kernel of the mode search.
fn reduction_for(bandwidth_px: f32) -> usize {
    let mut reduction = 1;
    while bandwidth_px / reduction as f32 >= (MAX_RADIUS + 1) as f32 {
        reduction *= 2;
    }
    reduction
}
