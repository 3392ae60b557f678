//! Cuts parts asunder that touch: in a neck of a few pixels, or along a contact that is short for their outlines and at which
//! the colour changes.

use crate::components::Components;
use crate::crop::{Crop, OBJECT, SHADOW};

/// Scratch memory of [`cut_necks`].
#[derive(Debug, Default)]
pub(crate) struct Necks {
    core: Vec<u8>,
    eroding: Vec<u8>,
    labels: Vec<u32>,
    queue: Vec<u32>,
    cores: Components,
    objects: Components,
    areas: Vec<u32>,
    holders: Vec<u32>,
    /// The pixels of the lines that were drawn last, with the cores that meet there, the lower number first.
    line: Vec<LinePixel>,
    /// Pixels of what grew from each core that have a neighbour which is no object.
    outlines: Vec<u32>,
}

#[derive(Debug, Clone, Copy)]
struct LinePixel {
    cores: [u32; 2],
    pixel: u32,
}

/// An outline is at least so many times as long as a contact with another part,
const LEAST_OUTLINE_OF_CONTACT: u32 = 10;
/// and so far the mean colours on both sides are apart, sRGB levels in any channel,
const LEAST_DIFFERENCE_AT_CONTACT: f32 = 25.0;
/// up to so many pixels from its middle.
const CONTACT_SEEN_PX: usize = 12;

impl Necks {
    /// Whether an object holds two cores of that many pixels: there may be a neck. Runs tell it sooner than pixels, and most
    /// objects hold one.
    fn are_possible(&mut self, codes: &[u8], width: usize, min_core: usize) -> bool {
        let Self { core, cores, objects, areas, holders, .. } = self;
        cores.find(core, width, 1, |_, _| {});
        areas.clear();
        areas.resize(cores.runs.len(), 0);
        for i in 0..cores.runs.len() {
            areas[cores.root(i)] += cores.runs[i].end - cores.runs[i].start;
        }
        let is_large = |area: &u32| *area > 0 && *area as usize >= min_core;
        if areas.iter().filter(|area| is_large(area)).count() < 2 {
            return false;
        }
        objects.find(codes, width, OBJECT, |_, _| {});
        holders.clear();
        holders.resize(objects.runs.len(), u32::MAX);
        let mut object = 0;
        for i in 0..cores.runs.len() {
            let (run, root) = (cores.runs[i], cores.root(i));
            // Every run of a core lies within one of an object.
            while objects.runs.get(object).is_some_and(|holder| (holder.y, holder.end) < (run.y, run.end)) {
                object += 1;
            }
            if object == objects.runs.len() || !is_large(&areas[root]) {
                continue;
            }
            let holder = &mut holders[objects.root(object)];
            if *holder != u32::MAX && *holder != root as u32 {
                return true;
            }
            *holder = root as u32;
        }
        false
    }
}

/// Parts objects at necks that are at most `2 * radius` pixels wide, where both ends hold a core of `min_core` pixels or
/// more; the pixels between go to the nearer core, and a line of shadow is drawn where the two meet.
pub(crate) fn cut_necks(crop: &mut Crop, radius: usize, min_core: usize, scratch: &mut Necks) {
    draw_lines(crop, radius, min_core, scratch);
}

/// As [`cut_necks`], but only where the outlines of both sides are long for the line, and their colours differ beside it.
/// `color` gives the sRGB levels of a pixel of the crop.
pub(crate) fn cut_contacts(
    crop: &mut Crop,
    radius: usize,
    min_core: usize,
    color: impl Fn(usize) -> [u8; 3],
    scratch: &mut Necks,
) {
    if !draw_lines(crop, radius, min_core, scratch) {
        return;
    }
    let width = crop.width();
    let Necks { labels, line, outlines, .. } = scratch;
    outlines.clear();
    for (i, &label) in labels.iter().enumerate().filter(|(i, label)| **label > 0 && crop.codes[*i] == OBJECT) {
        let side = label as usize;
        if outlines.len() <= side {
            outlines.resize(side + 1, 0);
        }
        // At the border of the crop a neighbour is missing.
        let is_inside = around(i, width, labels.len()).filter(|&n| crop.codes[n] == OBJECT).count() == 4;
        outlines[side] += u32::from(!is_inside);
    }
    line.sort_unstable_by_key(|pixel| (pixel.cores, pixel.pixel));
    for contact in line.chunk_by(|a, b| a.cores == b.cores) {
        let cores = contact[0].cores;
        let outline = |core: u32| outlines.get(core as usize).copied().unwrap_or(0);
        let is_short = cores.into_iter().all(|core| outline(core) >= LEAST_OUTLINE_OF_CONTACT * contact.len() as u32);
        if is_short && difference_at(contact, cores, &crop.codes, labels, width, &color) >= LEAST_DIFFERENCE_AT_CONTACT
        {
            continue;
        }
        contact.iter().for_each(|pixel| crop.codes[pixel.pixel as usize] = OBJECT);
    }
}

