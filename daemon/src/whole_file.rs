//! Small files of state: under its name such a file is whole, or it is the one before.

use std::io::{self, Write};
use std::path::Path;

use shared::recording::{Disk, OpenFile};

/// Writes it beside `file`, synchronises it, and gives it the name; makes its directory. An error names the file and what to do.
pub fn write(disk: &dyn Disk, file: &Path, text: &str) -> io::Result<()> {
    let mut part = file.as_os_str().to_owned();
    part.push(".part");
    let part = Path::new(&part);
    let write = || {
        disk.make_directory(file.parent().unwrap_or(Path::new("")))?;
        let created = disk.create(part)?;
        let mut created = OpenFile::new(disk, &created);
        created.write_all(text.as_bytes())?;
        created.flush()?;
        disk.replace(part, file)
    };
    write().map_err(|error| {
        let advice = format!("cannot write {}: {error}; check free space and permissions", file.display());
        io::Error::new(error.kind(), advice)
    })
}
