//! Rectangles of an image, with a value for each pixel.

use std::ops::Range;

/// Pixels of an image; none in the default one.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Area {
    pub(super) columns: Range<usize>,
    pub(super) rows: Range<usize>,
}

impl Area {
    /// The least rectangle with all points and `margin_px` about them, cut at the border of an image.
    pub(super) fn about(points: impl Iterator<Item = [f64; 2]>, margin_px: usize, size_px: [usize; 2]) -> Self {
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for point in points {
            for axis in 0..2 {
                low[axis] = low[axis].min(point[axis]);
                high[axis] = high[axis].max(point[axis]);
            }
        }
        let margin = margin_px as f64;
        // Without points, and beside the image, the end is not after the start.
        let range = |axis: usize| {
            let start = (low[axis].floor() - margin).max(0.0);
            let end = (high[axis].ceil() + margin + 1.0).min(size_px[axis] as f64);
            start as usize..end as usize
        };
        let (columns, rows) = (range(0), range(1));
        if columns.is_empty() || rows.is_empty() { Self::default() } else { Self { columns, rows } }
    }

    /// A point of the image as one of the rectangle.
    pub(super) fn local(&self, [u, v]: [f64; 2]) -> [f64; 2] {
        [u - self.columns.start as f64, v - self.rows.start as f64]
    }
}

/// A rectangle of an image with its values, row by row.
#[derive(Debug)]
pub(super) struct Tile<T> {
    pub(super) area: Area,
    pub(super) values: Vec<T>,
}

impl<T: Copy> Tile<T> {
    pub(super) fn new(area: Area, value: T) -> Self {
        let values = vec![value; area.columns.len() * area.rows.len()];
        Self { area, values }
    }

    /// Its values in a part of a row of the image: how many of these columns come before the first, and the values.
    pub(super) fn within(&self, row: usize, columns: &Range<usize>) -> (usize, &[T]) {
        let Area { columns: own, rows } = &self.area;
        let (start, end) = (own.start.max(columns.start), own.end.min(columns.end));
        if !rows.contains(&row) || start >= end {
            return (0, &[]);
        }
        let first = (row - rows.start) * own.len();
        (start - columns.start, &self.values[first + start - own.start..first + end - own.start])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn areas_hold_their_points_and_end_at_the_border() {
        let area = |points: &[[f64; 2]]| Area::about(points.iter().copied(), 1, [20, 10]);
        assert_eq!(area(&[[4.2, 3.0], [6.0, 5.5]]), Area { columns: 3..8, rows: 2..8 });
        assert_eq!(area(&[[-50.0, 0.0], [50.0, 50.0]]), Area { columns: 0..20, rows: 0..10 });
        for nowhere in [&[][..], &[[-3.0, 4.0]], &[[30.0, 4.0]], &[[f64::NAN, 4.0]], &[[4.0, 1e300]]] {
            assert_eq!(area(nowhere), Area::default(), "{nowhere:?}");
        }
    }

    #[test]
    fn a_part_of_a_row_has_the_values_of_its_columns() {
        let mut tile = Tile::new(Area { columns: 3..6, rows: 2..4 }, 0);
        tile.values.copy_from_slice(&[1, 2, 3, 4, 5, 6]);
        assert_eq!(tile.within(3, &(0..20)), (3, &[4, 5, 6][..]));
        assert_eq!(tile.within(2, &(4..5)), (0, &[2][..]));
        assert_eq!(tile.within(2, &(1..5)), (2, &[1, 2][..]));
        for (row, columns) in [(1, 0..20), (4, 0..20), (2, 0..3), (2, 6..9)] {
            assert!(tile.within(row, &columns).1.is_empty(), "{row}, {columns:?}");
        }
    }
}
