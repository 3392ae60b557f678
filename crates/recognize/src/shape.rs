//! Recognition by shape (section 5.2 of the paper): from the pixels of a region to candidates, parts at fitted poses.
//!
//! In: a salient region with its objects, the edges of the frame there, the models of the parts. Out: [`Candidate`]s, among
//! which `candidate` chooses. Where outlines leave no doubt the cost is that of a few shape contexts and fits an object;
//! else every part is searched for over the region.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use rayon::prelude::*;
use samsod_camera::Camera;
use samsod_segment::{BoundingBox, RgbView};
use samsod_shadow::ObjectRegion;

use crate::candidate::{Candidate, SURE, choose};
use crate::catalogue::Part;
use crate::coarse::{CoarseSearch, Window};
use crate::contour_match::Contour;
use crate::edge_model::EdgeModel;
use crate::gradient::Gradient;
use crate::orientation_map::OrientationMap;
use crate::pose_fit::{Fitter, LocalView, Pose};
use crate::region_pixels::{OBJECT, OUTSIDE, RegionPixels, SHADOW, box_round};
use crate::silhouette::Silhouette;
use crate::tint::Tint;

/// Side of the cells of the coarse search, px.
const CELL_PX: usize = 4;
/// Edges farther from the region than this are the table's, px.
const NEAR_PX: usize = 5;
/// Guesses that are fitted: the best of all,
const FITTED: usize = 10;
/// and of one part.
const FITTED_OF_PART: usize = 3;
/// but no more once so many parts were fitted and one is beyond doubt
const RIVALS_FITTED: usize = 3;
/// by these log-odds.
const BEYOND_DOUBT: f32 = 5.0;
/// Parts whose size is like that of an object that are compared by outline,
const NEAR_PARTS: usize = 6;
/// as far as this in logarithms of ratios.
const FARTHEST: f32 = 1.2;
/// Turned poses of a part whose outline looks alike that are fitted.
const LOOK_ALIKES: usize = 3;
/// of a fit that finds so much of the outline,
const LOOK_ALIKE_FIT: f32 = 0.25;
/// So many turns are all that there are, about.
const MANY_TURNS: usize = 12;
/// Between the turns that are tried of a part of three-fold symmetry or more, rad.
const SECTOR_STEP_RAD: f32 = 0.07;
/// and how much of the edges of the best they must show before.
const LOOK_ALIKE_SHARE: f32 = 0.6;
/// How far from an object its part is looked for where it shares its region with others, px.
const AROUND_PX: i32 = 30;
/// How far a part may reach beyond its region, px.
const BEYOND_PX: i32 = 8;
/// A region is searched as a whole where it is no longer than so many radii of the largest part.
const SMALL_REGION: f32 = 2.4;
/// An object of which a sure part has this share is not searched for again.
const EXPLAINED: f32 = 0.7;
/// Outlines leave no doubt where sure parts have this share of the objects of a region.
const CONVINCING: f32 = 0.8;
/// and find this share of their outline.
const CONVINCING_HITS: f32 = 0.3;
/// Log-odds below which a fit is not started again from nearby,
const LEAST: f32 = -5.0;
/// by turns of so much, rad,
const RESTART_RAD: f64 = 0.1;
/// and moves by this share of the radius, and so many mm at least.
const RESTART_SHARE: f64 = 0.12;
const RESTART_MM: f64 = 1.0;
/// Every choice is fitted again from so far to either side, rad.
const SETTLE_RAD: f64 = 0.05;
/// Fits of doubtful ones are started again of so many choices and their rivals, each so often.
const RESTARTED: usize = 3;
const RESTARTS_FITTED: usize = 2;
/// Silhouettes of candidates have every second pixel of every second row.
const SILHOUETTE_STEP: u32 = 2;
/// Fits of one part that are no farther apart are one.
const KNOWN_MM: f64 = 0.5;
const KNOWN_RAD: f64 = 0.01;
/// Share of the points on edges that says nothing about a guess.
const NEUTRAL_FIT: f32 = 0.35;
/// Worth of a pixel of outline on edges, in pixels of area.
const EDGE_WORTH: f32 = 10.0;
/// Cost of a pixel of the part outside of the region.
const OUTSIDE_COST: f32 = 0.5;

