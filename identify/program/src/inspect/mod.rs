//! Lists the content of logs, recordings and tables as an [`Inspection`], before anything is solved: facts, ranges of the
//! joints, and warnings. Used by `identify inspect`, and by the pages of a calibration or a refusal.

mod bar_log;
mod contacts;
pub mod curves;
mod recording;
mod robot_log;
mod rows;
mod unknown_table;

pub use bar_log::bar_log;
pub use contacts::contacts;
pub use recording::recording;
pub use robot_log::robot_log;
pub use rows::{lengths, poses, timed_poses, touches};
pub use unknown_table::{Mapping, Proposal, ProposeError, propose};

use shared::config::JointKind;

use crate::logs::{LogQuality, Row, Unwrapped, ranges, usual_and_longest_step_s};

/// If a revolute joint turned by less than this, the data do not determine its link \[deg\].
const TRAVEL_MIN_DEG: f64 = 5.0;
/// Name of a fact that states which information the file does not contain.
pub const UNSAID: &str = "not in the file";

/// Facts about a file, its joints, and warnings.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Inspection {
    /// Name and value of each fact, in the order of display.
    pub facts: Vec<(String, String)>,
    /// One entry for each joint.
    pub joints: Vec<JointLine>,
    /// Content that reduces the accuracy of a calibration or prevents it, with the remedy.
    pub suspicious: Vec<String>,
}

/// One joint of a log.
#[derive(Debug, Clone, PartialEq)]
pub struct JointLine {
    /// Name of the joint, such as `b1` or `q1`.
    pub name: String,
    /// Revolute or prismatic, which determines the unit.
    pub kind: JointKind,
    /// Smallest and largest value \[deg, mm\].
    pub range: [f64; 2],
    /// Largest speed between two consecutive samples \[deg/s, mm/s\].
    pub speed_max: f64,
}

impl Inspection {
    fn fact(&mut self, what: &str, value: impl Into<String>) {
        // A note that a person wrote may have several lines.
        let lines: Vec<String> = value.into().lines().map(|line| line.trim().to_owned()).collect();
        self.facts.push((what.to_owned(), lines.join(" / ")));
    }

    fn suspect(&mut self, sentence: impl Into<String>) {
        self.suspicious.push(sentence.into());
    }

    /// Reports all joints for which `described` returns a text, in one sentence. The sentence consists of
    /// these texts, followed by `of_all`.
    fn suspect_joints(&mut self, described: impl Fn(&JointLine) -> Option<String>, of_all: &str) {
        let found: Vec<String> = self.joints.iter().filter_map(described).collect();
        if !found.is_empty() {
            self.suspect(found.join(", ") + of_all);
        }
    }

    /// The joints, as groups of consecutive joints with the same unit.
    pub(crate) fn joints_by_unit(&self) -> impl Iterator<Item = &[JointLine]> {
        self.joints.chunk_by(|joint, next| joint.kind == next.kind)
    }
}

/// Reports period and gaps of the time stamps of a log, and the corrections that were applied to stamps and rows.
fn stamps(inspection: &mut Inspection, t_s: &[f64], quality: &LogQuality) {
    /// Longest interval between two stamps that does not count as a gap, in periods.
    const GAP_PERIODS: f64 = 5.0;
    let [period_s, longest_gap_s] = usual_and_longest_step_s(t_s);
    inspection
        .fact("stamps", format!("every {:.2} ms, longest gap {:.1} ms", period_s * 1e3, longest_gap_s * 1e3));
    if let Some(stamps) = quality.stamps.as_ref().filter(|stamps| stamps.evened) {
        let scatter =
            format!("{:.2} ms from it, {:.1} ms at most", stamps.jitter_s * 1e3, stamps.jitter_max_s * 1e3);
        inspection.fact(
            "clock of the rows",
            format!("every {:.4} ms; stamps are {scatter}", stamps.period_s * 1e3),
        );
    }
    if quality.duplicates_dropped > 0 {
        inspection.fact("repeated rows", format!("{} dropped", quality.duplicates_dropped));
    }
    if longest_gap_s > GAP_PERIODS * period_s {
        inspection.suspect(format!(
            "stamps are up to {:.0} ms apart: samples in such gaps are not used",
            longest_gap_s * 1e3
        ));
    }
}

/// Reports the readings that wrapped and were unwrapped.
fn unwrapped(inspection: &mut Inspection, all: &[Unwrapped]) {
    for Unwrapped { name, wraps, step_part, .. } in all {
        let times = if *wraps == 1 { "time" } else { "times" };
        let percent = 100.0 * step_part;
        inspection.fact(
            "unwrapped",
            format!("{name}, {wraps} {times}; its largest step is {percent:.1} % of the largest that can be unwrapped"),
        );
    }
}

/// Range and largest speed of each joint. The name of a joint is `prefix` with its number.
fn joint_lines<R: Row>(
    prefix: char,
    kinds: impl Iterator<Item = JointKind>,
    t_s: &[f64],
    rows: &[R],
) -> Vec<JointLine> {
    let ranges_si = ranges(rows);
    let mut fastest_si = vec![0.0_f64; ranges_si.len()];
    for (t_s, pair) in t_s.windows(2).zip(rows.windows(2)).filter(|(t_s, _)| t_s[1] > t_s[0]) {
        let ends = pair[0].numbers().iter().zip(pair[1].numbers());
        for (fastest, (before, after)) in fastest_si.iter_mut().zip(ends) {
            *fastest = fastest.max((after - before).abs() / (t_s[1] - t_s[0]));
        }
    }
    let line = |(joint, kind): (usize, JointKind)| {
        let factor = kind.display_factor();
        let (range, speed_max) = (ranges_si[joint].map(|value| value * factor), fastest_si[joint] * factor);
        JointLine { name: format!("{prefix}{}", joint + 1), kind, range, speed_max }
    };
    kinds.take(ranges_si.len()).enumerate().map(line).collect()
}

/// Warns about revolute joints that hardly moved, because they do not determine their links. `check` states what to check if
/// such a joint did move.
fn suspect_still(inspection: &mut Inspection, check: &str) {
    let is_still = |JointLine { kind, range: [low, high], .. }: &JointLine| {
        *kind == JointKind::Revolute && high - low < TRAVEL_MIN_DEG
    };
    inspection.suspect_joints(
        |joint| is_still(joint).then(|| joint.name.clone()),
        &format!(" moved by less than {TRAVEL_MIN_DEG} degrees: {check}, or choose a path that moves it"),
    );
}
