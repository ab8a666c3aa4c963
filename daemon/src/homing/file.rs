//! `homing.toml`: what was found, kept beside `ball_bar.toml`.

use std::io;
use std::path::Path;

use shared::config::{self, ConfigError, EncoderConfig, HomingConfig};
use shared::time::UtcNs;

/// What was found last; none if nothing ever was.
pub fn read(file: &Path) -> Result<Option<HomingConfig>, ConfigError> {
    if file.exists() { config::load(file).map(Some) } else { Ok(None) }
}

/// Keeps the counts at the marks, in the order of `encoders`. Under its final name the file is whole, or it is the one
/// before.
pub fn write(file: &Path, encoders: &[EncoderConfig], reference_counts: &[u32]) -> io::Result<()> {
    let homing = HomingConfig::new(UtcNs::from_datetime(chrono::Utc::now()), encoders, reference_counts);
    let text = toml::to_string(&homing).map_err(io::Error::other)?;
    let part = file.with_extension("toml.part");
    let explain = |error: io::Error| {
        let advice = format!("cannot write {}: {error}; check free space and permissions", file.display());
        io::Error::new(error.kind(), advice)
    };
    std::fs::write(&part, format!("# Written by `ballbard home`.\n{text}")).map_err(explain)?;
    std::fs::rename(&part, file).map_err(explain)
}
