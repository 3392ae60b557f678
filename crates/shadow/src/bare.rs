//! Salient regions of which the separation made shadow alone: a shadow has a part that casts it, which may be among what
//! was taken for it.
//!
//! In: the regions, the partition, and the objects that were found. Out: the pixels of every region without an object.

use samsod_saliency::SalientRegion;
use samsod_segment::Partition;

use crate::{Mask, MaskRun, ObjectRegion};

/// A salient region in which no object was found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BareRegion {
    /// Its index among the salient regions.
    pub region: usize,
    /// Its pixels.
    pub mask: Mask,
}

/// The regions without an object, in their order.
pub fn bare_regions(partition: &Partition, regions: &[SalientRegion], objects: &[ObjectRegion]) -> Vec<BareRegion> {
    let is_bare = |region: &usize| objects.iter().all(|object| object.region != *region);
    let mask_of = |region: usize| {
        let SalientRegion { partitions, bbox, .. } = regions.get(region)?;
        let rows = (bbox.y..=bbox.bottom()).zip(partition.runs().rows().iter().skip(bbox.y as usize));
        let runs = rows.flat_map(|(y, runs)| {
            let own = runs.iter().filter(|run| partitions.binary_search(&run.label).is_ok());
            own.map(move |run| MaskRun { y, start: run.start, end: run.end })
        });
        Some(BareRegion { region, mask: Mask::from_runs(&runs.collect::<Vec<MaskRun>>())? })
    };
    (0..regions.len()).filter(is_bare).filter_map(mask_of).collect()
}
