//! Colour gradients of a piece of a frame.
//!
//! At every pixel the derivative (5 x 5, of a Gaussian) of the channel that changes most: parts of the same brightness
//! as the table have edges, too.

use image::RgbImage;
use samsod_segment::{BoundingBox, RgbView};

/// An edge of so many times the gradient of noise counts half.
const HALF_RESPONSE: f32 = 2.0;
/// and this more, sRGB levels a pixel: below it nothing is seen.
const LEAST_GRADIENT: f32 = 1.0;

/// Units of the whole numbers that edges are looked up in ([`edge_lanes`](crate::edge_lanes)): of unit vectors,
pub(crate) const NORMAL_SCALE: f32 = 16_384.0;
/// of the roots of responses,
pub(crate) const RESPONSE_SCALE: f32 = 32_000.0;
/// and of derivatives, of which none is above 96 levels a pixel.
pub(crate) const SLOPE_SCALE: f32 = 256.0;

/// Rows that a derivative looks at.
const WINDOW: usize = 5;

/// A number between -32768 and 32767 as a whole one.
#[inline(always)]
pub(crate) fn rounded(value: f32) -> i16 {
    // Where floats are whole numbers apart, its low bits are those of the integer; no processor is too old for that.
    (value + 12_582_912.0).to_bits() as i16
}

/// Smooths a row of pixels of three channels with 1 4 6 4 1 (/ 16), and derives it with -1 -2 0 2 1 (/ 8).
fn along(padded: &[f32], smooth: &mut [f32], derived: &mut [f32]) {
    let length = smooth.len().min(derived.len());
    let at = |k: usize| &padded[3 * k..3 * k + length];
    let (a, b, c, d, e) = (at(0), at(1), at(2), at(3), at(4));
    for i in 0..length {
        smooth[i] = (a[i] + e[i] + 4.0 * (b[i] + d[i]) + 6.0 * c[i]) * (1.0 / 16.0);
        derived[i] = (e[i] - a[i] + 2.0 * (d[i] - b[i])) * (1.0 / 8.0);
    }
}

/// Both derivatives of a row, and the sums of their squares, from five rows that were smoothed and derived along.
fn down(rows: [(&[f32], &[f32]); WINDOW], dx: &mut [f32], dy: &mut [f32], squares: &mut [f32]) {
    let length = dx.len().min(dy.len()).min(squares.len());
    let [s0, s1, _, s3, s4] = rows.map(|(smooth, _)| &smooth[..length]);
    let [d0, d1, d2, d3, d4] = rows.map(|(_, derived)| &derived[..length]);
    let (dx, dy, squares) = (&mut dx[..length], &mut dy[..length], &mut squares[..length]);
    for i in 0..length {
        let x = (d0[i] + d4[i] + 4.0 * (d1[i] + d3[i]) + 6.0 * d2[i]) * (1.0 / 16.0);
        let y = (s4[i] - s0[i] + 2.0 * (s3[i] - s1[i])) * (1.0 / 8.0);
        (dx[i], dy[i], squares[i]) = (x, y, x * x + y * y);
    }
}

/// Gradient of a rectangle of a frame.
#[derive(Debug, Default, Clone)]
pub(crate) struct Gradient {
    /// Column and row of the first pixel in the frame.
    pub(crate) left: i32,
    pub(crate) top: i32,
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Derivatives along x and y, sRGB levels a pixel.
    pub(crate) dx: Vec<f32>,
    pub(crate) dy: Vec<f32>,
    /// Magnitude that noise and texture have, levels a pixel.
    pub(crate) noise: f32,
    /// At every pixel the direction across an edge, of a length whose fourth power is the response of the edge in
    /// [0, 1]: the fourth power of its product with a normal is then the response times cos^4 of the angle between. In
    /// units of 1 / [`RESPONSE_SCALE`].
    pub(crate) responses: Vec<[i16; 2]>,
    /// The derivatives, in units of 1 / [`SLOPE_SCALE`].
    pub(crate) slopes: Vec<[i16; 2]>,
    rows: Vec<f32>,
    sorted: Vec<f32>,
}

