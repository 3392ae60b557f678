//! Real processes in shared memory of their own, for the tests of the whole system.
//!
//! Every wait is for a condition, under one watchdog deadline that only a test that has failed reaches.

#![allow(dead_code, reason = "each test program uses its part")]
#![allow(clippy::expect_used, clippy::unwrap_used, clippy::panic, reason = "helpers of tests fail by panicking")]

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{self, Receiver};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use image::{Rgb, RgbImage};
use samsod_frame::{CameraId, FramePublisher, FrameServiceConfig, PixelFormat, SceneSubscriber};
use tempfile::TempDir;

/// Deadline of a whole wait. Machines under load are slow; a test that comes here has failed.
pub(crate) const WATCHDOG: Duration = Duration::from_secs(120);
const TICK: Duration = Duration::from_millis(5);

/// Section and key with which a daemon serves over HTTP, on a port that is free.
pub(crate) const HTTP: (&str, &str) = ("http", "listen = \"127.0.0.1:0\"");

/// Where a daemon with [`HTTP`] listens, as its log says, once it is ready.
pub(crate) fn address_of(daemon: &Process) -> String {
    let line = daemon.wait_for_line("page, health and metrics");
    daemon.wait_for_line("ready, waiting for frames");
    line.rsplit_once("address=").expect("address").1.to_owned()
}

/// Status code and body of what is served there.
pub(crate) fn get(address: &str, path: &str) -> (u16, String) {
    let mut stream = TcpStream::connect(address).expect("connection");
    stream.set_read_timeout(Some(WATCHDOG)).expect("timeout");
    write!(stream, "GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n").expect("request");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("answer");
    let (head, body) = answer.split_once("\r\n\r\n").expect("head and body");
    (head.split_whitespace().nth(1).expect("code").parse().expect("number"), body.to_owned())
}

/// Waits until `condition` gives something.
pub(crate) fn wait_for<T>(what: &str, mut condition: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + WATCHDOG;
    loop {
        if let Some(value) = condition() {
            return value;
        }
        assert!(Instant::now() < deadline, "{what}: not within {WATCHDOG:?}");
        thread::sleep(TICK);
    }
}

/// A cell with a configuration, a recording folder, images and shared memory of its own.
pub(crate) struct TestCell {
    folder: TempDir,
    pub(crate) service: FrameServiceConfig,
}

