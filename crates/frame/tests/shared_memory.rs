//! Frames and scenes through real shared memory, publisher and subscriber in one process.

#![allow(clippy::expect_used, reason = "helpers of tests fail by panicking, too")]

use std::sync::atomic::{AtomicU32, Ordering};
use std::thread;
use std::time::Duration;

use samsod_frame::{
    CameraId, FrameError, FrameHeader, FramePublisher, FrameServiceConfig, FrameSubscriber, PixelFormat, ReceiveError,
    ScenePublisher, SceneSubscriber, SendError, ServiceError,
};

/// Long enough for any machine: a test that needs it has failed.
const WATCHDOG: Duration = Duration::from_secs(30);
const NOTHING_COMES: Duration = Duration::from_millis(5);

fn config() -> FrameServiceConfig {
    static NUMBER: AtomicU32 = AtomicU32::new(0);
    let number = NUMBER.fetch_add(1, Ordering::Relaxed);
    let cell = format!("frame-test-{}-{number}", std::process::id());
    FrameServiceConfig { max_frame_bytes: 4096, ..FrameServiceConfig::for_cell(cell) }
}

fn pair(config: &FrameServiceConfig) -> (FramePublisher, FrameSubscriber) {
    let subscriber = FrameSubscriber::open(config).expect("subscriber");
    let publisher = FramePublisher::open(config, CameraId::new("left").expect("short")).expect("publisher");
    (publisher, subscriber)
}

fn send(publisher: &mut FramePublisher, width: u32, height: u32, stride: u32, format: PixelFormat, bytes: &[u8]) {
    let mut loan = publisher.loan_with_stride(width, height, format, stride).expect("loan");
    loan.pixels().copy_from_slice(bytes);
    loan.send().expect("send");
}

#[test]
fn every_format_arrives_as_rgb() {
    // A 4 x 3 picture: red, green, blue and black columns of falling brightness; rows padded by one byte.
    let columns = [[240, 0, 0], [0, 180, 0], [0, 0, 120], [0, 0, 0]];
    let expected: Vec<u8> = columns.as_flattened().repeat(3);
    let pad = |rows: Vec<Vec<u8>>| rows.into_iter().flat_map(|r| [r, vec![0xee]].concat()).collect::<Vec<u8>>();
    let bgr: Vec<u8> = columns.iter().flat_map(|[r, g, b]| [*b, *g, *r]).collect();

    let config = config();
    let (mut publisher, mut subscriber) = pair(&config);
    let mut scratch = Vec::new();
    let mut arrives = |stride: u32, format: PixelFormat, bytes: &[u8], expected: &[u8]| {
        send(&mut publisher, 4, 3, stride, format, bytes);
        let frame = subscriber.wait(WATCHDOG).expect("accepted").expect("sent");
        assert_eq!(frame.camera(), "left");
        assert_eq!((frame.layout().width(), frame.layout().height()), (4, 3));
        assert_eq!(frame.layout().format(), format);
        assert_eq!(frame.bytes().as_ptr() as usize % 8, 0, "payload starts at a multiple of 8");
        assert!(frame.latency().is_some());
        assert_eq!(frame.rgb(&mut scratch).expect("rgb").as_raw(), &expected, "{format}");
    };
    arrives(12, PixelFormat::Rgb8, &expected, &expected);
    arrives(13, PixelFormat::Rgb8, &pad(vec![columns.as_flattened().to_vec(); 3]), &expected);
    arrives(12, PixelFormat::Bgr8, &bgr.repeat(3), &expected);
    arrives(13, PixelFormat::Bgr8, &pad(vec![bgr; 3]), &expected);
    let grey = [10, 20, 30, 40, 50, 60, 70, 80, 90, 100, 110, 120];
    let spread: Vec<u8> = grey.iter().flat_map(|g| [*g; 3]).collect();
    arrives(4, PixelFormat::Mono8, &grey, &spread);
    arrives(5, PixelFormat::Mono8, &pad(grey.chunks(4).map(<[u8]>::to_vec).collect()), &spread);
    #[rustfmt::skip]
    let bayer = [
        10, 35, 60,   20, 20, 60,   30, 43, 70,   30, 40, 80,
        50, 50, 60,   60, 60, 60,   70, 70, 70,   70, 77, 80,
        90, 75, 60,  100, 100, 60, 110, 97, 70,  110, 120, 80,
    ];
    arrives(4, PixelFormat::BayerRg8, &grey, &bayer);
    arrives(5, PixelFormat::BayerRg8, &pad(grey.chunks(4).map(<[u8]>::to_vec).collect()), &bayer);
    // The same mosaic seen by other cameras: a red field, of which each format has another pixel in four.
    let red = [200, 0, 0].repeat(12);
    let rows = |even: [u8; 4], odd: [u8; 4]| [even, odd, even].concat();
    arrives(4, PixelFormat::BayerGr8, &rows([0, 200, 0, 200], [0; 4]), &red);
    arrives(4, PixelFormat::BayerGb8, &rows([0; 4], [200, 0, 200, 0]), &red);
    arrives(4, PixelFormat::BayerBg8, &rows([0; 4], [0, 200, 0, 200]), &red);
}

