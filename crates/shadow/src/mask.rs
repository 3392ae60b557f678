//! A set of pixels in its bounding box.

use image::GrayImage;
use samsod_segment::BoundingBox;

/// A set of pixels that is not empty.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mask {
    bbox: BoundingBox,
    /// 1 inside and 0 outside, row by row in `bbox`.
    bits: Vec<u8>,
}

/// Columns `start .. end` of row `y` of the image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MaskRun {
    /// Row, px.
    pub y: u32,
    /// First column, px.
    pub start: u32,
    /// One past the last column, px.
    pub end: u32,
}

impl Mask {
    /// The pixels of some runs, which may touch or overlap; `None` when there are none.
    pub fn from_runs(runs: &[MaskRun]) -> Option<Self> {
        let filled = || runs.iter().filter(|run| run.end > run.start);
        let first = filled().next()?;
        let (mut left, mut right, mut top, mut bottom) = (first.start, first.end, first.y, first.y);
        for run in filled() {
            left = left.min(run.start);
            right = right.max(run.end);
            top = top.min(run.y);
            bottom = bottom.max(run.y);
        }
        let bbox = BoundingBox { x: left, y: top, width: right - left, height: bottom - top + 1 };
        let width = bbox.width as usize;
        let mut bits = vec![0; width * bbox.height as usize];
        for run in filled() {
            let row = (run.y - top) as usize * width;
            bits[row + (run.start - left) as usize..row + (run.end - left) as usize].fill(1);
        }
        Some(Self { bbox, bits })
    }

    /// The smallest box that holds all pixels.
    pub fn bbox(&self) -> BoundingBox {
        self.bbox
    }

    /// 1 inside and 0 outside: `bbox().height * bbox().width` values, row by row.
    pub fn bits(&self) -> &[u8] {
        &self.bits
    }

    /// Whether the pixel (x, y) of the image belongs to the mask.
    pub fn contains(&self, x: u32, y: u32) -> bool {
        let b = &self.bbox;
        let inside = (b.x..=b.right()).contains(&x) && (b.y..=b.bottom()).contains(&y);
        inside && self.bits[(y - b.y) as usize * b.width as usize + (x - b.x) as usize] != 0
    }

    /// Number of pixels.
    pub fn area(&self) -> u32 {
        // Rows of bytes are summed in 32 bits, which compilers vectorise.
        self.bits.chunks(self.bbox.width as usize).map(|row| row.iter().map(|&bit| u32::from(bit)).sum::<u32>()).sum()
    }

    /// The rows from top to bottom: y of the image, and 1 or 0 for every column of the box.
    pub fn rows(&self) -> impl ExactSizeIterator<Item = (u32, &[u8])> {
        let top = self.bbox.y;
        self.bits.chunks_exact(self.bbox.width as usize).enumerate().map(move |(i, row)| (top + i as u32, row))
    }

    /// The pixels as runs, from top to bottom and left to right.
    pub fn runs(&self) -> impl Iterator<Item = MaskRun> {
        let left = self.bbox.x;
        self.rows().flat_map(move |(y, row)| {
            let mut start = left;
            row.chunk_by(|a, b| a == b).filter_map(move |chunk| {
                let run = MaskRun { y, start, end: start + chunk.len() as u32 };
                start = run.end;
                (chunk[0] != 0).then_some(run)
            })
        })
    }

    /// An image of `width x height` px, 255 inside and 0 outside; pixels beyond it are left out.
    pub fn to_image(&self, width: u32, height: u32) -> GrayImage {
        let mut image = GrayImage::new(width, height);
        let (x, y) = (self.bbox.x, self.bbox.y);
        if x < width && y < height {
            let columns = self.bbox.width.min(width - x) as usize;
            let lines = image.chunks_exact_mut(width as usize).skip(y as usize);
            for (line, (_, row)) in lines.zip(self.rows()) {
                for (pixel, &bit) in line[x as usize..].iter_mut().zip(&row[..columns]) {
                    *pixel = bit * 255;
                }
            }
        }
        image
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(y: u32, start: u32, end: u32) -> MaskRun {
        MaskRun { y, start, end }
    }

    #[test]
    fn a_mask_is_its_runs() {
        let runs = [run(3, 5, 7), run(3, 9, 10), run(5, 4, 6)];
        let mask = Mask::from_runs(&runs).unwrap();
        assert_eq!(mask.bbox(), BoundingBox { x: 4, y: 3, width: 6, height: 3 });
        assert_eq!(mask.bits(), [0, 1, 1, 0, 0, 1, 0, 0, 0, 0, 0, 0, 1, 1, 0, 0, 0, 0]);
        assert_eq!(mask.area(), 5);
        assert_eq!(mask.runs().collect::<Vec<_>>(), runs);
        assert_eq!(mask.rows().map(|(y, _)| y).collect::<Vec<_>>(), [3, 4, 5]);
        for (x, y, inside) in [(5, 3, true), (7, 3, false), (9, 3, true), (4, 5, true), (0, 0, false), (10, 3, false)] {
            assert_eq!(mask.contains(x, y), inside, "({x}, {y})");
        }
    }

    #[test]
    fn there_is_no_empty_mask() {
        assert_eq!(Mask::from_runs(&[]), None);
        assert_eq!(Mask::from_runs(&[run(1, 4, 4)]), None);
    }

    #[test]
    fn images_clip_what_lies_beyond_them() {
        let mask = Mask::from_runs(&[run(1, 1, 4), run(2, 0, 2)]).unwrap();
        assert_eq!(mask.to_image(3, 2).into_raw(), [0, 0, 0, 0, 255, 255]);
        assert_eq!(mask.to_image(4, 3).into_raw(), [0, 0, 0, 0, 0, 255, 255, 255, 255, 255, 0, 0]);
        let far = Mask::from_runs(&[run(7, 7, 9)]).unwrap();
        assert_eq!(far.to_image(3, 2).into_raw(), [0; 6]);
        assert_eq!(far.to_image(0, 0).into_raw(), [0u8; 0]);
    }
}
