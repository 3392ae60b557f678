//! The edges along the normals of the points of a model, eight points at a time.
//!
//! In: [`Block`]s of eight points in the image, each with its normal, and the [`Gradient`] of a piece of the frame. Out:
//! for every point the strongest edge within a reach along its normal. That is where recognition spends most of its time:
//! with AVX2 all eight points take each step along their normals at once; elsewhere one after the other, with the same
//! operations in the same order, so that every path gives the same result.

use crate::gradient::{Gradient, NORMAL_SCALE, RESPONSE_SCALE, SLOPE_SCALE, rounded};

/// Points of a block.
pub(crate) const LANES: usize = 8;
/// A number of each.
pub(crate) type Lanes = [f32; LANES];

/// Between the places that are looked at, px;
const STEP_PX: f32 = 1.0;
/// with every second of them where the reach is longer than this, px,
const LONG_PX: f32 = 5.5;
/// and how many there are to a side at most.
const MOST_STEPS: usize = 10;
/// Where a point lies that is not seen, px: in no image.
const NOWHERE_PX: f32 = -1e9;

/// A number of each point of a block, with which to calculate: an operation on all eight is one instruction where the
/// processor has such.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Wide(pub(crate) Lanes);

impl Wide {
    #[inline(always)]
    pub(crate) fn of(value: f32) -> Self {
        Self([value; LANES])
    }

    #[inline(always)]
    pub(crate) fn sqrt(self) -> Self {
        self.with(self, |a, _| a.sqrt())
    }

    #[inline(always)]
    pub(crate) fn recip(self) -> Self {
        self.with(self, |a, _| 1.0 / a)
    }

    #[inline(always)]
    pub(crate) fn max(self, other: Self) -> Self {
        self.with(other, |a, b| if a > b { a } else { b })
    }

    /// 1 where a number is at most another, else 0; 0 for NaN.
    #[inline(always)]
    pub(crate) fn at_most(self, other: Self) -> Self {
        self.with(other, |a, b| if a <= b { 1.0 } else { 0.0 })
    }

    /// The numbers where a mask is not 0, and 0 elsewhere.
    #[inline(always)]
    pub(crate) fn only(self, mask: Self) -> Self {
        self.with(mask, |a, mask| if mask > 0.0 { a } else { 0.0 })
    }

    #[inline(always)]
    fn with(self, other: Self, of: impl Fn(f32, f32) -> f32) -> Self {
        let mut result = self.0;
        for (a, b) in result.iter_mut().zip(other.0) {
            *a = of(*a, b);
        }
        Self(result)
    }
}

impl std::ops::Add for Wide {
    type Output = Self;

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.with(other, |a, b| a + b)
    }
}

impl std::ops::Sub for Wide {
    type Output = Self;

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.with(other, |a, b| a - b)
    }
}

impl std::ops::Mul for Wide {
    type Output = Self;

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.with(other, |a, b| a * b)
    }
}

impl std::ops::Mul<Wide> for f32 {
    type Output = Wide;

    #[inline(always)]
    fn mul(self, other: Wide) -> Wide {
        Wide::of(self) * other
    }
}

/// Eight points of a model in the image. The last of a model may have fewer: what is neither outline nor inside is none.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Block {
    /// Column and row, px of the frame.
    at: [Lanes; 2],
    /// Unit vectors across the edges,
    across: [Lanes; 2],
    /// and the same as whole numbers, in units of 1 / [`NORMAL_SCALE`].
    normals: [[i16; 2]; LANES],
    /// How the place along the normal changes with x, y (px / mm) and yaw (px / rad) of the pose.
    pub(crate) slopes: [Lanes; 3],
    /// 1 for the points of the outline, else 0.
    pub(crate) outline: Lanes,
    /// 1 for those inside, else 0.
    pub(crate) inner: Lanes,
}

