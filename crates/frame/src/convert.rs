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
            PixelFormat::BayerRg8 | PixelFormat::BayerGr8 | PixelFormat::BayerGb8 | PixelFormat::BayerBg8 => {
                let mosaic =
                    Mosaic { bytes: payload, stride: self.stride(), width, height, red: red_at(self.format()) };
                for (y, line) in lines.enumerate() {
                    mosaic.row(y, line);
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

/// Column and row, 0 or 1, of the red pixel in each 2 x 2 of a Bayer frame; blue is across from it.
fn red_at(format: PixelFormat) -> (usize, usize) {
    match format {
        PixelFormat::BayerGr8 => (1, 0),
        PixelFormat::BayerGb8 => (0, 1),
        PixelFormat::BayerBg8 => (1, 1),
        _ => (0, 0),
    }
}

/// A Bayer frame.
struct Mosaic<'a> {
    bytes: &'a [u8],
    stride: usize,
    width: usize,
    height: usize,
    red: (usize, usize),
}

impl Mosaic<'_> {
    /// One row: the pixels with all eight neighbours two by two, the others one by one.
    fn row(&self, y: usize, line: &mut [u8]) {
        let width = self.width;
        let mut plain = |x: usize| line[x * 3..x * 3 + 3].copy_from_slice(&self.pixel(x, y));
        if y == 0 || y + 1 == self.height || width < 4 {
            (0..width).for_each(plain);
            return;
        }
        // Columns 1 .. inner_end are done in pairs; an odd one is left to the plain path with the last column.
        let inner_end = 1 + (width - 2) / 2 * 2;
        plain(0);
        (inner_end..width).for_each(plain);

        let row = |y: usize| &self.bytes[y * self.stride..y * self.stride + width];
        let rows = [row(y - 1), row(y), row(y + 1)];
        let inner = &mut line[3..inner_end * 3];
        // A row has green and one more colour. A pair starts at an odd column, so on green where the other colour has column 0.
        let has_red = y % 2 == self.red.1;
        match (has_red, has_red == (self.red.0 == 0)) {
            (true, true) => pairs::<0, true>(rows, inner),
            (true, false) => pairs::<0, false>(rows, inner),
            (false, true) => pairs::<2, true>(rows, inner),
            (false, false) => pairs::<2, false>(rows, inner),
        }
    }

    /// Channel that a pixel has measured.
    fn colour_at(&self, x: usize, y: usize) -> usize {
        match (x % 2 == self.red.0, y % 2 == self.red.1) {
            (true, true) => 0,
            (false, false) => 2,
            _ => 1,
        }
    }

    /// One pixel from the definition: for borders, and the oracle of the fast path.
    fn pixel(&self, x: usize, y: usize) -> [u8; 3] {
        let at = |x: usize, y: usize| self.bytes[y * self.stride + x];
        let own = at(x, y);
        let (mut edge_sum, mut edge_count) = ([0u32; 3], [0u32; 3]);
        let (mut all_sum, mut all_count) = ([0u32; 3], [0u32; 3]);
        for ny in y.saturating_sub(1)..(y + 2).min(self.height) {
            for nx in x.saturating_sub(1)..(x + 2).min(self.width) {
                let (colour, value) = (self.colour_at(nx, ny), u32::from(at(nx, ny)));
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
                _ if colour == self.colour_at(x, y) => (u32::from(own), 1),
                (0, 0) => (u32::from(own), 1),
                (0, count) => (all_sum[colour], count),
                (count, _) => (edge_sum[colour], count),
            };
            ((sum + count / 2) / count) as u8
        })
    }
}

/// The inner pixels of a row whose colour beside green is channel `OWN`, from column 1 on in pairs: green and that colour, or the
/// other way round. Above and below lie pixels of the third colour.
fn pairs<const OWN: usize, const GREEN_FIRST: bool>([above, here, below]: [&[u8]; 3], line: &mut [u8]) {
    let windows = above.windows(4).zip(here.windows(4)).zip(below.windows(4)).step_by(2);
    for (out, ((a, h), b)) in line.chunks_exact_mut(6).zip(windows) {
        let (green, own) = if GREEN_FIRST { (1, 2) } else { (2, 1) };
        let green_px = [mean2(h[green - 1], h[green + 1]), h[green], mean2(a[green], b[green])];
        let cross = mean4(h[own - 1], h[own + 1], a[own], b[own]);
        let diagonal = mean4(a[own - 1], a[own + 1], b[own - 1], b[own + 1]);
        let own_px = [h[own], cross, diagonal];
        let in_order = |[own, green, other]: [u8; 3]| if OWN == 0 { [own, green, other] } else { [other, green, own] };
        out[(green - 1) * 3..][..3].copy_from_slice(&in_order(green_px));
        out[(own - 1) * 3..][..3].copy_from_slice(&in_order(own_px));
    }
}

