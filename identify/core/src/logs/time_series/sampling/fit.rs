//! Fits a smooth curve with steps to the rests of the stamps. The rest of a stamp is the stamp minus the number of its
//! row times the period.
//!
//! The curve is a chain of straight pieces between knots, a minute apart. The rows of the steps (*breaks*) are given, and
//! the fit estimates the sizes of the steps. A prior keeps the slope similar from piece to piece.

use std::ops::Range;

use nalgebra::{DMatrix, DVector};

use super::breaks::BESIDE;
use crate::statistics::median;

/// Distance of the knots, at which the fitted rate of the clock may change \[s\]. The rate of a clock follows temperature,
/// which takes minutes to change.
const KNOTS_S: f64 = 60.0;
/// Largest number of pieces between knots.
const PIECES_MAX: usize = 200;
/// Standard deviation of the change of the clock's rate from one knot to the next: a quartz clock changes by this if its
/// temperature changes by 1 K.
const RATE_CHANGE: f64 = 2e-6;
/// Limit of the Huber loss in standard deviations.
const HUBER: f64 = 1.345;

/// The curve fitted to the rests `t_k - n_k period`: a line with a bend at each knot, and a step at each break.
pub(super) struct StampFit {
    /// Value of the curve without the steps, for each row \[s\].
    pub(super) without_steps_s: Vec<f64>,
    /// Value of the curve with the steps, for each row \[s\].
    pub(super) with_steps_s: Vec<f64>,
    /// The step at each break \[s\].
    pub(super) steps_s: Vec<f64>,
    /// Estimated minus assumed period \[s\].
    pub(super) slope_s: f64,
}

impl StampFit {
    /// Minimises the Huber loss of the residuals plus `bend_weight` times the squared second differences at the knots,
    /// by iteratively reweighted least squares. For rounded stamps `bend_weight` is larger and the curve smoother,
    /// because the rounding errors of stamps in the same cell of the grid are not independent. `None` without rows, or
    /// if the equations cannot be solved.
    pub(super) fn new(
        rest_s: &[f64],
        numbers: &[f64],
        period_s: f64,
        breaks: &[usize],
        grid_s: Option<f64>,
    ) -> Option<Self> {
        const ROUNDS: usize = 8;
        // A step may be as large as an hour. Medians give a rough size, which is subtracted from the rests. Only the
        // remainder is fitted, so that floating-point errors stay small.
        let rough_s: Vec<f64> =
            breaks.iter().map(|&at| rough_step_s(rest_s, at).unwrap_or_default()).collect();
        let roughly_stepped_s = |row: usize| -> f64 {
            breaks.iter().zip(&rough_s).filter(|(first, _)| **first <= row).map(|(_, by_s)| by_s).sum()
        };
        let rest_s: Vec<f64> =
            rest_s.iter().enumerate().map(|(row, rest)| rest - roughly_stepped_s(row)).collect();
        let last_number = numbers.last()?.max(1.0);
        let pieces = ((last_number * period_s / KNOTS_S).ceil() as usize).clamp(1, PIECES_MAX);
        let curve = FitCurve { numbers, breaks, last_number, pieces };
        // Conservative variance, for which all rows of a piece are assumed to have the same rounding error.
        let rounding_variance =
            grid_s.unwrap_or_default().powi(2) / 12.0 * rest_s.len() as f64 / pieces as f64;
        // Standard deviation of a second difference of the values at three successive knots.
        let bend_s = RATE_CHANGE * last_number * period_s / pieces as f64;
        let mut x = DVector::<f64>::zeros(curve.unknowns());
        let mut sigma_s = f64::INFINITY;
        for _ in 0..ROUNDS {
            let (mut matrix, right_side) = curve.normal_equations(&rest_s, &x, HUBER * sigma_s);
            let scatter_variance = if sigma_s.is_finite() { sigma_s * sigma_s } else { 0.0 };
            let bend_weight = (scatter_variance + rounding_variance) / (bend_s * bend_s);
            curve.add_bends(&mut matrix, bend_weight);
            // Makes the matrix invertible if a piece has no rows.
            (0..curve.unknowns()).for_each(|i| matrix[(i, i)] += 1e-9 * (1.0 + matrix[(i, i)]));
            x = matrix.cholesky()?.solve(&right_side);
            let residual_s =
                |(row, rest): (usize, &f64)| (rest - curve.with_steps(&x, curve.place(row))).abs();
            let mut residuals_s: Vec<f64> = rest_s.iter().enumerate().map(residual_s).collect();
            // The median absolute value of a normal distribution is 0.675 standard deviations.
            sigma_s = (1.48 * median(&mut residuals_s)?).max(1e-9);
        }
        let places = (0..rest_s.len()).map(|row| (row, curve.place(row)));
        let steps = x.rows(curve.first_step(), breaks.len());
        Some(Self {
            without_steps_s: places.clone().map(|(_, place)| curve.without_steps(&x, place)).collect(),
            with_steps_s: places
                .map(|(row, place)| curve.with_steps(&x, place) + roughly_stepped_s(row))
                .collect(),
            steps_s: steps.iter().zip(&rough_s).map(|(remainder, rough_s)| remainder + rough_s).collect(),
            slope_s: (x[pieces] - x[0]) / last_number,
        })
    }
}

