//! Recognition by shape (section 5.2).

use std::collections::BTreeMap;

use samsod_camera::Camera;
use samsod_segment::{BoundingBox, RgbView};
use samsod_shadow::ObjectRegion;

use crate::catalogue::Part;
use crate::coarse::{CoarseSearch, Window};
use crate::contour_match::Contour;
use crate::edge_model::EdgeModel;
use crate::gradient::Gradient;
use crate::orientation_map::OrientationMap;
use crate::pose_fit::{Fit, Fitter, LocalView, Pose};
use crate::region_pixels::{OBJECT, OUTSIDE, RegionPixels, SHADOW};
use crate::silhouette::Silhouette;

/// Side of the cells of the coarse search, px.
const CELL_PX: usize = 4;
/// Edges farther from the region than this are the table's, px.
const NEAR_PX: usize = 5;
/// Poses that the outline of an object suggests that are fitted.
const FITTED: usize = 12;
/// of one part.
const FITTED_OF_PART: usize = 3;
/// Parts whose size is like that of an object that are compared by outline,
const NEAR_PARTS: usize = 8;
/// as far as this in logarithms of ratios.
const FARTHEST: f32 = 1.2;
/// Turned poses of a part whose outline looks alike that are fitted.
const LOOK_ALIKES: usize = 3;
/// How far from an object its part is looked for where it shares its region with others, px.
const AROUND_PX: i32 = 30;
/// How far a part may reach beyond its region, px.
const BEYOND_PX: i32 = 8;

/// Log-odds below which nothing is tried again,
const LEAST: f32 = -5.0;
/// by turns of so much, rad,
const RESTART_RAD: f64 = 0.1;
/// and moves by this share of the radius.
const RESTART_SHARE: f64 = 0.12;
/// Log-odds beyond which no other part is looked for.
const SURE: f32 = 3.0;
/// Share of the points on edges that says nothing.
const NEUTRAL_FIT: f32 = 0.35;
/// Worth of a pixel of outline on edges, in pixels of area.
const EDGE_WORTH: f32 = 10.0;
/// Cost of a pixel of the part outside of the region.
const OUTSIDE_COST: f32 = 0.5;

/// A part at a pose.
#[derive(Debug, Clone)]
pub(crate) struct Candidate {
    pub(crate) part: usize,
    /// Share that the silhouette has of the objects that lie in it by a third or more.
    pub(crate) explained: f32,
    pub(crate) fit: Fit,
    pub(crate) silhouette: Silhouette,
    /// Pixels of the silhouette, and those of them that are object, and outside of the region.
    pub(crate) pixels: [u32; 3],
    /// Pixels of each object, by its code.
    pub(crate) of_objects: BTreeMap<u8, u32>,
}

impl Candidate {
    /// Share of the points on edges.
    pub(crate) fn edges(&self) -> f32 {
        0.7 * self.fit.outline + 0.3 * self.fit.inner
    }

    /// Log-odds that it is right.
    pub(crate) fn odds(&self) -> f32 {
        let [all, object, outside] = self.pixels.map(|n| n as f32);
        let all = all.max(1.0);
        1.5 * self.fit.outline + 9.4 * self.fit.inner + 7.1 * self.fit.hits + 1.9 * object / all - 4.9 * outside / all
            + 8.3 * self.explained
            - 0.22 * all.ln()
            - 11.3
    }

    /// What is chosen first: the likelier, but of two likely ones that which explains more. A small part finds its edges
    /// in many a large one.
    fn rank(&self) -> f32 {
        let likely = 1.0 / (1.0 + (-self.odds()).exp());
        likely.powi(4) * (self.pixels[0] as f32).sqrt()
    }

    /// In [0, 1].
    pub(crate) fn score(&self) -> f32 {
        1.0 / (1.0 + (-0.5 * self.odds()).exp())
    }
}

