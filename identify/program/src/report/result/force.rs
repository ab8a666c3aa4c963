//! The entry of `calibration.toml` and `calibration.json` about the force on the bar. It contains the range of the force, the
//! identified elongation of the bar, and the deviation from the sphere with and without this elongation.

use serde::{Deserialize, Serialize};

use crate::evaluate::{PositiveForce, SphereDeviation};
use crate::logs::{ForceClock, ForceKind};

/// The force on the bar in `calibration.toml` and `calibration.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ForceEntry {
    /// Number of the run, from 1.
    pub run: usize,
    /// Kind of the measured force.
    pub kind: ForceKind,
    /// Clock by which the force log was recorded.
    pub clock: ForceClock,
    /// Direction of the log's positive force: `tension`, `compression` or `not determined`.
    pub positive: String,
    /// Name of the identified parameter: `bcompliance` \[m/N\], or `bplay`, half of the play \[m\]. Its value is positive if
    /// the log's positive force makes the bar longer.
    pub parameter: String,
    /// Value at the solution.
    pub value: f64,
    /// One standard deviation. Absent if the parameter was fixed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sigma: Option<f64>,
    /// Smallest and largest force along the bar \[N\], or smallest and largest sign.
    pub range: [f64; 2],
    /// Number of samples left out because they have no force.
    pub uncovered: usize,
    /// RMS deviation of the calibrated robot from the sphere of a rigid bar \[m\].
    pub off_sphere_rms_m: f64,
    /// RMS deviation from the sphere that the force does not explain \[m\].
    pub unexplained_rms_m: f64,
    /// Effect of the force on the bar's length, and the log's positive direction, as a sentence.
    pub sentence: String,
}

impl ForceEntry {
    /// Entry of a run; `None` if the run has no force.
    pub fn from_deviation(sphere: &SphereDeviation) -> Option<Self> {
        let elongation = sphere.elongation?;
        let positive = match elongation.positive {
            PositiveForce::Tension => "tension",
            PositiveForce::Compression => "compression",
            PositiveForce::NotDetermined => "not determined",
        };
        Some(Self {
            run: elongation.run + 1,
            kind: elongation.measured.kind,
            clock: elongation.measured.clock,
            positive: positive.into(),
            parameter: elongation.parameter.to_string(),
            value: elongation.value,
            sigma: elongation.sigma,
            range: elongation.measured.range,
            uncovered: elongation.measured.uncovered,
            off_sphere_rms_m: sphere.after.size_m.rms,
            unexplained_rms_m: sphere.after.unexplained_rms_m,
            sentence: elongation.sentence(),
        })
    }
}
