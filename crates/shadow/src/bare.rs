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

#[cfg(test)]
mod tests {
    use samsod_segment::{BoundingBox, RgbView};

    use super::*;
    use crate::OrientedBox;

    fn region(partitions: Vec<u32>, [x, y, width, height]: [u32; 4]) -> SalientRegion {
        let bbox = BoundingBox { x, y, width, height };
        SalientRegion { partitions, area: 0, bbox, centroid: [0.0; 2], axis_rad: 0.0, mean_saliency: 0.0 }
    }

    #[test]
    fn regions_without_an_object_have_the_pixels_of_their_partitions() {
        let bytes = [0u8; 4 * 3 * 3];
        let frame = RgbView::from_raw(4, 3, &bytes[..]).unwrap();
        let labels = vec![0, 1, 1, 2, 0, 1, 3, 3, 0, 0, 3, 0];
        let partition = Partition::from_labels(&frame, labels).unwrap();
        let label = |x: usize, y: usize| partition.labels()[4 * y + x];
        let mut both = vec![label(1, 0), label(2, 1)];
        both.sort_unstable();
        let regions = [region(both, [1, 0, 3, 3]), region(vec![label(3, 0)], [3, 0, 1, 1])];
        let bare = bare_regions(&partition, &regions, &[]);
        assert_eq!(bare.iter().map(|b| (b.region, b.mask.area())).collect::<Vec<_>>(), [(0, 6), (1, 1)]);
        assert_eq!(bare[0].mask.bbox(), BoundingBox { x: 1, y: 0, width: 3, height: 3 });
        assert!(bare[0].mask.contains(2, 2) && !bare[0].mask.contains(3, 0) && !bare[0].mask.contains(1, 2));
        let object = ObjectRegion {
            region: 0,
            mask: bare[0].mask.clone(),
            shadow: None,
            outline: Vec::new(),
            holes: Vec::new(),
            area: 6,
            centroid: [2.0, 1.0],
            axis_rad: 0.0,
            oriented_box: OrientedBox { center_px: [2.0, 1.0], length_px: 3.0, width_px: 3.0, angle_rad: 0.0 },
        };
        assert_eq!(bare_regions(&partition, &regions, &[object]), bare[1..]);
        // A region of another frame has no pixel here.
        assert!(bare_regions(&partition, &[region(vec![900], [50, 50, 9, 9])], &[]).is_empty());
    }
}
