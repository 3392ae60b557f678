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
const WITHIN_KERNEL: i16 = BANDWIDTH * 3 / 4;
/// Distances, in pixels, of the first and the second lattice.
const COARSE: usize = 4;
const MIDDLE: usize = 2;
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

/// Whitened colour planes with a border, and the modes.
#[derive(Debug, Default)]
pub(crate) struct MeanShift {
    width: usize,
    height: usize,
    stride: usize,
    planes: [Vec<i16>; 3],
    coarse: Vec<[i16; 3]>,
    middle: Vec<[i16; 3]>,
    /// The whitened colour of the mode of every pixel, row by row.
    pub(crate) modes: Vec<[i16; 3]>,
}

/// Sums over the window.
#[derive(Clone, Copy, Default)]
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

    /// Finds the mode of every pixel of `image` with a disc of `radius` (1 to [`MAX_RADIUS`]) working pixels.
    pub(crate) fn search(&mut self, image: &WorkingImage, whitening: &Whitening, radius: f32) {
        self.whiten(image, whitening);
        let disc = Disc::new(radius);
        let [mut coarse, mut middle, mut modes] =
            [&mut self.coarse, &mut self.middle, &mut self.modes].map(std::mem::take);
        self.search_lattice(&disc, COARSE, &[], &mut coarse);
        self.search_lattice(&disc, MIDDLE, &coarse, &mut middle);
        self.search_lattice(&disc, 1, &middle, &mut modes);
        (self.coarse, self.middle, self.modes) = (coarse, middle, modes);
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
            search_row(self, disc, &lattice, row, modes);
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

#[inline(always)]
fn distance_within(a: [i16; 3], b: [i16; 3], limit: i16) -> bool {
    let squared: i32 = (0..3).map(|c| i32::from(a[c]) - i32::from(b[c])).map(|d| d * d).sum();
    squared <= i32::from(limit) * i32::from(limit)
}

/// The same code as [`search_row`], compiled for AVX2: integer arithmetic, so the same modes.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,bmi1,bmi2,popcnt,lzcnt")]
fn search_row_avx2(space: &MeanShift, disc: &Disc, lattice: &Lattice<'_>, row: usize, modes: &mut [[i16; 3]]) {
    search_row(space, disc, lattice, row, modes);
}

#[inline(always)]
fn search_row(space: &MeanShift, disc: &Disc, lattice: &Lattice<'_>, row: usize, modes: &mut [[i16; 3]]) {
    let y = row * lattice.step;
    for (column, mode) in modes.iter_mut().enumerate() {
        let x = column * lattice.step;
        let colour = space.colour(x, y);
        if lattice.modes.is_empty() {
            *mode = climb(space, disc, x, y, colour, |_, _, _| None);
        } else if row % 2 == 0 && column % 2 == 0 {
            *mode = lattice.modes[row / 2 * lattice.columns + column / 2];
        } else {
            *mode = lattice
                .inherited(column, row, colour)
                .unwrap_or_else(|| climb(space, disc, x, y, colour, |x, y, colour| lattice.reached(x, y, colour)));
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

/// One mean shift: sums of offsets over the pixels under the kernel centred on (x, y) and `colour`.
#[inline(always)]
fn window(space: &MeanShift, disc: &Disc, x: usize, y: usize, colour: [i16; 3]) -> Shift {
    let radius = disc.radius;
    let (mut count, mut sum_y) = ([0i16; LANES], [0i16; LANES]);
    let mut sums = [[0i16; LANES]; 3];
    const WITHIN: i16 = BANDWIDTH * BANDWIDTH;
    for row in 0..=2 * radius {
        let at = (y + PAD + row - radius) * space.stride + x + PAD - HALF;
        let mut distance = [0i16; LANES];
        let mut offsets = [[0i16; LANES]; 3];
        for c in 0..3 {
            let line = &space.planes[c][at..at + LANES];
            for lane in 0..LANES {
                let d = line[lane].saturating_sub(colour[c]);
                offsets[c][lane] = d;
                let a = d.saturating_abs().min(CLIP);
                distance[lane] += a * a;
            }
        }
        let inside = &disc.rows[row];
        let dy = row as i16 - radius as i16;
        for lane in 0..LANES {
            let under = if distance[lane] <= WITHIN { inside[lane] } else { 0 };
            count[lane] -= under;
            sum_y[lane] += under & dy;
            for c in 0..3 {
                sums[c][lane] += under & offsets[c][lane];
            }
        }
    }
    let mut shift = Shift::default();
    for lane in 0..LANES {
        shift.count += i32::from(count[lane]);
        shift.x += i32::from(count[lane]) * (lane as i32 - HALF as i32);
        shift.y += i32::from(sum_y[lane]);
        for c in 0..3 {
            shift.colour[c] += i32::from(sums[c][lane]);
        }
    }
    shift
}