/// How far the mean colours on both sides of a contact are apart, round its middle; the largest over the channels.
fn difference_at(
    contact: &[LinePixel],
    cores: [u32; 2],
    codes: &[u8],
    labels: &[u32],
    width: usize,
    color: impl Fn(usize) -> [u8; 3],
) -> f32 {
    let count = contact.len().max(1);
    let places = contact.iter().map(|pixel| (pixel.pixel as usize % width, pixel.pixel as usize / width));
    let sum = places.fold((0, 0), |sum, place| (sum.0 + place.0, sum.1 + place.1));
    let (x, y) = (sum.0 / count, sum.1 / count);
    let mut sums = [[0.0f32; 4]; 2];
    let rows = y.saturating_sub(CONTACT_SEEN_PX)..(y + CONTACT_SEEN_PX + 1).min(labels.len() / width);
    for row in rows {
        for i in row * width + x.saturating_sub(CONTACT_SEEN_PX)..row * width + (x + CONTACT_SEEN_PX + 1).min(width) {
            let Some(side) = cores.iter().position(|core| *core == labels[i]) else { continue };
            if codes[i] == OBJECT {
                let [r, g, b] = color(i).map(f32::from);
                [r, g, b, 1.0].into_iter().zip(&mut sums[side]).for_each(|(level, sum)| *sum += level);
            }
        }
    }
    let [a, b] = sums.map(|[r, g, b, n]| [r, g, b].map(|sum| sum / n.max(1.0)));
    (0..3).map(|c| (a[c] - b[c]).abs()).fold(0.0, f32::max)
}

/// Draws the lines of shadow at which objects are cut, and keeps what grew from every core, and the pixels of the lines.
/// Whether there are any.
fn draw_lines(crop: &mut Crop, radius: usize, min_core: usize, scratch: &mut Necks) -> bool {
    let width = crop.width();
    scratch.core.clear();
    scratch.core.extend(crop.codes.iter().map(|&code| u8::from(code == OBJECT)));
    for _ in 0..radius {
        erode(&mut scratch.core, &mut scratch.eroding, width);
    }
    scratch.line.clear();
    if !scratch.are_possible(&crop.codes, width, min_core) {
        return false;
    }
    let Necks { core, labels, queue, line, .. } = scratch;
    labels.clear();
    labels.resize(core.len(), 0);
    queue.clear();
    // Cores: 4-connected, large enough.
    let mut cores = 0;
    for i in 0..core.len() {
        if core[i] == 0 || labels[i] != 0 {
            continue;
        }
        let start = queue.len();
        labels[i] = u32::MAX;
        queue.push(i as u32);
        let mut at = start;
        while at < queue.len() {
            for n in around(queue[at] as usize, width, core.len()) {
                if core[n] == 1 && labels[n] == 0 {
                    labels[n] = u32::MAX;
                    queue.push(n as u32);
                }
            }
            at += 1;
        }
        if queue.len() - start >= min_core {
            cores += 1;
            queue[start..].iter().for_each(|&i| labels[i as usize] = cores);
        } else {
            // Too small to be the end of a neck: as any other pixel between.
            queue[start..].iter().for_each(|&i| (labels[i as usize], core[i as usize]) = (0, 0));
            queue.truncate(start);
        }
    }
    if cores < 2 {
        return false;
    }
    let mut at = 0;
    while at < queue.len() {
        let i = queue[at] as usize;
        at += 1;
        // A pixel of the line passes nothing on.
        if crop.codes[i] != OBJECT {
            continue;
        }
        for n in around(i, width, labels.len()) {
            if crop.codes[n] == OBJECT && labels[n] == 0 {
                labels[n] = labels[i];
                queue.push(n as u32);
            } else if crop.codes[n] == OBJECT && labels[n] != labels[i] && core[n] == 0 {
                crop.codes[n] = SHADOW;
                let (a, b) = (labels[i].min(labels[n]), labels[i].max(labels[n]));
                line.push(LinePixel { cores: [a, b], pixel: n as u32 });
            }
        }
    }
    !line.is_empty()
}

