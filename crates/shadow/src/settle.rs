//! Objects anew, where the exact pixels of parts are known: a recognised part says better than any shading what is part
//! and what is shadow.
//!
//! In: the objects of a frame, and masks of parts, each with its salient region. Out: the objects after that. A known part
//! is one object with the pixels of its mask, whatever the separation made of them: pieces are joined, and what was taken
//! for shadow is regained. What is left of the objects that it covers stays an object where it is more than a seam along
//! the part; a seam goes to the shadow that it touches, and to the table where it touches none. Regions without a known
//! part stay as they are.

use rayon::prelude::*;
use samsod_segment::BoundingBox;

use crate::crop::{Crop, OBJECT, SHADOW};
use crate::objects::{Scratch, connected};
use crate::{Mask, MaskRun, ObjectRegion};

/// What is left beside a known part is an object where a square of twice this and one pixel fits in, px.
const SEAM_PX: usize = 3;

/// A part whose pixels are known.
#[derive(Debug, Clone, Copy)]
pub struct KnownPart<'a> {
    /// Index of its salient region.
    pub region: usize,
    /// Its pixels.
    pub mask: &'a Mask,
}

/// The objects of a frame after parts have been recognised among them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Settled {
    /// By region, in increasing order, and largest first within a region.
    pub objects: Vec<ObjectRegion>,
    /// For every known part the index of its object; `None` of a part that the parts before it cover.
    pub of_parts: Vec<Option<usize>>,
    /// For every object of before the indices of those that have pixels of it and are no known part.
    pub remains: Vec<Vec<usize>>,
}

