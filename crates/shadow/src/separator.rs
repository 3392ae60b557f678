//! The stage: parameters, scratch memory, checks of the input, and the order of the steps.

use samsod_saliency::{SaliencyMap, SalientRegion};
use samsod_segment::{Partition, RgbView};

use crate::crop::{Crop, Owners, paint_crops};
use crate::evidence::Evidence;
use crate::ncut::NcutError;
use crate::objects::find_objects;
use crate::params::{ObjectSide, ShadowParamError, ShadowParams};
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
        match self.params.object_side {
            ObjectSide::Paper => paper::label_regions(&input, crops)?,
            ObjectSide::Evidence => self.evidence.label_regions(&input, crops),
        }
        find_objects(crops, self.params.min_object_area_for(width, height), objects);
        Ok(())
    }
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
