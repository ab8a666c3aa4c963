//! Moves the files of an earlier calibration in the directory of results to a folder `earlier` (then `earlier-2` and so on),
//! so that files of two calibrations are never mixed.

use std::path::{Path, PathBuf};

use super::file::FileError;
use crate::report::page::is_page;

/// All files of a calibration except `experiment.toml`. Files that other programs read come first.
const FILES: [&str; 10] = [
    "calibration.toml",
    "calibration.json",
    "corrections.csv",
    "corrections_log.csv",
    "offsets.csv",
    "offsets_log.csv",
    "robot.urdf",
    "dh.csv",
    "residuals.csv",
    "report.html",
];

/// An earlier calibration, and the directory to which the files of this calibration can be moved.
#[derive(Debug)]
pub(crate) struct Earlier<'d> {
    directory: &'d Path,
    destination: PathBuf,
}

impl<'d> Earlier<'d> {
    /// Finds the calibration in a directory. `None` if the directory contains no calibration.
    pub fn in_directory(directory: &'d Path) -> Option<Self> {
        let is_there =
            ["calibration.toml", "calibration.json"].iter().any(|name| directory.join(name).exists());
        is_there.then(|| {
            let further = (2..).map(|number: u32| format!("earlier-{number}"));
            let mut names = std::iter::once("earlier".to_owned()).chain(further);
            let free = names.find_map(|name| Some(directory.join(name)).filter(|path| !path.exists()));
            Self { directory, destination: free.unwrap_or_else(|| directory.join("earlier")) }
        })
    }

    /// Directory to which the files would be moved.
    pub fn destination(&self) -> &Path {
        &self.destination
    }

    /// Moves the files to the destination and returns its path.
    ///
    /// # Errors
    /// [`FileError::Io`].
    pub fn set_aside(self) -> Result<PathBuf, FileError> {
        let refused = |path: PathBuf| move |source| FileError::Io { path, source };
        std::fs::create_dir(&self.destination).map_err(refused(self.destination.clone()))?;
        for name in FILES {
            let (from, to) = (self.directory.join(name), self.destination.join(name));
            if from.exists() {
                std::fs::rename(&from, &to).map_err(refused(from))?;
            }
        }
        Ok(self.destination)
    }
}

/// Removes the report page of a refused or earlier calibration from a directory into which a calibration is written. The old
/// page would contradict the new files until the new page is written. A `report.html` of another program is kept.
///
/// # Errors
/// [`FileError::Io`].
pub(in crate::report) fn remove_page(directory: &Path) -> Result<(), FileError> {
    let path = directory.join("report.html");
    let text = std::fs::read(&path).unwrap_or_default();
    if !is_page(&String::from_utf8_lossy(&text)) {
        return Ok(());
    }
    std::fs::remove_file(&path).map_err(|source| FileError::Io { path, source })
}
