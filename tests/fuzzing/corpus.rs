//! What a target is fed before a fuzzer has ideas of its own. Of each target are kept, in `tests/fuzz`:
//!
//! - `regressions/TARGET/NAME`: what once broke a promise, named after what it is,
//! - `corpus/TARGET.tar.zst`: what fuzzing found to reach other code than the rest.
//!
//! A fuzz target unpacks both, with its seeds, into `tests/fuzz/corpus/TARGET` when it starts, where `cargo fuzz` reads
//! and adds to them. What it has found is kept by (in `tests/fuzz`):
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
    /// Seeds, regressions and the archive, each with its name.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn inputs(&self) -> io::Result<Vec<(String, Vec<u8>)>> {
        let seeds = (self.seeds)().into_iter().enumerate();
        let mut inputs: Vec<_> = seeds.map(|(index, seed)| (format!("seed-{index}"), seed)).collect();
        inputs.extend(self.regressions()?);
        inputs.extend(self.archived()?);
        Ok(inputs)
    }

    /// What once broke a promise.
    ///
    /// # Errors
    /// A file that cannot be read.
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

    /// What the archive has.
    ///
    /// # Errors
    /// No archive, or one that cannot be read.
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

/// Puts the inputs of the target of that name where `cargo fuzz` reads them.
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
