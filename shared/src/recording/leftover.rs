//! Files that a crash, a kill or a power cut left behind, and damaged ones.
//!
//! The original goes only when its successor has been read back, and stays as `.mcap.torn` if any of its bytes
//! could not be used. At every moment one of the two is there under a name that says what it is.

use std::fs::{File, OpenOptions};
use std::io::{self, BufReader, BufWriter, Seek};
use std::path::{Path, PathBuf};

use super::recover::{self, SalvageError, Salvaged};
use super::run_file::{
    ACTIVE_ENDING, FINISHED_ENDING, TORN_ENDING, UNNAMED_ENDING, io_error, lock, rename, sync_directory,
};
use super::schema::RunMetadata;
use super::writer::WriteError;

/// Ending of a recovered file that has not been read back yet.
const RECOVERING_ENDING: &str = "mcap.recovering";
/// Originals of one name that are kept beside each other.
const TORN_MAX: u32 = 1000;

/// What became of a file.
#[derive(Debug, Clone, PartialEq)]
pub enum Recovery {
    /// It is whole and finished; nothing was changed.
    Whole {
        /// What it holds.
        content: Box<Salvaged>,
    },
    /// It was finished and only lacked its final name.
    Renamed {
        /// Under its final name.
        file: PathBuf,
        /// What it holds.
        content: Box<Salvaged>,
    },
    /// What was whole in it is now a finished recording.
    Recovered {
        /// The finished recording.
        file: PathBuf,
        /// The original, where a part of it could not be read.
        torn: Option<PathBuf>,
        /// What was taken out of it.
        content: Box<Salvaged>,
    },
}

