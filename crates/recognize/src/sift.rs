//! Recognition by local features (section 5.1 of the paper).
//!
//! In: a box of a frame, the features of the parts' templates, the camera. Out: a [`SiftMatch`] for every instance of a
//! part that enough features agree on, with its pose in the image (px, rad) and on the table (mm, rad) and its score in
//! [0, 1].
//!
//! 1. SIFT features of the box, once for all parts; not of the frame under a mask, for which OpenCV would build the scale
//!    space of the whole frame.
//! 2. For every feature the two nearest of each part. It stands out when the second is `ratio` times as far.
//! 3. Every match says where the part would lie. Both features are put on the plane of their height, mm, so their scales
//!    must be equal, too. Hough clustering over (x, y, scale, angle): first of what stands out, then of all nearest
//!    neighbours, since lettering repeats itself and hardly stands out; agreement is then all there is, and more is asked.
//! 4. The rigid motion that fits a cluster, then all features of the part that find their like where the motion puts
//!    them, and the motion that fits those. The same for its quarter turns: round parts look alike.
//! 5. A RANSAC homography of what agrees: what it leaves out is not on the part, and a part that it mirrors or shears is
//!    none.
//!
//! What no match takes still says where parts may lie: [`Proposal`]s, one a place, for others to confirm.
//!
//! Features are bounded by `max_features` for a box and a template. Time: that of the features, then their number in the
//! box times that in all templates times 128 multiplications.

use std::f64::consts::{FRAC_PI_2, LN_2, PI, TAU};

use opencv::core::set_num_threads;
use rayon::prelude::*;
use samsod_camera::Camera;
use samsod_segment::{BoundingBox, RgbView};

use crate::homography::{self, Found, failed};
use crate::hough::{self, Cells, Vote};
use crate::rigid_fit::{Pair, Rigid};
use crate::sift_features::{Features, SiftModel, dot};
use crate::sift_part::{Match, Rays, SiftPart, UNLIKE};
use crate::{ImagePose, Part, RecognizeError, SiftParams, WorldPose};

/// Distance up to which a feature lies where the pose puts it, mm.
const TOLERANCE_MM: f64 = 1.5;
/// The same before the pose was fitted to such features.
const FIRST_TOLERANCE_MM: f64 = 2.25;
/// Error of the pose that a cluster begins with, mm.
const CLUSTER_MM: f64 = 8.0;
/// Side of a cell of the vote: a share of the extent of the features, and no less than so many mm.
const CELL_SHARE: f64 = 0.12;
const LEAST_CELL_MM: f64 = 6.0;
/// Cells round the circle.
const CELL_ANGLES: u32 = 18;
/// Instances of a part that are nearer than this share of its reach are one.
const SAME_PLACE_SHARE: f64 = 0.5;
/// Votes of a cluster.
const LEAST_VOTES: usize = 3;
/// Clusters that are looked into: of features that stand out, and of all.
const CLUSTERS: [usize; 2] = [3, 5];
/// The feature next to the nearest must be so many times as far for a match to have a vote at all.
const LEAST_RATIO: f32 = 1.05;
/// Features that stand out or not must agree in such a multiple of `min_inliers`.
const UNSURE: f64 = 1.5;
/// Greatest differences of the logarithm of the size, and of the direction (rad), of features that are the same.
const MAX_LN_SIZE: f64 = 0.45;
const MAX_TURN_RAD: f64 = 0.52;
/// Scale of a part in mm, of which the camera knows that it is 1.
const SCALES: std::ops::RangeInclusive<f64> = 0.9..=1.1;
/// Poses of a part that are proposed, those that most features give first;
const PROPOSALS: usize = 40;
/// features give the same within so many mm and rad.
const SAME_POSE_MM: f64 = 4.0;
const SAME_POSE_RAD: f64 = 0.14;
/// Of turns that the outline allows one is told by features that agree with it in so many places, weighed by how like they are,
const LEAST_TURN: f64 = 1.0;
/// and in so many times as many as with any other.
const TURN_LEAD: f64 = 1.5;
/// Features lie within so many px of where they are looked for when they lie within a mm.
const MAX_PX_PER_MM: f64 = 4.0;

/// How a part was found.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct SiftMatch {
    /// Index of the part in the catalogue.
    pub(crate) part: usize,
    /// Places of the template whose feature lies where the pose puts it.
    pub(crate) inliers: usize,
    /// Matches that stood out, whether they agree with the pose or not.
    pub(crate) matches: usize,
    /// `inliers / (inliers + min_inliers)`: 0.5 with the fewest that count.
    pub(crate) score: f32,
    /// Where it is seen.
    pub(crate) image: ImagePose,
    /// Where it lies, when the camera is known; the yaw is that of the template's appearance, whatever its symmetry.
    pub(crate) world: Option<WorldPose>,
    /// Pixels of the frame from pixels of the template, on the plane of the part's height: that of the pose, which is
    /// known better than the eight numbers of a homography would be from the features alone.
    pub(crate) homography: [[f64; 3]; 3],
}

/// Where features that are too few to name a part put it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Proposal {
    /// Index of the part in the catalogue.
    pub(crate) part: usize,
    /// The pose on the table.
    pub(crate) motion: Rigid,
}

