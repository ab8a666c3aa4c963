//! Reads and writes `homing.toml` in the state directory, the file with the counts of the reference marks.

use std::io;
use std::path::{Path, PathBuf};

use shared::config::{self, ConfigError, EncoderConfig, HomingConfig};
use shared::recording::Disk;
use shared::time::UtcNs;

use crate::problem::{Fact, Problem};
use crate::whole_file;

/// The file with the reference marks. The program determines the marks, so they are state and not configuration. The
/// directory of the configuration may belong to another user.
#[derive(Debug, Clone)]
pub struct MarksFile {
    directory: PathBuf,
    file: PathBuf,
    /// Path at which earlier versions wrote the file. That file is read if `file` does not exist.
    older: Option<PathBuf>,
}

impl MarksFile {
    /// The file in the state directory `directory`. `older` is the path of earlier versions.
    pub fn new(directory: PathBuf, older: Option<PathBuf>) -> Self {
        Self { file: directory.join(HomingConfig::FILE_NAME), directory, older }
    }

    /// Path of the file.
    pub fn path(&self) -> &Path {
        &self.file
    }

    /// Reads the marks that were last saved. `None` if no marks were saved.
    pub fn read(&self, disk: &dyn Disk) -> Result<Option<HomingConfig>, ConfigError> {
        for file in std::iter::once(&self.file).chain(&self.older) {
            let unreadable = |source| ConfigError::Unreadable { path: file.to_owned(), source };
            if let Some(text) = whole_file::read(disk, file).map_err(unreadable)? {
                return config::parse(&text, file).map(Some);
            }
        }
        Ok(None)
    }

    /// Checks whether marks can be saved. Returns the reason if not. Saving may still fail later.
    pub fn problem(&self, disk: &dyn Disk) -> Option<Problem> {
        let directory = self.directory.display();
        let error = match disk.space(&self.directory) {
            Ok(space) if !space.is_writable => format!("{directory} cannot be written"),
            Ok(space) if space.free_bytes == 0 => format!("{directory} is on a full disk"),
            Ok(_) => return None,
            Err(error) => format!("{directory}: {error}"),
        };
        Some(Fact::MarksUnwritable { error }.into())
    }

    /// Saves the counts at the reference marks, in the order of `encoders`.
    pub fn write(
        &self,
        disk: &dyn Disk,
        encoders: &[EncoderConfig],
        reference_counts: &[u32],
    ) -> io::Result<()> {
        let now = UtcNs::from_datetime(chrono::Utc::now());
        let homing = HomingConfig::new(now, encoders, reference_counts);
        let text = config::to_toml(&homing).map_err(io::Error::other)?;
        whole_file::write(disk, &self.file, &format!("# Written by `ballbard home`.\n{text}"))
    }
}
