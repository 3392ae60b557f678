//! What is left of the objects of a region where the parts in it are known: a part whose pixels the separation joined with
//! those of another is nobody's object.
//!
//! In: the pixels of a region and the silhouettes of its known parts. Out: the region without these parts, whose objects
//! are the connected pixels that they leave, but for seams along them.

use samsod_segment::BoundingBox;

use crate::region_pixels::{MOST_CODE, OBJECT, OUTSIDE, RegionPixels, SHADOW, spread};
use crate::silhouette::Silhouette;

/// What is left beside a known part is an object where a square of twice this and one pixel fits in, px.
const SEAM_PX: usize = 3;

/// What is so much of an object was left of it by no part.
const WHOLE: f32 = 0.8;

/// The region that known parts leave.
#[derive(Debug)]
pub(crate) struct Leftover {
    /// Its objects are what is left; their pixels lie apart.
    pub(crate) region: RegionPixels,
    /// The code of the object that each is left of, the most of it.
    pub(crate) codes: Vec<u8>,
}

impl Leftover {
    /// What some parts leave of a region; `None` where nothing of so many pixels is left.
    pub(crate) fn of(region: &RegionPixels, known: &[&Silhouette], least_px: u32) -> Option<Self> {
        let crop = region.crop;
        let (width, height) = (crop.width as usize, crop.height as usize);
        let mut codes = region.codes.clone();
        for silhouette in known {
            forget(&mut codes, &crop, silhouette);
        }
        let is_left = |i: usize| codes[i] >= OBJECT;
        let mut areas = [0u32; 256];
        region.codes.iter().for_each(|&code| areas[usize::from(code)] += 1);
        if (0..codes.len()).filter(|&i| is_left(i)).count() < least_px as usize {
            return None;
        }
        // Without what is narrower than a seam.
        let far = spread(|i| !is_left(i), width, height, SEAM_PX);
        let open = spread(|i| far[i] == 0, width, height, SEAM_PX);
        let mut left = Self { region: region.clone(), codes: Vec::new() };
        (left.region.objects, left.region.boxes) = (Vec::new(), Vec::new());
        left.region.codes = codes.iter().map(|&code| code.min(SHADOW)).collect();
        let mut is_free: Vec<bool> = open.iter().map(|&open| open != 0).collect();
        let mut pixels: Vec<usize> = Vec::new();
        for start in 0..is_free.len() {
            if !is_free[start] || left.codes.len() > usize::from(MOST_CODE - OBJECT) {
                continue;
            }
            pixels.clear();
            connected(start, width, &mut is_free, &mut pixels);
            if pixels.len() >= least_px as usize {
                left.push(region, &codes, &areas, &pixels);
            }
        }
        (!left.codes.is_empty()).then_some(left)
    }

    /// Adds an object.
    fn push(&mut self, whole: &RegionPixels, codes: &[u8], areas: &[u32; 256], pixels: &[usize]) {
        let width = whole.crop.width as usize;
        let mut counts = [0u32; 256];
        pixels.iter().for_each(|&i| counts[usize::from(codes[i])] += 1);
        let most = (OBJECT..=MOST_CODE).max_by_key(|&code| counts[usize::from(code)]).unwrap_or(OBJECT);
        let Some(&object) = whole.objects.get(usize::from(most - OBJECT)) else { return };
        if pixels.len() as f32 >= WHOLE * areas[usize::from(most)] as f32 {
            return;
        }
        let (mut low, mut high) = ([u32::MAX; 2], [0u32; 2]);
        let own = RegionPixels::code_of(self.codes.len());
        for &i in pixels {
            let at = [whole.crop.x + (i % width) as u32, whole.crop.y + (i / width) as u32];
            for axis in 0..2 {
                low[axis] = low[axis].min(at[axis]);
                high[axis] = high[axis].max(at[axis]);
            }
            self.region.codes[i] = own;
        }
        let [width, height] = [0, 1].map(|axis| high[axis] - low[axis] + 1);
        self.region.boxes.push((BoundingBox { x: low[0], y: low[1], width, height }, None));
        self.region.objects.push(object);
        self.codes.push(most);
    }
}

