//! Notes that people change after a run. The recording stays unchanged: the note is a file beside it, and replaces the
//! recorded one in lists and tables.

use std::io::{self, Read};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shared::recording::schema::RunMetadata;
use shared::recording::{Disk, OpenFile, RunOverview, is_absent};
use shared::time::UtcNs;

use crate::whole_file;

/// Longer than any note; other files of this name are not read to their end \[bytes\].
const BYTES_MAX: u64 = 65_536;

#[derive(Debug, Serialize, Deserialize)]
struct Note {
    /// Start of the run concerned: another recording may get the name.
    run_started: UtcNs,
    note: String,
}

/// The file of the note of a recording.
pub fn beside(recording: &Path) -> PathBuf {
    recording.with_extension("note.json")
}

/// Saves the note of a finished recording, which may be empty.
pub fn keep(disk: &dyn Disk, recording: &Path, note: String) -> io::Result<()> {
    let overview = RunOverview::open_on(disk, recording).map_err(io::Error::other)?;
    let note = Note { run_started: overview.run.started, note };
    whole_file::write(disk, &beside(recording), &serde_json::to_string(&note)?)
}

/// Replaces the recorded note by the saved one. If that cannot be read, the note states so.
pub fn apply(disk: &dyn Disk, recording: &Path, run: &mut RunMetadata) {
    match read(disk, &beside(recording)) {
        Ok(Some(Note { run_started, note })) if run_started == run.started => run.note = note,
        Ok(_) => {}
        Err(error) => run.note = format!("{} (a later note cannot be read: {error})", run.note),
    }
}

fn read(disk: &dyn Disk, file: &Path) -> io::Result<Option<Note>> {
    let opened = match disk.open(file) {
        Err(error) if is_absent(&error) => return Ok(None),
        opened => opened?,
    };
    let mut text = String::new();
    OpenFile::new(disk, &opened).take(BYTES_MAX).read_to_string(&mut text)?;
    Ok(Some(serde_json::from_str(&text)?))
}

/// Removes the note of a recording that is being removed.
pub fn remove(disk: &dyn Disk, recording: &Path) -> io::Result<()> {
    match disk.remove(&beside(recording)) {
        Err(error) if is_absent(&error) => Ok(()),
        removed => removed,
    }
}
