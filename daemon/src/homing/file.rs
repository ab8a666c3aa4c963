//! `homing.toml`: what was found, kept beside `ball_bar.toml`.

use std::io::{self, Read, Write};
use std::path::Path;

use shared::config::{self, ConfigError, EncoderConfig, HomingConfig};
use shared::recording::{Disk, OpenFile, is_absent};
use shared::time::UtcNs;

/// What was found last; none if nothing ever was.
pub fn read(disk: &dyn Disk, file: &Path) -> Result<Option<HomingConfig>, ConfigError> {
    let unreadable = |source| ConfigError::Unreadable { path: file.to_owned(), source };
    let opened = match disk.open(file) {
        Err(error) if is_absent(&error) => return Ok(None),
        opened => opened.map_err(unreadable)?,
    };
    let mut text = String::new();
    OpenFile::new(disk, &opened).read_to_string(&mut text).map_err(unreadable)?;
    config::parse(&text, file).map(Some)
}

/// Keeps the counts at the marks, in the order of `encoders`. Under its final name the file is whole, or it is the one
/// before.
pub fn write(
    disk: &dyn Disk,
    file: &Path,
    encoders: &[EncoderConfig],
    reference_counts: &[u32],
) -> io::Result<()> {
    let homing = HomingConfig::new(UtcNs::from_datetime(chrono::Utc::now()), encoders, reference_counts);
    let text = toml::to_string(&homing).map_err(io::Error::other)?;
    let part = file.with_extension("toml.part");
    let explain = |error: io::Error| {
        let advice = format!("cannot write {}: {error}; check free space and permissions", file.display());
        io::Error::new(error.kind(), advice)
    };
    let create = || {
        let created = disk.create(&part)?;
        let mut created = OpenFile::new(disk, &created);
        created.write_all(format!("# Written by `ballbard home`.\n{text}").as_bytes())?;
        created.flush()?;
        disk.replace(&part, file)
    };
    create().map_err(explain)
}
