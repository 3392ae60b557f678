//! From a scene to what the robot works with: parts and things in its way, in its base frame.
//!
//! Input: the detections and objects of a [`Scene`], the catalogue, where the camera and the robot stand. Output: the parts of a
//! [`Sight`](samsod_robot::Sight). A part has the outline of its model, or of its mask without one; what is not known has the
//! outline of its mask on the table, and the height that the configuration assumes.

use samsod::Scene;
use samsod::recognize::{Catalogue, Detection, Part};
use samsod::shadow::Mask;
use samsod_camera::Camera;
use samsod_camera::nalgebra::{Isometry3, Point3};
use samsod_robot::{Convex, Grasp, SeenPart};

use crate::place::PlanePose;

/// A part of the catalogue as the robot sees it.
#[derive(Debug, Clone)]
struct KnownPart {
    name: String,
    height_mm: f64,
    /// Without a model it follows from each mask.
    outline: Option<Convex>,
    grasps: Vec<Grasp>,
    symmetry_order: u32,
}

/// What it takes to make sights of scenes.
#[derive(Debug, Clone)]
pub(crate) struct Sighter {
    parts: Vec<KnownPart>,
    base_from_world: Isometry3<f64>,
    unknown_height_mm: f64,
}

impl Sighter {
    pub(crate) fn new(catalogue: &Catalogue, base_from_world: Isometry3<f64>, unknown_height_mm: f64) -> Self {
        Self { parts: catalogue.parts().iter().map(known).collect(), base_from_world, unknown_height_mm }
    }

    /// Everything in a scene that has a place. Detections that are not inside, by their index, stay in the way of the gripper
    /// and cannot be gripped themselves.
    pub(crate) fn parts(&self, scene: &Scene, camera: &Camera, is_inside: impl Fn(usize) -> bool) -> Vec<SeenPart> {
        let detections = scene.detections.iter().enumerate().filter_map(|(i, detection)| {
            let mut part = self.detection(detection, camera)?;
            if !is_inside(i) {
                part.grasps.clear();
            }
            Some(part)
        });
        // What recognition has not been asked about is in the way all the same.
        let asked: Vec<usize> = scene.detections.iter().flat_map(|d| d.objects.iter().copied()).collect();
        let others = scene.objects.iter().enumerate().filter(|(i, _)| !asked.contains(i));
        let others = others.filter_map(|(_, object)| self.unknown(&object.mask, camera));
        detections.chain(others).collect()
    }

    fn detection(&self, detection: &Detection, camera: &Camera) -> Option<SeenPart> {
        let known = detection.name.as_ref().and_then(|name| self.parts.iter().find(|part| part.name == *name));
        let (Some(part), Some(world)) = (known, detection.world) else {
            return self.unknown(&detection.mask, camera);
        };
        let pose = PlanePose { x_mm: world.x_mm, y_mm: world.y_mm, z_mm: 0.0, yaw_deg: world.yaw_rad.to_degrees() };
        let base = pose.moved(&self.base_from_world);
        let (at_mm, yaw_rad) = ([base.x_mm, base.y_mm], base.yaw_deg.to_radians());
        let outline_mm = match &part.outline {
            Some(outline) => outline.clone(),
            None => {
                let [x, y] = at_mm;
                let here = self.outline(&detection.mask, camera, part.height_mm)?;
                here.moved([-x, -y], 0.0).moved([0.0, 0.0], -yaw_rad)
            }
        };
        Some(SeenPart {
            name: Some(part.name.clone()),
            score: f64::from(detection.score),
            at_mm,
            yaw_rad,
            z_mm: base.z_mm,
            height_mm: part.height_mm,
            outline_mm,
            grasps: part.grasps.clone(),
            symmetry_order: part.symmetry_order,
        })
    }

    fn unknown(&self, mask: &Mask, camera: &Camera) -> Option<SeenPart> {
        let outline_mm = self.outline(mask, camera, 0.0)?;
        let z_mm = (self.base_from_world * Point3::origin()).z;
        Some(SeenPart {
            name: None,
            score: 0.0,
            at_mm: [0.0; 2],
            yaw_rad: 0.0,
            z_mm,
            height_mm: self.unknown_height_mm,
            outline_mm,
            grasps: Vec::new(),
            symmetry_order: 1,
        })
    }

    /// The hull of a mask on a plane over the table, in the base frame.
    fn outline(&self, mask: &Mask, camera: &Camera, height_mm: f64) -> Option<Convex> {
        let ends = mask.runs().flat_map(|run| [(run.start, run.y), (run.end.saturating_sub(1), run.y)]);
        let pixels: Vec<[f64; 2]> = ends.map(|(x, y)| [f64::from(x), f64::from(y)]).collect();
        // The hull in the image first: it has tens of corners where a mask has thousands of pixels.
        let hull = Convex::hull(&pixels);
        let mut points = Vec::with_capacity(hull.corners_mm().len());
        for &corner in hull.corners_mm() {
            let [x, y, z] = camera.world_from_image(corner, height_mm).ok()?;
            let base = self.base_from_world * Point3::new(x, y, z);
            points.push([base.x, base.y]);
        }
        Some(Convex::hull(&points))
    }
}

fn known(part: &Part) -> KnownPart {
    let outline = part.mesh.as_ref().map(|mesh| {
        let vertices: Vec<[f64; 2]> = mesh.vertices().iter().map(|&[x, y, _]| [x, y].map(f64::from)).collect();
        Convex::hull(&vertices)
    });
    let first =
        Grasp { offset_mm: part.grasp.offset_mm, angle_rad: part.grasp.angle_rad, width_mm: part.grasp.width_mm };
    // Across its grasp a part is as wide as its outline: the second way to grip it.
    let across = outline.as_ref().and_then(|outline| outline.extent_mm(first.angle_rad));
    let across = across.map(|[least, most]| Grasp {
        angle_rad: first.angle_rad + std::f64::consts::FRAC_PI_2,
        width_mm: most - least,
        ..first
    });
    KnownPart {
        name: part.name.clone(),
        height_mm: part.height_mm,
        outline,
        grasps: [Some(first), across].into_iter().flatten().collect(),
        // What it looks like decides how it is turned in its slot.
        symmetry_order: part.symmetry.appearance_order,
    }
}
