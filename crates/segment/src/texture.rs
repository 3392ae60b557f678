//! Noise and texture of the table, and the colour transform that makes the range bandwidth 1 in every direction.
//!
//! Wood grain varies between dark and light brown but never towards blue: the covariance of colour within small blocks
//! says along which colours the table itself varies, and how much. With `b` the range bandwidth, `k` the texture gain
//! and `C` that covariance, two colours are one bandwidth apart when `d^T (b^2 I + k^2 C)^-1 d = 1`. The inverse of the
//! Cholesky factor of the bracket maps colours to a space where that is the Euclidean distance.

use crate::working_image::{UNITS_PER_LEVEL, WorkingImage};

/// Side of the blocks within which colour variation counts as texture, working pixels.
const BLOCK: usize = 16;

/// Largest total variance that is taken for texture, levels squared: a deviation of 16 levels in each channel.
const MOST_TEXTURE: f32 = 3.0 * 16.0 * 16.0;

/// Covariance of the colour within blocks of the table, levels squared: rr, rg, rb, gg, gb, bb.
///
/// The table fills most blocks; those between the 20th and the 60th percentile of total variance stand for it, so
/// that neither parts nor burnt-out corners count.
pub(crate) fn table_covariance(image: &WorkingImage, blocks: &mut Vec<[f32; 7]>) -> [f32; 6] {
    blocks.clear();
    let (bw, bh) = (BLOCK.min(image.width), BLOCK.min(image.height));
    for by in (0..=image.height - bh).step_by(bh) {
        for bx in (0..=image.width - bw).step_by(bw) {
            let (mut s, mut q) = ([0f32; 3], [0f32; 6]);
            // Every second row of a block is enough for a covariance that is averaged over hundreds of blocks.
            let origin = image.rgb[by * image.width + bx].map(f32::from);
            let mut n = 0f32;
            for y in (by..by + bh).step_by(2) {
                for p in &image.rgb[y * image.width + bx..y * image.width + bx + bw] {
                    let [r, g, b] = [0, 1, 2].map(|c| f32::from(p[c]) - origin[c]);
                    s[0] += r;
                    s[1] += g;
                    s[2] += b;
                    q[0] += r * r;
                    q[1] += r * g;
                    q[2] += r * b;
                    q[3] += g * g;
                    q[4] += g * b;
                    q[5] += b * b;
                    n += 1.0;
                }
            }
            let mean = s.map(|v| v / n);
            let scale = 1.0 / f32::from(UNITS_PER_LEVEL * UNITS_PER_LEVEL);
            let of = |k: usize, i: usize, j: usize| (q[k] / n - mean[i] * mean[j]) * scale;
            let cov = [of(0, 0, 0), of(1, 0, 1), of(2, 0, 2), of(3, 1, 1), of(4, 1, 2), of(5, 2, 2)];
            blocks.push([cov[0] + cov[3] + cov[5], cov[0], cov[1], cov[2], cov[3], cov[4], cov[5]]);
        }
    }
    blocks.sort_unstable_by(|a, b| a[0].total_cmp(&b[0]));
    let (from, to) = (blocks.len() / 5, (blocks.len() * 3 / 5).max(blocks.len() / 5 + 1));
    let mut covariance = [0f32; 6];
    for block in &blocks[from..to] {
        for (c, b) in covariance.iter_mut().zip(&block[1..]) {
            *c += b / (to - from) as f32;
        }
    }
    // Beyond that it is no texture but a part as large as the blocks, in a small image.
    let total = covariance[0] + covariance[3] + covariance[5];
    if total > MOST_TEXTURE {
        covariance = covariance.map(|c| c * MOST_TEXTURE / total);
    }
    covariance
}

/// A lower triangular map of colours, in levels, to a space where the range bandwidth is 1.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Whitening {
    rows: [[f32; 3]; 3],
}

impl Whitening {
    /// The map for a range bandwidth in levels, a texture gain and the covariance of the table.
    pub(crate) fn new(range_bandwidth: f32, texture_gain: f32, covariance: [f32; 6]) -> Self {
        let (floor, gain) = (range_bandwidth * range_bandwidth, texture_gain * texture_gain);
        let [rr, rg, rb, gg, gb, bb] = covariance.map(|c| c * gain);
        // Cholesky factor L of (b^2 I + k^2 C), positive definite because b >= 1.
        let l00 = (rr + floor).sqrt();
        let l10 = rg / l00;
        let l20 = rb / l00;
        let l11 = (gg + floor - l10 * l10).max(floor * 0.5).sqrt();
        let l21 = (gb - l20 * l10) / l11;
        let l22 = (bb + floor - l20 * l20 - l21 * l21).max(floor * 0.5).sqrt();
        // Its inverse, by forward substitution.
        let (a00, a11, a22) = (1.0 / l00, 1.0 / l11, 1.0 / l22);
        let a10 = -l10 * a00 * a11;
        let a21 = -l21 * a11 * a22;
        let a20 = -(l20 * a00 + l21 * a10) * a22;
        Self { rows: [[a00, 0.0, 0.0], [a10, a11, 0.0], [a20, a21, a22]] }
    }

    /// The whitened colour of one in levels; linear, so it serves differences as well.
    pub(crate) fn apply(&self, rgb: [f32; 3]) -> [f32; 3] {
        let [a, b, c] = self.rows;
        [a[0] * rgb[0], b[0] * rgb[0] + b[1] * rgb[1], c[0] * rgb[0] + c[1] * rgb[1] + c[2] * rgb[2]]
    }
}