impl Block {
    /// Where one of its points is, px of the frame, and the unit vector across its edge.
    pub(crate) fn point(&self, lane: usize) -> ([f32; 2], [f32; 2]) {
        ([0, 1].map(|i| self.at[i][lane]), [0, 1].map(|i| self.across[i][lane]))
    }

    /// Of points somewhere, with unit vectors `across`; those that are neither outline nor inside are nowhere.
    #[inline(always)]
    pub(crate) fn new(
        mut at: [Lanes; 2],
        across: [Lanes; 2],
        slopes: [Lanes; 3],
        outline: Lanes,
        inner: Lanes,
    ) -> Self {
        let mut normals = [[0; 2]; LANES];
        for lane in 0..LANES {
            normals[lane][0] = rounded(across[0][lane] * NORMAL_SCALE);
            normals[lane][1] = rounded(across[1][lane] * NORMAL_SCALE);
        }
        for lane in 0..LANES {
            let is_point = outline[lane] + inner[lane] > 0.0;
            at[0][lane] = if is_point { at[0][lane] } else { NOWHERE_PX };
            at[1][lane] = if is_point { at[1][lane] } else { NOWHERE_PX };
        }
        Self { at, across, normals, slopes, outline, inner }
    }
}

/// How far along the normals edges are looked for.
#[derive(Debug, Clone)]
pub(crate) struct Reach {
    steps: i32,
    /// Every so many of them are looked at.
    stride: i32,
    /// Weights of the places from the point outwards: e^-(distance / tolerance)^2.
    weights: [f32; MOST_STEPS + 1],
}

impl Reach {
    pub(crate) fn new(reach_px: f32, tolerance_px: f32) -> Self {
        let weight = |k: usize| {
            let ratio = k as f32 * STEP_PX / tolerance_px;
            (-ratio * ratio).exp()
        };
        let stride = if reach_px > LONG_PX { 2 } else { 1 };
        let steps = ((reach_px / STEP_PX).round() as i32).clamp(0, MOST_STEPS as i32) / stride * stride;
        Self { steps, stride, weights: std::array::from_fn(weight) }
    }

    /// So far around a point the gradient is read, px.
    fn radius(&self) -> f32 {
        (self.steps + 1) as f32 * STEP_PX
    }
}

/// The edge along the normal of each point of a block.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Edges {
    /// Its place along the normal, px.
    pub(crate) offset: Lanes,
    /// Its response in [0, 1]; 0 where the frame ends.
    pub(crate) response: Lanes,
    /// Whether the frame goes on around the point: 1 or 0.
    pub(crate) held: Lanes,
}

/// The edges of some blocks.
pub(crate) fn find_edges(gradient: &Gradient, reach: &Reach, blocks: &[Block], edges: &mut Vec<Edges>) {
    edges.clear();
    // Two pixels of two rows are read at once.
    let pixels = gradient.width * gradient.height;
    if pixels < gradient.width + 2 || pixels > i32::MAX as usize {
        let none = Edges { offset: [0.0; LANES], response: [0.0; LANES], held: [0.0; LANES] };
        edges.resize(blocks.len(), none);
        return;
    }
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor was just found to have AVX2, the only feature the function asks for.
        unsafe { avx2::find(gradient, reach, blocks, edges) };
        return;
    }
    edges.extend(blocks.iter().map(|block| find_portable(gradient, reach, block)));
}

