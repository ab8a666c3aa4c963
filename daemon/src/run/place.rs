//! The directory of the recordings: claiming it for this process, and recovering crashed runs in it.

use std::path::PathBuf;

use shared::recording::{Leftover, Recovery, recover_leftovers_on};

use super::error::RunError;
use crate::claim::Claim;
use crate::record::Storage;

/// Claims the directory, so that no other process records into it. The directory is created if it is
/// missing. If the directory cannot be created, it is not claimed, and the result is `None`. The problem
/// is then reported when the file of the run is created.
pub(crate) fn claim_directory(storage: &Storage) -> Result<Option<Claim>, RunError> {
    let directory = storage.directory();
    let disk = storage.disk();
    if disk.make_directory(directory).is_err() {
        return Ok(None);
    }
    Claim::directory(&*disk, directory)
        .map_err(|holder| RunError::InUse { directory: directory.to_owned(), holder })
}

/// Finishes the recordings of crashed runs, logs each of them, and returns their files.
pub fn finish_leftovers(storage: &Storage) -> Vec<PathBuf> {
    let (disk, places) = (storage.disk(), [storage.directory(), storage.spare()]);
    let leftovers = places.into_iter().flat_map(|place| recover_leftovers_on(&*disk, place));
    let mut finished = Vec::new();
    for Leftover { file, outcome } in leftovers {
        match outcome {
            Ok(Recovery::Recovered { file, content, .. } | Recovery::Renamed { file, content }) => {
                tracing::warn!(
                    file = %file.display(),
                    cycles = content.cycles,
                    "a run left behind by a crash was recovered"
                );
                finished.push(file);
            }
            Ok(Recovery::Whole { .. }) => {}
            Err(error) => tracing::warn!(file = %file.display(), "a file left behind: {error}"),
        }
    }
    finished
}