#[test]
fn packed_rgb_is_read_where_it_lies() {
    let config = config();
    let (mut publisher, mut subscriber) = pair(&config);
    send(&mut publisher, 2, 1, 6, PixelFormat::Rgb8, &[1, 2, 3, 4, 5, 6]);
    let frame = subscriber.wait(WATCHDOG).unwrap().unwrap();
    let mut scratch = Vec::new();
    assert_eq!(frame.rgb(&mut scratch).unwrap().as_raw().as_ptr(), frame.bytes().as_ptr());
}

#[test]
fn the_latest_frame_wins_and_the_others_are_counted() {
    let config = config();
    let (mut publisher, mut subscriber) = pair(&config);
    for grey in 0..10 {
        send(&mut publisher, 1, 1, 1, PixelFormat::Mono8, &[grey]);
    }
    let frame = subscriber.wait(WATCHDOG).unwrap().unwrap();
    assert_eq!((frame.sequence(), frame.bytes()[0]), (9, 9));
    assert!(frame.was_waiting());
    assert!(frame.is_from_new_publisher());
    assert!(subscriber.wait(NOTHING_COMES).unwrap().is_none());
    for grey in 10..13 {
        send(&mut publisher, 1, 1, 1, PixelFormat::Mono8, &[grey]);
    }
    // The first frame is still held: its slot must not be overwritten.
    assert_eq!(subscriber.wait(WATCHDOG).unwrap().unwrap().bytes()[0], 12);
    assert_eq!(frame.bytes()[0], 9);
    let counts = subscriber.counts();
    assert_eq!((counts.received, counts.dropped, counts.publishers), (2, 11, 1));
    assert_eq!(counts.received + counts.dropped, publisher.sent());
}

#[test]
fn a_publisher_can_be_exchanged() {
    let config = config();
    let (mut first, mut subscriber) = pair(&config);
    send(&mut first, 1, 1, 1, PixelFormat::Mono8, &[1]);
    let one = subscriber.wait(WATCHDOG).unwrap().unwrap();
    let mut second = FramePublisher::open(&config, CameraId::default()).unwrap();
    let third = FramePublisher::open(&config, CameraId::default());
    assert!(matches!(third, Err(ServiceError::Full { role: "publisher", limit: 2, .. })), "{third:?}");
    drop(first);
    send(&mut second, 1, 1, 1, PixelFormat::Mono8, &[2]);
    let two = subscriber.wait(WATCHDOG).unwrap().unwrap();
    assert!(two.is_from_new_publisher());
    assert_ne!(one.publisher(), two.publisher());
    assert_eq!(subscriber.counts().publishers, 2);
    assert_eq!(subscriber.counts().dropped, 0);
    FramePublisher::open(&config, CameraId::default()).expect("its place is free again");
}