/// Finds the parts of a catalogue by their features. Calls from several threads do not wait for each other.
#[derive(Debug)]
pub(crate) struct SiftMatcher {
    params: SiftParams,
    parts: Vec<SiftPart>,
}

/// The features of a box of a frame.
#[derive(Debug)]
pub(crate) struct Crop {
    found: Features,
    /// Squared lengths of the descriptors.
    norms: Vec<i32>,
    /// First pixel of the box.
    origin_px: [f64; 2],
}

/// One part against one box.
struct Search<'a> {
    part: &'a SiftPart,
    crop: &'a Crop,
    rays: &'a Rays,
    matches: &'a [Match],
    /// Features of the box that no instance of the part has taken.
    is_free: &'a [bool],
}

/// A part at a pose.
struct Candidate {
    motion: Rigid,
    agreements: Vec<Agreement>,
    /// Sum over the places, of likeness times distinctness, and the number of matches that stood out.
    quality: f64,
}

/// A feature of the part that was found where the pose puts it.
#[derive(Debug, Clone, Copy)]
struct Agreement {
    of_part: usize,
    of_crop: usize,
    quality: f64,
    pair: Pair,
}

impl SiftMatcher {
    /// A matcher for parts and the features of their templates, in the same order.
    ///
    /// # Errors
    /// OpenCV failed.
    pub(crate) fn new(models: &[SiftModel], parts: &[Part], params: &SiftParams) -> Result<Self, RecognizeError> {
        // Several boxes are searched at once; threads within one would only wait for each other.
        set_num_threads(1).map_err(failed)?;
        let parts = models.par_iter().zip(parts).map(|(model, part)| SiftPart::new(model, part)).collect();
        Ok(Self { params: params.clone(), parts })
    }

    /// The parts that are seen in a box of a frame, every part as often as it is seen, the surest first.
    ///
    /// # Arguments
    /// * `bbox` - box of the object and some pixels around it, within the frame
    /// * `is_wanted` - whether a pixel (x, y) of the frame is of the object or close to it; `None`: every pixel of the box
    /// * `camera` - that of the frame; without it, that of the templates
    ///
    /// # Errors
    /// OpenCV failed.
    pub(crate) fn match_region(
        &self,
        frame: &RgbView<'_>,
        bbox: &BoundingBox,
        is_wanted: Option<&dyn Fn(u32, u32) -> bool>,
        camera: Option<&Camera>,
    ) -> Result<Vec<SiftMatch>, RecognizeError> {
        self.match_crop(&self.crop(frame, bbox, is_wanted)?, camera, None)
    }

    /// What [`Self::match_region`] finds, and where the features that no match has taken would put parts.
    ///
    /// # Errors
    /// OpenCV failed.
    pub(crate) fn match_and_propose(
        &self,
        crop: &Crop,
        camera: &Camera,
    ) -> Result<(Vec<SiftMatch>, Vec<Proposal>), RecognizeError> {
        let mut proposals = Vec::new();
        let found = self.match_crop(crop, Some(camera), Some(&mut proposals))?;
        Ok((found, proposals))
    }

    /// Of the turns by which the outline of a part is the same, `order` in all, that which clearly most features agree with.
    pub(crate) fn turned(&self, crop: &Crop, camera: &Camera, part: usize, order: u32, pose: Rigid) -> Option<Rigid> {
        let (part, rays) = (&self.parts[part], Rays::new(camera, &crop.found.features, crop.origin_px));
        let is_free = vec![true; crop.norms.len()];
        let search = Search { part, crop, rays: &rays, matches: &[], is_free: &is_free };
        let turned = |k: u32| {
            let motion = Rigid { angle_rad: pose.angle_rad + TAU * f64::from(k) / f64::from(order), ..pose };
            let agreements = search.agreements(&motion, FIRST_TOLERANCE_MM);
            let candidate = Candidate { motion, agreements, quality: 0.0 };
            (motion, candidate.places(part).sum::<f64>())
        };
        let mut turns: Vec<(Rigid, f64)> = (0..order).map(turned).collect();
        turns.sort_by(|a, b| b.1.total_cmp(&a.1));
        let [(best, most), others @ ..] = &turns[..] else { return None };
        let next = others.first().map_or(0.0, |(_, quality)| *quality);
        (*most >= LEAST_TURN && *most >= TURN_LEAD * next).then_some(*best)
    }

    fn match_crop(
        &self,
        crop: &Crop,
        camera: Option<&Camera>,
        mut proposals: Option<&mut Vec<Proposal>>,
    ) -> Result<Vec<SiftMatch>, RecognizeError> {
        let (mut found, mut matches, mut rays) = (Vec::new(), Vec::new(), None);
        for (index, part) in self.parts.iter().enumerate() {
            let rays = rays_of(&mut rays, camera.unwrap_or(&part.camera), crop);
            let is_free = self.instances(index, crop, rays, &mut matches, camera.is_some(), &mut found)?;
            if let Some(proposals) = proposals.as_deref_mut() {
                let search = Search { part, crop, rays, matches: &matches, is_free: &is_free };
                proposals.extend(search.poses().into_iter().map(|motion| Proposal { part: index, motion }));
            }
        }
        Ok(surest_first(found))
    }

