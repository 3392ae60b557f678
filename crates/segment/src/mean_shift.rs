//! The mode search: for every pixel, the mode of the joint spatial-range density that its trajectory climbs to.
//!
//! The kernel is flat: a disc of `radius` pixels in the plane times a ball of [`BANDWIDTH`] units in whitened colour.
//! A trajectory starts at its pixel and moves to the mean of all pixels under the kernel until it stays. Positions and
//! colours are rounded to whole pixels and units, so trajectories are finite and every path of execution gives the
//! same modes.
//!
//! Trajectories start on a lattice of every fourth pixel, then of every second, then on all. From the second lattice on
//! a pixel between lattice pixels of one mode, itself within the kernel of that mode, inherits it; any other starts a
//! trajectory, which ends where it comes to a lattice pixel whose mode it has nearly reached. On a table one pixel in
//! ten needs a trajectory of its own.

use rayon::prelude::*;

use crate::texture::Whitening;
use crate::working_image::{UNITS_PER_LEVEL, WorkingImage};

/// One range bandwidth in units of whitened colour.
pub(crate) const BANDWIDTH: i16 = 64;
/// Largest radius of the disc: its rows then fit the lanes.
pub(crate) const MAX_RADIUS: usize = 7;
/// Modes closer than this are one mode, in units.
const SAME: i16 = BANDWIDTH / 4;
/// A pixel inherits a mode whose colour is closer than this to its own, in units.
const WITHIN_KERNEL: i16 = BANDWIDTH;
/// Distances, in pixels, of the lattices, each half of the one before.
const LATTICES: [usize; 3] = [4, 2, 1];
/// Shifts after which a trajectory that circles between roundings is stopped.
const MAX_SHIFTS: usize = 12;
/// Columns of the window: `x - 8 ..= x + 7`, one AVX2 register of 16-bit numbers.
const LANES: usize = 16;
const HALF: usize = LANES / 2;
/// Border around the planes; window rows never leave it.
const PAD: usize = HALF;
/// Colour of the border: farther than any bandwidth from every colour.
const NOWHERE: i16 = i16::MAX;
/// Component distances are clipped here: beyond the bandwidth, and three squares still fit 16 bits.
const CLIP: i16 = 104;
/// Squared range bandwidth.
const WITHIN: i16 = BANDWIDTH * BANDWIDTH;

/// Whitened colour planes with a border, and the modes.
#[derive(Debug, Default)]
pub(crate) struct MeanShift {
    width: usize,
    height: usize,
    stride: usize,
    planes: [Vec<i16>; 3],
    /// The modes of the lattice before.
    known: Vec<[i16; 3]>,
    /// The whitened colour of the mode of every pixel, row by row.
    pub(crate) modes: Vec<[i16; 3]>,
}

/// Sums over the window.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Shift {
    count: i32,
    x: i32,
    y: i32,
    colour: [i32; 3],
}

impl MeanShift {
    /// The whitened colour of working pixel (x, y), in units.
    pub(crate) fn colour(&self, x: usize, y: usize) -> [i16; 3] {
        let i = (y + PAD) * self.stride + x + PAD;
        [self.planes[0][i], self.planes[1][i], self.planes[2][i]]
    }

    /// Where row `row` of the window around (x, y) starts in the planes.
    #[inline(always)]
    fn window_row(&self, disc: &Disc, x: usize, y: usize, row: usize) -> usize {
        (y + PAD + row - disc.radius) * self.stride + x + PAD - HALF
    }

    /// Finds the mode of every pixel of `image` with a disc of `radius` (1 to [`MAX_RADIUS`]) working pixels.
    pub(crate) fn search(&mut self, image: &WorkingImage, whitening: &Whitening, radius: f32) {
        self.whiten(image, whitening);
        let disc = Disc::new(radius);
        let [mut known, mut modes] = [&mut self.known, &mut self.modes].map(std::mem::take);
        modes.clear();
        for step in LATTICES {
            std::mem::swap(&mut known, &mut modes);
            self.search_lattice(&disc, step, &known, &mut modes);
        }
        (self.known, self.modes) = (known, modes);
    }

    /// Finds the modes of the lattice of distance `step` into `modes`, given those of the lattice of twice that
    /// distance (none for the first).
    fn search_lattice(&self, disc: &Disc, step: usize, known: &[[i16; 3]], modes: &mut Vec<[i16; 3]>) {
        let columns = self.width.div_ceil(step);
        modes.resize(columns * self.height.div_ceil(step), [0; 3]);
        modes.par_chunks_mut(columns).enumerate().for_each(|(row, modes)| {
            let lattice = Lattice { step, modes: known, columns: self.width.div_ceil(2 * step) };
            #[cfg(target_arch = "x86_64")]
            if std::arch::is_x86_feature_detected!("avx2") {
                // SAFETY: the processor was just found to have AVX2, the only feature the function asks for.
                unsafe { search_row_avx2(self, disc, &lattice, row, modes) };
                return;
            }
            search_row(self, disc, &lattice, row, modes, window);
        });
    }

