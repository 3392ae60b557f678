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
const VERSION: u32 = 11;
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

#[cfg(test)]
mod tests {
    use image::{Luma, Rgb};

    use super::*;
    use crate::test_parts::{FLAT_L, mesh, part};

    #[test]
    fn whatever_a_value_comes_from_changes_its_key() {
        let base = part("l", &FLAT_L, true);
        let key = key_of(&base, "sift 1");
        assert_eq!(key, key_of(&base.clone(), "sift 1"));
        // Where it was read from and what it is called change nothing that is computed.
        let moved = Part { name: "other".to_owned(), folder: "elsewhere".into(), ..base.clone() };
        assert_eq!(key, key_of(&moved, "sift 1"));
        let mut keys = vec![key, key_of(&base, "sift 2"), key_of(&base, "")];
        let mut other = |change: &dyn Fn(&mut Part)| {
            let mut part = base.clone();
            change(&mut part);
            keys.push(key_of(&part, "sift 1"));
        };
        other(&|p| p.template.image.put_pixel(3, 3, Rgb([1, 2, 3])));
        other(&|p| p.template.mask.put_pixel(3, 3, Luma([255])));
        other(&|p| p.height_mm += 0.01);
        other(&|p| p.symmetry.shape_order = 2);
        other(&|p| p.symmetry.appearance_order = 2);
        other(&|p| p.template.crop_px[1] += 1);
        other(&|p| p.template.origin_mm[0] += 1e-9);
        other(&|p| p.template.yaw_rad += 1e-9);
        other(&|p| p.template.camera = crate::test_parts::tilted());
        other(&|p| p.mesh = None);
        other(&|p| p.mesh = Some(mesh(&[FLAT_L[0]])));
        // The same bytes in another shape.
        other(&|p| {
            let (width, height) = p.template.image.dimensions();
            let bytes = p.template.image.as_raw().clone();
            p.template.image = image::RgbImage::from_raw(height, width, bytes).unwrap();
        });
        let count = keys.len();
        keys.sort_unstable();
        keys.dedup();
        assert_eq!((keys.len(), count), (15, 15));
    }

    #[test]
    fn what_was_kept_comes_back_under_its_key_only() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("descriptors");
        let value = (vec![1.5f32, -2.0], "text".to_owned());
        let (key, another) = ([7u8; 32], [8u8; 32]);
        assert_eq!(read::<(Vec<f32>, String)>(&path, &key), None);
        assert!(write(&path, &key, &value));
        assert_eq!(read(&path, &key), Some(value.clone()));
        assert_eq!(read::<(Vec<f32>, String)>(&path, &another), None);
        // It takes the place of what was there.
        assert!(write(&path, &another, &value));
        assert_eq!((read::<(Vec<f32>, String)>(&path, &key), read(&path, &another)), (None, Some(value)));
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_truncated_or_foreign_file_is_ignored() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("descriptors");
        let (key, value) = ([7u8; 32], vec![[1.0f32, 2.0, 3.0]; 9]);
        assert!(write(&path, &key, &value));
        let whole = fs::read(&path).unwrap();
        for length in 0..whole.len() {
            fs::write(&path, &whole[..length]).unwrap();
            assert_eq!(read::<Vec<[f32; 3]>>(&path, &key), None, "{length} of {} bytes", whole.len());
        }
        // A length that no file holds.
        fs::write(&path, [&key[..], &[0xff; 9], &[0x01]].concat()).unwrap();
        assert_eq!(read::<Vec<[f32; 3]>>(&path, &key), None);
        fs::write(&path, "not ours").unwrap();
        assert_eq!(read::<Vec<[f32; 3]>>(&path, &key), None);
        // A folder of that name.
        fs::remove_file(&path).unwrap();
        fs::create_dir(&path).unwrap();
        assert_eq!(read::<Vec<[f32; 3]>>(&path, &key), None);
        assert!(!write(&path, &key, &value));
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "nothing half written is left");
    }

    #[test]
    fn a_folder_that_cannot_be_written_is_no_error() {
        let folder = tempfile::tempdir().unwrap();
        assert!(!write(&folder.path().join("missing/descriptors"), &[7; 32], &1));
        // Below a file, which nobody can write to, whatever the rights.
        let file = folder.path().join("file");
        fs::write(&file, "").unwrap();
        assert!(!write(&file.join("descriptors"), &[7; 32], &1));
        assert_eq!(read::<i32>(&file.join("descriptors"), &[7; 32]), None);
    }
}
