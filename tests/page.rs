//! The operator's page as a program asks for it: what is seen, who may change something, and viewers that stall. The page
//! itself, in a browser, is tested in crates/python/tests.

#![allow(clippy::expect_used, clippy::panic, reason = "helpers of tests fail by panicking")]

mod support;

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::ops::Deref;
use std::os::unix::fs::PermissionsExt;

use support::{HTTP, Process, TestCell, WATCHDOG, send, wait_for};

/// A daemon with a page.
struct Served {
    daemon: Process,
    client: Client,
}

impl Deref for Served {
    type Target = Client;

    fn deref(&self) -> &Client {
        &self.client
    }
}

/// Whoever asks it.
struct Client {
    address: String,
    token: String,
}

#[derive(Debug)]
struct Answer {
    code: u16,
    head: String,
    body: Vec<u8>,
}

impl Answer {
    fn json(&self) -> serde_json::Value {
        serde_json::from_slice(&self.body).unwrap_or_else(|e| panic!("{e}: {self:?}"))
    }

    /// The number of the frame that a picture is of.
    fn frame(&self) -> u64 {
        let line = self.head.lines().find_map(|line| line.strip_prefix("samsod-frame: ")).expect("header");
        line.trim().parse().expect("number")
    }
}

impl Served {
    fn start(cell: &TestCell, more: &[(&str, &str)]) -> Self {
        let daemon = cell.spawn_daemon(&cell.config(more), &[]);
        let address =
            daemon.wait_for_line("page, health and metrics").rsplit_once("address=").expect("address").1.to_owned();
        let file = daemon.wait_for_line("the operator's token").rsplit_once("file=").expect("file").1.to_owned();
        daemon.wait_for_line("ready, waiting for frames");
        let token = fs::read_to_string(file).expect("token").trim().to_owned();
        Self { daemon, client: Client { address, token } }
    }
}

impl Client {
    fn send(&self, method: &str, path: &str, headers: &[(&str, &str)], body: &str) -> Answer {
        let mut stream = TcpStream::connect(&self.address).expect("connection");
        stream.set_read_timeout(Some(WATCHDOG)).expect("timeout");
        let mut text = format!("{method} {path} HTTP/1.1\r\nConnection: close\r\nContent-Length: {}\r\n", body.len());
        if headers.iter().all(|(name, _)| *name != "Host") {
            text += &format!("Host: {}\r\n", self.address);
        }
        headers.iter().for_each(|(name, value)| text += &format!("{name}: {value}\r\n"));
        write!(stream, "{text}\r\n{body}").expect("request");
        let mut bytes = Vec::new();
        stream.read_to_end(&mut bytes).expect("answer");
        let end = bytes.windows(4).position(|window| window == b"\r\n\r\n").expect("head");
        let head = String::from_utf8_lossy(&bytes[..end]).into_owned();
        let code = head.split_whitespace().nth(1).expect("code").parse().expect("number");
        Answer { code, head, body: bytes[end + 4..].to_vec() }
    }

    fn get(&self, path: &str) -> Answer {
        self.send("GET", path, &[], "")
    }

    fn change(&self, method: &str, path: &str, body: &str) -> Answer {
        self.send(method, path, &[("Authorization", &format!("Bearer {}", self.token))], body)
    }

    fn status(&self) -> serde_json::Value {
        self.get("/api/v1/status").json()
    }

    /// The scene of the client's frame, once it is the newest.
    fn scene_of(&self, sequence: u64) -> serde_json::Value {
        wait_for("scene", || {
            let answer = self.get("/api/v1/scene");
            (answer.code == 200).then(|| answer.json()).filter(|scene| scene["sequence"] == sequence)
        })
    }

    /// A viewer of events.
    fn watch(&self) -> BufReader<TcpStream> {
        let mut stream = TcpStream::connect(&self.address).expect("connection");
        stream.set_read_timeout(Some(WATCHDOG)).expect("timeout");
        write!(stream, "GET /api/v1/events HTTP/1.1\r\nHost: {}\r\n\r\n", self.address).expect("request");
        BufReader::new(stream)
    }
}

/// Reads events until the scene of a frame of the client.
fn read_until_scene(viewer: &mut BufReader<TcpStream>, sequence: u64) -> serde_json::Value {
    loop {
        let mut line = String::new();
        assert!(viewer.read_line(&mut line).expect("events") > 0, "the events have ended");
        let scene = line.strip_prefix("data: ").and_then(|text| serde_json::from_str::<serde_json::Value>(text).ok());
        if let Some(scene) = scene.filter(|scene| scene["sequence"] == sequence) {
            return scene;
        }
    }
}

