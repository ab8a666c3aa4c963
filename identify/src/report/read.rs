//! Calibrations read back from their files.

use std::path::{Path, PathBuf};

use super::file::{CalibrationFile, SCHEMA};

/// Why a calibration cannot be read.
#[derive(Debug, thiserror::Error)]
#[error("{}: {kind}", path.display())]
pub struct CalibrationReadError {
    path: PathBuf,
    kind: Kind,
}

#[derive(Debug, thiserror::Error)]
enum Kind {
    #[error("cannot be read: {0}")]
    Io(#[from] std::io::Error),
    #[error("is no calibration.json: {0}; give the file that `identify calibrate` wrote, or its directory")]
    Json(#[from] serde_json::Error),
    #[error("is no calibration.toml: {0}; give the file that `identify calibrate` wrote, or its directory")]
    Toml(#[from] toml::de::Error),
    #[error("has schema {found}, this program knows {SCHEMA}; use the program that wrote it")]
    Schema { found: u32 },
}

impl CalibrationFile {
    /// Reads `calibration.json`, `calibration.toml`, or the former in a directory.
    ///
    /// # Errors
    /// [`CalibrationReadError`] names the file.
    pub fn open(path: &Path) -> Result<Self, CalibrationReadError> {
        let path = if path.is_dir() { path.join("calibration.json") } else { path.to_owned() };
        Self::read(&path).map_err(|kind| CalibrationReadError { path, kind })
    }

    fn read(path: &Path) -> Result<Self, Kind> {
        let text = std::fs::read_to_string(path)?;
        let is_toml = path.extension().is_some_and(|ending| ending == "toml");
        let file: Self = if is_toml { toml::from_str(&text)? } else { serde_json::from_str(&text)? };
        if file.schema == SCHEMA { Ok(file) } else { Err(Kind::Schema { found: file.schema }) }
    }
}