/// The edges of one block, point by point.
fn find_portable(gradient: &Gradient, reach: &Reach, block: &Block) -> Edges {
    let mut edges = Edges { offset: [0.0; LANES], response: [0.0; LANES], held: [0.0; LANES] };
    let width = gradient.width;
    let last = gradient.width * gradient.height - width - 2;
    let (left, top) = (gradient.left as f32, gradient.top as f32);
    let radius = reach.radius();
    for lane in 0..LANES {
        let [x, y] = [block.at[0][lane] - left, block.at[1][lane] - top];
        let [du, dv] = [block.across[0][lane], block.across[1][lane]];
        let held = x - radius >= 0.0
            && y - radius >= 0.0
            && x + radius < width as f32 - 1.0
            && y + radius < gradient.height as f32 - 1.0;
        if !held {
            continue;
        }
        let normal = block.normals[lane].map(i32::from);
        // Products of the normal with the vectors at the four pixels around a place, and its place between them.
        let corners = |pixels: &[[i16; 2]], offset: f32, scale: f32| {
            let (u, v) = (x + offset * du, y + offset * dv);
            let (column, row) = (u as i32, v as i32);
            let (fu, fv) = (u - column as f32, v - row as f32);
            let first = ((row * width as i32 + column).max(0) as usize).min(last);
            let product = |i: usize| {
                let [a, b] = pixels[first + i].map(i32::from);
                (a * normal[0] + b * normal[1]) as f32 * scale
            };
            ([0, 1, width, width + 1].map(product), fu, fv)
        };
        let mix = |[a, b, c, d]: [f32; 4], fu: f32, fv: f32| {
            let (upper, lower) = (a + fu * (b - a), c + fu * (d - c));
            upper + fv * (lower - upper)
        };
        let (mut best, mut most, mut response) = (0.0, -1.0, 0.0);
        for k in (-reach.steps..=reach.steps).step_by(reach.stride as usize) {
            let (values, fu, fv) = corners(&gradient.responses, k as f32 * STEP_PX, RESPONSE_UNIT);
            // Squares have no sign: the two sides of a thin line do not cancel between pixels.
            let between = mix(values.map(|value| value * value), fu, fv);
            let here = between * between;
            let weighed = here * reach.weights[k.unsigned_abs() as usize];
            if weighed > most {
                (best, most, response) = (k as f32 * STEP_PX, weighed, here);
            }
        }
        // Between the places by a parabola through the gradient across.
        let across = |offset: f32| {
            let (values, fu, fv) = corners(&gradient.slopes, offset, SLOPE_UNIT);
            mix(values, fu, fv).abs()
        };
        let (before, here, after) = (across(best - STEP_PX), across(best), across(best + STEP_PX));
        let bend = before - 2.0 * here + after;
        if bend < -1e-6 {
            best += (0.5 * (before - after) / bend).clamp(-0.5, 0.5) * STEP_PX;
        }
        (edges.offset[lane], edges.response[lane], edges.held[lane]) = (best, response, 1.0);
    }
    edges
}

