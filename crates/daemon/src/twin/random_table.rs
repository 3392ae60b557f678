//! Random tables: parts at random places and angles, where camera and robot reach them.
//!
//! In: names of parts, a seed, how far apart they must lie. Out: a [`TableState`], the same for the same input. Every part lies
//! inside the view with a margin, its grasp inside the reach of the robot, and no two outlines closer than the gap.

use samsod::recognize::{Catalogue, Part};
use samsod_camera::Camera;
use samsod_camera::nalgebra::Isometry3;
use samsod_robot::{Convex, TablePart, TableState, Whereabouts};

use super::random::Random;
use crate::place::PlanePose;

/// Distance of a grasp from the axis of the robot's base, mm: where the simulated MH5 with a tool of 100 mm, its gripper
/// pointing down, gets to the table and 120 mm above it. It does so from 300 to about 640 mm.
pub const REACH_MM: [f64; 2] = [310.0, 600.0];
/// Distance of a part from the border of the image, px.
pub const MARGIN_PX: f64 = 25.0;
/// Greatest gap that can be asked for, mm.
const MAX_GAP_MM: f64 = 1000.0;
/// Greatest distance of a circle from the base along an axis, mm.
const MAX_PLACE_MM: f64 = 100_000.0;
/// Places that are tried for a part, and how often all begins anew.
const TRIES: usize = 2000;
const ROUNDS: usize = 20;

/// What is to lie on the table.
#[derive(Debug, Clone, PartialEq)]
pub struct TableOptions {
    /// Names in the catalogue; one may come twice.
    pub parts: Vec<String>,
    /// The same seed makes the same table.
    pub seed: u64,
    /// Least distance of two outlines, 0 to 1000 mm: so that the fingers of a gripper fit beside each part.
    pub gap_mm: f64,
    /// Circles to keep free: x, y in the base frame of the robot, and radius, mm.
    pub keep_free_mm: Vec<[f64; 3]>,
}

/// Why there is no table.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TableError {
    /// Nothing is to lie on it.
    #[error("no part is named; known are {}", known.join(", "))]
    NoPart {
        /// Names in the catalogue.
        known: Vec<String>,
    },
    /// A part is not in the catalogue.
    #[error("no part is named {name:?}; known are {}", known.join(", "))]
    UnknownPart {
        /// The name given.
        name: String,
        /// Names in the catalogue.
        known: Vec<String>,
    },
    /// A part has no model, by which it would be drawn.
    #[error("part {name} has no model.stl; the twin draws parts by their models")]
    NoModel {
        /// The part.
        name: String,
    },
    /// A number is not allowed.
    #[error("{key} is {value}; allowed: 0 to {most}")]
    Value {
        /// Which.
        key: &'static str,
        /// The value given.
        value: f64,
        /// The most that is allowed.
        most: f64,
    },
    /// The parts do not fit.
    #[error(
        "{} of {parts} parts find a place with {gap_mm} mm between them, inside the view and {} to {} mm from the base; ask for \
         fewer parts or a smaller gap",
        placed,
        REACH_MM[0],
        REACH_MM[1]
    )]
    NoRoom {
        /// How many did find one, at best.
        placed: usize,
        /// How many there are.
        parts: usize,
        /// The gap, mm.
        gap_mm: f64,
    },
}

/// The part of a name, with a model.
pub(super) fn find<'a>(catalogue: &'a Catalogue, name: &str) -> Result<&'a Part, TableError> {
    match catalogue.part(name) {
        Some(part) if part.mesh.is_some() => Ok(part),
        Some(_) => Err(TableError::NoModel { name: name.to_owned() }),
        None => Err(TableError::UnknownPart { name: name.to_owned(), known: known(catalogue) }),
    }
}

fn known(catalogue: &Catalogue) -> Vec<String> {
    catalogue.parts().iter().map(|part| part.name.clone()).collect()
}