fn mean2(a: u8, b: u8) -> u8 {
    (u16::from(a) + u16::from(b)).div_ceil(2) as u8
}

fn mean4(a: u8, b: u8, c: u8, d: u8) -> u8 {
    ((u16::from(a) + u16::from(b) + u16::from(c) + u16::from(d) + 2) / 4) as u8
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

    const BAYER: [PixelFormat; 4] =
        [PixelFormat::BayerRg8, PixelFormat::BayerGr8, PixelFormat::BayerGb8, PixelFormat::BayerBg8];

    /// What a camera of this format would have measured: letters of its name say which colours the first pixels have.
    fn mosaic_of(picture: &[u8], width: usize, format: PixelFormat) -> Vec<u8> {
        let first: [usize; 2] = match format {
            PixelFormat::BayerRg8 => [0, 1],
            PixelFormat::BayerGr8 => [1, 0],
            PixelFormat::BayerGb8 => [1, 2],
            _ => [2, 1],
        };
        // The second row has the first one's colours across: green under the other, the third colour under green.
        let second = [if first[0] == 1 { 2 - first[1] } else { 1 }, if first[1] == 1 { 2 - first[0] } else { 1 }];
        let colour = |x: usize, y: usize| if y.is_multiple_of(2) { first[x % 2] } else { second[x % 2] };
        let pixels = picture.chunks_exact(3).enumerate();
        pixels.map(|(i, px)| px[colour(i % width, i / width)]).collect()
    }

    #[test]
    fn a_picture_of_the_cell_survives_every_mosaic() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/data/cell/0032.jpg");
        let picture = image::open(path).unwrap().into_rgb8();
        let (width, height) = picture.dimensions();
        for format in BAYER {
            let mosaic = mosaic_of(picture.as_raw(), width as usize, format);
            let psnr_db = |taken_for: PixelFormat| {
                let restored = rgb(width, height, width, taken_for, &mosaic);
                let squares = restored.iter().zip(picture.as_raw()).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2));
                10.0 * (255.0_f64.powi(2) * restored.len() as f64 / squares.sum::<f64>()).log10()
            };
            for taken_for in BAYER {
                println!("{format} taken for {taken_for}: {:.1} dB", psnr_db(taken_for));
            }
            let right = psnr_db(format);
            assert!(right > 38.0, "{format}: {right:.1} dB");
            for wrong in BAYER.into_iter().filter(|wrong| *wrong != format) {
                assert!(psnr_db(wrong) < right - 6.0, "{format} taken for {wrong}: {:.1} dB", psnr_db(wrong));
            }
        }
    }

    proptest! {
        #[test]
        fn fast_and_plain_demosaicing_agree(
            format in proptest::sample::select(&BAYER[..]),
            width in 1usize..20,
            height in 1usize..20,
            padding in 0usize..5,
            seed in proptest::collection::vec(any::<u8>(), 20 * 25),
        ) {
            let stride = width + padding;
            let payload = &seed[..stride * (height - 1) + width];
            let fast = rgb(width as u32, height as u32, stride as u32, format, payload);
            let mosaic = Mosaic { bytes: payload, stride, width, height, red: red_at(format) };
            for y in 0..height {
                for x in 0..width {
                    let plain = mosaic.pixel(x, y);
                    prop_assert_eq!(&fast[(y * width + x) * 3..][..3], &plain, "at {}, {}", x, y);
                }
            }
        }

        #[test]
        fn a_colour_field_survives_the_mosaic(
            format in proptest::sample::select(&BAYER[..]),
            width in 2u32..12, height in 2u32..12, colour in any::<[u8; 3]>(),
        ) {
            let payload = mosaic_of(&colour.repeat((width * height) as usize), width as usize, format);
            for px in rgb(width, height, width, format, &payload).chunks_exact(3) {
                prop_assert_eq!(px, &colour);
            }
        }
    }
}