/// The product of a normal and a vector of the gradient's, as whole numbers, is so many times this.
const RESPONSE_UNIT: f32 = 1.0 / (NORMAL_SCALE * RESPONSE_SCALE);
const SLOPE_UNIT: f32 = 1.0 / (NORMAL_SCALE * SLOPE_SCALE);

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use std::arch::x86_64::*;

    use super::{Block, Edges, LANES, Lanes, RESPONSE_UNIT, Reach, SLOPE_UNIT, STEP_PX};
    use crate::gradient::Gradient;

    /// What the points of a block are looked up in.
    struct Map<'a> {
        pixels: &'a [[i16; 2]],
        width: __m256i,
        /// The last pixel that has a neighbour to the right and two below.
        last: __m256i,
        /// One unit of its products with normals.
        unit: __m256,
    }

    /// Places of the points, px of the map, and their normals, each twice: of points 0, 1, 4, 5 and of 2, 3, 6, 7.
    struct Points {
        at: [__m256; 2],
        across: [__m256; 2],
        normals: [__m256i; 2],
    }

    #[target_feature(enable = "avx2")]
    fn load(lanes: &Lanes) -> __m256 {
        // SAFETY: the array has eight numbers, and the load asks for no alignment.
        unsafe { _mm256_loadu_ps(lanes.as_ptr()) }
    }

    #[target_feature(enable = "avx2")]
    fn store(value: __m256) -> Lanes {
        let mut lanes = [0.0; LANES];
        // SAFETY: as above.
        unsafe { _mm256_storeu_ps(lanes.as_mut_ptr(), value) };
        lanes
    }

    /// [`super::find_edges`] of blocks, for a gradient of at least a row and two pixels.
    #[target_feature(enable = "avx2")]
    pub(super) fn find(gradient: &Gradient, reach: &Reach, blocks: &[Block], edges: &mut Vec<Edges>) {
        let pixels = gradient.responses.len().min(gradient.slopes.len());
        let width = gradient.width;
        // Pixels `last` and `last + width`, and the ones to their right, lie within.
        let Some(last) = pixels.checked_sub(width + 2) else { return };
        let map = |pixels, unit| Map {
            pixels,
            width: _mm256_set1_epi32(width as i32),
            last: _mm256_set1_epi32(last as i32),
            unit: _mm256_set1_ps(unit),
        };
        let (responses, slopes) = (map(&gradient.responses, RESPONSE_UNIT), map(&gradient.slopes, SLOPE_UNIT));
        let corner = [gradient.left as f32, gradient.top as f32].map(|c| _mm256_set1_ps(c));
        let ends = [gradient.width as f32 - 1.0, gradient.height as f32 - 1.0].map(|c| _mm256_set1_ps(c));
        let (zero, step) = (_mm256_setzero_ps(), _mm256_set1_ps(STEP_PX));
        let radius = _mm256_set1_ps(reach.radius());
        for block in blocks {
            // SAFETY: eight pairs of 16 bits, and the load asks for no alignment.
            let normals = unsafe { _mm256_loadu_si256(block.normals.as_ptr().cast()) };
            let points = Points {
                at: [_mm256_sub_ps(load(&block.at[0]), corner[0]), _mm256_sub_ps(load(&block.at[1]), corner[1])],
                across: [load(&block.across[0]), load(&block.across[1])],
                normals: [_mm256_unpacklo_epi32(normals, normals), _mm256_unpackhi_epi32(normals, normals)],
            };
            let within = |axis: usize| {
                let at = points.at[axis];
                _mm256_and_ps(
                    _mm256_cmp_ps::<_CMP_GE_OQ>(_mm256_sub_ps(at, radius), zero),
                    _mm256_cmp_ps::<_CMP_LT_OQ>(_mm256_add_ps(at, radius), ends[axis]),
                )
            };
            let held = _mm256_and_ps(within(0), within(1));
            let (mut best, mut most, mut response) = (zero, _mm256_set1_ps(-1.0), zero);
            for k in (-reach.steps..=reach.steps).step_by(reach.stride as usize) {
                let offset = _mm256_set1_ps(k as f32 * STEP_PX);
                let (values, fu, fv) = corners(&responses, &points, offset);
                let squares = values.map(|value| _mm256_mul_ps(value, value));
                let between = mix(squares, fu, fv);
                let here = _mm256_mul_ps(between, between);
                let weighed = _mm256_mul_ps(here, _mm256_set1_ps(reach.weights[k.unsigned_abs() as usize]));
                let more = _mm256_cmp_ps::<_CMP_GT_OQ>(weighed, most);
                best = _mm256_blendv_ps(best, offset, more);
                most = _mm256_blendv_ps(most, weighed, more);
                response = _mm256_blendv_ps(response, here, more);
            }
            let across = |offset: __m256| {
                let (values, fu, fv) = corners(&slopes, &points, offset);
                _mm256_andnot_ps(_mm256_set1_ps(-0.0), mix(values, fu, fv))
            };
            let before = across(_mm256_sub_ps(best, step));
            let here = across(best);
            let after = across(_mm256_add_ps(best, step));
            let bend = _mm256_add_ps(_mm256_sub_ps(before, _mm256_mul_ps(_mm256_set1_ps(2.0), here)), after);
            let bends = _mm256_cmp_ps::<_CMP_LT_OQ>(bend, _mm256_set1_ps(-1e-6));
            let half = _mm256_set1_ps(0.5);
            let vertex = _mm256_div_ps(_mm256_mul_ps(half, _mm256_sub_ps(before, after)), bend);
            let vertex = _mm256_max_ps(_mm256_min_ps(vertex, half), _mm256_set1_ps(-0.5));
            let offset = _mm256_add_ps(best, _mm256_and_ps(bends, _mm256_mul_ps(vertex, step)));
            edges.push(Edges {
                offset: store(_mm256_and_ps(held, offset)),
                response: store(_mm256_and_ps(held, response)),
                held: store(_mm256_and_ps(held, _mm256_set1_ps(1.0))),
            });
        }
    }

    /// Products of the normals with the vectors at the four pixels around places along them, and the places between.
    #[inline]
    #[target_feature(enable = "avx2")]
    fn corners(map: &Map<'_>, points: &Points, offset: __m256) -> ([__m256; 4], __m256, __m256) {
        let [u, v] = [0, 1].map(|i| _mm256_add_ps(points.at[i], _mm256_mul_ps(offset, points.across[i])));
        let (column, row) = (_mm256_cvttps_epi32(u), _mm256_cvttps_epi32(v));
        let fu = _mm256_sub_ps(u, _mm256_cvtepi32_ps(column));
        let fv = _mm256_sub_ps(v, _mm256_cvtepi32_ps(row));
        let first = _mm256_add_epi32(_mm256_mullo_epi32(row, map.width), column);
        let upper = _mm256_min_epi32(_mm256_max_epi32(first, _mm256_setzero_si256()), map.last);
        let [a, b] = pairs(map, points, upper);
        let [c, d] = pairs(map, points, _mm256_add_epi32(upper, map.width));
        ([a, b, c, d], fu, fv)
    }

    /// Products of the normals with the vectors at some pixels and at those to their right.
    #[inline]
    #[target_feature(enable = "avx2")]
    fn pairs(map: &Map<'_>, points: &Points, indices: __m256i) -> [__m256; 2] {
        let (low, high) = (_mm256_castsi256_si128(indices), _mm256_extracti128_si256::<1>(indices));
        let base = map.pixels.as_ptr().cast::<i64>();
        // SAFETY: indices are within 0 and `map.last`, or a row below; that pixel and the next lie in `map.pixels`.
        let (even, odd) = unsafe {
            (
                _mm256_i32gather_epi64::<4>(base, _mm_unpacklo_epi64(low, high)),
                _mm256_i32gather_epi64::<4>(base, _mm_unpackhi_epi64(low, high)),
            )
        };
        let product = |pixels, normals| _mm256_mul_ps(_mm256_cvtepi32_ps(_mm256_madd_epi16(pixels, normals)), map.unit);
        let (even, odd) = (product(even, points.normals[0]), product(odd, points.normals[1]));
        [_mm256_shuffle_ps::<0b10_00_10_00>(even, odd), _mm256_shuffle_ps::<0b11_01_11_01>(even, odd)]
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    fn mix([a, b, c, d]: [__m256; 4], fu: __m256, fv: __m256) -> __m256 {
        let upper = _mm256_add_ps(a, _mm256_mul_ps(fu, _mm256_sub_ps(b, a)));
        let lower = _mm256_add_ps(c, _mm256_mul_ps(fu, _mm256_sub_ps(d, c)));
        _mm256_add_ps(upper, _mm256_mul_ps(fv, _mm256_sub_ps(lower, upper)))
    }
}

