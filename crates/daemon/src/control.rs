//! The operator's line to a running `samsodd`: hold, resume, status.
//!
//! A Unix socket beside the lock of the cell, for its own user alone. One request a connection, one line of JSON each way:
//!
//! ```text
//! {"request":"status"}                                   -> {"ok":{..}}
//! {"request":"hold"}                                     -> {"ok":{..}}
//! {"request":"resume","gripper_is_empty":false}          -> {"error":"the gripper may hold the flange; .."}
//! ```

use std::fs;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use samsod_frame::FrameServiceConfig;
use serde::{Deserialize, Serialize};
use tracing::warn;

use crate::commander::{Operator, RobotReport};

/// Longest request and answer, bytes.
const LONGEST: u64 = 1 << 20;
/// How long a client may take for its line.
const PATIENCE: Duration = Duration::from_secs(5);
/// How long the robot may take to resume or to stand.
const ANSWER_PATIENCE: Duration = Duration::from_secs(30);

/// What an operator can ask for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "request", rename_all = "snake_case")]
pub enum Request {
    /// How the robot and its sequence stand.
    Status,
    /// The robot is to stand, and stays so until it is resumed.
    Hold,
    /// A latched fault has been looked at: begin anew from home.
    Resume {
        /// The operator has taken out what the gripper may have held.
        gripper_is_empty: bool,
    },
    /// The full jig has been replaced by an empty one.
    NewJig,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Answer {
    Ok(Box<RobotReport>),
    Error(String),
}

/// Why the operator got no answer.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ControlError {
    /// Nobody listens.
    #[error("no samsodd answers for cell {cell:?} ({}: {source}); is it running, as the same user?", path.display())]
    Connect {
        /// The cell.
        cell: String,
        /// The socket.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// Somebody else listens.
    #[error(
        "{} belongs to user {owner}, not to this user nor to the owner of its folder: whoever made it is not samsodd",
        path.display()
    )]
    Stranger {
        /// The socket.
        path: PathBuf,
        /// Whose it is.
        owner: u32,
    },
    /// The connection broke.
    #[error("samsodd did not answer: {0}")]
    Broken(#[from] io::Error),
    /// The answer cannot be read.
    #[error("samsodd's answer cannot be read: {0}")]
    Malformed(#[from] serde_json::Error),
    /// samsodd refused.
    #[error("{0}")]
    Refused(String),
}

/// The socket of a cell: where its lock is.
pub fn socket_path(service: &FrameServiceConfig) -> PathBuf {
    let folder = service.root_path.as_deref().unwrap_or(Path::new("/tmp"));
    folder.join(format!("samsod-{}.sock", service.cell))
}

/// Asks the samsodd of a cell.
///
/// # Errors
/// [`ControlError`]
pub fn ask(service: &FrameServiceConfig, request: Request) -> Result<RobotReport, ControlError> {
    let path = socket_path(service);
    let connect_error = |source| ControlError::Connect { cell: service.cell.clone(), path: path.clone(), source };
    // In /tmp anybody may have made it before samsodd was started.
    let owner = fs::symlink_metadata(&path).map_err(connect_error)?.uid();
    let owner_of_folder = path.parent().and_then(|folder| fs::metadata(folder).ok()).map(|folder| folder.uid());
    if owner != rustix::process::geteuid().as_raw() && Some(owner) != owner_of_folder {
        return Err(ControlError::Stranger { path, owner });
    }
    let mut stream = UnixStream::connect(&path).map_err(connect_error)?;
    // Longer than samsodd itself waits for its robot.
    stream.set_read_timeout(Some(ANSWER_PATIENCE + PATIENCE))?;
    stream.set_write_timeout(Some(PATIENCE))?;
    let mut line = serde_json::to_vec(&request)?;
    line.push(b'\n');
    stream.write_all(&line)?;
    let mut answer = String::new();
    BufReader::new(stream.take(LONGEST)).read_line(&mut answer)?;
    match serde_json::from_str(&answer)? {
        Answer::Ok(report) => Ok(*report),
        Answer::Error(reason) => Err(ControlError::Refused(reason)),
    }
}

/// The socket while it is open.
#[derive(Debug)]
pub(crate) struct ControlSocket {
    path: PathBuf,
    ending: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl ControlSocket {
    /// Opens the socket of a cell whose lock is held: one that lies there is left from a daemon that has died.
    pub(crate) fn open(service: &FrameServiceConfig, operator: Option<Operator>) -> io::Result<Self> {
        let path = socket_path(service);
        match fs::remove_file(&path) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
            _ => {}
        }
        let listener = UnixListener::bind(&path)?;
        fs::set_permissions(&path, fs::Permissions::from_mode(0o600))?;
        let ending = Arc::new(AtomicBool::new(false));
        let ends = Arc::clone(&ending);
        let serve = move || {
            for stream in listener.incoming() {
                if ends.load(Ordering::SeqCst) {
                    return;
                }
                // A hold must not wait behind a resume, nor behind a client that says nothing.
                let operator = operator.clone();
                let serve = move || {
                    if let Err(error) = stream.and_then(|stream| answer(stream, operator.as_ref())) {
                        warn!(%error, "an operator's request was not answered");
                    }
                };
                if let Err(error) = thread::Builder::new().name("operator".to_owned()).spawn(serve) {
                    warn!(%error, "an operator's request was not answered");
                }
            }
        };
        let thread = thread::Builder::new().name("control".to_owned()).spawn(serve)?;
        Ok(Self { path, ending, thread: Some(thread) })
    }
}

impl Drop for ControlSocket {
    fn drop(&mut self) {
        self.ending.store(true, Ordering::SeqCst);
        // Wakes the thread from its wait.
        let woken = UnixStream::connect(&self.path).is_ok();
        let _ = fs::remove_file(&self.path);
        if let (true, Some(thread)) = (woken, self.thread.take()) {
            let _ = thread.join();
        }
    }
}

fn answer(mut stream: UnixStream, operator: Option<&Operator>) -> io::Result<()> {
    stream.set_write_timeout(Some(PATIENCE))?;
    let line = request_line(&mut stream)?;
    let answer = match (serde_json::from_slice::<Request>(&line), operator) {
        (Err(e), _) => Answer::Error(format!("the request cannot be read: {e}")),
        (Ok(_), None) => Answer::Error("no robot is commanded in this cell".to_owned()),
        (Ok(request), Some(operator)) => match operator.ask(request, ANSWER_PATIENCE) {
            Ok(report) => Answer::Ok(Box::new(report)),
            Err(reason) => Answer::Error(reason),
        },
    };
    let mut line = serde_json::to_vec(&answer).map_err(io::Error::other)?;
    line.push(b'\n');
    stream.write_all(&line)
}

/// The line of a request, which must be there in time as a whole.
fn request_line(stream: &mut UnixStream) -> io::Result<Vec<u8>> {
    let deadline = Instant::now() + PATIENCE;
    let (mut line, mut part) = (Vec::new(), [0; 1024]);
    while !line.contains(&b'\n') {
        let left = deadline.saturating_duration_since(Instant::now());
        if left.is_zero() || line.len() as u64 > LONGEST {
            return Err(io::Error::new(io::ErrorKind::TimedOut, "the request was not complete in time"));
        }
        stream.set_read_timeout(Some(left))?;
        match stream.read(&mut part)? {
            0 => break,
            n => line.extend_from_slice(&part[..n]),
        }
    }
    Ok(line)
}