#[test]
fn a_late_subscriber_misses_nothing_it_could_not_have_had() {
    let config = config();
    let mut publisher = FramePublisher::open(&config, CameraId::default()).unwrap();
    assert_eq!(publisher.subscribers(), 0);
    for _ in 0..5 {
        publisher.loan(1, 1, PixelFormat::Mono8).unwrap().send().unwrap();
    }
    let mut subscriber = FrameSubscriber::open(&config).unwrap();
    assert_eq!(publisher.subscribers(), 1);
    publisher.loan(1, 1, PixelFormat::Mono8).unwrap().send().unwrap();
    assert_eq!(subscriber.wait(WATCHDOG).unwrap().unwrap().sequence(), 5);
    assert_eq!(subscriber.counts().dropped, 0);
}

#[test]
fn a_waiting_subscriber_is_woken() {
    let config = config();
    let (mut publisher, mut subscriber) = pair(&config);
    thread::scope(|scope| {
        let (asleep, is_asleep) = std::sync::mpsc::channel();
        let waiting = scope.spawn(move || {
            assert!(subscriber.wait(NOTHING_COMES).unwrap().is_none());
            asleep.send(()).unwrap();
            // Beyond what the clock can tell: for ever.
            subscriber.wait(Duration::MAX).unwrap().map(|frame| frame.sequence())
        });
        is_asleep.recv().unwrap();
        publisher.loan(1, 1, PixelFormat::Mono8).unwrap().send().unwrap();
        assert_eq!(waiting.join().unwrap(), Some(0));
    });
}

#[test]
fn a_header_that_lies_is_refused_and_the_next_frame_accepted() {
    let config = config();
    let (mut publisher, mut subscriber) = pair(&config);
    let lie = FrameHeader { width: 640, height: 480, stride: 1920, pixel_format: 1, ..FrameHeader::default() };
    publisher.loan_raw(lie, 100).unwrap().send().unwrap();
    let refused = subscriber.wait(WATCHDOG).unwrap_err();
    let ReceiveError::Rejected { sequence: 0, source: FrameError::Payload { len: 100, needed: 921_600, .. } } = refused
    else {
        panic!("{refused}");
    };
    publisher.loan_raw(FrameHeader { pixel_format: 99, ..lie }, 0).unwrap().send().unwrap();
    let refused = subscriber.wait(WATCHDOG).unwrap_err().to_string();
    assert!(refused.starts_with("frame 1 rejected: pixel format 99 is unknown"), "{refused}");
    send(&mut publisher, 1, 1, 1, PixelFormat::Mono8, &[5]);
    assert_eq!(subscriber.wait(WATCHDOG).unwrap().unwrap().bytes(), [5]);
    let counts = subscriber.counts();
    assert_eq!((counts.received, counts.rejected, counts.dropped), (1, 2, 0));
}

#[test]
fn a_bad_frame_costs_no_good_one_that_waits_with_it() {
    let config = FrameServiceConfig { buffer_frames: 4, ..config() };
    let (mut publisher, mut subscriber) = pair(&config);
    let lie = FrameHeader { width: 640, height: 480, stride: 1920, pixel_format: 1, ..FrameHeader::default() };
    publisher.loan_raw(lie, 100).unwrap().send().unwrap();
    send(&mut publisher, 1, 1, 1, PixelFormat::Mono8, &[1]);
    send(&mut publisher, 1, 1, 1, PixelFormat::Mono8, &[2]);
    publisher.loan_raw(lie, 100).unwrap().send().unwrap();
    let held = subscriber.wait(WATCHDOG).unwrap().unwrap();
    assert_eq!((held.sequence(), held.bytes()), (2, &[2][..]));
    assert!(subscriber.wait(NOTHING_COMES).unwrap().is_none(), "the bad ones are done with");
    let counts = subscriber.counts();
    assert_eq!((counts.received, counts.rejected, counts.dropped), (1, 2, 1));
    // Only bad ones: the last of them is named, all are counted.
    publisher.loan_raw(lie, 100).unwrap().send().unwrap();
    publisher.loan_raw(lie, 100).unwrap().send().unwrap();
    let refused = subscriber.wait(WATCHDOG).unwrap_err();
    assert!(matches!(refused, ReceiveError::Rejected { sequence: 5, .. }), "{refused}");
    // A caller that holds all frames but one still gets the latest.
    for grey in 6..9 {
        send(&mut publisher, 1, 1, 1, PixelFormat::Mono8, &[grey]);
    }
    assert_eq!(subscriber.wait(WATCHDOG).unwrap().unwrap().bytes(), [8]);
    let counts = subscriber.counts();
    assert_eq!((counts.received, counts.rejected, counts.dropped), (2, 4, 3));
    assert_eq!(counts.received + counts.rejected + counts.dropped, publisher.sent());
}