    /// The conventional method that the paper compares with: the features of the whole frame against all parts, every
    /// part as often as it is seen, the surest first.
    ///
    /// # Errors
    /// OpenCV failed.
    pub(crate) fn conventional(
        &self,
        frame: &RgbView<'_>,
        camera: Option<&Camera>,
    ) -> Result<Vec<SiftMatch>, RecognizeError> {
        let bbox = BoundingBox { x: 0, y: 0, width: frame.width(), height: frame.height() };
        let crop = self.crop(frame, &bbox, None)?;
        let of_part = |(index, part): (usize, &SiftPart)| {
            let rays = Rays::new(camera.unwrap_or(&part.camera), &crop.found.features, crop.origin_px);
            let mut found = Vec::new();
            self.instances(index, &crop, &rays, &mut Vec::new(), camera.is_some(), &mut found)?;
            Ok(found)
        };
        let of_parts: Result<Vec<Vec<SiftMatch>>, RecognizeError> =
            self.parts.par_iter().enumerate().map(of_part).collect();
        Ok(surest_first(of_parts?.concat()))
    }

    /// Appends every instance of a part: cluster after cluster, each without the features of those before. Returns which features
    /// of the crop none has taken.
    fn instances(
        &self,
        index: usize,
        crop: &Crop,
        rays: &Rays,
        matches: &mut Vec<Match>,
        in_world: bool,
        found: &mut Vec<SiftMatch>,
    ) -> Result<Vec<bool>, RecognizeError> {
        let part = &self.parts[index];
        part.matches(&crop.found.descriptors, &crop.norms, self.params.ratio, LEAST_RATIO, matches);
        let mut is_free = vec![true; crop.norms.len()];
        let mut places: Vec<[f64; 2]> = Vec::new();
        loop {
            let search = Search { part, crop, rays, matches, is_free: &is_free };
            let Some(best) = search.best(self.params.min_inliers)? else { return Ok(is_free) };
            // Two parts do not lie in one place: what an instance leaves there is not another.
            let [x, y] = best.motion.at;
            let apart = SAME_PLACE_SHARE * part.reach_mm;
            if places.iter().all(|[px, py]| (px - x).hypot(py - y) > apart) {
                found.extend(self.describe(index, &search, &best, in_world));
                places.push([x, y]);
            }
            // Every instance takes at least `min_inliers` features, so that there is an end.
            best.agreements.iter().for_each(|agreement| is_free[agreement.of_crop] = false);
        }
    }

    /// What a box of a frame shows, for [`Self::match_and_propose`] and [`Self::turned`]; `is_wanted` as in [`Self::match_region`].
    ///
    /// # Errors
    /// OpenCV failed.
    pub(crate) fn crop(
        &self,
        frame: &RgbView<'_>,
        bbox: &BoundingBox,
        is_wanted: Option<&dyn Fn(u32, u32) -> bool>,
    ) -> Result<Crop, RecognizeError> {
        let of_frame = is_wanted.map(|is_wanted| move |x: u32, y: u32| is_wanted(bbox.x + x, bbox.y + y));
        let is_wanted = of_frame.as_ref().map(|is_wanted| is_wanted as &dyn Fn(u32, u32) -> bool);
        let found = Features::find(frame, bbox, &self.params, is_wanted)?;
        let norms = found.descriptors.iter().map(|descriptor| dot(descriptor, descriptor)).collect();
        Ok(Crop { found, norms, origin_px: [f64::from(bbox.x), f64::from(bbox.y)] })
    }

    /// The pose in the image and on the table; `None` where the camera does not see the part's origin or template.
    fn describe(&self, part: usize, search: &Search<'_>, best: &Candidate, in_world: bool) -> Option<SiftMatch> {
        let height_mm = search.part.height_mm;
        let pixel = |point: [f64; 2]| {
            let [x, y] = best.motion.apply(point);
            search.rays.camera.image_from_world([x, y, height_mm]).ok()
        };
        let (origin_px, along) = (pixel([0.0, 0.0])?, pixel([1.0, 0.0])?);
        // Rows run downwards.
        let angle_rad = (origin_px[1] - along[1]).atan2(along[0] - origin_px[0]);
        let [Some(a), Some(b), Some(c), Some(d)] = search.part.corners_mm.map(pixel) else { return None };
        let homography = homography::through(&search.part.corners_px, &[a, b, c, d])?;
        let [x_mm, y_mm] = best.motion.at;
        let world = WorldPose { x_mm, y_mm, yaw_rad: best.motion.angle_rad, height_mm };
        let inliers = best.places(search.part).count();
        Some(SiftMatch {
            part,
            inliers,
            matches: search.matches.iter().filter(|found| found.stands_out).count(),
            score: inliers as f32 / (inliers + self.params.min_inliers) as f32,
            image: ImagePose { origin_px, angle_rad },
            world: in_world.then_some(world),
            homography: std::array::from_fn(|i| std::array::from_fn(|j| homography[(i, j)])),
        })
    }
}

fn surest_first(mut found: Vec<SiftMatch>) -> Vec<SiftMatch> {
    found.sort_by(|a, b| b.score.total_cmp(&a.score));
    found
}