/// The search for parts in one region.
#[derive(Debug)]
pub(crate) struct RegionSearch<'a> {
    parts: &'a [Part],
    models: &'a [EdgeModel],
    camera: &'a Camera,
    frame: &'a RgbView<'a>,
    region: &'a RegionPixels,
    /// The tints of the parts' templates.
    tints: &'a [Tint],
    gradient: Gradient,
    /// Pixels of every object of the region.
    areas: Vec<u32>,
    fitter: Fitter,
    /// What was found so far.
    pub(crate) candidates: Vec<Candidate>,
}

/// A guess after a quick fit.
#[derive(Debug, Clone, Copy)]
struct Rough {
    part: usize,
    pose: Pose,
    worth: f32,
}

impl<'a> RegionSearch<'a> {
    /// Of a region, with the parts, their models and their tints, which have the same order.
    pub(crate) fn new(
        parts: &'a [Part],
        models: &'a [EdgeModel],
        camera: &'a Camera,
        frame: &'a RgbView<'a>,
        region: &'a RegionPixels,
        tints: &'a [Tint],
    ) -> Self {
        let mut areas = vec![0; region.objects.len()];
        for &code in &region.codes {
            if let Some(area) = code.checked_sub(OBJECT).and_then(|k| areas.get_mut(usize::from(k))) {
                *area += 1;
            }
        }
        Self {
            parts,
            models,
            camera,
            frame,
            region,
            tints,
            gradient: Gradient::of(frame, region.crop),
            areas,
            fitter: Fitter::default(),
            candidates: Vec::new(),
        }
    }

    /// Candidates that the outlines of the objects suggest.
    pub(crate) fn by_contours(&mut self, objects: &[ObjectRegion]) {
        for (k, &object) in self.region.objects.iter().enumerate() {
            // A piece of a part that another piece has told.
            if self.areas[k] > 0 && self.is_explained(k) {
                continue;
            }
            let Some(contour) = Contour::of(&objects[object], &self.gradient, self.camera) else { continue };
            let mut near: Vec<(usize, f32)> = (self.parts.iter().zip(self.models).enumerate())
                .map(|(i, (part, model))| (i, contour.distance(model, part.height_mm, self.camera)))
                .filter(|(_, distance)| *distance <= FARTHEST)
                .collect();
            near.sort_by(|a, b| a.1.total_cmp(&b.1));
            near.truncate(NEAR_PARTS);
            let code = Some(RegionPixels::code_of(k));
            let roughs_of = |fitter: &mut Fitter, &(index, _): &(usize, f32)| {
                let part = &self.parts[index];
                let (height_mm, order) = (part.height_mm, part.symmetry.shape_order);
                let guesses = contour.guesses(&self.models[index], height_mm, order, self.camera);
                guesses.iter().filter_map(|guess| self.rough(fitter, index, guess.pose, code)).collect::<Vec<Rough>>()
            };
            let roughs: Vec<Vec<Rough>> = near.par_iter().map_init(Fitter::default, roughs_of).collect();
            self.fit_best(roughs.concat());
        }
    }

    /// Whether sure parts explain the objects of the region.
    pub(crate) fn is_convincing(&self) -> bool {
        let chosen = choose(&self.candidates);
        let chosen = chosen.iter().map(|choice| &self.candidates[choice.index]);
        let sure = chosen.filter(|c| c.odds() >= SURE && c.fit.hits >= CONVINCING_HITS);
        let explained: u32 = sure.map(|c| c.pixels[1]).sum();
        let objects: u32 = self.areas.iter().sum();
        explained as f32 >= CONVINCING * objects as f32
    }

    /// Boxes round the objects of which no sure part has the most, each with its shadow.
    pub(crate) fn doubtful(&self) -> Vec<BoundingBox> {
        let boxes = self.region.boxes.iter().enumerate().filter(|(k, _)| !self.is_explained(*k));
        boxes.map(|(_, (own, shadow))| shadow.map_or(*own, |shadow| box_round(own, &shadow))).collect()
    }

    /// Whether a sure part has most of an object.
    fn is_explained(&self, k: usize) -> bool {
        let code = RegionPixels::code_of(k);
        let sure = self.candidates.iter().filter(|c| c.odds() >= SURE);
        let most = sure.filter_map(|c| c.of_objects.get(&code)).max().copied().unwrap_or(0);
        most as f32 >= EXPLAINED * self.areas.get(k).copied().unwrap_or(0) as f32
    }

