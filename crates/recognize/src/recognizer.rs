//! The stage: models of the parts, and who decides.

use rayon::prelude::*;
use samsod_camera::Camera;
use samsod_segment::{BoundingBox, RgbView};
use samsod_shadow::{BareRegion, Mask, ObjectRegion};
use serde::{Deserialize, Serialize};

use crate::cache;
use crate::candidate::{Candidate, choose};
use crate::edge_model::EdgeModel;
use crate::pose_fit::Pose;
use crate::region_pixels::{OBJECT, RegionPixels, box_round};
use crate::rigid_fit::Rigid;
use crate::shape::RegionSearch;
use crate::sift::{Crop, Proposal, SiftMatch, SiftMatcher};
use crate::sift_features::SiftModel;
use crate::silhouette::Silhouette;
use crate::tint::Tint;
use crate::{Catalogue, Detection, ImagePose, Method, Part, RecognizeParamError, RecognizeParams, WorldPose};

/// Name of the file beside a template that keeps what was computed from it.
const DESCRIPTORS_FILE: &str = "descriptors";
/// Pixels around a region that are looked at with it.
const MARGIN_PX: u32 = 16;
/// A part of which this share lies on another that was found before is not told apart from it.
const MOST_SHARED: f32 = 0.3;
/// An object is explained by parts that have this share of it.
const EXPLAINED: f32 = 0.5;
/// Features say the angle of a part that lies no farther from where its outline says it is, mm.
const SAME_PLACE_MM: f64 = 4.0;

/// Why objects could not be recognised.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RecognizeError {
    /// A parameter is out of range.
    #[error(transparent)]
    Params(#[from] RecognizeParamError),
    /// The catalogue has no part.
    #[error("the catalogue has no part; recognition needs at least one")]
    Empty,
    /// The camera is not that of the frame.
    #[error("frame of {frame:?} px for a camera of {camera:?} px")]
    CameraSize {
        /// Width and height of the frame, px.
        frame: [u32; 2],
        /// Those of the camera's image.
        camera: [u32; 2],
    },
    /// The camera is not given, and the parts were taught with another one.
    #[error(
        "frame of {frame:?} px without a camera, and the parts were taught with one of {taught:?} px: give the camera"
    )]
    CameraUnknown {
        /// Width and height of the frame, px.
        frame: [u32; 2],
        /// Those of the camera of the first part's template.
        taught: [u32; 2],
    },
    /// An object lies outside of the frame.
    #[error("object {object} reaches to pixel {corner:?} of a frame of {frame:?} px: it belongs to another frame")]
    ObjectOutside {
        /// Index of the object.
        object: usize,
        /// Right and bottom end of its mask, px.
        corner: [u32; 2],
        /// Width and height of the frame, px.
        frame: [u32; 2],
    },
    /// A region without objects lies outside of the frame.
    #[error("region {region} reaches to pixel {corner:?} of a frame of {frame:?} px: it belongs to another frame")]
    RegionOutside {
        /// Index of the region.
        region: usize,
        /// Right and bottom end of its mask, px.
        corner: [u32; 2],
        /// Width and height of the frame, px.
        frame: [u32; 2],
    },
    /// OpenCV failed, which no image should bring about.
    #[error("OpenCV: {0}")]
    OpenCv(String),
}

/// Recognises the parts of a catalogue.
#[derive(Debug)]
pub struct Recognizer {
    params: RecognizeParams,
    catalogue: Catalogue,
    edges: Vec<EdgeModel>,
    features: Vec<usize>,
    tints: Vec<Tint>,
    sift: SiftMatcher,
}

/// What is computed of a part once.
#[derive(Debug, Serialize, Deserialize)]
struct Descriptors {
    edges: EdgeModel,
    sift: SiftModel,
}

