//! Figures of position, orientation and length errors.

use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF, Normal};

use crate::instrument::PoseError;
use crate::statistics::quantile;

/// Sizes of errors over some rows, all in one unit.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Sizes {
    /// Mean.
    pub mean: f64,
    /// Root mean square.
    pub rms: f64,
    /// Nineteen of twenty are below it.
    pub p95: f64,
    /// Largest.
    pub max: f64,
}

impl Sizes {
    /// Of these sizes; zeros where there are none.
    pub fn of(sizes: impl Iterator<Item = f64>) -> Self {
        let mut sizes: Vec<f64> = sizes.collect();
        let count = sizes.len().max(1) as f64;
        Self {
            mean: sizes.iter().sum::<f64>() / count,
            rms: (sizes.iter().map(|e| e * e).sum::<f64>() / count).sqrt(),
            p95: quantile(&mut sizes, 0.95),
            max: quantile(&mut sizes, 1.0),
        }
    }
}

/// Figures over some rows.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct PoseFigures {
    /// Rows.
    pub rows: usize,
    /// Distances, or sizes of the errors of lengths \[m\].
    pub position_m: Sizes,
    /// Angles \[rad\]; none where only positions were measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rotation_rad: Option<Sizes>,
}

impl PoseFigures {
    /// Of these errors.
    pub fn of(errors: &[PoseError]) -> Self {
        let angles: Option<Vec<f64>> = errors.iter().map(|error| error.rotation_rad).collect();
        Self {
            rows: errors.len(),
            position_m: Sizes::of(errors.iter().map(|error| error.position_m)),
            rotation_rad: angles.filter(|a| !a.is_empty()).map(|angles| Sizes::of(angles.into_iter())),
        }
    }
}

/// Chance that a geometry which is as good as the nominal one counts as better.
const BETTER_BY_CHANCE: f64 = 0.05;

/// Whether the second of two root mean squares of `n` errors each is smaller: in position beyond chance, in rotation at all. Their
/// logarithms differ by a variance of `1 / n` at most.
pub fn is_surely_better(n: usize, position: [f64; 2], rotation: Option<[f64; 2]>) -> bool {
    let sigma = (n.max(1) as f64).sqrt().recip();
    let limit = (Normal::standard().inverse_cdf(BETTER_BY_CHANCE) * sigma).exp();
    let [nominal, own] = position;
    n > 0 && own < limit * nominal && rotation.is_none_or(|[nominal, own]| own < nominal)
}

/// Chance that a calibration that is as good as the nominal robot is called worse.
const WORSE_BY_CHANCE: f64 = 1e-3;

/// Whether the second of two root mean squares of `n` errors each is larger beyond chance. Their logarithms differ by a variance of
/// `1 / n` at most: they are of the same rows.
pub fn is_surely_worse(n: usize, [nominal, calibrated]: [f64; 2]) -> bool {
    let sigma = (n.max(1) as f64).sqrt().recip();
    calibrated > nominal * (Normal::standard().inverse_cdf(1.0 - WORSE_BY_CHANCE) * sigma).exp()
}

impl PoseFigures {
    /// Smaller than those of the same rows with the nominal robot, by [`is_surely_better`].
    pub fn are_surely_better_than(&self, nominal: &Self) -> bool {
        let rotations = nominal.rotation_rad.zip(self.rotation_rad);
        is_surely_better(
            self.rows,
            [nominal.position_m.rms, self.position_m.rms],
            rotations.map(|(nominal, own)| [nominal.rms, own.rms]),
        )
    }
}

/// The same rows in stages, each fitted to the fitting rows.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Stages {
    /// Tracker and probe, or the wire; the robot nominal.
    pub nominal: PoseFigures,
    /// And the robot's joint offsets.
    #[serde(default)]
    pub offsets: PoseFigures,
    /// And the other numbers of its links.
    pub links: PoseFigures,
    /// And the errors of its joints, and of the wire's zero.
    pub joints: PoseFigures,
}

/// Errors of each row of a file in the stages of [`Stages`], and which rows the fit saw.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RowErrors {
    /// Of all rows, stage by stage.
    pub stages: [Vec<PoseError>; 4],
    /// Rows that the fit saw.
    pub fitted: Vec<usize>,
    /// Rows that it did not see.
    pub held_out: Vec<usize>,
}

impl RowErrors {
    /// Figures of chosen rows.
    pub fn of(&self, chosen: &[usize]) -> Stages {
        let of_stage = |errors: &Vec<PoseError>| {
            PoseFigures::of(&chosen.iter().filter_map(|&row| errors.get(row).copied()).collect::<Vec<_>>())
        };
        let [nominal, offsets, links, joints] = self.stages.each_ref().map(of_stage);
        Stages { nominal, offsets, links, joints }
    }
}
