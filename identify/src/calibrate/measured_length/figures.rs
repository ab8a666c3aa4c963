//! Figures of length errors.

use crate::instrument::quantile;

/// Size of errors over some rows.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ErrorFigures {
    /// Rows.
    pub rows: usize,
    /// Mean of the absolute error \[m\].
    pub mean_m: f64,
    /// Root mean square \[m\].
    pub rms_m: f64,
    /// Median of the absolute error \[m\].
    pub median_m: f64,
    /// Nineteen of twenty are below it \[m\].
    pub p95_m: f64,
    /// Largest absolute error \[m\].
    pub max_m: f64,
}

impl ErrorFigures {
    /// Of these errors \[m\]; zeros where there are none.
    pub fn of(errors_m: &[f64]) -> Self {
        let count = errors_m.len().max(1) as f64;
        let mut sizes: Vec<f64> = errors_m.iter().map(|e| e.abs()).collect();
        sizes.sort_by(f64::total_cmp);
        Self {
            rows: errors_m.len(),
            mean_m: sizes.iter().sum::<f64>() / count,
            rms_m: (sizes.iter().map(|e| e * e).sum::<f64>() / count).sqrt(),
            median_m: median(&sizes),
            p95_m: quantile(&sizes, 0.95),
            max_m: sizes.last().copied().unwrap_or(0.0),
        }
    }
}

/// The same rows before and after the robot was calibrated. Before: anchor, attachment and offset fitted, robot
/// nominal.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Figures {
    /// With the nominal robot.
    pub before: ErrorFigures,
    /// With the calibrated robot.
    pub after: ErrorFigures,
}

/// Middle of sorted numbers, zero of none.
pub(super) fn median(sorted: &[f64]) -> f64 {
    let middle = |i: usize| sorted.get(i).copied().unwrap_or(0.0);
    match sorted.len() {
        0 => 0.0,
        n => 0.5 * (middle((n - 1) / 2) + middle(n / 2)),
    }
}

/// Values of the chosen rows.
pub(super) fn pick(values: &[f64], chosen: &[usize]) -> Vec<f64> {
    chosen.iter().filter_map(|&row| values.get(row).copied()).collect()
}
