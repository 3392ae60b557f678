//! Whose pixel is which, within the box of every region; the sheet on which a method writes what it found.

use std::ops::Range;

use rayon::prelude::*;
use samsod_saliency::SalientRegion;
use samsod_segment::{BoundingBox, Partition};

use crate::separator::{Input, ShadowError};

/// How far beyond its region an object may reach, px in both directions of the image.
pub(crate) const CLAIM_PX: u32 = 4;

/// How far beyond the box of its region a crop reaches: pixels of another region that bound a claim lie within.
const SEEN_PX: u32 = 2 * CLAIM_PX;

/// Codes of pixels. Nothing is known of them, or they are not the region's.
pub(crate) const OUTSIDE: u8 = 0;
/// Object.
pub(crate) const OBJECT: u8 = 1;
/// Shadow.
pub(crate) const SHADOW: u8 = 2;
/// Table that is seen in the region.
pub(crate) const TABLE: u8 = 3;

/// Owners of pixels. A pixel of no region.
const FREE: u8 = 0;
/// A pixel of the crop's region.
pub(crate) const OWN: u8 = 1;
/// A pixel of another region.
const OTHER: u8 = 2;
/// A pixel of no region that this one may claim.
const NEAR: u8 = 4;

/// Whether an owner is the crop's region, or it may claim the pixel.
pub(crate) fn has_right(owner: u8) -> bool {
    owner & (OWN | NEAR) != 0
}

/// The region that a partition belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Owner {
    /// Index of the region.
    pub(crate) region: u32,
    /// Index of the label in the region's `partitions`.
    pub(crate) node: u32,
}

/// The owner of every partition.
#[derive(Debug, Default)]
pub(crate) struct Owners {
    of_label: Vec<Option<Owner>>,
}

impl Owners {
    /// # Errors
    /// [`ShadowError::Label`] and [`ShadowError::Shared`].
    pub(crate) fn fill(&mut self, partition: &Partition, regions: &[SalientRegion]) -> Result<(), ShadowError> {
        self.of_label.clear();
        self.of_label.resize(partition.len(), None);
        for (region, r) in regions.iter().enumerate() {
            for (node, &label) in r.partitions.iter().enumerate() {
                let count = partition.len();
                let slot = self.of_label.get_mut(label as usize).ok_or(ShadowError::Label { region, label, count })?;
                let owner = Owner { region: region as u32, node: node as u32 };
                if let Some(first) = slot.replace(owner) {
                    return Err(ShadowError::Shared { label, first: first.region as usize, second: region });
                }
            }
        }
        Ok(())
    }

    /// The owner of a partition; `None` outside of all regions.
    pub(crate) fn of(&self, label: u32) -> Option<Owner> {
        self.of_label.get(label as usize).copied().flatten()
    }
}

/// The surroundings of one region: its box, a margin round it, and two sheets of that size, row by row.
#[derive(Debug, Default)]
pub(crate) struct Crop {
    /// Where the crop lies in the image; `None` for a region without partitions, whose sheets are empty.
    pub(crate) bbox: Option<BoundingBox>,
    /// [`FREE`], [`OWN`], [`OTHER`] or [`NEAR`]; where a shadow fades out, that of the shadow.
    owners: Vec<u8>,
    /// [`OUTSIDE`], [`OBJECT`], [`SHADOW`] or [`TABLE`], all [`OUTSIDE`] before the method. Only pixels that are the
    /// region's, or that it may claim ([`Crop::grow`]), count.
    pub(crate) codes: Vec<u8>,
    /// Scratch of [`Crop::grow`].
    reach: [Vec<u8>; 2],
}

/// Makes the crop of every region, and wipes its codes.
pub(crate) fn paint_crops(crops: &mut [Crop], input: &Input<'_>) {
    crops.par_iter_mut().zip(input.regions).enumerate().for_each(|(number, (crop, region))| {
        crop.paint(input, number as u32, region);
    });
}

impl Crop {
    /// A crop of which nothing is known.
    pub(crate) fn blank(bbox: BoundingBox) -> Self {
        let codes = vec![OUTSIDE; bbox.width as usize * bbox.height as usize];
        Self { bbox: Some(bbox), codes, ..Self::default() }
    }

