//! The stage: parameters, scratch memory, checks of the input, and the order of the steps.

use samsod_saliency::{SaliencyMap, SalientRegion};
use samsod_segment::{Partition, RgbView};

use crate::basins::NONE;
use crate::crop::{Crop, Owners, paint_crops};
use crate::evidence::Evidence;
use crate::fringe::FringeSigns;
use crate::ncut::NcutError;
use crate::objects::find_objects;
use crate::params::{ObjectSide, ShadowParamError, ShadowParams};
use crate::signs::Signs;
use crate::{ObjectRegion, paper};

/// Why objects could not be separated from shadows.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ShadowError {
    /// The frame and the partition differ in size.
    #[error("frame of {frame_width} x {frame_height} px for a partition of {width} x {height} px")]
    FrameSize {
        /// Width of the frame, px.
        frame_width: u32,
        /// Height of the frame, px.
        frame_height: u32,
        /// Width of the partition, px.
        width: u32,
        /// Height of the partition, px.
        height: u32,
    },
    /// The saliency map and the partition differ in size.
    #[error("saliency map of {map_width} x {map_height} px for a partition of {width} x {height} px")]
    MapSize {
        /// Width of the map, px.
        map_width: u32,
        /// Height of the map, px.
        map_height: u32,
        /// Width of the partition, px.
        width: u32,
        /// Height of the partition, px.
        height: u32,
    },
    /// A region has a partition that is not there: it belongs to another image.
    #[error("region {region} has the partition {label}; there are {count}, from 0")]
    Label {
        /// Index of the region.
        region: usize,
        /// Label of the partition.
        label: u32,
        /// Number of partitions.
        count: usize,
    },
    /// Regions must be disjoint.
    #[error("partition {label} belongs to the regions {first} and {second}; it may belong to one")]
    Shared {
        /// Label of the partition.
        label: u32,
        /// Index of the one region.
        first: usize,
        /// Index of the other; the same when the label stands twice in one region.
        second: usize,
    },
    /// There must be one probability for every piece.
    #[error("{given} probabilities for {pieces} pieces; each needs one in [0, 1]")]
    Probabilities {
        /// Number of probabilities given.
        given: usize,
        /// Number of pieces.
        pieces: usize,
    },
    /// There must be one probability for every pixel at an outline.
    #[error("{given} probabilities for {pixels} pixels at outlines; each needs one in [0, 1]")]
    FringeProbabilities {
        /// Number of probabilities given.
        given: usize,
        /// Number of pixels.
        pixels: usize,
    },
    /// A graph of partitions could not be cut, which no image should bring about.
    #[error("normalised cut: {0}")]
    Cut(#[from] NcutError),
}

/// What a method sees.
#[derive(Clone, Copy)]
pub(crate) struct Input<'a> {
    /// The frame.
    pub(crate) frame: &'a RgbView<'a>,
    /// Its partition.
    pub(crate) partition: &'a Partition,
    /// Its saliency.
    pub(crate) saliency: &'a SaliencyMap,
    /// Its salient regions; `crops[i]` is that of `regions[i]`.
    pub(crate) regions: &'a [SalientRegion],
    /// To which region each partition belongs.
    pub(crate) owners: &'a Owners,
}

/// The pieces that the regions of a frame are parted into, and what `"evidence"` knows of them.
#[derive(Debug, Clone, PartialEq)]
pub struct Pieces {
    /// Index of the piece of every pixel of the frame, row by row; -1 where there is none.
    pub labels: Vec<i32>,
    /// The signs of every piece, region by region.
    pub signs: Vec<Signs>,
}

/// The pixels at the outlines of what is judged part, and what `"evidence"` knows of them.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FringePixels {
    /// Their places in the frame (x, y), px, region by region.
    pub places: Vec<[u32; 2]>,
    /// Their signs.
    pub signs: Vec<FringeSigns>,
}

/// Separates objects from shadows; keeps its scratch memory from frame to frame.
#[derive(Debug)]
pub struct ShadowSeparator {
    params: ShadowParams,
    owners: Owners,
    crops: Vec<Crop>,
    evidence: Evidence,
}

impl ShadowSeparator {
    /// Makes a separator.
    ///
    /// # Errors
    /// The parameter that is out of range, with the value and what is allowed.
    pub fn new(params: ShadowParams) -> Result<Self, ShadowParamError> {
        params.check()?;
        Ok(Self { params, owners: Owners::default(), crops: Vec::new(), evidence: Evidence::default() })
    }

    /// The parameters in force.
    pub fn params(&self) -> &ShadowParams {
        &self.params
    }

    /// The objects of a frame: by region, in the order of `regions`, and largest first within a region.
    ///
    /// # Errors
    /// [`ShadowError`] when sizes differ, or regions are not those of the partition.
    pub fn separate(
        &mut self,
        frame: &RgbView<'_>,
        partition: &Partition,
        saliency: &SaliencyMap,
        regions: &[SalientRegion],
    ) -> Result<Vec<ObjectRegion>, ShadowError> {
        let mut objects = Vec::new();
        self.separate_into(frame, partition, saliency, regions, &mut objects)?;
        Ok(objects)
    }

