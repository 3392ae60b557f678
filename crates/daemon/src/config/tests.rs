//! Configurations read, refused and printed.

use super::*;

fn read(text: &str) -> Result<Config, ConfigError> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cell.toml");
    fs::write(&path, text).unwrap();
    Config::read(&path)
}

#[test]
fn a_section_without_keys_is_the_defaults_and_they_print_and_read_back() {
    let config = read("[cell]").unwrap();
    assert_eq!(config, Config::default());
    // An angle may change in its last digit on the way through degrees.
    let again = read(&config.to_toml().unwrap()).unwrap();
    let robot =
        RobotConfig { home: config.robot.home, simulated: config.robot.simulated.clone(), ..again.robot.clone() };
    assert_eq!(Config { robot, ..again }, config);
}

#[test]
fn every_key_is_printed_one_without_a_value_in_a_comment() {
    let text = Config::default().to_toml().unwrap();
    // These have no optional keys, and refuse a missing one before an unknown one.
    let whole = ["[robot.home]", "[robot.motoman.gripper.io]"];
    let is_section = |line: &&str| line.starts_with('[') && !whole.contains(line);
    let sections = text.lines().filter(is_section).collect::<Vec<_>>();
    assert_eq!(sections.len(), 21, "{sections:?}");
    for section in sections {
        let (_, part) = text.split_once(&format!("{section}\n")).unwrap();
        let part = part.split("\n[").next().unwrap();
        // What is said of an unknown key names all that are known.
        let refusal = read(&format!("{section}\nno_such_key = 1\n")).unwrap_err().to_string();
        let (_, known) = refusal.split_once("expected ").unwrap_or_else(|| panic!("{refusal}"));
        for key in known.split('`').skip(1).step_by(2) {
            let starts = [format!("{key} = "), format!("# {key}: not set, ")];
            let is_section = text.contains(&format!(".{key}]\n"));
            assert!(
                is_section || part.lines().any(|line| starts.iter().any(|start| line.starts_with(start))),
                "{section} {key}: {text}"
            );
        }
    }
    assert!(text.contains("[segment]\n# spatial_bandwidth_px: not set, a ninetieth of the longer side"), "{text}");

    // One that is set is no comment, and reads back.
    let folder = tempfile::tempdir().unwrap();
    let table = folder.path().join("table.json");
    TableState::new(Vec::new()).write(&table).unwrap();
    let set = "[http]\ntoken_file = \"/tmp/token\"\n[foxglove]\n[interest]\nfile = \"/tmp/region.toml\"\n[frames]\nroot_path = \"/tmp/a\"\n[segment]\nspatial_bandwidth_px = 12.0\nmin_area_px = 48\n\
               [shadow]\nmin_object_area_px = 30\n[view]\n";
    let robot = "figure = 0\npart_sensor = { start_address = 20030, bit = 4 }\n\
                 emergency_stop = { start_address = 80020, bit = 5 }\n\
                 job = { name = \"MOVE\", target_variable = 1, speed_variable = 2, kind_variable = 3 }\n";
    let config = read(&format!("{set}[robot.simulated]\ntable = {table:?}\n[robot.motoman]\n{robot}")).unwrap();
    let text = config.to_toml().unwrap();
    let comments: Vec<&str> = text.lines().filter(|line| line.contains('#')).collect();
    let catalogue = "# folder: not set, objects are found, but not named; samsod teach makes one";
    assert_eq!(comments, [catalogue, "# file: not set, [view] takes its place"], "{text}");
    let again = read(&text).unwrap();
    assert_eq!((again.frames, again.segment, again.shadow), (config.frames, config.segment, config.shadow));
}

#[test]
fn the_example_is_accepted() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/cell.toml");
    let config = Config::read(&path).unwrap();
    assert_eq!(config.cell.name, "demo");
    // The corners of a camera frame lie within reach of the simulated arm.
    let arm = config.robot.arm();
    for (u, v) in [(0.0, 0.0), (1077.0, 0.0), (0.0, 957.0), (1077.0, 957.0)] {
        let [x, y] = config.view.unwrap().table_from_image(u, v);
        let above = Pose::gripper_down(x, y, config.robot.safe_height_mm, 0.0);
        arm.joints_at(&above, &Joints([0.0; 6])).unwrap();
    }
}