    /// Columns of the crop; 0 for a region without partitions.
    pub(crate) fn width(&self) -> usize {
        self.bbox.map_or(0, |b| b.width as usize)
    }

    /// Rows of the crop; 0 for a region without partitions.
    pub(crate) fn height(&self) -> usize {
        self.bbox.map_or(0, |b| b.height as usize)
    }

    fn paint(&mut self, input: &Input<'_>, number: u32, region: &SalientRegion) {
        // The partitions are asked, not the region: whoever made it may have put any box into it.
        let boxes = region.partitions.iter().flat_map(|&label| {
            let own = input.partition.objects().get(label as usize).map(|object| object.bbox);
            own.into_iter().chain(input.partition.penumbra_box(label))
        });
        self.bbox = boxes.reduce(|a, b| a.union(&b)).map(|b| {
            let (x, y) = (b.x.saturating_sub(SEEN_PX), b.y.saturating_sub(SEEN_PX));
            let right = b.right().saturating_add(SEEN_PX).min(input.partition.width() - 1);
            let bottom = b.bottom().saturating_add(SEEN_PX).min(input.partition.height() - 1);
            BoundingBox { x, y, width: right - x + 1, height: bottom - y + 1 }
        });
        let pixels = self.width() * self.height();
        self.codes.clear();
        self.codes.resize(pixels, OUTSIDE);
        let mut owners = std::mem::take(&mut self.owners);
        owners.resize(pixels, FREE);
        // Every pixel belongs to a run.
        self.for_each_run(input.partition, |sheet, label| {
            owners[sheet].fill(match input.owners.of(label) {
                Some(owner) if owner.region == number => OWN,
                Some(_) => OTHER,
                None => FREE,
            });
        });
        // The table where a shadow of the region fades out is looked at, too: that it does tells a shadow from a part.
        if let Some(bbox) = self.bbox {
            for (y, row) in (bbox.y..).zip(owners.chunks_exact_mut(bbox.width as usize)) {
                for run in input.partition.penumbrae(y) {
                    let Some(owner) = input.owners.of(run.label) else { continue };
                    let (from, to) = (run.start.max(bbox.x), run.end.min(bbox.x + bbox.width));
                    let code = if owner.region == number { OWN } else { OTHER };
                    let columns = from.saturating_sub(bbox.x) as usize..to.saturating_sub(bbox.x) as usize;
                    let free = row.get_mut(columns).unwrap_or_default().iter_mut().filter(|o| **o == FREE);
                    free.for_each(|o| *o = code);
                }
            }
        }
        self.owners = owners;
    }

    /// Calls `f(pixels of the sheets, label)` for every run of the crop, from top to bottom and left to right.
    pub(crate) fn for_each_run(&self, partition: &Partition, mut f: impl FnMut(Range<usize>, u32)) {
        let Some(bbox) = self.bbox else { return };
        let (left, right) = (bbox.x, bbox.x + bbox.width);
        for (i, y) in (bbox.y..=bbox.bottom()).enumerate() {
            let row = i * bbox.width as usize;
            let runs = partition.runs().row(y as usize);
            let first = runs.partition_point(|run| run.end <= left);
            for run in runs[first..].iter().take_while(|run| run.start < right) {
                let columns = (run.start.max(left) - left) as usize..(run.end.min(right) - left) as usize;
                f(row + columns.start..row + columns.end, run.label);
            }
        }
    }

    /// Lets the method claim pixels of no region up to [`CLAIM_PX`] from its own (chessboard distance). One that is as
    /// near to another region can be claimed by neither, so objects never overlap.
    pub(crate) fn grow(&mut self) {
        let (width, height) = (self.width(), self.height());
        if width == 0 {
            return;
        }
        let [reach, across] = &mut self.reach;
        reach.clone_from(&self.owners);
        across.clone_from(&self.owners);
        for _ in 0..CLAIM_PX {
            for (to, from) in across.chunks_exact_mut(width).zip(reach.chunks_exact(width)) {
                spread(to, from, 1);
            }
            spread(reach, across, width);
            for (owner, &reached) in self.owners.iter_mut().zip(reach.iter()) {
                // Claims of an earlier, nearer step stay.
                *owner |= if *owner == FREE && reached == OWN { NEAR } else { 0 };
            }
        }
        debug_assert_eq!(self.owners.len(), width * height);
    }