    fn whiten(&mut self, image: &WorkingImage, whitening: &Whitening) {
        (self.width, self.height) = (image.width, image.height);
        // The window reads LANES columns from x - 8 on, so the stride ends a full window behind the last pixel.
        self.stride = image.width + 2 * PAD;
        let size = self.stride * (image.height + 2 * PAD);
        let (width, stride) = (self.width, self.stride);
        for plane in &mut self.planes {
            if plane.len() != size {
                plane.clear();
                plane.resize(size, NOWHERE);
            }
        }
        let unit = f32::from(BANDWIDTH) / f32::from(UNITS_PER_LEVEL);
        let [p0, p1, p2] = &mut self.planes;
        p0.par_chunks_mut(stride)
            .zip(p1.par_chunks_mut(stride))
            .zip(p2.par_chunks_mut(stride))
            .enumerate()
            .with_min_len(8)
            .for_each(|(row, ((r0, r1), r2))| {
                let inside = row.checked_sub(PAD).filter(|&y| y < image.height);
                let Some(y) = inside else {
                    for r in [r0, r1, r2] {
                        r.fill(NOWHERE);
                    }
                    return;
                };
                for r in [&mut *r0, &mut *r1, &mut *r2] {
                    r[..PAD].fill(NOWHERE);
                    r[PAD + width..].fill(NOWHERE);
                }
                let colours = &image.rgb[y * width..(y + 1) * width];
                for (x, rgb) in colours.iter().enumerate() {
                    let w = whitening.apply(rgb.map(|c| f32::from(c) * unit));
                    r0[PAD + x] = w[0].round() as i16;
                    r1[PAD + x] = w[1].round() as i16;
                    r2[PAD + x] = w[2].round() as i16;
                }
            });
    }
}

/// Which lanes of every window row lie in the disc: -1 inside, 0 outside.
struct Disc {
    radius: usize,
    rows: [[i16; LANES]; 2 * MAX_RADIUS + 1],
}

impl Disc {
    fn new(radius: f32) -> Self {
        let whole = (radius as usize).clamp(1, MAX_RADIUS);
        let limit = radius.max(1.0) * radius.max(1.0);
        let mut rows = [[0; LANES]; 2 * MAX_RADIUS + 1];
        for (row, lanes) in rows.iter_mut().enumerate().take(2 * whole + 1) {
            let dy = row as f32 - whole as f32;
            for (lane, inside) in lanes.iter_mut().enumerate() {
                let dx = lane as f32 - HALF as f32;
                if dx * dx + dy * dy <= limit && dx.abs() <= whole as f32 {
                    *inside = -1;
                }
            }
        }
        Self { radius: whole, rows }
    }
}

/// The modes that are known when a lattice of distance `step` is searched: those of twice that distance.
struct Lattice<'a> {
    step: usize,
    modes: &'a [[i16; 3]],
    columns: usize,
}

impl Lattice<'_> {
    /// The mode that the pixel in `column` and `row` of the lattice being searched inherits, if its neighbours agree.
    #[inline(always)]
    fn inherited(&self, column: usize, row: usize, colour: [i16; 3]) -> Option<[i16; 3]> {
        let last_row = self.modes.len() / self.columns - 1;
        let (left, right) = (column / 2, column.div_ceil(2).min(self.columns - 1));
        let (upper, lower) = (row / 2, row.div_ceil(2).min(last_row));
        let mode = self.modes[upper * self.columns + left];
        let agree = distance_within(mode, colour, WITHIN_KERNEL)
            && distance_within(mode, self.modes[upper * self.columns + right], SAME)
            && distance_within(mode, self.modes[lower * self.columns + left], SAME)
            && distance_within(mode, self.modes[lower * self.columns + right], SAME);
        agree.then_some(mode)
    }

    /// The known mode nearest to pixel (x, y), if it is nearly `colour`.
    #[inline(always)]
    fn reached(&self, x: usize, y: usize, colour: [i16; 3]) -> Option<[i16; 3]> {
        let apart = 2 * self.step;
        let column = ((x + self.step) / apart).min(self.columns - 1);
        let row = ((y + self.step) / apart).min(self.modes.len() / self.columns - 1);
        let mode = self.modes[row * self.columns + column];
        distance_within(mode, colour, SAME).then_some(mode)
    }
}

