//! Groups of like pieces of a region: what one piece is too small to tell, a group of them may.
//!
//! Pieces are joined across their borders in the order of the gradients there, as Felzenszwalb and Huttenlocher join
//! pixels: two groups become one where the border between them is hardly steeper than those within either. Small groups
//! are let off more than large ones.

use crate::basins::{Basin, Border};

/// Scratch memory of the joining.
#[derive(Debug, Default)]
pub(crate) struct Groups {
    /// Gradient in the upper bits, index of the border in the lower ones.
    order: Vec<u64>,
    parents: Vec<u32>,
    pixels: Vec<f32>,
    /// The steepest border within a group, sRGB levels over two pixels.
    steepest: Vec<f32>,
    numbers: Vec<u32>,
}

impl Groups {
    /// Writes the group of every basin, dense from 0 in the order of their first basins, and returns their number. `slack`
    /// is what a group is let off, sRGB levels times its pixels: groups grow with it.
    pub(crate) fn join(&mut self, basins: &[Basin], borders: &[Border], slack: f32, groups: &mut Vec<u32>) -> usize {
        self.order.clear();
        // Gradients are not negative, so their bits are in the order of the numbers.
        let keys = borders.iter().zip(0u64..).map(|(border, i)| u64::from(border.gradient.to_bits()) << 32 | i);
        self.order.extend(keys);
        self.order.sort_unstable();
        self.parents.clear();
        self.parents.extend(0..basins.len() as u32);
        self.pixels.clear();
        self.pixels.extend(basins.iter().map(|basin| basin.pixels));
        self.steepest.clear();
        self.steepest.resize(basins.len(), 0.0);
        for &key in &self.order {
            let border = &borders[(key & u64::from(u32::MAX)) as usize];
            let (a, b) = (root(&mut self.parents, border.a), root(&mut self.parents, border.b));
            if a == b {
                continue;
            }
            let allowed = |i: u32| self.steepest[i as usize] + slack / self.pixels[i as usize];
            if border.gradient > allowed(a).min(allowed(b)) {
                continue;
            }
            let (large, small) = if self.pixels[a as usize] < self.pixels[b as usize] { (b, a) } else { (a, b) };
            self.parents[small as usize] = large;
            self.pixels[large as usize] += self.pixels[small as usize];
            // Borders come by gradient: none before was steeper.
            self.steepest[large as usize] = border.gradient;
        }
        self.numbers.clear();
        self.numbers.resize(basins.len(), u32::MAX);
        groups.clear();
        let mut count = 0;
        for i in 0..basins.len() as u32 {
            let number = &mut self.numbers[root(&mut self.parents, i) as usize];
            if *number == u32::MAX {
                *number = count;
                count += 1;
            }
            groups.push(*number);
        }
        count as usize
    }
}

/// The first of the group that a basin belongs to; shortens the way for the next who asks.
fn root(parents: &mut [u32], mut i: u32) -> u32 {
    while parents[i as usize] != i {
        let above = parents[parents[i as usize] as usize];
        parents[i as usize] = above;
        i = above;
    }
    i
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Basins of so many pixels in a row, and the gradients between them.
    fn row(pixels: &[f32], gradients: &[f32]) -> (Vec<Basin>, Vec<Border>) {
        let basins = pixels.iter().map(|&pixels| Basin { pixels, ..Basin::default() }).collect();
        let border = |(a, &gradient): (u32, &f32)| Border { a, b: a + 1, length: 1.0, gradient };
        (basins, (0..).zip(gradients).map(border).collect())
    }

    fn join(pixels: &[f32], gradients: &[f32], slack: f32) -> Vec<u32> {
        let (basins, borders) = row(pixels, gradients);
        let (mut groups, mut labels) = (Groups::default(), vec![9; 3]);
        let count = groups.join(&basins, &borders, slack, &mut labels);
        assert_eq!(count, labels.iter().max().map_or(0, |&last| last as usize + 1));
        labels
    }

    #[test]
    fn a_steep_border_parts_two_groups() {
        let pixels = [50.0; 6];
        assert_eq!(join(&pixels, &[5.0, 6.0, 40.0, 6.0, 5.0], 300.0), [0, 0, 0, 1, 1, 1]);
        assert_eq!(join(&pixels, &[5.0, 6.0, 40.0, 6.0, 5.0], 20000.0), [0; 6]);
        assert_eq!(join(&pixels, &[5.0, 6.0, 40.0, 6.0, 5.0], 0.0), [0, 1, 2, 3, 4, 5]);
    }

    #[test]
    fn small_pieces_are_let_off_more() {
        // The same gradient joins a piece of 5 pixels to its neighbour, and not one of 500.
        assert_eq!(join(&[5.0, 5.0, 500.0, 500.0], &[30.0, 30.0, 30.0], 300.0), [0, 0, 1, 2]);
    }

    #[test]
    fn regions_without_borders() {
        assert_eq!(join(&[], &[], 300.0), [0u32; 0]);
        assert_eq!(join(&[7.0], &[], 300.0), [0]);
    }
}
