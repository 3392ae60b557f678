//! Which of two turns of a part shows the table where it should: through its holes and keyways.
//!
//! In: a frame and the silhouettes of a part at two turns that look alike. Out: how much better the second agrees: where only
//! one of them covers the table, the frame looks like the rest of the part or it does not. Glare leaves a part no edges to
//! compare, but what is seen through it stays dark.

use samsod_segment::RgbView;

use crate::silhouette::Silhouette;

/// Fewer pixels that one alone covers tell nothing.
const LEAST_PIXELS: usize = 12;
/// Brightness that differs from that of the part by so many sRGB levels beyond its own spread counts half.
const HALF_LEVELS: f32 = 12.0;

/// How much better the second of two silhouettes of all pixels agrees with the frame, in [-1, 1]; 0 where they tell nothing.
pub(crate) fn uncovered_lead(frame: &RgbView<'_>, first: &Silhouette, second: &Silhouette) -> f32 {
    let (mut both, mut alone) = (Vec::new(), [Vec::new(), Vec::new()]);
    split(frame, first, second, |value, is_shared| if is_shared { &mut both } else { &mut alone[0] }.push(value));
    split(frame, second, first, |value, is_shared| {
        if !is_shared {
            alone[1].push(value);
        }
    });
    if both.is_empty() || alone.iter().any(|values| values.len() < LEAST_PIXELS) {
        return 0.0;
    }
    let middle = |values: &mut Vec<f32>| {
        let half = values.len() / 2;
        *values.select_nth_unstable_by(half, f32::total_cmp).1
    };
    let usual = middle(&mut both);
    let spread = middle(&mut both.iter().map(|value| (value - usual).abs()).collect());
    // Of what one alone takes for the part, how far it is from looking like it.
    let unlike = |values: &[f32]| {
        let unlike = |value: &f32| {
            let off = (value - usual).abs();
            off / (off + 2.0 * spread + HALF_LEVELS)
        };
        values.iter().map(unlike).sum::<f32>() / values.len() as f32
    };
    unlike(&alone[0]) - unlike(&alone[1])
}

/// Calls `put` with the brightness of every pixel of a silhouette, and whether it is in another, too.
fn split(frame: &RgbView<'_>, own: &Silhouette, other: &Silhouette, mut put: impl FnMut(f32, bool)) {
    let raw = frame.as_raw();
    for (y, row) in own.rows() {
        let line = other.row(y);
        for (x, _) in (own.bbox.x..).zip(row).filter(|(_, bit)| **bit != 0) {
            let start = 3 * (y as usize * frame.width() as usize + x as usize);
            let Some(rgb) = raw.get(start..start + 3) else { continue };
            let column = x.checked_sub(other.bbox.x).map(|column| column as usize);
            let shared = line.zip(column).and_then(|(line, column)| line.get(column)).is_some_and(|bit| *bit != 0);
            put(rgb.iter().map(|&c| f32::from(c)).sum::<f32>() / 3.0, shared);
        }
    }
}

#[cfg(test)]
mod tests {
    use image::{Rgb, RgbImage};
    use samsod_segment::BoundingBox;

    use super::*;
    use crate::test_parts::view;

    /// A disc of 40 px with a notch of 8 x 10 px to the right (or left) of its middle.
    fn notched(right: bool) -> Silhouette {
        let bits = (0..80 * 80).map(|i| {
            let (x, y) = (i % 80 - 40, i / 80 - 40);
            let notch = if right { (10..18).contains(&x) } else { (-18..-10).contains(&x) };
            u8::from(x * x + y * y < 1600 && !(notch && (-5..5).contains(&y)))
        });
        Silhouette { bbox: BoundingBox { x: 20, y: 10, width: 80, height: 80 }, step: 1, bits: bits.collect() }
    }

    fn painted(silhouette: &Silhouette, part: u8, table: u8) -> RgbImage {
        RgbImage::from_fn(120, 100, |x, y| {
            let column = x.checked_sub(silhouette.bbox.x);
            let bit = silhouette.row(y).zip(column).and_then(|(row, column)| row.get(column as usize));
            Rgb([if bit.is_some_and(|bit| *bit != 0) { part } else { table }; 3])
        })
    }

    #[test]
    fn the_turn_whose_notch_shows_the_table_leads() {
        let (right, left) = (notched(true), notched(false));
        // In glare, and dark on a bright table.
        for (part, table) in [(255, 90), (40, 160)] {
            let frame = painted(&right, part, table);
            let lead = uncovered_lead(&view(&frame), &left, &right);
            assert!(lead > 0.7, "{lead}");
            assert_eq!(uncovered_lead(&view(&frame), &right, &left), -lead);
        }
    }

    #[test]
    fn what_tells_nothing_leads_to_nothing() {
        let (right, left) = (notched(true), notched(false));
        let frame = painted(&right, 120, 120);
        assert_eq!(uncovered_lead(&view(&frame), &left, &right), 0.0);
        let frame = painted(&right, 255, 90);
        assert_eq!(uncovered_lead(&view(&frame), &right, &right), 0.0, "nothing that one alone covers");
        assert_eq!(uncovered_lead(&view(&frame), &right, &Silhouette::default()), 0.0);
    }
}