/// The candidates that together explain a region, the likeliest first; indices into `candidates`, and the best rival of
/// another part for each.
pub(crate) fn select(candidates: &[Candidate]) -> Vec<(usize, Option<usize>)> {
    let mut order: Vec<usize> = (0..candidates.len()).collect();
    order.sort_by(|&a, &b| candidates[b].rank().total_cmp(&candidates[a].rank()));
    let mut chosen: Vec<(usize, Option<usize>)> = Vec::new();
    for &i in &order {
        if chosen.iter().any(|(other, _)| overlap(&candidates[i], &candidates[*other]) > 0.25) {
            continue;
        }
        let is_rival = |k: &&usize| {
            candidates[**k].part != candidates[i].part && overlap(&candidates[**k], &candidates[i]) > 0.3
        };
        chosen.push((i, order.iter().find(is_rival).copied()));
    }
    chosen
}

/// What a guess of a part of so many pixels is worth that has so many of an object, and outside of the region.
fn worth(all: f32, object: f32, outside: f32, edges: f32) -> f32 {
    let length = 4.0 * all.sqrt();
    object + EDGE_WORTH * length * (edges - NEUTRAL_FIT) - OUTSIDE_COST * outside
}

/// A guess after a quick fit.
#[derive(Debug, Clone, Copy)]
struct Rough {
    part: usize,
    pose: Pose,
    gain: f32,
}

/// The largest share of an object that a likely candidate has.
fn explained_share(candidates: &[Candidate], code: u8, area: u32) -> f32 {
    let likely = candidates.iter().filter(|c| c.odds() >= SURE);
    let most = likely.filter_map(|c| c.of_objects.get(&code)).max().copied().unwrap_or(0);
    most as f32 / area.max(1) as f32
}

/// A box and so many pixels around it.
fn window_of(bbox: BoundingBox, margin_px: i32) -> Window {
    let [left, top, right, bottom] = [bbox.x, bbox.y, bbox.right() + 1, bbox.bottom() + 1].map(|c| c as i32);
    [left - margin_px, top - margin_px, right + margin_px, bottom + margin_px]
}

/// Pixels that two candidates share, as a share of the smaller.
fn overlap(a: &Candidate, b: &Candidate) -> f32 {
    let mut both = 0u32;
    let bb = b.silhouette.bbox;
    for (y, row) in a.silhouette.rows() {
        if y < bb.y || y > bb.bottom() {
            continue;
        }
        let other = &b.silhouette.bits[(y - bb.y) as usize * bb.width as usize..][..bb.width as usize];
        for (x, &bit) in (a.silhouette.bbox.x..).zip(row) {
            if bit != 0 && x >= bb.x && x <= bb.right() && other[(x - bb.x) as usize] != 0 {
                both += 1;
            }
        }
    }
    both as f32 / a.pixels[0].min(b.pixels[0]).max(1) as f32
}

#[derive(Debug)]
pub(crate) struct ShapeMatcher {
    pub(crate) models: Vec<EdgeModel>,
}

#[derive(Debug, Default)]
struct Scratch {
    search: CoarseSearch,
    fitter: Fitter,
}

impl ShapeMatcher {
    pub(crate) fn new(parts: &[Part]) -> Self {
        let model = |part: &Part| {
            let key = crate::cache::key_of(part, "shape2");
            let path = part.folder.join("shape.cache");
            crate::cache::read(&path, &key).unwrap_or_else(|| {
                let m = EdgeModel::of(part);
                crate::cache::write(&path, &key, &m);
                m
            })
        };
        Self { models: parts.iter().map(model).collect() }
    }