/// Settles the objects of a frame by the parts that are known.
///
/// # Arguments
/// * `objects` - those of the separation, whose masks do not overlap
/// * `parts` - the parts; of pixels that two of them have, those of the first stay
/// * `min_area_px` - connected pixels fewer than these are no object, unless they are a known part
pub fn settle_objects(objects: &[ObjectRegion], parts: &[KnownPart<'_>], min_area_px: u32) -> Settled {
    let taken = Taken::by(parts);
    let mut regions: Vec<usize> =
        objects.iter().map(|object| object.region).chain(parts.iter().map(|part| part.region)).collect();
    regions.sort_unstable();
    regions.dedup();
    let of_region = |scratch: &mut Scratch, &region: &usize| {
        let own: Vec<usize> = (0..objects.len()).filter(|&i| objects[i].region == region).collect();
        let known: Vec<usize> = (0..parts.len()).filter(|&i| parts[i].region == region).collect();
        let is_free = |mask: &Mask| mask.runs().all(|run| taken.is_free(&run));
        if known.is_empty() && own.iter().all(|&i| objects[i].masks().all(is_free)) {
            return own.iter().map(|&i| (objects[i].clone(), Origin::Object(vec![i]))).collect();
        }
        settle_region(scratch, objects, &own, parts, &known, &taken, min_area_px)
    };
    let found: Vec<Vec<(ObjectRegion, Origin)>> = regions.par_iter().map_init(Scratch::default, of_region).collect();
    let mut settled =
        Settled { objects: Vec::new(), of_parts: vec![None; parts.len()], remains: vec![Vec::new(); objects.len()] };
    for (object, origin) in found.into_iter().flatten() {
        let index = settled.objects.len();
        settled.objects.push(object);
        match origin {
            Origin::Part(part) => settled.of_parts[part] = Some(index),
            Origin::Object(of) => of.iter().for_each(|&i| settled.remains[i].push(index)),
        }
    }
    settled
}

/// Where an object comes from.
enum Origin {
    /// It is this part.
    Part(usize),
    /// It has pixels of these objects.
    Object(Vec<usize>),
}

/// Which part has a pixel.
struct Taken {
    bbox: Option<BoundingBox>,
    /// 1 + the index of the part, 0 without one.
    owners: Vec<u32>,
}

impl Taken {
    fn by(parts: &[KnownPart<'_>]) -> Self {
        let bbox = parts.iter().map(|part| part.mask.bbox()).reduce(|a, b| a.union(&b));
        let mut taken = Self { bbox, owners: Vec::new() };
        taken.owners.resize(bbox.map_or(0, |b| b.width as usize * b.height as usize), 0);
        for (number, part) in (1..).zip(parts) {
            for run in part.mask.runs() {
                if let Some(pixels) = taken.range(&run) {
                    let free = taken.owners[pixels].iter_mut().filter(|owner| **owner == 0);
                    free.for_each(|owner| *owner = number);
                }
            }
        }
        taken
    }

    /// Where the pixels of a run stand, as far as they lie in the box.
    fn range(&self, run: &MaskRun) -> Option<std::ops::Range<usize>> {
        let b = self.bbox?;
        let (start, end) = (run.start.max(b.x), run.end.min(b.x + b.width));
        if !(b.y..=b.bottom()).contains(&run.y) || start >= end {
            return None;
        }
        let row = (run.y - b.y) as usize * b.width as usize;
        Some(row + (start - b.x) as usize..row + (end - b.x) as usize)
    }

    /// The part that has a pixel.
    fn owner(&self, x: u32, y: u32) -> Option<usize> {
        let range = self.range(&MaskRun { y, start: x, end: x + 1 })?;
        (self.owners[range.start] as usize).checked_sub(1)
    }

    fn is_free(&self, run: &MaskRun) -> bool {
        self.range(run).is_none_or(|pixels| self.owners[pixels].iter().all(|&owner| owner == 0))
    }
}

fn settle_region(
    scratch: &mut Scratch,
    objects: &[ObjectRegion],
    own: &[usize],
    parts: &[KnownPart<'_>],
    known: &[usize],
    taken: &Taken,
    min_area_px: u32,
) -> Vec<(ObjectRegion, Origin)> {
    let masks = own.iter().flat_map(|&i| objects[i].masks()).chain(known.iter().map(|&i| parts[i].mask));
    let Some(bbox) = masks.map(Mask::bbox).reduce(|a, b| a.union(&b)) else { return Vec::new() };
    let region = known.first().map(|&i| parts[i].region).or(own.first().map(|&i| objects[i].region)).unwrap_or(0);
    let width = bbox.width as usize;
    let index = |x: u32, y: u32| (y - bbox.y) as usize * width + (x - bbox.x) as usize;
    let mut crop = Crop::blank(bbox);
    let paint = |mask: &Mask, mut set: Box<dyn FnMut(usize) + '_>| {
        for run in mask.runs() {
            (run.start..run.end).filter(|&x| taken.owner(x, run.y).is_none()).for_each(|x| set(index(x, run.y)));
        }
    };
    for &i in own {
        if let Some(shadow) = &objects[i].shadow {
            paint(shadow, Box::new(|at| crop.codes[at] = SHADOW));
        }
    }
    // What is left of the objects, and the seams in it.
    let mut left = vec![0u8; crop.codes.len()];
    let mut core = vec![0u8; crop.codes.len()];
    for &i in own {
        let mask = &objects[i].mask;
        if mask.runs().all(|run| taken.is_free(&run)) {
            paint(mask, Box::new(|at| (left[at], core[at]) = (1, 1)));
        } else {
            let mut rest = vec![0u8; crop.codes.len()];
            paint(mask, Box::new(|at| rest[at] = 1));
            for ((core, left), (open, rest)) in
                core.iter_mut().zip(&mut left).zip(opened(&rest, width, SEAM_PX).iter().zip(&rest))
            {
                (*core, *left) = (*core | open, *left | rest);
            }
        }
    }
    let mut shadow = Vec::new();
    let mut seams = Crop::blank(bbox);
    for (i, code) in seams.codes.iter_mut().enumerate() {
        *code = if left[i] != 0 && core[i] == 0 { OBJECT } else { crop.codes[i] };
    }
    connected(&seams, u32::MAX, &mut shadow);
    for run in &shadow {
        let row = run.y as usize * width;
        crop.codes[row + run.start as usize..row + run.end as usize].fill(SHADOW);
    }
    for (code, _) in crop.codes.iter_mut().zip(&core).filter(|(_, core)| **core != 0) {
        *code = OBJECT;
    }
    shadow.clear();
    let mut found: Vec<(Vec<MaskRun>, Option<usize>)> =
        connected(&crop, min_area_px, &mut shadow).into_iter().map(|runs| (runs, None)).collect();
    for &part in known {
        let mut sheet = Crop::blank(bbox);
        for run in parts[part].mask.runs() {
            for x in (run.start..run.end).filter(|&x| taken.owner(x, run.y) == Some(part)) {
                sheet.codes[index(x, run.y)] = OBJECT;
            }
        }
        // Of a part that another one cuts in two, the larger piece.
        let pieces = connected(&sheet, 1, &mut Vec::new());
        found.extend(pieces.into_iter().next().map(|runs| (runs, Some(part))));
    }
    let area = |runs: &[MaskRun]| runs.iter().map(|run| run.end - run.start).sum::<u32>();
    found.sort_by_key(|(runs, _)| std::cmp::Reverse(area(runs)));
    let (runs, origins): (Vec<Vec<MaskRun>>, Vec<Option<usize>>) = found.into_iter().unzip();
    let of_remains = |object: &ObjectRegion| {
        let has =
            |&i: &usize| object.mask.runs().any(|run| (run.start..run.end).any(|x| objects[i].mask.contains(x, run.y)));
        own.iter().copied().filter(has).collect()
    };
    let measured = scratch.measure_all(region, bbox, runs, &shadow).into_iter().zip(origins);
    measured
        .filter_map(|(object, part)| {
            let object = object?;
            let origin = part.map_or_else(|| Origin::Object(of_remains(&object)), Origin::Part);
            Some((object, origin))
        })
        .collect()
}

/// The pixels of all squares of `2 radius + 1` pixels a side that fit into a sheet.
fn opened(sheet: &[u8], width: usize, radius: usize) -> Vec<u8> {
    let outside: Vec<u8> = sheet.iter().map(|&inside| 1 - inside).collect();
    let core: Vec<u8> = grown(&outside, width, radius, 1).iter().map(|&outside| 1 - outside).collect();
    grown(&core, width, radius, 0)
}

/// All pixels no farther from those of a sheet than so many rows and columns; beyond the sheet lies `beyond`.
fn grown(sheet: &[u8], width: usize, radius: usize, beyond: u8) -> Vec<u8> {
    let width = width.max(1);
    let height = sheet.len() / width;
    let mut across = vec![0u8; sheet.len()];
    let reach = |at: usize, count: usize| (at.saturating_sub(radius), (at + radius).min(count.saturating_sub(1)));
    let is_near_end = |at: usize, count: usize| at < radius || at + radius >= count;
    for (to, row) in across.chunks_exact_mut(width).zip(sheet.chunks_exact(width)) {
        for (x, to) in to.iter_mut().enumerate() {
            let (first, last) = reach(x, width);
            let edge = beyond != 0 && is_near_end(x, width);
            *to = u8::from(edge || row[first..=last].iter().any(|&bit| bit != 0));
        }
    }
    let mut all = vec![0u8; sheet.len()];
    for (y, to) in all.chunks_exact_mut(width).enumerate() {
        let (first, last) = reach(y, height);
        if beyond != 0 && is_near_end(y, height) {
            to.fill(1);
        }
        for row in across[first * width..(last + 1) * width].chunks_exact(width) {
            to.iter_mut().zip(row).for_each(|(to, from)| *to |= from);
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::objects::find_objects;

    /// The objects of drawings, one region each: `#` object, `s` shadow, `t` table.
    fn objects(drawings: &[(u32, u32, &[&str])]) -> Vec<ObjectRegion> {
        objects_of(1, drawings)
    }

    /// Those of at least so many pixels.
    fn objects_of(min_area_px: u32, drawings: &[(u32, u32, &[&str])]) -> Vec<ObjectRegion> {
        let mut crops: Vec<Crop> = drawings.iter().map(|(x, y, rows)| Crop::drawn(*x, *y, rows)).collect();
        let mut objects = Vec::new();
        find_objects(&mut crops, min_area_px, &mut objects);
        objects
    }

    fn rectangle([x, y, width, height]: [u32; 4]) -> Mask {
        let runs: Vec<MaskRun> = (y..y + height).map(|y| MaskRun { y, start: x, end: x + width }).collect();
        Mask::from_runs(&runs).unwrap()
    }

    fn pixels(mask: &Mask) -> Vec<(u32, u32)> {
        mask.runs().flat_map(|run| (run.start..run.end).map(move |x| (x, run.y))).collect()
    }

    #[test]
    fn a_known_part_joins_its_pieces_and_regains_what_was_taken_for_shadow() {
        let before = objects(&[(100, 50, &["##ss###sss", "##ss###sss", "  ssssssss"])]);
        assert_eq!(before.len(), 2);
        let mask = rectangle([100, 50, 7, 2]);
        let settled = settle_objects(&before, &[KnownPart { region: 0, mask: &mask }], 1);
        let [object] = &settled.objects[..] else { panic!("{} objects", settled.objects.len()) };
        assert_eq!((object.region, object.area, &object.mask), (0, 14, &mask));
        assert_eq!(object.centroid, [103.0, 50.5]);
        assert_eq!((object.oriented_box.length_px, object.outline.len()), (7.0, 14));
        let shadow = pixels(object.shadow.as_ref().unwrap());
        assert_eq!(shadow.len(), 14);
        assert!(shadow.iter().all(|&(x, y)| x >= 107 || y == 52), "{shadow:?}");
        assert_eq!((settled.of_parts, settled.remains), (vec![Some(0)], vec![vec![], vec![]]));
    }

    #[test]
    fn a_seam_goes_to_the_shadow_it_touches_or_the_table_and_a_neighbour_stays() {
        // One object of 34 x 10 pixels; shadow touches it below.
        let row: String = "#".repeat(34);
        let shade: String = "s".repeat(34);
        let mut rows = vec![row.as_str(); 10];
        rows.push(&shade);
        let before = objects(&[(10, 20, &rows)]);
        // All but two rows above, two below, and nine columns on the right.
        let mask = rectangle([10, 22, 25, 6]);
        let settled = settle_objects(&before, &[KnownPart { region: 0, mask: &mask }], 1);
        let [part, neighbour] = &settled.objects[..] else { panic!("{} objects", settled.objects.len()) };
        assert_eq!(part.mask, mask);
        assert_eq!(neighbour.mask, rectangle([35, 20, 9, 10]));
        let mut shadow: Vec<_> = [part, neighbour].iter().flat_map(|o| pixels(o.shadow.as_ref().unwrap())).collect();
        shadow.sort_unstable_by_key(|&(x, y)| (y, x));
        let expected = [pixels(&rectangle([10, 28, 25, 2])), pixels(&rectangle([10, 30, 34, 1]))].concat();
        assert_eq!(shadow, expected);
        assert_eq!((settled.of_parts, settled.remains), (vec![Some(0)], vec![vec![1]]));
        // What is left is too small for an object.
        let settled = settle_objects(&before, &[KnownPart { region: 0, mask: &mask }], 91);
        assert_eq!((settled.objects.len(), &settled.remains[..]), (1, &[vec![]][..]));
    }

    #[test]
    fn of_two_parts_in_one_place_the_first_has_the_pixels() {
        let before = objects(&[(5, 5, &["########", "########"])]);
        let (first, second, hidden) = (rectangle([5, 5, 5, 2]), rectangle([8, 5, 5, 2]), rectangle([6, 5, 2, 2]));
        let parts = [&first, &second, &hidden].map(|mask| KnownPart { region: 0, mask });
        let settled = settle_objects(&before, &parts, 1);
        let masks: Vec<&Mask> = settled.objects.iter().map(|object| &object.mask).collect();
        assert_eq!(masks, [&first, &rectangle([10, 5, 3, 2])]);
        assert_eq!(settled.of_parts, [Some(0), Some(1), None]);
        // Cut in two by another, a part is its larger piece.
        let settled = settle_objects(&before, &[parts[2], parts[0]], 1);
        assert_eq!(settled.of_parts, [Some(0), Some(1)]);
        assert_eq!(settled.objects[1].mask, rectangle([8, 5, 2, 2]));
    }

    #[test]
    fn what_is_not_known_stays_as_it_was() {
        let drawings: [(u32, u32, &[&str]); 3] =
            [(100, 50, &["##ss###", "##ss###"]), (20, 20, &["####ss", "####ss", "tttttt"]), (60, 20, &["###", "sss"])];
        let before = objects(&drawings);
        let settled = settle_objects(&before, &[], 1);
        assert_eq!(settled.objects, before);
        assert_eq!(settled.remains, [[0], [1], [2], [3]]);
        // A part of one region that reaches into the next takes what it needs of that alone.
        let mask = rectangle([20, 20, 41, 1]);
        let settled = settle_objects(&before, &[KnownPart { region: 1, mask: &mask }], 1);
        let of_region = |region: usize| settled.objects.iter().filter(|o| o.region == region).collect::<Vec<_>>();
        assert_eq!(of_region(0), before[..2].iter().collect::<Vec<_>>());
        assert_eq!(of_region(1)[0].mask, mask);
        assert!(of_region(2).is_empty(), "a row of two pixels is a seam");
        assert_eq!(settle_objects(&[], &[], 1), Settled::default());
    }

    proptest! {
        #[test]
        fn no_pixel_is_of_two_objects_and_none_is_invented(
            cells in proptest::collection::vec(0usize..3, 40 * 24),
            blocks in proptest::collection::vec((0u32..30, 0u32..18, 1u32..14, 1u32..10), 0..4),
        ) {
            let rows: Vec<String> =
                cells.chunks(40).map(|row| row.iter().map(|&c| ['#', 's', 't'][c]).collect()).collect();
            let rows: Vec<&str> = rows.iter().map(String::as_str).collect();
            let before = objects_of(5, &[(3, 4, &rows)]);
            let masks: Vec<Mask> = blocks.iter().map(|&(x, y, w, h)| rectangle([3 + x, 4 + y, w, h])).collect();
            let parts: Vec<KnownPart<'_>> = masks.iter().map(|mask| KnownPart { region: 0, mask }).collect();
            let settled = settle_objects(&before, &parts, 5);
            let mut seen = std::collections::BTreeSet::new();
            for mask in settled.objects.iter().flat_map(ObjectRegion::masks) {
                for at in pixels(mask) {
                    prop_assert!(seen.insert(at), "{:?} twice", at);
                    let was = before.iter().flat_map(ObjectRegion::masks).chain(&masks);
                    prop_assert!(was.into_iter().any(|mask| mask.contains(at.0, at.1)));
                }
            }
            for (mask, index) in masks.iter().zip(&settled.of_parts) {
                let object = index.map(|i| &settled.objects[i].mask);
                prop_assert!(object.is_none_or(|own| pixels(own).iter().all(|&(x, y)| mask.contains(x, y))));
            }
            for (i, remains) in settled.remains.iter().enumerate() {
                for &index in remains {
                    let own = pixels(&settled.objects[index].mask);
                    prop_assert!(own.iter().any(|&(x, y)| before[i].mask.contains(x, y)));
                    prop_assert!(settled.objects[index].area >= 5);
                }
            }
            let areas: Vec<u32> = settled.objects.iter().map(|object| object.area).collect();
            prop_assert!(areas.is_sorted_by(|a, b| a >= b));
        }
    }
}
