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

impl Coarse<'_> {
    fn row(&self, y: usize) -> &[u32] {
        &self.labels[y * self.width..(y + 1) * self.width]
    }

    /// The labels of the 3 x 3 working pixels around (x, y), each once and its own first, with the mode that the first
    /// pixel of that label has.
    fn candidates(&self, x: usize, y: usize) -> Candidates {
        let mut found = Candidates { count: 0, list: [(0, [0; 3]); 9] };
        let mut push = |i: usize| {
            let label = self.labels[i];
            if !found.list[..found.count].iter().any(|c| c.0 == label) {
                found.list[found.count] = (label, self.modes[i]);
                found.count += 1;
            }
        };
        push(y * self.width + x);
        for y in y.saturating_sub(1)..(y + 2).min(self.height) {
            for x in x.saturating_sub(1)..(x + 2).min(self.width) {
                push(y * self.width + x);
            }
        }
        found
    }
}

struct Candidates {
    count: usize,
    list: [(u32, [i16; 3]); 9],
}

impl Candidates {
    /// The label whose mode is closest to a whitened colour.
    fn closest(&self, colour: [f32; 3]) -> u32 {
        let mut best = (f32::INFINITY, self.list[0].0);
        for &(label, mode) in &self.list[..self.count] {
            let d: f32 = (0..3).map(|c| colour[c] - f32::from(mode[c])).map(|d| d * d).sum();
            if d < best.0 {
                best = (d, label);
            }
        }
        best.1
    }
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
    labels.par_chunks_mut(w * r).enumerate().with_min_len(4).for_each(|(y, out)| {
        let line = coarse.row(y);
        let (above, below) = (coarse.row(y.saturating_sub(1)), coarse.row((y + 1).min(coarse.height - 1)));
        let mut start = 0;
        for run in line.chunk_by(|a, b| a == b) {
            let end = start + run.len();
            for row in out.chunks_exact_mut(w) {
                row[start * r..(end * r).min(w)].fill(run[0]);
            }
            start = end;
        }
        // Whether a column of three working pixels has one label.
        let plain = |x: usize| above[x] == line[x] && below[x] == line[x];
        let last = coarse.width - 1;
        for x in 0..coarse.width {
            let (left, right) = (x.saturating_sub(1), (x + 1).min(last));
            let inside = plain(x) && line[left] == line[x] && line[right] == line[x] && plain(left) && plain(right);
            if inside {
                continue;
            }
            let candidates = coarse.candidates(x, y);
            for (row, out) in out.chunks_exact_mut(w).enumerate() {
                let (from, to) = (x * r, ((x + 1) * r).min(w));
                let first = (y * r + row) * w;
                let colours = bytes[(first + from) * 3..(first + to) * 3].chunks_exact(3);
                for (label, rgb) in out[from..to].iter_mut().zip(colours) {
                    let rgb = [0, 1, 2].map(|c| f32::from(rgb[c]) * f32::from(BANDWIDTH));
                    *label = candidates.closest(whitening.apply(rgb));
                }
            }
        }
    });
}
