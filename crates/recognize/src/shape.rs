//! Recognition by shape (section 5.2 of the paper): from the pixels of a region to candidates, parts at fitted poses.
//!
//! In: a salient region with its objects, the edges of the frame there, the models of the parts. Out: [`Candidate`]s, among
//! which `candidate` chooses. Where outlines leave no doubt the cost is that of a few shape contexts and fits an object;
//! else every part is searched for over the region.

use std::collections::BTreeMap;
use std::f64::consts::{FRAC_PI_2, TAU};

use rayon::prelude::*;
use samsod_camera::Camera;
use samsod_segment::{BoundingBox, RgbView};
use samsod_shadow::ObjectRegion;

use crate::candidate::{Candidate, MOST_SHARED, SAME_PLACE, SURE, choose};
use crate::catalogue::Part;
use crate::coarse::{CoarseSearch, Window};
use crate::contour_match::{Contour, ContourGuess};
use crate::edge_model::EdgeModel;
use crate::gradient::Gradient;
use crate::leftover::Leftover;
use crate::orientation_map::OrientationMap;
use crate::pose_fit::{Fit, Fitter, LocalView, Pose};
use crate::region_pixels::{OBJECT, OUTSIDE, RegionPixels, SHADOW, box_round};
use crate::ring_letters::turned_by_letters;
use crate::silhouette::Silhouette;
use crate::tint::Tint;
use crate::uncovered::uncovered_lead;

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
/// and of one that may lie at any of many turns so many more, by their outline alone,
const LOOK_ALIKE_OUTLINES: usize = 2;
/// and so often.
const TURN_ROUNDS: usize = 2;
/// What the points of the outline that one of two turns alone has weigh, beside all of it,
const LONE_WORTH: f32 = 0.5;
/// and what the frame shows where one of them alone covers the table.
const UNCOVERED_WORTH: f32 = 2.0;
/// So many turns are all that there are, about,
const MANY_TURNS: usize = 12;
/// and are tried of what has these log-odds before: it is round where it should be.
const LEAST_BEFORE_TURNS: f32 = -3.0;
/// Fits of a part that differ by less are of one turn, rad.
const LEAST_TURN_RAD: f64 = 0.1;
/// Letters of a round part tell its turn when they are seen to this share,
const LEAST_LETTERS: f32 = 0.35;
/// and turn it when that is so much more than where it is.
const LETTERS_LEAD: f32 = 0.05;
/// Between the turns that are tried of a part of three-fold symmetry or more, rad.
const SECTOR_STEP_RAD: f32 = 0.07;
/// and how much of the edges of the best they must show before.
const LOOK_ALIKE_SHARE: f32 = 0.6;
/// How far from an object its part is looked for where it shares its region with others, px.
const AROUND_PX: i32 = 30;
/// How far a part may reach beyond its region, px.
const BEYOND_PX: i32 = 16;
/// Log-odds of parts that are taken for known where what they leave of objects is searched.
const KNOWN: f32 = 0.0;
/// Log-odds of parts that are likely,
const LIKELY: f32 = 0.0;
/// and groups of objects that they leave unexplained that are searched as one each.
const GROUPS: usize = 3;
/// A region is searched as a whole where it is no longer than so many radii of the largest part.
const SMALL_REGION: f32 = 2.4;
/// An object of which a sure part has this share is not searched for again.
const EXPLAINED: f32 = 0.7;
/// Outlines leave no doubt where sure parts have this share of the objects of a region.
const CONVINCING: f32 = 0.8;
/// and of every one that has the area of this share of the smallest part
const LEAST_PIECE: f32 = 0.25;
/// this share,
const LEFT: f32 = 0.5;
/// and find this share of their outline,
const CONVINCING_HITS: f32 = 0.3;
/// or local features that agree to this score.
const CONVINCING_FEATURES: f32 = 0.65;
/// Log-odds below which a fit is not started again from nearby,
const LEAST: f32 = -5.0;
/// by turns of so much, rad,
const RESTART_RAD: f64 = 0.1;
/// and moves by this share of the radius, and so many mm at least.
const RESTART_SHARE: f64 = 0.12;
const RESTART_MM: f64 = 1.0;
/// and of large parts by moves of so much, too, and turns that move their ends by it, mm.
const RESTART_NEAR_MM: f64 = 2.0;
/// Every choice is fitted again from so far to either side, rad.
const SETTLE_RAD: f64 = 0.05;
/// Fits of doubtful ones are started again of so many choices and their rivals, each so often.
const RESTARTED: usize = 3;
const RESTARTS_FITTED: usize = 3;
/// and of so many parts in pieces, of these log-odds.
const JOINED: usize = 2;
const LEAST_JOINED: f32 = -2.0;
/// Silhouettes of candidates have every second pixel of every second row.
const SILHOUETTE_STEP: u32 = 2;
/// Fits of one part that are no farther apart are one.
const KNOWN_MM: f64 = 0.5;
const KNOWN_RAD: f64 = 0.01;
/// Nor is one of a part whose best turn has been found, beyond doubt, so far away, mm.
const BESIDE_KNOWN_MM: f64 = 3.0;
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
    /// Pixels of an object that may be a part.
    least_piece_px: f32,
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