    /// Candidates from a search over the whole region, for what the separation of shadows has broken or joined.
    pub(crate) fn by_search(&mut self) {
        let mut map = OrientationMap::default();
        map.fill(&self.gradient, &self.region.near(NEAR_PX), CELL_PX);
        let whole = window_of(self.region.bbox, BEYOND_PX);
        if self.region.objects.len() == 1 || self.is_small(whole) {
            self.search_window(&map, whole, None);
            return;
        }
        for k in 0..self.region.objects.len() {
            if self.is_explained(k) {
                continue;
            }
            let code = RegionPixels::code_of(k);
            let Some((own, shadow)) = self.region.boxes.get(k).copied() else { continue };
            let own = window_of(own, AROUND_PX);
            let shadow = shadow.map_or(own, |shadow| window_of(shadow, BEYOND_PX));
            let window = [
                own[0].min(shadow[0]).max(whole[0]),
                own[1].min(shadow[1]).max(whole[1]),
                own[2].max(shadow[2]).min(whole[2]),
                own[3].max(shadow[3]).min(whole[3]),
            ];
            self.search_window(&map, window, Some(code));
        }
    }

    /// Candidates from a search over all of the frame, objects or not.
    pub(crate) fn by_search_of_frame(&mut self) {
        let mut map = OrientationMap::default();
        map.fill(&self.gradient, &vec![1; self.region.codes.len()], CELL_PX);
        self.search_window(&map, window_of(self.region.crop, 0), None);
    }

    /// Adds the candidate that a guess of a part leads to.
    pub(crate) fn add(&mut self, part: usize, guess: Pose, features: f32) {
        let candidate = self.candidate(part, guess).map(|candidate| Candidate { features, ..candidate });
        self.candidates.extend(candidate);
    }

    /// Where choices are doubtful, starts their fits and those of their rivals again from poses nearby.
    pub(crate) fn restart(&mut self) {
        let doubtful: Vec<(usize, Pose, f32)> = choose(&self.candidates)
            .iter()
            .filter(|choice| (LEAST..SURE).contains(&self.candidates[choice.index].odds()))
            .take(RESTARTED)
            .flat_map(|choice| std::iter::once(choice.index).chain(choice.rival))
            .map(|i| (self.candidates[i].part, self.candidates[i].fit.pose, self.candidates[i].features))
            .collect();
        for (part, pose, features) in doubtful {
            let step = (RESTART_SHARE * f64::from(self.models[part].radius_mm)).max(RESTART_MM);
            let (sin, cos) = pose.yaw_rad.sin_cos();
            let moves = [(step, 0.0), (-step, 0.0), (0.0, step), (0.0, -step)];
            let turns = [RESTART_RAD, -RESTART_RAD];
            let starts = moves.map(|(x, y)| (x, y, 0.0)).into_iter().chain(turns.map(|yaw| (0.0, 0.0, yaw)));
            let mut fitter = Fitter::default();
            let mut roughs: Vec<Rough> = starts
                .filter_map(|(x, y, yaw)| {
                    let x_mm = pose.x_mm + cos * x - sin * y;
                    let y_mm = pose.y_mm + sin * x + cos * y;
                    self.rough(&mut fitter, part, Pose { x_mm, y_mm, yaw_rad: pose.yaw_rad + yaw }, None)
                })
                .collect();
            roughs.sort_by(|a, b| b.worth.total_cmp(&a.worth));
            for rough in roughs.iter().take(RESTARTS_FITTED) {
                self.add(part, rough.pose, features);
            }
        }
    }

    /// Fits every choice again from a little to either side: lettering has minima of its own beside the right one.
    pub(crate) fn settle(&mut self) {
        let choices: Vec<(usize, Pose, f32)> = choose(&self.candidates)
            .iter()
            .map(|choice| &self.candidates[choice.index])
            .filter(|c| c.odds() >= LEAST)
            .map(|c| (c.part, c.fit.pose, c.features))
            .collect();
        for (part, pose, features) in choices {
            for turn in [SETTLE_RAD, -SETTLE_RAD] {
                self.add(part, Pose { yaw_rad: pose.yaw_rad + turn, ..pose }, features);
            }
        }
    }

    /// Whether a window is hardly larger than the largest part.
    fn is_small(&self, window: Window) -> bool {
        let radius = self.models.iter().map(|model| model.radius_mm).fold(0.0, f32::max);
        let center = [0, 1].map(|i| 0.5 * f64::from(window[i] + window[i + 2]));
        let place = self.camera.world_from_image(center, 0.0).ok();
        let px_per_mm =
            place.and_then(|[x, y, _]| LocalView::new(self.camera, x, y, 1.0)).map_or(1.0, |local| local.px_per_mm());
        let longest = (window[2] - window[0]).max(window[3] - window[1]) as f32;
        longest <= SMALL_REGION * radius * px_per_mm
    }

