//! Grades a run (GOOD, CHECK or BAD) and lists the reasons. Inputs are the fractions of valid and lost cycles, the duration,
//! the angle that each joint turned, whether the file was recovered, and the clocks of the devices. The limits for duration
//! and angle are those of `identify`. Page, commands and API all use this grade.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use shared::recording::schema::required::{OVERLAP_MIN_S, TRAVEL_MIN_DEG};
use shared::recording::{Flagged, RunOverview};

use crate::problem::{Level, clock_time};

/// Minimum fraction of valid cycles of a good run. The sigma of each parameter is inversely proportional to the square root
/// of the number of valid cycles. At this limit, sigmas are therefore 0.5 % larger than with all cycles.
pub const VALID_SHARE_GOOD: f64 = 0.99;
/// Fraction of valid cycles below which a run is bad. Below this limit, sigmas are at least 41 % larger than with all
/// cycles, and many gaps interrupt the valid cycles.
pub const VALID_SHARE_BAD: f64 = 0.5;
/// Minimum duration of a run beyond the overlap that `identify` requires \[s\]. The margin is needed for three reasons: the
/// computation of a speed needs a sample before and after, the log ends between two of its rows, and the clock of the log
/// differs from the clock of the run.
pub const LENGTH_MARGIN_S: f64 = 1.0;
/// Largest number of causes of invalid cycles that are listed.
const CAUSES_MAX: usize = 3;

/// A grade and its reasons.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Verdict {
    /// Severity of the worst reason.
    pub level: Level,
    /// Reasons for the grade, as text; empty if the grade is `good`.
    pub reasons: Vec<String>,
}

/// Everything that the grade depends on.
#[derive(Debug, Clone, Copy, Default)]
pub struct GradeInput<'a> {
    /// Bus cycles in the file.
    pub cycles: u64,
    /// Cycles in which every encoder is valid.
    pub cycles_valid: u64,
    /// Cycles that were lost between bus and file, or by damage of the file.
    pub cycles_lost: u64,
    /// Time between two cycles \[s\].
    pub period_s: f64,
    /// Invalid cycles, by joint and reason.
    pub flagged: &'a [Flagged],
    /// The file was interrupted and recovered.
    pub recovered: bool,
    /// The bus has no distributed clocks, so a sample may be as old as a cycle.
    pub without_clocks: bool,
    /// For each encoder: joint, and angle by which the joint turned \[deg\]. Empty if the angles are unknown.
    pub turned_deg: &'a [(u8, f64)],
}

impl Verdict {
    /// Grades a run with this content. A run that `identify calibrate` refuses by default is never graded as good.
    pub fn grade(content: &GradeInput<'_>) -> Self {
        let GradeInput { cycles, cycles_valid, cycles_lost, recovered, without_clocks, .. } = *content;
        let mut verdict = Self::default();
        if cycles == 0 {
            return Self::bad("it has no cycles");
        }
        if cycles_valid == 0 {
            return Self::bad(format!("none of the {cycles} cycles is valid{}", content.causes()));
        }
        let (valid_share, invalid) =
            (cycles_valid as f64 / cycles as f64, cycles.saturating_sub(cycles_valid));
        if valid_share < VALID_SHARE_GOOD {
            let level = if valid_share < VALID_SHARE_BAD { Level::Bad } else { Level::Check };
            let percent = 100.0 * (1.0 - valid_share);
            let causes = content.causes();
            verdict.add(level, format!("{invalid} of {cycles} cycles are flagged ({percent:.1} %){causes}"));
        }
        if cycles_lost > 0 {
            let cycles = if cycles_lost == 1 { "cycle was" } else { "cycles were" };
            let damage = if recovered { ", or by damage of the file" } else { "" };
            verdict.add(Level::Check, format!("{cycles_lost} {cycles} lost between bus and disk{damage}"));
        }
        // Round down to 0.1 s, so that a run that is too short is not displayed with the required length.
        let length_s = (10.0 * cycles as f64 * content.period_s + 1e-6).floor() / 10.0;
        let length_s_min = OVERLAP_MIN_S + LENGTH_MARGIN_S;
        if length_s < length_s_min {
            verdict.add(
                Level::Check,
                format!(
                    "it is {length_s:.1} s long; record at least {length_s_min:.0} s: `identify` needs \
                     {OVERLAP_MIN_S:.0} s of motion"
                ),
            );
        }
        let unmoved = content.turned_deg.iter().filter(|(_, turned_deg)| *turned_deg < TRAVEL_MIN_DEG);
        let unmoved: Vec<_> = unmoved
            .map(|(joint, turned_deg)| format!("joint {joint} turned by {turned_deg:.1}\u{b0}"))
            .collect();
        if !unmoved.is_empty() {
            let unmoved = unmoved.join(", ");
            verdict.add(
                Level::Check,
                format!("{unmoved}; `identify` needs at least {TRAVEL_MIN_DEG:.0}\u{b0} of each joint"),
            );
        }
        if recovered {
            verdict.add(Level::Check, "it was interrupted and recovered");
        }
        if without_clocks {
            verdict.add(Level::Check, "without distributed clocks samples may be a whole cycle old");
        }
        verdict
    }