/// A part turned to where its outline looks alike.
#[derive(Debug, Clone, Copy)]
struct Turned {
    pose: Pose,
    outline: f32,
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
            least_piece_px: LEAST_PIECE * smallest_px(models, camera, region),
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
            let code = [RegionPixels::code_of(k)];
            let roughs_of = |fitter: &mut Fitter, &(index, _): &(usize, f32)| {
                let part = &self.parts[index];
                let (height_mm, order) = (part.height_mm, part.symmetry.shape_order);
                let guesses = contour.guesses(&self.models[index], height_mm, order, self.camera);
                let rough = |guess: &ContourGuess| self.rough(fitter, index, guess.pose, Some(&code));
                guesses.iter().filter_map(rough).collect::<Vec<Rough>>()
            };
            let roughs: Vec<Vec<Rough>> = near.par_iter().map_init(Fitter::default, roughs_of).collect();
            self.fit_best(roughs.concat());
        }
    }

    /// Whether sure parts explain the objects of the region, and none of them that may be a part is left.
    pub(crate) fn is_convincing(&self) -> bool {
        let chosen = choose(&self.candidates);
        let chosen = chosen.iter().map(|choice| &self.candidates[choice.index]);
        let is_seen = |c: &Candidate| c.fit.hits >= CONVINCING_HITS || c.features >= CONVINCING_FEATURES;
        let sure: Vec<&Candidate> = chosen.filter(|c| c.odds() >= SURE && is_seen(c)).collect();
        let explained: u32 = sure.iter().map(|c| c.pixels[1]).sum();
        let objects: u32 = self.areas.iter().sum();
        let is_left = |(k, area): (usize, &u32)| {
            let code = RegionPixels::code_of(k);
            let own: u32 = sure.iter().filter_map(|c| c.of_objects.get(&code)).sum();
            *area as f32 >= self.least_piece_px && (own as f32) < LEFT * *area as f32
        };
        explained as f32 >= CONVINCING * objects as f32 && !self.areas.iter().enumerate().any(is_left)
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
        if self.region.objects.len() <= 1 || self.is_small(whole) {
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
            self.search_window(&map, window, Some(&[code]));
        }
    }

    /// Candidates from a search over what no likely part explains: a part in pieces is larger than any of them.
    pub(crate) fn by_search_of_rest(&mut self) {
        if self.region.objects.len() < 2 {
            return;
        }
        let chosen: Vec<&Candidate> =
            choose(&self.candidates).iter().map(|choice| &self.candidates[choice.index]).collect();
        let is_left = |k: usize, least: f32| {
            let code = RegionPixels::code_of(k);
            let likely = chosen.iter().filter(|c| c.odds() >= least);
            let own: u32 = likely.filter_map(|c| c.of_objects.get(&code)).sum();
            (own as f32) < EXPLAINED * self.areas[k] as f32
        };
        // With what is not sure of pieces: a small part may be likely in one of them.
        let rest: Vec<usize> = (0..self.region.objects.len()).filter(|&k| is_left(k, SURE)).collect();
        let unlikely: Vec<u8> =
            rest.iter().filter(|&&k| is_left(k, LIKELY)).map(|&k| RegionPixels::code_of(k)).collect();
        let whole = window_of(self.region.bbox, BEYOND_PX);
        // Those whose boxes, shadows included, meet.
        let window = |k: usize| -> Option<Window> {
            let (own, shadow) = self.region.boxes.get(k).copied()?;
            let own = window_of(own, BEYOND_PX);
            Some(shadow.map_or(own, |shadow| union(own, window_of(shadow, BEYOND_PX))))
        };
        let mut groups: Vec<(Window, Vec<u8>)> = Vec::new();
        for k in rest {
            let Some(mut joined) = window(k) else { continue };
            let mut codes = vec![RegionPixels::code_of(k)];
            let meets = |a: &Window, b: &Window| a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];
            while let Some(i) = groups.iter().position(|(other, _)| meets(other, &joined)) {
                let (other, mut others) = groups.swap_remove(i);
                joined = union(joined, other);
                codes.append(&mut others);
            }
            groups.push((joined, codes));
        }
        groups.retain(|(_, codes)| codes.len() > 1 && codes.iter().any(|code| unlikely.contains(code)));
        groups.truncate(GROUPS);
        if groups.is_empty() {
            return;
        }
        let mut map = OrientationMap::default();
        map.fill(&self.gradient, &self.region.near(NEAR_PX), CELL_PX);
        for (window, codes) in groups {
            let window =
                [window[0].max(whole[0]), window[1].max(whole[1]), window[2].min(whole[2]), window[3].min(whole[3])];
            self.search_window(&map, window, Some(&codes));
        }
    }

    /// Candidates from a search over what likely parts leave of the objects that they lie on: two parts that were taken for one
    /// object are larger than either.
    pub(crate) fn by_search_of_left(&mut self) {
        let likely: Vec<&Silhouette> = choose(&self.candidates)
            .iter()
            .map(|choice| &self.candidates[choice.index])
            .filter(|c| c.odds() >= KNOWN)
            .map(|c| &c.silhouette)
            .collect();
        if likely.is_empty() {
            return;
        }
        let least_px = LEFT * self.least_piece_px / LEAST_PIECE;
        let Some(left) = Leftover::of(self.region, &likely, least_px as u32) else { return };
        let mut areas = vec![0; left.codes.len()];
        for &code in &left.region.codes {
            if let Some(area) = code.checked_sub(OBJECT).and_then(|k| areas.get_mut(usize::from(k))) {
                *area += 1;
            }
        }
        let mut search = RegionSearch {
            region: &left.region,
            gradient: std::mem::take(&mut self.gradient),
            areas,
            fitter: std::mem::take(&mut self.fitter),
            candidates: Vec::new(),
            ..*self
        };
        let mut map = OrientationMap::default();
        map.fill(&search.gradient, &search.region.near(NEAR_PX), CELL_PX);
        for (k, (own, _)) in left.region.boxes.iter().enumerate() {
            let window = window_of(*own, AROUND_PX);
            search.search_window(&map, window, Some(&[RegionPixels::code_of(k)]));
        }
        search.restart();
        search.settle();
        let mut found = std::mem::take(&mut search.candidates);
        (self.gradient, self.fitter) = (search.gradient, search.fitter);
        for candidate in &mut found {
            // What is left belongs to the object that it was left of.
            let mut of_objects = BTreeMap::new();
            for (code, count) in &candidate.of_objects {
                let whole = code.checked_sub(OBJECT).and_then(|k| left.codes.get(usize::from(k)));
                *of_objects.entry(whole.copied().unwrap_or(*code)).or_insert(0) += count;
            }
            candidate.of_objects = of_objects;
        }
        self.candidates.extend(found);
    }

    /// Candidates at poses that local features propose, for some objects (by their codes).
    pub(crate) fn by_proposals(&mut self, proposals: &[(usize, Pose)], of_objects: &[u8]) {
        let rough =
            |fitter: &mut Fitter, &(part, pose): &(usize, Pose)| self.rough(fitter, part, pose, Some(of_objects));
        let roughs: Vec<Option<Rough>> = proposals.par_iter().map_init(Fitter::default, rough).collect();
        self.fit_best(roughs.into_iter().flatten().collect());
    }

    /// Candidates where likely ones would lie turned by quarters: a few features hardly tell the ends of a part apart.
    pub(crate) fn by_quarter_turns(&mut self) {
        let likely: Vec<(usize, Pose)> = choose(&self.candidates)
            .iter()
            .map(|choice| &self.candidates[choice.index])
            .filter(|c| c.odds() >= LEAST && self.parts[c.part].symmetry.shape_order == 1)
            .map(|c| (c.part, c.fit.pose))
            .collect();
        for (part, pose) in likely {
            for quarters in [1.0, 2.0, 3.0] {
                self.add(part, Pose { yaw_rad: pose.yaw_rad + quarters * FRAC_PI_2, ..pose }, 0.0);
            }
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
        let mut fitter = std::mem::take(&mut self.fitter);
        let candidate = self.candidate(&mut fitter, part, guess);
        self.fitter = fitter;
        let candidate = candidate.map(|candidate| Candidate { features, ..candidate });
        self.candidates.extend(candidate);
    }

    /// The likeliest poses of doubtful parts in pieces, each another turn of one part.
    fn joined(&self) -> Vec<usize> {
        let chosen = choose(&self.candidates);
        let is_doubtful = |c: &Candidate| {
            let others = chosen.iter().map(|choice| &self.candidates[choice.index]);
            let mut others = others.filter(|other| c.overlap(other) > MOST_SHARED).map(Candidate::odds);
            c.is_joined() && (LEAST_JOINED..SURE).contains(&c.odds()) && others.all(|odds| odds < SURE)
        };
        let mut order: Vec<usize> = (0..self.candidates.len()).filter(|&i| is_doubtful(&self.candidates[i])).collect();
        order.sort_by(|&a, &b| self.candidates[b].odds().total_cmp(&self.candidates[a].odds()));
        let mut joined: Vec<usize> = Vec::new();
        for i in order {
            let like = |&j: &usize| {
                let (a, b) = (&self.candidates[i], &self.candidates[j]);
                let turn = (a.fit.pose.yaw_rad - b.fit.pose.yaw_rad).rem_euclid(TAU);
                a.part == b.part && turn.min(TAU - turn) < LEAST_TURN_RAD && a.overlap(b) > SAME_PLACE
            };
            if joined.len() < JOINED && !joined.iter().any(like) {
                joined.push(i);
            }
        }
        joined
    }

    /// Where choices are doubtful, starts their fits and those of their rivals again from poses nearby.
    pub(crate) fn restart(&mut self) {
        let doubtful: Vec<(usize, Pose, f32)> = choose(&self.candidates)
            .iter()
            .filter(|choice| (LEAST..SURE).contains(&self.candidates[choice.index].odds()))
            .take(RESTARTED)
            .flat_map(|choice| std::iter::once(choice.index).chain(choice.rival))
            .chain(self.joined())
            .map(|i| (self.candidates[i].part, self.candidates[i].fit.pose, self.candidates[i].features))
            .collect();
        for (part, pose, features) in doubtful {
            let step = (RESTART_SHARE * f64::from(self.models[part].radius_mm)).max(RESTART_MM);
            let (sin, cos) = pose.yaw_rad.sin_cos();
            let moves = [(step, 0.0), (-step, 0.0), (0.0, step), (0.0, -step)];
            let turns = [RESTART_RAD, -RESTART_RAD];
            let starts = moves.map(|(x, y)| (x, y, 0.0)).into_iter().chain(turns.map(|yaw| (0.0, 0.0, yaw)));
            // Of a long part so much is far.
            let near_rad = RESTART_NEAR_MM / f64::from(self.models[part].radius_mm);
            let d = RESTART_NEAR_MM;
            let near_moves = [(d, 0.0, 0.0), (-d, 0.0, 0.0), (0.0, d, 0.0), (0.0, -d, 0.0)];
            let near = near_moves.into_iter().chain([(0.0, 0.0, near_rad), (0.0, 0.0, -near_rad)]);
            let starts = starts.chain(near.filter(|_| step > 1.5 * RESTART_NEAR_MM));
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
        self.prune_turns();
    }

    /// Of fits of one part in one place that differ by one of many turns keeps the one that more speaks for than for any other.
    fn prune_turns(&mut self) {
        let (fitter, camera, gradient) = (&mut self.fitter, self.camera, &self.gradient);
        let mut lost = vec![false; self.candidates.len()];
        for i in 0..self.candidates.len() {
            let (part, model) = (&self.parts[self.candidates[i].part], &self.models[self.candidates[i].part]);
            if part.symmetry.shape_order != 1 || model.look_alike_turns.len() < MANY_TURNS {
                continue;
            }
            for j in i + 1..self.candidates.len() {
                let (a, b) = (&self.candidates[i], &self.candidates[j]);
                let turn = (a.fit.pose.yaw_rad - b.fit.pose.yaw_rad).rem_euclid(TAU);
                let is_turned = turn.min(TAU - turn) > LEAST_TURN_RAD;
                let is_likely = a.odds().min(b.odds()) >= LEAST;
                if lost[i] || lost[j] || a.part != b.part || !is_turned || !is_likely || a.overlap(b) < SAME_PLACE {
                    continue;
                }
                let height_mm = part.height_mm;
                let [own, other] = [a, b].map(|c| {
                    let shares = [c.fit.outline, c.fit.inner];
                    turn_worth(fitter, model, height_mm, (camera, gradient), shares, &c.fit.pose)
                });
                let poses = [&a.fit.pose, &b.fit.pose];
                let lead = fitter.lone_lead(model, height_mm, camera, gradient, poses).unwrap_or_default();
                let lead = LONE_WORTH * lead + UNCOVERED_WORTH * uncovered(part, camera, self.frame, poses);
                let is_other = other + lead > own;
                lost[if is_other { i } else { j }] = true;
            }
        }
        let mut lost = lost.into_iter();
        self.candidates.retain(|_| !lost.next().unwrap_or_default());
    }

    /// A part whose outline does not tell its turn, turned as what is written on it says; `None` where nothing does.
    pub(crate) fn turned_by_lettering(&mut self, index: usize, pose: Pose) -> Option<Pose> {
        let (part, model) = (&self.parts[index], &self.models[index]);
        if let Some(lettering) = &model.lettering {
            let seen = (self.frame, &self.gradient);
            return lettering.turned(&mut self.fitter, model, part, self.camera, seen, pose);
        }
        if model.letters.is_empty() {
            return None;
        }
        let (fitter, height_mm) = (&mut self.fitter, part.height_mm);
        let own = fitter.signed_share(&model.letters, height_mm, self.camera, &self.gradient, &pose)?;
        let (turned, share) = turned_by_letters(fitter, &model.letters, height_mm, self.camera, &self.gradient, pose);
        if share < LEAST_LETTERS {
            return None;
        }
        Some(if share > own + LETTERS_LEAD { turned } else { pose })
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

    fn search_window(&mut self, map: &OrientationMap, window: Window, of_objects: Option<&[u8]>) {
        let roughs_of = |(search, fitter): &mut (CoarseSearch, Fitter), index: usize| {
            let (part, model) = (&self.parts[index], &self.models[index]);
            let (height_mm, order) = (part.height_mm, part.symmetry.shape_order);
            let guesses = search.search(model, height_mm, order, self.camera, &self.gradient, map, window);
            guesses.iter().filter_map(|guess| self.rough(fitter, index, guess.pose, of_objects)).collect::<Vec<Rough>>()
        };
        let all = (0..self.parts.len()).into_par_iter();
        let roughs: Vec<Vec<Rough>> = all.map_init(Default::default, roughs_of).collect();
        self.fit_best(roughs.concat());
    }

    /// What a guess is worth after a quick fit: for some objects (by their codes), or for all of the region.
    fn rough(&self, fitter: &mut Fitter, part: usize, guess: Pose, of_objects: Option<&[u8]>) -> Option<Rough> {
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
                code if of_objects.is_none_or(|own| own.contains(&code)) => object += 1,
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
    fn candidate(&self, fitter: &mut Fitter, index: usize, guess: Pose) -> Option<Candidate> {
        let (part, model) = (&self.parts[index], &self.models[index]);
        let known: Vec<Pose> = self.candidates.iter().filter(|c| c.part == index).map(|c| c.fit.pose).collect();
        let (camera, gradient) = (self.camera, &self.gradient);
        let mut fit = fitter.fit(model, part.height_mm, camera, gradient, guess)?;
        let turns: Vec<f32> = match part.symmetry.shape_order {
            0 | 2 => Vec::new(),
            1 => model.look_alike_turns.clone(),
            // Between one and the next of the turns that are the same.
            n => (1..).map(|k| k as f32 * SECTOR_STEP_RAD).take_while(|turn| turn * (n as f32) < 6.2).collect(),
        };
        let apart_mm = |other: &Pose| (fit.pose.x_mm - other.x_mm).hypot(fit.pose.y_mm - other.y_mm);
        let is_near = |other: &Pose, turn: f64| {
            let turned = (fit.pose.yaw_rad - other.yaw_rad).rem_euclid(TAU);
            apart_mm(other) <= KNOWN_MM && turned.min(TAU - turned) <= turn
        };
        // What is round inside agrees at any turn: an outline that does not may only be turned.
        let looks_alike = fit.outline.max(fit.inner) >= LOOK_ALIKE_FIT && !turns.is_empty();
        // Of a part that may be turned by anything the best turn has been found.
        let by_letters = fit.outline >= LOOK_ALIKE_FIT && part.symmetry.shape_order == 0 && !model.letters.is_empty();
        let any_turn = (looks_alike && turns.len() >= MANY_TURNS) || by_letters;
        if known.iter().any(|other| is_near(other, if any_turn { TAU } else { KNOWN_RAD })) {
            return None;
        }
        let is_beside =
            |c: &Candidate| c.part == index && apart_mm(&c.fit.pose) <= BESIDE_KNOWN_MM && c.odds() >= BEYOND_DOUBT;
        if any_turn && self.candidates.iter().any(is_beside) {
            return None;
        }
        let is_hopeless = |fit: Fit| self.assess(index, fit).is_none_or(|c| c.odds() < LEAST_BEFORE_TURNS);
        if looks_alike && !(turns.len() >= MANY_TURNS && is_hopeless(fit)) {
            let has_many = turns.len() >= MANY_TURNS && part.symmetry.shape_order == 1;
            let (height_mm, view) = (part.height_mm, (camera, gradient));
            let at = |fitter: &mut Fitter, pose: Pose| {
                let shares = fitter.edge_shares(model, height_mm, camera, gradient, pose).unwrap_or_default();
                Turned { pose, outline: shares[0], worth: turn_worth(fitter, model, height_mm, view, shares, &pose) }
            };
            // About a place that a wrong turn was fitted to the right one does not quite meet its edges: once more from where the
            // best turn puts it.
            for _ in 0..if has_many { TURN_ROUNDS } else { 1 } {
                // What is fitted is compared as it is, what is not by the quicker shares.
                let quick = at(fitter, fit.pose).worth;
                let turned_by = |turn: &f32| Pose { yaw_rad: fit.pose.yaw_rad + f64::from(*turn), ..fit.pose };
                let mut turned: Vec<Turned> = turns.iter().map(|turn| at(fitter, turned_by(turn))).collect();
                turned.sort_by(|a, b| b.worth.total_cmp(&a.worth));
                let mut contenders: Vec<Turned> = turned.iter().take(LOOK_ALIKES).copied().collect();
                if has_many {
                    // What is inside may be hidden in glare.
                    turned.drain(..contenders.len());
                    turned.sort_by(|a, b| b.outline.total_cmp(&a.outline));
                    contenders.extend(turned.iter().take(LOOK_ALIKE_OUTLINES));
                }
                let before = fit.pose;
                let mut own = None;
                let mut best = turn_worth(fitter, model, height_mm, view, [fit.outline, fit.inner], &fit.pose);
                for Turned { pose, worth: share, .. } in contenders {
                    // What is so much worse before it is fitted does not win by that.
                    if share < LOOK_ALIKE_SHARE * quick {
                        continue;
                    }
                    let Some(other) = fitter.fit(model, height_mm, camera, gradient, pose) else { continue };
                    let share = turn_worth(fitter, model, height_mm, view, [other.outline, other.inner], &other.pose);
                    let poses = [&fit.pose, &other.pose];
                    let lone = fitter.lone_lead(model, height_mm, camera, gradient, poses).unwrap_or_default();
                    let mut lead = share + LONE_WORTH * lone - best;
                    let mut turned = None;
                    if has_many {
                        let first = own.get_or_insert_with(|| Silhouette::of(part, camera, &fit.pose, 1));
                        turned = Silhouette::of(part, camera, &other.pose, 1);
                        let pair = first.as_ref().zip(turned.as_ref());
                        lead += UNCOVERED_WORTH * pair.map_or(0.0, |(a, b)| uncovered_lead(self.frame, a, b));
                    }
                    if lead > 0.0 {
                        (best, fit, own) = (share, other, Some(turned));
                    }
                }
                if fit.pose == before {
                    break;
                }
            }
        }
        if by_letters {
            // What is inside counts where it is turned as it is seen.
            let letters = &model.letters;
            let (turned, _) = turned_by_letters(fitter, letters, part.height_mm, camera, gradient, fit.pose);
            let turned = fitter.fit(model, part.height_mm, camera, gradient, turned);
            fit = turned.filter(|turned| turned.inner > fit.inner).unwrap_or(fit);
        }
        self.assess(index, fit)
    }

    /// The candidate that a fit of a part is; `None` outside of the frame.
    fn assess(&self, index: usize, fit: Fit) -> Option<Candidate> {
        let silhouette = Silhouette::of(&self.parts[index], self.camera, &fit.pose, SILHOUETTE_STEP)?;
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

/// How much better the second of two poses agrees with what the frame shows where one of them alone covers the table.
fn uncovered(part: &Part, camera: &Camera, frame: &RgbView<'_>, poses: [&Pose; 2]) -> f32 {
    let [first, second] = poses.map(|pose| Silhouette::of(part, camera, pose, 1));
    first.zip(second).map_or(0.0, |(first, second)| uncovered_lead(frame, &first, &second))
}

/// What speaks for a turn among those that look alike: its shares of edges, of the outline and inside, and of marks. The outline
/// counts twice: what a picture shows inside depends on where the light comes from.
fn turn_worth(
    fitter: &mut Fitter,
    model: &EdgeModel,
    height_mm: f64,
    (camera, gradient): (&Camera, &Gradient),
    [outline, inner]: [f32; 2],
    pose: &Pose,
) -> f32 {
    let marks = fitter.mark_share(model, height_mm, camera, gradient, pose).unwrap_or_default();
    2.0 * outline + inner + marks
}

/// Pixels of the smallest part in a region; 0 where the camera does not see the table.
fn smallest_px(models: &[EdgeModel], camera: &Camera, region: &RegionPixels) -> f32 {
    let b = region.bbox;
    let center = [b.x + b.right(), b.y + b.bottom()].map(|c| 0.5 * f64::from(c));
    let place = camera.world_from_image(center, 0.0).ok();
    let local = place.and_then(|[x, y, _]| LocalView::new(camera, x, y, 1.0));
    let areas = models.iter().map(|model| model.view([0.0, 0.0, 1.0]).area_mm2);
    let least = areas.fold(f32::INFINITY, f32::min);
    local.filter(|_| least.is_finite()).map_or(0.0, |local| least * local.px_per_mm().powi(2))
}

/// The smallest window round two.
fn union(a: Window, b: Window) -> Window {
    [a[0].min(b[0]), a[1].min(b[1]), a[2].max(b[2]), a[3].max(b[3])]
}

/// A box and so many pixels around it.
fn window_of(bbox: BoundingBox, margin_px: i32) -> Window {
    let [left, top, right, bottom] = [bbox.x, bbox.y, bbox.right() + 1, bbox.bottom() + 1].map(|c| c as i32);
    [left - margin_px, top - margin_px, right + margin_px, bottom + margin_px]
}
