//! What the separation of shadows left of a salient region: whose pixel is which.

use samsod_segment::BoundingBox;
use samsod_shadow::{BareRegion, Mask, ObjectRegion};

/// Not of the region.
pub(crate) const OUTSIDE: u8 = 0;
/// Shadow of the region.
pub(crate) const SHADOW: u8 = 1;
/// Object pixel of the region; of its k-th object `OBJECT + k`, and of all beyond [`MOST_CODE`] that.
pub(crate) const OBJECT: u8 = 2;
pub(crate) const MOST_CODE: u8 = 250;

/// The smallest box round two.
pub(crate) fn box_round(a: &BoundingBox, b: &BoundingBox) -> BoundingBox {
    let (x, y) = (a.x.min(b.x), a.y.min(b.y));
    let (right, bottom) = (a.right().max(b.right()), a.bottom().max(b.bottom()));
    BoundingBox { x, y, width: right - x + 1, height: bottom - y + 1 }
}

/// A box and so many pixels around it, within the frame.
fn with_margin(bbox: &BoundingBox, margin_px: u32, [width, height]: [u32; 2]) -> BoundingBox {
    let (x, y) = (bbox.x.saturating_sub(margin_px), bbox.y.saturating_sub(margin_px));
    BoundingBox {
        x,
        y,
        width: (bbox.right() + margin_px + 1).min(width) - x,
        height: (bbox.bottom() + margin_px + 1).min(height) - y,
    }
}

/// Gives the pixels of a mask, which lies in the crop, a code.
fn paint(codes: &mut [u8], crop: &BoundingBox, mask: &Mask, code: u8) {
    for run in mask.runs() {
        let row = (run.y - crop.y) as usize * crop.width as usize;
        codes[row + (run.start - crop.x) as usize..row + (run.end - crop.x) as usize].fill(code);
    }
}

/// The objects of one salient region and their pixels.
#[derive(Debug, Clone)]
pub(crate) struct RegionPixels {
    pub(crate) region: usize,
    /// Indices of its objects.
    pub(crate) objects: Vec<usize>,
    /// Box of each object, and of its shadow.
    pub(crate) boxes: Vec<(BoundingBox, Option<BoundingBox>)>,
    /// Smallest box round objects and shadows.
    pub(crate) bbox: BoundingBox,
    /// The box with a margin, within the frame.
    pub(crate) crop: BoundingBox,
    /// [`OUTSIDE`], [`SHADOW`] or [`OBJECT`] and above for every pixel of the crop.
    pub(crate) codes: Vec<u8>,
}

impl RegionPixels {
    /// Every region that has an object, in the order of their first objects.
    pub(crate) fn of(objects: &[ObjectRegion], margin_px: u32, frame_size: [u32; 2]) -> Vec<Self> {
        let mut groups: Vec<(usize, Vec<usize>)> = Vec::new();
        for (index, object) in objects.iter().enumerate() {
            match groups.iter_mut().find(|(region, _)| *region == object.region) {
                Some((_, members)) => members.push(index),
                None => groups.push((object.region, vec![index])),
            }
        }
        groups
            .into_iter()
            .filter_map(|(region, members)| Self::new(objects, region, members, margin_px, frame_size))
            .collect()
    }

    fn new(
        objects: &[ObjectRegion],
        region: usize,
        members: Vec<usize>,
        margin_px: u32,
        frame_size: [u32; 2],
    ) -> Option<Self> {
        let masks = || members.iter().flat_map(|&i| std::iter::once(&objects[i].mask).chain(&objects[i].shadow));
        let bbox = masks().map(Mask::bbox).reduce(|a, b| a.union(&b))?;
        let crop = with_margin(&bbox, margin_px, frame_size);
        let mut codes = vec![OUTSIDE; crop.width as usize * crop.height as usize];
        let mut paint = |mask: &Mask, code: u8| paint(&mut codes, &crop, mask, code);
        for &i in &members {
            if let Some(shadow) = &objects[i].shadow {
                paint(shadow, SHADOW);
            }
        }
        for (k, &i) in members.iter().enumerate() {
            paint(&objects[i].mask, Self::code_of(k));
        }
        let of = |i: usize| (objects[i].mask.bbox(), objects[i].shadow.as_ref().map(Mask::bbox));
        let boxes = members.iter().map(|&i| of(i)).collect();
        Some(Self { region, objects: members, boxes, bbox, crop, codes })
    }