impl Descriptors {
    /// Those that are kept beside the part, or new ones, which are then kept.
    fn of(part: &Part, params: &RecognizeParams) -> Result<Self, RecognizeError> {
        let key = cache::key_of(part, &format!("{:?}", params.sift));
        let path = part.folder.join(DESCRIPTORS_FILE);
        if let Some(kept) = cache::read(&path, &key) {
            return Ok(kept);
        }
        let sift = SiftModel::compute(&part.template, &params.sift)?;
        let descriptors = Self { edges: EdgeModel::of(part), sift };
        cache::write(&path, &key, &descriptors);
        Ok(descriptors)
    }
}

/// A part in a region.
#[derive(Debug)]
struct Found {
    part: usize,
    pose: Pose,
    method: Method,
    score: f32,
    margin: f32,
    silhouette: Silhouette,
    /// Indices of the objects that it has half of.
    objects: Vec<usize>,
}

impl Recognizer {
    /// Computes what is matched against, or reads it from the folders of the parts where it was kept.
    ///
    /// # Errors
    /// A parameter that is out of range; a catalogue without parts.
    pub fn new(catalogue: Catalogue, params: RecognizeParams) -> Result<Self, RecognizeError> {
        params.check()?;
        if catalogue.parts().is_empty() {
            return Err(RecognizeError::Empty);
        }
        let descriptors: Result<Vec<Descriptors>, RecognizeError> =
            catalogue.parts().par_iter().map(|part| Descriptors::of(part, &params)).collect();
        let (edges, models): (Vec<EdgeModel>, Vec<SiftModel>) =
            descriptors?.into_iter().map(|d| (d.edges, d.sift)).unzip();
        let features = models.iter().map(SiftModel::features).collect();
        let sift = SiftMatcher::new(&models, catalogue.parts(), &params.sift)?;
        let tints = catalogue.parts().iter().map(|part| Tint::of_template(&part.template)).collect();
        Ok(Self { params, catalogue, edges, features, tints, sift })
    }

    /// The parameters in force.
    pub fn params(&self) -> &RecognizeParams {
        &self.params
    }

    /// The parts that are looked for.
    pub fn catalogue(&self) -> &Catalogue {
        &self.catalogue
    }

    /// Number of local features of every part's template, in the order of the catalogue.
    pub fn features(&self) -> &[usize] {
        &self.features
    }

    /// Says of every object which part it is, at which pose; one detection a part, or unknown object. By region, in the
    /// order of their first objects; named ones first, in an order of their own, then the unknown.
    ///
    /// # Arguments
    /// * `frame` - the frame that the objects were found in
    /// * `objects` - its objects
    /// * `camera` - that of the frame, with its pose; without it the frame is taken for one of the camera that the first
    ///   part was taught with, and detections have no place in the world
    ///
    /// # Errors
    /// [`RecognizeError`]: sizes that do not fit.
    pub fn recognize(
        &self,
        frame: &RgbView<'_>,
        objects: &[ObjectRegion],
        camera: Option<&Camera>,
    ) -> Result<Vec<Detection>, RecognizeError> {
        self.recognize_all(frame, objects, &[], camera)
    }

