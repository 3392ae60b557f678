//! One `samsodd` for a cell: an advisory lock that the system releases with the process, however that ends.
//!
//! Input: the configuration of the shared memory, which makes two daemons peers or strangers. The lock file lies where
//! all daemons of a cell look: in the root path of its shared memory, or in `/tmp` without one. It stays behind, and is
//! harmless: what counts is whether a living process holds the lock.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Read, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use samsod_frame::FrameServiceConfig;

/// Why the cell was not taken.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LockError {
    /// Another daemon serves the cell.
    #[error(
        "cell {cell:?} is already served by process {holder} of user {user} since {since} (it holds {}); one samsodd a cell",
        path.display()
    )]
    Taken {
        /// Name of the cell.
        cell: String,
        /// Its process id as it wrote it down, or `?`.
        holder: String,
        /// Whose it is: a name, or a number without one.
        user: String,
        /// When it took the cell, UTC.
        since: String,
        /// The lock file.
        path: PathBuf,
    },
    /// Another user has put a lock file there.
    #[error("{} belongs to user {user}: only a file of this user is a lock; a root_path of one's own keeps others out", path.display())]
    Stranger {
        /// The lock file.
        path: PathBuf,
        /// Whose it is.
        user: String,
    },
    /// The lock file cannot be used.
    #[error("cannot lock {}: {source}; it must be a file that this user may write", path.display())]
    Io {
        /// The lock file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
}

/// The lock on a cell; dropping it, or dying, releases it.
#[derive(Debug)]
pub(crate) struct CellLock {
    _file: File,
}

impl CellLock {
    pub(crate) fn take(service: &FrameServiceConfig) -> Result<Self, LockError> {
        let folder = service.root_path.as_deref().unwrap_or(Path::new("/tmp"));
        let path = folder.join(format!("samsod-{}.lock", service.cell));
        let io = |source| LockError::Io { path: path.clone(), source };
        fs::create_dir_all(folder).map_err(io)?;
        // A lock file in /tmp may have been put there by anybody: never through a link, never for others to write.
        let mut file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .mode(0o600)
            .custom_flags(O_NOFOLLOW)
            .open(&path)
            .map_err(io)?;
        let metadata = file.metadata().map_err(io)?;
        let user = user_name(metadata.uid());
        if metadata.uid() != rustix::process::geteuid().as_raw() {
            return Err(LockError::Stranger { path, user });
        }
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let mut holder = String::new();
                // A file that is no text has no process id to tell; the lock is taken all the same.
                let _ = (&mut file).take(20).read_to_string(&mut holder);
                let holder = if holder.trim().is_empty() { "?".to_owned() } else { holder.trim().to_owned() };
                // It was written when the cell was taken, and never since.
                let since = metadata.modified().map_err(io)?;
                let since = humantime::format_rfc3339_seconds(since).to_string();
                return Err(LockError::Taken { cell: service.cell.clone(), holder, user, since, path });
            }
            Err(TryLockError::Error(source)) => return Err(io(source)),
        }
        file.set_len(0).and_then(|()| writeln!(file, "{}", std::process::id())).map_err(io)?;
        Ok(Self { _file: file })
    }
}

/// The name of a user of this machine, or the number of one without a name.
fn user_name(uid: u32) -> String {
    let users = fs::read_to_string("/etc/passwd").unwrap_or_default();
    let name = users.lines().find_map(|line| {
        let mut fields = line.split(':');
        let name = fields.next()?;
        (fields.nth(1)?.parse() == Ok(uid)).then(|| name.to_owned())
    });
    name.unwrap_or_else(|| uid.to_string())
}

/// `O_NOFOLLOW` of Linux; the value differs by architecture.
#[cfg(any(target_arch = "aarch64", target_arch = "arm"))]
const O_NOFOLLOW: i32 = 0o100_000;
/// `O_NOFOLLOW` of Linux; the value differs by architecture.
#[cfg(not(any(target_arch = "aarch64", target_arch = "arm")))]
const O_NOFOLLOW: i32 = 0o400_000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_second_is_refused_until_the_first_is_gone() {
        let folder = tempfile::tempdir().unwrap();
        let service =
            FrameServiceConfig { root_path: Some(folder.path().join("new")), ..FrameServiceConfig::for_cell("c") };
        let first = CellLock::take(&service).unwrap();
        let refused = CellLock::take(&service).unwrap_err().to_string();
        let user = user_name(rustix::process::geteuid().as_raw());
        let expected =
            format!("cell \"c\" is already served by process {} of user {user} since 20", std::process::id());
        assert!(refused.starts_with(&expected), "{refused}");
        let other = FrameServiceConfig { cell: "d".into(), ..service.clone() };
        CellLock::take(&other).unwrap();
        drop(first);
        CellLock::take(&service).unwrap();
    }

    #[test]
    fn users_have_names_or_numbers() {
        assert_eq!(user_name(0), "root");
        assert_eq!(user_name(4_000_000_001), "4000000001");
    }

    #[test]
    fn a_link_is_not_followed() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("precious");
        fs::write(&target, "text").unwrap();
        std::os::unix::fs::symlink(&target, folder.path().join("samsod-c.lock")).unwrap();
        let service =
            FrameServiceConfig { root_path: Some(folder.path().to_owned()), ..FrameServiceConfig::for_cell("c") };
        assert!(matches!(CellLock::take(&service), Err(LockError::Io { .. })));
        assert_eq!(fs::read_to_string(&target).unwrap(), "text");
    }
}