#[test]
fn scene_picture_and_layers_are_of_one_frame_and_old_ones_are_told_apart_from_unknown_ones() {
    let cell = TestCell::new();
    let served = Served::start(&cell, &[HTTP]);
    assert_eq!(served.get("/api/v1/scene").code, 503, "nothing was seen yet");
    let mut publisher = cell.publisher();
    send(&mut publisher, 3);
    let scene = served.scene_of(0);
    let frame = scene["frame"].as_u64().unwrap();
    // The square of the picture: 12 x 12 px from (11, 16) on.
    let object = &scene["objects"][0];
    let [x, y] = [0, 1].map(|i| object["centroid_px"][i].as_f64().unwrap());
    assert!((x - 16.5).abs() < 1.0 && (y - 21.5).abs() < 1.0, "{object}");
    let corners = scene["drawing"]["objects"][0]["outlines_px"][0].as_array().unwrap();
    assert!((4..20).contains(&corners.len()), "few corners draw a square: {corners:?}");

    let picture = served.get(&format!("/api/v1/frame.jpg?frame={frame}"));
    assert_eq!((picture.code, picture.frame()), (200, frame));
    let picture = image::load_from_memory(&picture.body).unwrap().into_rgb8();
    assert_eq!(picture.dimensions(), (64, 48));
    let [red, green, _] = picture.get_pixel(16, 21).0;
    assert!(red > 150 && green < 90, "the square is red");
    for (layer, at_square, at_table) in [("partition", 255, 255), ("saliency", 255, 0), ("shadow", 255, 0)] {
        let answer = served.get(&format!("/api/v1/layers/{layer}.png?frame={frame}"));
        assert_eq!((answer.code, answer.frame()), (200, frame), "{layer}");
        let png = image::load_from_memory(&answer.body).unwrap().into_rgba8();
        let alpha = |x, y| png.get_pixel(x, y)[3];
        assert_eq!(png.dimensions(), (64, 48));
        assert!(alpha(16, 21).abs_diff(at_square) < 60 && alpha(60, 44).abs_diff(at_table) < 60, "{layer}");
    }
    assert_eq!(served.get("/api/v1/frame.jpg?frame=4711").code, 404);
    let wrong = served.get("/api/v1/frame.jpg?frame=-1");
    assert_eq!(wrong.code, 400, "{wrong:?}");

    // Somebody watches, so every frame is shown; the first is gone after a dozen more.
    for sequence in 1..16 {
        send(&mut publisher, sequence);
        served.scene_of(sequence.into());
    }
    let gone = served.get(&format!("/api/v1/scene?frame={frame}"));
    assert_eq!(gone.code, 410, "{gone:?}");
    // The last frame is seen by those who come later, too, and no frame need come for that.
    drop(publisher);
    let newest = served.scene_of(15);
    assert_eq!(newest["sequence"], 15);
    served.daemon.terminate().assert_success();
}

#[test]
fn what_changes_something_needs_the_token_and_hold_latches_the_robot() {
    let cell = TestCell::new();
    let served = Served::start(&cell, &[HTTP]);
    let file = cell.path("shm/samsod-test-cell.token");
    assert_eq!(fs::metadata(&file).unwrap().permissions().mode() & 0o777, 0o600);
    for (method, path, body) in [
        ("POST", "hold", ""),
        ("POST", "resume", "{\"gripper_is_empty\":true}"),
        ("POST", "new-jig", ""),
        ("POST", "inspect", ""),
        ("PUT", "region", "{}"),
        ("DELETE", "region", ""),
        ("POST", "teach/look", ""),
        ("POST", "teach", "{}"),
        ("POST", "calibration/verify", "{}"),
        ("POST", "token", ""),
    ] {
        for token in
            ["", "Bearer", "Bearer wrong", &format!("Basic {}", served.token), &format!("Bearer {}x", served.token)]
        {
            let headers = if token.is_empty() { vec![] } else { vec![("Authorization", token)] };
            let answer = served.send(method, &format!("/api/v1/{path}"), &headers, body);
            assert_eq!(answer.code, 401, "{method} {path} with {token:?}: {answer:?}");
            assert!(answer.head.to_lowercase().contains("www-authenticate: bearer"), "{answer:?}");
        }
    }
    assert_eq!(served.status()["robot"]["latched"], false, "nothing was done");
    assert_eq!(served.change("POST", "/api/v1/token", "").code, 204);
    let held = served.change("POST", "/api/v1/hold", "");
    assert_eq!((held.code, &held.json()["robot"]["latched"]), (200, &true.into()), "{held:?}");
    let wrong = served.change("POST", "/api/v1/resume", "{\"gripper\":true}");
    assert!(wrong.code == 400 && wrong.json()["error"].as_str().unwrap().contains("gripper_is_empty"), "{wrong:?}");
    let resumed = served.change("POST", "/api/v1/resume", "{\"gripper_is_empty\":false}");
    assert_eq!((resumed.code, &resumed.json()["robot"]["latched"]), (200, &false.into()), "{resumed:?}");
    let log = served.daemon.terminate();
    log.assert_success();
    assert!(!log.stderr.contains(&served.client.token), "the log names the file, not the token");
}