    /// [`Self::recognize`], which also searches regions that have no object, as parts may be taken for shadow as a whole.
    /// What is found there comes last, and has no objects.
    ///
    /// # Arguments
    /// * `bare` - regions without an object, of [`bare_regions`](samsod_shadow::bare_regions)
    /// * the others - as those of [`Self::recognize`]
    ///
    /// # Errors
    /// As [`Self::recognize`].
    pub fn recognize_all(
        &self,
        frame: &RgbView<'_>,
        objects: &[ObjectRegion],
        bare: &[BareRegion],
        camera: Option<&Camera>,
    ) -> Result<Vec<Detection>, RecognizeError> {
        let size: [u32; 2] = frame.dimensions().into();
        let view = self.camera_for(size, camera)?;
        let outside = |mask: &Mask| {
            let corner = [mask.bbox().right(), mask.bbox().bottom()];
            (corner[0] >= size[0] || corner[1] >= size[1]).then_some(corner)
        };
        for (index, object) in objects.iter().enumerate() {
            if let Some(corner) = std::iter::once(&object.mask).chain(&object.shadow).find_map(outside) {
                return Err(RecognizeError::ObjectOutside { object: index, corner, frame: size });
            }
        }
        for BareRegion { region, mask } in bare {
            if let Some(corner) = outside(mask) {
                return Err(RecognizeError::RegionOutside { region: *region, corner, frame: size });
            }
        }
        let mut regions = RegionPixels::of(objects, MARGIN_PX, size);
        if self.params.method != Method::Sift {
            regions.extend(bare.iter().map(|bare| RegionPixels::of_bare(bare, MARGIN_PX, size)));
        }
        let of_region = |region: &RegionPixels| self.in_region(frame, objects, view, camera.is_some(), region);
        let found: Result<Vec<Vec<Detection>>, RecognizeError> = regions.par_iter().map(of_region).collect();
        Ok(found?.into_iter().flatten().collect())
    }

    /// The conventional method that the paper compares with: features of the whole frame against every template.
    ///
    /// # Errors
    /// As [`Self::recognize`].
    pub fn conventional_sift(
        &self,
        frame: &RgbView<'_>,
        camera: Option<&Camera>,
    ) -> Result<Vec<Detection>, RecognizeError> {
        let view = self.camera_for(frame.dimensions().into(), camera)?;
        let matches = self.sift.conventional(frame, Some(view))?;
        let found = self.of_matches(&matches, view, None);
        Ok(found.into_iter().filter_map(|found| self.detection(found, 0, view, camera.is_some())).collect())
    }

    /// The conventional method that the paper compares with: edges of the whole frame against every template.
    ///
    /// # Errors
    /// As [`Self::recognize`].
    pub fn conventional_shape(
        &self,
        frame: &RgbView<'_>,
        camera: Option<&Camera>,
    ) -> Result<Vec<Detection>, RecognizeError> {
        let size = frame.dimensions().into();
        let view = self.camera_for(size, camera)?;
        let region = RegionPixels::of_frame(size);
        let mut search = RegionSearch::new(self.catalogue.parts(), &self.edges, view, frame, &region, &self.tints);
        search.by_search_of_frame();
        let found = self.of_candidates(&search.candidates, view, &region);
        let named = found.into_iter().filter(|found| self.is_named(found));
        Ok(named.filter_map(|found| self.detection(found, 0, view, camera.is_some())).collect())
    }

    /// The camera of a frame, or that of the templates.
    fn camera_for<'a>(&'a self, frame: [u32; 2], camera: Option<&'a Camera>) -> Result<&'a Camera, RecognizeError> {
        if let Some(camera) = camera {
            let size = camera.intrinsics().size_px();
            return if size == frame { Ok(camera) } else { Err(RecognizeError::CameraSize { frame, camera: size }) };
        }
        let taught = self.catalogue.parts().first().ok_or(RecognizeError::Empty)?;
        let size = taught.template.camera.intrinsics().size_px();
        if size != frame {
            return Err(RecognizeError::CameraUnknown { frame, taught: size });
        }
        Ok(&taught.template.camera)
    }

