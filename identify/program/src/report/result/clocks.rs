//! Difference and relative rate of the clocks of instrument and robot, as estimated by a calibration. This module contains
//! their entry in `calibration.toml`, and the sentences about them for terminal and page.

use serde::{Deserialize, Serialize};
use shared::time::UtcNs;

use crate::calibrate::Calibration;
use crate::instrument::Run;
use crate::model::ParameterId;
use crate::prepare::Alignment;

/// Time alignment of the logs of an instrument and the robot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ClockEntry {
    /// Number of the run or file, from 1.
    pub data_set: usize,
    /// Instrument whose clock the robot's clock is compared with: `ball-bar` or `tracker`.
    pub instrument: String,
    /// Reference time on the instrument's clock.
    pub reference_utc: String,
    /// Robot clock minus instrument clock at the reference time \[ns\].
    pub robot_minus_instrument_ns: i64,
    /// One standard deviation of this difference \[ns\]. Absent if no solve estimated it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sigma_ns: Option<f64>,
    /// Relative rate of the robot's clock minus one \[ppm\]. It is positive if the robot's clock runs faster.
    pub skew_ppm: f64,
    /// One standard deviation of `skew_ppm` \[ppm\]. Absent if no solve estimated it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub skew_sigma_ppm: Option<f64>,
    /// Correlation of the speeds at the coarse alignment.
    pub correlation: f64,
    /// Duration of the overlap of the logs \[s\].
    pub overlap_s: f64,
    /// True if the alignment is ambiguous: because the motion repeats, other differences of the clocks fit equally well.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub ambiguous: bool,
}

impl ClockEntry {
    /// Entry of data set `run` (from 0) at the solution. `reference` is the reference time on the instrument's clock, and
    /// `is_dated` is true if the epoch of this clock is known. `alignment` is the time alignment before the solve.
    pub fn solved(
        calibration: &Calibration,
        run: usize,
        (reference, is_dated): (UtcNs, bool),
        alignment: &Alignment,
    ) -> Option<Self> {
        let Run { instrument, model } = calibration.runs.get(run)?;
        let solved = &calibration.solved;
        let value = |id| model.parameter(id).map_or(0.0, |parameter| parameter.value);
        let columns = solved.columns.of_run(run);
        let sigma = |id| solved.solution.covariance.sigma(*columns.get(model.column_of(id)?)?);
        let instrument = instrument.name();
        let reference_s = reference.0 as f64 * 1e-9;
        Some(Self {
            data_set: run + 1,
            instrument: instrument.to_owned(),
            reference_utc: if is_dated {
                reference.to_string()
            } else {
                format!("{reference_s:.3} s (the {instrument}'s clock, its epoch is unknown)")
            },
            robot_minus_instrument_ns: alignment.solved_difference_ns(value(ParameterId::ClockShift)),
            sigma_ns: sigma(ParameterId::ClockShift).map(|sigma_s| sigma_s * 1e9),
            skew_ppm: value(ParameterId::ClockSkew) * 1e6,
            skew_sigma_ppm: sigma(ParameterId::ClockSkew).map(|sigma| sigma * 1e6),
            correlation: alignment.correlation,
            overlap_s: alignment.overlap_s,
            ambiguous: alignment.ambiguous,
        })
    }

    /// Clause with the difference and the relative rate of the clocks.
    pub fn difference(&self) -> String {
        let within = |sigma: Option<f64>, unit: &str| {
            sigma.map_or_else(String::new, |sigma| format!(" (sigma {sigma:.2} {unit})"))
        };
        format!(
            "robot's clock minus {}'s: {:.6} s{} at {}, faster by {:+.3} ppm{}",
            self.instrument,
            self.robot_minus_instrument_ns as f64 * 1e-9,
            within(self.sigma_ns.map(|sigma_ns| sigma_ns * 1e-3), "us"),
            self.reference_utc,
            self.skew_ppm,
            within(self.skew_sigma_ppm, "ppm"),
        )
    }

    /// Sentence with the content of [`Self::difference`], the correlation of the speeds and the overlap of the logs.
    pub fn sentence(&self) -> String {
        let repeats = if self.ambiguous {
            "; the motion repeats itself and other shifts fit as well: the geometry is the same, the clocks are not"
        } else {
            ""
        };
        format!(
            "{}; speeds correlate to {:.3}, the logs overlap for {:.1} s{repeats}",
            self.difference(),
            self.correlation,
            self.overlap_s
        )
    }
}