#[test]
fn other_hosts_and_other_origins_get_nothing_and_the_page_forbids_what_is_not_its_own() {
    let cell = TestCell::new();
    let served = Served::start(&cell, &[("http", "listen = \"127.0.0.1:0\"\nhosts = [\"cell3.example\"]")]);
    let port = served.address.rsplit_once(':').unwrap().1;
    let evil = format!("evil.example:{port}");
    for path in ["/", "/metrics", "/healthz", "/api/v1/status", "/api/v1/frame.jpg", "/elsewhere"] {
        assert_eq!(served.send("GET", path, &[("Host", &evil)], "").code, 421, "{path}");
        assert_eq!(served.send("GET", path, &[("Origin", "http://evil.example")], "").code, 403, "{path}");
    }
    let bearer = format!("Bearer {}", served.token);
    let foreign = [("Origin", "null"), ("Authorization", bearer.as_str())];
    assert_eq!(served.send("POST", "/api/v1/hold", &foreign, "").code, 403, "even with the token");
    let embedded = [("Sec-Fetch-Site", "cross-site"), ("Sec-Fetch-Mode", "no-cors")];
    assert_eq!(served.send("GET", "/api/v1/frame.jpg", &embedded, "").code, 403);
    for host in [format!("localhost:{port}"), format!("[::1]:{port}"), format!("cell3.example:{port}")] {
        assert_eq!(served.send("GET", "/", &[("Host", &host)], "").code, 200, "{host}");
    }
    let page = served.get("/");
    let head = page.head.to_lowercase();
    assert!(head.contains("content-security-policy: default-src 'none'; script-src 'self'"), "{head}");
    assert!(head.contains("frame-ancestors 'none'") && head.contains("nosniff"), "{head}");
    let own = format!("http://{}", served.address);
    assert_eq!(served.send("GET", "/api/v1/status", &[("Origin", &own)], "").code, 200);
    assert_eq!(served.get("/api/v1/elsewhere").code, 404);
    assert_eq!(served.get("/api/v1/hold").code, 405);
    served.daemon.terminate().assert_success();
}

#[test]
fn a_token_of_the_configuration_is_kept_over_starts_and_one_that_all_may_read_is_refused() {
    let cell = TestCell::new();
    let path = cell.path("token");
    fs::write(&path, "a-token-of-the-plant\n").unwrap();
    fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
    let http = [("http", "listen = \"127.0.0.1:0\"\ntoken_file = \"token\"")];
    let served = Served::start(&cell, &http);
    assert_eq!(served.token, "a-token-of-the-plant");
    assert_eq!(served.change("POST", "/api/v1/token", "").code, 204);
    served.daemon.terminate().assert_success();
    fs::set_permissions(&path, fs::Permissions::from_mode(0o644)).unwrap();
    let ended = cell.spawn_daemon(&cell.config(&http), &[]).wait();
    assert_eq!(ended.status.code(), Some(1), "{ended:?}");
    assert!(ended.stderr.contains("[http] token_file: ") && ended.stderr.contains("chmod o="), "{}", ended.stderr);
}

#[test]
fn viewers_that_stop_reading_slow_neither_vision_nor_other_viewers() {
    let cell = TestCell::new();
    let served = Served::start(&cell, &[HTTP]);
    let mut publisher = cell.publisher();
    let mut scenes = cell.scenes();
    send(&mut publisher, 0);
    scenes.of_frame(0);
    let mut viewer = served.watch();
    read_until_scene(&mut viewer, 0);
    // These ask, and never read: their sockets fill.
    let stalled: Vec<_> = (0..8).map(|_| served.watch()).collect();
    let half: Vec<_> = (0..8)
        .map(|_| {
            let mut stream = TcpStream::connect(&served.address).expect("connection");
            write!(stream, "GET /api/v1/frame.jpg HTTP/1.1\r\nHost: {}\r\n", served.address).expect("request");
            stream
        })
        .collect();
    for number in 1..200 {
        send(&mut publisher, number);
        // Every frame comes through vision, one after another.
        scenes.of_frame(number.into());
    }
    let newest = read_until_scene(&mut viewer, 199);
    assert_eq!(newest["frame"], 200, "every frame was processed: {newest}");
    let status = served.status();
    assert_eq!((&status["frames"]["processed"], &status["frames"]["dropped"]), (&200.into(), &0.into()), "{status}");
    drop((stalled, half));
    served.daemon.terminate().assert_success();
}

