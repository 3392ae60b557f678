//! The live view as a viewer sees it: what comes over the WebSocket is what stands in the recording; a viewer that does not read is
//! not waited for; and the layout that is shipped fits.

#![allow(clippy::expect_used, clippy::panic, reason = "helpers of tests fail by panicking")]

mod support;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::net::{TcpListener, TcpStream};
use std::path::Path;

use serde_json::{Value, json};
use support::{Process, TestCell, WATCHDOG, messages, send};
use tungstenite::client::IntoClientRequest;
use tungstenite::protocol::WebSocket;

const LIVE: (&str, &str) = ("foxglove", "listen = \"127.0.0.1:0\"");
const NO_ROBOT: (&str, &str) = ("robot", "controller = \"none\"");
/// What every frame has on the table of a test.
const OF_FRAME: [&str; 10] = [
    "/camera/image",
    "/segment/labels",
    "/saliency",
    "/regions",
    "/detections",
    "/masks",
    "/outlines",
    "/places",
    "/scene",
    "/stage/timings",
];

/// A viewer, by the protocol of Foxglove's.
struct Viewer {
    socket: WebSocket<TcpStream>,
    /// Topics by the number of their subscription, which is that of their channel.
    topics: BTreeMap<u32, String>,
    channels: Vec<Value>,
    server: Value,
}

impl Viewer {
    /// Connects, and reads what is to be had until all of `topics` are.
    fn connect(daemon: &Process, topics: usize) -> Self {
        let line = daemon.wait_for_line("live view");
        let address = line.rsplit_once("address=").expect("address").1;
        let mut request = format!("ws://{address}").into_client_request().expect("request");
        request.headers_mut().insert("Sec-WebSocket-Protocol", "foxglove.sdk.v1".parse().expect("header"));
        let stream = TcpStream::connect(address).expect("connection");
        stream.set_read_timeout(Some(WATCHDOG)).expect("timeout");
        let (socket, _) = tungstenite::client(request, stream).expect("handshake");
        let mut viewer = Self { socket, topics: BTreeMap::new(), channels: Vec::new(), server: Value::Null };
        while viewer.channels.len() < topics {
            let message = viewer.socket.read().expect("message");
            if let Ok(text) = message.to_text() {
                let said: Value = serde_json::from_str(text).expect("JSON");
                match said["op"].as_str() {
                    Some("advertise") => viewer.channels.extend(said["channels"].as_array().expect("channels").clone()),
                    Some("serverInfo") => viewer.server = said,
                    _ => {}
                }
            }
        }
        viewer
    }

    fn subscribe(&mut self) {
        for channel in &self.channels {
            let id = u32::try_from(channel["id"].as_u64().expect("id")).expect("small");
            self.topics.insert(id, channel["topic"].as_str().expect("topic").to_owned());
        }
        let all: Vec<_> = self.topics.keys().map(|id| json!({"id": id, "channelId": id})).collect();
        let subscribe = json!({"op": "subscribe", "subscriptions": all});
        self.socket.send(subscribe.to_string().into()).expect("subscription");
    }

    /// The next message on a topic: its name, time and bytes.
    fn next(&mut self) -> (String, u64, Vec<u8>) {
        loop {
            let message = self.socket.read().expect("message");
            // 1, subscription, time, bytes: little endian.
            if message.is_binary()
                && let Some((1, rest)) = message.into_data().split_first()
                && let Some((id, rest)) = rest.split_first_chunk()
                && let Some((time, data)) = rest.split_first_chunk()
            {
                let topic = self.topics.get(&u32::from_le_bytes(*id)).expect("subscribed").clone();
                return (topic, u64::from_le_bytes(*time), data.to_vec());
            }
        }
    }
}