    /// Grades a finished file.
    pub fn of_file(RunOverview { run, end }: &RunOverview) -> Self {
        let joints = run.encoders.iter().map(|encoder| encoder.joint);
        let turned_deg: Vec<_> = joints.zip(end.turned_deg.iter().copied()).collect();
        Self::grade(&GradeInput {
            cycles: end.cycles,
            cycles_valid: end.cycles_valid,
            cycles_lost: end.cycles_lost,
            period_s: run.cycle_period_ns as f64 * 1e-9,
            flagged: &end.flagged,
            recovered: end.recovered,
            without_clocks: !run.distributed_clocks,
            turned_deg: &turned_deg,
        })
    }

    /// Grade of a run that cannot be used at all.
    pub fn bad(reason: impl Into<String>) -> Self {
        Self { level: Level::Bad, reasons: vec![reason.into()] }
    }

    fn add(&mut self, level: Level, reason: impl Into<String>) {
        self.level = self.level.max(level);
        self.reasons.push(reason.into());
    }
}

impl GradeInput<'_> {
    /// Lists the causes of invalid cycles, the longest first: joint, reason, duration, and time of the first invalid cycle.
    /// Example: `: joint 3 signal too low (2.0 s, first at 0:12)`.
    fn causes(&self) -> String {
        let mut flagged: Vec<_> = self.flagged.iter().collect();
        flagged.sort_by_key(|flagged| std::cmp::Reverse(flagged.cycles));
        let unlisted = flagged.len().saturating_sub(CAUSES_MAX);
        let describe = |flagged: &&Flagged| {
            let Flagged { joint, reason, first, cycles, periods } = flagged;
            let who = joint.map_or("all joints".to_owned(), |joint| format!("joint {joint}"));
            let lasted_s = *cycles as f64 * self.period_s;
            let begun = clock_time(*first as f64 * self.period_s);
            let times = if *periods > 1 { format!(" in {periods} periods") } else { String::new() };
            format!("{who} {reason} ({lasted_s:.1} s{times}, first at {begun})")
        };
        let mut causes: Vec<_> = flagged.iter().take(CAUSES_MAX).map(describe).collect();
        if unlisted > 0 {
            causes.push(format!("{unlisted} more cause{}", if unlisted == 1 { "" } else { "s" }));
        }
        if causes.is_empty() { String::new() } else { format!(": {}", causes.join(", ")) }
    }
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self.level {
            Level::Good => "GOOD",
            Level::Check => "CHECK",
            Level::Bad => "BAD",
        })?;
        if self.reasons.is_empty() { Ok(()) } else { write!(f, ": {}", self.reasons.join("; ")) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MOVED: [(u8, f64); 2] = [(1, 40.0), (2, 30.0)];
    const WHOLE: GradeInput<'_> = GradeInput {
        cycles: 12_000,
        cycles_valid: 12_000,
        cycles_lost: 0,
        period_s: 0.01,
        flagged: &[],
        recovered: false,
        without_clocks: false,
        turned_deg: &MOVED,
    };

    fn grade(content: &GradeInput<'_>) -> String {
        Verdict::grade(content).to_string()
    }

    #[test]
    fn a_whole_run_is_good_and_a_few_flagged_cycles_cost_nothing() {
        assert_eq!(grade(&WHOLE), "GOOD");
        assert_eq!(grade(&GradeInput { cycles_valid: 11_881, ..WHOLE }), "GOOD");
    }

    #[test]
    fn a_run_without_cycles_or_without_a_valid_one_is_bad() {
        assert_eq!(grade(&GradeInput::default()), "BAD: it has no cycles");
        assert_eq!(grade(&GradeInput { cycles_valid: 0, ..WHOLE }), "BAD: none of the 12000 cycles is valid");
        assert!(grade(&GradeInput { cycles_valid: 5_999, ..WHOLE }).starts_with("BAD: 6001 of 12000"));
    }

    #[test]
    fn what_a_person_should_check_is_named() {
        for (content, why) in [
            (GradeInput { cycles_valid: 11_000, ..WHOLE }, "1000 of 12000 cycles are flagged (8.3 %)"),
            (GradeInput { cycles_lost: 1, ..WHOLE }, "1 cycle was lost between bus and disk"),
            (
                GradeInput { cycles_lost: 20, recovered: true, ..WHOLE },
                "20 cycles were lost between bus and disk, or by damage of the file; it was interrupted",
            ),
            (GradeInput { recovered: true, ..WHOLE }, "recovered"),
            (GradeInput { without_clocks: true, ..WHOLE }, "distributed clocks"),
            (
                GradeInput { turned_deg: &[(1, 40.0), (3, 0.2)], ..WHOLE },
                "joint 3 turned by 0.2\u{b0}; `identify` needs",
            ),
            (GradeInput { turned_deg: &[(5, 2.9)], ..WHOLE }, "at least 3\u{b0} of each joint"),
            (
                GradeInput { cycles: 990, cycles_valid: 990, ..WHOLE },
                "it is 9.9 s long; record at least 11 s: `identify` needs 10 s of motion",
            ),
            // A run must be longer than the overlap that `identify` requires; see LENGTH_MARGIN_S.
            (
                GradeInput { cycles: 1_000, cycles_valid: 1_000, ..WHOLE },
                "it is 10.0 s long; record at least 11 s",
            ),
            (
                GradeInput { cycles: 1_099, cycles_valid: 1_099, ..WHOLE },
                "it is 10.9 s long; record at least 11 s",
            ),
        ] {
            let grade = grade(&content);
            assert!(grade.starts_with("CHECK: ") && grade.contains(why), "{grade}");
        }
    }

    #[test]
    fn a_run_with_invalid_cycles_names_joint_reason_time_and_length() {
        let flagged = |joint, reason: &str, first, cycles, periods| Flagged {
            joint,
            reason: reason.into(),
            first,
            cycles,
            periods,
        };
        let flagged = [
            flagged(Some(3), "signal too low", 6_500, 900, 2),
            flagged(None, "bus down", 1_200, 1_100, 1),
            flagged(Some(1), "no new sample", 5, 2, 1),
            flagged(Some(2), "no new sample", 5, 1, 1),
        ];
        assert_eq!(
            grade(&GradeInput { cycles_valid: 10_000, flagged: &flagged, ..WHOLE }),
            "CHECK: 2000 of 12000 cycles are flagged (16.7 %): all joints bus down (11.0 s, first at 0:12), \
             joint 3 signal too low (9.0 s in 2 periods, first at 1:05), joint 1 no new sample (0.0 s, first at 0:00), \
             1 more cause"
        );
        let blind = grade(&GradeInput { cycles_valid: 0, flagged: &flagged[..1], ..WHOLE });
        assert!(
            blind.starts_with("BAD: none of the 12000 cycles is valid: joint 3 signal too low"),
            "{blind}"
        );
    }

    #[test]
    fn the_worst_reason_decides_and_all_are_listed() {
        let grade = grade(&GradeInput { cycles_valid: 1, recovered: true, ..WHOLE });
        assert!(grade.starts_with("BAD: 11999 of 12000") && grade.ends_with("recovered"), "{grade}");
    }
}
