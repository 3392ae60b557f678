//! Finds dark holes in parts.
//!
//! A deep hole shows a table on which no light falls: darker than any shadow, and without a hue. By its tone alone it might
//! be a black part; but nothing lies there on all sides of which another part begins.

use samsod_segment::BoundingBox;

use crate::crop::{Crop, OBJECT, SHADOW};

/// Share of its box that a hole fills at least; lettering and slots between fins fill less.
const LEAST_FILL: f32 = 0.55;
/// Shortest side of the box of a hole, px: smaller ones are marks and engravings.
const LEAST_SIDE_PX: u32 = 6;

/// Scratch memory of [`cut_holes`].
#[derive(Debug, Default)]
pub(crate) struct Holes {
    seen: Vec<bool>,
    hole: Vec<u32>,
}

/// Makes shadow of dark object pixels (`is_dark` by index in the crop) that brighter object pixels enclose, when they are
/// compact. `starts` holds at least one pixel of every dark piece.
pub(crate) fn cut_holes(
    crop: &mut Crop,
    starts: impl Iterator<Item = usize>,
    is_dark: impl Fn(usize) -> bool,
    scratch: &mut Holes,
) {
    let width = crop.width();
    let Holes { seen, hole } = scratch;
    seen.clear();
    seen.resize(crop.codes.len(), false);
    for start in starts {
        if seen[start] || crop.codes[start] != OBJECT || !is_dark(start) {
            continue;
        }
        hole.clear();
        hole.push(start as u32);
        seen[start] = true;
        let mut is_enclosed = true;
        let mut bbox: Option<BoundingBox> = None;
        let mut at = 0;
        while at < hole.len() {
            let i = hole[at] as usize;
            at += 1;
            let (x, y) = (i % width, i / width);
            let here = BoundingBox { x: x as u32, y: y as u32, width: 1, height: 1 };
            bbox = Some(bbox.map_or(here, |b| b.union(&here)));
            if x == 0 || x + 1 == width || y == 0 || i + width >= crop.codes.len() {
                is_enclosed = false;
                continue;
            }
            for n in [i - 1, i + 1, i - width, i + width] {
                if crop.codes[n] != OBJECT {
                    is_enclosed = false;
                } else if !seen[n] && is_dark(n) {
                    seen[n] = true;
                    hole.push(n as u32);
                }
            }
        }
        let is_compact = bbox.is_some_and(|b| {
            b.width.min(b.height) >= LEAST_SIDE_PX && hole.len() as f32 >= LEAST_FILL * (b.width * b.height) as f32
        });
        if is_enclosed && is_compact {
            hole.iter().for_each(|&i| crop.codes[i as usize] = SHADOW);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Cuts a drawing in which `#` is a bright and `o` a dark object pixel; returns it with what was cut as `s`.
    fn cut(rows: &[&str]) -> Vec<String> {
        let drawn: Vec<String> = rows.iter().map(|row| row.replace('o', "#")).collect();
        let drawn: Vec<&str> = drawn.iter().map(String::as_str).collect();
        let mut crop = Crop::drawn(0, 0, &drawn);
        let dark: Vec<bool> = rows.iter().flat_map(|row| row.bytes().map(|c| c == b'o')).collect();
        cut_holes(&mut crop, 0..dark.len(), |i| dark[i], &mut Holes::default());
        let rows = crop.codes.chunks_exact(crop.width()).zip(dark.chunks_exact(crop.width()));
        rows.map(|(codes, dark)| {
            let letter = |(&code, &dark): (&u8, &bool)| match code {
                OBJECT => {
                    if dark {
                        'o'
                    } else {
                        '#'
                    }
                }
                SHADOW => 's',
                _ => ' ',
            };
            codes.iter().zip(dark).map(letter).collect()
        })
        .collect()
    }

    const PLATE: &str = "##########";

    #[test]
    fn a_dark_hole_in_a_part_is_cut() {
        let rows = [PLATE, "##oooooo##", "##oooooo##", "##oooooo##", "##oooooo##", "##oooooo##", "##oooooo##", PLATE];
        let holed = "##ssssss##";
        assert_eq!(cut(&rows), [PLATE, holed, holed, holed, holed, holed, holed, PLATE]);
    }

    #[test]
    fn a_black_part_stays_whole() {
        let rows = ["          ", " oooooooo ", " oooooooo ", " oooooooo ", " oooooooo ", " oooooooo ", " oooooooo "];
        assert_eq!(cut(&rows), rows);
        // So does the black end of a part: nothing of it lies on one side.
        let rows = [PLATE, "oooooo####", "oooooo####", "oooooo####", "oooooo####", "oooooo####", "oooooo####", PLATE];
        assert_eq!(cut(&rows), rows);
    }

    #[test]
    fn small_marks_and_thin_lettering_stay() {
        let rows = [PLATE, "##ooooo###", "##ooooo###", "##ooooo###", "##ooooo###", "##ooooo###", PLATE];
        assert_eq!(cut(&rows), rows);
        let rows = [PLATE, "##o#######", "##o#######", "##o#######", "##o#######", "##o#######", "##oooooo##", PLATE];
        assert_eq!(cut(&rows), rows);
    }
}
