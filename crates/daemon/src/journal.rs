//! The journal of systemd: one entry an event, with its fields by themselves.
//!
//! Under systemd standard error is the journal, which `JOURNAL_STREAM` tells; a line there would be text alone. [`Journal`] hands
//! over the same text as `MESSAGE`, and each field once more: `frame=17` is `SAMSOD_FRAME=17`, to be searched for by
//! `journalctl SAMSOD_FRAME=17`. Anywhere else lines go to standard error.
//!
//! It speaks the journal's own protocol: `NAME=value` and a line feed, or, of a value with line feeds, the name, the length in 64
//! bits little endian, and the value.

use std::fmt::{self, Write as _};
use std::io;
use std::os::fd::AsFd;
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::time::Duration;

use tracing::field::{Field, Visit};
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::layer::Context;

/// Where the journal listens.
const SOCKET: &str = "/run/systemd/journal/socket";
/// Longest value that is handed over, bytes: an entry must fit into one message.
const LONGEST: usize = 32 << 10;
/// A journal that does not take its entries must not hold up those who write them for longer.
const PATIENCE: Duration = Duration::from_secs(1);

/// Whether standard error is the journal, as systemd says by `JOURNAL_STREAM`, device and inode of the stream.
pub fn is_standard_error(journal_stream: Option<&str>) -> bool {
    let Some((device, inode)) = journal_stream.and_then(|stream| stream.split_once(':')) else { return false };
    let Ok(stat) = rustix::fs::fstat(io::stderr().as_fd()) else { return false };
    device.parse() == Ok(stat.st_dev) && inode.parse() == Ok(stat.st_ino)
}

/// Writes events to the journal.
#[derive(Debug)]
pub struct Journal {
    socket: UnixDatagram,
    path: PathBuf,
    identifier: String,
}

impl Journal {
    /// The journal of this machine; `identifier` is what entries are shown with, the name of the program.
    ///
    /// # Errors
    /// No socket can be made.
    pub fn open(identifier: &str) -> io::Result<Self> {
        Self::at(Path::new(SOCKET), identifier)
    }

    fn at(path: &Path, identifier: &str) -> io::Result<Self> {
        let socket = UnixDatagram::unbound()?;
        socket.set_write_timeout(Some(PATIENCE))?;
        Ok(Self { socket, path: path.to_owned(), identifier: identifier.to_owned() })
    }
}

impl<S: Subscriber> Layer<S> for Journal {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let mut entry = Entry::default();
        event.record(&mut entry);
        let metadata = event.metadata();
        let priority = match *metadata.level() {
            Level::ERROR => "3",
            Level::WARN => "4",
            Level::INFO => "6",
            Level::DEBUG | Level::TRACE => "7",
        };
        let mut bytes = Vec::new();
        put(&mut bytes, "MESSAGE", &entry.text());
        put(&mut bytes, "PRIORITY", priority);
        put(&mut bytes, "SYSLOG_IDENTIFIER", &self.identifier);
        put(&mut bytes, "SAMSOD_TARGET", metadata.target());
        if let (Some(file), Some(line)) = (metadata.file(), metadata.line()) {
            put(&mut bytes, "CODE_FILE", file);
            put(&mut bytes, "CODE_LINE", &line.to_string());
        }
        for (name, value, _) in &entry.fields {
            put(&mut bytes, &field_name(name), value);
        }
        // By name each time: a journal that was started anew has another socket there.
        if self.socket.send_to(&bytes, &self.path).is_err() {
            // The stream may still be read when the socket is not.
            eprintln!("{}", entry.text());
        }
    }
}

/// Name of a field in the journal: capitals, digits and underscores.
fn field_name(name: &str) -> String {
    let plain = name.chars().map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_uppercase() } else { '_' });
    format!("SAMSOD_{}", plain.collect::<String>())
}

