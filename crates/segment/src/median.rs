//! Separable median of the working image: structure finer than the kernel (ruled lines, speckles, pores, single-pixel
//! noise) belongs to the table, edges stay where they are.
//!
//! The median along rows is followed by the median along columns, over 3 or 5 pixels each; at the border the image is
//! continued by its last pixel.

use rayon::prelude::*;

/// Widest kernel.
pub(crate) const MAX_RADIUS: usize = 2;

/// Filters `rgb`, `width` pixels a row, with a kernel of `2 radius + 1`; `scratch` is reused memory.
pub(crate) fn median(rgb: &mut [[u16; 3]], width: usize, radius: usize, scratch: &mut Vec<[u16; 3]>) {
    if radius == 0 || rgb.is_empty() {
        return;
    }
    scratch.resize(rgb.len(), [0; 3]);
    let stride = width * 3;
    let height = rgb.len() / width;
    scratch
        .as_flattened_mut()
        .par_chunks_mut(stride)
        .zip(rgb.as_flattened().par_chunks(stride))
        .with_min_len(16)
        .for_each(|(out, line)| {
            // The line with its ends repeated.
            let mut padded = vec![0u16; stride + 6 * radius];
            padded[3 * radius..3 * radius + stride].copy_from_slice(line);
            for i in 0..radius {
                padded.copy_within(3 * radius..3 * radius + 3, 3 * i);
                padded.copy_within(3 * radius + stride - 3..3 * radius + stride, stride + 3 * (radius + i));
            }
            let tap = |i: usize| &padded[3 * i..3 * i + stride];
            match radius {
                1 => median3_of(out, [tap(0), tap(1), tap(2)]),
                _ => median5_of(out, [tap(0), tap(1), tap(2), tap(3), tap(4)]),
            }
        });
    let lines = scratch.as_flattened();
    rgb.as_flattened_mut().par_chunks_mut(stride).enumerate().with_min_len(16).for_each(|(y, out)| {
        let tap = |dy: isize| {
            let row = y.saturating_add_signed(dy).min(height - 1);
            &lines[row * stride..(row + 1) * stride]
        };
        match radius {
            1 => median3_of(out, [tap(-1), tap(0), tap(1)]),
            _ => median5_of(out, [tap(-2), tap(-1), tap(0), tap(1), tap(2)]),
        }
    });
}

fn median3_of(out: &mut [u16], [a, b, c]: [&[u16]; 3]) {
    for ((o, (&a, &b)), &c) in out.iter_mut().zip(a.iter().zip(b)).zip(c) {
        *o = median3(a, b, c);
    }
}

fn median5_of(out: &mut [u16], [a, b, c, d, e]: [&[u16]; 5]) {
    for (((o, (&a, &b)), (&c, &d)), &e) in out.iter_mut().zip(a.iter().zip(b)).zip(c.iter().zip(d)).zip(e) {
        // The least and the greatest of four cannot be the median of five.
        let low = a.min(b).max(c.min(d));
        let high = a.max(b).min(c.max(d));
        *o = median3(low, high, e);
    }
}

fn median3(a: u16, b: u16, c: u16) -> u16 {
    a.min(b).max(a.max(b).min(c))
}
