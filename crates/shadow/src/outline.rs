//! Outlines of a connected mask: its outer boundary and that of every hole, pixel by pixel.
//!
//! Border following after Suzuki and Abe: a border begins where a row enters the mask for the first time, or leaves it
//! where no border passed by yet. `imageproc::contours` does the same for whole images; here it is one component in
//! its box, and the runs that are known anyway say where borders can begin.

use crate::{Mask, MaskRun};

/// Closed polygons through pixel centres of the image, px: neighbours in the list are neighbours in the image, and the
/// last is one of the first.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Outlines {
    /// The outer boundary, clockwise on the screen, from the leftmost pixel of the topmost row.
    pub(crate) outer: Vec<[i32; 2]>,
    /// The pixels round each hole, counter-clockwise on the screen, from top to bottom by where they begin.
    pub(crate) holes: Vec<Vec<[i32; 2]>>,
}

/// Bits of the sheet: inside, and the border on the pixel's right has been followed.
const INSIDE: u8 = 1;
const RIGHT_DONE: u8 = 2;

/// Steps clockwise on the screen, beginning with right.
const STEPS: [[i32; 2]; 8] = [[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]];
const RIGHT: usize = 0;
const LEFT: usize = 4;

/// Scratch memory of the tracing.
#[derive(Debug, Default)]
pub(crate) struct Tracer {
    sheet: Vec<u8>,
}

impl Tracer {
    /// The outlines of a mask whose pixels hang together, given its runs, sorted by row and column.
    pub(crate) fn trace(&mut self, mask: &Mask, runs: &[MaskRun]) -> Outlines {
        let bbox = mask.bbox();
        // A frame of one pixel saves asking for the border of the sheet at every step.
        let stride = bbox.width as usize + 2;
        self.sheet.clear();
        self.sheet.resize(stride * (bbox.height as usize + 2), 0);
        for (line, (_, row)) in self.sheet.chunks_exact_mut(stride).skip(1).zip(mask.rows()) {
            line[1..stride - 1].copy_from_slice(row);
        }
        let cell = |x: u32, y: u32| (y - bbox.y + 1) as usize * stride + (x - bbox.x + 1) as usize;
        let mut outlines = Outlines::default();
        if let Some(first) = runs.first() {
            outlines.outer = self.follow([first.start, first.y], cell(first.start, first.y), stride, LEFT);
        }
        for run in runs {
            let last = cell(run.end - 1, run.y);
            if self.sheet[last] & RIGHT_DONE == 0 {
                outlines.holes.push(self.follow([run.end - 1, run.y], last, stride, RIGHT));
            }
        }
        outlines
    }