    /// As [`ShadowSeparator::separate`], into a vector whose memory is reused.
    ///
    /// # Errors
    /// As [`ShadowSeparator::separate`]; the vector is then unchanged.
    pub fn separate_into(
        &mut self,
        frame: &RgbView<'_>,
        partition: &Partition,
        saliency: &SaliencyMap,
        regions: &[SalientRegion],
        objects: &mut Vec<ObjectRegion>,
    ) -> Result<(), ShadowError> {
        let side = self.params.object_side;
        // Into the pool once: every parallel step that began outside of it would put this thread to sleep and wake it again.
        rayon::scope(|_| {
            self.with_crops(frame, partition, saliency, regions, |evidence, input, crops| match side {
                ObjectSide::Paper => Ok(paper::label_regions(input, crops)?),
                ObjectSide::Evidence => {
                    evidence.label_regions(input, crops);
                    Ok(())
                }
            })?;
            self.find_objects(partition, regions, objects);
            Ok(())
        })
    }

    /// The pieces that `"evidence"` judges, whatever the parameters say, with their signs: to fit its judgement.
    ///
    /// # Errors
    /// As [`ShadowSeparator::separate`].
    pub fn pieces(
        &mut self,
        frame: &RgbView<'_>,
        partition: &Partition,
        saliency: &SaliencyMap,
        regions: &[SalientRegion],
    ) -> Result<Pieces, ShadowError> {
        self.with_crops(frame, partition, saliency, regions, |evidence, input, crops| {
            evidence.describe(input, crops);
            Ok(())
        })?;
        let width = partition.width() as usize;
        let mut pieces = Pieces { labels: vec![-1; partition.labels().len()], signs: Vec::new() };
        for (crop, (labels, signs)) in self.crops.iter().zip(self.evidence.described(regions.len())) {
            let Some(bbox) = crop.bbox else { continue };
            let first = pieces.signs.len();
            for (row, labels) in (bbox.y as usize..).zip(labels.chunks_exact(crop.width())) {
                let start = row * width + bbox.x as usize;
                for (to, &label) in pieces.labels[start..start + crop.width()].iter_mut().zip(labels) {
                    if label != NONE {
                        *to = (first + label as usize) as i32;
                    }
                }
            }
            pieces.signs.extend_from_slice(signs);
        }
        Ok(pieces)
    }

    /// The pixels at the outlines that `"evidence"` settles when the pieces, in the order of [`ShadowSeparator::pieces`], are
    /// part with these probabilities in [0, 1], with their signs: to fit how they are settled.
    ///
    /// # Errors
    /// As [`ShadowSeparator::separate`], and [`ShadowError::Probabilities`].
    pub fn fringe(
        &mut self,
        frame: &RgbView<'_>,
        partition: &Partition,
        saliency: &SaliencyMap,
        regions: &[SalientRegion],
        parts: &[f32],
    ) -> Result<FringePixels, ShadowError> {
        self.with_crops(frame, partition, saliency, regions, |evidence, input, crops| {
            write_judged(evidence, input, crops, parts)?;
            evidence.describe_fringes(crops);
            Ok(())
        })?;
        let mut fringe = FringePixels::default();
        for (crop, (pixels, signs)) in self.crops.iter().zip(self.evidence.described_fringes(regions.len())) {
            let Some(bbox) = crop.bbox else { continue };
            let place = |&i: &u32| [bbox.x + i % bbox.width, bbox.y + i / bbox.width];
            fringe.places.extend(pixels.iter().map(place));
            fringe.signs.extend_from_slice(signs);
        }
        Ok(fringe)
    }

    /// As [`ShadowSeparator::separate`] by `"evidence"`, with probabilities in [0, 1] that the pieces, in the order of
    /// [`ShadowSeparator::pieces`], are part, and that the pixels of [`ShadowSeparator::fringe`] show one: to measure another
    /// judgement. A pixel whose piece is part shows it from 0.38 on, others from 0.5. Without the latter outlines are settled as
    /// always.
    ///
    /// # Errors
    /// As [`ShadowSeparator::separate`], [`ShadowError::Probabilities`] and [`ShadowError::FringeProbabilities`].
    pub fn separate_judged(
        &mut self,
        frame: &RgbView<'_>,
        partition: &Partition,
        saliency: &SaliencyMap,
        regions: &[SalientRegion],
        parts: &[f32],
        fringe: Option<&[f32]>,
    ) -> Result<Vec<ObjectRegion>, ShadowError> {
        self.with_crops(frame, partition, saliency, regions, |evidence, input, crops| {
            write_judged(evidence, input, crops, parts)?;
            let Some(probabilities) = fringe else {
                evidence.settle_fringes(crops);
                return Ok(());
            };
            evidence.describe_fringes(crops);
            let pixels = evidence.described_fringes(crops.len()).map(|(pixels, _)| pixels.len()).sum();
            if probabilities.len() != pixels || !are_probabilities(probabilities) {
                return Err(ShadowError::FringeProbabilities { given: probabilities.len(), pixels });
            }
            evidence.write_fringes(crops, probabilities);
            Ok(())
        })?;
        let mut objects = Vec::new();
        self.find_objects(partition, regions, &mut objects);
        Ok(objects)
    }

