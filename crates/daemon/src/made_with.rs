//! What a recording was made with: the program, the configuration in force, the camera file and the parts of the catalogue.
//!
//! It stands at the head of every file as MCAP metadata named [`METADATA`], so that a recording can be replayed where its cell is
//! not.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use samsod::recognize::Catalogue;
use sha2::{Digest, Sha256};

use crate::config::{Config, ConfigError};

/// Name of the metadata record.
pub const METADATA: &str = "samsod.made_with";

/// Files of a part from which anything that is seen follows, in the folder of the part.
const PART_FILES: [&str; 4] = ["part.toml", "template.png", "mask.png", "model.stl"];

/// What scenes follow from, beside the frames.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct MadeWith {
    /// Version of the program.
    pub version: String,
    /// Number over its sources, in hexadecimal: see [`build`].
    pub build: String,
    /// The configuration in force, TOML, with every key.
    pub configuration: String,
    /// The text of the camera file, if one is used.
    pub camera: Option<String>,
    /// Of each part of the catalogue, by name: the SHA-256 of its files, in hexadecimal. Empty without a catalogue.
    pub catalogue: BTreeMap<String, String>,
}

/// Number over the sources and dependencies of this program: programs with the same number see the same in the same frame.
pub fn build() -> &'static str {
    env!("SAMSOD_BUILD")
}

impl MadeWith {
    /// This program with a configuration. Reads the camera file and the files of the parts.
    ///
    /// # Errors
    /// [`ConfigError`]: one of these files cannot be read (any more).
    pub fn new(config: &Config, catalogue: Option<&Catalogue>) -> Result<Self, ConfigError> {
        let read = |path: &Path| {
            fs::read_to_string(path).map_err(|source| ConfigError::Read { path: path.to_owned(), source })
        };
        Ok(Self {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            build: build().to_owned(),
            configuration: config.to_toml()?,
            camera: config.camera.file.as_deref().map(read).transpose()?,
            catalogue: Self::parts_of(catalogue)?,
        })
    }

    /// [`catalogue`](Self::catalogue) of the parts of a catalogue, from their files.
    ///
    /// # Errors
    /// [`ConfigError::Read`]
    pub fn parts_of(catalogue: Option<&Catalogue>) -> Result<BTreeMap<String, String>, ConfigError> {
        let parts = catalogue.map_or(&[][..], Catalogue::parts).iter();
        parts.map(|part| Ok((part.name.clone(), part_digest(&part.folder)?))).collect()
    }

    /// Whether scenes follow from the same: everything but the program.
    pub fn is_set_up_as(&self, other: &Self) -> bool {
        (&self.configuration, &self.camera, &self.catalogue) == (&other.configuration, &other.camera, &other.catalogue)
    }

    /// Twelve hexadecimal digits that tell one configuration, with its camera file and catalogue, from another.
    pub fn digest(&self) -> String {
        let mut hash = Sha256::new();
        let catalogue = self.catalogue.iter().flat_map(|(name, digest)| [name.as_str(), digest]);
        for text in
            [self.configuration.as_str(), self.camera.as_deref().unwrap_or_default()].into_iter().chain(catalogue)
        {
            hash.update((text.len() as u64).to_le_bytes());
            hash.update(text.as_bytes());
        }
        hexadecimal(&hash.finalize()[..6])
    }

    /// What other parts have otherwise than those of [`catalogue`](Self::catalogue), in words.
    pub fn other_parts(&self, now: &BTreeMap<String, String>) -> Vec<String> {
        let mut words = Vec::new();
        for (name, digest) in &self.catalogue {
            match now.get(name) {
                None => words.push(format!("[catalogue] {name} is missing")),
                Some(now) if now != digest => words.push(format!("[catalogue] {name} is another")),
                Some(_) => {}
            }
        }
        let new = now.keys().filter(|name| !self.catalogue.contains_key(*name));
        words.extend(new.map(|name| format!("[catalogue] {name} is new")));
        words
    }

    /// As it stands in a file.
    pub(crate) fn to_metadata(&self) -> BTreeMap<String, String> {
        let parts = self.catalogue.iter().map(|(name, digest)| (format!("part/{name}"), digest.clone()));
        let camera = self.camera.iter().map(|text| ("camera".to_owned(), text.clone()));
        [("version", &self.version), ("build", &self.build), ("configuration", &self.configuration)]
            .into_iter()
            .map(|(key, value)| (key.to_owned(), value.clone()))
            .chain(camera)
            .chain(parts)
            .collect()
    }

    /// From a file; what is missing is empty.
    pub(crate) fn from_metadata(mut metadata: BTreeMap<String, String>) -> Self {
        let mut take = |key: &str| metadata.remove(key).unwrap_or_default();
        let (version, build, configuration) = (take("version"), take("build"), take("configuration"));
        let camera = metadata.remove("camera");
        let parts =
            metadata.into_iter().filter_map(|(key, digest)| Some((key.strip_prefix("part/")?.to_owned(), digest)));
        Self { version, build, configuration, camera, catalogue: parts.collect() }
    }
}

/// SHA-256 over the files of a part. A model is not needed.
fn part_digest(folder: &Path) -> Result<String, ConfigError> {
    let mut hash = Sha256::new();
    for name in PART_FILES {
        let path = folder.join(name);
        match fs::read(&path) {
            Ok(bytes) => {
                hash.update((bytes.len() as u64).to_le_bytes());
                hash.update(&bytes);
            }
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => hash.update(u64::MAX.to_le_bytes()),
            Err(source) => return Err(ConfigError::Read { path, source }),
        }
    }
    Ok(hexadecimal(&hash.finalize()))
}

fn hexadecimal(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_survives_the_way_through_a_file_and_its_digest_tells_what_scenes_follow_from() {
        let whole = MadeWith {
            version: "1.2.3".to_owned(),
            build: "00ff".to_owned(),
            configuration: "[cell]\nname = \"a\"\n".to_owned(),
            camera: Some("[intrinsics]\n".to_owned()),
            catalogue: BTreeMap::from([
                ("hex_nut".to_owned(), "12".to_owned()),
                ("washer".to_owned(), "34".to_owned()),
            ]),
        };
        assert_eq!(MadeWith::from_metadata(whole.to_metadata()), whole);
        let without = MadeWith { camera: None, catalogue: BTreeMap::new(), ..whole.clone() };
        assert_eq!(MadeWith::from_metadata(without.to_metadata()), without);
        assert_ne!(whole.digest(), without.digest());
        let other_program = MadeWith { build: "0100".to_owned(), ..whole.clone() };
        assert!(whole.is_set_up_as(&other_program) && whole.digest() == other_program.digest());
        let mut taught_anew = whole.clone();
        taught_anew.catalogue.insert("washer".to_owned(), "35".to_owned());
        assert!(!whole.is_set_up_as(&taught_anew) && whole.digest() != taught_anew.digest());
    }

    #[test]
    fn the_digest_of_a_part_follows_its_files() {
        let folder = tempfile::tempdir().unwrap();
        let digest = || part_digest(folder.path()).unwrap();
        let empty = digest();
        fs::write(folder.path().join("part.toml"), "name = \"a\"").unwrap();
        let with_file = digest();
        // What is computed from the others is no part of it.
        fs::write(folder.path().join("descriptors"), "cache").unwrap();
        assert_eq!(digest(), with_file);
        fs::write(folder.path().join("model.stl"), "").unwrap();
        assert!(empty != with_file && with_file != digest(), "an empty model is not none");
    }
}
