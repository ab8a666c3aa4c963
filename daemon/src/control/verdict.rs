//! What a run is worth, in one word. Page, commands and API say what is decided here.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use shared::recording::RunOverview;

use super::status::Level;

/// From this share of valid cycles on a run is good: the sigma of every parameter grows with one over the root of their
/// number, by 0.5 % here.
pub const VALID_SHARE_GOOD: f64 = 0.99;
/// Below this share a run is bad: sigmas are 41 % larger, and what is left lies in pieces.
pub const VALID_SHARE_BAD: f64 = 0.5;
/// A joint that turned less has not moved: the play of a coupling is less, any path that calibrates is far more \[deg\].
pub const MOVED_MIN_DEG: f64 = 1.0;

/// A word and its reasons.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Verdict {
    /// How grave it is.
    pub level: Level,
    /// Why, for people; empty if all is well.
    pub reasons: Vec<String>,
}

/// What a verdict rests on.
#[derive(Debug, Clone, Copy, Default)]
pub struct Content<'a> {
    /// Bus cycles in the file.
    pub cycles: u64,
    /// Cycles in which every encoder is valid.
    pub cycles_valid: u64,
    /// Cycles that were lost between bus and file.
    pub cycles_lost: u64,
    /// The file was cut short and recovered.
    pub recovered: bool,
    /// Samples may be as old as a cycle.
    pub without_clocks: bool,
    /// Joint of each encoder and how far it turned \[deg\]; empty where that is not known.
    pub turned_deg: &'a [(u8, f64)],
}

impl Verdict {
    /// Of a run with this content.
    pub fn of(content: &Content<'_>) -> Self {
        let Content { cycles, cycles_valid, cycles_lost, recovered, without_clocks, turned_deg } = *content;
        let mut verdict = Self::default();
        if cycles == 0 {
            return Self::bad("it holds no cycle");
        }
        if cycles_valid == 0 {
            return Self::bad(format!("none of the {cycles} cycles is valid"));
        }
        let (share, flagged) = (cycles_valid as f64 / cycles as f64, cycles.saturating_sub(cycles_valid));
        if share < VALID_SHARE_GOOD {
            let level = if share < VALID_SHARE_BAD { Level::Bad } else { Level::Check };
            verdict.add(
                level,
                format!("{flagged} of {cycles} cycles are flagged ({:.1} %)", 100.0 * (1.0 - share)),
            );
        }
        if cycles_lost > 0 {
            verdict.add(Level::Check, format!("{cycles_lost} cycles were lost on the way to the disk"));
        }
        let still = turned_deg.iter().filter(|(_, turned_deg)| *turned_deg < MOVED_MIN_DEG);
        let still: Vec<_> = still.map(|(joint, _)| joint.to_string()).collect();
        if !still.is_empty() {
            verdict.add(Level::Check, format!("joint {} has not moved", still.join(", ")));
        }
        if recovered {
            verdict.add(Level::Check, "it was cut short and recovered");
        }
        if without_clocks {
            verdict.add(Level::Check, "without distributed clocks samples may be a whole cycle old");
        }
        verdict
    }

    /// Of a finished file.
    pub fn of_file(RunOverview { run, end }: &RunOverview) -> Self {
        let joints = run.encoders.iter().map(|encoder| encoder.joint);
        let turned_deg: Vec<_> = joints.zip(end.turned_deg.iter().copied()).collect();
        Self::of(&Content {
            cycles: end.cycles,
            cycles_valid: end.cycles_valid,
            cycles_lost: end.cycles_lost,
            recovered: end.recovered,
            without_clocks: !run.distributed_clocks,
            turned_deg: &turned_deg,
        })
    }

    /// Of what cannot be used at all.
    pub fn bad(reason: impl Into<String>) -> Self {
        Self { level: Level::Bad, reasons: vec![reason.into()] }
    }

    fn add(&mut self, level: Level, reason: impl Into<String>) {
        self.level = self.level.max(level);
        self.reasons.push(reason.into());
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
    const WHOLE: Content<'_> = Content {
        cycles: 12_000,
        cycles_valid: 12_000,
        cycles_lost: 0,
        recovered: false,
        without_clocks: false,
        turned_deg: &MOVED,
    };

    fn told(content: &Content<'_>) -> String {
        Verdict::of(content).to_string()
    }

    #[test]
    fn a_whole_run_is_good_and_a_few_flagged_cycles_cost_nothing() {
        assert_eq!(told(&WHOLE), "GOOD");
        assert_eq!(told(&Content { cycles_valid: 11_881, ..WHOLE }), "GOOD");
    }

    #[test]
    fn a_run_without_cycles_or_without_a_valid_one_is_bad() {
        assert_eq!(told(&Content::default()), "BAD: it holds no cycle");
        assert_eq!(told(&Content { cycles_valid: 0, ..WHOLE }), "BAD: none of the 12000 cycles is valid");
        assert!(told(&Content { cycles_valid: 5_999, ..WHOLE }).starts_with("BAD: 6001 of 12000"));
    }

    #[test]
    fn what_somebody_should_look_at_is_named() {
        for (content, why) in [
            (Content { cycles_valid: 11_000, ..WHOLE }, "1000 of 12000 cycles are flagged (8.3 %)"),
            (Content { cycles_lost: 1, ..WHOLE }, "1 cycles were lost"),
            (Content { recovered: true, ..WHOLE }, "recovered"),
            (Content { without_clocks: true, ..WHOLE }, "distributed clocks"),
            (Content { turned_deg: &[(1, 40.0), (3, 0.2)], ..WHOLE }, "joint 3 has not moved"),
        ] {
            let told = told(&content);
            assert!(told.starts_with("CHECK: ") && told.contains(why), "{told}");
        }
    }

    #[test]
    fn the_gravest_reason_decides_and_all_are_said() {
        let told = told(&Content { cycles_valid: 1, recovered: true, ..WHOLE });
        assert!(told.starts_with("BAD: 11999 of 12000") && told.ends_with("recovered"), "{told}");
    }
}