#[test]
fn a_publisher_refuses_what_no_subscriber_would_accept() {
    let config = config();
    let mut publisher = FramePublisher::open(&config, CameraId::default()).unwrap();
    let empty = publisher.loan(0, 1, PixelFormat::Rgb8).unwrap_err();
    assert!(matches!(empty, SendError::Frame(FrameError::Side { side: "width", value: 0, .. })), "{empty}");
    let large = publisher.loan(100, 100, PixelFormat::Rgb8).unwrap_err();
    assert_eq!(large.to_string(), "30000 bytes do not fit into a slot of 4096 bytes; raise max_frame_bytes");
    let huge = publisher.loan(u32::MAX, 1, PixelFormat::Rgb8).unwrap_err();
    assert!(matches!(huge, SendError::Frame(FrameError::Side { .. })), "{huge}");
}

#[test]
fn holding_too_many_frames_is_an_error_that_says_so() {
    let config = config();
    let (mut publisher, mut subscriber) = pair(&config);
    let mut held = Vec::new();
    for _ in 0..config.borrowed_frames {
        publisher.loan(1, 1, PixelFormat::Mono8).unwrap().send().unwrap();
        held.push(subscriber.wait(WATCHDOG).unwrap().unwrap());
    }
    publisher.loan(1, 1, PixelFormat::Mono8).unwrap().send().unwrap();
    assert_eq!(subscriber.wait(WATCHDOG).unwrap_err(), ReceiveError::TooManyHeld { held: 2 });
    held.clear();
    assert!(subscriber.wait(WATCHDOG).unwrap().is_some());
}

#[test]
fn places_for_subscribers_are_limited() {
    let config = FrameServiceConfig { max_subscribers: 1, ..config() };
    let _first = FrameSubscriber::open(&config).unwrap();
    let second = FrameSubscriber::open(&config).unwrap_err();
    assert!(matches!(second, ServiceError::Full { role: "subscriber", limit: 1, .. }), "{second}");
}

#[test]
fn configurations_that_are_refused() {
    let refusal = |config: FrameServiceConfig| FrameSubscriber::open(&config).unwrap_err().to_string();
    for cell in ["", "a/b", "a b", "..", &"x".repeat(65)] {
        assert!(refusal(FrameServiceConfig::for_cell(cell)).contains("must be 1 to 64 of"));
    }
    let refused = refusal(FrameServiceConfig { buffer_frames: 0, ..config() });
    assert_eq!(refused, "buffer_frames is 0; 1 to 64 are allowed");
    let refused = refusal(FrameServiceConfig { root_path: Some("relative".into()), ..config() });
    assert_eq!(refused, "root_path relative: it must be absolute");
    let refused = refusal(FrameServiceConfig { root_path: Some(format!("/{}", "x".repeat(40)).into()), ..config() });
    assert!(refused.ends_with("it has 41 bytes, at most 40 are allowed"), "{refused}");
}

#[test]
fn participants_under_different_roots_do_not_meet() {
    let root = std::path::PathBuf::from(format!("/tmp/samsod-root-test-{:<016}", std::process::id()));
    assert!(root.as_os_str().len() <= FrameServiceConfig::MAX_ROOT_PATH);
    let elsewhere = config();
    let config = FrameServiceConfig { root_path: Some(root.clone()), ..elsewhere.clone() };
    let (mut publisher, mut subscriber) = pair(&config);
    let mut stranger = FrameSubscriber::open(&elsewhere).unwrap();
    publisher.loan(1, 1, PixelFormat::Mono8).unwrap().send().unwrap();
    assert!(subscriber.wait(WATCHDOG).unwrap().is_some());
    assert!(stranger.wait(NOTHING_COMES).unwrap().is_none());
    assert!(root.join("services").is_dir());
    drop((publisher, subscriber));
    std::fs::remove_dir_all(&root).unwrap();
}

