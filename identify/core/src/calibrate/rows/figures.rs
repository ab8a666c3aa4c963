//! Statistics of pose errors of any instrument. Tests whether a calibrated robot is better or worse than the nominal one
//! for the same samples. Defines the stages of a calibration after which the errors of rows are recorded ([`Stages`]).

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
    pub fn of(errors: impl IntoIterator<Item = PoseError>) -> Self {
        let errors: Vec<PoseError> = errors.into_iter().collect();
        let angles: Option<Vec<f64>> = errors.iter().map(|error| error.rotation_rad).collect();
        Self {
            rows: errors.len(),
            position_m: Sizes::of(errors.iter().map(|error| error.position_m)),
            rotation_rad: angles.filter(|a| !a.is_empty()).map(|angles| Sizes::of(angles.into_iter())),
        }
    }

    /// Root mean squares of position and rotation.
    pub fn rms(&self) -> PoseError {
        let rotation_rad = self.rotation_rad.map(|sizes| sizes.rms);
        PoseError { position_m: self.position_m.rms, rotation_rad }
    }
}

/// Number of independent errors of samples that share their errors, such as the samples of a segment: one along each axis.
pub const INDEPENDENT_OF_GROUP: usize = 3;
/// Probability that a calibrated robot is classified as better although it is not.
const BETTER_BY_CHANCE: f64 = 0.05;
/// Probability that a calibrated robot is classified as worse although it is not.
const WORSE_BY_CHANCE: f64 = 1e-3;

/// Quantile of the ratio of two root mean squares, at this probability, if both robots have equal errors. Each root mean
/// square is that of `n` errors. The variance of the difference of their logarithms is at most `1 / n`, because both are
/// for the same samples.
fn ratio_by_chance(n: usize, probability: f64) -> f64 {
    let sigma = (n.max(1) as f64).sqrt().recip();
    (Normal::standard().inverse_cdf(probability) * sigma).exp()
}

/// Whether the calibrated robot is significantly better, from two root mean squares of `n` errors each. The position must
/// be significantly better. The rotation, if it was measured, must be better by any amount.
pub fn is_surely_better(n: usize, [nominal, calibrated]: [PoseError; 2]) -> bool {
    let limit_m = ratio_by_chance(n, BETTER_BY_CHANCE) * nominal.position_m;
    let rotations = nominal.rotation_rad.zip(calibrated.rotation_rad);
    let rotation_is_better = rotations.is_none_or(|(nominal, calibrated)| calibrated < nominal);
    n > 0 && calibrated.position_m < limit_m && rotation_is_better
}

/// Whether the calibrated robot is significantly worse, from two root mean squares of `n` errors each.
pub fn is_surely_worse(n: usize, [nominal, calibrated]: [f64; 2]) -> bool {
    calibrated > nominal * ratio_by_chance(n, 1.0 - WORSE_BY_CHANCE)
}

/// Results for the same rows after each of four fits to the fitting rows. A drift of the instrument's offset is
/// removed from each result.
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
