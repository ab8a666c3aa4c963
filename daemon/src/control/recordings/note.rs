//! Notes that people change after a run. The recording stays as it was recorded: the note is a file beside it, and stands
//! for the recorded one wherever runs are shown or written as tables.

use std::io::{self, Read};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shared::recording::schema::RunMetadata;
use shared::recording::{Disk, OpenFile, RunOverview, is_absent};
use shared::time::UtcNs;

use crate::whole_file;

/// Far longer than any note; whatever else has the name is not read to its end \[bytes\].
const BYTES_MAX: u64 = 65_536;

#[derive(Debug, Serialize, Deserialize)]
struct Note {
    /// When the run began that it is about: another recording may get the name.
    run_started: UtcNs,
    note: String,
}

/// The file of the note of a recording.
pub fn beside(recording: &Path) -> PathBuf {
    recording.with_extension("note.json")
}

/// Keeps the note of a finished recording, an empty one too.
pub fn keep(disk: &dyn Disk, recording: &Path, note: String) -> io::Result<()> {
    let overview = RunOverview::open_on(disk, recording).map_err(io::Error::other)?;
    let note = Note { run_started: overview.run.started, note };
    whole_file::write(disk, &beside(recording), &serde_json::to_string(&note)?)
}

/// Puts the note that was kept in the place of the recorded one. One that cannot be read says so.
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

/// Removes the note of a recording that goes.
pub fn remove(disk: &dyn Disk, recording: &Path) -> io::Result<()> {
    match disk.remove(&beside(recording)) {
        Err(error) if is_absent(&error) => Ok(()),
        removed => removed,
    }
}