    pub(crate) fn candidates(
        &self,
        parts: &[Part],
        camera: &Camera,
        frame: &RgbView<'_>,
        objects: &[ObjectRegion],
        region: &RegionPixels,
    ) -> Vec<Candidate> {
        let areas = region.objects.iter().map(|&i| objects[i].area).collect();
        let scene = Scene { gradient: Gradient::of(frame, region.crop), camera, region, areas, parts };
        let scratch = &mut Scratch::default();
        let mut all = Vec::new();
        for (k, &object) in region.objects.iter().enumerate() {
            self.by_contour(&scene, &objects[object], RegionPixels::code_of(k), scratch, &mut all);
        }
        if std::env::var("LAB_B").is_err() && !self.is_convincing(region, &all) {
            let mut map = OrientationMap::default();
            map.fill(&scene.gradient, &region.near(NEAR_PX), CELL_PX);
            let whole = window_of(region.bbox, BEYOND_PX);
            if region.objects.len() == 1 || self.is_small(&scene, whole) {
                self.by_search(&scene, &map, whole, None, scratch, &mut all);
            } else {
                for (k, &object) in region.objects.iter().enumerate() {
                    let object = &objects[object];
                    let code = RegionPixels::code_of(k);
                    if explained_share(&all, code, object.area) >= 0.7 {
                        continue;
                    }
                    let own = window_of(object.mask.bbox(), AROUND_PX);
                    let shadow = object.shadow.as_ref().map_or(own, |shadow| window_of(shadow.bbox(), BEYOND_PX));
                    let window = [
                        own[0].min(shadow[0]).max(whole[0]),
                        own[1].min(shadow[1]).max(whole[1]),
                        own[2].max(shadow[2]).min(whole[2]),
                        own[3].max(shadow[3]).min(whole[3]),
                    ];
                    self.by_search(&scene, &map, window, Some(code), scratch, &mut all);
                }
            }
        }
        self.restart(&scene, scratch, &mut all);
        all
    }

    /// Where the best candidates are doubtful, starts their fits again from poses nearby.
    fn restart(&self, scene: &Scene<'_>, scratch: &mut Scratch, all: &mut Vec<Candidate>) {
        let doubtful: Vec<(usize, Pose)> = select(all)
            .iter()
            .filter(|(i, _)| (LEAST..SURE).contains(&all[*i].odds()))
            .map(|(i, _)| (all[*i].part, all[*i].fit.pose))
            .chain(self.promising(all))
            .collect();
        for (part, pose) in doubtful {
            let step = (RESTART_SHARE * f64::from(self.models[part].radius_mm)).max(1.0);
            let (sin, cos) = pose.yaw_rad.sin_cos();
            let starts = [
                (0.0, 0.0, RESTART_RAD),
                (0.0, 0.0, -RESTART_RAD),
                (step, 0.0, 0.0),
                (-step, 0.0, 0.0),
                (0.0, step, 0.0),
                (0.0, -step, 0.0),
            ];
            for (x, y, yaw) in starts {
                let start = Pose {
                    x_mm: pose.x_mm + cos * x - sin * y,
                    y_mm: pose.y_mm + sin * x + cos * y,
                    yaw_rad: pose.yaw_rad + yaw,
                };
                all.extend(self.candidate(scene, part, start, scratch));
            }
        }
    }

    /// For every doubtful choice, the parts of other names that come closest to it.
    fn promising(&self, all: &[Candidate]) -> Vec<(usize, Pose)> {
        let chosen = select(all);
        let rivals = chosen.iter().filter(|(i, _)| all[*i].odds() < SURE).filter_map(|(_, rival)| *rival);
        rivals.map(|i| (all[i].part, all[i].fit.pose)).collect()
    }

    /// Whether a window is hardly larger than the largest part.
    fn is_small(&self, scene: &Scene<'_>, window: Window) -> bool {
        let radius = self.models.iter().map(|model| model.radius_mm).fold(0.0, f32::max);
        let center = [0, 1].map(|i| 0.5 * f64::from(window[i] + window[i + 2]));
        let px_per_mm = scene
            .camera
            .world_from_image(center, 0.0)
            .ok()
            .and_then(|[x, y, _]| LocalView::new(scene.camera, x, y, 1.0))
            .map_or(1.0, |local| local.px_per_mm());
        let longest = (window[2] - window[0]).max(window[3] - window[1]) as f32;
        longest <= 2.4 * radius * px_per_mm
    }

