//! From codes of pixels to objects: connected components, shadows to the nearest of them, measures.
//!
//! In: the crops that a method has written on. Out: the [`ObjectRegion`]s. Everything is done on runs of a row within
//! the box of a region.

use rayon::prelude::*;
use samsod_saliency::longest_axis_rad;
use samsod_segment::BoundingBox;

use crate::components::Components;
use crate::crop::{Crop, OBJECT, SHADOW};
use crate::nearest::NearestLabels;
use crate::outline::{Outlines, Tracer};
use crate::{Mask, MaskRun, OrientedBox};

/// One object: connected pixels of a salient region that are neither shadow nor table.
#[derive(Debug, Clone, PartialEq)]
pub struct ObjectRegion {
    /// Index of its region among the salient regions.
    pub region: usize,
    /// Its pixels, 4-connected; those of two objects never overlap. They may lie up to 4 px outside of the region, but never
    /// in another, unless the object is a part whose pixels are known ([`settle_objects`](crate::settle_objects)).
    pub mask: Mask,
    /// The shadow pixels of the region that are nearest to this object of it.
    pub shadow: Option<Mask>,
    /// Outer boundary, (x, y), px, through the centres of the boundary pixels: clockwise on the screen from the leftmost
    /// pixel of the topmost row, in steps to one of the eight neighbours; the last is a neighbour of the first. Parts one
    /// pixel wide are passed twice.
    pub outline: Vec<[i32; 2]>,
    /// The object's pixels round each hole, as `outline` but counter-clockwise.
    pub holes: Vec<Vec<[i32; 2]>>,
    /// Number of pixels of the mask.
    pub area: u32,
    /// Centre of area (x, y) of the mask, px, pixel centres at integers.
    pub centroid: [f32; 2],
    /// The smallest rectangle round the mask.
    pub oriented_box: OrientedBox,
    /// Direction of the longest axis (second moments), radians in (-pi/2, pi/2], counter-clockwise on the screen from
    /// image right; 0 where no axis is longest.
    pub axis_rad: f32,
}

impl ObjectRegion {
    /// Its own pixels, then those of its shadow.
    pub fn masks(&self) -> impl Iterator<Item = &Mask> {
        std::iter::once(&self.mask).chain(&self.shadow)
    }
}

/// Finds the objects of every region, in the order of regions, largest first within one. `crops` are used up.
pub(crate) fn find_objects(crops: &mut [Crop], min_area: u32, objects: &mut Vec<ObjectRegion>) {
    let found: Vec<Vec<ObjectRegion>> = crops
        .par_iter_mut()
        .enumerate()
        .map_init(Scratch::default, |scratch, (region, crop)| scratch.objects_of(region, crop, min_area))
        .collect();
    objects.clear();
    objects.extend(found.into_iter().flatten());
}

/// The 4-connected components of the object pixels of a crop that have `min_area` pixels, largest first, in its
/// coordinates; smaller ones that touch shadow are appended to the runs of shadow, after those of the crop.
pub(crate) fn connected(crop: &Crop, min_area: u32, shadow: &mut Vec<MaskRun>) -> Vec<Vec<MaskRun>> {
    let mut components = Components::default();
    find_components(&mut components, crop, shadow);
    sorted(&mut components, crop, min_area, shadow)
}

/// Scratch memory of one thread.
#[derive(Debug, Default)]
pub(crate) struct Scratch {
    components: Components,
    shadow: Vec<MaskRun>,
    nearest: NearestLabels,
    tracer: Tracer,
}

impl Scratch {
    fn objects_of(&mut self, region: usize, crop: &mut Crop, min_area: u32) -> Vec<ObjectRegion> {
        let Some(bbox) = crop.bbox else { return Vec::new() };
        crop.keep_rights();
        self.shadow.clear();
        find_components(&mut self.components, crop, &mut self.shadow);
        let parts = sorted(&mut self.components, crop, min_area, &mut self.shadow);
        let shadows = self.shares(&parts, bbox);
        let whole = parts.into_iter().zip(shadows);
        whole.filter_map(|(runs, shadow)| self.measure(region, bbox, runs, shadow)).collect()
    }

