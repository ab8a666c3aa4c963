//! One check and its result.

use std::fmt;

use serde::Serialize;

use crate::problem::Problem;

/// Property of the bus that is checked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Subject {
    /// The network interface can be used.
    Interface,
    /// Coupler and terminals are those of the configuration.
    Devices,
    /// The revisions of coupler and terminals are known.
    Revisions,
    /// Every device enters OP.
    BringUp,
    /// Every device processes every frame, and stays in OP.
    WorkingCounter,
    /// Terminals sample on SYNC0.
    DistributedClocks,
    /// Each cycle receives its reply in time.
    Cycles,
    /// Every encoder has a signal without amplitude or frequency error.
    Signals,
    /// No port counts errors.
    Cables,
    /// Each encoder has a reference mark and is on the configured joint.
    Homing,
    /// The bus returns to operation after its cable was pulled.
    PulledCable,
}

/// Result of one check.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Check {
    /// Property that was checked.
    pub subject: Subject,
    /// Cycle rate; `None` if the check does not depend on the rate \[Hz\].
    pub rate_hz: Option<u32>,
    /// Result with its reasons.
    #[serde(flatten)]
    pub outcome: Outcome,
}

/// Outcome of a check.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "snake_case", tag = "outcome")]
pub enum Outcome {
    /// The bus is as expected.
    Passed {
        /// Figures or names that were found.
        found: String,
    },
    /// The bus is not as expected.
    Failed {
        /// Figures or names that were expected.
        expected: String,
        /// Figures or names that were found instead.
        found: String,
        /// What to do; empty if `found` contains it.
        remedy: String,
        /// Code of the problem in the manual; `None` if it has none.
        code: Option<&'static str>,
    },
    /// The check was not done.
    NotDone {
        /// Reason, which people read and which determines the exit code.
        because: Reason,
    },
}

/// Why a check was not done.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Reason {
    /// The check is disabled, because this key of the configuration is false.
    NotAsked(&'static str),
    /// The check needs a person at a terminal.
    NoPerson,
    /// The check depends on this other check, which did not pass.
    After(Subject),
    /// The test was stopped.
    Stopped(String),
}

impl Check {
    /// Whether the check passed or is disabled.
    pub fn is_good(&self) -> bool {
        matches!(self.outcome, Outcome::Passed { .. } | Outcome::NotDone { because: Reason::NotAsked(_) })
    }
}

impl Outcome {
    /// Outcome of a bus that is as expected.
    pub fn passed(found: impl Into<String>) -> Self {
        Self::Passed { found: found.into() }
    }

    /// Outcome of a bus that is not as expected because of a known problem. `found` replaces the text of
    /// the problem if it contains more figures.
    pub fn failed(expected: impl Into<String>, problem: &Problem, found: Option<String>) -> Self {
        Self::Failed {
            expected: expected.into(),
            found: found.unwrap_or_else(|| problem.text.clone()),
            remedy: problem.remedy.clone(),
            code: Some(problem.code()),
        }
    }
}

impl fmt::Display for Subject {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Interface => "interface",
            Self::Devices => "devices",
            Self::Revisions => "revisions",
            Self::BringUp => "bring-up",
            Self::WorkingCounter => "working counter",
            Self::DistributedClocks => "distributed clocks",
            Self::Cycles => "cycles",
            Self::Signals => "encoder signals",
            Self::Cables => "cables",
            Self::Homing => "homing",
            Self::PulledCable => "pulled cable",
        })
    }
}

impl fmt::Display for Reason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotAsked(key) => write!(f, "`{key} = false` in the configuration"),
            Self::NoPerson => {
                write!(f, "it needs a person; run `ballbard smoke` in a terminal, without --json")
            }
            Self::After(subject) => write!(f, "it needs `{subject}` to pass"),
            Self::Stopped(cause) => f.write_str(cause),
        }
    }
}

impl fmt::Display for Check {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let word = match &self.outcome {
            Outcome::Passed { .. } => "passed",
            Outcome::Failed { .. } => "FAILED",
            // A disabled check is good, so the number of bad checks does not include it.
            Outcome::NotDone { because: Reason::NotAsked(_) } => "disabled",
            Outcome::NotDone { .. } => "not done",
        };
        write!(f, "{word:8}  {}", self.subject)?;
        if let Some(rate_hz) = self.rate_hz {
            write!(f, " at {rate_hz} Hz")?;
        }
        match &self.outcome {
            Outcome::Passed { found } => write!(f, ": {found}"),
            Outcome::NotDone { because } => write!(f, ": {because}"),
            Outcome::Failed { expected, found, remedy, code } => {
                write!(f, ": {found}")?;
                if let Some(code) = code {
                    write!(f, " [{code}]")?;
                }
                write!(f, "\n          expected: {expected}")?;
                if remedy.is_empty() { Ok(()) } else { write!(f, "\n          to do: {remedy}") }
            }
        }
    }
}