#[cfg(test)]
mod tests {
    use image::{Rgb, RgbImage};
    use proptest::prelude::*;

    use super::*;

    /// A disc brighter than the table, and a dark stripe.
    fn image() -> RgbImage {
        RgbImage::from_fn(80, 60, |x, y| {
            let (dx, dy) = (x as f32 - 30.3, y as f32 - 28.6);
            let stripe = (x + 2 * y) % 97 < 4;
            Rgb(if stripe {
                [20, 30, 25]
            } else if dx.hypot(dy) < 15.0 {
                [190, 160, 90]
            } else {
                [90, 95, 100]
            })
        })
    }

    /// A point, and the direction across it, rad.
    type Point = ([f32; 2], f32);

    fn block(points: &[Point]) -> Block {
        let of = |pick: fn(&Point) -> f32| -> Lanes { std::array::from_fn(|lane| points.get(lane).map_or(0.0, pick)) };
        let at = [of(|p| p.0[0]), of(|p| p.0[1])];
        Block::new(at, [of(|p| p.1.cos()), of(|p| p.1.sin())], [[0.0; LANES]; 3], of(|_| 1.0), [0.0; LANES])
    }

    #[test]
    fn the_rim_of_a_disc_is_found_from_points_beside_it() {
        let disc = RgbImage::from_fn(80, 60, |x, y| {
            Rgb([if (x as f32 - 30.0).hypot(y as f32 - 29.0) < 15.0 { 200 } else { 60 }; 3])
        });
        let gradient = Gradient::of_image(&disc);
        for k in 0..5 {
            let off = |lane: usize| (lane as f32 - 3.5) * 0.9;
            let point = |lane: usize| {
                let angle = (k * LANES + lane) as f32 * 0.157;
                let radius = 14.5 + off(lane);
                ([30.0 + radius * angle.cos(), 29.0 + radius * angle.sin()], angle)
            };
            let points: Vec<_> = (0..LANES).map(point).collect();
            let mut found = Vec::new();
            find_edges(&gradient, &Reach::new(5.0, 15.0), &[block(&points)], &mut found);
            for lane in 0..LANES {
                // A strong edge responds a pixel to either side of where it is, and the nearer weighs more.
                let left = found[0].offset[lane] + off(lane);
                assert!(left.abs() < 1.2 && found[0].response[lane] > 0.8, "{k} {lane}: {:?}", found[0]);
            }
        }
    }

