//! Small files of state: under its name such a file is whole, or it is the one before.

use std::io::{self, Write};
use std::path::Path;
use std::sync::atomic::{AtomicU32, Ordering};

use shared::recording::{Disk, OpenFile};

/// Writes it beside `file` under a name that no other writer has, synchronises it, and gives it the name; makes its
/// directory. Of two that write at once one stands, whole. An error names the file and what to do.
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
        // What went wrong is reported, not this.
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

    use super::*;

    /// A disk on which another writes the same file while the first is about to.
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
    fn of_two_that_write_at_once_the_last_stands_whole() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("note.json");
        let disk = Two { file: file.clone(), has_written: AtomicBool::default() };
        write(&disk, &file, "the note of one").unwrap();
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "the note of one");
        assert_eq!(std::fs::read_dir(directory.path()).unwrap().count(), 1, "nothing else is left");
    }
}
