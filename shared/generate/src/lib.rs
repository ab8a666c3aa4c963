//! `generate` of both programs: completions and man pages, made of what their commands are.

use std::fs;
use std::io;
use std::path::PathBuf;

use clap::{Args, Command, Subcommand};
use clap_complete::Shell;

use shared::output::show;

/// What is typed after `generate`.
#[derive(Debug, Args)]
pub struct GenerateArguments {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Completions, on standard output.
    Completions {
        /// Shell to complete in
        shell: Shell,
    },
    /// Man pages: one for the program and one for each command.
    Man {
        /// Directory, which must be there
        directory: PathBuf,
    },
}

impl GenerateArguments {
    /// Writes what was asked for of this program.
    ///
    /// # Errors
    /// Where it cannot be written, with where.
    pub fn run(&self, mut program: Command) -> io::Result<()> {
        match &self.what {
            What::Completions { shell } => {
                let name = program.get_name().to_owned();
                let mut text = Vec::new();
                clap_complete::generate(*shell, &mut program, name, &mut text);
                show(String::from_utf8_lossy(&text))
            }
            What::Man { directory } => {
                let explained = |error: io::Error| {
                    let text = format!("cannot write man pages to {}: {error}", directory.display());
                    io::Error::new(error.kind(), text)
                };
                if !fs::metadata(directory).map_err(explained)?.is_dir() {
                    return Err(explained(io::ErrorKind::NotADirectory.into()));
                }
                clap_mangen::generate_to(program, directory).map_err(explained)
            }
        }
    }
}
