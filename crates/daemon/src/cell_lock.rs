//! One `samsodd` for a cell: an advisory lock that the system releases with the process, however that ends.
//!
//! Input: the configuration of the shared memory, which makes two daemons peers or strangers. The lock file lies where
//! all daemons of a cell look: in the root path of its shared memory, or in `/tmp` without one. It stays behind, and is
//! harmless: what counts is whether a living process holds the lock.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use samsod_frame::FrameServiceConfig;

/// Why the cell was not taken.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LockError {
    /// Another daemon serves the cell.
    #[error("cell {cell:?} is already served by process {holder} (it holds {}); one samsodd a cell", path.display())]
    Taken {
        /// Name of the cell.
        cell: String,
        /// Its process id as it wrote it down, or `?`.
        holder: String,
        /// The lock file.
        path: PathBuf,
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
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let mut holder = String::new();
                // A file that is no text has no process id to tell; the lock is taken all the same.
                let _ = (&mut file).take(20).read_to_string(&mut holder);
                let holder = if holder.trim().is_empty() { "?".to_owned() } else { holder.trim().to_owned() };
                return Err(LockError::Taken { cell: service.cell.clone(), holder, path });
            }
            Err(TryLockError::Error(source)) => return Err(io(source)),
        }
        file.set_len(0).and_then(|()| writeln!(file, "{}", std::process::id())).map_err(io)?;
        Ok(Self { _file: file })
    }
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
        let expected = format!("cell \"c\" is already served by process {}", std::process::id());
        assert!(refused.starts_with(&expected), "{refused}");
        let other = FrameServiceConfig { cell: "d".into(), ..service.clone() };
        CellLock::take(&other).unwrap();
        drop(first);
        CellLock::take(&service).unwrap();
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