    fn search_window(&mut self, map: &OrientationMap, window: Window, of_object: Option<u8>) {
        let roughs_of = |(search, fitter): &mut (CoarseSearch, Fitter), index: usize| {
            let (part, model) = (&self.parts[index], &self.models[index]);
            let (height_mm, order) = (part.height_mm, part.symmetry.shape_order);
            let guesses = search.search(model, height_mm, order, self.camera, &self.gradient, map, window);
            guesses.iter().filter_map(|guess| self.rough(fitter, index, guess.pose, of_object)).collect::<Vec<Rough>>()
        };
        let all = (0..self.parts.len()).into_par_iter();
        let roughs: Vec<Vec<Rough>> = all.map_init(Default::default, roughs_of).collect();
        self.fit_best(roughs.concat());
    }

    /// What a guess is worth after a quick fit: for one object (by its code), or for all of the region.
    fn rough(&self, fitter: &mut Fitter, part: usize, guess: Pose, of_object: Option<u8>) -> Option<Rough> {
        let (model, height_mm) = (&self.models[part], self.parts[part].height_mm);
        let (pose, [outline, inner]) = fitter.quick(model, height_mm, self.camera, &self.gradient, guess)?;
        let local = LocalView::new(self.camera, pose.x_mm, pose.y_mm, height_mm)?;
        let view = model.view(pose.towards(self.camera, height_mm / 2.0));
        let (sin, cos) = (pose.yaw_rad.sin() as f32, pose.yaw_rad.cos() as f32);
        let origin = local.origin().map(|c| c as f32);
        let (mut object, mut outside) = (0u32, 0u32);
        for [x, y, z] in &view.surface {
            let at = local.image_offset([cos * x - sin * y, sin * x + cos * y, *z]);
            let [u, v] = [0, 1].map(|i| origin[i] + at[i] + 0.5);
            match if u >= 0.0 && v >= 0.0 { self.region.code(u as u32, v as u32) } else { OUTSIDE } {
                OUTSIDE => outside += 1,
                SHADOW => {}
                code if of_object.is_none_or(|own| own == code) => object += 1,
                // Of another object: as good as outside.
                _ => outside += 1,
            }
        }
        let share = 1.0 / view.surface.len().max(1) as f32;
        let area = view.area_mm2 * local.px_per_mm().powi(2);
        let edges = 0.7 * outline + 0.3 * inner - NEUTRAL_FIT;
        let worth = area * share * (object as f32 - OUTSIDE_COST * outside as f32)
            + EDGE_WORTH * 4.0 * area.max(0.0).sqrt() * edges;
        Some(Rough { part, pose, worth })
    }

    /// Fits the most promising guesses.
    fn fit_best(&mut self, mut roughs: Vec<Rough>) {
        roughs.sort_by(|a, b| b.worth.total_cmp(&a.worth));
        let mut of_part = vec![0; self.parts.len()];
        let mut fitted = 0;
        let first = self.candidates.len();
        for rough in roughs {
            let parts_fitted = of_part.iter().filter(|count| **count > 0).count();
            let is_sure =
                self.candidates[first..].iter().any(|c| c.odds() >= BEYOND_DOUBT && c.fit.hits >= CONVINCING_HITS);
            if fitted >= FITTED || (is_sure && parts_fitted >= RIVALS_FITTED) {
                break;
            }
            if of_part[rough.part] < FITTED_OF_PART {
                of_part[rough.part] += 1;
                fitted += 1;
                self.add(rough.part, rough.pose, 0.0);
            }
        }
    }