    /// A region without an object, which lies in the frame: all of it is shadow.
    pub(crate) fn of_bare(bare: &BareRegion, margin_px: u32, frame_size: [u32; 2]) -> Self {
        let bbox = bare.mask.bbox();
        let crop = with_margin(&bbox, margin_px, frame_size);
        let mut codes = vec![OUTSIDE; crop.width as usize * crop.height as usize];
        paint(&mut codes, &crop, &bare.mask, SHADOW);
        Self { region: bare.region, objects: Vec::new(), boxes: Vec::new(), bbox, crop, codes }
    }

    /// A whole frame, in which nothing is known of objects.
    pub(crate) fn of_frame([width, height]: [u32; 2]) -> Self {
        let whole = BoundingBox { x: 0, y: 0, width, height };
        let codes = vec![OUTSIDE; width as usize * height as usize];
        Self { region: 0, objects: Vec::new(), boxes: Vec::new(), bbox: whole, crop: whole, codes }
    }

    /// The code of the k-th object of a region.
    pub(crate) fn code_of(k: usize) -> u8 {
        (usize::from(OBJECT) + k).min(usize::from(MOST_CODE)) as u8
    }

    /// 1 at the pixels of the crop that are in the region or at most so far from it (in rows and columns), else 0.
    pub(crate) fn near(&self, reach_px: usize) -> Vec<u8> {
        spread(|i| self.codes[i] != OUTSIDE, self.crop.width as usize, self.crop.height as usize, reach_px)
    }

    /// The code of a pixel of the frame.
    pub(crate) fn code(&self, x: u32, y: u32) -> u8 {
        let (dx, dy) = (x.wrapping_sub(self.crop.x), y.wrapping_sub(self.crop.y));
        if dx >= self.crop.width || dy >= self.crop.height {
            return OUTSIDE;
        }
        self.codes[(dy * self.crop.width + dx) as usize]
    }
}