impl Gradient {
    /// Of a rectangle of a frame, which must lie within it.
    pub(crate) fn of(frame: &RgbView<'_>, bbox: BoundingBox) -> Self {
        let mut gradient = Self::default();
        gradient.measure(frame.as_raw(), frame.width() as usize, bbox);
        gradient
    }

    /// Of a whole image.
    pub(crate) fn of_image(image: &RgbImage) -> Self {
        let (width, height) = image.dimensions();
        let mut gradient = Self::default();
        gradient.measure(image.as_raw(), width as usize, BoundingBox { x: 0, y: 0, width, height });
        gradient
    }

    fn measure(&mut self, pixels: &[u8], stride: usize, bbox: BoundingBox) {
        let (width, height) = (bbox.width as usize, bbox.height as usize);
        (self.left, self.top, self.width, self.height) = (bbox.x as i32, bbox.y as i32, width, height);
        self.dx.clear();
        self.dy.clear();
        self.dx.reserve(width * height);
        self.dy.reserve(width * height);
        if width * height > 0 {
            self.measure_rows(pixels, stride, bbox);
        }
        self.sorted.clear();
        self.sorted.extend(self.dx.iter().zip(&self.dy).step_by(3).map(|(x, y)| (x * x + y * y).sqrt()));
        let middle = self.sorted.len() / 2;
        self.noise =
            if self.sorted.is_empty() { 0.0 } else { *self.sorted.select_nth_unstable_by(middle, f32::total_cmp).1 };
        self.respond(HALF_RESPONSE * self.noise + LEAST_GRADIENT);
    }

    /// Derives row by row; of each row only those around it are kept. The channels lie beside each other, so that what is
    /// done to a row is done to neighbours in memory.
    fn measure_rows(&mut self, pixels: &[u8], stride: usize, bbox: BoundingBox) {
        let (width, height) = (self.width, self.height);
        let length = 3 * width;
        // Smoothed and derived along the row, for the row itself and two to either side.
        self.rows.clear();
        self.rows.resize(2 * WINDOW * length, 0.0);
        // Two pixels more to either side, which repeat the last.
        let mut padded = vec![0.0f32; length + 12];
        let (mut dx, mut dy, mut squares) = (vec![0.0f32; length], vec![0.0f32; length], vec![0.0f32; length]);
        let mut next = 0;
        for y in 0..height {
            while next < (y + 3).min(height) {
                let start = ((bbox.y as usize + next) * stride + bbox.x as usize) * 3;
                let Some(row) = pixels.get(start..start + length) else { return };
                padded[6..6 + length].iter_mut().zip(row).for_each(|(to, from)| *to = f32::from(*from));
                for channel in 0..3 {
                    let (first, last) = (f32::from(row[channel]), f32::from(row[length - 3 + channel]));
                    for k in 0..2 {
                        padded[3 * k + channel] = first;
                        padded[6 + length + 3 * k + channel] = last;
                    }
                }
                let slot = next % WINDOW * 2 * length;
                let (smooth, derived) = self.rows[slot..slot + 2 * length].split_at_mut(length);
                along(&padded, smooth, derived);
                next += 1;
            }
            let row = |k: isize| {
                let slot = (y as isize + k).clamp(0, height as isize - 1) as usize % WINDOW * 2 * length;
                self.rows[slot..slot + 2 * length].split_at(length)
            };
            down([row(-2), row(-1), row(0), row(1), row(2)], &mut dx, &mut dy, &mut squares);
            let channels = dx.as_chunks::<3>().0.iter().zip(dy.as_chunks::<3>().0).zip(squares.as_chunks::<3>().0);
            for ((dx, dy), &[r, g, b]) in channels {
                let most = if g > r { 1 } else { 0 };
                let most = if b > r.max(g) { 2 } else { most };
                self.dx.push(dx[most]);
                self.dy.push(dy[most]);
            }
        }
    }