impl TestCell {
    pub(crate) fn new() -> Self {
        // Directly below /tmp: the paths of sockets must be short.
        let folder = tempfile::Builder::new().prefix("samsod-").tempdir_in("/tmp").expect("folder");
        let service = FrameServiceConfig {
            root_path: Some(folder.path().join("shm")),
            max_frame_bytes: 1 << 20,
            ..FrameServiceConfig::for_cell("test-cell")
        };
        Self { folder, service }
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Writes a configuration with further keys; `[recording]`, `[frames]` and `[view]` may be gone on with. There is a view
    /// unless a section `[camera]` is given.
    pub(crate) fn config(&self, more: &[(&str, &str)]) -> PathBuf {
        let mut text = format!("[cell]\nname = \"{}\"\n", self.service.cell);
        let mut own = vec![
            ("frames", format!("root_path = {:?}\n", self.path("shm"))),
            // Small file systems of build machines are no reason to record nothing.
            ("recording", format!("folder = {:?}\nmin_free_mib = 0\n", self.path("recordings"))),
        ];
        if more.iter().all(|(section, _)| *section != "camera") {
            own.push(("view", String::new()));
        }
        for (section, keys) in &own {
            text += &format!("[{section}]\n{keys}");
            more.iter().filter(|(s, _)| s == section).for_each(|(_, keys)| text += &format!("{keys}\n"));
        }
        for (section, keys) in more.iter().filter(|(s, _)| own.iter().all(|(own, _)| own != s)) {
            text += &format!("[{section}]\n{keys}\n");
        }
        let path = self.path("cell.toml");
        fs::write(&path, text).expect("configuration");
        path
    }

    /// The recordings, oldest first.
    pub(crate) fn recordings(&self) -> Vec<PathBuf> {
        let mut files: Vec<_> = fs::read_dir(self.path("recordings"))
            .map(|entries| entries.map(|entry| entry.expect("entry").path()).collect())
            .unwrap_or_default();
        files.sort();
        files
    }

    /// Starts samsodd and waits until it is ready.
    pub(crate) fn start_daemon(&self, arguments: &[&str]) -> Process {
        let daemon = self.spawn_daemon(&self.config(&[]), arguments);
        daemon.wait_for_line("ready, waiting for frames");
        daemon
    }

    pub(crate) fn spawn_daemon(&self, config: &Path, arguments: &[&str]) -> Process {
        let mut command = Command::new(env!("CARGO_BIN_EXE_samsodd"));
        command.arg("--config").arg(config).args(arguments).current_dir(self.folder.path());
        Process::spawn(command)
    }

    /// Starts samsodd as systemd does: it tells what it does to a socket.
    pub(crate) fn spawn_notifying_daemon(&self, config: &Path, notify: &Path, watchdog: Duration) -> Process {
        let mut command = Command::new(env!("CARGO_BIN_EXE_samsodd"));
        command.arg("--config").arg(config).current_dir(self.folder.path());
        command.env("NOTIFY_SOCKET", notify).env("WATCHDOG_USEC", watchdog.as_micros().to_string());
        Process::spawn(command)
    }

    /// Starts the frame client of the command line on a folder.
    pub(crate) fn spawn_client(&self, images: &Path, arguments: &[&str]) -> Process {
        let mut command = Command::new(env!("CARGO_BIN_EXE_samsod"));
        command.arg("publish").arg(images).args(["--cell", &self.service.cell]);
        command.arg("--root-path").arg(self.path("shm")).args(arguments).current_dir(self.folder.path());
        Process::spawn(command)
    }

    /// A folder with `count` small images, each a coloured square on grey that moves from one to the next.
    pub(crate) fn images(&self, count: u32) -> PathBuf {
        let folder = self.path("images");
        fs::create_dir_all(&folder).expect("images");
        for i in 0..count {
            picture(i).save(folder.join(format!("{i:04}.png"))).expect("image");
        }
        folder
    }

    pub(crate) fn publisher(&self) -> FramePublisher {
        FramePublisher::open(&self.service, CameraId::new("test").expect("short")).expect("publisher")
    }

    /// A publisher of larger frames than others of this cell.
    pub(crate) fn publisher_of(&self, max_frame_bytes: usize) -> FramePublisher {
        let service = FrameServiceConfig { max_frame_bytes, ..self.service.clone() };
        FramePublisher::open(&service, CameraId::new("test").expect("short")).expect("publisher")
    }

    pub(crate) fn scenes(&self) -> Scenes {
        Scenes { subscriber: SceneSubscriber::open(&self.service).expect("scene subscriber") }
    }
}

/// 64 x 48 px: a coloured square on grey.
pub(crate) fn picture(number: u32) -> RgbImage {
    let left = 8 + number % 32;
    RgbImage::from_fn(64, 48, |x, y| {
        let inside = (left..left + 12).contains(&x) && (16..28).contains(&y);
        if inside { Rgb([200, 40, 40]) } else { Rgb([120, 120, 120]) }
    })
}

/// Sends one picture.
pub(crate) fn send(publisher: &mut FramePublisher, number: u32) {
    let image = picture(number);
    let mut loan = publisher.loan(image.width(), image.height(), PixelFormat::Rgb8).expect("loan");
    loan.pixels().copy_from_slice(&image);
    loan.send().expect("send");
}

/// The scenes that the daemon publishes.
pub(crate) struct Scenes {
    subscriber: SceneSubscriber,
}

impl Scenes {
    pub(crate) fn next(&mut self) -> serde_json::Value {
        let deadline = Instant::now() + WATCHDOG;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            assert!(!left.is_zero(), "no scene within {WATCHDOG:?}");
            if let Some(scene) = self.subscriber.wait(left).expect("scenes") {
                let json: serde_json::Value = serde_json::from_slice(scene.bytes()).expect("JSON");
                assert_eq!(json["sequence"], scene.header().sequence);
                assert_eq!(json["timestamp_ns"], scene.header().timestamp_ns);
                return json;
            }
        }
    }