#[test]
fn scenes_arrive_in_order() {
    let config = config();
    let mut reader = SceneSubscriber::open(&config).unwrap();
    let mut writer = ScenePublisher::open(&config).unwrap();
    assert_eq!(writer.send(3, 33, br#"{"regions":[]}"#).unwrap(), 1);
    writer.send(4, 44, b"{}").unwrap();
    let scene = reader.wait(WATCHDOG).unwrap().unwrap();
    let header = scene.header();
    assert_eq!((header.sequence, header.timestamp_ns, header.encoding), (3, 33, 1));
    assert_eq!(scene.bytes(), br#"{"regions":[]}"#);
    assert_eq!(reader.wait(Duration::MAX).unwrap().unwrap().header().sequence, 4);
    assert!(reader.wait(NOTHING_COMES).unwrap().is_none());
    let large = vec![b' '; config.max_scene_bytes + 1];
    assert!(matches!(writer.send(5, 55, &large), Err(SendError::TooLarge { key: "max_scene_bytes", .. })));
}

#[test]
fn slots_are_filled_by_others_and_sent_in_any_order() {
    let config = config();
    let mut subscriber = FrameSubscriber::open(&config).unwrap();
    let mut publisher = FramePublisher::open_with_slots(&config, CameraId::new("left").unwrap(), 2).unwrap();
    let mut first = publisher.take_slot(12).unwrap();
    let mut second = publisher.take_slot(12).unwrap();
    assert!(matches!(publisher.take_slot(12), Err(SendError::Transport { .. })), "no third one");
    let addresses = [first.as_mut_ptr() as usize, second.as_mut_ptr() as usize];
    // As a driver does: from another thread, at an address.
    let filler = thread::spawn(move || {
        for (address, value) in addresses.into_iter().zip([1_u8, 2]) {
            // SAFETY: the slots are held until this thread has ended, and nobody else looks at them.
            unsafe { std::ptr::write_bytes(address as *mut u8, value, 12) };
        }
    });
    filler.join().unwrap();
    let header =
        FrameHeader { width: 4, height: 3, stride: 4, pixel_format: 3, camera_frame: 77, ..Default::default() };
    publisher.send_slot(second, FrameHeader { camera_time_ns: 5_000, ..header }).unwrap();
    let frame = subscriber.wait(WATCHDOG).unwrap().unwrap();
    assert_eq!((frame.bytes(), frame.camera(), frame.sequence()), (&[2_u8; 12][..], "left", 0));
    assert_eq!((frame.header().camera_frame, frame.header().camera_time_ns), (77, 5_000));
    assert!(frame.timestamp_ns() > 0);
    publisher.send_slot(first, header).unwrap();
    let frame = subscriber.wait(WATCHDOG).unwrap().unwrap();
    assert_eq!((frame.bytes(), frame.sequence()), (&[1_u8; 12][..], 1));

    let slot = publisher.take_slot(12).unwrap();
    let refused = publisher.send_slot(slot, FrameHeader { height: 4, ..header });
    assert!(matches!(refused, Err(SendError::Frame(FrameError::Payload { len: 12, needed: 16, .. }))), "{refused:?}");
    let mut other = FramePublisher::open(&config, CameraId::default()).unwrap();
    let slot = publisher.take_slot(12).unwrap();
    assert_eq!(other.send_slot(slot, header), Err(SendError::ForeignSlot));
    assert!(matches!(publisher.take_slot(4097), Err(SendError::TooLarge { bytes: 4097, max: 4096, .. })));
    let none = FramePublisher::open_with_slots(&config, CameraId::default(), 0);
    assert!(matches!(none, Err(ServiceError::Setting { key: "slots", value: 0, .. })), "{none:?}");
    let outlives = publisher.take_slot(12).unwrap();
    drop(publisher);
    drop(outlives);
}
