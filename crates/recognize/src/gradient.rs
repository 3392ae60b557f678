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
    /// [0, 1]: the fourth power of its product with a normal is then the response times cos^4 of the angle between.
    response: Vec<[f32; 2]>,
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
        self.response.clear();
        self.response.extend(self.dx.iter().zip(&self.dy).map(|(&dx, &dy)| {
            let magnitude = (dx * dx + dy * dy).sqrt();
            if magnitude <= 0.0 {
                return [0.0; 2];
            }
            let length = (magnitude / (magnitude + half)).sqrt().sqrt() / magnitude;
            [dx * length, dy * length]
        }));
    }

    /// Whether all of a circle, in pixels of the frame, lies between the centres of the outermost pixels.
    #[inline]
    pub(crate) fn holds(&self, u: f32, v: f32, radius: f32) -> bool {
        let (x, y) = (u - self.left as f32, v - self.top as f32);
        x - radius >= 0.0
            && y - radius >= 0.0
            && x + radius < self.width as f32 - 1.0
            && y + radius < self.height as f32 - 1.0
    }

    /// Response, in [0, 1], of edges across a normal at a position that the gradient holds.
    #[inline]
    pub(crate) fn response_across(&self, u: f32, v: f32, normal: [f32; 2]) -> f32 {
        let (x, y) = (u - self.left as f32, v - self.top as f32);
        let (x0, y0) = (x as usize, y as usize);
        let (fx, fy) = (x - x0 as f32, y - y0 as f32);
        let i = y0 * self.width + x0;
        let (Some([a, b]), Some([c, d])) = (
            self.response.get(i..i + 2).and_then(|row| row.first_chunk::<2>()),
            self.response.get(i + self.width..i + self.width + 2).and_then(|row| row.first_chunk::<2>()),
        ) else {
            return 0.0;
        };
        // Squares have no sign: the two sides of a thin line do not cancel between pixels.
        let squared = |q: &[f32; 2]| {
            let across = q[0] * normal[0] + q[1] * normal[1];
            across * across
        };
        let (a, b, c, d) = (squared(a), squared(b), squared(c), squared(d));
        let upper = a + fx * (b - a);
        let lower = c + fx * (d - c);
        let between = upper + fy * (lower - upper);
        between * between
    }

    /// Derivatives at a position of the frame, px, between pixels; `None` outside.
    #[inline]
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
