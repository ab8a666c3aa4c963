//! Rows that do not belong into a fit.

use nalgebra::Vector3;

use super::figures::{median, pick};
use super::{LengthOptions, RejectedRow, Rejection};
use crate::instrument::LengthRow;
use crate::kinematics::Chain;

/// Median absolute deviation from zero to standard deviation of a normal distribution.
const SIGMA_PER_MEDIAN: f64 = 1.4826;

/// Standard deviation of residuals that are mostly normal, by their median size.
pub(super) fn robust_sigma(residuals: &[f64]) -> f64 {
    let mut sizes: Vec<f64> = residuals.iter().map(|r| r.abs()).collect();
    sizes.sort_by(f64::total_cmp);
    // Data without any noise still need a unit.
    (SIGMA_PER_MEDIAN * median(&sizes)).max(1e-9)
}

/// Rows whose controller position is not where their joint angles put the flange.
pub(super) fn contradicting(rows: &[LengthRow], robot: &Chain, tolerance_m: f64) -> Vec<RejectedRow> {
    let distance = |row: &LengthRow| {
        let claimed = row.flange_m.map(Vector3::from)?;
        Some((robot.forward(&row.joints_rad).translation.vector - claimed).norm())
    };
    let rejected = |(index, row): (usize, &LengthRow)| {
        let distance_m = distance(row).filter(|d| *d > tolerance_m)?;
        Some(RejectedRow { row: index, why: Rejection::FlangeContradicts { distance_m } })
    };
    rows.iter().enumerate().filter_map(rejected).collect()
}

/// Rows that a fit should not see: single fitting rows with gross residuals, and every row, fitting or not, inside a
/// run of which the fitting rows are mostly off. The scale is that of the `kept` rows.
pub(super) fn faulty(
    residuals_m: &[f64],
    fitting: &[usize],
    kept: &[usize],
    options: &LengthOptions,
) -> Vec<RejectedRow> {
    let sigma_m = robust_sigma(&pick(residuals_m, kept));
    let single = |row: &usize| {
        let residual_m = residuals_m.get(*row).copied()?;
        let gross = residual_m.abs() > options.residual_limit * sigma_m;
        gross.then_some(RejectedRow { row: *row, why: Rejection::GrossResidual { residual_m } })
    };
    let in_run = |row: usize| {
        let median_m = neighbours_m(residuals_m, fitting, row);
        let faulty = median_m > options.run_limit? * sigma_m;
        faulty.then_some(RejectedRow { row, why: Rejection::FaultyRun { median_m } })
    };
    let mut found: Vec<RejectedRow> = (0..residuals_m.len()).filter_map(in_run).collect();
    let singles = fitting.iter().filter_map(single).filter(|r| found.iter().all(|f| f.row != r.row));
    let singles: Vec<RejectedRow> = singles.collect();
    found.extend(singles);
    found.sort_by_key(|r| r.row);
    found
}

/// Median size of the residuals of the fitting rows just before or just after a row, whichever is larger: a run ends
/// sharply, and a row at its edge belongs to it.
fn neighbours_m(residuals_m: &[f64], fitting: &[usize], row: usize) -> f64 {
    const ROWS_EACH_SIDE: usize = 5;
    let at = fitting.partition_point(|&f| f < row);
    let itself = usize::from(fitting.get(at) == Some(&row));
    let before = at + itself;
    let sides = [before.saturating_sub(ROWS_EACH_SIDE)..before, at..(at + ROWS_EACH_SIDE).min(fitting.len())];
    let sides = sides.map(|side| fitting.get(side).unwrap_or_default());
    let size = |side: &[usize]| {
        let mut sizes: Vec<f64> = pick(residuals_m, side).iter().map(|r| r.abs()).collect();
        sizes.sort_by(f64::total_cmp);
        // A side with few rows says nothing.
        if sizes.len() < ROWS_EACH_SIDE { 0.0 } else { median(&sizes) }
    };
    size(sides[0]).max(size(sides[1]))
}

/// The same rows are rejected.
pub(super) fn same_rows(a: &[RejectedRow], b: &[RejectedRow]) -> bool {
    a.iter().map(|r| r.row).eq(b.iter().map(|r| r.row))
}

/// Rows that are not rejected.
pub(super) fn without(rows: &[usize], rejected: &[RejectedRow]) -> Vec<usize> {
    rows.iter().copied().filter(|row| rejected.iter().all(|r| r.row != *row)).collect()
}
