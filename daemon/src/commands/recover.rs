//! `ballbard recover`: a finished recording out of one that was cut short or damaged.

use std::path::PathBuf;

use clap::Args;
use shared::output::say;
use shared::recording::{Recovery, Salvaged, recover_file};

#[derive(Debug, Args)]
pub struct RecoverArguments {
    /// The recording, `.mcap.active` or `.mcap`
    file: PathBuf,
}

pub fn run(arguments: &RecoverArguments) -> anyhow::Result<()> {
    match recover_file(&arguments.file)? {
        Recovery::Whole { content } => {
            let file = arguments.file.display();
            say(format_args!("{file}: whole, {} cycles; nothing to recover", content.cycles))?;
        }
        Recovery::Renamed { file, content } => {
            say(format_args!(
                "{}: was finished, {} cycles; it has its name now",
                file.display(),
                content.cycles
            ))?;
        }
        Recovery::Recovered { file, torn, content } => {
            say(format_args!("{}: {}", file.display(), kept(&content)))?;
            if let Some(timing) = &content.timing {
                say(timing)?;
            }
            if let Some(damage) = content.damage {
                say(damage)?;
            }
            if let Some(torn) = torn {
                say(format_args!("the original is kept as {}", torn.display()))?;
            }
        }
    }
    Ok(())
}

fn kept(content: &Salvaged) -> String {
    match content.last_good {
        Some(last) => {
            let Salvaged { cycles, cycles_valid, cycles_lost, .. } = content;
            let whole = cycles - cycles_lost;
            let lost = match cycles_lost {
                0 => String::new(),
                lost => format!("; {lost} cycles between them are lost"),
            };
            format!("recovered {whole} cycles, {cycles_valid} valid, the last of {last}{lost}")
        }
        None => "recovered, but no cycle was whole".into(),
    }
}
