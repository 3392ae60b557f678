//! Which old recordings are deleted.
//!
//! In: a folder, the name of a cell, how long and how much is kept. Out: what was deleted, oldest first. Only files with a name
//! that samsodd gives to a recording of this cell are looked at, and none that somebody writes to; whatever else lies in the
//! folder is not touched.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use samsod_recording::is_in_use;

/// What is kept. Zero keeps all.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Keep {
    /// Since a file was last written to, days.
    pub(super) days: u64,
    /// All files together, MiB.
    pub(super) mib: u64,
}

impl Keep {
    pub(super) fn is_all(&self) -> bool {
        *self == Self { days: 0, mib: 0 }
    }
}

/// A recording that is no more.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Deleted {
    pub(super) path: PathBuf,
    pub(super) bytes: u64,
    /// Which key of the configuration wanted it so.
    pub(super) because: &'static str,
}

/// A file of the cell. Ordered by age: the time in its name, then its number in the recording.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
struct OwnFile {
    begun: String,
    number: u32,
    path: PathBuf,
    bytes: u64,
    modified: SystemTime,
}

/// The name of a cell as it stands in the names of files.
pub(super) fn safe_name(cell_name: &str) -> String {
    cell_name.chars().map(|c| if c.is_ascii_alphanumeric() || "-_".contains(c) { c } else { '_' }).collect()
}

/// Time and number in the name of a recording of this cell: `CELL-20261126T101500.123Z.mcap`, `..-002.mcap`.
fn parse_name<'a>(name: &'a str, safe_name: &str) -> Option<(&'a str, u32)> {
    let rest = name.strip_prefix(safe_name)?.strip_prefix('-')?.strip_suffix(".mcap")?;
    const TIME: &str = "00000000T000000.000Z";
    let (time, number) = rest.split_at_checked(TIME.len())?;
    let fits = |(c, like): (u8, u8)| if like == b'0' { c.is_ascii_digit() } else { c == like };
    if !time.bytes().zip(TIME.bytes()).all(fits) {
        return None;
    }
    let number = match number {
        "" => 1,
        number => {
            let digits = number.strip_prefix('-')?;
            (digits.len() >= 3 && digits.bytes().all(|c| c.is_ascii_digit())).then_some(())?;
            digits.parse().ok()?
        }
    };
    Some((time, number))
}

/// Deletes what is to be kept no longer. One that cannot be deleted is told in the log and looked at again next time.
///
/// # Errors
/// The folder cannot be read.
pub(super) fn sweep(
    folder: &Path,
    safe_name: &str,
    keep: Keep,
    in_use: &Path,
    now: SystemTime,
) -> io::Result<Vec<Deleted>> {
    let mut files = Vec::new();
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name();
        let Some((begun, number)) = name.to_str().and_then(|name| parse_name(name, safe_name)) else { continue };
        // Of the link itself: what it leads to is not ours. One that has gone away meanwhile needs no deleting.
        let Ok(about) = entry.metadata() else { continue };
        if about.is_file() {
            let modified = about.modified()?;
            files.push(OwnFile { begun: begun.to_owned(), number, path: entry.path(), bytes: about.len(), modified });
        }
    }
    files.sort();
    let mut total: u64 = files.iter().map(|file| file.bytes).sum();
    let longest = Duration::from_secs(keep.days.saturating_mul(86_400));
    let mut deleted = Vec::new();
    for OwnFile { path, bytes, modified, .. } in files {
        let age = now.duration_since(modified).unwrap_or_default();
        let because = match keep {
            Keep { days: 1.., .. } if age > longest => "keep_days",
            Keep { mib: 1.., .. } if total > keep.mib.saturating_mul(1 << 20) => "keep_mib",
            _ => continue,
        };
        if path == in_use || File::open(&path).is_ok_and(|file| is_in_use(&file)) {
            continue;
        }
        match fs::remove_file(&path) {
            Ok(()) => {
                total -= bytes;
                tracing::info!(path = %path.display(), mib = bytes >> 20, because, "an old recording is deleted");
                deleted.push(Deleted { path, bytes, because });
            }
            Err(error) => tracing::warn!(path = %path.display(), %error, "an old recording cannot be deleted"),
        }
    }
    Ok(deleted)
}

#[cfg(test)]
mod tests {
    use super::*;

    const DAY: Duration = Duration::from_secs(86_400);

