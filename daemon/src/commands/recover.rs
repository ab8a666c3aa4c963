//! `ballbard recover`: repairs a truncated or damaged recording.

use std::path::{Path, PathBuf};

use clap::Args;
use serde::Serialize;
use shared::output::say;
use shared::recording::{Recovery, Salvaged, TimingSummary, recover_file};

use super::Format;

#[derive(Debug, Args)]
pub struct RecoverArguments {
    /// Recording to repair, a file with the ending .mcap.active or .mcap
    file: PathBuf,
    #[command(flatten)]
    format: Format,
}

/// Result of a repair, printed as JSON.
#[derive(Serialize)]
struct RecoveryReport<'a> {
    /// `whole`, `renamed` or `recovered`.
    outcome: &'static str,
    /// Path of the finished recording.
    file: String,
    /// Path of the original file, if some of its content could not be read.
    torn: Option<String>,
    cycles: u64,
    cycles_valid: u64,
    cycles_lost: u64,
    /// Sample time of the last intact cycle.
    last_good_utc: Option<String>,
    /// Description of the damaged content.
    damage: Option<String>,
    timing: Option<&'a TimingSummary>,
}

impl<'a> RecoveryReport<'a> {
    fn from_recovery(recovery: &'a Recovery, asked: &Path) -> Self {
        let (outcome, file, torn, content) = match recovery {
            Recovery::Whole { content } => ("whole", asked, None, content),
            Recovery::Renamed { file, content } => ("renamed", file.as_path(), None, content),
            Recovery::Recovered { file, torn, content } => {
                ("recovered", file.as_path(), torn.as_ref(), content)
            }
        };
        Self {
            outcome,
            file: file.display().to_string(),
            torn: torn.map(|torn| torn.display().to_string()),
            cycles: content.cycles,
            cycles_valid: content.cycles_valid,
            cycles_lost: content.cycles_lost,
            last_good_utc: content.last_good.map(|last| last.to_string()),
            damage: content.damage.map(|damage| damage.to_string()),
            timing: content.timing.as_ref(),
        }
    }
}

pub fn run(arguments: &RecoverArguments) -> anyhow::Result<()> {
    let recovery = recover_file(&arguments.file)?;
    let outcome = RecoveryReport::from_recovery(&recovery, &arguments.file);
    if arguments.format.prints(&outcome)? {
        return Ok(());
    }
    let RecoveryReport { file, torn, cycles, damage, timing, .. } = &outcome;
    match &recovery {
        Recovery::Whole { .. } => say(format_args!("{file}: intact, {cycles} cycles; nothing to recover"))?,
        Recovery::Renamed { .. } => say(format_args!("{file}: complete, {cycles} cycles; only renamed"))?,
        Recovery::Recovered { content, .. } => {
            say(format_args!("{file}: {}", salvaged_text(content)))?;
            timing.iter().try_for_each(say)?;
            damage.iter().try_for_each(say)?;
            torn.iter().try_for_each(|torn| say(format_args!("the original is kept as {torn}")))?;
        }
    }
    Ok(())
}

fn salvaged_text(content: &Salvaged) -> String {
    match content.last_good {
        Some(last) => {
            let Salvaged { cycles, cycles_valid, cycles_lost, .. } = content;
            let intact = cycles - cycles_lost;
            let lost = match cycles_lost {
                0 => String::new(),
                lost => format!("; {lost} cycles between them are lost"),
            };
            format!("recovered {intact} cycles, {cycles_valid} valid, the last at {last}{lost}")
        }
        None => "recovered, but without any intact cycle".into(),
    }
}
