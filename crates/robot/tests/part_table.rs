//! The table of a simulated robot: what can be picked, what fails, what collides, and its file.

// A test says what went wrong best by stopping there.
#![allow(clippy::unwrap_used)]

use samsod_robot::{
    Collider, Convex, GripperShape, PartTable, PartTableError, PickTolerance, Pose, TablePart, TableState, Whereabouts,
    Workpieces,
};

/// A block of 40 x 20 x 30 mm.
fn block(name: &str, x_mm: f64, y_mm: f64, yaw_deg: f64) -> TablePart {
    TablePart {
        name: name.to_owned(),
        whereabouts: Whereabouts::Table,
        x_mm,
        y_mm,
        z_mm: 0.0,
        yaw_rad: yaw_deg.to_radians(),
        height_mm: 30.0,
        grasp_width_mm: 20.0,
        grasp_offset_mm: [0.0, 0.0],
        grasp_angle_rad: 0.0,
        symmetry_order: 1,
        outline_mm: Convex::rectangle([0.0, 0.0], [40.0, 20.0], 0.0),
    }
}

fn gripper() -> GripperShape {
    GripperShape { opening_mm: 50.0, finger_thickness_mm: 5.0, finger_width_mm: 10.0, ..GripperShape::default() }
}

fn table(parts: Vec<TablePart>) -> PartTable {
    PartTable::new(TableState::new(parts), gripper(), PickTolerance::default())
}

fn down(x_mm: f64, y_mm: f64, z_mm: f64, yaw_deg: f64) -> Pose {
    Pose::gripper_down(x_mm, y_mm, z_mm, yaw_deg.to_radians())
}

#[test]
fn a_part_is_held_within_the_tolerance_and_missed_beyond_it() {
    let held = |tool: Pose| {
        let mut table = table(vec![block("a", 400.0, 0.0, 30.0)]);
        let held = table.close(&tool);
        assert_eq!(table.state().parts[0].whereabouts == Whereabouts::Gripper, held);
        assert_eq!(table.state().picks[0].held, held);
        held
    };
    assert!(held(down(401.0, 1.0, 15.0, 33.0)));
    assert!(held(down(400.0, 0.0, 15.0, -150.0)), "from behind");
    assert!(held(down(400.0, 0.0, 15.0, 120.0)), "across, 40 mm wide");
    assert!(!held(down(403.1, 0.0, 15.0, 30.0)), "3.1 mm off");
    assert!(!held(down(400.0, 0.0, 15.0, 37.0)), "7 degrees off");
    assert!(!held(down(400.0, 0.0, 31.0, 30.0)), "above it");
    let mut wide = block("a", 400.0, 0.0, 0.0);
    wide.grasp_width_mm = 51.0;
    assert!(!table(vec![wide]).close(&down(400.0, 0.0, 15.0, 0.0)), "wider than the gripper opens");
}

#[test]
fn what_is_put_down_lies_where_the_tool_says_turned_as_it_was_gripped() {
    let mut table = table(vec![block("a", 400.0, 0.0, 30.0)]);
    assert!(table.close(&down(401.0, 0.0, 15.0, 30.0)));
    table.open(&down(500.0, 100.0, 15.0, 120.0));
    let part = &table.state().parts[0];
    assert_eq!(part.whereabouts, Whereabouts::Jig);
    // Gripped 1 mm off along the base's x axis, then turned by 90 degrees.
    assert!((part.x_mm - 500.0).abs() < 1e-9 && (part.y_mm - 99.0).abs() < 1e-9, "{part:?}");
    assert!((part.yaw_rad.to_degrees() - 120.0).abs() < 1e-9, "{part:?}");

    assert!(table.close(&down(500.0, 99.0, 15.0, 120.0)));
    table.open(&down(500.0, 100.0, 95.0, 120.0));
    assert_eq!(table.state().parts[0].whereabouts, Whereabouts::Dropped);
}

#[test]
fn a_finger_a_body_and_a_held_part_that_meet_something_are_told_once_each() {
    let mut table =
        table(vec![block("a", 400.0, 0.0, 0.0), block("b", 400.0, 27.0, 0.0), block("c", 400.0, 150.0, 0.0)]);
    table.open(&down(400.0, 0.0, 200.0, 0.0));
    for z in (15..200).rev() {
        table.passes(&down(400.0, 0.0, f64::from(z), 0.0));
    }
    let met =
        |table: &PartTable| -> Vec<_> { table.state().collisions.iter().map(|c| (c.part.clone(), c.by)).collect() };
    assert_eq!(met(&table), [("b".to_owned(), Collider::Finger)]);
    assert!(table.close(&down(400.0, 0.0, 15.0, 0.0)));
    // Across the table at too low a height, into c.
    for y in 60..=150 {
        table.passes(&down(400.0, f64::from(y), 40.0, 0.0));
    }
    assert_eq!(met(&table).last(), Some(&("c".to_owned(), Collider::HeldPart)));
    assert_eq!(met(&table).len(), 2);
    for y in 60..=150 {
        table.passes(&down(400.0, f64::from(y), 50.0, 0.0));
    }
    assert_eq!(met(&table).len(), 2, "high enough");
}

#[test]
fn the_file_is_replaced_at_every_change_and_what_it_cannot_hold_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("table.json");
    TableState::new(vec![block("a", 400.0, 0.0, 30.0)]).write(&path).unwrap();
    let mut table = PartTable::open(&path, gripper(), PickTolerance::default()).unwrap();
    assert!(table.close(&down(400.0, 0.0, 15.0, 30.0)));
    assert_eq!(TableState::read(&path).unwrap(), table.state());
    assert_eq!(TableState::read(&path).unwrap().parts[0].whereabouts, Whereabouts::Gripper);

    let text = std::fs::read_to_string(&path).unwrap();
    let bad = [
        (text.replace("\"height_mm\": 30.0", "\"height_mm\": -1.0"), "part \"a\": height_mm is -1; it must be above 0"),
        (
            text.replace("\"x_mm\": 400.0", "\"x_mm\": 4e9"),
            "part \"a\": x_mm is 4000000000; allowed: -100000 to 100000",
        ),
        (text.replace("\"version\": 1", "\"version\": 7"), "version is 7; this program knows 1"),
        (text[..text.len() / 2].to_owned(), "is no table of parts: EOF"),
    ];
    for (text, message) in bad {
        std::fs::write(&path, text).unwrap();
        let error = TableState::read(&path).unwrap_err().to_string();
        assert!(error.contains(message) && error.contains("table.json"), "{error}");
    }
    let missing = folder.path().join("none.json");
    assert!(matches!(TableState::read(&missing), Err(PartTableError::Read { .. })));
}