/// The rays of a camera, made anew when it is another one than before: most catalogues are taught with one.
fn rays_of<'a>(rays: &'a mut Option<Rays>, camera: &Camera, crop: &Crop) -> &'a Rays {
    if rays.as_ref().is_some_and(|rays| rays.camera != *camera) {
        *rays = None;
    }
    rays.get_or_insert_with(|| Rays::new(camera, &crop.found.features, crop.origin_px))
}

impl Search<'_> {
    /// The pose that most features agree on, if these are enough.
    fn best(&self, min_inliers: usize) -> Result<Option<Candidate>, RecognizeError> {
        let (votes, voters) = self.votes();
        let side_mm = (CELL_SHARE * 2.0 * self.part.reach_mm).max(LEAST_CELL_MM);
        let cells = Cells { side_mm, ln_scale: LN_2, angles: CELL_ANGLES };
        let unsure = (UNSURE * min_inliers as f64).ceil() as usize;
        let mut best: Option<Candidate> = None;
        for (only_outstanding, least, most) in [(true, min_inliers, CLUSTERS[0]), (false, unsure, CLUSTERS[1])] {
            let chosen: Vec<usize> = (0..votes.len()).filter(|&i| voters[i].stands_out || !only_outstanding).collect();
            let some: Vec<Vote> = chosen.iter().map(|&i| votes[i]).collect();
            for cluster in hough::clusters(&some, &cells, LEAST_VOTES, most) {
                let members: Vec<Vote> = cluster.iter().map(|&i| some[i]).collect();
                let pairs: Vec<Pair> = cluster.iter().map(|&i| self.pair(&voters[chosen[i]])).collect();
                let guess = self.motion(&hough::mean(&members));
                let fit = Rigid::robust(&pairs, guess, CLUSTER_MM, TOLERANCE_MM);
                let candidate = fit.and_then(|(motion, _)| self.at_pose(motion));
                let enough = candidate.filter(|candidate| candidate.places(self.part).count() >= least);
                best = better(best, enough);
            }
        }
        let Some(Rigid { angle_rad, at }) = best.as_ref().map(|best| best.motion) else { return Ok(None) };
        for quarters in [1.0, 2.0, 3.0] {
            let turned = self.at_pose(Rigid { angle_rad: angle_rad + quarters * FRAC_PI_2, at });
            best = better(best, turned.filter(|turned| turned.places(self.part).count() >= min_inliers));
        }
        let Some(best) = best else { return Ok(None) };
        let confirmed = self.confirm(best)?;
        Ok(confirmed.filter(|confirmed| confirmed.places(self.part).count() >= min_inliers))
    }

    /// Where every match puts the centre of the part's features, if sizes allow it, and the match.
    fn votes(&self) -> (Vec<Vote>, Vec<Match>) {
        let free = self.matches.iter().filter(|found| self.is_free[found.of_crop]);
        let vote = |found: &Match| {
            let of_part = &self.part.features[found.of_part];
            let feature = &self.crop.found.features[found.of_crop];
            let on_plane = self.rays.on_plane(found.of_crop, feature, of_part.height_mm);
            let ln_scale = (on_plane.size_mm / of_part.size_mm).ln();
            let angle_rad = on_plane.angle_rad - of_part.angle_rad;
            let arm = [0, 1].map(|axis| self.part.center[axis] - of_part.at[axis]);
            let at = Rigid { angle_rad, at: on_plane.at }.apply(arm);
            // NaN does not vote either.
            (ln_scale.abs() < MAX_LN_SIZE).then_some((Vote { at, ln_scale, angle_rad }, *found))
        };
        free.filter_map(vote).unzip()
    }

    /// The poses that single features give, those that most of them give first.
    fn poses(&self) -> Vec<Rigid> {
        let (votes, voters) = self.votes();
        let mut poses: Vec<(Vote, usize)> = Vec::new();
        for (vote, voter) in votes.iter().zip(&voters) {
            let weight = if voter.stands_out { 2 } else { 1 };
            let is_same = |other: &Vote| {
                let turn = (vote.angle_rad - other.angle_rad + PI).rem_euclid(TAU) - PI;
                (vote.at[0] - other.at[0]).hypot(vote.at[1] - other.at[1]) <= SAME_POSE_MM
                    && turn.abs() <= SAME_POSE_RAD
            };
            match poses.iter_mut().find(|(other, _)| is_same(other)) {
                Some((_, count)) => *count += weight,
                None => poses.push((*vote, weight)),
            }
        }
        poses.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
        let motion = |(vote, _): &(Vote, usize)| self.motion(vote);
        poses.iter().take(PROPOSALS).map(motion).collect()
    }

    /// The motion of the part that a vote for the place of its centre gives.
    fn motion(&self, vote: &Vote) -> Rigid {
        let [x, y] = Rigid { angle_rad: vote.angle_rad, at: [0.0; 2] }.apply(self.part.center);
        Rigid { angle_rad: vote.angle_rad, at: [vote.at[0] - x, vote.at[1] - y] }
    }

    fn pair(&self, found: &Match) -> Pair {
        let of_part = &self.part.features[found.of_part];
        let feature = &self.crop.found.features[found.of_crop];
        Pair { from: of_part.at, to: self.rays.on_plane(found.of_crop, feature, of_part.height_mm).at }
    }

    /// What agrees with a pose, and the pose that fits this best; `None` when hardly anything does, or only at another
    /// scale.
    fn at_pose(&self, motion: Rigid) -> Option<Candidate> {
        let agreements = self.agreements(&motion, FIRST_TOLERANCE_MM);
        let pairs: Vec<Pair> = agreements.iter().map(|agreement| agreement.pair).collect();
        let (motion, _) = Rigid::robust(&pairs, motion, FIRST_TOLERANCE_MM, TOLERANCE_MM)?;
        let mut agreements = self.agreements(&motion, TOLERANCE_MM);
        let pairs: Vec<Pair> = agreements.iter().map(|agreement| agreement.pair).collect();
        let (motion, scale) = Rigid::robust(&pairs, motion, TOLERANCE_MM, TOLERANCE_MM)?;
        agreements.retain(|agreement| motion.residual(&agreement.pair) < TOLERANCE_MM);
        if !SCALES.contains(&scale) {
            return None;
        }
        let mut candidate = Candidate { motion, agreements, quality: 0.0 };
        let outstanding = self.matches.iter().filter(|found| found.stands_out && candidate.has(found, self.part));
        candidate.quality = outstanding.count() as f64 + candidate.places(self.part).sum::<f64>();
        Some(candidate)
    }

    /// The features of the part that find their like within a tolerance of where a pose puts them. Every feature of the
    /// box is that of one feature of the part, the most similar.
    fn agreements(&self, motion: &Rigid, tolerance_mm: f64) -> Vec<Agreement> {
        let features = &self.crop.found.features;
        let most = UNLIKE * UNLIKE;
        let mut nearest: Vec<Option<(i32, usize)>> = vec![None; features.len()];
        for (i, of_part) in self.part.features.iter().enumerate() {
            let [x, y] = motion.apply(of_part.at);
            let Ok(pixel) = self.rays.camera.image_from_world([x, y, of_part.height_mm]) else { continue };
            let [u, v] = [0, 1].map(|axis| pixel[axis] - self.crop.origin_px[axis]);
            let reach_px = MAX_PX_PER_MM * tolerance_mm;
            let first = features.partition_point(|feature| f64::from(feature.at[1]) < v - reach_px);
            let rows = features.iter().enumerate().skip(first);
            let rows = rows.take_while(|(_, feature)| f64::from(feature.at[1]) <= v + reach_px);
            let mut most_similar: Option<(i32, usize)> = None;
            for (j, feature) in rows.filter(|(_, feature)| (f64::from(feature.at[0]) - u).abs() <= reach_px) {
                let on_plane = self.rays.on_plane(j, feature, of_part.height_mm);
                let turn = on_plane.angle_rad - of_part.angle_rad - motion.angle_rad;
                let is_near = (on_plane.at[0] - x).hypot(on_plane.at[1] - y) < tolerance_mm;
                let is_alike = turn.sin().atan2(turn.cos()).abs() < MAX_TURN_RAD
                    && (on_plane.size_mm / of_part.size_mm).ln().abs() < MAX_LN_SIZE;
                if !(is_near && is_alike && self.is_free[j]) {
                    continue;
                }
                let distance = self.part.distance(i, &self.crop.found.descriptors[j], self.crop.norms[j]);
                if f64::from(distance) < most && most_similar.is_none_or(|(least, _)| distance < least) {
                    most_similar = Some((distance, j));
                }
            }
            if let Some((distance, j)) = most_similar
                && nearest[j].is_none_or(|(least, _)| distance < least)
            {
                nearest[j] = Some((distance, i));
            }
        }
        let found = nearest.iter().enumerate().filter_map(|(j, nearest)| nearest.map(|nearest| (j, nearest)));
        let agreement = |(of_crop, (distance, of_part)): (usize, (i32, usize))| {
            let quality = (1.0 - f64::from(distance) / most) * self.part.features[of_part].distinctness;
            let pair = self.pair(&Match { of_part, of_crop, stands_out: false });
            Agreement { of_part, of_crop, quality, pair }
        };
        found.map(agreement).collect()
    }

    /// Leaves out what a RANSAC homography leaves out; `None` when no camera could see the part by that homography.
    fn confirm(&self, mut candidate: Candidate) -> Result<Option<Candidate>, RecognizeError> {
        let pairs = || candidate.agreements.iter().map(|agreement| agreement.pair);
        let (from, to): (Vec<[f64; 2]>, Vec<[f64; 2]>) = pairs().map(|pair| (pair.from, pair.to)).unzip();
        let agree = match homography::ransac(&from, &to, TOLERANCE_MM)? {
            Found::View { agree, .. } => agree,
            // A line of lettering has no homography, but a pose.
            Found::Degenerate => return Ok(Some(candidate)),
            Found::NoView => return Ok(None),
        };
        let mut bits = agree.into_iter();
        candidate.agreements.retain(|_| bits.next().unwrap_or(false));
        let pairs: Vec<Pair> = candidate.agreements.iter().map(|agreement| agreement.pair).collect();
        let Some((motion, _)) = Rigid::robust(&pairs, candidate.motion, TOLERANCE_MM, TOLERANCE_MM) else {
            return Ok(None);
        };
        Ok(Some(Candidate { motion, ..candidate }))
    }
}

