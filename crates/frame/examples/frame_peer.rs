//! The other side of a frame client in another language: says what it receives, or sends what is known, and prints the layout of the
//! headers. The tests of the Python package run it.
//!
//! usage: `frame_peer layout` | `frame_peer receive CELL ROOT FRAMES` | `frame_peer send CELL ROOT FRAMES` |
//! `frame_peer send-scenes CELL ROOT SCENES`

#![allow(clippy::unwrap_used, reason = "a wrong call may end it")]

use std::env;
use std::io::{self, BufRead, Write};
use std::mem::{offset_of, size_of};
use std::time::Duration;

use samsod_frame::{
    CameraId, FrameHeader, FramePublisher, FrameServiceConfig, FrameSubscriber, PixelFormat, SceneHeader,
    ScenePublisher,
};

fn main() {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match words[..] {
        ["layout"] => layout(),
        ["receive", cell, root, count] => receive(&service(cell, root), count.parse().unwrap()),
        ["send", cell, root, count] => send(&service(cell, root), count.parse().unwrap()),
        ["send-scenes", cell, root, count] => send_scenes(&service(cell, root), count.parse().unwrap()),
        _ => {
            eprintln!("frame_peer: {words:?}; layout, receive, send and send-scenes are allowed");
            std::process::exit(2);
        }
    }
}

fn service(cell: &str, root: &str) -> FrameServiceConfig {
    FrameServiceConfig { root_path: Some(root.into()), max_frame_bytes: 1 << 16, ..FrameServiceConfig::for_cell(cell) }
}

/// One line for each field: structure, field, offset, bytes.
fn layout() {
    macro_rules! field {
        ($header:ident, $field:ident) => {
            let value = $header::default();
            let bytes = size_of_val(&value.$field);
            println!("{} {} {} {bytes}", stringify!($header), stringify!($field), offset_of!($header, $field));
        };
    }
    field!(FrameHeader, sequence);
    field!(FrameHeader, timestamp_ns);
    field!(FrameHeader, width);
    field!(FrameHeader, height);
    field!(FrameHeader, stride);
    field!(FrameHeader, pixel_format);
    field!(FrameHeader, camera);
    field!(FrameHeader, camera_frame);
    field!(FrameHeader, camera_time_ns);
    println!("FrameHeader - - {}", size_of::<FrameHeader>());
    field!(SceneHeader, sequence);
    field!(SceneHeader, timestamp_ns);
    field!(SceneHeader, encoding);
    field!(SceneHeader, reserved);
    println!("SceneHeader - - {}", size_of::<SceneHeader>());
    for format in PixelFormat::ALL {
        println!("PixelFormat {format} {} {}", format as u32, format.bytes_per_pixel());
    }
}

/// One line for each frame: its header, and its first pixel and last pixel as RGB.
fn receive(service: &FrameServiceConfig, count: u64) {
    let mut subscriber = FrameSubscriber::open(service).unwrap();
    say("ready");
    let mut scratch = Vec::new();
    for _ in 0..count {
        let Some(frame) = subscriber.wait(Duration::from_secs(60)).unwrap() else { std::process::exit(1) };
        let header = frame.header();
        let rgb = frame.rgb(&mut scratch).unwrap();
        let (first, last) = (&rgb.as_raw()[..3], &rgb.as_raw()[rgb.as_raw().len() - 3..]);
        say(&format!(
            "{} {} {} {} {} {} {:?} {} {} {first:?} {last:?}",
            header.sequence,
            header.timestamp_ns,
            header.width,
            header.height,
            header.stride,
            frame.layout().format(),
            frame.camera(),
            header.camera_frame,
            header.camera_time_ns
        ));
    }
}

/// A frame for each line that comes in: 6 x 4 pixels of rgb8 in rows of 20 bytes, each the number of its row, column and frame.
fn send(service: &FrameServiceConfig, count: u8) {
    let mut publisher = FramePublisher::open(service, CameraId::new("peer").unwrap()).unwrap();
    say("ready");
    let mut lines = io::stdin().lock().lines();
    for number in 0..count {
        lines.next().unwrap().unwrap();
        let mut loan = publisher.loan_with_stride(6, 4, PixelFormat::Rgb8, 20).unwrap();
        for (y, row) in loan.pixels().chunks_mut(20).enumerate() {
            row.fill(0xee);
            for (x, pixel) in row[..18].chunks_exact_mut(3).enumerate() {
                pixel.copy_from_slice(&[y as u8, x as u8, number]);
            }
        }
        loan.set_timestamp_ns(1_000 + u64::from(number));
        loan.set_camera_frame(100 + u64::from(number), 7);
        loan.send().unwrap();
        say("sent");
    }
    // A subscriber maps the memory when it wakes for its first frame.
    lines.next();
}

/// A scene for each line that comes in.
fn send_scenes(service: &FrameServiceConfig, count: u64) {
    let mut publisher = ScenePublisher::open(service).unwrap();
    say("ready");
    let mut lines = io::stdin().lock().lines();
    for number in 0..count {
        lines.next().unwrap().unwrap();
        // Of a scene, what readers of poses look at.
        let json = format!(
            "{{\"sequence\":{number},\"detections\":[{{\"name\":\"Ölpumpe\",\"world\":{{\"x_mm\":250,\"y_mm\":-40,\"z_mm\":0,\
             \"yaw_deg\":90}}}},{{\"name\":null,\"world\":null}}]}}"
        );
        publisher.send(number, 1_000 + number, json.as_bytes()).unwrap();
        say("sent");
    }
    lines.next();
}

fn say(line: &str) {
    println!("{line}");
    io::stdout().flush().unwrap();
}
