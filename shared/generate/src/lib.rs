//! The command `generate` of both programs. It writes shell completions and man pages from the command tree of the program.
//! The module [`page`] writes the book's page about the commands.

pub mod page;

use std::fs;
use std::io;
use std::path::PathBuf;

use clap::{Args, Command, Subcommand};
use clap_complete::Shell;

use shared::output::show;

/// Returns a function that adds the example to the help of a command below `generate`. `program` is the name in the example.
pub fn with_example(program: &str) -> impl Fn(Command) -> Command {
    move |command| {
        let value = if command.get_name() == "man" { "man1" } else { "bash" };
        let example = format!("{}{program} generate {} {value}", page::EXAMPLE, command.get_name());
        command.after_help(example)
    }
}

/// Arguments of `generate`.
#[derive(Debug, Args)]
pub struct GenerateArguments {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Print completions for a shell
    Completions {
        /// Shell for which completions are printed
        shell: Shell,
    },
    /// Write man pages: one for the program and one for each command
    Man {
        /// Existing directory for the pages
        directory: PathBuf,
    },
}

impl GenerateArguments {
    /// Writes the requested completions or man pages of this program.
    ///
    /// # Errors
    /// If the pages cannot be written. The message contains the directory.
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
