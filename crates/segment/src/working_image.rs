//! The image at the resolution of the mode search: box averages of `reduction` x `reduction` pixels.

use rayon::prelude::*;

use crate::partition::RgbView;

/// Colours are kept in sixteenths of a level: an average of many pixels carries more than 8 bits.
pub(crate) const UNITS_PER_LEVEL: u16 = 16;

/// RGB averages of square blocks, the blocks at the right and lower edge cut off by the image.
#[derive(Debug, Default)]
pub(crate) struct WorkingImage {
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Side of a block, px of the image.
    pub(crate) reduction: usize,
    /// Interleaved R, G, B in sixteenths of a level.
    pub(crate) rgb: Vec<[u16; 3]>,
}

impl WorkingImage {
    /// Becomes the same as another one, in its own memory.
    pub(crate) fn copy_from(&mut self, other: &Self) {
        (self.width, self.height, self.reduction) = (other.width, other.height, other.reduction);
        self.rgb.clone_from(&other.rgb);
    }

    /// Reduces `image` by `reduction` (at least 1).
    pub(crate) fn fill(&mut self, image: &RgbView<'_>, reduction: usize) {
        let (w, h) = (image.width() as usize, image.height() as usize);
        self.reduction = reduction;
        self.width = w.div_ceil(reduction);
        self.height = h.div_ceil(reduction);
        self.rgb.resize(self.width * self.height, [0; 3]);
        let bytes: &[u8] = image.as_raw();
        self.rgb.par_chunks_mut(self.width).enumerate().with_min_len(8).for_each(|(row, out)| {
            let y0 = row * reduction;
            let y1 = (y0 + reduction).min(h);
            if reduction == 1 {
                for (o, p) in out.iter_mut().zip(bytes[y0 * w * 3..].chunks_exact(3)) {
                    *o = [p[0], p[1], p[2]].map(|c| u16::from(c) * UNITS_PER_LEVEL);
                }
            } else if reduction == 2 && y1 == y0 + 2 {
                let upper = &bytes[y0 * w * 3..(y0 + 1) * w * 3];
                let lower = &bytes[(y0 + 1) * w * 3..(y0 + 2) * w * 3];
                for ((o, a), b) in out.iter_mut().zip(upper.chunks_exact(6)).zip(lower.chunks_exact(6)) {
                    for c in 0..3 {
                        let sum = u16::from(a[c]) + u16::from(a[c + 3]) + u16::from(b[c]) + u16::from(b[c + 3]);
                        o[c] = sum * (UNITS_PER_LEVEL / 4);
                    }
                }
                if w % 2 == 1 {
                    out[self.width - 1] = block_mean(bytes, w, w - 1..w, y0..y1);
                }
            } else {
                for (column, o) in out.iter_mut().enumerate() {
                    let x0 = column * reduction;
                    *o = block_mean(bytes, w, x0..(x0 + reduction).min(w), y0..y1);
                }
            }
        });
    }
}

fn block_mean(bytes: &[u8], width: usize, xs: std::ops::Range<usize>, ys: std::ops::Range<usize>) -> [u16; 3] {
    let mut sum = [0u32; 3];
    let n = (xs.len() * ys.len()) as u32;
    for y in ys {
        for p in bytes[(y * width + xs.start) * 3..(y * width + xs.end) * 3].chunks_exact(3) {
            for (s, &c) in sum.iter_mut().zip(p) {
                *s += u32::from(c);
            }
        }
    }
    sum.map(|s| ((s * u32::from(UNITS_PER_LEVEL) + n / 2) / n) as u16)
}