    fn in_region(
        &self,
        frame: &RgbView<'_>,
        objects: &[ObjectRegion],
        view: &Camera,
        in_world: bool,
        region: &RegionPixels,
    ) -> Result<Vec<Detection>, RecognizeError> {
        let found = match self.params.method {
            Method::Sift => {
                let crop = self.sift.crop(frame, &region.crop, None)?;
                let (matches, proposals) = self.sift.match_and_propose(&crop, view)?;
                let mut found = self.of_matches(&matches, view, Some(region));
                found.extend(self.confirmed(frame, objects, view, region, (&crop, &proposals), &found));
                self.turn_by_lettering(frame, view, region, &mut found);
                found
            }
            Method::Shape | Method::Best => self.by_shape(frame, objects, view, region)?,
        };
        let (named, doubtful): (Vec<Found>, Vec<Found>) = found.into_iter().partition(|found| self.is_named(found));
        let mut detections: Vec<Detection> = Vec::new();
        let mut explained = vec![0u32; region.objects.len()];
        for found in named {
            count_in_objects(&found.silhouette, region, &mut explained);
            detections.extend(self.detection(found, region.region, view, in_world));
        }
        for (&index, count) in region.objects.iter().zip(explained) {
            let object = &objects[index];
            if count as f32 >= EXPLAINED * object.area as f32 {
                continue;
            }
            // What came closest, of what has a piece of it.
            let near = doubtful.iter().filter(|found| found.objects.contains(&index));
            let best = near.max_by(|a, b| a.score.total_cmp(&b.score));
            let (score, margin, method) = best.map_or((0.0, 0.0, Method::Shape), |b| (b.score, b.margin, b.method));
            detections.push(Detection::unknown(object, index, score, margin, method));
        }
        Ok(detections)
    }

    fn is_named(&self, found: &Found) -> bool {
        found.score >= self.params.min_score && found.margin >= self.params.min_margin
    }

    /// What features say of boxes of a frame.
    fn matches(
        &self,
        frame: &RgbView<'_>,
        view: &Camera,
        boxes: &[BoundingBox],
    ) -> Result<Vec<SiftMatch>, RecognizeError> {
        let of_box = |bbox: &BoundingBox| self.sift.match_region(frame, bbox, None, Some(view));
        let found: Result<Vec<Vec<SiftMatch>>, RecognizeError> = boxes.par_iter().map(of_box).collect();
        Ok(found?.concat())
    }

    fn by_shape(
        &self,
        frame: &RgbView<'_>,
        objects: &[ObjectRegion],
        view: &Camera,
        region: &RegionPixels,
    ) -> Result<Vec<Found>, RecognizeError> {
        let parts = self.catalogue.parts();
        let mut search = RegionSearch::new(parts, &self.edges, view, frame, region, &self.tints);
        search.by_contours(objects);
        if region.objects.is_empty() {
            search.by_search();
            search.restart();
        }
        // What features say, and where they were asked.
        let mut matches: Vec<SiftMatch> = Vec::new();
        let mut asked: Vec<BoundingBox> = Vec::new();
        if !search.is_convincing() {
            search.by_search();
            search.by_search_of_rest();
            search.restart();
            search.settle();
            if self.params.method == Method::Best && !search.is_convincing() {
                // Features cost by the pixel: not where a part is beyond doubt.
                let doubtful = search.doubtful().into_iter().map(|bbox| within(&bbox, MARGIN_PX, &region.crop));
                asked = apart(doubtful.collect());
                matches = self.matches(frame, view, &asked)?;
                for each in &matches {
                    if let Some(pose) = pose_of(each) {
                        search.add(each.part, pose, each.score);
                    }
                }
            }
        }
        search.settle();
        search.by_search_of_left();
        let mut found = self.of_candidates(&search.candidates, view, region);
        if self.params.method == Method::Best {
            // Lettering tells turns apart that the outline cannot.
            let says_more = |part: usize| parts[part].symmetry.appearance_order != parts[part].symmetry.shape_order;
            let unasked = found.iter().filter(|f| self.is_named(f) && says_more(f.part));
            let unasked = unasked.map(|f| f.silhouette.bbox).filter(|bbox| !asked.iter().any(|asked| has(asked, bbox)));
            let unasked = unasked.map(|bbox| within(&bbox, MARGIN_PX, &region.crop)).collect();
            matches.extend(self.matches(frame, view, &apart(unasked))?);
            for found in found.iter_mut().filter(|found| says_more(found.part)) {
                let near = |m: &&SiftMatch| {
                    m.part == found.part
                        && pose_of(m).is_some_and(|pose| {
                            (pose.x_mm - found.pose.x_mm).hypot(pose.y_mm - found.pose.y_mm) <= SAME_PLACE_MM
                        })
                };
                if let Some(pose) = matches.iter().find(near).and_then(pose_of) {
                    found.pose.yaw_rad =
                        turned_to(found.pose.yaw_rad, pose.yaw_rad, parts[found.part].symmetry.shape_order);
                    found.method = Method::Sift;
                }
                if let Some(pose) = search.turned_by_lettering(found.part, found.pose) {
                    found.pose = pose;
                    found.method = Method::Sift;
                }
            }
        }
        Ok(found)
    }