#[test]
fn the_cell_of_the_package_is_accepted_and_moves_nothing() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../packaging/cell.toml");
    let config = Config::read(&path).unwrap();
    assert_eq!((config.robot.controller, config.robot.armed), (ControllerKind::None, false));
    assert!(config.http.unwrap().listen.ip().is_loopback());
    // What the unit makes is what the configuration names.
    let unit = fs::read_to_string(path.with_file_name("samsodd.service")).unwrap();
    let key = |name: &str| unit.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix('=')).unwrap();
    assert_eq!(config.frames.root_path.unwrap(), Path::new("/run").join(key("RuntimeDirectory")));
    assert!(config.recording.folder.starts_with(Path::new("/var/lib").join(key("StateDirectory"))));
    let patience_ms = 1000 * key("TimeoutStopSec").parse::<u64>().unwrap();
    assert!((2000..10_000).contains(&patience_ms), "samsodd ends within two seconds");
}

#[test]
fn times_of_the_supervision_have_bounds() {
    for (text, expected) in [
        ("[supervision]\nstuck_after_ms = 499\n", "[supervision] stuck_after_ms is 499; allowed: 500 to 3600000"),
        ("[frames]\nstalled_after_ms = 9\n", "[frames] stalled_after_ms is 9; allowed: 10 to 86400000"),
    ] {
        assert_eq!(read(text).unwrap_err().to_string(), expected);
    }
}

#[test]
fn a_jig_names_parts_of_the_catalogue_and_slots_within_reach() {
    let parts = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/parts");
    let jig = |slot: &str| read(&format!("[catalogue]\nfolder = {parts:?}\n[jig]\norder = [{{ {slot} }}]\n"));
    let config = jig("part = \"hex_nut\", x_mm = 300.0, y_mm = 250.0, yaw_deg = 90.0").unwrap();
    assert!((config.jig.order[0].yaw_rad - std::f64::consts::FRAC_PI_2).abs() < 1e-12);
    for (slot, parts) in [
        (
            "part = \"hexnut\", x_mm = 300.0, y_mm = 250.0",
            ["[jig] order: line 1 (hexnut)", "it has asym_plate, bearing"],
        ),
        ("part = \"hex_nut\", x_mm = 740.0, y_mm = 250.0", ["[jig] order: line 1 (hex_nut)", "out of reach"]),
        (
            "part = \"hex_nut\", x_mm = 300.0, y_mm = 250.0, z_mm = -20.0",
            ["line 1 (hex_nut)", "workspace z is -14.5 mm"],
        ),
        ("part = \"hex_nut\", x_mm = nan, y_mm = 250.0", ["line 1 (hex_nut)", "x_mm of a pose is NaN"]),
    ] {
        let refusal = jig(slot).unwrap_err().to_string();
        assert!(parts.iter().all(|part| refusal.contains(part)), "{slot}: {refusal}");
    }
}

#[test]
fn a_view_is_printed_when_it_is_given_and_named_when_it_is_not() {
    let text = Config::default().to_toml().unwrap();
    assert!(text.starts_with("# [view] mm_per_px, origin_px: not set, and no [camera] file: objects"), "{text}");
    let text = read("[view]\nmm_per_px = 0.5").unwrap().to_toml().unwrap();
    assert!(text.contains("[view]\nmm_per_px = 0.5\norigin_px = [-625.0, 479.0]\n"), "{text}");
    assert!(!text.contains("# [view]"), "{text}");
    assert_eq!(read(&text).unwrap().view, Some(ViewConfig { mm_per_px: 0.5, ..ViewConfig::default() }));
}

const CAMERA: &str = "[intrinsics]\nwidth_px = 1078\nheight_px = 958\nfx_px = 1600.0\nfy_px = 1600.0\n\
    cx_px = 541.2\ncy_px = 476.6\nk1 = 0.0\nk2 = 0.0\np1 = 0.0\np2 = 0.0\nk3 = 0.0\n";
const WORLD: &str = "[world]\nworld_from_camera_mm = [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], \
    [0.0, 0.0, -1.0, 900.0], [0.0, 0.0, 0.0, 1.0]]\n";

