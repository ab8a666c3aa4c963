//! Free space, and the floor at which recording stops while there is still room to finish the file.

use std::io;
use std::path::{Path, PathBuf};

use nix::sys::statvfs::statvfs;

const BYTES_PER_MB: u64 = 1_000_000;

/// The space that recordings leave free on their file system.
#[derive(Debug, Clone)]
pub struct DiskFloor {
    directory: PathBuf,
    floor_bytes: u64,
}

impl DiskFloor {
    /// Leaves `floor_mb` free where `directory` is or will be \[MB\].
    pub fn new(directory: &Path, floor_mb: u32) -> Self {
        Self { directory: directory.to_owned(), floor_bytes: u64::from(floor_mb) * BYTES_PER_MB }
    }

    /// Space that a recording may still use: free space above the floor; none where the floor is reached \[bytes\].
    pub fn usable_bytes(&self) -> io::Result<Option<u64>> {
        // A directory that is not there yet will be made on the file system of the nearest one that is.
        let existing = self.directory.ancestors().find(|path| path.exists()).unwrap_or(Path::new("."));
        let existing = if existing.as_os_str().is_empty() { Path::new(".") } else { existing };
        let system = statvfs(existing)?;
        let free_bytes = system.blocks_available() as u64 * system.fragment_size() as u64;
        Ok(free_bytes.checked_sub(self.floor_bytes))
    }

    /// Why nothing may be recorded now; none if it may. A file system that does not tell is trusted.
    pub fn problem(&self) -> Option<String> {
        match self.usable_bytes() {
            Ok(None) => Some(format!(
                "disk floor: less than {} MB are free where {} is; delete or move recordings, or lower `disk_floor_mb` \
                 in daemon.toml",
                self.floor_bytes / BYTES_PER_MB,
                self.directory.display()
            )),
            _ => None,
        }
    }
}