fn better(best: Option<Candidate>, other: Option<Candidate>) -> Option<Candidate> {
    match (best, other) {
        (Some(best), Some(other)) => Some(if other.quality > best.quality { other } else { best }),
        (best, other) => best.or(other),
    }
}

impl Candidate {
    /// The quality of every place of the part that agrees: that of the best of its features.
    fn places(&self, part: &SiftPart) -> impl Iterator<Item = f64> {
        let place = |agreement: &Agreement| part.features[agreement.of_part].place;
        let mut places: Vec<(usize, f64)> = self.agreements.iter().map(|a| (place(a), a.quality)).collect();
        places.sort_by(|a, b| a.0.cmp(&b.0).then(b.1.total_cmp(&a.1)));
        places.dedup_by_key(|(place, _)| *place);
        places.into_iter().map(|(_, quality)| quality)
    }

    /// Whether a match is among what agrees.
    fn has(&self, found: &Match, part: &SiftPart) -> bool {
        let place = part.features[found.of_part].place;
        let mut of_feature = self.agreements.iter().filter(|agreement| agreement.of_crop == found.of_crop);
        of_feature.any(|agreement| part.features[agreement.of_part].place == place)
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;
    use std::path::{Path, PathBuf};

    use image::{GrayImage, Luma, Rgb, RgbImage};
    use proptest::prelude::*;
    use samsod_camera::{Intrinsics, pose_from_rows};

    use super::*;
    use crate::{Grasp, Symmetry, Template};

    const WHOLE: BoundingBox = BoundingBox { x: 0, y: 0, width: 1078, height: 958 };
    /// Where the housing block of the frame lies: left, top, width and height, px.
    const HOUSING: [u32; 4] = [245, 116, 145, 199];
    const HEIGHT_MM: f64 = 32.0;

    fn frame() -> RgbImage {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/cell/0008.jpg");
        image::open(path).unwrap().into_rgb8()
    }

    /// The camera of that frame: 900 mm over the table.
    fn camera() -> Camera {
        let text = "width_px = 1078\nheight_px = 958\nfx_px = 1600.0\nfy_px = 1600.0\ncx_px = 541.2\n\
                    cy_px = 476.6\nk1 = 0.0\nk2 = 0.0\np1 = 0.0\np2 = 0.0\nk3 = 0.0";
        let intrinsics = Intrinsics::new(toml::from_str(text).unwrap()).unwrap();
        let rows = [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 900.0], [0.0, 0.0, 0.0, 1.0]];
        Camera::new(intrinsics, pose_from_rows(&rows).unwrap(), None).unwrap()
    }