/// A configuration with a camera file beside it.
fn read_with_camera(text: &str, camera: &str) -> Result<Config, ConfigError> {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("camera.toml"), camera).unwrap();
    let path = folder.path().join("cell.toml");
    fs::write(&path, text).unwrap();
    let config = Config::read(&path)?;
    assert_eq!(config.camera.file, Some(std::path::absolute(folder.path().join("camera.toml")).unwrap()));
    // What is printed means the same elsewhere, while the file is there.
    let elsewhere = tempfile::tempdir().unwrap();
    let printed = elsewhere.path().join("printed.toml");
    fs::write(&printed, config.to_toml().unwrap()).unwrap();
    assert_eq!(Config::read(&printed).unwrap().camera, config.camera);
    assert!(config.placer()?.unwrap().image_size_px() == Some([1078, 958]));
    Ok(config)
}

#[test]
fn a_camera_file_lies_beside_the_configuration_and_is_checked_with_it() {
    let whole = format!("{CAMERA}{WORLD}");
    let with = |keys: &str| format!("[camera]\nfile = \"camera.toml\"\n{keys}\n");
    let config = read_with_camera(&with("object_height_mm = 12.5"), &whole).unwrap();
    assert_eq!((config.camera.object_height_mm, config.view), (12.5, None));
    for (text, camera, parts) in [
        (with(""), CAMERA.to_owned(), vec!["[camera] file: ", "camera.toml: there is no [world]"]),
        (with(""), whole.replace("fx_px = 1600.0", "fx_px = -1.0"), vec!["camera.toml: [intrinsics] fx_px"]),
        (with(""), "[intrinsics]\n".to_owned(), vec!["[camera] file: ", "camera.toml", "missing field `width_px`"]),
        (with("[view]"), whole.clone(), vec!["[camera] file = ", "camera.toml and [view] are both given"]),
        (with("[frames]\nmax_height_px = 900"), whole.clone(), vec!["1078 x 958 px", "max_height_px", "8192 x 900"]),
        (with("object_height_mm = 950.0"), whole.clone(), vec!["object_height_mm = 950: the plane z = 950 mm is"]),
        (with("object_height_mm = nan"), whole.clone(), vec!["[camera] object_height_mm is NaN"]),
        ("[camera]\nfile = \"none.toml\"".to_owned(), whole.clone(), vec!["cannot read ", "none.toml"]),
    ] {
        let refusal = read_with_camera(&text, &camera).unwrap_err().to_string();
        for part in parts {
            assert!(refusal.contains(part), "{text:?}: {refusal}");
        }
    }
}

#[test]
fn a_catalogue_lies_beside_the_configuration_and_is_checked_with_it() {
    let folder = tempfile::tempdir().unwrap();
    let write = |text: &str| {
        let path = folder.path().join("cell.toml");
        fs::write(&path, text).unwrap();
        path
    };
    let bundled = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/parts");
    let parts = folder.path().join("parts");
    let path = write("[catalogue]\nfolder = \"parts\"\n");
    let refusal = |path: &Path| Config::read(path).unwrap_err().to_string();
    assert!(refusal(&path).starts_with(&format!("[catalogue] folder: cannot read {}: ", parts.display())));
    // Those who do without it are not held up: this is how the first part is taught.
    assert_eq!(Config::read_without_catalogue(&path).unwrap().catalogue.folder, Some(parts.clone()));
    fs::create_dir(&parts).unwrap();
    assert!(refusal(&path).contains("no part in it"), "{}", refusal(&path));
    fs::create_dir(parts.join("washer")).unwrap();
    for name in ["part.toml", "template.png", "mask.png", "model.stl"] {
        fs::copy(bundled.join("washer").join(name), parts.join("washer").join(name)).unwrap();
    }
    let config = Config::read(&path).unwrap();
    assert_eq!(config.read_catalogue().unwrap().unwrap().parts()[0].name, "washer");
    assert!(config.to_toml().unwrap().contains(&format!("folder = {parts:?}")), "{}", config.to_toml().unwrap());
    fs::write(parts.join("washer/mask.png"), "no image").unwrap();
    let text = refusal(&path);
    assert!(text.starts_with("[catalogue] folder: ") && text.contains("washer/mask.png"), "{text}");
    assert!(read("[catalogue]\nfolders = \"a\"").unwrap_err().to_string().contains("unknown field `folders`"));
}