    /// Weighs the edges: one of `half` levels a pixel has a response of one half.
    fn respond(&mut self, half: f32) {
        let whole = |value: f32, scale: f32| rounded(value * scale);
        self.responses.clear();
        self.responses.extend(self.dx.iter().zip(&self.dy).map(|(&dx, &dy)| {
            let magnitude = (dx * dx + dy * dy).sqrt();
            // Of nothing there is no direction, and its length is 0.
            let length = (magnitude / (magnitude + half)).sqrt().sqrt() / magnitude.max(f32::MIN_POSITIVE);
            [whole(dx * length, RESPONSE_SCALE), whole(dy * length, RESPONSE_SCALE)]
        }));
        self.slopes.clear();
        self.slopes
            .extend(self.dx.iter().zip(&self.dy).map(|(&dx, &dy)| [whole(dx, SLOPE_SCALE), whole(dy, SLOPE_SCALE)]));
    }

    /// Derivatives at a position of the frame, px, between pixels; `None` outside.
    pub(crate) fn at(&self, u: f32, v: f32) -> Option<(f32, f32)> {
        let (x, y) = (u - self.left as f32, v - self.top as f32);
        if !(x >= 0.0 && y >= 0.0 && x < self.width as f32 - 1.0 && y < self.height as f32 - 1.0) {
            return None;
        }
        let (x0, y0) = (x as usize, y as usize);
        let (fx, fy) = (x - x0 as f32, y - y0 as f32);
        let i = y0 * self.width + x0;
        let mix = |values: &[f32]| {
            let upper = values[i] + fx * (values[i + 1] - values[i]);
            let lower = values[i + self.width] + fx * (values[i + self.width + 1] - values[i + self.width]);
            upper + fy * (lower - upper)
        };
        Some((mix(&self.dx), mix(&self.dy)))
    }

    /// Whether the gradient is at least so steep at a pixel of the rectangle.
    pub(crate) fn exceeds(&self, x: usize, y: usize, least: f32) -> bool {
        let i = y * self.width + x;
        let inside = x < self.width && y < self.height;
        inside && self.dx[i] * self.dx[i] + self.dy[i] * self.dy[i] >= least * least
    }

    /// Direction across an edge and its magnitude where the magnitude is greatest across it, at a pixel of the
    /// rectangle.
    pub(crate) fn ridge(&self, x: usize, y: usize) -> Option<(f32, f32, f32)> {
        if x < 1 || y < 1 || x + 1 >= self.width || y + 1 >= self.height {
            return None;
        }
        let i = y * self.width + x;
        let (dx, dy) = (self.dx[i], self.dy[i]);
        let magnitude = (dx * dx + dy * dy).sqrt();
        if magnitude <= 0.0 {
            return None;
        }
        let (nx, ny) = (dx / magnitude, dy / magnitude);
        // Neighbour across: right, below, or one of the two diagonals.
        let offset = match (nx.abs() > 0.383, ny.abs() > 0.383) {
            (true, false) => 1isize,
            (false, true) => self.width as isize,
            _ if nx * ny > 0.0 => self.width as isize + 1,
            _ => self.width as isize - 1,
        };
        let other = |k: isize| {
            let j = (i as isize + k) as usize;
            (self.dx[j] * self.dx[j] + self.dy[j] * self.dy[j]).sqrt()
        };
        (magnitude >= other(offset) && magnitude > other(-offset)).then_some((nx, ny, magnitude))
    }
}

#[cfg(test)]
mod tests {
    use image::Rgb;

    use super::*;
    use crate::test_parts::view;

    /// A step from 50 to 200 at column 10.3, where pixel centres are at integers.
    fn step() -> RgbImage {
        RgbImage::from_fn(24, 20, |x, _| {
            Rgb([match x {
                ..10 => 50,
                // 0.2 of the pixel lies beyond the step.
                10 => 80,
                _ => 200,
            }; 3])
        })
    }