/// Why a file could not be recovered. It is then as it was.
#[derive(Debug, thiserror::Error)]
pub enum RecoverError {
    /// Not the name of a recording.
    #[error("{}: not a recording; its name must end in .mcap or .mcap.active", .0.display())]
    NotARecording(PathBuf),
    /// A living process has it.
    #[error("{}: is being written by a running ballbard; stop that run instead", .0.display())]
    Busy(PathBuf),
    /// The system refused.
    #[error("{}: cannot be read: {source}; check the path and its permissions", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// Its content cannot be taken out.
    #[error("{}: {source}", path.display())]
    Salvage {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: SalvageError,
    },
    /// Names could not be given.
    #[error(transparent)]
    Write(#[from] WriteError),
}

/// One file that was found left behind.
#[derive(Debug)]
pub struct Leftover {
    /// Where it was.
    pub file: PathBuf,
    /// What became of it.
    pub outcome: Result<Recovery, RecoverError>,
}

/// Makes a finished recording out of a file, whatever is wrong with it.
pub fn recover_file(path: &Path) -> Result<Recovery, RecoverError> {
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let active = name.strip_suffix(&format!(".{ACTIVE_ENDING}"));
    let stem = active.or_else(|| name.strip_suffix(&format!(".{FINISHED_ENDING}")));
    let stem = stem.ok_or_else(|| RecoverError::NotARecording(path.to_owned()))?;
    let io = |source| RecoverError::Io { path: path.to_owned(), source };
    let original = lock(File::open(path).map_err(io)?).map_err(|error| match error.kind() {
        io::ErrorKind::WouldBlock => RecoverError::Busy(path.to_owned()),
        _ => io(error),
    })?;
    let finished = path.with_file_name(format!("{stem}.{FINISHED_ENDING}"));
    let salvage = |source| RecoverError::Salvage { path: path.to_owned(), source };
    if let Ok(content) = recover::check(BufReader::new(&*original)) {
        let content = Box::new(content);
        if active.is_none() {
            return Ok(Recovery::Whole { content });
        }
        original.sync_all().map_err(io)?;
        rename(path, &finished)?;
        return Ok(Recovery::Renamed { file: finished, content });
    }
    if active.is_some() && finished.exists() {
        let (run, _) = recover::find_run(&*original).map_err(salvage)?;
        return settle_with_existing(path, finished, &run);
    }
    let recovering = path.with_file_name(format!("{stem}.{RECOVERING_ENDING}"));
    let content = rewrite(&original, &recovering).map_err(salvage)?;
    replace(path, &recovering, &finished, content)
}

/// Recovers every file of a directory that was left behind; those of running processes are not touched. What
/// cannot be recovered is renamed, so that it is not tried again; of a file without a byte nothing is kept.
pub fn recover_leftovers(directory: &Path) -> Vec<Leftover> {
    let Ok(entries) = std::fs::read_dir(directory) else { return Vec::new() };
    let mut files: Vec<_> = entries.flatten().map(|entry| entry.path()).collect();
    files.sort();
    files.retain(|path| is_left_over(path) && !remove_if_empty(path) && !is_unnamed(path));
    let outcomes = files.into_iter().map(|file| Leftover { outcome: recover_file(&file), file });
    outcomes
        .filter(|leftover| !matches!(leftover.outcome, Err(RecoverError::Busy(_))))
        .inspect(|leftover| {
            if let Err(RecoverError::Salvage { source: SalvageError::NothingWhole(_), .. }) = leftover.outcome
            {
                // Its outcome is reported; that it keeps its name would only be tried again.
                let _ = set_aside(&leftover.file);
            }
        })
        .collect()
}

/// The name is one that a crash leaves: of a run that was being written, or of a file that had no name yet.
fn is_left_over(path: &Path) -> bool {
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let is_active = !name.starts_with('.') && name.ends_with(&format!(".{ACTIVE_ENDING}"));
    is_active || unnamed_by(path).is_some_and(|process| !Path::new("/proc").join(process).exists())
}

fn is_unnamed(path: &Path) -> bool {
    unnamed_by(path).is_some()
}

/// The process that was about to name this file.
fn unnamed_by(path: &Path) -> Option<&str> {
    let name = path.file_name()?.to_str()?.strip_prefix('.')?.strip_suffix(UNNAMED_ENDING)?;
    name.split_once('-').map(|(process, _)| process)
}

/// Removes a file in which there is nothing, and which nobody is about to fill.
fn remove_if_empty(path: &Path) -> bool {
    let is_empty = |file: &File| file.metadata().is_ok_and(|found| found.len() == 0);
    let unused = File::open(path).ok().filter(is_empty).and_then(|file| lock(file).ok());
    unused.is_some_and(|unused| is_empty(&unused) && std::fs::remove_file(path).is_ok())
}

/// Writes what is whole beside the original and reads it back.
fn rewrite(original: &File, recovering: &Path) -> Result<Salvaged, SalvageError> {
    let created = OpenOptions::new().read(true).write(true).create(true).truncate(true).open(recovering);
    let outcome = created.map_err(|error| io_error(recovering)(error).into()).and_then(|file| {
        let (content, written) = recover::salvage(original, BufWriter::new(file))?;
        let mut file = written.into_inner().map_err(|error| io_error(recovering)(error.into_error()))?;
        file.sync_all().and_then(|()| file.rewind()).map_err(io_error(recovering))?;
        recover::verify(BufReader::new(file), &content)?;
        Ok(content)
    });
    if outcome.is_err() {
        // The original is untouched; half a copy is of no use to anybody.
        let _ = std::fs::remove_file(recovering);
    }
    outcome
}

/// Gives the recovered file its final name; then the original goes, or is kept where bytes of it were not used.
fn replace(
    path: &Path,
    recovering: &Path,
    finished: &Path,
    content: Salvaged,
) -> Result<Recovery, RecoverError> {
    let torn = if path == finished {
        let torn = free_torn_name(path)?;
        std::fs::hard_link(path, &torn).map_err(io_error(&torn))?;
        std::fs::rename(recovering, finished).map_err(io_error(finished))?;
        sync_parent(finished)?;
        Some(torn)
    } else {
        rename(recovering, finished)?;
        // Of a run that had ended something is not as it was written, or it would be whole.
        if content.damage.is_some() || content.end.is_some() {
            Some(set_aside(path)?)
        } else {
            std::fs::remove_file(path).map_err(io_error(path))?;
            sync_parent(path)?;
            None
        }
    };
    Ok(Recovery::Recovered { file: finished.to_owned(), torn, content: Box::new(content) })
}

/// A crash during an earlier recovery left both; if the finished one is whole and of this run, it stands.
fn settle_with_existing(path: &Path, finished: PathBuf, run: &RunMetadata) -> Result<Recovery, RecoverError> {
    let existing = File::open(&finished).ok().and_then(|file| recover::check(BufReader::new(file)).ok());
    match existing.filter(|existing| existing.run == *run) {
        Some(existing) => {
            let torn = set_aside(path)?;
            Ok(Recovery::Recovered { file: finished, torn: Some(torn), content: Box::new(existing) })
        }
        None => Err(WriteError::Exists(finished).into()),
    }
}

/// Renames a file to `.mcap.torn`.
fn set_aside(path: &Path) -> Result<PathBuf, WriteError> {
    let torn = free_torn_name(path)?;
    rename(path, &torn)?;
    Ok(torn)
}

fn free_torn_name(path: &Path) -> Result<PathBuf, WriteError> {
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let stem = name.trim_end_matches(".active").trim_end_matches(".mcap");
    let numbered = (1..TORN_MAX).map(|number| format!("{stem}-{number}.{TORN_ENDING}"));
    let first = path.with_file_name(format!("{stem}.{TORN_ENDING}"));
    std::iter::once(first.clone())
        .chain(numbered.map(|name| path.with_file_name(name)))
        .find(|candidate| !candidate.exists())
        .ok_or(WriteError::Exists(first))
}

fn sync_parent(path: &Path) -> Result<(), WriteError> {
    let directory = path.parent().unwrap_or(Path::new("."));
    sync_directory(directory).map_err(io_error(directory))
}

/// A living process writes the file, or it cannot be asked.
pub fn is_in_use(path: &Path) -> bool {
    File::open(path).and_then(lock).is_err()
}
