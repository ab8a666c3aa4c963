//! Figures of position and orientation errors.

use crate::instrument::{Apart, quantile};

/// Sizes of errors over some rows, all in one unit.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
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
        let mut sorted: Vec<f64> = sizes.collect();
        sorted.sort_by(f64::total_cmp);
        let count = sorted.len().max(1) as f64;
        Self {
            mean: sorted.iter().sum::<f64>() / count,
            rms: (sorted.iter().map(|e| e * e).sum::<f64>() / count).sqrt(),
            p95: quantile(&sorted, 0.95),
            max: sorted.last().copied().unwrap_or(0.0),
        }
    }
}

/// Figures over some rows.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PoseFigures {
    /// Rows.
    pub rows: usize,
    /// Distances \[m\].
    pub position_m: Sizes,
    /// Angles \[rad\]; none where only positions were measured.
    pub rotation_rad: Option<Sizes>,
}

impl PoseFigures {
    /// Of these errors.
    pub fn of(errors: &[Apart]) -> Self {
        let angles: Option<Vec<f64>> = errors.iter().map(|error| error.rotation_rad).collect();
        Self {
            rows: errors.len(),
            position_m: Sizes::of(errors.iter().map(|error| error.position_m)),
            rotation_rad: angles.filter(|a| !a.is_empty()).map(|angles| Sizes::of(angles.into_iter())),
        }
    }
}

/// The same rows in three stages, each fitted to the fitting rows.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Stages {
    /// Tracker and probe, the robot nominal.
    pub nominal: PoseFigures,
    /// And the robot's links.
    pub links: PoseFigures,
    /// And the errors of its joints.
    pub joints: PoseFigures,
}

impl Stages {
    /// Of chosen rows.
    pub(super) fn of(stages: [&[Apart]; 3], chosen: &[usize]) -> Self {
        let [nominal, links, joints] = stages.map(|errors| {
            let chosen = chosen.iter().filter_map(|&row| errors.get(row).copied());
            PoseFigures::of(&chosen.collect::<Vec<_>>())
        });
        Self { nominal, links, joints }
    }
}
