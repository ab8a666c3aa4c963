//! `ballbard generate`: completions and man pages, made of what the commands are.

use std::fs;
use std::path::PathBuf;

use anyhow::Context;
use clap::{Args, CommandFactory, Subcommand};
use clap_complete::Shell;
use shared::output::unless_gone;

use super::Arguments;

#[derive(Debug, Args)]
pub struct GenerateArguments {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Completions, on standard output.
    Completions {
        /// Which shell
        shell: Shell,
    },
    /// Man pages: `ballbard.1` and one for each command.
    Man {
        /// Directory, which must be there
        directory: PathBuf,
    },
}

pub fn run(arguments: &GenerateArguments) -> anyhow::Result<()> {
    let mut command = Arguments::command();
    match &arguments.what {
        What::Completions { shell } => {
            let mut text = Vec::new();
            clap_complete::generate(*shell, &mut command, "ballbard", &mut text);
            let written = std::io::Write::write_all(&mut std::io::stdout().lock(), &text);
            Ok(unless_gone(written)?)
        }
        What::Man { directory } => {
            anyhow::ensure!(
                fs::metadata(directory).is_ok_and(|found| found.is_dir()),
                "{} is no directory",
                directory.display()
            );
            clap_mangen::generate_to(command, directory)
                .with_context(|| format!("cannot write man pages to {}", directory.display()))
        }
    }
}