    /// What is chosen of some candidates.
    fn of_candidates(&self, candidates: &[Candidate], view: &Camera, region: &RegionPixels) -> Vec<Found> {
        let of = |candidate: &Candidate, rival: Option<&Candidate>| {
            let part = &self.catalogue.parts()[candidate.part];
            let score = candidate.score();
            let margin = (score - rival.map_or(0.0, Candidate::score)).max(0.0);
            // Nobody asks for the pixels of what gets no name.
            let is_named = score >= self.params.min_score && margin >= self.params.min_margin;
            let silhouette =
                if is_named { Silhouette::of(part, view, &candidate.fit.pose, 1)? } else { Silhouette::default() };
            let objects = candidate.of_objects.iter().filter(|(_, count)| 2 * **count >= candidate.pixels[1].min(2));
            let index_of = |code: &u8| region.objects.get(usize::from(code - OBJECT)).copied();
            Some(Found {
                part: candidate.part,
                pose: candidate.fit.pose,
                method: Method::Shape,
                score,
                margin,
                silhouette,
                objects: objects.filter_map(|(code, _)| index_of(code)).collect(),
            })
        };
        choose(candidates)
            .into_iter()
            .filter_map(|choice| of(&candidates[choice.index], choice.rival.map(|rival| &candidates[rival])))
            .collect()
    }

    /// Turns what features found and the outline allows to turn as its lettering says.
    fn turn_by_lettering(&self, frame: &RgbView<'_>, view: &Camera, region: &RegionPixels, found: &mut [Found]) {
        let parts = self.catalogue.parts();
        let turns = |part: usize| parts[part].symmetry.appearance_order != parts[part].symmetry.shape_order;
        if !found.iter().any(|found| turns(found.part)) {
            return;
        }
        let mut search = RegionSearch::new(parts, &self.edges, view, frame, region, &self.tints);
        for found in found.iter_mut().filter(|found| turns(found.part)) {
            if let Some(pose) = search.turned_by_lettering(found.part, found.pose) {
                found.pose = pose;
                found.method = Method::Sift;
            }
        }
    }

    /// The parts that features propose where those that they name explain no object, and that the edges of the frame confirm.
    fn confirmed(
        &self,
        frame: &RgbView<'_>,
        objects: &[ObjectRegion],
        view: &Camera,
        region: &RegionPixels,
        (crop, proposals): (&Crop, &[Proposal]),
        found: &[Found],
    ) -> Vec<Found> {
        let named: Vec<&Found> = found.iter().filter(|found| self.is_named(found)).collect();
        let mut explained = vec![0u32; region.objects.len()];
        named.iter().for_each(|found| count_in_objects(&found.silhouette, region, &mut explained));
        let is_left = |k: &usize| (explained[*k] as f32) < EXPLAINED * objects[region.objects[*k]].area as f32;
        let left: Vec<u8> = (0..region.objects.len()).filter(is_left).map(RegionPixels::code_of).collect();
        if left.is_empty() || proposals.is_empty() || !self.params.sift.confirm {
            return Vec::new();
        }
        let parts = self.catalogue.parts();
        let mut search = RegionSearch::new(parts, &self.edges, view, frame, region, &self.tints);
        let pose = |Rigid { angle_rad, at: [x_mm, y_mm] }| Pose { x_mm, y_mm, yaw_rad: angle_rad };
        let guesses: Vec<(usize, Pose)> = proposals.iter().map(|p| (p.part, pose(p.motion))).collect();
        search.by_proposals(&guesses, &left);
        search.by_quarter_turns();
        search.restart();
        search.settle();
        let mut confirmed = self.of_candidates(&search.candidates, view, region);
        confirmed.retain(|other| {
            let is_apart = |found: &&Found| share(&found.silhouette, &other.silhouette) <= MOST_SHARED;
            self.is_named(other) && named.iter().all(is_apart)
        });
        for found in &mut confirmed {
            let (symmetry, Pose { x_mm, y_mm, yaw_rad }) = (&parts[found.part].symmetry, found.pose);
            let motion = Rigid { angle_rad: yaw_rad, at: [x_mm, y_mm] };
            if symmetry.appearance_order != symmetry.shape_order
                && let Some(turned) = self.sift.turned(crop, view, found.part, symmetry.shape_order, motion)
            {
                found.pose = pose(turned);
                found.method = Method::Sift;
            }
        }
        confirmed
    }

