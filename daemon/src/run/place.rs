//! The directory of the recordings: claiming it for this process, and recovering crashed runs in it.

use std::path::{Path, PathBuf};

use shared::recording::{Leftover, Recovery, RunOverview, Salvaged, recover_leftovers_on, set_aside};

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
    // The spare directory is first, because `has_moved` needs its finished recordings.
    let (disk, places) = (storage.disk(), [storage.spare(), storage.directory()]);
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
                if has_moved(storage, &file, &content) {
                    let aside = set_aside(&*disk, &file).map_or_else(
                        |error| error.to_string(),
                        |torn| format!("it is now {}", torn.display()),
                    );
                    tracing::warn!(file = %file.display(), "the whole run is in the spare directory; {aside}");
                } else {
                    finished.push(file);
                }
            }
            Ok(Recovery::Whole { .. }) => {}
            Err(error) => tracing::warn!(file = %file.display(), "a file left behind: {error}"),
        }
    }
    finished
}

/// Whether a recovered file has only the beginning of a run that moved to the spare directory. The old file of such a run
/// remains if it cannot be removed, for example because its file system has become read-only.
fn has_moved(storage: &Storage, file: &Path, content: &Salvaged) -> bool {
    let Some(moved) = file.file_name().map(|name| storage.spare().join(name)) else { return false };
    let disk = storage.disk();
    let is_other_file =
        || matches!((disk.id_at(&moved), disk.id_at(file)), (Ok(one), Ok(other)) if one != other);
    let has_all = |moved: RunOverview| {
        moved.run == content.run && moved.end.cycles >= content.cycles && is_other_file()
    };
    RunOverview::open_on(&*disk, &moved).is_ok_and(has_all)
}
