//! Inputs of the fuzz targets. For each target, `tests/fuzz` contains:
//!
//! - `regressions/TARGET/NAME`: inputs that once caused a failure, each named after the property that it violated,
//! - `corpus/TARGET.tar.zst`: inputs found by fuzzing, each of which reaches additional code.
//!
//! When a fuzz target starts, it writes these inputs and its seeds to `tests/fuzz/corpus/TARGET`. `cargo fuzz` reads that
//! directory and adds new inputs to it. To save the new inputs, run in `tests/fuzz`:
//!
//! ```sh
//! cargo +nightly fuzz cmin -s none --fuzz-dir . TARGET
//! tar --zstd --sort=name --owner=0 --group=0 --mtime=@0 -cf corpus/TARGET.tar.zst -C corpus TARGET
//! ```

use std::fs;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use super::Target;

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz")
}

impl Target {
    /// All inputs with their names: seeds, regressions and the archive.
    ///
    /// # Errors
    /// If a file cannot be read.
    pub fn inputs(&self) -> io::Result<Vec<(String, Vec<u8>)>> {
        let seeds = (self.seeds)().into_iter().enumerate();
        let mut inputs: Vec<_> = seeds.map(|(index, seed)| (format!("seed-{index}"), seed)).collect();
        inputs.extend(self.regressions()?);
        inputs.extend(self.archived()?);
        Ok(inputs)
    }

    /// Inputs that once caused a failure, with their names.
    ///
    /// # Errors
    /// If a file cannot be read.
    pub fn regressions(&self) -> io::Result<Vec<(String, Vec<u8>)>> {
        let folder = folder().join("regressions").join(self.name);
        if !folder.exists() {
            return Ok(Vec::new());
        }
        let read = |entry: io::Result<fs::DirEntry>| {
            let entry = entry?;
            Ok((entry.file_name().to_string_lossy().into_owned(), fs::read(entry.path())?))
        };
        fs::read_dir(folder)?.map(read).collect()
    }

    /// Inputs of the archive, with their names.
    ///
    /// # Errors
    /// If the archive is missing or cannot be read.
    pub fn archived(&self) -> io::Result<Vec<(String, Vec<u8>)>> {
        let archive = fs::File::open(folder().join("corpus").join(format!("{}.tar.zst", self.name)))?;
        let mut archive = tar::Archive::new(zstd::Decoder::new(archive)?);
        let mut inputs = Vec::new();
        for entry in archive.entries()? {
            let mut entry = entry?;
            if entry.header().entry_type().is_file() {
                let name = entry.path()?.file_name().unwrap_or_default().to_string_lossy().into_owned();
                let mut bytes = Vec::new();
                entry.read_to_end(&mut bytes)?;
                inputs.push((name, bytes));
            }
        }
        Ok(inputs)
    }
}

/// Writes the inputs of the target of that name to the directory that `cargo fuzz` reads.
///
/// # Panics
/// If they cannot be read or written.
pub fn unpack(name: &str) {
    let target = super::TARGETS.iter().find(|target| target.name == name).expect("a target of that name");
    let folder = folder().join("corpus").join(name);
    fs::create_dir_all(&folder).expect("a folder of the corpus");
    for (name, bytes) in target.inputs().expect("inputs") {
        fs::write(folder.join(name), bytes).expect("an input of the corpus");
    }
}
