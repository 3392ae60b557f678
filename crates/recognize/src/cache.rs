//! What was computed from the files of a part, kept beside them.
//!
//! The file holds a key, which covers the format, the parameters and all that the part was read from, and the value. A
//! key that is another, or a file that cannot be read, means computing again; a folder that cannot be written only
//! costs that time at every start.

use std::fs;
use std::io::Write as _;
use std::path::Path;

use serde::Serialize;
use serde::de::DeserializeOwned;
use sha2::{Digest, Sha256};

use crate::catalogue::Part;

/// Changes with what is computed or how it is written.
const VERSION: u32 = 5;
/// Largest file that is read, bytes.
const MOST_BYTES: u64 = 256 << 20;

/// Identifies what a value was computed from.
pub(crate) type Key = [u8; 32];

/// The key of a part with some parameters, given as text.
pub(crate) fn key_of(part: &Part, parameters: &str) -> Key {
    let mut hash = Sha256::new();
    let mut add = |bytes: &[u8]| {
        // With its length, so that no two sequences of fields are one.
        hash.update((bytes.len() as u64).to_le_bytes());
        hash.update(bytes);
    };
    add(&VERSION.to_le_bytes());
    add(env!("CARGO_PKG_VERSION").as_bytes());
    add(parameters.as_bytes());
    let template = &part.template;
    // All numbers but those of pictures and mesh, which are long.
    let numbers = format!(
        "{} {:?} {:?} {:?} {:?} {:?} {:?} {:?}",
        part.height_mm,
        part.symmetry,
        template.crop_px,
        template.origin_mm,
        template.yaw_rad,
        template.image.dimensions(),
        template.camera.intrinsics(),
        template.camera.world_from_camera()
    );
    add(numbers.as_bytes());
    add(template.image.as_raw());
    add(template.mask.as_raw());
    if let Some(mesh) = &part.mesh {
        add(&mesh.vertices().iter().flatten().flat_map(|c| c.to_le_bytes()).collect::<Vec<u8>>());
        add(&mesh.triangles().iter().flatten().flat_map(|i| i.to_le_bytes()).collect::<Vec<u8>>());
    }
    hash.finalize().into()
}

/// The value that was kept under a key.
pub(crate) fn read<T: DeserializeOwned>(path: &Path, key: &Key) -> Option<T> {
    if fs::metadata(path).ok()?.len() > MOST_BYTES {
        return None;
    }
    let bytes = fs::read(path).ok()?;
    let (found, value) = bytes.split_first_chunk::<32>()?;
    if found != key {
        return None;
    }
    postcard::from_bytes(value).ok()
}

/// Keeps a value; whether that succeeded.
pub(crate) fn write<T: Serialize>(path: &Path, key: &Key, value: &T) -> bool {
    let Ok(bytes) = postcard::to_stdvec(value) else { return false };
    let Some(folder) = path.parent() else { return false };
    // Beside it and then in its place: another process sees the old file or the new one.
    let Ok(mut file) = tempfile::NamedTempFile::new_in(folder) else { return false };
    file.write_all(key).and_then(|()| file.write_all(&bytes)).is_ok() && file.persist(path).is_ok()
}