fn put(bytes: &mut Vec<u8>, name: &str, value: &str) {
    let mut end = value.len().min(LONGEST);
    while !value.is_char_boundary(end) {
        end -= 1;
    }
    let value = &value.as_bytes()[..end];
    bytes.extend_from_slice(name.as_bytes());
    if value.contains(&b'\n') {
        bytes.push(b'\n');
        bytes.extend_from_slice(&(value.len() as u64).to_le_bytes());
    } else {
        bytes.push(b'=');
    }
    bytes.extend_from_slice(value);
    bytes.push(b'\n');
}

/// The fields of an event.
#[derive(Debug, Default)]
struct Entry {
    message: String,
    /// Name, plain value, and the value as a line shows it.
    fields: Vec<(&'static str, String, String)>,
}

impl Entry {
    /// As standard error would show it.
    fn text(&self) -> String {
        self.fields.iter().fold(self.message.clone(), |mut text, (name, _, shown)| {
            let _ = write!(text, " {name}={shown}");
            text
        })
    }
}

impl Visit for Entry {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        let value = format!("{value:?}");
        match field.name() {
            "message" => self.message = value,
            name => self.fields.push((name, value.clone(), value)),
        }
    }

    fn record_str(&mut self, field: &Field, value: &str) {
        match field.name() {
            "message" => self.message = value.to_owned(),
            name => self.fields.push((name, value.to_owned(), format!("{value:?}"))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tracing_subscriber::layer::SubscriberExt;

    #[test]
    fn an_event_is_one_entry_with_its_text_and_its_fields() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("socket");
        let journal = UnixDatagram::bind(&path).unwrap();
        let subscriber = tracing_subscriber::registry().with(Journal::at(&path, "samsodd").unwrap());
        let long = "\u{e4}".repeat(LONGEST);
        tracing::subscriber::with_default(subscriber, || {
            let (none, phase) = (None::<u64>, Some(tracing::field::display("above the part")));
            tracing::warn!(command = 7, frame = 12u64, pick = none, phase, part = "hex nut", "command ended");
            tracing::info!(reason = "line 1\nline 2", "refused");
            tracing::error!(long, "cut");
        });
        let mut buffer = vec![0; 1 << 20];
        let mut next = || {
            let length = journal.recv(&mut buffer).unwrap();
            buffer[..length].to_vec()
        };
        let entry = String::from_utf8(next()).unwrap();
        let lines: Vec<&str> = entry.lines().collect();
        for line in [
            "MESSAGE=command ended command=7 frame=12 phase=above the part part=\"hex nut\"",
            "PRIORITY=4",
            "SYSLOG_IDENTIFIER=samsodd",
            "SAMSOD_COMMAND=7",
            "SAMSOD_FRAME=12",
            "SAMSOD_PHASE=above the part",
            "SAMSOD_PART=hex nut",
        ] {
            assert!(lines.contains(&line), "{line}: {entry}");
        }
        assert!(!entry.contains("PICK"), "what is not there has no field: {entry}");
        let entry = next();
        let framed = [&b"SAMSOD_REASON\n"[..], &13u64.to_le_bytes(), b"line 1\nline 2\n"].concat();
        assert!(entry.windows(framed.len()).any(|part| part == framed), "{}", entry.escape_ascii());
        let entry = String::from_utf8(next()).unwrap();
        let value = entry.lines().find_map(|line| line.strip_prefix("SAMSOD_LONG=")).unwrap();
        assert_eq!(value.len(), LONGEST, "cut between two letters");
    }

    #[test]
    fn another_stream_than_that_of_the_journal_is_none() {
        let stat = rustix::fs::fstat(io::stderr().as_fd()).unwrap();
        let own = format!("{}:{}", stat.st_dev, stat.st_ino);
        assert!(is_standard_error(Some(&own)));
        let other = format!("{}:{}", stat.st_dev, stat.st_ino.wrapping_add(1));
        for stream in [None, Some(""), Some("8"), Some("a:b"), Some(other.as_str())] {
            assert!(!is_standard_error(stream), "{stream:?}");
        }
    }
}
