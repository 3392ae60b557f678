//! The folder of the transport's bookkeeping files: whoever can write to it can take part in the cell, so it must belong to this
//! user alone.

use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

/// Bits of a mode with which others than the owner may write.
const OTHERS_WRITE: u32 = 0o022;

/// Why a folder is not to be used, in words; none if it may, or does not exist yet.
pub(crate) fn objection(root: &Path) -> Option<String> {
    let metadata = match fs::symlink_metadata(root) {
        Ok(metadata) => metadata,
        Err(e) if e.kind() == io::ErrorKind::NotFound => return None,
        Err(e) => return Some(e.to_string()),
    };
    let me = rustix::process::geteuid().as_raw();
    let mode = metadata.mode() & 0o7777;
    if metadata.is_symlink() {
        Some("it is a symbolic link, which another user may have put there; name the folder itself".to_owned())
    } else if !metadata.is_dir() {
        Some("it is no folder".to_owned())
    } else if metadata.uid() != me {
        Some(format!(
            "it belongs to user {}, and this is user {me}; all participants of a cell run under one user id, and nobody else \
             may have made the folder before them",
            metadata.uid()
        ))
    } else if mode & OTHERS_WRITE != 0 {
        Some(format!("others may write to it (mode {mode:o}); chmod go-w makes it this user's alone"))
    } else {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn only_a_folder_that_others_cannot_write_to_is_used() {
        let folder = std::env::temp_dir().join(format!("samsod-root-{}", std::process::id()));
        assert_eq!(objection(&folder), None, "what is not there yet is made");
        fs::create_dir(&folder).unwrap();
        let with_mode = |mode| {
            fs::set_permissions(&folder, fs::Permissions::from_mode(mode)).unwrap();
            objection(&folder)
        };
        assert_eq!(with_mode(0o755), None);
        assert!(with_mode(0o777).unwrap().contains("mode 777"));
        assert!(with_mode(0o720).unwrap().contains("mode 720"));
        let link = folder.with_extension("link");
        std::os::unix::fs::symlink(&folder, &link).unwrap();
        assert!(objection(&link).unwrap().contains("symbolic link"));
        fs::remove_file(&link).unwrap();
        fs::remove_dir(&folder).unwrap();
        fs::write(&folder, "a file").unwrap();
        assert_eq!(objection(&folder).unwrap(), "it is no folder");
        fs::remove_file(&folder).unwrap();
    }
}