/// Difference between the medians of the rests on both sides of a break \[s\].
fn rough_step_s(rest_s: &[f64], at: usize) -> Option<f64> {
    let middle_s = |range: Range<usize>| median(&mut rest_s.get(range)?.to_vec());
    let end = (at + BESIDE).min(rest_s.len());
    Some(middle_s(at..end)? - middle_s(at.saturating_sub(BESIDE)..at)?)
}

/// Geometry of the curve to be fitted. The vector `x` of unknowns contains the values at the knots, then the
/// sizes of the steps:
///
/// ```text
/// | knot 0 | knot 1 | ... | knot `pieces` | step 0 | step 1 | ... |
/// ```
struct FitCurve<'a> {
    /// Number of each row on the clock, in periods.
    numbers: &'a [f64],
    /// First row after each step.
    breaks: &'a [usize],
    /// Number of the last row.
    last_number: f64,
    /// Number of pieces between knots.
    pieces: usize,
}

/// Position of a row on the curve: the knot before the row, the fraction of the way to the next knot, and the number
/// of steps before the row.
#[derive(Clone, Copy)]
struct KnotPosition {
    knot: usize,
    fraction: f64,
    steps: usize,
}

impl FitCurve<'_> {
    fn first_step(&self) -> usize {
        self.pieces + 1
    }

    fn unknowns(&self) -> usize {
        self.first_step() + self.breaks.len()
    }

    fn place(&self, row: usize) -> KnotPosition {
        let along = self.numbers[row] / self.last_number * self.pieces as f64;
        let knot = (along as usize).min(self.pieces - 1);
        let steps = self.breaks.partition_point(|first| *first <= row);
        KnotPosition { knot, fraction: along - knot as f64, steps }
    }

    fn without_steps(&self, x: &DVector<f64>, KnotPosition { knot, fraction, .. }: KnotPosition) -> f64 {
        (1.0 - fraction) * x[knot] + fraction * x[knot + 1]
    }

    fn with_steps(&self, x: &DVector<f64>, place: KnotPosition) -> f64 {
        self.without_steps(x, place) + x.rows(self.first_step(), place.steps).sum()
    }

    /// Normal equations of all rows. Rows whose residuals at `x` are above `limit_s` have less weight (Huber).
    fn normal_equations(
        &self,
        rest_s: &[f64],
        x: &DVector<f64>,
        limit_s: f64,
    ) -> (DMatrix<f64>, DVector<f64>) {
        let mut matrix = DMatrix::<f64>::zeros(self.unknowns(), self.unknowns());
        let mut right_side = DVector::<f64>::zeros(self.unknowns());
        for (row, rest) in rest_s.iter().enumerate() {
            let place = self.place(row);
            let weight = (limit_s / (rest - self.with_steps(x, place)).abs()).min(1.0);
            let weight = if weight.is_finite() { weight } else { 1.0 };
            let KnotPosition { knot, fraction, steps } = place;
            let mut coefficients = vec![(knot, 1.0 - fraction), (knot + 1, fraction)];
            coefficients.extend((0..steps).map(|step| (self.first_step() + step, 1.0)));
            for &(i, a) in &coefficients {
                right_side[i] += weight * a * rest;
                coefficients.iter().for_each(|&(j, b)| matrix[(i, j)] += weight * a * b);
            }
        }
        (matrix, right_side)
    }

    /// Adds `weight` times the squared second differences at the knots to the normal equations.
    fn add_bends(&self, matrix: &mut DMatrix<f64>, weight: f64) {
        for first in 0..self.pieces.saturating_sub(1) {
            let bend = [(first, 1.0), (first + 1, -2.0), (first + 2, 1.0)];
            for (i, a) in bend {
                bend.iter().for_each(|&(j, b)| matrix[(i, j)] += weight * a * b);
            }
        }
    }
}