/// Whether two whitened colours are at most `limit` units apart.
#[inline(always)]
pub(crate) fn distance_within(a: [i16; 3], b: [i16; 3], limit: i16) -> bool {
    let squared: i32 = (0..3).map(|c| i32::from(a[c]) - i32::from(b[c])).map(|d| d * d).sum();
    squared <= i32::from(limit) * i32::from(limit)
}

/// Sums over the window around a pixel and a colour: the one step that each processor does in its own way.
trait Window: Fn(&MeanShift, &Disc, usize, usize, [i16; 3]) -> Shift {}

impl<F: Fn(&MeanShift, &Disc, usize, usize, [i16; 3]) -> Shift> Window for F {}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn search_row_avx2(space: &MeanShift, disc: &Disc, lattice: &Lattice<'_>, row: usize, modes: &mut [[i16; 3]]) {
    let window =
        |space: &MeanShift, disc: &Disc, x: usize, y: usize, colour: [i16; 3]| avx2::window(space, disc, x, y, colour);
    search_row(space, disc, lattice, row, modes, window);
}

#[inline(always)]
fn search_row(
    space: &MeanShift,
    disc: &Disc,
    lattice: &Lattice<'_>,
    row: usize,
    modes: &mut [[i16; 3]],
    window: impl Window,
) {
    let y = row * lattice.step;
    for (column, mode) in modes.iter_mut().enumerate() {
        let x = column * lattice.step;
        let colour = space.colour(x, y);
        if lattice.modes.is_empty() {
            *mode = climb(space, disc, x, y, colour, &window, |_, _, _| None);
        } else if row.is_multiple_of(2) && column.is_multiple_of(2) {
            *mode = lattice.modes[row / 2 * lattice.columns + column / 2];
        } else {
            *mode = lattice.inherited(column, row, colour).unwrap_or_else(|| {
                climb(space, disc, x, y, colour, &window, |x, y, colour| lattice.reached(x, y, colour))
            });
        }
    }
}

/// Follows the trajectory from (x, y) and `colour` to its mode, or to a known mode that it has `reached`.
#[inline(always)]
fn climb(
    space: &MeanShift,
    disc: &Disc,
    mut x: usize,
    mut y: usize,
    mut colour: [i16; 3],
    window: &impl Window,
    reached: impl Fn(usize, usize, [i16; 3]) -> Option<[i16; 3]>,
) -> [i16; 3] {
    for _ in 0..MAX_SHIFTS {
        let shift = window(space, disc, x, y, colour);
        if shift.count == 0 {
            break;
        }
        let n = 1.0 / shift.count as f32;
        let move_by = |sum: i32| (sum as f32 * n).round_ties_even() as i32;
        let (dx, dy) = (move_by(shift.x), move_by(shift.y));
        let dc = shift.colour.map(|s| move_by(s) as i16);
        x = (x as i32 + dx) as usize;
        y = (y as i32 + dy) as usize;
        for (c, d) in colour.iter_mut().zip(dc) {
            *c += d;
        }
        if dx == 0 && dy == 0 && dc.iter().all(|d| d.abs() <= 1) {
            break;
        }
        if let Some(mode) = reached(x, y, colour) {
            return mode;
        }
    }
    colour
}

/// One mean shift: sums of offsets over the pixels under the kernel centred on (x, y) and `colour`. The portable path.
fn window(space: &MeanShift, disc: &Disc, x: usize, y: usize, colour: [i16; 3]) -> Shift {
    let mut shift = Shift::default();
    for row in 0..=2 * disc.radius {
        let at = space.window_row(disc, x, y, row);
        let lines = [0, 1, 2].map(|c| &space.planes[c][at..at + LANES]);
        for (lane, &inside) in disc.rows[row].iter().enumerate() {
            let offset = [0, 1, 2].map(|c| lines[c][lane].saturating_sub(colour[c]));
            let clipped = offset.map(|d| i32::from(d.saturating_abs().min(CLIP)));
            let distance: i32 = clipped.iter().map(|d| d * d).sum();
            if inside != 0 && distance <= i32::from(WITHIN) {
                shift.count += 1;
                shift.x += lane as i32 - HALF as i32;
                shift.y += row as i32 - disc.radius as i32;
                for (sum, d) in shift.colour.iter_mut().zip(offset) {
                    *sum += i32::from(d);
                }
            }
        }
    }
    shift
}

/// The window in AVX2 registers: a row of 16 pixels at a time.
#[cfg(target_arch = "x86_64")]
mod avx2 {
    use std::arch::x86_64::*;

    use super::{CLIP, Disc, LANES, MeanShift, Shift, WITHIN};

    #[target_feature(enable = "avx2")]
    fn load(lanes: &[i16; LANES]) -> __m256i {
        // SAFETY: the array is 32 bytes long and the load needs no alignment.
        unsafe { _mm256_loadu_si256(lanes.as_ptr().cast()) }
    }