    /// The objects of what a method has written.
    fn find_objects(&mut self, partition: &Partition, regions: &[SalientRegion], objects: &mut Vec<ObjectRegion>) {
        let min_area_px = self.params.min_object_area_for(partition.width(), partition.height());
        find_objects(&mut self.crops[..regions.len()], min_area_px, objects);
    }

    /// Checks the input, and lets a method write on the crops of the regions.
    fn with_crops(
        &mut self,
        frame: &RgbView<'_>,
        partition: &Partition,
        saliency: &SaliencyMap,
        regions: &[SalientRegion],
        method: impl FnOnce(&mut Evidence, &Input<'_>, &mut [Crop]) -> Result<(), ShadowError>,
    ) -> Result<(), ShadowError> {
        let (width, height) = (partition.width(), partition.height());
        let (frame_width, frame_height) = frame.dimensions();
        if (frame_width, frame_height) != (width, height) {
            return Err(ShadowError::FrameSize { frame_width, frame_height, width, height });
        }
        let (map_width, map_height) = (saliency.width(), saliency.height());
        if (map_width, map_height) != (width, height) {
            return Err(ShadowError::MapSize { map_width, map_height, width, height });
        }
        self.owners.fill(partition, regions)?;
        // Crops beyond those of this frame keep their memory for the next.
        if self.crops.len() < regions.len() {
            self.crops.resize_with(regions.len(), Crop::default);
        }
        let crops = &mut self.crops[..regions.len()];
        let input = Input { frame, partition, saliency, regions, owners: &self.owners };
        paint_crops(crops, &input);
        method(&mut self.evidence, &input, crops)
    }
}

/// Describes the pieces, and writes what they are by these probabilities.
fn write_judged(
    evidence: &mut Evidence,
    input: &Input<'_>,
    crops: &mut [Crop],
    parts: &[f32],
) -> Result<(), ShadowError> {
    evidence.describe(input, crops);
    let pieces = evidence.described(crops.len()).map(|(_, signs)| signs.len()).sum();
    if parts.len() != pieces || !are_probabilities(parts) {
        return Err(ShadowError::Probabilities { given: parts.len(), pieces });
    }
    evidence.write_judged(crops, parts);
    Ok(())
}

fn are_probabilities(values: &[f32]) -> bool {
    values.iter().all(|value| (0.0..=1.0).contains(value))
}

#[cfg(test)]
pub(crate) mod tests {
    use samsod_segment::BoundingBox;

    use super::*;

    /// What the stages see, painted by a test.
    pub(crate) struct Scene {
        width: u32,
        height: u32,
        rgb: Vec<u8>,
        partition: Partition,
        saliency: SaliencyMap,
        regions: Vec<SalientRegion>,
        owners: Owners,
    }

    impl Scene {
        /// Labels are those of partitions, dense from 0; `regions` lists the labels of each.
        pub(crate) fn new(
            [width, height]: [u32; 2],
            color: impl Fn(u32, u32) -> [u8; 3],
            label: impl Fn(u32, u32) -> u32,
            regions: &[&[u32]],
        ) -> Self {
            let at = |i: u32| (i % width, i / width);
            let rgb: Vec<u8> = (0..width * height).map(at).flat_map(|(x, y)| color(x, y)).collect();
            let labels: Vec<u32> = (0..width * height).map(at).map(|(x, y)| label(x, y)).collect();
            let frame = RgbView::from_raw(width, height, &rgb[..]).unwrap();
            let partition = Partition::from_labels(&frame, labels).unwrap();
            let saliency = SaliencyMap::from_values(width, height, vec![0.0; (width * height) as usize]).unwrap();
            let region_of = |labels: &&[u32]| {
                let (partitions, bbox) = (labels.to_vec(), BoundingBox { x: 0, y: 0, width: 1, height: 1 });
                SalientRegion { partitions, area: 0, bbox, centroid: [0.0; 2], axis_rad: 0.0, mean_saliency: 0.0 }
            };
            let regions: Vec<SalientRegion> = regions.iter().map(region_of).collect();
            let mut owners = Owners::default();
            owners.fill(&partition, &regions).unwrap();
            Self { width, height, rgb, partition, saliency, regions, owners }
        }

        /// Calls `f` with what is seen, and the crops of the regions, which have claimed what they may.
        pub(crate) fn show<T>(&self, f: impl FnOnce(&Input<'_>, &mut [Crop]) -> T) -> T {
            let frame = RgbView::from_raw(self.width, self.height, &self.rgb[..]).unwrap();
            let (partition, saliency) = (&self.partition, &self.saliency);
            let input = Input { frame: &frame, partition, saliency, regions: &self.regions, owners: &self.owners };
            let mut crops: Vec<Crop> = self.regions.iter().map(|_| Crop::default()).collect();
            paint_crops(&mut crops, &input);
            crops.iter_mut().for_each(Crop::grow);
            f(&input, &mut crops)
        }
    }
}