    /// Reads on until the scene of this frame.
    pub(crate) fn of_frame(&mut self, sequence: u64) -> serde_json::Value {
        loop {
            let scene = self.next();
            if scene["sequence"] == sequence {
                return scene;
            }
        }
    }
}

/// A child process whose output is read; killed when dropped.
pub(crate) struct Process {
    child: Child,
    stderr: Receiver<String>,
    stdout: Option<JoinHandle<String>>,
}

/// How a process ended and what it said.
#[derive(Debug)]
pub(crate) struct Ended {
    pub status: ExitStatus,
    pub stdout: String,
    pub stderr: String,
}

impl Ended {
    /// The number behind `name` in the line that begins with `line` of the table on standard output.
    pub(crate) fn count(&self, line: &str, name: &str) -> u64 {
        let text = self.stdout.lines().find(|l| l.starts_with(line)).unwrap_or_else(|| panic!("{line}: {self:?}"));
        let (_, rest) = text.split_once(&format!("{name} ")).unwrap_or_else(|| panic!("{name}: {text}"));
        rest.split_whitespace().next().and_then(|n| n.parse().ok()).unwrap_or_else(|| panic!("{name}: {text}"))
    }

    #[track_caller]
    pub(crate) fn assert_success(&self) {
        assert!(self.status.success(), "{self:#?}");
    }
}

impl Process {
    pub(crate) fn spawn(mut command: Command) -> Self {
        command.env_remove("RUST_LOG").stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap_or_else(|e| panic!("{command:?}: {e}"));
        let (sender, stderr) = mpsc::channel();
        let lines = BufReader::new(child.stderr.take().expect("piped"));
        thread::spawn(move || {
            for line in lines.lines().map_while(Result::ok) {
                // Nobody listens any more once the test is over.
                let _ = sender.send(line);
            }
        });
        let mut output = child.stdout.take().expect("piped");
        let stdout = thread::spawn(move || {
            let mut text = String::new();
            output.read_to_string(&mut text).expect("text");
            text
        });
        Self { child, stderr, stdout: Some(stdout) }
    }

    pub(crate) fn id(&self) -> u32 {
        self.child.id()
    }

    /// Reads the log until a line that contains `text`.
    #[track_caller]
    pub(crate) fn wait_for_line(&self, text: &str) -> String {
        let mut seen = Vec::new();
        let deadline = Instant::now() + WATCHDOG;
        loop {
            match self.stderr.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
                Ok(line) if line.contains(text) => return line,
                Ok(line) => seen.push(line),
                Err(e) => panic!("no line with {text:?} ({e}); there were {seen:#?}"),
            }
        }
    }

    /// The lines that have come since they were last read, without waiting for more.
    pub(crate) fn lines(&self) -> Vec<String> {
        self.stderr.try_iter().collect()
    }

    pub(crate) fn has_ended(&mut self) -> bool {
        self.child.try_wait().expect("child").is_some()
    }

    /// Address space taken by the messages of publishers, bytes.
    pub(crate) fn message_memory(&self) -> u64 {
        let maps = fs::read_to_string(format!("/proc/{}/maps", self.child.id())).expect("maps");
        let size = |line: &str| {
            let (start, end) = line.split_whitespace().next()?.split_once('-')?;
            Some(u64::from_str_radix(end, 16).ok()? - u64::from_str_radix(start, 16).ok()?)
        };
        let of_messages = |line: &&str| line.contains("/dev/shm/iox2_") && line.contains(".data");
        maps.lines().filter(of_messages).filter_map(size).sum()
    }

    /// Sends a signal by name, e.g. `TERM`.
    pub(crate) fn signal(&self, name: &str) {
        let script = format!("kill -{name} {}", self.child.id());
        let status = Command::new("/bin/sh").arg("-c").arg(script).status().expect("shell");
        assert!(status.success(), "kill -{name}");
    }

    /// Stops the process and waits until it stands.
    pub(crate) fn freeze(&self) {
        self.signal("STOP");
        wait_for("stopped process", || {
            // Every thread must stand, not only the first.
            let tasks = fs::read_dir(format!("/proc/{}/task", self.child.id())).expect("tasks");
            let stands = |task: PathBuf| {
                let stat = fs::read_to_string(task.join("stat")).unwrap_or_default();
                stat.rsplit_once(')').is_none_or(|(_, rest)| rest.trim_start().starts_with('T'))
            };
            tasks.flatten().all(|task| stands(task.path())).then_some(())
        });
    }

    pub(crate) fn thaw(&self) {
        self.signal("CONT");
    }

    /// Waits for the end.
    pub(crate) fn wait(mut self) -> Ended {
        let status = wait_for("end of process", || self.child.try_wait().expect("child"));
        let stdout = self.stdout.take().expect("read once").join().expect("standard output");
        let stderr = self.stderr.iter().collect::<Vec<_>>().join("\n");
        Ended { status, stdout, stderr }
    }

    /// Asks it to end and waits until it has.
    pub(crate) fn terminate(self) -> Ended {
        self.signal("TERM");
        self.wait()
    }

    /// Kills it as `kill -9` does.
    pub(crate) fn kill(self) {
        self.signal("KILL");
        self.wait();
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Runs the command line of samsod to its end.
pub(crate) fn samsod(arguments: &[&str]) -> Ended {
    let mut command = Command::new(env!("CARGO_BIN_EXE_samsod"));
    command.args(arguments);
    Process::spawn(command).wait()
}

/// A file or folder of the bundled data.
pub(crate) fn test_data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data").join(name)
}

