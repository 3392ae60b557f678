//! From the pixels of a frame to packed RGB.
//!
//! Input: a checked [`FrameLayout`] and its payload. Output: a view of `width * height * 3` bytes, of the payload
//! itself where that already is packed RGB, else of a scratch that the caller keeps. Cost: linear in pixels.
//!
//! Bayer frames are interpolated bilinearly: a colour that a pixel did not measure is the rounded mean of those
//! pixels in its 3 x 3 neighbourhood that did, of its four edge neighbours where these have it. Across the border
//! nothing is made up: the mean is over the neighbours that exist. Frames one pixel wide or high lack some colours
//! altogether; there the pixel's own sample stands in, so such a frame is grey rather than black.

use crate::{FrameLayout, PixelFormat, RgbView};

impl FrameLayout {
    /// The frame as packed RGB.
    ///
    /// Packed rgb8 is returned where it lies, without a copy. Every other layout is converted into `scratch`, which
    /// grows to the size of the frame once and is then reused.
    ///
    /// `None` when the payload is shorter than the one this layout was checked against.
    ///
    /// ```
    /// use samsod_frame::{FrameHeader, FrameLayout, PixelFormat};
    /// let header = FrameHeader { width: 2, height: 1, stride: 2, pixel_format: 3, ..FrameHeader::default() };
    /// let grey = [7, 250];
    /// let mut scratch = Vec::new();
    /// let rgb = FrameLayout::check(&header, grey.len())?.rgb(&grey, &mut scratch).ok_or("too short")?;
    /// assert_eq!(rgb.as_raw(), &[7, 7, 7, 250, 250, 250]);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn rgb<'a>(&self, payload: &'a [u8], scratch: &'a mut Vec<u8>) -> Option<RgbView<'a>> {
        let payload = payload.get(..self.payload_bytes())?;
        let (width, height) = (self.width() as usize, self.height() as usize);
        if self.format() == PixelFormat::Rgb8 && self.stride() == self.row_bytes() {
            return RgbView::from_raw(self.width(), self.height(), payload);
        }
        scratch.resize(width * height * 3, 0);
        let rows = payload.chunks(self.stride()).map(|row| &row[..self.row_bytes()]);
        let lines = scratch.chunks_exact_mut(width * 3);
        match self.format() {
            PixelFormat::Rgb8 => rows.zip(lines).for_each(|(row, line)| line.copy_from_slice(row)),
            PixelFormat::Bgr8 => rows.zip(lines).for_each(|(row, line)| swap_red_blue(row, line)),
            PixelFormat::Mono8 => rows.zip(lines).for_each(|(row, line)| spread_grey(row, line)),
            PixelFormat::BayerRg8 => {
                for (y, line) in lines.enumerate() {
                    demosaic_row(payload, self.stride(), width, height, y, line);
                }
            }
        }
        RgbView::from_raw(self.width(), self.height(), scratch.as_slice())
    }
}

fn swap_red_blue(row: &[u8], line: &mut [u8]) {
    for (out, px) in line.chunks_exact_mut(3).zip(row.chunks_exact(3)) {
        out.copy_from_slice(&[px[2], px[1], px[0]]);
    }
}

fn spread_grey(row: &[u8], line: &mut [u8]) {
    for (out, &grey) in line.chunks_exact_mut(3).zip(row) {
        out.fill(grey);
    }
}