/// Neighbours that share an edge.
fn around(i: usize, width: usize, len: usize) -> impl Iterator<Item = usize> {
    let x = i % width;
    [
        (x > 0).then(|| i - 1),
        (x + 1 < width).then_some(i + 1),
        i.checked_sub(width),
        Some(i + width).filter(|&n| n < len),
    ]
    .into_iter()
    .flatten()
}

/// Keeps pixels whose eight neighbours are all set; beyond the crop nothing is.
fn erode(core: &mut [u8], scratch: &mut Vec<u8>, width: usize) {
    for step in [1, width] {
        scratch.clear();
        scratch.extend_from_slice(core);
        if scratch.len() <= 2 * step {
            core.fill(0);
            return;
        }
        let end = core.len() - step;
        core[..step].fill(0);
        core[end..].fill(0);
        let sides = scratch.iter().zip(&scratch[2 * step..]);
        for ((to, &here), (&before, &after)) in core[step..end].iter_mut().zip(&scratch[step..end]).zip(sides) {
            *to = before & here & after;
        }
    }
    // A shift along the sheet has carried the ends of rows over to the next.
    for row in core.chunks_exact_mut(width) {
        row[0] = 0;
        row[width - 1] = 0;
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const RADIUS: usize = 2;

    /// Two squares of 12 x 12 pixels, and between them a bar of `neck` rows.
    fn dumbbell(neck: usize) -> Crop {
        let row = |y: usize| {
            let in_square = (1..13).contains(&y);
            let bar = if in_square && y.abs_diff(7) * 2 < neck + usize::from(y < 7) { '#' } else { 's' };
            let square = if in_square { '#' } else { 't' };
            let across = |c: char, n: usize| std::iter::repeat_n(c, n);
            let code = |x: char| across(x, 12).chain(across(bar, 6)).chain(across(x, 12));
            across(' ', 1).chain(code(square)).chain(across(' ', 1)).collect::<String>()
        };
        let rows: Vec<String> = (0..14).map(row).collect();
        Crop::drawn(0, 0, &rows.iter().map(String::as_str).collect::<Vec<_>>())
    }

    fn cut(crop: &mut Crop, min_core: usize) {
        cut_necks(crop, RADIUS, min_core, &mut Necks::default());
    }

    /// Two squares of 30 x 30 pixels that touch along `contact` rows in their middle.
    fn touching(contact: usize) -> Crop {
        let row = |y: usize| {
            let between = if y.abs_diff(15) * 2 < contact { '#' } else { 's' };
            let across = |c: char, n: usize| std::iter::repeat_n(c, n);
            across('#', 30).chain(across(between, 2)).chain(across('#', 30)).collect::<String>()
        };
        let rows: Vec<String> = (0..30).map(row).collect();
        Crop::drawn(0, 0, &rows.iter().map(String::as_str).collect::<Vec<_>>())
    }

    /// How many objects `cut_contacts` leaves, with these colours left and right.
    fn objects_after(crop: &mut Crop, left: [u8; 3], right: [u8; 3]) -> usize {
        let width = crop.width();
        let color = |i: usize| if i % width < 31 { left } else { right };
        cut_contacts(crop, 8, 100, color, &mut Necks::default());
        let is_object: Vec<bool> = crop.codes.iter().map(|&code| code == OBJECT).collect();
        components(&is_object, width).len()
    }

    const GREY: [u8; 3] = [120, 120, 120];
    const BLUE: [u8; 3] = [60, 90, 160];

    #[test]
    fn a_short_contact_of_two_colours_is_cut() {
        let mut crop = touching(8);
        assert_eq!(objects_after(&mut crop, GREY, BLUE), 2);
        let pixels = |crop: &Crop| crop.codes.iter().filter(|&&code| code == OBJECT).count();
        assert!(pixels(&touching(8)) - pixels(&crop) <= 10, "a line of a pixel and no more is lost");
    }

    #[test]
    fn a_contact_of_one_colour_or_a_long_one_stays() {
        let mut one_color = touching(8);
        assert_eq!(objects_after(&mut one_color, GREY, [130, 125, 120]), 1);
        assert_eq!(one_color.codes, touching(8).codes, "and is as it was");
        assert_eq!(objects_after(&mut touching(14), GREY, BLUE), 1);
        // A part of two colours has no waist.
        assert_eq!(objects_after(&mut touching(30), GREY, BLUE), 1);
    }

    #[test]
    fn contacts_of_several_parts_are_judged_one_by_one() {
        let row = |y: usize| {
            let bridge = if y.abs_diff(15) < 3 { '#' } else { 's' };
            let square = std::iter::repeat_n('#', 30);
            let bridge = || std::iter::repeat_n(bridge, 2);
            square.clone().chain(bridge()).chain(square.clone()).chain(bridge()).chain(square).collect::<String>()
        };
        let rows: Vec<String> = (0..30).map(row).collect();
        let mut crop = Crop::drawn(0, 0, &rows.iter().map(String::as_str).collect::<Vec<_>>());
        let width = crop.width();
        // Grey, grey, blue: only the second contact parts two colours.
        cut_contacts(&mut crop, 6, 100, |i| if i % width < 63 { GREY } else { BLUE }, &mut Necks::default());
        let is_object: Vec<bool> = crop.codes.iter().map(|&code| code == OBJECT).collect();
        let mut areas: Vec<usize> = components(&is_object, width).iter().map(Vec::len).collect();
        areas.sort_unstable();
        assert_eq!(areas.len(), 2);
        assert!(areas[0] < 1000 && areas[1] > 1700, "{areas:?}");
    }

    /// The 4-connected pixels of each object.
    fn components(is_object: &[bool], width: usize) -> Vec<Vec<usize>> {
        let mut seen = vec![false; is_object.len()];
        let mut found = Vec::new();
        for start in 0..seen.len() {
            let (mut stack, mut pixels) = (vec![start], Vec::new());
            while let Some(i) = stack.pop() {
                if is_object[i] && !std::mem::replace(&mut seen[i], true) {
                    pixels.push(i);
                    stack.extend(around(i, width, seen.len()));
                }
            }
            found.extend((!pixels.is_empty()).then_some(pixels));
        }
        found
    }

    fn objects(crop: &Crop) -> Vec<Vec<usize>> {
        components(&crop.codes.iter().map(|&code| code == OBJECT).collect::<Vec<_>>(), crop.width())
    }

    /// Sizes of the objects, largest first.
    fn sizes(crop: &Crop) -> Vec<usize> {
        let mut sizes: Vec<usize> = objects(crop).iter().map(Vec::len).collect();
        sizes.sort_unstable_by_key(|&size| std::cmp::Reverse(size));
        sizes
    }

    #[test]
    fn parts_that_touch_in_a_neck_are_two() {
        for neck in 1..=2 * RADIUS {
            let mut crop = dumbbell(neck);
            let before = crop.codes.clone();
            assert_eq!(sizes(&crop), [2 * 144 + 6 * neck], "as painted");
            cut(&mut crop, 40);
            let sizes = sizes(&crop);
            assert_eq!(sizes.len(), 2, "neck of {neck}");
            // Each keeps about half of the neck: all that is lost is a line across it.
            assert!(sizes[1] >= 144 + 2 * neck, "{sizes:?}");
            let lost: Vec<usize> = (0..before.len()).filter(|&i| crop.codes[i] != before[i]).collect();
            assert!(lost.len() <= 2 * neck && !lost.is_empty(), "{} pixels of a neck of {neck}", lost.len());
            for i in lost {
                assert_eq!((before[i], crop.codes[i]), (OBJECT, SHADOW));
                assert!((13..19).contains(&(i % crop.width())), "in the neck");
            }
        }
    }

    #[test]
    fn a_waist_is_not_a_neck() {
        let mut crop = dumbbell(2 * RADIUS + 1);
        let before = crop.codes.clone();
        cut(&mut crop, 40);
        assert_eq!(crop.codes, before);
    }

    #[test]
    fn what_hangs_on_a_neck_but_is_small_stays_on() {
        // 12 x 12 pixels less two on each side are 64.
        let mut crop = dumbbell(3);
        let before = crop.codes.clone();
        cut(&mut crop, 65);
        assert_eq!(crop.codes, before);
        cut(&mut crop, 64);
        assert_eq!(sizes(&crop).len(), 2);
    }

    #[test]
    fn a_bead_on_the_neck_does_not_hold_two_parts_together() {
        // The bead has a core, but a small one, and the parts are equally far from it.
        let mut crop = Crop::drawn(
            0,
            0,
            &[
                "########           ########",
                "########  #######  ########",
                "########  #######  ########",
                "########  #######  ########",
                "###########################",
                "########  #######  ########",
                "########  #######  ########",
                "########  #######  ########",
                "########           ########",
            ],
        );
        cut(&mut crop, 12);
        assert_eq!(sizes(&crop).len(), 2);
    }

    #[test]
    fn a_thin_part_is_not_cut() {
        let mut crop =
            Crop::drawn(0, 0, &["t####################t", "t####################t", "s###################st"]);
        let before = crop.codes.clone();
        cut(&mut crop, 1);
        assert_eq!(crop.codes, before);
    }

    #[test]
    fn parts_that_do_not_touch_stay_as_they_are() {
        let mut crop = dumbbell(0);
        let before = crop.codes.clone();
        cut(&mut crop, 40);
        assert_eq!(crop.codes, before);
    }

    #[test]
    fn crops_without_room() {
        let drawings: [&[&str]; 5] = [&["#"], &["##"], &["#", "#"], &["##", "##"], &["##########"]];
        for rows in drawings {
            let mut crop = Crop::drawn(0, 0, rows);
            cut(&mut crop, 1);
            assert!(crop.codes.iter().all(|&code| code == OBJECT));
        }
        cut(&mut Crop::default(), 1);
    }

    proptest! {
        /// Only object becomes shadow, cores stay, and memory of an earlier crop says nothing.
        #[test]
        fn nothing_but_necks_is_touched(width in 1usize..20, radius in 0usize..3, codes in prop::collection::vec(0u8..14, 1..300)) {
            let letters = |c: &u8| [' ', 's', 't'].get(usize::from(*c)).copied().unwrap_or('#');
            let rows: Vec<String> = codes.chunks_exact(width).map(|row| row.iter().map(letters).collect()).collect();
            prop_assume!(!rows.is_empty());
            let mut crop = Crop::drawn(0, 0, &rows.iter().map(String::as_str).collect::<Vec<_>>());
            let before = crop.codes.clone();
            let mut scratch = Necks::default();
            cut_necks(&mut dumbbell(3), RADIUS, 40, &mut scratch);
            cut_necks(&mut crop, radius, 4, &mut scratch);
            for (&was, &is) in before.iter().zip(&crop.codes) {
                prop_assert!(was == is || (was, is) == (OBJECT, SHADOW));
            }
            let mut fresh = Crop::drawn(0, 0, &rows.iter().map(String::as_str).collect::<Vec<_>>());
            cut_necks(&mut fresh, radius, 4, &mut Necks::default());
            prop_assert_eq!(&fresh.codes, &crop.codes);
            // Whether the eight neighbours at any distance up to the radius are object.
            let (w, h, r) = (width as isize, rows.len() as isize, radius as isize);
            let is_set = |x: isize, y: isize| (0..w).contains(&x) && (0..h).contains(&y) && before[(y * w + x) as usize] == OBJECT;
            let is_core = |i: isize| (-r..=r).all(|dy| (-r..=r).all(|dx| is_set(i % w + dx, i / w + dy)));
            let cores = components(&(0..w * h).map(is_core).collect::<Vec<_>>(), width);
            let large: Vec<Vec<usize>> = cores.into_iter().filter(|core| core.len() >= 4).collect();
            for object in objects(&crop) {
                prop_assert!(large.iter().filter(|core| core.iter().any(|i| object.contains(i))).count() <= 1);
            }
            prop_assert!(large.iter().flatten().all(|&i| crop.codes[i] == OBJECT));
        }
    }
}
