//! What the logs of a calibration say of themselves, for its page.

use std::path::Path;

use super::bar::RunFiles;
use crate::inspect::{self, Inspection};
use crate::logs::BarLog;
use crate::report::page::Source;
use crate::threads::both;

/// Recording and robot log of each run.
pub(super) fn sources(runs: &[RunFiles<'_>]) -> Vec<Source> {
    let of_run = |run: &RunFiles<'_>| {
        let (recording, robot) = both(|| recording(&run.recording), || inspect::robot_log(&run.log));
        let source = |role, path: &Path, inspection| Source { role, path: path.to_owned(), inspection };
        [source("recording", run.recording_path, recording), source("robot log", run.log_path, robot)]
    };
    runs.iter().flat_map(of_run).collect()
}

/// What is in the bar's side of a run, whoever recorded it.
pub(super) fn recording(log: &BarLog) -> Inspection {
    match log {
        BarLog::Recording(recording) => inspect::recording(recording),
        BarLog::Other(other) => inspect::bar_log(other),
    }
}