/// One row of a Bayer frame: the pixels with all eight neighbours two by two, the others one by one.
fn demosaic_row(bytes: &[u8], stride: usize, width: usize, height: usize, y: usize, line: &mut [u8]) {
    let mut plain = |x: usize| {
        let rgb = demosaic_pixel(bytes, stride, width, height, x, y);
        line[x * 3..x * 3 + 3].copy_from_slice(&rgb);
    };
    if y == 0 || y + 1 == height || width < 4 {
        (0..width).for_each(plain);
        return;
    }
    // Columns 1 .. inner_end are done in pairs; an odd one is left to the plain path with the last column.
    let inner_end = 1 + (width - 2) / 2 * 2;
    plain(0);
    (inner_end..width).for_each(plain);

    let row = |y: usize| &bytes[y * stride..y * stride + width];
    let (above, here, below) = (row(y - 1), row(y), row(y + 1));
    let inner = line[3..inner_end * 3].chunks_exact_mut(6);
    let windows = above.windows(4).zip(here.windows(4)).zip(below.windows(4)).step_by(2);
    for (out, ((a, h), b)) in inner.zip(windows) {
        // The pair starts at an odd column: green then red on even rows, blue then green on odd ones.
        let (cross, diagonal) = (mean4(h[1], h[3], a[2], b[2]), mean4(a[1], a[3], b[1], b[3]));
        let (left_right, up_down) = (mean2(h[0], h[2]), mean2(a[1], b[1]));
        let rgb = if y.is_multiple_of(2) {
            [left_right, h[1], up_down, h[2], cross, diagonal]
        } else {
            let (cross, diagonal) = (mean4(h[0], h[2], a[1], b[1]), mean4(a[0], a[2], b[0], b[2]));
            [diagonal, cross, h[1], mean2(a[2], b[2]), h[2], mean2(h[1], h[3])]
        };
        out.copy_from_slice(&rgb);
    }
}

fn mean2(a: u8, b: u8) -> u8 {
    (u16::from(a) + u16::from(b)).div_ceil(2) as u8
}

fn mean4(a: u8, b: u8, c: u8, d: u8) -> u8 {
    ((u16::from(a) + u16::from(b) + u16::from(c) + u16::from(d) + 2) / 4) as u8
}

