//! Formats replies of a service as text.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::bail;
use shared::output::say;
use shared::recording::RunMark;

use crate::commands::Format;
use crate::control::recordings::runs::RunLine;
use crate::control::recordings::verdict::Verdict;
use crate::control::status::{IN_SPITE_OF, LastRun, RunStatus};
use crate::problem::{Level, Problem};

/// Line that precedes values of the simulated bus.
pub const SIMULATED: &str = "SIMULATED: no hardware; the encoder counts are generated";

/// Text with the codes of these problems, under which the manual explains them. Empty without problems.
pub fn codes(problems: &[Problem]) -> String {
    let mut codes: Vec<_> = problems.iter().map(Problem::code).collect();
    codes.dedup();
    if codes.is_empty() { String::new() } else { format!(" [{}]", codes.join(", ")) }
}

/// Prints a list of recordings. Prints the text `none` if the list is empty.
pub fn print_list(lines: &[RunLine], none: &str, format: Format) -> anyhow::Result<()> {
    if format.prints(&lines)? {
        return Ok(());
    }
    // Print the directory only once for consecutive recordings in it.
    let mut place = None;
    for line in lines {
        let parent = line.file.parent();
        if place != parent {
            place = parent;
            say(format_args!("in {}:", parent.unwrap_or(Path::new(".")).display()))?;
        }
        say(listed(line))?;
    }
    if lines.is_empty() {
        say(none)?;
    }
    Ok(())
}

/// Returns an error if the run is rated BAD, although its file is complete.
pub fn ensure_usable(name: &str, verdict: Option<&Verdict>) -> anyhow::Result<()> {
    match verdict {
        Some(Verdict { level: Level::Bad, reasons }) => {
            bail!("run `{name}` is unusable: {}", reasons.join("; "))
        }
        _ => Ok(()),
    }
}

/// Text about the run that is being recorded.
pub fn running(run: &RunStatus) -> String {
    let age =
        run.sync_age_ms.map_or("nothing on disk yet".into(), |age| format!("synchronised {age} ms ago"));
    format!(
        "run `{}`: {} cycles on disk, {} valid, {} lost, {:.1} MB, {age}\n{}; {:.1} s not safe on disk yet, {:.1} s not \
         written yet (at {:.0} s cycles are lost)",
        run.name,
        run.cycles,
        run.cycles_valid,
        run.cycles_lost,
        run.bytes as f64 * 1e-6,
        if run.file.is_empty() { "no file yet" } else { &run.file },
        run.unsynced_s,
        run.backlog_s,
        run.backlog_limit_s
    )
}

/// Text about a run that has ended, with its grade and the next step.
pub fn last_run(last: &LastRun) -> String {
    let LastRun { name, file, cycles, cycles_valid, cycles_lost, cause, provenance, verdict, next, .. } =
        last;
    let flagged = cycles - cycles_valid.min(cycles);
    let Some(file) = file else { return format!("{name}: {cause}") };
    let mut text = format!(
        "{file}\n{cycles} cycles, {cycles_valid} valid, {flagged} flagged, {cycles_lost} lost; {cause}"
    );
    if !provenance.is_measured() {
        let _ = write!(text, "\n{provenance}");
    }
    if let Some(verdict) = verdict {
        let _ = write!(text, "\n{verdict}");
    }
    if let Some(next) = next {
        let _ =
            write!(text, "\nnext: save the log of the robot's controller as {name}.csv, then type\n  {next}");
    }
    text
}

/// Text of a recording as a line of the list.
fn listed(line: &RunLine) -> String {
    let started = line.started.map_or(String::from("?"), |at| {
        at.to_datetime().with_timezone(&chrono::Local).format("%Y-%m-%d %H:%M:%S %:z").to_string()
    });
    let verdict = line.verdict.as_ref().map(ToString::to_string);
    let cause = Some(line.cause.clone()).filter(|cause| !cause.is_empty());
    let result = verdict.into_iter().chain(cause).collect::<Vec<_>>().join("; ");
    let mut text = format!(
        "{:<28} {started:<26}  {:>8.1} s {:>8} cycles  {result}",
        line.name, line.length_s, line.cycles
    );
    if !line.provenance.is_measured() {
        let _ = write!(text, "  [{}]", line.provenance);
    }
    if line.recovered {
        text.push_str("  [recovered]");
    }
    let (reasons, marks): (Vec<_>, Vec<_>) =
        line.marks.iter().partition(|mark| mark.text.starts_with(IN_SPITE_OF));
    for RunMark { text: reason, .. } in reasons {
        let _ = write!(text, "  [{}]", reason.replace(char::is_control, " "));
    }
    if !marks.is_empty() {
        let _ = write!(text, "  [{} mark{}]", marks.len(), if marks.len() == 1 { "" } else { "s" });
    }
    if !line.note.is_empty() {
        let _ = write!(text, "  {}", line.note.replace(char::is_control, " "));
    }
    text
}