    /// Forgets codes of pixels that the region has no right to.
    pub(crate) fn keep_rights(&mut self) {
        for (code, &owner) in self.codes.iter_mut().zip(&self.owners) {
            *code = if has_right(owner) { *code } else { OUTSIDE };
        }
    }

    /// [`OWN`] for a pixel of the region, other values for others, row by row.
    pub(crate) fn owners(&self) -> &[u8] {
        &self.owners
    }
}

/// `to[i] = from[i - step] | from[i] | from[i + step]`.
fn spread(to: &mut [u8], from: &[u8], step: usize) {
    to.copy_from_slice(from);
    if step < from.len() {
        for (t, &f) in to.iter_mut().zip(&from[step..]) {
            *t |= f;
        }
        for (t, &f) in to[step..].iter_mut().zip(from) {
            *t |= f;
        }
    }
}

#[cfg(test)]
impl Crop {
    /// A crop at (x, y) of the image, all its own: `#` is object, `s` shadow, `t` table, anything else outside.
    pub(crate) fn drawn(x: u32, y: u32, rows: &[&str]) -> Self {
        let code = |c| match c {
            b'#' => OBJECT,
            b's' => SHADOW,
            b't' => TABLE,
            _ => OUTSIDE,
        };
        let codes: Vec<u8> = rows.iter().flat_map(|row| row.bytes().map(code)).collect();
        let bbox = BoundingBox { x, y, width: rows[0].len() as u32, height: rows.len() as u32 };
        Self { bbox: Some(bbox), owners: vec![OWN; codes.len()], codes, reach: Default::default() }
    }
}

#[cfg(test)]
mod tests {
    use samsod_saliency::SaliencyMap;
    use samsod_segment::RgbView;

    use super::*;

    /// The crops of regions made of labels 1, 2, .. of a label image; 0 belongs to none.
    fn crops(width: u32, height: u32, label: impl Fn(u32, u32) -> u32) -> Vec<Crop> {
        let bytes = vec![0u8; (width * height * 3) as usize];
        let frame = RgbView::from_raw(width, height, &bytes[..]).unwrap();
        let labels: Vec<u32> =
            (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).map(|(x, y)| label(x, y)).collect();
        let partition = Partition::from_labels(&frame, labels).unwrap();
        let saliency = SaliencyMap::from_values(width, height, vec![0.0; (width * height) as usize]).unwrap();
        let regions: Vec<SalientRegion> = (1..partition.len() as u32).map(region_of).collect();
        let mut owners = Owners::default();
        owners.fill(&partition, &regions).unwrap();
        let mut crops: Vec<Crop> = regions.iter().map(|_| Crop::default()).collect();
        let input =
            Input { frame: &frame, partition: &partition, saliency: &saliency, regions: &regions, owners: &owners };
        paint_crops(&mut crops, &input);
        crops
    }

    fn region_of(label: u32) -> SalientRegion {
        let bbox = BoundingBox { x: 0, y: 0, width: 1, height: 1 };
        SalientRegion { partitions: vec![label], area: 0, bbox, centroid: [0.0; 2], axis_rad: 0.0, mean_saliency: 0.0 }
    }

    /// Pixels of the image with this owner.
    fn pixels(crop: &Crop, owner: u8) -> Vec<(u32, u32)> {
        let b = crop.bbox.unwrap();
        let all = (0..b.height).flat_map(|y| (0..b.width).map(move |x| (x, y)));
        all.zip(crop.owners()).filter(|(_, o)| **o == owner).map(|((x, y), _)| (b.x + x, b.y + y)).collect()
    }

    #[test]
    fn a_crop_reaches_beyond_its_region_but_not_beyond_the_image() {
        let crops = crops(60, 50, |x, y| u32::from((20..30).contains(&x) && (3..9).contains(&y)));
        assert_eq!(crops[0].bbox, Some(BoundingBox { x: 12, y: 0, width: 26, height: 17 }));
        let own: Vec<_> = (3..9).flat_map(|y| (20..30).map(move |x| (x, y))).collect();
        assert_eq!(pixels(&crops[0], OWN), own);
        assert!(crops[0].codes.iter().all(|&code| code == OUTSIDE));
    }

