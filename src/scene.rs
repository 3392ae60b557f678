//! What one frame showed.

use std::time::Duration;

use samsod_recognize::Detection;
use samsod_saliency::{SaliencyMap, SalientRegion};
use samsod_segment::Partition;
use samsod_shadow::ObjectRegion;

/// Everything that [`Cell::inspect`](crate::Cell::inspect) found in one frame.
#[derive(Debug, Clone, Default)]
pub struct Scene {
    /// The proto-object partitions of the frame.
    pub partition: Partition,
    /// Saliency S in [0, 1], one value a pixel.
    pub saliency: SaliencyMap,
    /// The connected salient regions, largest first.
    pub regions: Vec<SalientRegion>,
    /// The objects without their shadows: by region, in the order of `regions`, and largest first within a region. A part
    /// that was recognised has the pixels that its pose gives it ([`samsod_recognize::settle`]); without a catalogue they
    /// are what the separation of shadows says.
    pub objects: Vec<ObjectRegion>,
    /// What the objects are; empty in a cell without a catalogue.
    pub detections: Vec<Detection>,
    /// Wall-clock time of every stage.
    pub times: StageTimes,
}

/// Wall-clock time of each stage of one frame.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct StageTimes {
    /// Mean shift and partitioning.
    pub segment: Duration,
    /// Structure-aware centre-surround saliency.
    pub saliency: Duration,
    /// Threshold and salient regions.
    pub regions: Duration,
    /// Separation of objects from shadows.
    pub shadow: Duration,
    /// Recognition, and the objects after it; hardly anything in a cell without a catalogue.
    pub recognize: Duration,
}

impl StageTimes {
    /// The stages in their order, with the names used in recordings and tables.
    pub fn stages(&self) -> [(&'static str, Duration); 5] {
        [
            ("segment", self.segment),
            ("saliency", self.saliency),
            ("regions", self.regions),
            ("shadow", self.shadow),
            ("recognize", self.recognize),
        ]
    }

    /// The sum over the stages.
    pub fn total(&self) -> Duration {
        self.stages().iter().map(|(_, d)| *d).sum()
    }
}
