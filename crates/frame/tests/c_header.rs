//! `include/samsod_frame.h` says what this crate has: compiled by a C and a C++ compiler, and compared field by field.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail by panicking, too")]

use std::fs;
use std::mem::{align_of, offset_of, size_of};
use std::path::{Path, PathBuf};
use std::process::Command;

use iceoryx2::prelude::ZeroCopySend;
use samsod_frame::{FrameHeader, MAX_SIDE_PX, MAX_STRIDE_BYTES, PixelFormat, SENT_EVENT, SceneHeader};

/// A folder that goes away with its test.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("samsod-c-{name}-{}", std::process::id()));
        fs::create_dir_all(&path).unwrap();
        Self(path)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// What the header says, line by line.
const PROGRAM: &str = r#"
#include <stdio.h>
#include "samsod_frame.h"
#define FIELD(type, field) \
    printf(#type " " #field " %zu %zu\n", offsetof(type, field), sizeof(((type *)0)->field))
struct aligned_frame { char before; samsod_frame_header header; };
struct aligned_scene { char before; samsod_scene_header header; };
int main(void) {
    FIELD(samsod_frame_header, sequence);
    FIELD(samsod_frame_header, timestamp_ns);
    FIELD(samsod_frame_header, width);
    FIELD(samsod_frame_header, height);
    FIELD(samsod_frame_header, stride);
    FIELD(samsod_frame_header, pixel_format);
    FIELD(samsod_frame_header, camera);
    FIELD(samsod_frame_header, camera_frame);
    FIELD(samsod_frame_header, camera_time_ns);
    FIELD(samsod_scene_header, sequence);
    FIELD(samsod_scene_header, timestamp_ns);
    FIELD(samsod_scene_header, encoding);
    FIELD(samsod_scene_header, reserved);
    printf("sizes %zu %zu\n", sizeof(samsod_frame_header), sizeof(samsod_scene_header));
    printf("alignments %zu %zu\n", offsetof(struct aligned_frame, header), offsetof(struct aligned_scene, header));
    printf("names %s %s\n", SAMSOD_FRAME_HEADER_TYPE_NAME, SAMSOD_SCENE_HEADER_TYPE_NAME);
    printf("limits %d %d %d\n", SAMSOD_MAX_SIDE_PX, SAMSOD_MAX_STRIDE_BYTES, SAMSOD_SENT_EVENT);
    printf("formats %d %d %d %d %d %d %d\n", SAMSOD_RGB8, SAMSOD_BGR8, SAMSOD_MONO8, SAMSOD_BAYER_RG8, SAMSOD_BAYER_GR8,
           SAMSOD_BAYER_GB8, SAMSOD_BAYER_BG8);
    return 0;
}
"#;

fn said_by(compiler: &str, standard: &str, extension: &str) -> String {
    let folder = Folder::new(extension);
    let source = folder.0.join(format!("layout.{extension}"));
    let program = folder.0.join("layout");
    fs::write(&source, PROGRAM).unwrap();
    let include = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../include");
    let compiled = Command::new(compiler)
        .args([standard, "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-I"])
        .arg(include)
        .arg(&source)
        .arg("-o")
        .arg(&program)
        .output()
        .unwrap();
    assert!(compiled.status.success(), "{compiler}: {}", String::from_utf8_lossy(&compiled.stderr));
    let ran = Command::new(&program).output().unwrap();
    assert!(ran.status.success(), "{ran:?}");
    String::from_utf8(ran.stdout).unwrap()
}

/// The same lines from the types of this crate.
fn expected() -> String {
    let mut lines = Vec::new();
    let (frame, scene) = (FrameHeader::default(), SceneHeader::default());
    macro_rules! field {
        ($name:literal, $value:ident, $header:ident, $field:ident) => {
            let bytes = size_of_val(&$value.$field);
            lines.push(format!("{} {} {} {bytes}", $name, stringify!($field), offset_of!($header, $field)));
        };
    }
    field!("samsod_frame_header", frame, FrameHeader, sequence);
    field!("samsod_frame_header", frame, FrameHeader, timestamp_ns);
    field!("samsod_frame_header", frame, FrameHeader, width);
    field!("samsod_frame_header", frame, FrameHeader, height);
    field!("samsod_frame_header", frame, FrameHeader, stride);
    field!("samsod_frame_header", frame, FrameHeader, pixel_format);
    field!("samsod_frame_header", frame, FrameHeader, camera);
    field!("samsod_frame_header", frame, FrameHeader, camera_frame);
    field!("samsod_frame_header", frame, FrameHeader, camera_time_ns);
    field!("samsod_scene_header", scene, SceneHeader, sequence);
    field!("samsod_scene_header", scene, SceneHeader, timestamp_ns);
    field!("samsod_scene_header", scene, SceneHeader, encoding);
    field!("samsod_scene_header", scene, SceneHeader, reserved);
    lines.push(format!("sizes {} {}", size_of::<FrameHeader>(), size_of::<SceneHeader>()));
    lines.push(format!("alignments {} {}", align_of::<FrameHeader>(), align_of::<SceneHeader>()));
    // SAFETY: the names are constants.
    let names = unsafe { (FrameHeader::type_name(), SceneHeader::type_name()) };
    lines.push(format!("names {} {}", names.0, names.1));
    lines.push(format!("limits {MAX_SIDE_PX} {MAX_STRIDE_BYTES} {SENT_EVENT}"));
    let formats = PixelFormat::ALL.map(|format| (format as u32).to_string()).join(" ");
    lines.push(format!("formats {formats}\n"));
    lines.join("\n")
}

#[test]
fn a_c_compiler_sees_the_same_layout() {
    assert_eq!(said_by("cc", "-std=c11", "c"), expected());
}

#[test]
fn a_cpp_compiler_sees_the_same_layout() {
    assert_eq!(said_by("c++", "-std=c++17", "cpp"), expected());
}
