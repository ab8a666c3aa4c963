//! The entry of `calibration.toml` and `calibration.json` on the force on the bar: its range, the identified elongation, and
//! the deviation from the sphere with and without it.

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
    /// Clock of the force log.
    pub clock: ForceClock,
    /// Direction of the log's positive force: `tension`, `compression` or `not determined`.
    pub positive: String,
    /// `bcompliance` \[m/N\] or `bplay`, half of the play \[m\]: positive where the log's positive force makes the bar longer.
    pub parameter: String,
    /// Value at the solution.
    pub value: f64,
    /// One standard deviation; absent where it was fixed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sigma: Option<f64>,
    /// Smallest and largest along the bar \[N\], or signs.
    pub range: [f64; 2],
    /// Samples left out because they have no force.
    pub uncovered: usize,
    /// Deviation of the calibrated robot from the sphere of a rigid bar, root mean square \[m\].
    pub off_sphere_rms_m: f64,
    /// The same without what the force explains \[m\].
    pub unexplained_rms_m: f64,
    /// Effect of the force on the bar's length, and the log's positive direction, as a sentence.
    pub sentence: String,
}

impl ForceEntry {
    /// Of a run that has a force.
    pub fn of(sphere: &SphereDeviation) -> Option<Self> {
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
