//! What the separation of shadows left of a salient region: whose pixel is which.

use samsod_segment::BoundingBox;
use samsod_shadow::{Mask, ObjectRegion};

/// Not of the region.
pub(crate) const OUTSIDE: u8 = 0;
/// Shadow of the region.
pub(crate) const SHADOW: u8 = 1;
/// Object pixel of the region; of its k-th object `OBJECT + k`, and of all beyond [`MOST_CODE`] that.
pub(crate) const OBJECT: u8 = 2;
pub(crate) const MOST_CODE: u8 = 250;

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
        [width, height]: [u32; 2],
    ) -> Option<Self> {
        let masks = || members.iter().flat_map(|&i| std::iter::once(&objects[i].mask).chain(&objects[i].shadow));
        let left = masks().map(|m| m.bbox().x).min()?;
        let top = masks().map(|m| m.bbox().y).min()?;
        let right = masks().map(|m| m.bbox().right()).max()?;
        let bottom = masks().map(|m| m.bbox().bottom()).max()?;
        let bbox = BoundingBox { x: left, y: top, width: right - left + 1, height: bottom - top + 1 };
        let (x, y) = (left.saturating_sub(margin_px), top.saturating_sub(margin_px));
        let crop = BoundingBox {
            x,
            y,
            width: (right + margin_px + 1).min(width) - x,
            height: (bottom + margin_px + 1).min(height) - y,
        };
        let mut codes = vec![OUTSIDE; crop.width as usize * crop.height as usize];
        let mut paint = |mask: &Mask, code: u8| {
            for run in mask.runs() {
                let row = (run.y - y) as usize * crop.width as usize;
                codes[row + (run.start - x) as usize..row + (run.end - x) as usize].fill(code);
            }
        };
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
        let (width, height) = (self.crop.width as usize, self.crop.height as usize);
        let spread = |line: &mut dyn FnMut(usize) -> bool, length: usize, set: &mut dyn FnMut(usize)| {
            let mut until = 0;
            for i in 0..length {
                if line(i) {
                    for j in until.max(i.saturating_sub(reach_px))..(i + reach_px + 1).min(length) {
                        set(j);
                    }
                    until = i + reach_px + 1;
                }
            }
        };
        let mut rows = vec![0u8; width * height];
        for y in 0..height {
            let codes = &self.codes[y * width..(y + 1) * width];
            let row = &mut rows[y * width..(y + 1) * width];
            spread(&mut |x| codes[x] != OUTSIDE, width, &mut |x| row[x] = 1);
        }
        let mut near = vec![0u8; width * height];
        for x in 0..width {
            spread(&mut |y| rows[y * width + x] != 0, height, &mut |y| near[y * width + x] = 1);
        }
        near
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