    /// Whether all of a region is explained by parts that leave no doubt.
    fn is_convincing(&self, region: &RegionPixels, candidates: &[Candidate]) -> bool {
        let chosen: Vec<&Candidate> = select(candidates).iter().map(|(i, _)| &candidates[*i]).collect();
        let sure: u32 = chosen.iter().filter(|c| c.odds() >= SURE && c.fit.hits >= 0.3).map(|c| c.pixels[1]).sum();
        let object_pixels = region.codes.iter().filter(|&&code| code >= OBJECT).count();
        sure as f32 >= 0.8 * object_pixels as f32
    }

    /// Candidates that the outline of an object suggests.
    fn by_contour(
        &self,
        scene: &Scene<'_>,
        object: &ObjectRegion,
        code: u8,
        scratch: &mut Scratch,
        all: &mut Vec<Candidate>,
    ) {
        let Some(contour) = Contour::of(object, &scene.gradient, scene.camera) else { return };
        let mut near: Vec<(usize, f32)> = (scene.parts.iter().enumerate())
            .map(|(i, part)| (i, contour.distance(&self.models[i], part.height_mm, scene.camera)))
            .collect();
        near.sort_by(|a, b| a.1.total_cmp(&b.1));
        let mut roughs = Vec::new();
        for &(index, distance) in near.iter().take(NEAR_PARTS) {
            if distance > FARTHEST {
                break;
            }
            let part = &scene.parts[index];
            let guesses = contour.guesses(&self.models[index], part.height_mm, part.symmetry.shape_order, scene.camera);
            roughs.extend(guesses.iter().filter_map(|guess| self.rough(scene, index, guess.pose, Some(code), &mut scratch.fitter)));
        }
        self.fit_best(scene, roughs, scratch, all);
    }

    /// Candidates from a search over the whole region, for what the separation of shadows has broken or joined.
    fn by_search(
        &self,
        scene: &Scene<'_>,
        map: &OrientationMap,
        window: Window,
        object: Option<u8>,
        scratch: &mut Scratch,
        all: &mut Vec<Candidate>,
    ) {
        let mut roughs = Vec::new();
        for (index, part) in scene.parts.iter().enumerate() {
            let guesses = scratch.search.search(
                &self.models[index],
                part.height_mm,
                part.symmetry.shape_order,
                scene.camera,
                &scene.gradient,
                map,
                window,
            );
            roughs.extend(guesses.iter().filter_map(|guess| self.rough(scene, index, guess.pose, object, &mut scratch.fitter)));
        }
        self.fit_best(scene, roughs, scratch, all);
    }

    /// What a guess is worth after a quick fit: for one object (by its code), or for all of the region.
    fn rough(
        &self,
        scene: &Scene<'_>,
        part: usize,
        guess: Pose,
        of_object: Option<u8>,
        fitter: &mut Fitter,
    ) -> Option<Rough> {
        let (model, height_mm) = (&self.models[part], scene.parts[part].height_mm);
        let (pose, [outline, inner]) = fitter.quick(model, height_mm, scene.camera, &scene.gradient, guess)?;
        let local = LocalView::new(scene.camera, pose.x_mm, pose.y_mm, height_mm)?;
        let view = model.view(pose.towards(scene.camera, height_mm / 2.0));
        let (sin, cos) = (pose.yaw_rad.sin() as f32, pose.yaw_rad.cos() as f32);
        let origin = local.origin().map(|c| c as f32);
        let (mut object, mut outside) = (0u32, 0u32);
        for [x, y, z] in &view.surface {
            let at = local.image_offset([cos * x - sin * y, sin * x + cos * y, *z]);
            let [u, v] = [0, 1].map(|i| (origin[i] + at[i]).round());
            match if u >= 0.0 && v >= 0.0 { scene.region.code(u as u32, v as u32) } else { OUTSIDE } {
                OUTSIDE => outside += 1,
                SHADOW => {}
                code if of_object.is_none_or(|own| own == code) => object += 1,
                // Of another object: as good as outside.
                _ => outside += 1,
            }
        }
        let count = view.surface.len().max(1) as f32;
        let area = view.area_mm2 * local.px_per_mm().powi(2);
        let edges = 0.7 * outline + 0.3 * inner;
        let gain = worth(area, area * object as f32 / count, area * outside as f32 / count, edges);
        Some(Rough { part, pose, gain })
    }