    /// What features say, the surest first; of two in one place the surer.
    fn of_matches(&self, matches: &[SiftMatch], view: &Camera, region: Option<&RegionPixels>) -> Vec<Found> {
        let mut all: Vec<Found> = Vec::new();
        for each in matches {
            let Some(pose) = pose_of(each) else { continue };
            let Some(silhouette) = Silhouette::of(&self.catalogue.parts()[each.part], view, &pose, 1) else { continue };
            if let Some(other) = all.iter_mut().find(|other| share(&silhouette, &other.silhouette) > MOST_SHARED) {
                other.margin = other.margin.min(other.score - each.score);
                continue;
            }
            let mut objects = Vec::new();
            if let Some(region) = region {
                let mut counts = vec![0u32; region.objects.len()];
                count_in_objects(&silhouette, region, &mut counts);
                objects.extend(region.objects.iter().zip(counts).filter(|(_, count)| *count > 0).map(|(i, _)| *i));
            }
            let (score, part) = (each.score, each.part);
            all.push(Found { part, pose, method: Method::Sift, score, margin: score, silhouette, objects });
        }
        all
    }

    fn detection(&self, found: Found, region: usize, view: &Camera, in_world: bool) -> Option<Detection> {
        let part = &self.catalogue.parts()[found.part];
        let order = match found.method {
            Method::Sift => part.symmetry.appearance_order,
            _ => part.symmetry.shape_order,
        };
        let pose = Pose { yaw_rad: within_order(found.pose.yaw_rad, order), ..found.pose };
        let height_mm = part.height_mm as f32;
        let pixel = |x: f32| view.image_from_world(pose.world_from_part([x, 0.0, height_mm])).ok();
        let (origin_px, ahead) = (pixel(0.0)?, pixel(1.0)?);
        // Rows run downwards.
        let angle_rad = (origin_px[1] - ahead[1]).atan2(ahead[0] - origin_px[0]);
        let world = WorldPose { x_mm: pose.x_mm, y_mm: pose.y_mm, yaw_rad: pose.yaw_rad, height_mm: part.height_mm };
        Some(Detection {
            region,
            objects: found.objects,
            name: Some(part.name.clone()),
            method: found.method,
            score: found.score,
            margin: found.margin,
            image: ImagePose { origin_px, angle_rad },
            world: in_world.then_some(world),
            mask: found.silhouette.to_mask()?,
        })
    }
}

/// Adds to the numbers of pixels that a silhouette of all pixels has of every object of a region.
fn count_in_objects(silhouette: &Silhouette, region: &RegionPixels, counts: &mut [u32]) {
    for (y, row) in silhouette.rows() {
        for (x, _) in (silhouette.bbox.x..).zip(row).filter(|(_, bit)| **bit != 0) {
            let k = region.code(x, y).checked_sub(OBJECT).map(usize::from);
            if let Some(count) = k.and_then(|k| counts.get_mut(k)) {
                *count += 1;
            }
        }
    }
}