    #[test]
    fn where_the_shadow_of_a_region_fades_out_is_its_own() {
        // A dark plate, and beside it a shadow that fades out between columns 120 and 200.
        let (width, height) = (320, 240);
        let light = |x: u32, y: u32| match x {
            60..120 if (80..160).contains(&y) => 0.05,
            120..200 if (90..150).contains(&y) => 0.3 + 0.7 * (x - 120) as f32 / 80.0,
            _ => 1.0,
        };
        let level = |light: f32| (255.0 * (0.4 * light).powf(1.0 / 2.2)) as u8;
        let bytes: Vec<u8> = (0..height).flat_map(|y| (0..width).flat_map(move |x| [level(light(x, y)); 3])).collect();
        let frame = RgbView::from_raw(width, height, &bytes[..]).unwrap();
        let partition = samsod_segment::Segmenter::new(Default::default()).unwrap().segment(&frame).unwrap();
        let at = |x: u32, y: u32| partition.labels()[(y * width + x) as usize];
        let table = at(0, 0);
        assert_eq!(at(185, 120), table, "light of 0.87 is table");
        let faded = partition.fades_from(185, 120).unwrap();
        let saliency = SaliencyMap::from_values(width, height, vec![0.0; (width * height) as usize]).unwrap();
        let partitions: Vec<u32> = (0..partition.len() as u32).filter(|&label| label != table).collect();
        assert!(partitions.contains(&faded));
        let regions = [SalientRegion { partitions, ..region_of(0) }];
        let mut owners = Owners::default();
        owners.fill(&partition, &regions).unwrap();
        let mut crops = [Crop::default()];
        let input =
            Input { frame: &frame, partition: &partition, saliency: &saliency, regions: &regions, owners: &owners };
        paint_crops(&mut crops, &input);
        let own = pixels(&crops[0], OWN);
        assert!(own.contains(&(185, 120)) && own.contains(&(90, 120)));
        assert!(!own.contains(&(185, 60)) && !own.contains(&(205, 120)));
    }

    #[test]
    fn claims_reach_four_pixels() {
        let mut crops = crops(40, 40, |x, y| u32::from((x, y) == (20, 20)));
        crops[0].grow();
        let near: Vec<_> = (16..25).flat_map(|y| (16..25).map(move |x| (x, y))).filter(|&at| at != (20, 20)).collect();
        assert_eq!(pixels(&crops[0], NEAR), near);
    }

    #[test]
    fn claims_of_two_regions_never_meet() {
        // Five pixels lie between them: two go to each, and the middle one to neither.
        let mut crops = crops(50, 20, |x, _| match x {
            10..20 => 1,
            25..30 => 2,
            _ => 0,
        });
        for crop in &mut crops {
            crop.grow();
        }
        let columns = |crop: &Crop| -> Vec<u32> {
            pixels(crop, NEAR).into_iter().filter(|&(_, y)| y == 7).map(|(x, _)| x).collect()
        };
        assert_eq!(columns(&crops[0]), [6, 7, 8, 9, 20, 21]);
        assert_eq!(columns(&crops[1]), [23, 24, 30, 31, 32, 33]);
        assert_eq!(pixels(&crops[0], OWN).len(), 200);
        assert!(!pixels(&crops[0], OTHER).is_empty());
    }

    #[test]
    fn codes_without_a_right_are_forgotten() {
        let mut crops = crops(30, 10, |x, _| match x {
            5..10 => 1,
            12..20 => 2,
            _ => 0,
        });
        crops[0].grow();
        crops[0].codes.fill(OBJECT);
        crops[0].keep_rights();
        let b = crops[0].bbox.unwrap();
        let kept: Vec<u32> =
            (b.x..).zip(&crops[0].codes[..b.width as usize]).filter(|(_, c)| **c != 0).map(|(x, _)| x).collect();
        // Four to the left, and of the two between the regions the nearer one.
        assert_eq!(kept, (1..11).collect::<Vec<_>>());
    }
}
