//! The region of interest: where on the picture parts may be picked.
//!
//! Input: a polygon that the operator draws on a frame. Output: whether a pixel lies in it. Everything outside is seen, recorded
//! and kept clear of as before; only nothing there is picked. On frames of another size than the one it was drawn on nobody
//! knows what it means, so nothing at all is picked then.
//!
//! It is kept in a small file, replaced as a whole, and is in force again at the next start.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use serde::{Deserialize, Serialize};

/// Corners that a region may have.
const CORNERS: [usize; 2] = [3, 100];
/// Longest side of a frame, px.
const LONGEST_PX: u32 = samsod_frame::MAX_SIDE_PX;

/// A polygon on frames of one size.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Region {
    /// Width of the frame that it was drawn on, px.
    pub(crate) width_px: u32,
    /// Its height, px.
    pub(crate) height_px: u32,
    /// Corners (x, y) in their order, px, pixel centres at integers; the last joins the first.
    pub(crate) points_px: Vec<[f64; 2]>,
}

/// Why a region is none.
#[derive(Debug, thiserror::Error)]
pub(crate) enum RegionError {
    #[error("{key} is {value}; allowed: {allowed}")]
    Value { key: &'static str, value: String, allowed: String },
    #[error("the region has no area: its corners lie on a line")]
    Flat,
    #[error("cannot use {}: {cause}", path.display())]
    File { path: PathBuf, cause: String },
}

impl Region {
    pub(crate) fn check(&self) -> Result<(), RegionError> {
        for (key, side) in [("width_px", self.width_px), ("height_px", self.height_px)] {
            if !(1..=LONGEST_PX).contains(&side) {
                return Err(RegionError::Value { key, value: side.to_string(), allowed: format!("1 to {LONGEST_PX}") });
            }
        }
        let [least, most] = CORNERS;
        if !(least..=most).contains(&self.points_px.len()) {
            let (value, allowed) = (format!("{} corners", self.points_px.len()), format!("{least} to {most}"));
            return Err(RegionError::Value { key: "points_px", value, allowed });
        }
        let (width, height) = (f64::from(self.width_px), f64::from(self.height_px));
        for &[x, y] in &self.points_px {
            // Written so that NaN is refused.
            if !((-0.5..=width - 0.5).contains(&x) && (-0.5..=height - 0.5).contains(&y)) {
                let allowed = format!("corners on the frame, (-0.5, -0.5) to ({}, {})", width - 0.5, height - 0.5);
                return Err(RegionError::Value { key: "points_px", value: format!("({x}, {y})"), allowed });
            }
        }
        if self.area_px() < 1.0 {
            return Err(RegionError::Flat);
        }
        Ok(())
    }

    /// Whether it has a pixel of a frame of a size.
    pub(crate) fn has(&self, size_px: [u32; 2], [x, y]: [f64; 2]) -> bool {
        if size_px != [self.width_px, self.height_px] {
            return false;
        }
        // A ray to the right crosses the border an odd number of times from inside.
        let mut inside = false;
        for ([ax, ay], [bx, by]) in self.edges() {
            if (ay > y) != (by > y) && x < ax + (y - ay) / (by - ay) * (bx - ax) {
                inside = !inside;
            }
        }
        inside
    }

    fn edges(&self) -> impl Iterator<Item = ([f64; 2], [f64; 2])> {
        self.points_px.iter().zip(self.points_px.iter().cycle().skip(1)).map(|(a, b)| (*a, *b))
    }

