//! Which pixels lie inside a triangle.

/// Rounding of a weight: neighbouring triangles leave no gap.
const ROUNDING: f64 = 1e-9;

/// Calls `set` for every pixel of a picture whose centre lies in a triangle, with its index `y * width + x` and the weights
/// of the three corners there. Centres are at integers; the turn of the triangle does not matter.
pub(super) fn fill(corners: [[f64; 2]; 3], width: usize, height: usize, mut set: impl FnMut(usize, [f64; 3])) {
    let [a, b, c] = corners;
    let double_area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1]);
    // NaN is no area, either.
    if !(double_area.abs() >= 1e-12 && double_area.is_finite()) {
        return;
    }
    let extent = |axis: usize, side: usize| {
        let least = a[axis].min(b[axis]).min(c[axis]).ceil().max(0.0);
        let most = a[axis].max(b[axis]).max(c[axis]).floor().min(side as f64 - 1.0);
        (least <= most).then_some((least as usize, most as usize))
    };
    let (Some((left, right)), Some((top, bottom))) = (extent(0, width), extent(1, height)) else { return };
    let scale = 1.0 / double_area;
    // How the weights of a, b and c change from column to column.
    let by_column = [(b[1] - c[1]) * scale, (c[1] - a[1]) * scale, (a[1] - b[1]) * scale];
    for y in top..=bottom {
        let row = y as f64;
        let first_a = (b[0] * (c[1] - row) - c[0] * (b[1] - row)) * scale;
        let first_b = (c[0] * (a[1] - row) - a[0] * (c[1] - row)) * scale;
        let first = [first_a, first_b, 1.0 - first_a - first_b];
        // Slivers have wide boxes: only the columns in which no weight is negative are looked at.
        let (mut from, mut to) = (left as f64, right as f64);
        for (first, by_column) in first.into_iter().zip(by_column) {
            let crossing = (-ROUNDING - first) / by_column;
            if by_column > 0.0 {
                from = from.max(crossing.ceil());
            } else if by_column < 0.0 {
                to = to.min(crossing.floor());
            } else if first < -ROUNDING {
                to = f64::NEG_INFINITY;
            }
        }
        if from > to {
            continue;
        }
        for x in from as usize..=to as usize {
            let column = x as f64;
            let [weight_a, weight_b] = [0, 1].map(|i| first[i] + column * by_column[i]);
            set(y * width + x, [weight_a, weight_b, 1.0 - weight_a - weight_b]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn filled(corners: [[f64; 2]; 3], width: usize, height: usize) -> Vec<usize> {
        let mut pixels = Vec::new();
        fill(corners, width, height, |index, weights| {
            let at = [0, 1].map(|axis| (0..3).map(|i| weights[i] * corners[i][axis]).sum::<f64>());
            assert!((at[0] - (index % width) as f64).abs() < 1e-9 && (at[1] - (index / width) as f64).abs() < 1e-9);
            pixels.push(index);
        });
        pixels
    }

    #[test]
    fn centres_inside_are_filled_whichever_way_the_corners_turn() {
        let [a, b, c] = [[-0.2, -0.2], [3.2, -0.2], [-0.2, 3.2]];
        let expected = vec![0, 1, 2, 3, 4, 5, 6, 8, 9, 12];
        assert_eq!(filled([a, b, c], 4, 4), expected);
        assert_eq!(filled([c, b, a], 4, 4), expected);
    }

    #[test]
    fn triangles_are_cut_at_the_border_and_none_without_an_area_is_filled() {
        assert_eq!(filled([[-90.0, -90.0], [90.0, -90.0], [0.0, 90.0]], 3, 2).len(), 6);
        for corners in [
            [[9.0, 0.0], [12.0, 0.0], [9.0, 3.0]],
            [[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]],
            [[f64::NAN, 0.0], [2.0, 0.0], [0.0, 2.0]],
        ] {
            assert!(filled(corners, 4, 4).is_empty(), "{corners:?}");
        }
    }
}