    /// What is seen in a rectangle as a part that lies there at yaw 0.
    fn part(name: &str, image: &RgbImage, [x, y, width, height]: [u32; 4]) -> Part {
        let image = image::imageops::crop_imm(image, x, y, width, height).to_image();
        let mut mask = GrayImage::new(width, height);
        let inner = 8..width.max(16) - 8;
        inner.for_each(|x| (8..height - 8).for_each(|y| mask.put_pixel(x, y, Luma([255]))));
        let center = [f64::from(x + width / 2), f64::from(y + height / 2)];
        let [x_mm, y_mm, _] = camera().world_from_image(center, HEIGHT_MM).unwrap();
        Part {
            name: name.to_owned(),
            folder: PathBuf::new(),
            height_mm: HEIGHT_MM,
            grasp: Grasp { width_mm: 10.0, offset_mm: [0.0; 2], angle_rad: 0.0 },
            symmetry: Symmetry { shape_order: 1, appearance_order: 1 },
            template: Template {
                image,
                mask,
                camera: camera(),
                crop_px: [x, y],
                origin_mm: [x_mm, y_mm],
                yaw_rad: 0.0,
            },
            mesh: None,
        }
    }

    fn matcher(parts: &[Part]) -> SiftMatcher {
        let params = SiftParams::default();
        let models: Vec<SiftModel> = parts.iter().map(|p| SiftModel::compute(&p.template, &params).unwrap()).collect();
        SiftMatcher::new(&models, parts, &params).unwrap()
    }