    /// The objects that some connected runs are, with the shadow that is nearest to each; all in coordinates of the box.
    /// `None` in the place of one without a pixel.
    pub(crate) fn measure_all(
        &mut self,
        region: usize,
        bbox: BoundingBox,
        parts: Vec<Vec<MaskRun>>,
        shadow: &[MaskRun],
    ) -> Vec<Option<ObjectRegion>> {
        self.shadow.clear();
        self.shadow.extend_from_slice(shadow);
        let shadows = self.shares(&parts, bbox);
        let whole = parts.into_iter().zip(shadows);
        whole.map(|(runs, shadow)| self.measure(region, bbox, runs, shadow)).collect()
    }

    /// The runs of shadow that are nearest to each object, in coordinates of the crop.
    fn shares(&mut self, parts: &[Vec<MaskRun>], bbox: BoundingBox) -> Vec<Vec<MaskRun>> {
        let mut shares = vec![Vec::new(); parts.len()];
        if let [only] = &mut shares[..] {
            std::mem::swap(only, &mut self.shadow);
            return shares;
        }
        if parts.is_empty() || self.shadow.is_empty() {
            return shares;
        }
        let labelled = (0..).zip(parts.iter().map(Vec::as_slice));
        self.nearest.fill(bbox.width as usize, bbox.height as usize, labelled);
        for run in &self.shadow {
            let mut start = run.start;
            while start < run.end {
                let label = self.nearest.label(start, run.y);
                let end = (start + 1..run.end).find(|&x| self.nearest.label(x, run.y) != label).unwrap_or(run.end);
                if let Some(share) = label.and_then(|l| shares.get_mut(l as usize)) {
                    share.push(MaskRun { y: run.y, start, end });
                }
                start = end;
            }
        }
        shares
    }

    fn measure(
        &mut self,
        region: usize,
        bbox: BoundingBox,
        mut runs: Vec<MaskRun>,
        mut shadow: Vec<MaskRun>,
    ) -> Option<ObjectRegion> {
        for run in runs.iter_mut().chain(&mut shadow) {
            *run = MaskRun { y: run.y + bbox.y, start: run.start + bbox.x, end: run.end + bbox.x };
        }
        let mask = Mask::from_runs(&runs)?;
        let Outlines { outer: outline, holes } = self.tracer.trace(&mask, &runs);
        let (area, centroid, axis_rad) = moments(&runs);
        Some(ObjectRegion {
            region,
            shadow: Mask::from_runs(&shadow),
            outline,
            holes,
            area,
            centroid,
            oriented_box: OrientedBox::around(&runs)?,
            axis_rad,
            mask,
        })
    }
}

/// Finds the components of object pixels, and appends the runs of shadow.
fn find_components(components: &mut Components, crop: &Crop, shadow: &mut Vec<MaskRun>) {
    let others = |code, run| {
        if code == SHADOW {
            shadow.push(run)
        }
    };
    components.find(&crop.codes, crop.width(), OBJECT, others);
}

/// The runs of every component of at least `min_area` pixels, largest first. Smaller ones go to the shadow that
/// they touch, and to the table where they touch none.
fn sorted(components: &mut Components, crop: &Crop, min_area: u32, shadow: &mut Vec<MaskRun>) -> Vec<Vec<MaskRun>> {
    struct Found {
        area: u32,
        touches_shadow: bool,
        rank: u32,
    }
    let mut found: Vec<Found> = Vec::new();
    // Roots come before the other runs of their component.
    let mut numbers = vec![0u32; components.runs.len()];
    for i in 0..components.runs.len() {
        let root = components.root(i);
        if root == i {
            numbers[i] = found.len() as u32;
            found.push(Found { area: 0, touches_shadow: false, rank: u32::MAX });
        } else {
            numbers[i] = numbers[root];
        }
        let component = &mut found[numbers[i] as usize];
        component.area += components.runs[i].end - components.runs[i].start;
    }
    let mut order: Vec<usize> = (0..found.len()).filter(|&i| found[i].area >= min_area.max(1)).collect();
    order.sort_by_key(|&i| std::cmp::Reverse(found[i].area));
    for (rank, &i) in order.iter().enumerate() {
        found[i].rank = rank as u32;
    }
    let mut parts = vec![Vec::new(); order.len()];
    for (run, &number) in components.runs.iter().zip(&numbers) {
        let component = &mut found[number as usize];
        match parts.get_mut(component.rank as usize) {
            Some(runs) => runs.push(*run),
            None => component.touches_shadow = component.touches_shadow || touches(crop, run, SHADOW),
        }
    }
    let is_dropped_to_shadow = |number: u32| {
        let component = &found[number as usize];
        component.rank == u32::MAX && component.touches_shadow
    };
    let dropped = components.runs.iter().zip(&numbers).filter(|(_, number)| is_dropped_to_shadow(**number));
    shadow.extend(dropped.map(|(run, _)| *run));
    parts
}