    fn area_px(&self) -> f64 {
        (self.edges().map(|([ax, ay], [bx, by])| ax * by - bx * ay).sum::<f64>() / 2.0).abs()
    }
}

/// The region in force, changed by the operator and asked by vision.
#[derive(Debug)]
pub(crate) struct Interest {
    file: PathBuf,
    region: Mutex<Option<Arc<Region>>>,
}

impl Interest {
    /// Reads the file, if there is one.
    pub(crate) fn open(file: PathBuf) -> Result<Self, RegionError> {
        let fail = |cause: String| RegionError::File { path: file.clone(), cause };
        let region = match fs::read_to_string(&file) {
            Ok(text) => {
                let region: Region = toml::from_str(&text).map_err(|e| fail(e.to_string().trim_end().to_owned()))?;
                region.check().map_err(|e| fail(e.to_string()))?;
                Some(Arc::new(region))
            }
            // What is wrong with the folder of the recordings is told by the recorder.
            Err(e) if matches!(e.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => None,
            Err(e) => return Err(fail(e.to_string())),
        };
        Ok(Self { file, region: Mutex::new(region) })
    }

    pub(crate) fn region(&self) -> Option<Arc<Region>> {
        self.region.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Stores a region, or takes it away. It is in force from the next frame on.
    pub(crate) fn set(&self, region: Option<Region>) -> Result<(), RegionError> {
        let fail = |path: &Path, cause: String| RegionError::File { path: path.to_owned(), cause };
        let mut current = self.region.lock().unwrap_or_else(PoisonError::into_inner);
        match &region {
            Some(region) => {
                region.check()?;
                let text = toml::to_string(region).map_err(|e| fail(&self.file, e.to_string()))?;
                let new = self.file.with_extension("new");
                if let Some(folder) = self.file.parent() {
                    fs::create_dir_all(folder).map_err(|e| fail(folder, e.to_string()))?;
                }
                let head = "# Where on the picture parts may be picked; written by the operator's page of samsodd.\n";
                fs::write(&new, head.to_owned() + &text).map_err(|e| fail(&new, e.to_string()))?;
                fs::rename(&new, &self.file).map_err(|e| fail(&self.file, e.to_string()))?;
            }
            None => match fs::remove_file(&self.file) {
                Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(fail(&self.file, e.to_string())),
                _ => {}
            },
        }
        *current = region.map(Arc::new);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn region(points_px: &[[f64; 2]]) -> Region {
        Region { width_px: 100, height_px: 80, points_px: points_px.to_vec() }
    }

    #[test]
    fn a_region_has_what_lies_in_its_polygon_on_frames_of_its_size() {
        // A square with a notch from above.
        let notched =
            region(&[[10.0, 10.0], [40.0, 10.0], [50.0, 50.0], [60.0, 10.0], [90.0, 10.0], [90.0, 70.0], [10.0, 70.0]]);
        notched.check().unwrap();
        let has = |point| notched.has([100, 80], point);
        assert!(has([20.0, 20.0]) && has([50.0, 60.0]) && has([80.0, 20.0]));
        assert!(!has([50.0, 20.0]), "in the notch");
        assert!(!has([5.0, 40.0]) && !has([50.0, 75.0]) && !has([f64::NAN, 40.0]));
        assert!(!notched.has([200, 160], [20.0, 20.0]), "a frame of another size");
    }

    #[test]
    fn what_is_no_region_is_refused_with_the_value() {
        let refused = |points: &[[f64; 2]]| region(points).check().unwrap_err().to_string();
        assert_eq!(refused(&[[1.0, 1.0], [2.0, 2.0]]), "points_px is 2 corners; allowed: 3 to 100");
        assert!(refused(&[[1.0, 1.0], [100.0, 1.0], [1.0, 9.0]]).starts_with("points_px is (100, 1); allowed"));
        assert!(refused(&[[1.0, 1.0], [f64::NAN, 1.0], [1.0, 9.0]]).starts_with("points_px is (NaN, 1); allowed"));
        assert_eq!(refused(&[[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]]), "the region has no area: its corners lie on a line");
        let none = Region { width_px: 0, ..region(&[[1.0, 1.0], [2.0, 1.0], [1.0, 9.0]]) };
        assert!(none.check().unwrap_err().to_string().starts_with("width_px is 0; allowed: 1 to "));
    }

    #[test]
    fn a_region_is_in_force_again_after_a_start_until_it_is_taken_away() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("state/region.toml");
        let interest = Interest::open(file.clone()).unwrap();
        assert_eq!(interest.region(), None);
        let square = region(&[[10.0, 10.0], [40.5, 10.0], [40.0, 50.0]]);
        interest.set(Some(square.clone())).unwrap();
        assert_eq!(Interest::open(file.clone()).unwrap().region().as_deref(), Some(&square));
        // A wrong one changes nothing.
        assert!(interest.set(Some(region(&[]))).is_err());
        assert_eq!(interest.region().as_deref(), Some(&square));
        interest.set(None).unwrap();
        interest.set(None).unwrap();
        assert_eq!((interest.region(), Interest::open(file.clone()).unwrap().region()), (None, None));
        fs::write(&file, "width_px = 3\n").unwrap();
        let refused = Interest::open(file).unwrap_err().to_string();
        assert!(refused.contains("region.toml") && refused.contains("height_px"), "{refused}");
    }
}
