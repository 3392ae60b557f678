//! Every configuration that is shipped, and every kind of file that is none: by the schema and by samsodd itself.

#![allow(clippy::expect_used, clippy::unwrap_used, clippy::panic, reason = "helpers of tests fail by panicking")]

mod support;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use jsonschema::Validator;
use support::{Ended, Process, TestCell, test_data};

fn samsodd(arguments: &[&str]) -> Ended {
    let mut command = Command::new(env!("CARGO_BIN_EXE_samsodd"));
    command.args(arguments);
    Process::spawn(command).wait()
}

fn check(path: &Path) -> Ended {
    samsodd(&["--config", path.to_str().unwrap(), "--check-config"])
}

/// The schema as the program prints it.
fn schema() -> Validator {
    let ended = samsodd(&["--config-schema"]);
    ended.assert_success();
    let schema = serde_json::from_str(&ended.stdout).expect("JSON");
    jsonschema::draft202012::meta::validate(&schema).expect("a schema");
    jsonschema::validator_for(&schema).expect("a schema that can be used")
}

/// What the schema has against a file; nothing if it is content.
fn objections(schema: &Validator, text: &str) -> Vec<String> {
    let value: serde_json::Value = toml::from_str(text).unwrap_or_else(|e| panic!("{e}: {text}"));
    schema.iter_errors(&value).map(|error| format!("{}: {error}", error.instance_path())).collect()
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// The cell of the demonstration, as its script writes it.
fn demo_cell(cell: &TestCell, controller: &str) -> PathBuf {
    let script = fs::read_to_string(root().join("scripts/demo.sh")).unwrap();
    let (_, text) = script.split_once("cat <<TOML\n").expect("begin");
    let (text, _) = text.split_once("\nTOML\n").expect("end");
    fs::write(cell.path("table.json"), "{\"version\": 1, \"parts\": []}").unwrap();
    let text = format!("{text}\n    {{ part = \"hex_nut\", x_mm = 150.0, y_mm = 340.0, yaw_deg = 90.0 }},\n]\n");
    let text = text
        .replace("$cell", "demo-1")
        .replace("$PWD/$data", test_data("").to_str().unwrap())
        .replace("$out", cell.path("out").to_str().unwrap())
        .replace("$controller", controller)
        .replace("${1:-127.0.0.1:10080}", "127.0.0.1:10080");
    assert!(!text.contains('$'), "a variable that is new: {text}");
    let path = cell.path(&format!("demo-{controller}.toml"));
    fs::write(&path, text).unwrap();
    path
}

#[test]
fn every_shipped_configuration_passes_the_schema_and_the_check() {
    let cell = TestCell::new();
    let schema = schema();
    let mut files =
        vec![root().join("packaging/cell.toml"), demo_cell(&cell, "simulated"), demo_cell(&cell, "motoman")];
    let examples = fs::read_dir(root().join("examples")).unwrap().map(|entry| entry.unwrap().path());
    // That of samsod-camera is another program's, whose own tests read it.
    let is_of_samsodd = |path: &PathBuf| {
        path.extension().is_some_and(|extension| extension == "toml") && !path.ends_with("camera-client.toml")
    };
    files.extend(examples.filter(is_of_samsodd));
    assert!(files.len() >= 4, "{files:?}");
    for file in files {
        let text = fs::read_to_string(&file).unwrap();
        assert_eq!(objections(&schema, &text), Vec::<String>::new(), "{}", file.display());
        check(&file).assert_success();
        // Lines that are commented out are examples, too.
        let with_keys = uncommented(&text);
        assert_eq!(objections(&schema, &with_keys), Vec::<String>::new(), "{}", file.display());
        // And what is in force.
        let printed = check(&file).stdout;
        assert_eq!(objections(&schema, &printed), Vec::<String>::new(), "{}", file.display());
    }
}

/// The file with the keys that stand in comments; of a key that then stands there twice, the first.
fn uncommented(text: &str) -> String {
    let mut lines = Vec::<String>::new();
    let mut keys = Vec::new();
    let mut is_list = false;
    for line in text.lines() {
        let bare = line.strip_prefix("# ").unwrap_or(line);
        // A formula is none.
        let key = bare.split_once(" = ").filter(|(_, value)| !value.starts_with('(')).map(|(key, _)| key.trim());
        let key = key.filter(|key| key.chars().all(|c| c.is_ascii_lowercase() || c == '_'));
        if bare.starts_with('[') {
            keys.clear();
        }
        let is_new = key.is_some_and(|key| !keys.contains(&key.to_owned()));
        if is_list || is_new || (bare.starts_with('[') && bare.ends_with(']')) {
            keys.extend(key.map(str::to_owned).filter(|_| !is_list));
            is_list = if is_list { bare != "]" } else { bare.ends_with('[') };
            lines.push(bare.to_owned());
        }
    }
    lines.join("\n")
}

#[test]
fn wrong_files_fail_both() {
    let cell = TestCell::new();
    let schema = schema();
    for (text, expected) in [
        ("[segmnt]\nrange_bandwidth = 4.0", "segmnt"),
        ("[view]\nmm_per_inch = 1.0", "mm_per_inch"),
        ("[view]\nmm_per_px = \"wide\"", "wide"),
        ("[view]\norigin_px = [1.0]", "origin_px"),
        ("[cell]\nname = 7", "7"),
        ("[saliency]\nmethod = \"slow\"", "slow"),
        ("[saliency]\nscales = { object_sizes = [60.0] }", "object_sizes"),
        ("[regions]\nthreshold = \"high\"", "high"),
        ("[regions]\nthreshold = true", "threshold"),
        ("[shadow]\nobject_side = \"bright\"", "bright"),
        ("[recognize]\nsift = { features = 3 }", "features"),
        ("[robot]\ncontroller = \"abb\"", "abb"),
        ("[robot]\narmed = \"yes\"", "yes"),
        ("[robot]\nhome = { x_mm = 250.0, y_mm = 330.0 }", "z_mm"),
        ("[robot.limits]\nworkspace_min_mm = [0.0, 0.0]", "workspace_min_mm"),
        ("[robot.motoman]\ngripper = { magnet = 1 }", "magnet"),
        ("[robot.motoman]\nmode = \"teach\"", "teach"),
        ("[jig]\norder = [{ part = \"hex_nut\", x_mm = 1.0 }]", "y_mm"),
        ("[recording]\nqueue_frames = -1", "-1"),
        ("[recording]\nimage_encoding = \"bmp\"", "bmp"),
        ("[http]\nlisten = 9464", "9464"),
        ("[log]\nlevel = \"loud\"", "loud"),
    ] {
        let found = objections(&schema, text);
        assert!(!found.is_empty(), "the schema takes {text:?}");
        let path = cell.path("wrong.toml");
        fs::write(&path, text).unwrap();
        let ended = check(&path);
        assert_eq!(ended.status.code(), Some(2), "{text:?}: {ended:?}");
        assert!(ended.stderr.contains(expected), "{expected}: {}", ended.stderr);
    }
}

/// What stands before the cut means what it means in the whole file, or samsodd says what is wrong. That keys are missing behind it
/// nobody can tell: every key may be left out.
#[test]
fn a_file_that_is_cut_off_anywhere_is_refused_or_says_what_the_whole_one_says() {
    let cell = TestCell::new();
    let path = cell.path("cut.toml");
    let mut whole = fs::read_to_string(root().join("examples/cell.toml")).unwrap();
    whole = uncommented(&whole).replace("file = \"camera.toml\"", "").replace("folder = \"parts\"", "");
    whole = whole.split("[jig]").next().unwrap().to_owned();
    let of_whole: toml::Table = toml::from_str(&whole).unwrap();
    let ends = whole.char_indices().filter(|(_, c)| *c == '\n').map(|(at, _)| at);
    // After each line, and in the middle of each.
    let mut cuts = vec![0];
    for end in ends {
        let start = cuts[cuts.len() - 1];
        cuts.extend([start + (end - start) / 2, end + 1]);
    }
    let (mut accepted, mut refused) = (0, 0);
    for cut in cuts {
        fs::write(&path, &whole[..cut]).unwrap();
        match samsod_daemon::config::Config::read(&path) {
            Ok(_) => {
                accepted += 1;
                let cut: toml::Table = toml::from_str(&whole[..cut]).unwrap();
                assert!(is_part_of(&cut, &of_whole), "{cut:?}");
            }
            Err(e) => {
                refused += 1;
                let text = e.to_string();
                assert!(text.contains("cut.toml") || text.contains("is ") || text.contains(" = "), "{text}");
            }
        }
    }
    assert!(accepted > 20 && refused > 20, "{accepted} accepted, {refused} refused");
}

/// Whether every key of `part` has the value that it has in `whole`; a number at the very end may have lost digits, which nobody
/// can tell either.
fn is_part_of(part: &toml::Table, whole: &toml::Table) -> bool {
    part.iter().all(|(key, value)| match (value, whole.get(key)) {
        (toml::Value::Table(part), Some(toml::Value::Table(whole))) => is_part_of(part, whole),
        (value, Some(whole)) => value == whole || whole.to_string().starts_with(&value.to_string()),
        (_, None) => false,
    })
}

#[test]
fn what_is_no_text_file_with_keys_is_refused_by_name() {
    let cell = TestCell::new();
    let path = cell.path("file.toml");
    let file = path.to_str().unwrap();
    for (bytes, expected) in [
        (&b""[..], "is empty"),
        (b"\n# only words\n", "is empty"),
        (b"[cell]\nname = \"\xff\xfe\"\n", "is no text in UTF-8"),
        (&[0; 64], "TOML parse error"),
        (b"\x89PNG\r\n\x1a\n", "is no text in UTF-8"),
    ] {
        fs::write(&path, bytes).unwrap();
        for arguments in [&["--config", file, "--check-config"][..], &["--config", file]] {
            let ended = samsodd(arguments);
            assert_eq!(ended.status.code(), Some(2), "{}: {ended:?}", bytes.escape_ascii());
            assert!(ended.stderr.contains(file) && ended.stderr.contains(expected), "{expected}: {}", ended.stderr);
        }
    }
    fs::remove_file(&path).unwrap();
    fs::create_dir(&path).unwrap();
    let ended = check(&path);
    assert_eq!(ended.status.code(), Some(2), "{ended:?}");
    assert!(ended.stderr.contains(&format!("{file} is a folder")), "{}", ended.stderr);
    // The same of a file that a configuration names.
    let config = cell.config(&[("camera", "file = \"file.toml\"")]);
    let ended = check(&config);
    assert_eq!(ended.status.code(), Some(2), "{ended:?}");
    assert!(ended.stderr.contains("[camera] file: cannot read") && ended.stderr.contains("file.toml"), "{ended:?}");
}
