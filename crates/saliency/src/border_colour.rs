//! How unlike the colours along the border of the image a partition is.
//!
//! Each of the four sides has a strip with a mean and covariance of colour (L*a*b*); the Mahalanobis distance from it tells
//! how unlike. An object may touch a side, so of the four distances of a partition the largest is left out.

use samsod_segment::Partition;

/// Depth of a strip as a share of the longer side of the image.
const DEPTH: f32 = 0.1;
/// Variance that every direction of colour has at least, squared Delta E: a uniform border has none of its own.
const LEAST_VARIANCE: f64 = 4.0;

/// Pixels of every label in the strips along the top, bottom, left and right side.
fn strips(partition: &Partition) -> [Vec<f64>; 4] {
    let (width, height) = (partition.width() as usize, partition.height() as usize);
    let depth = ((width.max(height) as f32 * DEPTH).round() as usize).max(2);
    let mut strips = [0; 4].map(|_| vec![0.0; partition.len()]);
    for (y, row) in partition.runs().rows().iter().enumerate() {
        for run in row {
            let (start, end, label) = (run.start as usize, run.end as usize, run.label as usize);
            if y < depth {
                strips[0][label] += (end - start) as f64;
            }
            if y + depth >= height {
                strips[1][label] += (end - start) as f64;
            }
            strips[2][label] += end.min(depth).saturating_sub(start) as f64;
            strips[3][label] += end.saturating_sub(start.max(width.saturating_sub(depth))) as f64;
        }
    }
    strips
}

/// Distance of every partition from the border, one a label, not negative; `colours` are L*a*b*.
pub(crate) fn border_contrast(partition: &Partition, colours: &[[f32; 3]]) -> Vec<f32> {
    let colours: Vec<[f64; 3]> = colours.iter().map(|c| c.map(f64::from)).collect();
    let (mut sums, mut largest) = (vec![0.0; colours.len()], vec![0.0f64; colours.len()]);
    for pixels in strips(partition) {
        let distances = mahalanobis(&colours, &pixels);
        // A side of one colour would outweigh the others: each counts by its own range.
        let range = distances.iter().copied().fold(0.0, f64::max).max(1e-9);
        for ((sum, largest), distance) in sums.iter_mut().zip(&mut largest).zip(distances) {
            *sum += distance / range;
            *largest = largest.max(distance / range);
        }
    }
    sums.iter().zip(&largest).map(|(sum, largest)| (sum - largest) as f32).collect()
}

/// Distance of every colour from the distribution that weights make of them.
fn mahalanobis(colours: &[[f64; 3]], weights: &[f64]) -> Vec<f64> {
    let total = weights.iter().sum::<f64>().max(1.0);
    let mut mean = [0.0; 3];
    for (colour, weight) in colours.iter().zip(weights) {
        for (m, c) in mean.iter_mut().zip(colour) {
            *m += c * weight / total;
        }
    }
    let offset = |colour: &[f64; 3]| [0, 1, 2].map(|i| colour[i] - mean[i]);
    let mut covariance = [0, 1, 2].map(|i| [0, 1, 2].map(|k| if i == k { LEAST_VARIANCE } else { 0.0 }));
    for (colour, weight) in colours.iter().zip(weights) {
        let d = offset(colour);
        for (i, row) in covariance.iter_mut().enumerate() {
            for (k, c) in row.iter_mut().enumerate() {
                *c += d[i] * d[k] * weight / total;
            }
        }
    }
    let inverse = inverse(covariance);
    let squared =
        |d: [f64; 3]| -> f64 { (0..3).map(|i| (0..3).map(|k| d[i] * inverse[i][k] * d[k]).sum::<f64>()).sum() };
    colours.iter().map(|colour| squared(offset(colour)).max(0.0).sqrt()).collect()
}

/// Inverse of a symmetric matrix whose eigenvalues are all at least [`LEAST_VARIANCE`], by cofactors.
fn inverse(m: [[f64; 3]; 3]) -> [[f64; 3]; 3] {
    let minor = |i: usize, k: usize| {
        let ([a, b], [c, d]) = ([(i + 1) % 3, (i + 2) % 3], [(k + 1) % 3, (k + 2) % 3]);
        m[a][c] * m[b][d] - m[a][d] * m[b][c]
    };
    let determinant: f64 = (0..3).map(|k| m[0][k] * minor(0, k)).sum();
    [0, 1, 2].map(|i| [0, 1, 2].map(|k| minor(k, i) / determinant))
}

#[cfg(test)]
mod tests {
    use super::{inverse, mahalanobis};

    #[test]
    fn the_inverse_undoes_the_matrix() {
        let m = [[5.0, 1.0, -2.0], [1.0, 6.0, 0.5], [-2.0, 0.5, 9.0]];
        let i = inverse(m);
        for (row, line) in m.iter().enumerate() {
            let product = (0..3).fold([0.0; 3], |sum, k| [0, 1, 2].map(|column| sum[column] + line[k] * i[k][column]));
            for (column, value) in product.into_iter().enumerate() {
                assert!((value - f64::from(u8::from(row == column))).abs() < 1e-12, "{row}, {column}: {value}");
            }
        }
    }

    #[test]
    fn distances_are_in_deviations() {
        // Two border colours 8 apart in lightness: mean 4, variance 16 and the least variance of 4.
        let colours = [[0.0, 0.0, 0.0], [8.0, 0.0, 0.0], [4.0, 6.0, 0.0]];
        let distances = mahalanobis(&colours, &[50.0, 50.0, 0.0]);
        assert!((distances[0] - 4.0 / 20f64.sqrt()).abs() < 1e-12, "{distances:?}");
        assert!((distances[0] - distances[1]).abs() < 1e-12, "{distances:?}");
        assert!((distances[2] - 3.0).abs() < 1e-12, "{distances:?}");
    }
}
