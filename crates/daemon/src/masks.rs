//! Objects and shadows of a scene as one picture of codes, a byte a pixel.
//!
//! | code | pixel |
//! |---|---|
//! | 0 | neither |
//! | 255 - i | object i, from 255 down to 129 |
//! | 127 - i | shadow of object i, from 127 down to 1 |
//!
//! i is the index of the object in its scene; objects from 126 on share the last code of each kind. So a viewer that
//! shows the codes as grey levels shows objects white, shadows grey and the table black.

use samsod::shadow::{Mask, ObjectRegion};

/// Neither object nor shadow.
const TABLE: u8 = 0;
const FIRST_OBJECT: u8 = 255;
const FIRST_SHADOW: u8 = 127;
/// Index of the last object with codes of its own.
const LAST: u8 = 126;

/// What a pixel shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shown {
    /// Neither an object nor its shadow.
    Table,
    /// The object of this index.
    Object(usize),
    /// The shadow of the object of this index.
    Shadow(usize),
}

impl Shown {
    /// What a code says; a code that is never written is table.
    pub fn from_code(code: u8) -> Self {
        match code {
            1..=FIRST_SHADOW => Self::Shadow((FIRST_SHADOW - code).into()),
            129.. => Self::Object((FIRST_OBJECT - code).into()),
            _ => Self::Table,
        }
    }
}

/// Paints the codes of all objects into `codes`, which becomes `width * height` bytes, row by row, and keeps its memory.
pub fn paint((width, height): (u32, u32), objects: &[ObjectRegion], codes: &mut Vec<u8>) {
    codes.clear();
    codes.resize(width as usize * height as usize, TABLE);
    for (i, object) in objects.iter().enumerate() {
        let below = u8::try_from(i).unwrap_or(LAST).min(LAST);
        if let Some(shadow) = &object.shadow {
            paint_mask(width, codes, shadow, FIRST_SHADOW - below);
        }
        paint_mask(width, codes, &object.mask, FIRST_OBJECT - below);
    }
}

/// A mask may come from elsewhere than the frame; what lies beyond the picture is left out.
fn paint_mask(width: u32, codes: &mut [u8], mask: &Mask, code: u8) {
    for run in mask.runs() {
        let row = run.y as usize * width as usize;
        let (start, end) = (run.start.min(width) as usize, run.end.min(width) as usize);
        if let Some(pixels) = codes.get_mut(row + start..row + end) {
            pixels.fill(code);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use samsod::shadow::{MaskRun, OrientedBox};

    fn object(at: u32, shadow: bool) -> ObjectRegion {
        let mask = |y| Mask::from_runs(&[MaskRun { y, start: at, end: at + 2 }]);
        ObjectRegion {
            region: 0,
            mask: mask(0).unwrap(),
            shadow: if shadow { mask(1) } else { None },
            outline: Vec::new(),
            holes: Vec::new(),
            area: 2,
            centroid: [0.0; 2],
            oriented_box: OrientedBox { center_px: [0.0; 2], length_px: 1.0, width_px: 1.0, angle_rad: 0.0 },
            axis_rad: 0.0,
        }
    }

    #[test]
    fn every_object_and_shadow_has_its_code_and_the_buffer_is_used_again() {
        // The second reaches beyond the picture.
        let objects = [object(1, true), object(4, false)];
        let mut codes = vec![9; 3];
        paint((5, 2), &objects, &mut codes);
        assert_eq!(codes, [0, 255, 255, 0, 254, 0, 127, 127, 0, 0]);
        let shown: Vec<Shown> = codes.iter().map(|&code| Shown::from_code(code)).collect();
        assert_eq!((shown[0], shown[1], shown[4]), (Shown::Table, Shown::Object(0), Shown::Object(1)));
        assert_eq!(shown[6], Shown::Shadow(0));
        paint((2, 1), &[], &mut codes);
        assert_eq!(codes, [0, 0]);
    }

    #[test]
    fn codes_run_out_without_running_over() {
        let objects: Vec<_> = (0..300).map(|i| object(2 * i, true)).collect();
        let mut codes = Vec::new();
        paint((600, 2), &objects, &mut codes);
        for i in 0..300 {
            let expected = i.min(126);
            assert_eq!(Shown::from_code(codes[2 * i]), Shown::Object(expected));
            assert_eq!(Shown::from_code(codes[600 + 2 * i]), Shown::Shadow(expected));
        }
        assert_eq!(Shown::from_code(128), Shown::Table);
    }
}