/// 1 at the pixels of a rectangle that are set or at most so far from one that is (in rows and columns), else 0.
pub(crate) fn spread(is_set: impl Fn(usize) -> bool, width: usize, height: usize, reach_px: usize) -> Vec<u8> {
    let line = |is_set: &dyn Fn(usize) -> bool, length: usize, set: &mut dyn FnMut(usize)| {
        let mut until = 0;
        for i in 0..length {
            if is_set(i) {
                for j in until.max(i.saturating_sub(reach_px))..(i + reach_px + 1).min(length) {
                    set(j);
                }
                until = i + reach_px + 1;
            }
        }
    };
    let mut rows = vec![0u8; width * height];
    for y in 0..height {
        let row = &mut rows[y * width..(y + 1) * width];
        line(&|x| is_set(y * width + x), width, &mut |x| row[x] = 1);
    }
    let mut near = vec![0u8; width * height];
    for x in 0..width {
        line(&|y| rows[y * width + x] != 0, height, &mut |y| near[y * width + x] = 1);
    }
    near
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::test_parts::{object, rectangle};

    const FRAME: [u32; 2] = [100, 80];

    #[test]
    fn every_pixel_has_the_code_of_its_object() {
        let objects = [
            object(3, rectangle([20, 20, 10, 5]), Some(rectangle([18, 20, 40, 8]))),
            object(7, rectangle([60, 60, 4, 4]), None),
            object(3, rectangle([40, 22, 6, 6]), None),
        ];
        let regions = RegionPixels::of(&objects, 5, FRAME);
        assert_eq!(
            regions.iter().map(|r| (r.region, r.objects.clone())).collect::<Vec<_>>(),
            [(3, vec![0, 2]), (7, vec![1])]
        );
        let region = &regions[0];
        assert_eq!(region.bbox, BoundingBox { x: 18, y: 20, width: 40, height: 8 });
        assert_eq!(region.crop, BoundingBox { x: 13, y: 15, width: 50, height: 18 });
        assert_eq!(region.boxes[0].0, objects[0].mask.bbox());
        assert_eq!(region.boxes[0].1, objects[0].shadow.as_ref().map(Mask::bbox));
        assert_eq!(region.boxes[1].1, None);
        let count = |code| region.codes.iter().filter(|c| **c == code).count();
        // Objects lie over the shadow.
        assert_eq!((count(OBJECT), count(OBJECT + 1), count(SHADOW)), (50, 36, 40 * 8 - 50 - 36));
        for (at, code) in [([20, 20], OBJECT), ([29, 24], OBJECT), ([40, 22], OBJECT + 1), ([18, 27], SHADOW)] {
            assert_eq!(region.code(at[0], at[1]), code, "{at:?}");
        }
        for [x, y] in [[17, 20], [58, 20], [20, 19], [20, 28], [0, 0], [60, 60], [99, 79], [5000, 5000]] {
            assert_eq!(region.code(x, y), OUTSIDE, "{x} {y}");
        }
    }

    #[test]
    fn regions_at_the_border_of_the_frame_are_cut_there() {
        let objects = [object(0, rectangle([0, 0, 3, 2]), None), object(1, rectangle([97, 77, 3, 3]), None)];
        let regions = RegionPixels::of(&objects, 16, FRAME);
        assert_eq!(regions[0].crop, BoundingBox { x: 0, y: 0, width: 19, height: 18 });
        assert_eq!(regions[1].crop, BoundingBox { x: 81, y: 61, width: 19, height: 19 });
        assert_eq!((regions[0].code(2, 1), regions[0].code(3, 1)), (OBJECT, OUTSIDE));
        assert_eq!((regions[1].code(99, 79), regions[1].code(96, 79)), (OBJECT, OUTSIDE));
        let whole = RegionPixels::of(&[object(0, rectangle([0, 0, 100, 80]), None)], 16, FRAME);
        assert_eq!(whole[0].crop, BoundingBox { x: 0, y: 0, width: 100, height: 80 });
        assert!(whole[0].near(5).iter().all(|near| *near == 1));
    }

    #[test]
    fn more_objects_than_codes_share_the_last() {
        let objects: Vec<ObjectRegion> =
            (0..300u32).map(|i| object(0, rectangle([i % 100, i / 100 * 2, 1, 1]), None)).collect();
        let regions = RegionPixels::of(&objects, 0, FRAME);
        assert_eq!(regions[0].objects.len(), 300);
        assert_eq!(regions[0].codes.iter().filter(|c| **c == MOST_CODE).count(), 300 - usize::from(MOST_CODE - OBJECT));
        assert!(RegionPixels::of(&[], 16, FRAME).is_empty());
    }

    proptest! {
        #[test]
        fn near_is_what_a_square_around_the_region_reaches(
            boxes in prop::collection::vec((0u32..90, 0u32..70, 1u32..10, 1u32..10), 1..4),
            reach in 0usize..7,
        ) {
            let objects: Vec<ObjectRegion> =
                boxes.iter().map(|(x, y, w, h)| object(0, rectangle([*x, *y, *w, *h]), None)).collect();
            let region = &RegionPixels::of(&objects, 4, FRAME)[0];
            let near = region.near(reach);
            let far = reach as i64;
            for (i, near) in near.iter().enumerate() {
                let (x, y) = (i as i64 % i64::from(region.crop.width), i as i64 / i64::from(region.crop.width));
                let (x, y) = (x + i64::from(region.crop.x), y + i64::from(region.crop.y));
                let expected = boxes.iter().any(|(l, t, w, h)| {
                    let [l, t, w, h] = [*l, *t, *w, *h].map(i64::from);
                    (l - far..l + w + far).contains(&x) && (t - far..t + h + far).contains(&y)
                });
                prop_assert_eq!(*near == 1, expected, "{} {}", x, y);
            }
        }
    }
}