    /// The same sums as [`super::window`].
    #[inline]
    #[target_feature(enable = "avx2")]
    pub(super) fn window(space: &MeanShift, disc: &Disc, x: usize, y: usize, colour: [i16; 3]) -> Shift {
        let (clip, within) = (_mm256_set1_epi16(CLIP), _mm256_set1_epi16(WITHIN));
        let center = [0, 1, 2].map(|c| _mm256_set1_epi16(colour[c]));
        let zero = _mm256_setzero_si256();
        let (mut count, mut sum_y, mut sums) = (zero, zero, [zero; 3]);
        let mut dy = _mm256_set1_epi16(-(disc.radius as i16));
        let one = _mm256_set1_epi16(1);
        for (row, inside) in disc.rows[..=2 * disc.radius].iter().enumerate() {
            let at = space.window_row(disc, x, y, row);
            let mut distance = zero;
            let mut offsets = [zero; 3];
            for c in 0..3 {
                let Some(line) = space.planes[c].get(at..).and_then(|l| l.first_chunk()) else { continue };
                let offset = _mm256_subs_epi16(load(line), center[c]);
                // The unsigned minimum takes |-32768|, which stays negative, for the large number that it is.
                let clipped = _mm256_min_epu16(_mm256_abs_epi16(offset), clip);
                distance = _mm256_add_epi16(distance, _mm256_mullo_epi16(clipped, clipped));
                offsets[c] = offset;
            }
            let under = _mm256_andnot_si256(_mm256_cmpgt_epi16(distance, within), load(inside));
            count = _mm256_sub_epi16(count, under);
            sum_y = _mm256_add_epi16(sum_y, _mm256_and_si256(under, dy));
            for (sum, offset) in sums.iter_mut().zip(offsets) {
                *sum = _mm256_add_epi16(*sum, _mm256_and_si256(under, offset));
            }
            dy = _mm256_add_epi16(dy, one);
        }
        let columns = _mm256_setr_epi16(-8, -7, -6, -5, -4, -3, -2, -1, 0, 1, 2, 3, 4, 5, 6, 7);
        let [count, x, y, r] = add_lanes([
            _mm256_madd_epi16(count, one),
            _mm256_madd_epi16(count, columns),
            _mm256_madd_epi16(sum_y, one),
            _mm256_madd_epi16(sums[0], one),
        ]);
        let [g, b, ..] = add_lanes([_mm256_madd_epi16(sums[1], one), _mm256_madd_epi16(sums[2], one), zero, zero]);
        Shift { count, x, y, colour: [r, g, b] }
    }

    /// The sums over the eight 32-bit lanes of four registers.
    #[target_feature(enable = "avx2")]
    fn add_lanes([a, b, c, d]: [__m256i; 4]) -> [i32; 4] {
        let halves = _mm256_hadd_epi32(_mm256_hadd_epi32(a, b), _mm256_hadd_epi32(c, d));
        let sum = _mm_add_epi32(_mm256_castsi256_si128(halves), _mm256_extracti128_si256(halves, 1));
        [_mm_extract_epi32(sum, 0), _mm_extract_epi32(sum, 1), _mm_extract_epi32(sum, 2), _mm_extract_epi32(sum, 3)]
    }
}

#[cfg(all(test, target_arch = "x86_64"))]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// Both paths sum the same integers, for every kernel, at borders and for colours far from any pixel.
        #[test]
        fn the_avx2_window_sums_what_the_portable_one_sums(
            width in 1usize..40,
            height in 1usize..24,
            radius in 1.0f32..8.0,
            levels in prop::collection::vec(0u16..=4080, 40 * 24 * 3),
            center in prop::array::uniform3(-300i16..300),
        ) {
            if !std::arch::is_x86_feature_detected!("avx2") {
                return Ok(());
            }
            let rgb = levels.chunks_exact(3).take(width * height).map(|c| [c[0], c[1], c[2]]).collect();
            let image = WorkingImage { width, height, reduction: 1, rgb };
            let whitening = Whitening::new(6.0, 2.0, [9.0, 3.0, 0.0, 16.0, -2.0, 4.0]);
            let mut space = MeanShift::default();
            space.whiten(&image, &whitening);
            let disc = Disc::new(radius);
            for y in 0..height {
                for x in 0..width {
                    for colour in [space.colour(x, y), center] {
                        // SAFETY: AVX2 was detected above.
                        let fast = unsafe { avx2::window(&space, &disc, x, y, colour) };
                        prop_assert_eq!(fast, window(&space, &disc, x, y, colour));
                    }
                }
            }
        }
    }
}
