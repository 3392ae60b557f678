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
        self.dx.resize(width * height, 0.0);
        self.dy.resize(width * height, 0.0);
        // Along every row: smoothed with 1 4 6 4 1 (/ 16), and derived with -1 -2 0 2 1 (/ 8).
        self.rows.clear();
        self.rows.resize(2 * width * height, 0.0);
        let clamp = |i: isize, n: usize| i.clamp(0, n as isize - 1) as usize;
        for channel in 0..3 {
            let (smooth, derived) = self.rows.split_at_mut(width * height);
            for y in 0..height {
                let start = ((bbox.y as usize + y) * stride + bbox.x as usize) * 3 + channel;
                let at = |x: isize| f32::from(pixels[start + clamp(x, width) * 3]);
                for x in 0..width {
                    let i = x as isize;
                    let (a, b, c, d, e) = (at(i - 2), at(i - 1), at(i), at(i + 1), at(i + 2));
                    smooth[y * width + x] = (a + e + 4.0 * (b + d) + 6.0 * c) * (1.0 / 16.0);
                    derived[y * width + x] = (e - a + 2.0 * (d - b)) * (1.0 / 8.0);
                }
            }
            for y in 0..height {
                let row = |k: isize| clamp(y as isize + k, height) * width;
                let [r0, r1, r2, r3, r4] = [row(-2), row(-1), row(0), row(1), row(2)];
                for x in 0..width {
                    let dx = (derived[r0 + x]
                        + derived[r4 + x]
                        + 4.0 * (derived[r1 + x] + derived[r3 + x])
                        + 6.0 * derived[r2 + x])
                        * (1.0 / 16.0);
                    let dy = (smooth[r4 + x] - smooth[r0 + x] + 2.0 * (smooth[r3 + x] - smooth[r1 + x])) * (1.0 / 8.0);
                    let index = y * width + x;
                    let (ox, oy) = (self.dx[index], self.dy[index]);
                    if dx * dx + dy * dy > ox * ox + oy * oy {
                        self.dx[index] = dx;
                        self.dy[index] = dy;
                    }
                }
            }
        }
        self.sorted.clear();
        self.sorted.extend(self.dx.iter().zip(&self.dy).step_by(3).map(|(x, y)| x.hypot(*y)));
        let middle = self.sorted.len() / 2;
        self.noise =
            if self.sorted.is_empty() { 0.0 } else { *self.sorted.select_nth_unstable_by(middle, f32::total_cmp).1 };
        self.respond(HALF_RESPONSE * self.noise + LEAST_GRADIENT);
    }

    /// Weighs the edges: one of `half` levels a pixel has a response of one half.
    fn respond(&mut self, half: f32) {
        let whole = |value: f32, scale: f32| (value * scale).round_ties_even() as i16;
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
    #[cfg(test)]
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

    /// Direction across an edge and its magnitude where the magnitude is greatest across it, at a pixel of the
    /// rectangle.
    pub(crate) fn ridge(&self, x: usize, y: usize) -> Option<(f32, f32, f32)> {
        if x < 1 || y < 1 || x + 1 >= self.width || y + 1 >= self.height {
            return None;
        }
        let i = y * self.width + x;
        let (dx, dy) = (self.dx[i], self.dy[i]);
        let magnitude = dx.hypot(dy);
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
            self.dx[j].hypot(self.dy[j])
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