    #[test]
    fn a_step_is_seen_where_it_is_and_as_high_as_it_is() {
        let gradient = Gradient::of_image(&step());
        let row: Vec<f32> = (0..24).map(|x| gradient.dx[7 * 24 + x]).collect();
        let height: f32 = row.iter().sum();
        let place = row.iter().enumerate().map(|(x, dx)| x as f32 * dx).sum::<f32>() / height;
        assert!((height - 150.0).abs() < 1e-3 && (place - 10.3).abs() < 1e-4, "{height} at {place}");
        assert!(gradient.dy.iter().all(|dy| dy.abs() < 1e-3));
        // Only one pixel of a row is the ridge, from the second row to the last but one.
        let ridges: Vec<(usize, usize)> = (0..20)
            .flat_map(|y| (0..24).map(move |x| (x, y)))
            .filter(|&(x, y)| gradient.ridge(x, y).is_some())
            .collect();
        assert_eq!(ridges, (1..19).map(|y| (10, y)).collect::<Vec<_>>());
        let (nx, ny, magnitude) = gradient.ridge(10, 7).unwrap();
        assert!((nx - 1.0).abs() < 1e-6 && ny.abs() < 1e-6 && (magnitude - row[10]).abs() < 1e-4);
    }

    #[test]
    fn a_slope_has_its_levels_a_pixel_and_its_direction() {
        let slope = RgbImage::from_fn(30, 30, |x, y| Rgb([(3 * x + 4 * y) as u8, 0, 0]));
        let gradient = Gradient::of_image(&slope);
        assert_eq!(gradient.at(12.4, 13.7), Some((3.0, 4.0)));
        assert!((gradient.noise - 5.0).abs() < 1e-4, "{}", gradient.noise);
    }

    #[test]
    fn colours_of_one_brightness_have_an_edge() {
        // Luminance (Rec. 601) 59.8 and 59.9.
        let image = RgbImage::from_fn(20, 20, |x, _| Rgb(if x < 10 { [200, 0, 0] } else { [0, 102, 0] }));
        let gradient = Gradient::of_image(&image);
        let (dx, dy) = gradient.at(9.5, 10.0).unwrap();
        assert!(dx.abs() > 40.0 && dy == 0.0, "{dx} {dy}");
    }

    #[test]
    fn what_lies_outside_of_the_rectangle_is_not_seen() {
        let mut image = RgbImage::from_pixel(30, 30, Rgb([40, 80, 120]));
        for i in 0..30 {
            for edge in [4, 20] {
                image.put_pixel(i, edge, Rgb([255; 3]));
                image.put_pixel(edge, i, Rgb([255; 3]));
            }
        }
        let gradient = Gradient::of(&view(&image), BoundingBox { x: 5, y: 5, width: 15, height: 15 });
        assert!(gradient.dx.iter().chain(&gradient.dy).all(|d| *d == 0.0));
        assert!((gradient.left, gradient.top, gradient.noise) == (5, 5, 0.0));
        assert_eq!(gradient.at(5.0, 5.0), Some((0.0, 0.0)));
        for (u, v) in [(4.9, 10.0), (10.0, 4.9), (19.0, 10.0), (10.0, 19.0), (f32::NAN, 10.0)] {
            assert_eq!(gradient.at(u, v), None, "{u} {v}");
        }
        assert!((0..15).all(|i| gradient.ridge(i, 0).is_none() && gradient.ridge(14, i).is_none()));
    }

    #[test]
    fn a_rectangle_has_the_gradient_of_its_frame() {
        let image = step();
        let whole = Gradient::of_image(&image);
        let part = Gradient::of(&view(&image), BoundingBox { x: 3, y: 2, width: 15, height: 11 });
        // Two pixels from its border, which are repeated beyond.
        for (u, v) in [(5.0, 5.5), (9.25, 6.0), (10.5, 10.0), (15.0, 8.0)] {
            assert_eq!(part.at(u, v), whole.at(u, v), "{u} {v}");
        }
    }

    #[test]
    fn a_single_pixel_is_no_error() {
        let gradient = Gradient::of_image(&RgbImage::from_pixel(1, 1, Rgb([9; 3])));
        assert_eq!((gradient.dx.as_slice(), gradient.at(0.0, 0.0), gradient.ridge(0, 0)), (&[0.0][..], None, None));
    }
}