    /// Follows the border from a pixel whose neighbour in direction `outside` is not inside.
    fn follow(&mut self, at: [u32; 2], start: usize, stride: usize, outside: usize) -> Vec<[i32; 2]> {
        let stride = stride as isize;
        let offset = |direction: usize| STEPS[direction][0] as isize + STEPS[direction][1] as isize * stride;
        let step = |from: usize, direction: usize| from.wrapping_add_signed(offset(direction));
        let mut at = at.map(|v| v as i32);
        let mut points = vec![at];
        let first = (1..8).map(|turn| (outside + turn) % 8).find(|&d| self.sheet[step(start, d)] & INSIDE != 0);
        let Some(first) = first else {
            // A single pixel.
            self.sheet[start] |= RIGHT_DONE;
            return points;
        };
        let last = step(start, first);
        let (mut here, mut back) = (start, first);
        loop {
            // Counter-clockwise from where we came; the pixel there is inside, so the search ends.
            let mut ahead = back;
            loop {
                ahead = (ahead + 7) % 8;
                if self.sheet[step(here, ahead)] & INSIDE != 0 {
                    break;
                }
                if ahead == RIGHT {
                    self.sheet[here] |= RIGHT_DONE;
                }
            }
            let next = step(here, ahead);
            if next == start && here == last {
                break;
            }
            at = [at[0] + STEPS[ahead][0], at[1] + STEPS[ahead][1]];
            points.push(at);
            here = next;
            back = (ahead + 4) % 8;
        }
        // Followed counter-clockwise round the outside; the first pixel stays the first.
        points[1..].reverse();
        points
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// The mask of a drawing: `#` is inside.
    fn draw(rows: &[&str]) -> (Mask, Vec<MaskRun>) {
        let mut runs = Vec::new();
        for (y, row) in (10..).zip(rows) {
            for (x, c) in (20..).zip(row.chars()) {
                if c == '#' {
                    runs.push(MaskRun { y, start: x, end: x + 1 });
                }
            }
        }
        let mask = Mask::from_runs(&runs).unwrap();
        let runs = mask.runs().collect();
        (mask, runs)
    }

    fn trace(rows: &[&str]) -> Outlines {
        let (mask, runs) = draw(rows);
        Tracer::default().trace(&mask, &runs)
    }

    /// Twice the signed area, positive for a polygon that is clockwise on the screen.
    fn doubled_area(polygon: &[[i32; 2]]) -> i32 {
        let next = polygon.iter().cycle().skip(1);
        polygon.iter().zip(next).map(|(a, b)| a[0] * b[1] - b[0] * a[1]).sum()
    }

    #[test]
    fn a_rectangle_is_walked_clockwise() {
        let found = trace(&["###", "###"]);
        assert_eq!(found.outer, [[20, 10], [21, 10], [22, 10], [22, 11], [21, 11], [20, 11]]);
        assert!(found.holes.is_empty());
    }

    #[test]
    fn single_pixels_and_lines() {
        assert_eq!(trace(&["#"]).outer, [[20, 10]]);
        assert_eq!(trace(&["##"]).outer, [[20, 10], [21, 10]]);
        // There and back.
        assert_eq!(trace(&["###"]).outer, [[20, 10], [21, 10], [22, 10], [21, 10]]);
        assert_eq!(trace(&["#", "#", "#"]).outer, [[20, 10], [20, 11], [20, 12], [20, 11]]);
        for rows in [&["#"][..], &["###"], &["#", "#", "#"]] {
            assert!(trace(rows).holes.is_empty());
        }
    }

    #[test]
    fn holes_are_walked_the_other_way() {
        let found = trace(&["#####", "#.#.#", "#####"]);
        assert_eq!(found.outer.len(), 12);
        assert!(doubled_area(&found.outer) > 0);
        assert_eq!(found.holes.len(), 2);
        for hole in &found.holes {
            assert_eq!(hole.len(), 4, "the four neighbours of a pixel: {hole:?}");
            assert!(doubled_area(hole) < 0);
        }
        assert_eq!(found.holes[0][0], [20, 11]);
        assert_eq!(found.holes[1][0], [22, 11]);
        let wide = trace(&["######", "#....#", "#....#", "######"]);
        assert_eq!((wide.holes.len(), wide.holes[0].len()), (1, 12));
    }

    #[test]
    fn bays_and_islands_are_no_holes() {
        assert!(trace(&["####", "#...", "####"]).holes.is_empty());
        assert!(trace(&["#.#", "###"]).holes.is_empty());
        // The inner wall of a ring that is open at the bottom.
        assert!(trace(&["#####", "#...#", "#.#.#", "#.#.#", "#.###"]).holes.is_empty());
    }

    proptest! {
        /// Closed in steps of one pixel, on the boundary, and every boundary pixel is on some outline.
        #[test]
        fn outlines_are_the_boundary(bits in prop::collection::vec(0u8..3, 12 * 9)) {
            // Grown from one pixel, so that it hangs together.
            let (width, height) = (12i32, 9i32);
            let filled = |x: i32, y: i32| {
                (0..width).contains(&x) && (0..height).contains(&y) && bits[(y * width + x) as usize] > 0
            };
            let start = (0..width * height).map(|i| (i % width, i / width)).find(|&(x, y)| filled(x, y));
            prop_assume!(start.is_some());
            let mut inside = std::collections::BTreeSet::new();
            let mut stack: Vec<(i32, i32)> = start.into_iter().collect();
            while let Some((x, y)) = stack.pop() {
                if filled(x, y) && inside.insert((y, x)) {
                    stack.extend([(x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)]);
                }
            }
            let pixels: Vec<_> = inside
                .iter()
                .map(|&(y, x)| MaskRun { y: y as u32, start: x as u32, end: x as u32 + 1 })
                .collect();
            let mask = Mask::from_runs(&pixels).unwrap();
            let runs: Vec<_> = mask.runs().collect();
            let found = Tracer::default().trace(&mask, &runs);
            let mut seen = std::collections::BTreeSet::new();
            for outline in std::iter::once(&found.outer).chain(&found.holes) {
                for (a, b) in outline.iter().zip(outline.iter().cycle().skip(1)) {
                    prop_assert!((a[0] - b[0]).abs() <= 1 && (a[1] - b[1]).abs() <= 1);
                    prop_assert!(inside.contains(&(a[1], a[0])));
                    seen.insert((a[1], a[0]));
                }
            }
            for &(y, x) in &inside {
                let open = [(y, x + 1), (y, x - 1), (y + 1, x), (y - 1, x)].iter().any(|p| !inside.contains(p));
                prop_assert_eq!(open, seen.contains(&(y, x)), "({}, {})", x, y);
            }
            if found.outer.len() > 1 {
                prop_assert!(doubled_area(&found.outer) >= 0);
            }
            for hole in &found.holes {
                prop_assert!(doubled_area(hole) <= 0);
            }
        }
    }
}