/// One pixel of a Bayer frame from the definition: for borders, and the oracle of the fast path.
fn demosaic_pixel(bytes: &[u8], stride: usize, width: usize, height: usize, x: usize, y: usize) -> [u8; 3] {
    let colour_at = |x: usize, y: usize| match (x % 2, y % 2) {
        (0, 0) => 0,
        (1, 1) => 2,
        _ => 1,
    };
    let own = bytes[y * stride + x];
    let (mut edge_sum, mut edge_count) = ([0u32; 3], [0u32; 3]);
    let (mut all_sum, mut all_count) = ([0u32; 3], [0u32; 3]);
    for ny in y.saturating_sub(1)..(y + 2).min(height) {
        for nx in x.saturating_sub(1)..(x + 2).min(width) {
            let (colour, value) = (colour_at(nx, ny), u32::from(bytes[ny * stride + nx]));
            all_sum[colour] += value;
            all_count[colour] += 1;
            if (nx == x) != (ny == y) {
                edge_sum[colour] += value;
                edge_count[colour] += 1;
            }
        }
    }
    std::array::from_fn(|colour| {
        let (sum, count) = match (edge_count[colour], all_count[colour]) {
            _ if colour == colour_at(x, y) => (u32::from(own), 1),
            (0, 0) => (u32::from(own), 1),
            (0, count) => (all_sum[colour], count),
            (count, _) => (edge_sum[colour], count),
        };
        ((sum + count / 2) / count) as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::FrameHeader;
    use proptest::prelude::*;

    fn layout(width: u32, height: u32, stride: u32, format: PixelFormat, len: usize) -> FrameLayout {
        let header = FrameHeader { width, height, stride, pixel_format: format as u32, ..FrameHeader::default() };
        FrameLayout::check(&header, len).unwrap()
    }

    fn rgb(width: u32, height: u32, stride: u32, format: PixelFormat, payload: &[u8]) -> Vec<u8> {
        let mut scratch = Vec::new();
        let view = layout(width, height, stride, format, payload.len()).rgb(payload, &mut scratch);
        view.unwrap().as_raw().to_vec()
    }

    #[test]
    fn packed_rgb_is_not_copied() {
        let payload: Vec<u8> = (0..36).collect();
        let mut scratch = Vec::new();
        let view = layout(4, 3, 12, PixelFormat::Rgb8, 36).rgb(&payload, &mut scratch).unwrap();
        assert_eq!(view.as_raw().as_ptr(), payload.as_ptr());
        assert!(scratch.is_empty());
    }

    #[test]
    fn a_longer_payload_does_not_reach_the_view() {
        let payload = vec![9; 100];
        assert_eq!(rgb(4, 3, 12, PixelFormat::Rgb8, &payload).len(), 36);
    }

    #[test]
    fn padding_of_rows_is_left_out() {
        // 2 x 2, stride 8, the last row not padded.
        let payload = [1, 2, 3, 4, 5, 6, 99, 99, 7, 8, 9, 10, 11, 12];
        assert_eq!(rgb(2, 2, 8, PixelFormat::Rgb8, &payload), [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]);
        assert_eq!(rgb(2, 2, 8, PixelFormat::Bgr8, &payload), [3, 2, 1, 6, 5, 4, 9, 8, 7, 12, 11, 10]);
        let grey = [1, 2, 99, 3, 4];
        assert_eq!(rgb(2, 2, 3, PixelFormat::Mono8, &grey), [1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4]);
    }

    #[test]
    fn bayer_of_4_by_3_by_hand() {
        // R  G  R  G      10  20  30  40
        // G  B  G  B      50  60  70  80
        // R  G  R  G      90 100 110 120
        let payload = [10, 20, 30, 40, 50, 60, 70, 80, 90, 100, 110, 120];
        #[rustfmt::skip]
        let expected = [
            // R = own, G = (20 + 50) / 2, B = 60;  R = (10 + 30) / 2, G, B = 60; ..
            10, 35, 60,   20, 20, 60,   30, 43, 70,   30, 40, 80,
            50, 50, 60,   60, 60, 60,   70, 70, 70,   70, 77, 80,
            90, 75, 60,  100, 100, 60, 110, 97, 70,  110, 120, 80,
        ];
        assert_eq!(rgb(4, 3, 4, PixelFormat::BayerRg8, &payload), expected);
    }

    #[test]
    fn bayer_of_one_pixel_row_and_column() {
        assert_eq!(rgb(1, 1, 1, PixelFormat::BayerRg8, &[77]), [77, 77, 77]);
        // R G R: no blue anywhere, so each pixel's own sample stands in.
        assert_eq!(rgb(3, 1, 3, PixelFormat::BayerRg8, &[10, 20, 30]), [10, 20, 10, 20, 20, 20, 30, 20, 30]);
        assert_eq!(rgb(1, 2, 1, PixelFormat::BayerRg8, &[10, 20]), [10, 20, 10, 10, 20, 20]);
    }

    proptest! {
        #[test]
        fn fast_and_plain_demosaicing_agree(
            width in 1usize..20,
            height in 1usize..20,
            padding in 0usize..5,
            seed in proptest::collection::vec(any::<u8>(), 20 * 25),
        ) {
            let stride = width + padding;
            let payload = &seed[..stride * (height - 1) + width];
            let fast = rgb(width as u32, height as u32, stride as u32, PixelFormat::BayerRg8, payload);
            for y in 0..height {
                for x in 0..width {
                    let plain = demosaic_pixel(payload, stride, width, height, x, y);
                    prop_assert_eq!(&fast[(y * width + x) * 3..][..3], &plain, "at {}, {}", x, y);
                }
            }
        }

        #[test]
        fn a_colour_field_survives_the_mosaic(
            width in 2u32..12, height in 2u32..12, colour in any::<[u8; 3]>(),
        ) {
            let payload: Vec<u8> = (0..height)
                .flat_map(|y| (0..width).map(move |x| colour[(x % 2 + y % 2) as usize]))
                .collect();
            for px in rgb(width, height, width, PixelFormat::BayerRg8, &payload).chunks_exact(3) {
                prop_assert_eq!(px, &colour);
            }
        }
    }
}