#[test]
fn refusals_name_the_key_the_value_and_what_is_allowed() {
    for (text, parts) in [
        ("[segmnt]", vec!["unknown field `segmnt`", "expected one of", "`segment`"]),
        ("[view]\nmm_per_pixel = 1.0", vec!["unknown field `mm_per_pixel`", "`mm_per_px`"]),
        ("[view]\nmm_per_px = \"wide\"", vec!["invalid type: string \"wide\"", "mm_per_px", "line 2"]),
        ("[cell", vec!["cell.toml", "line 1"]),
        ("[camera]\nfiles = \"a\"", vec!["unknown field `files`", "`file`", "`object_height_mm`"]),
        ("[view]\nmm_per_px = -1.0", vec!["[view] mm_per_px is -1; allowed: 0.001 to 1000"]),
        ("[view]\nmm_per_px = nan", vec!["[view] mm_per_px is NaN"]),
        ("[view]\norigin_px = [0.0, inf]", vec!["[view] origin_px is inf"]),
        ("[frames]\nmax_width_px = 0", vec!["[frames] max_width_px is 0; allowed: 1 to 16384"]),
        ("[frames]\nbuffer_frames = 0", vec!["[frames] buffer_frames is 0; 1 to 64 are allowed"]),
        ("[cell]\nname = \"a b\"", vec!["[cell] cell name \"a b\" must be"]),
        ("[segment]\nrange_bandwidth = nan", vec!["range_bandwidth = NaN; allowed are 1 to 255"]),
        ("[saliency]\nmethod = \"slow\"", vec!["unknown variant `slow`", "`fast`", "`exact`"]),
        ("[regions]\nthreshold = -1.0", vec!["-1"]),
        ("[shadow]\nobject_side = \"bright\"", vec!["unknown variant `bright`", "`paper`", "`evidence`"]),
        (
            "[shadow]\nmin_object_area_px = 0",
            vec!["vision: shadow: min_object_area_px = 0; allowed are 1 to 4294967295"],
        ),
        ("[recognize]\nmin_score = 2.0", vec!["vision: recognize: min_score = 2; allowed are 0 to 1"]),
        ("[robot]\ncontroller = \"abb\"", vec!["unknown variant `abb`", "`simulated`", "`motoman`"]),
        ("[robot.motoman]\nkeep_alive = 1", vec!["[robot.motoman] keep_alive is 1; it must be -1 or 2 to 32767"]),
        ("[robot]\njoint_speed_fraction = 1.5", vec!["joint_speed_fraction is 1.5; allowed: 0.001 to 1"]),
        ("[robot]\nsafe_height_mm = 5.0", vec!["[robot] safe_height_mm is 5; allowed: 20 to 5000"]),
        ("[camera]\nobject_height_mm = 400.0", vec!["[robot] safe_height_mm is 200; allowed: 400 to 5000"]),
        ("[recording]\nqueue_frames = 0", vec!["[recording] queue_frames = 0; allowed is 1 to 64"]),
        ("[robot]\ntool_length_mm = -2.0", vec!["[robot] tool_length_mm is -2; it must be 0 to 1000"]),
        (
            "[robot]\nhome = { x_mm = 900.0, y_mm = 0.0, z_mm = 200.0, rx_deg = 180.0, ry_deg = 0.0, rz_deg = 0.0 }",
            vec!["[robot] home: (900.0, 0.0, 200.0) mm", "is out of reach"],
        ),
        ("[robot.gripper]\nopening_mm = 0.0", vec!["[robot.gripper] opening_mm is 0; allowed: above 0, at most 1000"]),
        ("[robot.limits]\nstep_max_mm = nan", vec!["[robot.limits] step_max_mm is NaN; allowed: 1 to 5000"]),
        ("[robot.simulated]\nclock_rate = 0.0", vec!["[robot.simulated] clock_rate is 0; allowed: 0.01 to 1000"]),
        ("[robot.simulated]\ntable = \"/no/table.json\"", vec!["table: cannot read the table /no/table.json"]),
        ("[jig]\norder = [{ part = \"hex_nut\", x_mm = 400.0, y_mm = 0.0 }]", vec!["there is no [catalogue] folder"]),
        ("[frames]\nroot_path = \"here\"", vec!["[frames] root_path here: it must be absolute"]),
    ] {
        let refusal = read(text).unwrap_err().to_string();
        for part in parts {
            assert!(refusal.contains(part), "{text:?}: {refusal}");
        }
    }
    let missing = Config::read(Path::new("/no/such/cell.toml")).unwrap_err().to_string();
    assert!(missing.starts_with("cannot read /no/such/cell.toml: "), "{missing}");
}