/// A box and so many pixels around it, as far as another reaches.
fn within(bbox: &BoundingBox, margin_px: u32, whole: &BoundingBox) -> BoundingBox {
    let (x, y) = (bbox.x.saturating_sub(margin_px).max(whole.x), bbox.y.saturating_sub(margin_px).max(whole.y));
    let right = bbox.right().saturating_add(margin_px).min(whole.right());
    let bottom = bbox.bottom().saturating_add(margin_px).min(whole.bottom());
    BoundingBox { x, y, width: (right + 1).saturating_sub(x), height: (bottom + 1).saturating_sub(y) }
}

/// Boxes of which those that overlap are one.
fn apart(mut boxes: Vec<BoundingBox>) -> Vec<BoundingBox> {
    let overlap = |a: &BoundingBox, b: &BoundingBox| {
        a.x <= b.right() && b.x <= a.right() && a.y <= b.bottom() && b.y <= a.bottom()
    };
    let mut i = 0;
    while i < boxes.len() {
        match (i + 1..boxes.len()).find(|&j| overlap(&boxes[i], &boxes[j])) {
            Some(j) => {
                let other = boxes.remove(j);
                boxes[i] = box_round(&boxes[i], &other);
                // A larger one may overlap one that the smaller did not.
                i = 0;
            }
            None => i += 1,
        }
    }
    boxes
}

/// Whether a box has all of another.
fn has(whole: &BoundingBox, other: &BoundingBox) -> bool {
    whole.x <= other.x && whole.y <= other.y && whole.right() >= other.right() && whole.bottom() >= other.bottom()
}

fn pose_of(found: &SiftMatch) -> Option<Pose> {
    found.world.map(|world| Pose { x_mm: world.x_mm, y_mm: world.y_mm, yaw_rad: world.yaw_rad })
}

/// Of the turns by which an outline of n-fold symmetry is the same, that of `yaw` that is nearest to another.
fn turned_to(yaw_rad: f64, other_rad: f64, order: u32) -> f64 {
    if order == 0 {
        return other_rad;
    }
    let step = std::f64::consts::TAU / f64::from(order);
    yaw_rad + step * ((other_rad - yaw_rad) / step).round()
}

/// An angle within (-pi / n, pi / n] of n-fold symmetry; 0 where any turn is the same.
fn within_order(yaw_rad: f64, order: u32) -> f64 {
    if order == 0 {
        return 0.0;
    }
    let step = std::f64::consts::TAU / f64::from(order);
    let turned = yaw_rad.rem_euclid(step);
    if turned > step / 2.0 { turned - step } else { turned }
}

/// Pixels that two silhouettes share, as a share of the smaller.
fn share(a: &Silhouette, b: &Silhouette) -> f32 {
    a.shared_pixels(b) as f32 / a.pixels().min(b.pixels()).max(1) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::{FRAC_PI_2, PI};

    #[test]
    fn angles_of_symmetric_parts_are_told_once() {
        assert!((within_order(PI, 1) - PI).abs() < 1e-12);
        assert!((within_order(-PI, 1) - PI).abs() < 1e-12);
        assert!((within_order(PI + 0.1, 2) - 0.1).abs() < 1e-12);
        assert!((within_order(-0.1, 4) + 0.1).abs() < 1e-12);
        assert_eq!(within_order(1.2, 0), 0.0);
    }

    #[test]
    fn features_choose_among_the_turns_of_an_outline() {
        assert!((turned_to(0.1, PI, 2) - (PI + 0.1)).abs() < 1e-12);
        assert!((turned_to(0.1, 0.3, 2) - 0.1).abs() < 1e-12);
        assert!((turned_to(0.1, -FRAC_PI_2, 4) - (0.1 - FRAC_PI_2)).abs() < 1e-12);
        assert_eq!(turned_to(0.1, 2.0, 0), 2.0);
    }
}
