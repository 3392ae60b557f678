//! Where in a piece of the frame there are edges of which direction, coarsely.
//!
//! In: a [`Gradient`]. Out: for every square cell a set of directions (8 bits, 22.5 degrees each, modulo 180)
//! of edges in it and around it. A point of a model finds an edge by one lookup.

use std::f32::consts::PI;

use crate::gradient::Gradient;

/// Directions told apart.
const BINS: usize = 8;
/// An edge has so many times the gradient of noise, and so many sRGB levels a pixel more.
const NOISE_RATIO: f32 = 2.0;
const LEAST_GRADIENT: f32 = 1.5;

/// Directions of edges, cell by cell.
#[derive(Debug, Default, Clone)]
pub(crate) struct OrientationMap {
    /// Side of a cell, px.
    pub(crate) cell_px: usize,
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Directions in the cell and its eight neighbours.
    pub(crate) bits: Vec<u8>,
    own: Vec<u8>,
}

impl OrientationMap {
    /// Reads the edges of a gradient at the pixels of `near`, row by row, that are not 0.
    pub(crate) fn fill(&mut self, gradient: &Gradient, near: &[u8], cell_px: usize) {
        self.cell_px = cell_px;
        self.width = gradient.width.div_ceil(cell_px);
        self.height = gradient.height.div_ceil(cell_px);
        self.own.clear();
        self.own.resize(self.width * self.height, 0);
        let least = NOISE_RATIO * gradient.noise + LEAST_GRADIENT;
        for y in 0..gradient.height {
            for x in 0..gradient.width {
                let i = y * gradient.width + x;
                if near[i] == 0 || gradient.dx[i].abs().max(gradient.dy[i].abs()) < 0.7 * least {
                    continue;
                }
                let Some((nx, ny, magnitude)) = gradient.ridge(x, y) else { continue };
                if magnitude >= least {
                    self.own[y / cell_px * self.width + x / cell_px] |= bit_of(nx, ny);
                }
            }
        }
        self.bits.clear();
        self.bits.resize(self.width * self.height, 0);
        for y in 0..self.height {
            for x in 0..self.width {
                let mut bits = 0;
                for row in y.saturating_sub(1)..=(y + 1).min(self.height - 1) {
                    for column in x.saturating_sub(1)..=(x + 1).min(self.width - 1) {
                        bits |= self.own[row * self.width + column];
                    }
                }
                self.bits[y * self.width + x] = bits;
            }
        }
    }
}

/// The bit of a direction across an edge.
fn bit_of(nx: f32, ny: f32) -> u8 {
    1 << bin_of(nx, ny)
}

fn bin_of(nx: f32, ny: f32) -> usize {
    ((ny.atan2(nx).rem_euclid(PI) / PI * BINS as f32) as usize) % BINS
}

/// The bits of a direction across an edge that may be off by half a bin.
pub(crate) fn bits_around(nx: f32, ny: f32) -> u8 {
    let at = ny.atan2(nx).rem_euclid(PI) / PI * BINS as f32;
    let bin = at as usize % BINS;
    let beside = if at.fract() < 0.5 { (bin + BINS - 1) % BINS } else { (bin + 1) % BINS };
    1 << bin | 1 << beside
}