/// Takes the pixels of a part out of a region.
fn forget(codes: &mut [u8], crop: &BoundingBox, silhouette: &Silhouette) {
    let step = silhouette.step;
    for (y, row) in silhouette.rows() {
        for (x, _) in (silhouette.bbox.x..).zip(row).filter(|(_, bit)| **bit != 0) {
            // Of a reduced silhouette a bit stands for the pixels around.
            for v in (y * step).saturating_sub(step / 2)..y * step + step.div_ceil(2) {
                for u in (x * step).saturating_sub(step / 2)..x * step + step.div_ceil(2) {
                    let (dx, dy) = (u.wrapping_sub(crop.x), v.wrapping_sub(crop.y));
                    if dx < crop.width && dy < crop.height {
                        codes[(dy * crop.width + dx) as usize] = OUTSIDE;
                    }
                }
            }
        }
    }
}

/// Takes the free pixels that are 4-connected with one of them.
fn connected(start: usize, width: usize, is_free: &mut [bool], pixels: &mut Vec<usize>) {
    is_free[start] = false;
    pixels.push(start);
    let mut next = 0;
    while let Some(&i) = pixels.get(next) {
        next += 1;
        let beside = [(i % width > 0).then(|| i - 1), ((i + 1) % width > 0).then_some(i + 1)];
        for j in beside.into_iter().flatten().chain(i.checked_sub(width)).chain([i + width]) {
            if let Some(free) = is_free.get_mut(j).filter(|free| **free) {
                *free = false;
                pixels.push(j);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_parts::{object, rectangle};

    fn silhouette([x, y, width, height]: [u32; 4], step: u32) -> Silhouette {
        Silhouette { bbox: BoundingBox { x, y, width, height }, step, bits: vec![1; (width * height) as usize] }
    }

    #[test]
    fn a_part_that_was_joined_with_a_known_one_is_an_object_again() {
        let objects = [
            object(2, rectangle([60, 60, 20, 20]), None),
            object(2, rectangle([85, 20, 24, 12]), None),
            object(2, rectangle([20, 20, 60, 30]), Some(rectangle([20, 40, 70, 45]))),
        ];
        let region = &RegionPixels::of(&objects, 8, [120, 100])[0];
        // The left half of the second object is known, and a seam stays along the top of it.
        let known = silhouette([10, 11, 18, 14], 2);
        let on_the_third = silhouette([85, 20, 12, 12], 1);
        let left = Leftover::of(region, &[&known, &on_the_third], 100).unwrap();
        // The first one, on which nothing lies, is searched as it is.
        assert_eq!(left.codes, [OBJECT + 2, OBJECT + 1]);
        assert_eq!(left.region.objects, [2, 1]);
        assert_eq!(left.region.boxes[1], (BoundingBox { x: 97, y: 20, width: 12, height: 12 }, None));
        let own = left.region.boxes[0].0;
        assert!((54..=56).contains(&own.x) && own.right() == 79 && (own.y, own.bottom()) == (20, 49), "{own:?}");
        assert_eq!(left.region.code(70, 30), OBJECT);
        assert_eq!(left.region.code(100, 25), OBJECT + 1);
        assert_eq!(left.region.code(70, 70), SHADOW);
        assert_eq!(left.region.code(30, 30), OUTSIDE);
        assert_eq!(left.region.code(85, 60), SHADOW);
        assert_eq!(left.region.crop, region.crop);
    }

    #[test]
    fn seams_and_small_pieces_are_nothing() {
        let objects = [object(0, rectangle([20, 20, 60, 30]), None)];
        let region = &RegionPixels::of(&objects, 8, [120, 100])[0];
        assert!(Leftover::of(region, &[&silhouette([20, 24, 60, 26], 1)], 50).is_none());
        assert!(Leftover::of(region, &[&silhouette([20, 20, 50, 30], 1)], 500).is_none());
        assert!(Leftover::of(region, &[&silhouette([20, 20, 50, 30], 1)], 300).is_some());
        // Nothing known, a part that lies elsewhere, and one beyond the frame.
        assert!(Leftover::of(region, &[], 50).is_none());
        let elsewhere = [&silhouette([100, 80, 19, 19], 1), &silhouette([110, 90, 40, 40], 2)];
        assert!(Leftover::of(region, &elsewhere, 50).is_none());
    }
}