/// A frame of 1078 x 958 px of a plain blue table with some bundled parts on it, cut from their templates and each moved by
/// so many pixels from where it lay.
pub(crate) fn compose(parts: &[(&str, [i64; 2])]) -> RgbImage {
    let mut state = 1u32;
    let mut frame = RgbImage::from_fn(1078, 958, |_, _| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        let noise = (state >> 24) as u8 % 5;
        Rgb([40 + noise, 80 + noise, 140 + noise])
    });
    for (name, [right, down]) in parts {
        let template = samsod::recognize::Part::read(&test_data(&format!("parts/{name}"))).expect("part").template;
        for (x, y, _) in template.mask.enumerate_pixels().filter(|(_, _, value)| value[0] > 127) {
            let at = |crop: u32, offset: u32, moved: i64| (i64::from(crop + offset) + moved) as u32;
            let (u, v) = (at(template.crop_px[0], x, *right), at(template.crop_px[1], y, *down));
            frame.put_pixel(u, v, *template.image.get_pixel(x, y));
        }
    }
    frame
}

/// Messages of a recording by topic, in their order.
pub(crate) fn messages(recording: &Path) -> Vec<(String, Vec<u8>)> {
    let bytes = fs::read(recording).expect("recording");
    mcap::MessageStream::new(&bytes)
        .expect("MCAP")
        .map(|message| message.expect("message"))
        .map(|message| (message.channel.topic.clone(), message.data.into_owned()))
        .collect()
}

/// Whether a recording was closed: its summary is there and its numbers agree with the messages.
#[track_caller]
pub(crate) fn assert_closed(recording: &Path) {
    let bytes = fs::read(recording).expect("recording");
    let summary = mcap::Summary::read(&bytes).expect("closed recording").expect("summary");
    let counted = summary.stats.expect("statistics").message_count;
    assert_eq!(counted, messages(recording).len() as u64);
}

/// The value of a metric with its labels; none if it is not there.
pub(crate) fn metric(text: &str, name: &str) -> Option<f64> {
    let line = text.lines().find(|line| line.strip_prefix(name).is_some_and(|rest| rest.starts_with(' ')))?;
    line.rsplit_once(' ')?.1.parse().ok()
}

/// How many messages of a topic there are.
pub(crate) fn count(messages: &[(String, Vec<u8>)], topic: &str) -> usize {
    messages.iter().filter(|(t, _)| t == topic).count()
}

/// The messages of a JSON topic.
pub(crate) fn json(messages: &[(String, Vec<u8>)], topic: &str) -> Vec<serde_json::Value> {
    let of_topic = messages.iter().filter(|(t, _)| t == topic);
    of_topic.map(|(_, data)| serde_json::from_slice(data).expect("JSON")).collect()
}
