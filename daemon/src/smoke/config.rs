//! The configuration of the smoke test, `config/smoke.toml`: which checks are done, and their limits.

use std::time::Duration;

use serde::{Deserialize, Serialize};
use shared::config::{DaemonConfig, Kind, Validate, Violation};

/// Checks to be done, and their limits.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SmokeConfig {
    /// Check the encoder signals. An encoder must be connected to every terminal.
    pub signals: bool,
    /// Check the homing, for which a person turns one joint after the other.
    pub homing: bool,
    /// Check the cable, which a person pulls and plugs in again.
    pub pulled_cable: bool,
    /// Largest fraction of the cycles at one rate that may be bad for the same reason.
    pub bad_share_max: f64,
    /// Revisions of the coupler whose behaviour is known. Only the upper half of the revision number is listed.
    pub coupler_revisions: Vec<u16>,
    /// Revisions of the terminals whose process data are known. Only the upper half of the revision number is listed.
    pub terminal_revisions: Vec<u16>,
    /// Cycle rates, which are tested in this order. The bus is brought into operation for each rate.
    pub cycles: Vec<CyclesConfig>,
}

/// A series of cycles at one rate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CyclesConfig {
    /// Cycles per second \[Hz\].
    pub rate_hz: u32,
    /// Duration \[s\].
    pub duration_s: u32,
}

impl CyclesConfig {
    /// Duration of the series.
    pub fn duration(self) -> Duration {
        Duration::from_secs(self.duration_s.into())
    }

    /// Number of cycles of the series.
    pub fn cycles(self) -> u64 {
        u64::from(self.rate_hz) * u64::from(self.duration_s)
    }
}

impl Validate for SmokeConfig {
    const KIND: Option<Kind> = Some(Kind::Smoke);

    fn validate(&self) -> Result<(), Violation> {
        if !(0.0..=1.0).contains(&self.bad_share_max) {
            let problem = format!("{} is outside 0 to 1", self.bad_share_max);
            return Err(Violation::new("bad_share_max", problem, "0.001 is one cycle in a thousand"));
        }
        if self.cycles.is_empty() {
            return Err(Violation::new(
                "cycles",
                "the list is empty",
                "add [[cycles]] with rate_hz and duration_s",
            ));
        }
        for CyclesConfig { rate_hz, duration_s } in &self.cycles {
            DaemonConfig { rate_hz: *rate_hz, ..DaemonConfig::default() }.validate()?;
            if !(1..=86_400).contains(duration_s) {
                let problem = format!("{duration_s} is outside 1 to 86400");
                return Err(Violation::new("duration_s", problem, "60 is usual"));
            }
        }
        Ok(())
    }
}