    fn view(image: &RgbImage) -> RgbView<'_> {
        RgbView::from_raw(image.width(), image.height(), image.as_raw().as_slice()).unwrap()
    }

    /// The housing block of the frame, and the pixel at which its origin is seen.
    fn housing(frame: &RgbImage) -> (Part, [f64; 2]) {
        let housing = part("housing", frame, HOUSING);
        let [x, y] = housing.template.origin_mm;
        let about = camera().image_from_world([x, y, HEIGHT_MM]).unwrap();
        (housing, about)
    }

    /// The image turned counter-clockwise on the screen about a pixel, which comes to lie at another.
    fn turned(image: &RgbImage, about: [f64; 2], angle_rad: f64, to: [f64; 2]) -> RgbImage {
        let (sin, cos) = angle_rad.sin_cos();
        RgbImage::from_fn(image.width(), image.height(), |u, v| {
            let [x, y] = [f64::from(u) - to[0], f64::from(v) - to[1]];
            let at = [about[0] + cos * x - sin * y, about[1] + sin * x + cos * y].map(|c| c as f32);
            image::imageops::interpolate_bilinear(image, at[0], at[1]).unwrap_or(Rgb([40, 60, 120]))
        })
    }

    #[test]
    fn features_that_name_nothing_still_propose_the_pose_and_tell_its_turn() {
        let frame = frame();
        let (housing, about) = housing(&frame);
        let (angle_rad, to) = (f64::to_radians(37.0), [600.0, 500.0]);
        let moved = turned(&frame, about, angle_rad, to);
        let [x, y, _] = camera().world_from_image(to, HEIGHT_MM).unwrap();
        // More than there are must agree, so that nothing is named.
        let params = SiftParams { min_inliers: 1000, ..SiftParams::default() };
        let models = [SiftModel::compute(&housing.template, &params).unwrap()];
        let matcher = SiftMatcher::new(&models, &[housing], &params).unwrap();
        let bbox = BoundingBox { x: 480, y: 380, width: 240, height: 240 };
        let crop = matcher.crop(&view(&moved), &bbox, None).unwrap();
        let (found, proposals) = matcher.match_and_propose(&crop, &camera()).unwrap();
        assert_eq!(found, []);
        assert!((1..=PROPOSALS).contains(&proposals.len()), "{} proposals", proposals.len());
        let Proposal { part, motion } = proposals[0];
        let turn = (motion.angle_rad - angle_rad).sin().atan2((motion.angle_rad - angle_rad).cos());
        assert!(part == 0 && turn.abs() < 0.1, "{motion:?}");
        assert!((motion.at[0] - x).hypot(motion.at[1] - y) < 3.0, "{motion:?} for {x} {y}");
        // Turned the wrong way round, features say which of two turns it is.
        let wrong = Rigid { angle_rad: angle_rad + PI, at: [x, y] };
        let right = matcher.turned(&crop, &camera(), 0, 2, wrong).unwrap();
        assert!(
            (right.angle_rad - angle_rad).rem_euclid(TAU) < 1e-9
                || (right.angle_rad - angle_rad).rem_euclid(TAU) > TAU - 1e-9
        );
        // Of a place with nothing on it they say nothing.
        let elsewhere = Rigid { at: [x + 40.0, y + 40.0], ..wrong };
        assert_eq!(matcher.turned(&crop, &camera(), 0, 2, elsewhere), None);
    }

    #[test]
    fn a_part_that_was_turned_and_moved_is_found_there() {
        let frame = frame();
        let (housing, about) = housing(&frame);
        let matcher = matcher(&[part("table", &frame, [500, 80, 150, 150]), housing]);
        for (degrees, to) in [(0.0, about), (37.0, [600.0, 500.0]), (-120.0, [200.0, 600.5]), (179.0, [800.0, 300.0])] {
            let angle_rad = f64::to_radians(degrees);
            let moved = turned(&frame, about, angle_rad, to);
            let bbox = BoundingBox { x: to[0] as u32 - 120, y: to[1] as u32 - 120, width: 240, height: 240 };
            let bbox = if to[1] < 240.0 { BoundingBox { y: 60, ..bbox } } else { bbox };
            let camera = camera();
            let found = matcher.match_region(&view(&moved), &bbox, None, Some(&camera)).unwrap();
            assert_eq!(found.iter().map(|m| m.part).collect::<Vec<_>>(), [1], "at {degrees} degrees");
            let (image, world) = (&found[0].image, found[0].world.unwrap());
            let apart = (image.origin_px[0] - to[0]).hypot(image.origin_px[1] - to[1]);
            assert!(apart < 0.2, "{apart} px at {degrees} degrees");
            let wrong = |angle: f64| (angle - angle_rad).sin().atan2((angle - angle_rad).cos()).abs().to_degrees();
            assert!(wrong(image.angle_rad) < 0.2 && wrong(world.yaw_rad) < 0.2, "{degrees}: {found:?}");
            let [x, y, _] = camera.world_from_image(to, HEIGHT_MM).unwrap();
            assert!((world.x_mm - x).hypot(world.y_mm - y) < 0.12 && world.height_mm == HEIGHT_MM);
            assert!(found[0].inliers >= 20 && found[0].score > 0.75, "{found:?}");
            // The template's middle is the origin.
            let h = &found[0].homography;
            let [u, v, w] = [0, 1, 2].map(|i| h[i][0] * 72.0 + h[i][1] * 99.0 + h[i][2]);
            assert!((u / w - image.origin_px[0]).hypot(v / w - image.origin_px[1]) < 0.01);
            // Without a camera, that of the template sees the same.
            let same = matcher.match_region(&view(&moved), &bbox, None, None).unwrap();
            assert_eq!((same[0].image, same[0].world), (found[0].image, None));
        }
    }

    #[test]
    fn the_whole_frame_has_every_instance() {
        let frame = frame();
        let (housing, about) = housing(&frame);
        let mut twice = frame.clone();
        let moved = turned(&frame, about, 0.8, [700.0, 300.0]);
        image::imageops::replace(
            &mut twice,
            &image::imageops::crop_imm(&moved, 580, 180, 240, 240).to_image(),
            580,
            180,
        );
        let mut found = matcher(&[housing]).conventional(&view(&twice), Some(&camera())).unwrap();
        found.sort_by(|a, b| a.image.origin_px[0].total_cmp(&b.image.origin_px[0]));
        assert_eq!(found.len(), 2, "{found:?}");
        for (found, (to, angle)) in found.iter().zip([(about, 0.0), ([700.0, 300.0], 0.8)]) {
            assert!((found.image.origin_px[0] - to[0]).hypot(found.image.origin_px[1] - to[1]) < 0.2, "{found:?}");
            assert!((found.image.angle_rad - angle).abs() < 0.004, "{found:?}");
        }
    }

    #[test]
    fn pixels_that_are_not_wanted_have_no_say() {
        let frame = frame();
        let matcher = matcher(&[part("housing", &frame, HOUSING)]);
        let [x, y, width, height] = HOUSING;
        let bbox = BoundingBox { x, y, width, height };
        let among = |is_wanted: &dyn Fn(u32, u32) -> bool| {
            matcher.match_region(&view(&frame), &bbox, Some(is_wanted), None).unwrap().first().map_or(0, |m| m.inliers)
        };
        let (all, half) = (among(&|_, _| true), among(&|_, row| row < y + height / 2));
        assert!(half > 5 && half < all, "{half} of {all}");
        assert_eq!(among(&|_, _| false), 0);
    }

    #[test]
    fn a_mirrored_part_is_hardly_the_same() {
        let frame = frame();
        let matcher = matcher(&[part("housing", &frame, HOUSING)]);
        let inliers = |image: &RgbImage| {
            matcher.conventional(&view(image), None).unwrap().iter().map(|found| found.inliers).max().unwrap_or(0)
        };
        let (same, mirrored) = (inliers(&frame), inliers(&image::imageops::flip_horizontal(&frame)));
        // Screw holes are their own mirror images.
        assert!(mirrored * 4 < same, "{mirrored} of {same}");
    }

    #[test]
    fn a_part_without_features_is_never_found() {
        let frame = frame();
        let grey = RgbImage::from_pixel(1078, 958, Rgb([120, 120, 120]));
        let plain = part("plain", &grey, HOUSING);
        assert_eq!(SiftModel::compute(&plain.template, &SiftParams::default()).unwrap().features(), 0);
        let matcher = matcher(&[plain]);
        assert_eq!(matcher.conventional(&view(&frame), Some(&camera())).unwrap(), []);
        assert_eq!(matcher.match_region(&view(&grey), &WHOLE, None, None).unwrap(), []);
    }

    #[test]
    fn the_smallest_boxes_are_no_error() {
        let frame = frame();
        let matcher = matcher(&[part("housing", &frame, HOUSING)]);
        for (x, y, width, height) in [(0, 0, 0, 0), (5, 5, 1, 1), (1077, 957, 1, 1), (300, 200, 3, 40), (0, 0, 1078, 1)]
        {
            let bbox = BoundingBox { x, y, width, height };
            assert_eq!(matcher.match_region(&view(&frame), &bbox, None, Some(&camera())).unwrap(), []);
        }
    }

    #[test]
    fn thousands_of_features_are_bounded() {
        let mut state = 7u64;
        let mut noise = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 56) as u8
        };
        let noisy = RgbImage::from_fn(1078, 958, |_, _| Rgb([noise(); 3]));
        let params = SiftParams { max_features: 300, ..SiftParams::default() };
        let found = Features::find(&view(&noisy), &WHOLE, &params, None).unwrap();
        assert_eq!((found.features.len(), found.descriptors.len()), (300, 300));
        let template = part("noise", &noisy, [100, 100, 400, 400]).template;
        assert!(SiftModel::compute(&template, &params).unwrap().features() <= 300);
    }

    #[test]
    fn what_is_kept_comes_back() {
        let template = part("housing", &frame(), HOUSING).template;
        let model = SiftModel::compute(&template, &SiftParams::default()).unwrap();
        assert!(model.features() > 50);
        let bytes = postcard::to_stdvec(&model).unwrap();
        assert_eq!(postcard::from_bytes::<SiftModel>(&bytes).unwrap(), model);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(8))]
        #[test]
        fn every_angle_is_told(degrees in -180.0f64..180.0) {
            let frame = frame();
            let housing = part("housing", &frame, HOUSING);
            let [x, y] = housing.template.origin_mm;
            let about = camera().image_from_world([x, y, HEIGHT_MM]).unwrap();
            let to = [541.0, 477.0];
            let moved = turned(&frame, about, degrees.to_radians(), to);
            let bbox = BoundingBox { x: 421, y: 357, width: 240, height: 240 };
            let found = matcher(&[housing]).match_region(&view(&moved), &bbox, None, Some(&camera())).unwrap();
            prop_assert_eq!(found.len(), 1);
            let turn = (found[0].image.angle_rad - degrees.to_radians() + PI).rem_euclid(2.0 * PI) - PI;
            prop_assert!(turn.to_degrees().abs() < 0.2, "{} for {degrees}", found[0].image.angle_rad.to_degrees());
            prop_assert!((found[0].image.origin_px[0] - to[0]).hypot(found[0].image.origin_px[1] - to[1]) < 0.2);
        }
    }
}
