//! samsodd that does not start, or prints and ends: every refusal says what is wrong and what is allowed.

mod support;

use std::fs;
use std::path::Path;

use support::{TestCell, samsod};

#[test]
fn check_config_prints_what_is_in_force() {
    let cell = TestCell::new();
    let config = cell.config(&[("view", "mm_per_px = 0.25"), ("segment", "range_bandwidth = 9.5")]);
    let ended = cell.spawn_daemon(&config, &["--check-config"]).wait();
    ended.assert_success();
    for line in ["name = \"test-cell\"", "mm_per_px = 0.25", "range_bandwidth = 9.5", "joint_speed_fraction = 0.5"] {
        assert!(ended.stdout.lines().any(|l| l == line), "{line}: {}", ended.stdout);
    }
    assert!(!cell.path("recordings").exists(), "checking makes nothing");
    // What it prints is a configuration.
    fs::write(cell.path("again.toml"), &ended.stdout).unwrap();
    let again = cell.spawn_daemon(&cell.path("again.toml"), &["--check-config"]).wait();
    again.assert_success();
    // An angle may change in its last digit on the way through degrees.
    let plain = |text: &str| text.lines().filter(|l| !l.contains("_deg")).map(str::to_owned).collect::<Vec<_>>();
    assert_eq!(plain(&again.stdout), plain(&ended.stdout));
}

#[test]
fn the_example_is_a_configuration() {
    let cell = TestCell::new();
    let example = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/cell.toml");
    let ended = cell.spawn_daemon(&example, &["--check-config"]).wait();
    ended.assert_success();
    assert!(ended.stdout.contains("name = \"demo\""), "{}", ended.stdout);
}

#[test]
fn wrong_configurations_are_refused_with_code_2() {
    let cell = TestCell::new();
    for (section, keys, expected) in [
        ("view", "mm_per_inch = 1.0", "unknown field `mm_per_inch`, expected `mm_per_px` or `origin_px`"),
        ("view", "mm_per_px = nan", "[view] mm_per_px is NaN; allowed: 0.001 to 1000"),
        ("segment", "range_bandwidth = -1.0", "range_bandwidth = -1; allowed are 1 to 255"),
        ("recording", "queue_frames = 0", "queue_frames = 0; allowed is 1 to 64"),
        ("robot", "controller = \"none of these\"", "unknown variant `none of these`"),
        ("camera", "file = \"missing.toml\"", "[camera] file: cannot read "),
        ("camera", "object_height_mm = inf", "[camera] object_height_mm is inf; allowed: -1000 to 5000"),
    ] {
        let ended = cell.spawn_daemon(&cell.config(&[(section, keys)]), &[]).wait();
        assert_eq!(ended.status.code(), Some(2), "{ended:?}");
        assert!(ended.stderr.contains(expected), "{expected}: {}", ended.stderr);
    }
    let ended = cell.spawn_daemon(Path::new("/no/such/cell.toml"), &[]).wait();
    assert_eq!(ended.status.code(), Some(2));
    assert!(ended.stderr.contains("cannot read /no/such/cell.toml"), "{}", ended.stderr);
}

#[test]
fn a_second_daemon_on_the_cell_is_refused_with_code_4() {
    let cell = TestCell::new();
    let first = cell.start_daemon(&[]);
    // Another folder for its recording does not make it another cell.
    let other_folder = cell.config(&[]);
    let text = fs::read_to_string(&other_folder).unwrap().replace("recordings", "elsewhere");
    fs::write(&other_folder, text).unwrap();
    let second = cell.spawn_daemon(&other_folder, &[]).wait();
    assert_eq!(second.status.code(), Some(4), "{second:?}");
    let expected = format!("cell \"test-cell\" is already served by process {}", first.id());
    assert!(second.stderr.contains(&expected), "{}", second.stderr);
    let since = second.stderr.split_once(" since ").unwrap().1.split_once(' ').unwrap().0;
    let lock = fs::metadata(cell.path("shm/samsod-test-cell.lock")).unwrap().modified().unwrap();
    assert_eq!(since, humantime::format_rfc3339_seconds(lock).to_string(), "{}", second.stderr);
    assert!(second.stderr.contains(" of user "), "{}", second.stderr);
    assert!(!cell.path("elsewhere").exists(), "the second has touched nothing");
    first.terminate().assert_success();
    cell.start_daemon(&[]).terminate().assert_success();
}

#[test]
fn a_folder_that_cannot_be_written_is_named() {
    let cell = TestCell::new();
    // A file in the way, since no permission stops a superuser.
    fs::write(cell.path("recordings"), "a file").unwrap();
    let ended = cell.spawn_daemon(&cell.config(&[]), &[]).wait();
    assert_eq!(ended.status.code(), Some(1), "{ended:?}");
    let expected = format!("cannot write recordings to {}", cell.path("recordings").display());
    assert!(ended.stderr.contains(&expected), "{}", ended.stderr);
}

#[test]
fn a_client_without_a_daemon_says_so() {
    let cell = TestCell::new();
    let ended = cell.spawn_client(&cell.images(1), &["--wait", "0"]).wait();
    assert!(!ended.status.success());
    assert!(ended.stderr.contains("no subscriber on cell \"test-cell\""), "{}", ended.stderr);
}

#[test]
fn manual_pages_and_completions_of_both_programs_are_written() {
    let cell = TestCell::new();
    let folder = cell.path("generated");
    samsod(&["generate", folder.to_str().unwrap()]).assert_success();
    let read = |name: &str| fs::read_to_string(folder.join(name)).unwrap_or_else(|e| panic!("{name}: {e}"));
    for (page, word) in
        [("samsodd.1", "check\\-config"), ("samsod.1", "samsod\\-publish"), ("samsod-resume.1", "gripper")]
    {
        let text = read(&format!("man/{page}"));
        assert!(text.contains(".TH ") && text.contains(word), "{page}: {text}");
    }
    for name in ["samsod.bash", "samsodd.bash", "_samsod", "_samsodd", "samsod.fish", "samsodd.fish"] {
        let text = read(&format!("completions/{name}"));
        let word = if name.contains("samsodd") { "until-jig-is-full" } else { "new-jig" };
        assert!(text.contains(word), "{name}: {text}");
    }
    let schema: serde_json::Value = serde_json::from_str(&read("cell.schema.json")).unwrap();
    assert_eq!(schema["title"], "Configuration of samsodd", "{schema}");
    assert!(!read("man/samsod.1").contains("generate"), "what only the package needs is not shown");
    let in_the_way = cell.path("file");
    fs::write(&in_the_way, "text").unwrap();
    let refused = samsod(&["generate", in_the_way.to_str().unwrap()]);
    assert!(!refused.status.success() && refused.stderr.contains("cannot write to"), "{refused:?}");
}