    /// A file of so many KiB that was last written so many days ago.
    fn file(folder: &Path, name: &str, kib: usize, days: u32, now: SystemTime) -> PathBuf {
        let path = folder.join(name);
        fs::write(&path, vec![0; kib << 10]).unwrap();
        File::options().write(true).open(&path).unwrap().set_modified(now - days * DAY).unwrap();
        path
    }

    fn left(folder: &Path) -> Vec<String> {
        let mut names: Vec<_> =
            fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn only_names_that_samsodd_gives_to_this_cell_are_its_own() {
        for (name, expected) in [
            ("left-20261126T101500.123Z.mcap", Some(1)),
            ("left-20261126T101500.123Z-002.mcap", Some(2)),
            ("left-20261126T101500.123Z-1000.mcap", Some(1000)),
            ("left-20261126T101500.123Z-02.mcap", None),
            ("left-20261126T101500.123Z-panic-1.png", None),
            ("left-20261126T101500.123Z-recovered.mcap", None),
            ("left-arm-20261126T101500.123Z.mcap", None),
            ("right-20261126T101500.123Z.mcap", None),
            ("left-2026-11-26.mcap", None),
            ("left.mcap", None),
            ("left-20261126T101500.123Z.mcap.bak", None),
        ] {
            assert_eq!(parse_name(name, "left").map(|(_, number)| number), expected, "{name}");
        }
    }

    #[test]
    fn what_is_too_old_goes_and_nothing_that_is_not_ours() {
        let folder = tempfile::tempdir().unwrap();
        let now = SystemTime::now();
        let make = |name, days| file(folder.path(), name, 1, days, now);
        make("left-20260901T000000.000Z.mcap", 40);
        make("left-20260901T000000.000Z-002.mcap", 31);
        make("left-20261101T000000.000Z.mcap", 29);
        make("right-20260901T000000.000Z.mcap", 90);
        make("left-20260901T000000.000Z-panic-1.png", 90);
        make("notes.mcap", 90);
        let open = make("left-20260801T000000.000Z.mcap", 90);
        let written = File::open(make("left-20260802T000000.000Z.mcap", 90)).unwrap();
        written.lock().unwrap();
        let keep = Keep { days: 30, mib: 0 };
        let deleted = sweep(folder.path(), "left", keep, &open, now).unwrap();
        let names: Vec<_> =
            deleted.iter().map(|d| (d.path.file_name().unwrap().to_str().unwrap(), d.because)).collect();
        assert_eq!(
            names,
            [("left-20260901T000000.000Z.mcap", "keep_days"), ("left-20260901T000000.000Z-002.mcap", "keep_days")]
        );
        assert_eq!(left(folder.path()).len(), 6, "{:?}", left(folder.path()));
    }

    #[test]
    fn the_oldest_go_until_the_rest_fits_and_the_numbers_of_a_recording_count() {
        let folder = tempfile::tempdir().unwrap();
        let now = SystemTime::now();
        // By name: a copy may have touched the times.
        for (name, days) in [
            ("c-20261001T000000.000Z-999.mcap", 1),
            ("c-20261001T000000.000Z-1000.mcap", 2),
            ("c-20261002T000000.000Z.mcap", 3),
            ("c-20261003T000000.000Z.mcap", 0),
        ] {
            file(folder.path(), name, 1024, days, now);
        }
        file(folder.path(), "somebody else's", 4096, 0, now);
        let open = folder.path().join("c-20261003T000000.000Z.mcap");
        let deleted = sweep(folder.path(), "c", Keep { days: 0, mib: 2 }, &open, now).unwrap();
        assert_eq!(deleted.iter().map(|d| d.because).collect::<Vec<_>>(), ["keep_mib", "keep_mib"]);
        let expected = ["c-20261002T000000.000Z.mcap", "c-20261003T000000.000Z.mcap", "somebody else's"];
        assert_eq!(left(folder.path()), expected);
        // The one in use stays, however little is to be kept.
        sweep(folder.path(), "c", Keep { days: 1, mib: 1 }, &open, now + 100 * DAY).unwrap();
        assert_eq!(left(folder.path()), ["c-20261003T000000.000Z.mcap", "somebody else's"]);
        assert!(sweep(folder.path(), "c", Keep { days: 0, mib: 0 }, Path::new("/"), now).unwrap().is_empty());
    }
}