/// Lays parts on the table.
///
/// # Arguments
/// * `camera` - that sees the table
/// * `base_from_world` - pose of the table in the base frame of the robot
///
/// # Errors
/// [`TableError`]: a part that is not known, parts that do not fit.
pub fn random_table(
    options: &TableOptions,
    catalogue: &Catalogue,
    camera: &Camera,
    base_from_world: &Isometry3<f64>,
) -> Result<TableState, TableError> {
    if options.parts.is_empty() {
        return Err(TableError::NoPart { known: known(catalogue) });
    }
    let within = |key, value: f64, most: f64| {
        // NaN is in no range.
        if (0.0..=most).contains(&value) { Ok(()) } else { Err(TableError::Value { key, value, most }) }
    };
    within("gap_mm", options.gap_mm, MAX_GAP_MM)?;
    for [x_mm, y_mm, radius_mm] in &options.keep_free_mm {
        // The sign of a place does not matter.
        within("keep_free_mm x", x_mm.abs(), MAX_PLACE_MM)?;
        within("keep_free_mm y", y_mm.abs(), MAX_PLACE_MM)?;
        within("keep_free_mm radius", *radius_mm, MAX_GAP_MM)?;
    }
    let lying: Vec<TablePart> =
        options.parts.iter().map(|name| Ok(lying(find(catalogue, name)?))).collect::<Result<_, TableError>>()?;
    // The largest first: small ones find a place between them.
    let length = |part: &TablePart| part.outline_mm.corners_mm().iter().map(|p| p[0].hypot(p[1])).fold(0.0, f64::max);
    let mut order: Vec<usize> = (0..lying.len()).collect();
    order.sort_by(|&a, &b| length(&lying[b]).total_cmp(&length(&lying[a])));

    let mut random = Random::new(options.seed);
    let mut best = 0;
    for _ in 0..ROUNDS {
        let mut placed: Vec<(usize, TablePart, Convex)> = Vec::new();
        for &index in &order {
            let place = (0..TRIES).find_map(|_| {
                let part = throw(&lying[index], camera, base_from_world, &mut random)?;
                let outline = part.outline();
                let is_free = placed.iter().all(|(_, _, other)| outline.gap_mm(other) >= options.gap_mm)
                    && options.keep_free_mm.iter().all(|[x, y, radius]| {
                        let circle = Convex::hull(&[[*x, *y]]);
                        outline.gap_mm(&circle) >= *radius
                    });
                is_free.then_some((index, part, outline))
            });
            match place {
                Some(place) => placed.push(place),
                None => break,
            }
        }
        best = best.max(placed.len());
        if placed.len() == lying.len() {
            placed.sort_by_key(|(index, ..)| *index);
            let parts = placed.into_iter().map(|(_, part, _)| part).collect();
            // Of the table, which lies as high as the base of the robot or not.
            let surfaces_mm = vec![rounded(base_from_world.translation.vector.z)];
            return Ok(TableState { surfaces_mm, ..TableState::new(parts) });
        }
    }
    Err(TableError::NoRoom { placed: best, parts: lying.len(), gap_mm: options.gap_mm })
}

/// A part of the catalogue at the base of the robot.
fn lying(part: &Part) -> TablePart {
    let vertices = part.mesh.iter().flat_map(|mesh| mesh.vertices());
    let from_above: Vec<[f64; 2]> = vertices.map(|v| [v[0], v[1]].map(|c| rounded(f64::from(c)))).collect();
    TablePart {
        name: part.name.clone(),
        whereabouts: Whereabouts::Table,
        x_mm: 0.0,
        y_mm: 0.0,
        z_mm: 0.0,
        yaw_rad: 0.0,
        height_mm: part.height_mm,
        grasp_width_mm: part.grasp.width_mm,
        grasp_offset_mm: part.grasp.offset_mm,
        grasp_angle_rad: rounded(part.grasp.angle_rad.to_degrees()).to_radians(),
        symmetry_order: part.symmetry.shape_order,
        outline_mm: Convex::hull(&from_above),
    }
}

/// The part somewhere, if camera and robot reach it there.
fn throw(
    part: &TablePart,
    camera: &Camera,
    base_from_world: &Isometry3<f64>,
    random: &mut Random,
) -> Option<TablePart> {
    let pixel = camera.intrinsics().size_px().map(|side| random.within([0.0, f64::from(side) - 1.0]));
    let yaw_deg = random.within([-180.0, 180.0]);
    let [x_mm, y_mm, z_mm] = camera.world_from_image(pixel, 0.0).ok()?;
    let base = PlanePose { x_mm, y_mm, z_mm, yaw_deg }.moved(base_from_world);
    let part = TablePart {
        x_mm: rounded(base.x_mm),
        y_mm: rounded(base.y_mm),
        z_mm: rounded(base.z_mm),
        yaw_rad: rounded(base.yaw_deg).to_radians(),
        ..part.clone()
    };
    let [grasp_x, grasp_y] = part.grasp_mm();
    if !(REACH_MM[0]..=REACH_MM[1]).contains(&grasp_x.hypot(grasp_y)) {
        return None;
    }
    let world_from_base = base_from_world.inverse();
    let is_in_view = part.outline().corners_mm().iter().all(|&[x, y]| {
        [0.0, part.height_mm].into_iter().all(|height_mm| {
            let corner = PlanePose { x_mm: x, y_mm: y, z_mm: part.z_mm + height_mm, yaw_deg: 0.0 };
            let corner = corner.moved(&world_from_base);
            let pixel = camera.image_from_world([corner.x_mm, corner.y_mm, corner.z_mm]);
            pixel.is_ok_and(|pixel| {
                pixel
                    .into_iter()
                    .zip(camera.intrinsics().size_px())
                    .all(|(c, side)| (MARGIN_PX..=f64::from(side) - 1.0 - MARGIN_PX).contains(&c))
            })
        })
    });
    is_in_view.then_some(part)
}

/// To a hundredth: a file for people, too.
fn rounded(value: f64) -> f64 {
    // Adding 0 makes -0 a 0.
    (value * 100.0).round() / 100.0 + 0.0
}
