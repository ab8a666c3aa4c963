//! Reads and writes small state files. A file is replaced as a whole, so a reader finds either the new
//! or the previous content.

use std::io::{self, Read, Write};
use std::path::Path;
use std::sync::atomic::{AtomicU32, Ordering};

use shared::recording::{Disk, OpenFile, is_absent};

/// Length of the longest file that is read \[bytes\]. Every state file is shorter, so a longer file was
/// not written by this program.
const BYTES_MAX: u64 = 65_536;

/// Text of a file; `None` if it does not exist. A file that is longer than [`BYTES_MAX`] is an error. The beginning of such
/// a file is not returned, because it may be valid text with another meaning than the whole file.
pub fn read(disk: &dyn Disk, file: &Path) -> io::Result<Option<String>> {
    let opened = match disk.open(file) {
        Err(error) if is_absent(&error) => return Ok(None),
        opened => opened?,
    };
    let invalid = |problem: String| io::Error::new(io::ErrorKind::InvalidData, problem);
    let mut bytes = Vec::new();
    OpenFile::new(disk, &opened).take(BYTES_MAX + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > BYTES_MAX {
        return Err(invalid(format!("longer than {BYTES_MAX} bytes, so `ballbard` did not write it")));
    }
    String::from_utf8(bytes).map(Some).map_err(|error| invalid(error.to_string()))
}

/// Writes a temporary file with a unique name, synchronises it, and renames it to `file`. Creates the directory if it does
/// not exist. If two processes write at the same time, the file contains the complete text of one of them. An error contains
/// the path of the file and what to do.
pub fn write(disk: &dyn Disk, file: &Path, text: &str) -> io::Result<()> {
    static NUMBER: AtomicU32 = AtomicU32::new(0);
    let number = NUMBER.fetch_add(1, Ordering::Relaxed);
    let part = &file.with_file_name(format!(".{}-{number}.part", std::process::id()));
    let write = || {
        disk.make_directory(file.parent().unwrap_or(Path::new("")))?;
        let created = disk.create(part)?;
        let mut created = OpenFile::new(disk, &created);
        created.write_all(text.as_bytes())?;
        created.flush()?;
        disk.replace(part, file)
    };
    write().map_err(|error| {
        // Ignore an error of the removal, because the first error is reported.
        let _ = disk.remove(part);
        let advice = format!("cannot write {}: {error}; check free space and permissions", file.display());
        io::Error::new(error.kind(), advice)
    })
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::os::unix::fs::FileExt;
    use std::path::PathBuf;
    use std::sync::atomic::AtomicBool;

    use shared::recording::SystemDisk;

    use super::*;

    /// A disk on which another process writes the same file just before the first write.
    #[derive(Debug)]
    struct Two {
        file: PathBuf,
        has_written: AtomicBool,
    }

    impl Disk for Two {
        fn write_at(&self, file: &File, bytes: &[u8], offset: u64) -> io::Result<usize> {
            if !self.has_written.swap(true, Ordering::Relaxed) {
                write(self, &self.file, "the note of the other, which is longer").unwrap();
            }
            file.write_at(bytes, offset)
        }
    }

    #[test]
    fn a_file_is_read_whole_or_not_at_all() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("note.json");
        assert_eq!(read(&SystemDisk, &file).unwrap(), None);
        let longest = "x".repeat(BYTES_MAX as usize);
        std::fs::write(&file, &longest).unwrap();
        assert!(read(&SystemDisk, &file).unwrap().is_some_and(|text| text == longest));
        std::fs::write(&file, longest + "y").unwrap();
        let error = read(&SystemDisk, &file).unwrap_err().to_string();
        assert!(error.contains("longer than 65536 bytes"), "{error}");
    }

    #[test]
    fn of_two_concurrent_writers_the_last_wins_completely() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("note.json");
        let disk = Two { file: file.clone(), has_written: AtomicBool::default() };
        write(&disk, &file, "the note of one").unwrap();
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "the note of one");
        assert_eq!(std::fs::read_dir(directory.path()).unwrap().count(), 1, "nothing else is left");
    }
}