    #[test]
    fn what_lies_at_the_end_of_the_frame_or_nowhere_finds_nothing() {
        let gradient = Gradient::of_image(&image());
        let places = [[2.0, 30.0], [40.0, 57.5], [-1e6, 3.0], [f32::NAN, 20.0], [40.0, f32::INFINITY], [40.0, 30.0]];
        let block = block(&places.map(|at| (at, 0.0)));
        let mut found = Vec::new();
        find_edges(&gradient, &Reach::new(3.0, 3.0), &[block], &mut found);
        assert_eq!(found[0].held, [0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]);
        assert!((0..LANES).all(|i| found[0].held[i] > 0.0 || (found[0].response[i], found[0].offset[i]) == (0.0, 0.0)));
        // Of a single pixel nothing can be read.
        let point = Gradient::of_image(&RgbImage::from_pixel(1, 1, Rgb([9; 3])));
        find_edges(&point, &Reach::new(3.0, 3.0), &[block; 2], &mut found);
        assert!(found.len() == 2 && found.iter().all(|edges| edges.held == [0.0; LANES]));
    }

    proptest! {
        #[test]
        fn every_path_finds_the_same(
            points in prop::collection::vec((-3.0f32..83.0, -3.0f32..63.0, -3.2f32..3.2), LANES),
            reach in 1.0f32..10.0,
        ) {
            let gradient = Gradient::of_image(&image());
            let points: Vec<_> = points.into_iter().map(|(u, v, angle)| ([u, v], angle)).collect();
            let block = block(&points);
            let reach = Reach::new(reach, 0.7 * reach);
            let mut found = Vec::new();
            find_edges(&gradient, &reach, &[block], &mut found);
            prop_assert_eq!(found[0], find_portable(&gradient, &reach, &block));
        }
    }
}