/// Whether a run has an edge in common with a pixel of this code.
fn touches(crop: &Crop, run: &MaskRun, code: u8) -> bool {
    let width = crop.width();
    let (y, start, end) = (run.y as usize, run.start as usize, run.end as usize);
    let row = |y: usize| &crop.codes[y * width..(y + 1) * width];
    let beside = (start > 0 && row(y)[start - 1] == code) || row(y).get(end) == Some(&code);
    let above = y > 0 && row(y - 1)[start..end].contains(&code);
    let below = y + 1 < crop.height() && row(y + 1)[start..end].contains(&code);
    beside || above || below
}

/// Area, centre of area and direction of the longest axis of some runs.
fn moments(runs: &[MaskRun]) -> (u32, [f32; 2], f32) {
    let (mut area, mut x, mut y) = (0f64, 0f64, 0f64);
    for run in runs {
        let n = f64::from(run.end - run.start);
        area += n;
        x += n * f64::from(run.start + run.end - 1) / 2.0;
        y += n * f64::from(run.y);
    }
    let center = [x / area.max(1.0), y / area.max(1.0)];
    let mut about_center = [0f64; 3];
    for run in runs {
        let n = f64::from(run.end - run.start);
        let dx = f64::from(run.start + run.end - 1) / 2.0 - center[0];
        let dy = f64::from(run.y) - center[1];
        // A run of n pixels has a second moment of its own, n (n^2 - 1) / 12.
        about_center[0] += n * dx * dx + n * (n * n - 1.0) / 12.0;
        about_center[1] += n * dx * dy;
        about_center[2] += n * dy * dy;
    }
    (area as u32, center.map(|c| c as f32), longest_axis_rad(about_center))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn objects(min_area: u32, crops: &mut [Crop]) -> Vec<ObjectRegion> {
        let mut objects = Vec::new();
        find_objects(crops, min_area, &mut objects);
        objects
    }

    fn of_drawing(min_area: u32, rows: &[&str]) -> Vec<ObjectRegion> {
        objects(min_area, &mut [Crop::drawn(100, 50, rows)])
    }

    fn pixels(mask: &Mask) -> Vec<(u32, u32)> {
        mask.runs().flat_map(|run| (run.start..run.end).map(move |x| (x, run.y))).collect()
    }

    #[test]
    fn one_object_and_its_shadow() {
        let found = of_drawing(1, &["      ", " ####s", " ####s", "  ssst"]);
        let [object] = &found[..] else { panic!("{} objects", found.len()) };
        assert_eq!((object.region, object.area), (0, 8));
        assert_eq!(object.mask.bbox(), BoundingBox { x: 101, y: 51, width: 4, height: 2 });
        assert_eq!(object.centroid, [102.5, 51.5]);
        assert_eq!(object.axis_rad, 0.0);
        assert_eq!((object.oriented_box.length_px, object.oriented_box.width_px), (4.0, 2.0));
        assert_eq!(object.oriented_box.center_px, [102.5, 51.5]);
        assert_eq!(object.outline[0], [101, 51]);
        assert_eq!(object.outline.len(), 8);
        let shadow = object.shadow.as_ref().unwrap();
        assert_eq!(pixels(shadow), [(105, 51), (105, 52), (102, 53), (103, 53), (104, 53)]);
    }

    #[test]
    fn parts_that_only_a_shadow_joins_are_two() {
        let found = of_drawing(1, &["##ssss###", "##ssss###", "   ss    "]);
        let [large, small] = &found[..] else { panic!("{} objects", found.len()) };
        assert_eq!((large.area, small.area), (6, 4));
        assert_eq!(large.mask.bbox().x, 106);
        // Each has the nearer half of the shadow.
        assert_eq!(pixels(small.shadow.as_ref().unwrap()), [(102, 50), (103, 50), (102, 51), (103, 51), (103, 52)]);
        assert_eq!(pixels(large.shadow.as_ref().unwrap()), [(104, 50), (105, 50), (104, 51), (105, 51), (104, 52)]);
    }

    #[test]
    fn corners_do_not_join() {
        assert_eq!(of_drawing(1, &["##  ", "##  ", "  ##", "  ##"]).len(), 2);
        assert_eq!(of_drawing(1, &["##  ", "### ", "  ##", "  ##"]).len(), 1);
    }

    #[test]
    fn branches_that_meet_below_are_one() {
        let found = of_drawing(1, &["# # #", "# # #", "#####"]);
        assert_eq!(found.iter().map(|o| o.area).collect::<Vec<_>>(), [11]);
        let found = of_drawing(1, &["#####", "# # #", "# # #"]);
        assert_eq!(found.iter().map(|o| o.area).collect::<Vec<_>>(), [11]);
    }

    #[test]
    fn specks_become_shadow_where_they_touch_it() {
        let found = of_drawing(5, &["###   ", "###s# ", "###s  ", "    t#"]);
        let [object] = &found[..] else { panic!("{} objects", found.len()) };
        assert_eq!(object.area, 9);
        assert_eq!(pixels(object.shadow.as_ref().unwrap()), [(103, 51), (104, 51), (103, 52)]);
    }

    #[test]
    fn regions_of_shadow_or_nothing_have_no_object() {
        assert!(of_drawing(1, &["sss", "sts"]).is_empty());
        assert!(of_drawing(1, &["   "]).is_empty());
        assert!(of_drawing(7, &["###", "###"]).is_empty());
        assert!(objects(1, &mut [Crop::default()]).is_empty());
        assert!(objects(1, &mut []).is_empty());
    }

    #[test]
    fn objects_know_their_region() {
        let mut crops =
            [Crop::drawn(0, 0, &["ss"]), Crop::drawn(9, 9, &["# ##"]), Crop::default(), Crop::drawn(3, 3, &["#"])];
        let found = objects(1, &mut crops);
        assert_eq!(found.iter().map(|o| (o.region, o.area)).collect::<Vec<_>>(), [(1, 2), (1, 1), (3, 1)]);
    }

    #[test]
    fn a_ring_has_a_hole() {
        let found = of_drawing(1, &["#####", "#ttt#", "#ttt#", "#####"]);
        assert_eq!((found[0].holes.len(), found[0].holes[0].len()), (1, 10));
        assert_eq!(found[0].shadow, None);
    }

    proptest! {
        #[test]
        fn every_pixel_goes_where_it_belongs(
            width in 1usize..14,
            codes in prop::collection::vec(0u8..4, 1..160),
            min_area in 1u32..8,
        ) {
            let letters = [' ', '#', 's', 't'];
            let height = codes.len() / width;
            prop_assume!(height > 0);
            let rows: Vec<String> =
                codes.chunks_exact(width).map(|row| row.iter().map(|&c| letters[c as usize]).collect()).collect();
            let rows: Vec<&str> = rows.iter().map(String::as_str).collect();
            let found = of_drawing(min_area, &rows);
            let mut count = vec![(0, 0); width * height];
            for object in &found {
                prop_assert!(object.area >= min_area);
                prop_assert_eq!(object.area, object.mask.area());
                let at = |(x, y): (u32, u32)| (y - 50) as usize * width + (x - 100) as usize;
                for p in pixels(&object.mask) {
                    prop_assert_eq!(codes[at(p)], OBJECT);
                    count[at(p)].0 += 1;
                }
                for p in object.shadow.iter().flat_map(pixels) {
                    prop_assert!(codes[at(p)] == SHADOW || codes[at(p)] == OBJECT);
                    count[at(p)].1 += 1;
                }
                let b = &object.oriented_box;
                prop_assert!(b.length_px >= b.width_px && b.length_px * b.width_px > object.area as f32 - 0.01);
            }
            for (&code, &(object, shadow)) in codes.iter().zip(&count) {
                prop_assert!(object + shadow <= 1, "no pixel is in two masks");
                if code == SHADOW && !found.is_empty() {
                    prop_assert_eq!(shadow, 1);
                }
            }
        }
    }
}