#[test]
fn inspect_answers_with_a_frame_that_comes_after_it_was_asked() {
    let cell = TestCell::new();
    let served = Served::start(&cell, &[HTTP]);
    let mut publisher = cell.publisher();
    let mut scenes = cell.scenes();
    send(&mut publisher, 0);
    scenes.of_frame(0);
    let client = &served.client;
    let asked = std::thread::scope(|scope| {
        let asking = scope.spawn(|| client.change("POST", "/api/v1/inspect", ""));
        let mut number = 1;
        while !asking.is_finished() {
            send(&mut publisher, number);
            scenes.of_frame(number.into());
            number += 1;
        }
        asking.join().unwrap()
    });
    assert_eq!(asked.code, 200, "{asked:?}");
    assert!(asked.json()["sequence"].as_u64().unwrap() >= 1, "not the one that was there");
    served.daemon.terminate().assert_success();
}

#[test]
fn nothing_outside_the_region_of_interest_is_picked_also_after_a_new_start() {
    let cell = TestCell::new();
    let region = |left: u32, right: u32| {
        format!("{{\"width_px\":64,\"height_px\":48,\"points_px\":[[{left},0],[{right},0],[{right},47],[{left},47]]}}")
    };
    // The middle of the square lies at (16.5, 21.5).
    let served = Served::start(&cell, &[HTTP]);
    let mut publisher = cell.publisher();
    let wrong =
        served.change("PUT", "/api/v1/region", "{\"width_px\":64,\"height_px\":48,\"points_px\":[[0,0],[9,9]]}");
    assert!(wrong.code == 400 && wrong.json()["error"].as_str().unwrap().contains("2 corners"), "{wrong:?}");
    let stored = served.change("PUT", "/api/v1/region", &region(40, 60));
    assert_eq!(stored.code, 200, "{stored:?}");
    send(&mut publisher, 3);
    let scene = served.scene_of(0);
    assert_eq!((&scene["objects"][0]["id"], &scene["best_object"]), (&0.into(), &serde_json::Value::Null), "{scene}");
    assert_eq!(scene["drawing"]["objects"][0]["inside"], false);
    drop(publisher);
    served.daemon.terminate().assert_success();

    let served = Served::start(&cell, &[HTTP]);
    assert_eq!(served.status()["region_of_interest"]["points_px"][0][0], 40.0);
    let mut publisher = cell.publisher();
    send(&mut publisher, 3);
    assert!(served.scene_of(0)["best_object"].is_null());
    assert_eq!(served.status()["robot"]["commands"]["sent"], 0);
    assert_eq!(served.change("PUT", "/api/v1/region", &region(4, 30)).code, 200);
    send(&mut publisher, 3);
    assert_eq!(served.scene_of(1)["best_object"], 0);
    // A robot that is not idle lets a frame go.
    wait_for("the robot above the part", || {
        send(&mut publisher, 3);
        served.status()["robot"]["commands"]["sent"].as_u64().filter(|sent| *sent > 0)
    });
    assert_eq!(served.change("DELETE", "/api/v1/region", "").code, 200);
    assert!(served.status()["region_of_interest"].is_null());
    served.daemon.terminate().assert_success();
    // The region is in the recording of each run.
    let runs: Vec<_> =
        cell.recordings().into_iter().filter(|path| path.extension().is_some_and(|e| e == "mcap")).collect();
    assert_eq!(runs.len(), 2);
    for run in runs {
        let log = support::messages(&run).into_iter().filter(|(topic, _)| topic == "/log");
        let told = log.filter(|(_, text)| String::from_utf8_lossy(text).contains("in the region of interest alone"));
        assert!(told.count() > 0, "{run:?}");
    }
}

#[test]
fn the_description_of_the_api_names_every_path_that_is_served() {
    let cell = TestCell::new();
    let served = Served::start(&cell, &[HTTP]);
    let description = served.get("/api/v1/openapi.json").json();
    assert_eq!(description["openapi"], "3.1.0");
    let paths = description["paths"].as_object().unwrap();
    assert!(paths.len() >= 17, "{}", paths.len());
    for (path, operations) in paths {
        for method in operations.as_object().unwrap().keys() {
            // Without a token nothing is done; what is not served is 404 or 405.
            if (path.as_str(), method.as_str()) == ("/events", "get") {
                continue;
            }
            let answer = served.send(&method.to_uppercase(), &format!("/api/v1{path}"), &[], "");
            assert!(![404, 405].contains(&answer.code), "{method} {path}: {answer:?}");
        }
    }
    served.daemon.terminate().assert_success();
}
