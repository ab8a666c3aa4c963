//! Notes that people change after a run. The recording stays unchanged. The changed note is saved in a file next to the
//! recording, and replaces the recorded note in lists and tables.

use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shared::recording::schema::RunMetadata;
use shared::recording::{Disk, RunOverview};
use shared::time::UtcNs;

use super::unless_absent;
use crate::whole_file;

#[derive(Debug, Serialize, Deserialize)]
struct Note {
    /// Start of the run that the note belongs to. If another recording gets the same name later, its start differs, so the
    /// note is not used for that recording.
    run_started: UtcNs,
    note: String,
}

/// Path of the note of a recording.
pub fn beside(recording: &Path) -> PathBuf {
    recording.with_extension("note.json")
}

/// Saves the note of a finished recording. An empty note replaces the recorded one, too.
pub fn keep(disk: &dyn Disk, recording: &Path, note: String) -> io::Result<()> {
    let overview = RunOverview::open_on(disk, recording).map_err(io::Error::other)?;
    let note = Note { run_started: overview.run.started, note };
    whole_file::write(disk, &beside(recording), &serde_json::to_string(&note)?)
}

/// Replaces the recorded note by the saved one. If the saved note cannot be read, the error is appended to the recorded note.
pub fn apply(disk: &dyn Disk, recording: &Path, run: &mut RunMetadata) {
    match read(disk, &beside(recording)) {
        Ok(Some(Note { run_started, note })) if run_started == run.started => run.note = note,
        Ok(_) => {}
        Err(error) => run.note = format!("{} (a later note cannot be read: {error})", run.note),
    }
}

fn read(disk: &dyn Disk, file: &Path) -> io::Result<Option<Note>> {
    Ok(whole_file::read(disk, file)?.map(|text| serde_json::from_str(&text)).transpose()?)
}

/// Removes the note of a recording that is being removed.
pub fn remove(disk: &dyn Disk, recording: &Path) -> io::Result<()> {
    unless_absent(disk.remove(&beside(recording)))
}
