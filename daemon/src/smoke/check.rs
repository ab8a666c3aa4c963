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
    /// Their revisions are known.
    Revisions,
    /// Every device enters OP.
    BringUp,
    /// Every device processes every frame, and stays in OP.
    WorkingCounter,
    /// Terminals sample on SYNC0.
    DistributedClocks,
    /// Cycles have their reply in time.
    Cycles,
    /// Every encoder has a signal without amplitude or frequency error.
    Signals,
    /// No port counts errors.
    Cables,
    /// Each encoder has its mark, and is on its joint.
    Homing,
    /// The bus returns to operation after its cable was pulled.
    PulledCable,
}

/// Result of one check.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Check {
    /// Property that was checked.
    pub subject: Subject,
    /// Rate of the cycles; absent if the check does not depend on it \[Hz\].
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
        /// Figures or names found.
        found: String,
    },
    /// The bus is not as expected.
    Failed {
        /// Figures or names expected.
        expected: String,
        /// Figures or names found instead.
        found: String,
        /// What to do; empty if `found` states it.
        remedy: String,
        /// Code of the problem in the manual, if it has one.
        code: Option<&'static str>,
    },
    /// The check was not done.
    NotDone {
        /// Reason for a person and for the exit code.
        because: Reason,
    },
}

/// Why a check was not done.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Reason {
    /// The configuration has this key set to false.
    NotAsked(&'static str),
    /// It needs a person at a terminal.
    NoPerson,
    /// It needs another check to pass.
    After(Subject),
    /// The test was stopped.
    Stopped(String),
}

impl Check {
    /// Whether it passed or is disabled.
    pub fn is_good(&self) -> bool {
        matches!(self.outcome, Outcome::Passed { .. } | Outcome::NotDone { because: Reason::NotAsked(_) })
    }
}

impl Outcome {
    /// A bus that is as expected.
    pub fn passed(found: impl Into<String>) -> Self {
        Self::Passed { found: found.into() }
    }

    /// A bus that is not as expected, because of a known problem; `found` may have more figures than its text.
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