    /// Fits the most promising guesses.
    fn fit_best(&self, scene: &Scene<'_>, mut roughs: Vec<Rough>, scratch: &mut Scratch, all: &mut Vec<Candidate>) {
        roughs.sort_by(|a, b| b.gain.total_cmp(&a.gain));
        let mut of_part = vec![0; scene.parts.len()];
        let mut fitted = 0;
        for rough in roughs {
            let count = &mut of_part[rough.part];
            if fitted >= FITTED || *count >= FITTED_OF_PART {
                continue;
            }
            if let Some(candidate) = self.candidate(scene, rough.part, rough.pose, scratch) {
                *count += 1;
                fitted += 1;
                all.push(candidate);
            }
        }
    }

    /// The candidate that a guess leads to.
    fn candidate(&self, scene: &Scene<'_>, index: usize, guess: Pose, scratch: &mut Scratch) -> Option<Candidate> {
        let (part, model) = (&scene.parts[index], &self.models[index]);
        let fitter = &mut scratch.fitter;
        let mut fit = fitter.fit(model, part.height_mm, scene.camera, &scene.gradient, guess)?;
        if part.symmetry.shape_order == 1 && !model.look_alike_turns.is_empty() && fit.hits > 0.2 {
            let mut at = |turn: f32| {
                let pose = Pose { yaw_rad: fit.pose.yaw_rad + f64::from(turn), ..fit.pose };
                let [outline, inner] =
                    fitter.edge_shares(model, part.height_mm, scene.camera, &scene.gradient, pose).unwrap_or_default();
                (pose, outline + inner)
            };
            let here = at(0.0).1;
            let mut turned: Vec<(Pose, f32)> = model.look_alike_turns.iter().map(|turn| at(*turn)).collect();
            turned.sort_by(|a, b| b.1.total_cmp(&a.1));
            turned.truncate(LOOK_ALIKES);
            for (pose, share) in turned {
                if share < 0.8 * here {
                    continue;
                }
                let other = fitter.fit(model, part.height_mm, scene.camera, &scene.gradient, pose);
                if let Some(other) = other.filter(|other| other.outline + other.inner > fit.outline + fit.inner) {
                    fit = other;
                }
            }
        }
        let mut silhouette = Silhouette::default();
        silhouette.paint(part, scene.camera, &fit.pose)?;
        let mut pixels = [0; 3];
        let mut of_objects: BTreeMap<u8, u32> = BTreeMap::new();
        for (y, row) in silhouette.rows() {
            for (x, &bit) in (silhouette.bbox.x..).zip(row) {
                if bit != 0 {
                    pixels[0] += 1;
                    match scene.region.code(x, y) {
                        OUTSIDE => pixels[2] += 1,
                        SHADOW => {}
                        code => {
                            pixels[1] += 1;
                            *of_objects.entry(code).or_default() += 1;
                        }
                    }
                }
            }
        }
        // Of the objects that lie in it by a third or more, the share that it explains.
        let (mut own, mut all) = (0u32, 0u32);
        for (&code, &count) in &of_objects {
            let area = scene.areas.get(usize::from(code - OBJECT)).copied().unwrap_or(0);
            if 3 * count >= area {
                own += count;
                all += area;
            }
        }
        let explained = if all == 0 { 0.0 } else { own as f32 / all as f32 };
        Some(Candidate { part: index, explained, fit, silhouette, pixels, of_objects })
    }
}

/// What a region is matched against.
#[derive(Debug)]
struct Scene<'a> {
    gradient: Gradient,
    camera: &'a Camera,
    region: &'a RegionPixels,
    /// Pixels of every object of the region.
    areas: Vec<u32>,
    parts: &'a [Part],
}
