//! Boundaries at full resolution: a pixel of a working pixel at a boundary goes to the side whose colour it has.

use rayon::prelude::*;

use crate::mean_shift::BANDWIDTH;
use crate::partition::RgbView;
use crate::texture::Whitening;

/// Labels and modes at working resolution.
pub(crate) struct Coarse<'a> {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) reduction: usize,
    pub(crate) labels: &'a [u32],
    pub(crate) modes: &'a [[i16; 3]],
}

/// Fills `labels`, one a pixel of `image`, from the coarse ones.
///
/// Inside a partition the coarse label holds. In a working pixel with a neighbour of another label, every pixel
/// chooses among the labels of its 3 x 3 working pixels the one whose mode there is closest in whitened colour.
pub(crate) fn refine(image: &RgbView<'_>, whitening: &Whitening, coarse: &Coarse<'_>, labels: &mut Vec<u32>) {
    let (w, h) = (image.width() as usize, image.height() as usize);
    labels.resize(w * h, 0);
    let r = coarse.reduction;
    if r == 1 {
        labels.copy_from_slice(coarse.labels);
        return;
    }
    let bytes: &[u8] = image.as_raw();
    labels.par_chunks_mut(w * r).enumerate().with_min_len(4).for_each(|(cy, out)| {
        let rows = out.len() / w;
        let y_range = cy.saturating_sub(1)..(cy + 2).min(coarse.height);
        for cx in 0..coarse.width {
            let own = coarse.labels[cy * coarse.width + cx];
            let x_range = cx.saturating_sub(1)..(cx + 2).min(coarse.width);
            let (x0, x1) = (cx * r, ((cx + 1) * r).min(w));
            // The candidates: every label around, with the mode that the working pixel nearest to it has.
            let mut candidates = [(0u32, [0i16; 3]); 9];
            let mut count = 0;
            let mut push = |i: usize| {
                let label = coarse.labels[i];
                if !candidates[..count].iter().any(|c: &(u32, _)| c.0 == label) {
                    candidates[count] = (label, coarse.modes[i]);
                    count += 1;
                }
            };
            push(cy * coarse.width + cx);
            for y in y_range.clone() {
                for x in x_range.clone() {
                    push(y * coarse.width + x);
                }
            }
            if count == 1 {
                for row in 0..rows {
                    out[row * w + x0..row * w + x1].fill(own);
                }
                continue;
            }
            for row in 0..rows {
                for x in x0..x1 {
                    let at = ((cy * r + row) * w + x) * 3;
                    let rgb = [bytes[at], bytes[at + 1], bytes[at + 2]];
                    let colour = whitening.apply(rgb.map(|c| f32::from(c) * f32::from(BANDWIDTH)));
                    let mut best = (f32::INFINITY, own);
                    for &(label, mode) in &candidates[..count] {
                        let d: f32 = (0..3).map(|c| colour[c] - f32::from(mode[c])).map(|d| d * d).sum();
                        if d < best.0 {
                            best = (d, label);
                        }
                    }
                    out[row * w + x] = best.1;
                }
            }
        }
    });
}
