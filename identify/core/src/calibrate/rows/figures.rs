//! Statistics of pose errors of any instrument. Tests whether the calibrated robot is better or worse than the nominal robot
//! for the same samples. Also defines the stages of a calibration after which the errors of rows are recorded ([`Stages`]).

use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF, Normal};

use crate::instrument::PoseError;
use crate::statistics::Sizes;

/// Statistics of pose errors over a number of samples.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct PoseFigures {
    /// Number of samples in the statistics.
    pub rows: usize,
    /// Position errors, or absolute errors of lengths \[m\].
    pub position_m: Sizes,
    /// Rotation angles \[rad\]; `None` if only positions were measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rotation_rad: Option<Sizes>,
}

impl PoseFigures {
    /// Computes the statistics of these errors.
    pub fn from_errors(errors: impl IntoIterator<Item = PoseError>) -> Self {
        let errors: Vec<PoseError> = errors.into_iter().collect();
        let angles: Option<Vec<f64>> = errors.iter().map(|error| error.rotation_rad).collect();
        Self {
            rows: errors.len(),
            position_m: Sizes::from_values(errors.iter().map(|error| error.position_m)),
            rotation_rad: angles
                .filter(|a| !a.is_empty())
                .map(|angles| Sizes::from_values(angles.into_iter())),
        }
    }

    /// Root mean squares of position and rotation.
    pub fn rms(&self) -> PoseError {
        let rotation_rad = self.rotation_rad.map(|sizes| sizes.rms);
        PoseError { position_m: self.position_m.rms, rotation_rad }
    }
}

/// Number of independent errors of a group of samples with common errors, such as a segment: one along each axis.
pub const INDEPENDENT_OF_GROUP: usize = 3;
/// Probability that a calibrated robot is classified as better although it is not.
const BETTER_BY_CHANCE: f64 = 0.05;
/// Probability that a calibrated robot is classified as worse although it is not.
const WORSE_BY_CHANCE: f64 = 1e-3;

/// Ratio of two root mean squares that is not exceeded with this probability if both robots have equal errors. Each root
/// mean square is computed from `n` errors. The variance of the difference of their logarithms is at most `1 / n`, because
/// both robots are tested with the same samples.
fn ratio_by_chance(n: usize, probability: f64) -> f64 {
    let sigma = (n.max(1) as f64).sqrt().recip();
    (Normal::standard().inverse_cdf(probability) * sigma).exp()
}

/// Whether the calibrated robot is significantly better than the nominal one. Each root mean square is computed from `n`
/// errors. The position must be significantly better. The rotation, if it was measured, only has to be better.
pub fn is_surely_better(n: usize, [nominal, calibrated]: [PoseError; 2]) -> bool {
    let limit_m = ratio_by_chance(n, BETTER_BY_CHANCE) * nominal.position_m;
    let rotations = nominal.rotation_rad.zip(calibrated.rotation_rad);
    let rotation_is_better = rotations.is_none_or(|(nominal, calibrated)| calibrated < nominal);
    n > 0 && calibrated.position_m < limit_m && rotation_is_better
}

/// Whether the calibrated robot is significantly worse than the nominal one. Each root mean
/// square is computed from `n` errors.
pub fn is_surely_worse(n: usize, [nominal, calibrated]: [f64; 2]) -> bool {
    calibrated > nominal * ratio_by_chance(n, 1.0 - WORSE_BY_CHANCE)
}

/// Results for the same rows after each of four fits. The held-out rows were not used in these fits. If the instrument's
/// offset drifts, the drift is removed from each result.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Stages<T = PoseFigures> {
    /// Fit of the instrument alone, with the nominal robot.
    pub nominal: T,
    /// Fit that also estimates the robot's joint offsets.
    #[serde(default)]
    pub offsets: T,
    /// Fit that also estimates the other link parameters.
    pub links: T,
    /// Fit that also estimates error terms of the joints.
    pub joints: T,
}
