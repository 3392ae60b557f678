//! A frame on which the vision chain panicked, kept aside with the configuration: all that is needed to see it again.
//!
//! Output: two files beside the recording, named after it and the frame: `demo-20260101T120000.000Z-panic-17.png` and `.toml`;
//! `samsod inspect` takes both.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use samsod::segment::RgbView;

/// Frames that are kept of one run: a bug that strikes at every frame must not fill the disk.
pub(crate) const MOST_KEPT: u64 = 10;

/// Why a frame could not be kept.
#[derive(Debug, thiserror::Error)]
pub(crate) enum KeepError {
    /// The picture cannot be written.
    #[error("cannot write {}: {cause}", path.display())]
    Picture {
        /// The file.
        path: PathBuf,
        /// What the encoder or the system said.
        cause: image::ImageError,
    },
    /// The configuration cannot be written.
    #[error("cannot write {}: {cause}", path.display())]
    Configuration {
        /// The file.
        path: PathBuf,
        /// What the system said.
        cause: io::Error,
    },
}

/// Writes a frame and the configuration in force; returns the path of the picture.
pub(crate) fn keep(
    recording: &Path,
    sequence: u64,
    image: &RgbView<'_>,
    configuration: &str,
) -> Result<PathBuf, KeepError> {
    let with = |extension: &str| {
        let mut name = recording.with_extension("").into_os_string();
        name.push(format!("-panic-{sequence}.{extension}"));
        PathBuf::from(name)
    };
    let (picture, path) = (with("png"), with("toml"));
    // First what fails least: a picture without its configuration is of less use.
    fs::write(&path, configuration).map_err(|cause| KeepError::Configuration { path, cause })?;
    image.save(&picture).map_err(|cause| KeepError::Picture { path: picture.clone(), cause })?;
    Ok(picture)
}