    /// The candidate that a guess leads to; `None` where it is one that is known.
    fn candidate(&mut self, index: usize, guess: Pose) -> Option<Candidate> {
        let (part, model) = (&self.parts[index], &self.models[index]);
        let known: Vec<Pose> = self.candidates.iter().filter(|c| c.part == index).map(|c| c.fit.pose).collect();
        let (fitter, camera, gradient) = (&mut self.fitter, self.camera, &self.gradient);
        let mut fit = fitter.fit(model, part.height_mm, camera, gradient, guess)?;
        let turns: Vec<f32> = match part.symmetry.shape_order {
            0 | 2 => Vec::new(),
            1 => model.look_alike_turns.clone(),
            // Between one and the next of the turns that are the same.
            n => (1..).map(|k| k as f32 * SECTOR_STEP_RAD).take_while(|turn| turn * (n as f32) < 6.2).collect(),
        };
        let is_near = |other: &Pose, turn: f64| {
            let turned = (fit.pose.yaw_rad - other.yaw_rad).rem_euclid(TAU);
            let apart = (fit.pose.x_mm - other.x_mm).hypot(fit.pose.y_mm - other.y_mm);
            apart <= KNOWN_MM && turned.min(TAU - turned) <= turn
        };
        let looks_alike = fit.outline >= LOOK_ALIKE_FIT && !turns.is_empty();
        // Of a part that may be turned by anything the best turn has been found.
        let any_turn = looks_alike && turns.len() >= MANY_TURNS;
        if known.iter().any(|other| is_near(other, if any_turn { TAU } else { KNOWN_RAD })) {
            return None;
        }
        if looks_alike {
            let height_mm = part.height_mm;
            let mut at = |pose: Pose| {
                let [outline, inner] = fitter.edge_shares(model, height_mm, camera, gradient, pose).unwrap_or_default();
                2.0 * outline + inner + fitter.mark_share(model, height_mm, camera, gradient, &pose).unwrap_or_default()
            };
            // The outline counts twice: what a picture shows inside depends on where the light comes from. What is fitted
            // is compared as it is, what is not by the quicker shares.
            let quick = at(fit.pose);
            let marks = |fitter: &mut Fitter, pose: &Pose| {
                fitter.mark_share(model, height_mm, camera, gradient, pose).unwrap_or_default()
            };
            let turned = turns.iter().map(|turn| {
                let pose = Pose { yaw_rad: fit.pose.yaw_rad + f64::from(*turn), ..fit.pose };
                (pose, at(pose))
            });
            let mut turned: Vec<(Pose, f32)> = turned.collect();
            turned.sort_by(|a, b| b.1.total_cmp(&a.1));
            let mut best = 2.0 * fit.outline + fit.inner + marks(fitter, &fit.pose);
            for (pose, share) in turned.into_iter().take(LOOK_ALIKES) {
                // What is so much worse before it is fitted does not win by that.
                if share < LOOK_ALIKE_SHARE * quick {
                    break;
                }
                let Some(other) = fitter.fit(model, height_mm, camera, gradient, pose) else { continue };
                let share = 2.0 * other.outline + other.inner + marks(fitter, &other.pose);
                if share > best {
                    (best, fit) = (share, other);
                }
            }
        }
        let silhouette = Silhouette::of(part, camera, &fit.pose, SILHOUETTE_STEP)?;
        let weight = SILHOUETTE_STEP * SILHOUETTE_STEP;
        let mut of_codes = [0u32; 256];
        for (y, row) in silhouette.rows() {
            for (x, _) in (silhouette.bbox.x..).zip(row).filter(|(_, bit)| **bit != 0) {
                of_codes[usize::from(self.region.code(x * SILHOUETTE_STEP, y * SILHOUETTE_STEP))] += weight;
            }
        }
        let of_objects: BTreeMap<u8, u32> = (OBJECT..=u8::MAX)
            .map(|code| (code, of_codes[usize::from(code)]))
            .filter(|(_, count)| *count > 0)
            .collect();
        let of_objects_all: u32 = of_objects.values().sum();
        let outside = of_codes[usize::from(OUTSIDE)];
        let pixels = [of_objects_all + outside + of_codes[usize::from(SHADOW)], of_objects_all, outside];
        let explained = (!self.region.objects.is_empty()).then(|| {
            let (mut own, mut all) = (0u32, 0u32);
            for (code, &count) in &of_objects {
                let area = self.areas.get(usize::from(code - OBJECT)).copied().unwrap_or(0);
                if 3 * count >= area {
                    own += count;
                    all += area;
                }
            }
            own as f32 / all.max(1) as f32
        });
        let tint = self.tints[index].distance(&Tint::of_frame(self.frame, &silhouette));
        Some(Candidate { part: index, fit, silhouette, pixels, of_objects, explained, features: 0.0, tint })
    }
}

/// A box and so many pixels around it.
fn window_of(bbox: BoundingBox, margin_px: i32) -> Window {
    let [left, top, right, bottom] = [bbox.x, bbox.y, bbox.right() + 1, bbox.bottom() + 1].map(|c| c as i32);
    [left - margin_px, top - margin_px, right + margin_px, bottom + margin_px]
}