#[test]
fn a_viewer_sees_what_stands_in_the_recording() {
    let cell = TestCell::new();
    let daemon = cell.spawn_daemon(&cell.config(&[LIVE, NO_ROBOT]), &[]);
    let mut viewer = Viewer::connect(&daemon, 19);
    daemon.wait_for_line("ready, waiting for frames");
    assert_eq!(viewer.server["name"], "samsod test-cell");
    // Nobody may write through it.
    assert_eq!(viewer.server["capabilities"], json!([]));
    viewer.subscribe();

    // The subscription is on its way while the first frames are seen.
    let mut publisher = cell.publisher();
    let mut live = Vec::new();
    let mut whole = 0;
    for number in 0.. {
        send(&mut publisher, number);
        let mut of_frame = BTreeSet::new();
        // The timings are the last of a frame.
        while !of_frame.contains("/stage/timings") {
            let message = viewer.next();
            of_frame.insert(message.0.clone());
            live.push(message);
        }
        whole += usize::from(OF_FRAME.iter().all(|topic| of_frame.contains(*topic)));
        if whole == 3 {
            break;
        }
    }
    daemon.terminate().assert_success();

    let recording = cell.recordings().pop().expect("recording");
    let bytes = fs::read(&recording).expect("recording");
    let mut recorded = BTreeSet::new();
    let mut channels = BTreeMap::new();
    for message in mcap::MessageStream::new(&bytes).expect("MCAP") {
        let message = message.expect("message");
        let (topic, schema) = (message.channel.topic.clone(), message.channel.schema.as_ref().expect("schema"));
        channels.insert(topic.clone(), (message.channel.message_encoding.clone(), schema.name.clone()));
        recorded.insert((topic, message.log_time, message.data.into_owned()));
    }
    for message in &live {
        assert!(recorded.contains(message), "{} at {} is not in the recording", message.0, message.1);
    }
    for (topic, (encoding, schema)) in channels {
        let channel = viewer.channels.iter().find(|channel| channel["topic"] == topic.as_str());
        let channel = channel.unwrap_or_else(|| panic!("{topic} is not advertised"));
        assert_eq!((&channel["encoding"], &channel["schemaName"]), (&json!(encoding), &json!(schema)), "{topic}");
    }
}

#[test]
fn a_viewer_that_does_not_read_is_not_waited_for() {
    let cell = TestCell::new();
    // Raw images: what lies in the sockets is soon less than what is sent.
    let config = cell.config(&[LIVE, NO_ROBOT, ("recording", "image_encoding = \"raw\"")]);
    let daemon = cell.spawn_daemon(&config, &[]);
    let mut viewer = Viewer::connect(&daemon, 19);
    daemon.wait_for_line("ready, waiting for frames");
    viewer.subscribe();
    let (mut publisher, mut scenes) = (cell.publisher(), cell.scenes());
    const FRAMES: u32 = 1000;
    for number in 0..FRAMES {
        send(&mut publisher, number);
        scenes.of_frame(number.into());
    }
    let ended = daemon.terminate();
    ended.assert_success();
    let recorded = messages(&cell.recordings().pop().expect("recording"));
    let images = recorded.iter().filter(|(topic, _)| topic == "/camera/image").count() as u64;
    // The recorder waits for no viewer, and the disk of a test machine may be slow.
    let (_, counts) = ended.stdout.split_once("frames (").expect("counts");
    let dropped: u64 = counts.split_whitespace().next().and_then(|n| n.parse().ok()).expect("number");
    assert_eq!(images + dropped, u64::from(FRAMES));
    assert!(images > 0);
}

#[test]
fn a_port_that_is_taken_is_named() {
    let cell = TestCell::new();
    let taken = TcpListener::bind("127.0.0.1:0").expect("port");
    let address = taken.local_addr().expect("address");
    let daemon = cell.spawn_daemon(&cell.config(&[("foxglove", &format!("listen = \"{address}\""))]), &[]);
    let ended = daemon.wait();
    assert!(!ended.status.success());
    assert!(
        ended.stderr.contains(&format!("cannot serve the live view on {address}"))
            && ended.stderr.contains("[foxglove] listen"),
        "{}",
        ended.stderr
    );
}

/// Every text of a JSON value, keys too.
fn texts<'a>(value: &'a Value, into: &mut BTreeSet<&'a str>) {
    match value {
        Value::String(text) => {
            into.insert(text);
        }
        Value::Array(values) => values.iter().for_each(|value| texts(value, into)),
        Value::Object(fields) => fields.iter().for_each(|(key, value)| {
            into.insert(key);
            texts(value, into);
        }),
        _ => {}
    }
}

#[test]
fn the_layout_shows_topics_and_fields_that_there_are() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/foxglove-layout.json");
    let layout: Value = serde_json::from_str(&fs::read_to_string(path).expect("layout")).expect("JSON");
    let mut named = BTreeSet::new();
    texts(&layout, &mut named);
    let paths: Vec<&str> = named.into_iter().filter(|text| text.starts_with('/')).collect();
    assert!(
        ["/camera/image", "/detections", "/scene", "/log"].iter().filter(|topic| paths.contains(topic)).count() >= 3
    );

    let cell = TestCell::new();
    let daemon = cell.spawn_daemon(&cell.config(&[LIVE]), &[]);
    let viewer = Viewer::connect(&daemon, 19);
    for path in paths {
        let (topic, field) = path.split_once('.').unwrap_or((path, ""));
        let channel = viewer.channels.iter().find(|channel| channel["topic"] == topic);
        let channel = channel.unwrap_or_else(|| panic!("{path}: there is no such topic"));
        if !field.is_empty() {
            let schema = channel["schema"].as_str().expect("schema");
            let schema: Value = serde_json::from_str(schema).unwrap_or_else(|e| panic!("{path}: {e}"));
            assert!(schema["properties"].get(field).is_some(), "{path}: there is no such field");
        }
    }
}
