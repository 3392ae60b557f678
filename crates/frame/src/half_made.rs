//! Nodes that were killed while they were being made or taken away. The transport writes a node's details first and its monitor, by
//! which others tell that it is dead, afterwards; and it takes the details away first. What was killed in between stays: without a
//! monitor nobody looks at it, and without the details nobody knows where its files lie.

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

/// From this age on what is half made or half taken away will stay so: both take some milliseconds.
const ABANDONED_AFTER: Duration = Duration::from_secs(10);

/// The same of a service, for which others wait.
const SERVICE_ABANDONED_AFTER: Duration = Duration::from_secs(2);

/// Removes what is left of such nodes. What cannot be removed stays, and does no harm but to take room.
pub(crate) fn remove_nodes(root: &Path) {
    let now = SystemTime::now();
    let mut nodes: BTreeMap<String, Vec<PathBuf>> = BTreeMap::new();
    for entry in fs::read_dir(root.join("nodes")).into_iter().flatten().flatten() {
        if let Some(id) = node_of(&entry.file_name().to_string_lossy()) {
            nodes.entry(id.to_owned()).or_default().push(entry.path());
        }
    }
    let is_monitor = |path: &PathBuf| path.extension().is_some_and(|extension| extension == "node_monitor");
    let is_old = |path: &PathBuf| {
        let changed = fs::metadata(path).and_then(|metadata| metadata.modified());
        changed.is_ok_and(|changed| now.duration_since(changed).is_ok_and(|age| age >= ABANDONED_AFTER))
    };
    let is_whole = |id: &String, paths: &[PathBuf]| {
        paths.iter().any(is_monitor) && root.join("nodes").join(id).join("iox2_node.details").exists()
    };
    for (_, paths) in nodes.iter().filter(|(id, paths)| !is_whole(id, paths) && paths.iter().all(is_old)) {
        for path in paths {
            // Somebody else may be at it, too.
            let _ = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
        }
    }
}

/// Removes services whose maker was killed meanwhile: their file can no longer be written to when it is whole, some milliseconds
/// after it is there. Before that nobody can open it or make it anew.
pub(crate) fn remove_services(root: &Path) {
    for entry in fs::read_dir(root.join("services")).into_iter().flatten().flatten() {
        let Ok(metadata) = entry.metadata() else { continue };
        let is_whole = metadata.permissions().mode() & 0o200 == 0;
        let age = metadata.modified().ok().and_then(|changed| changed.elapsed().ok());
        if metadata.is_file() && !is_whole && age.is_some_and(|age| age >= SERVICE_ABANDONED_AFTER) {
            // Somebody else may be at it, too.
            let _ = fs::remove_file(entry.path());
        }
    }
}

/// The number of the node that a file or folder is of: `NUMBER` or `iox2_NUMBER.node_monitor` and the like.
fn node_of(name: &str) -> Option<&str> {
    let id = name.strip_prefix("iox2_").unwrap_or(name).split('.').next()?;
    (!id.is_empty() && id.bytes().all(|byte| byte.is_ascii_digit())).then_some(id)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::File;

    #[test]
    fn only_old_services_that_are_still_being_written_are_removed() {
        let root = std::env::temp_dir().join(format!("samsod-half-service-{}", std::process::id()));
        let services = root.join("services");
        fs::create_dir_all(&services).unwrap();
        let make = |name: &str, mode, age: Duration| {
            let file = File::create(services.join(name)).unwrap();
            file.set_modified(SystemTime::now() - age).unwrap();
            file.set_permissions(fs::Permissions::from_mode(mode)).unwrap();
        };
        let (long, short) = (SERVICE_ABANDONED_AFTER * 2, Duration::ZERO);
        make("1", 0o600, long);
        make("2", 0o600, short);
        make("3", 0o400, long);
        remove_services(&root);
        let left = ["1", "2", "3"].map(|name| services.join(name).exists());
        fs::remove_dir_all(&root).unwrap();
        assert_eq!(left, [false, true, true]);
    }

    #[test]
    fn only_old_nodes_without_a_monitor_or_without_details_are_removed() {
        let root = std::env::temp_dir().join(format!("samsod-half-made-{}", std::process::id()));
        let nodes = root.join("nodes");
        let make = |id: &str, has_monitor: bool, has_details: bool, age: Duration| {
            let then = SystemTime::now() - age;
            fs::create_dir_all(nodes.join(id)).unwrap();
            fs::write(nodes.join(id).join("iox2_1.port_tag"), "").unwrap();
            if has_details {
                fs::write(nodes.join(id).join("iox2_node.details"), "text").unwrap();
            }
            if has_monitor {
                let monitor = File::create(nodes.join(format!("iox2_{id}.node_monitor"))).unwrap();
                monitor.set_modified(then).unwrap();
            }
            File::open(nodes.join(id)).unwrap().set_modified(then).unwrap();
        };
        let (long, short) = (ABANDONED_AFTER * 2, Duration::ZERO);
        make("1", true, true, long);
        make("2", false, true, long);
        make("3", false, true, short);
        make("4", true, false, long);
        make("5", true, false, short);
        make("other", false, true, long);
        remove_nodes(&root);
        let left = ["1", "2", "3", "4", "5", "iox2_4.node_monitor", "other"].map(|name| nodes.join(name).exists());
        fs::remove_dir_all(&root).unwrap();
        assert_eq!(left, [true, false, true, false, true, false, true]);
        remove_nodes(&root);
    }
}
