//! The recordings of a directory: how long, how good, and which of them were recovered.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shared::recording::{ACTIVE_ENDING, FINISHED_ENDING, RunOverview, is_in_use};
use shared::time::UtcNs;

/// One recording of the list.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunLine {
    /// Its name.
    pub name: String,
    /// Its file.
    pub file: PathBuf,
    /// When it began; none where the file does not tell.
    pub started: Option<UtcNs>,
    /// Length \[s\].
    pub length_s: f64,
    /// Bus cycles in it.
    pub cycles: u64,
    /// Cycles in which every encoder is valid.
    pub cycles_valid: u64,
    /// In words.
    pub verdict: String,
    /// It was cut short and recovered.
    pub recovered: bool,
    /// Free text that was given with it.
    pub note: String,
}

/// Recordings of a directory, the latest first; those that do not tell when they began come last. With those of runs
/// that had to go on in `spare`.
pub fn list(directory: &Path, spare: Option<&Path>) -> std::io::Result<Vec<RunLine>> {
    // It is there only if a run needed it.
    let elsewhere = spare.and_then(|spare| std::fs::read_dir(spare).ok()).into_iter().flatten();
    let entries = std::fs::read_dir(directory)?.chain(elsewhere).flatten();
    let mut lines: Vec<_> = entries.filter_map(|entry| line(entry.path())).collect();
    lines.sort_by(|one, other| other.started.cmp(&one.started).then_with(|| one.name.cmp(&other.name)));
    Ok(lines)
}

/// Files of runs that no living process writes.
pub fn left_behind(directory: &Path) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(directory) else { return Vec::new() };
    let active = |path: &PathBuf| stem(path, ACTIVE_ENDING).is_some() && !is_in_use(path);
    entries.flatten().map(|entry| entry.path()).filter(active).collect()
}

fn stem(path: &Path, ending: &str) -> Option<String> {
    let name = path.file_name()?.to_str()?;
    Some(name.strip_suffix(ending)?.strip_suffix('.')?.to_owned()).filter(|stem| !stem.is_empty())
}

fn line(file: PathBuf) -> Option<RunLine> {
    if let Some(name) = stem(&file, ACTIVE_ENDING) {
        let verdict = if is_in_use(&file) {
            "is being recorded"
        } else {
            "left behind by a crash; it is recovered when the next run or the service starts"
        };
        return Some(RunLine { verdict: verdict.into(), ..unknown(name, file) });
    }
    let name = stem(&file, FINISHED_ENDING)?;
    Some(match RunOverview::open(&file) {
        Ok(RunOverview { run, end }) => RunLine {
            started: Some(run.started),
            length_s: end.cycles as f64 * run.cycle_period_ns as f64 * 1e-9,
            cycles: end.cycles,
            cycles_valid: end.cycles_valid,
            verdict: verdict(end.cycles, end.cycles_valid, end.cycles_lost),
            recovered: end.recovered,
            note: run.note,
            ..unknown(name, file)
        },
        Err(error) => RunLine { verdict: error.kind.to_string(), ..unknown(name, file) },
    })
}

fn unknown(name: String, file: PathBuf) -> RunLine {
    RunLine {
        name,
        file,
        started: None,
        length_s: 0.0,
        cycles: 0,
        cycles_valid: 0,
        verdict: String::new(),
        recovered: false,
        note: String::new(),
    }
}

fn verdict(cycles: u64, valid: u64, lost: u64) -> String {
    match (cycles, cycles - valid.min(cycles), lost) {
        (0, ..) => "empty".into(),
        (_, 0, 0) => "good".into(),
        (_, flagged, 0) => format!("{flagged} cycles flagged"),
        (_, flagged, lost) => format!("{flagged} cycles flagged, {lost} of them lost"),
    }
}
