//! Drift of an instrument's offset over the rows of a file.
//!
//! If a wire is rewound, slips or warms up, its offset changes, and the errors of neighbouring rows are correlated. The
//! drift of the offset is modelled as a stationary random walk over the row number (Ornstein and Uhlenbeck 1930). It has two
//! parameters: its size is a standard deviation, and its memory is a correlation length. The residuals (model minus measured
//! length) are `r = g + e` with the drift `g` and white noise `e`.
//!
//! The inverse of the covariance `K` of `g` is tridiagonal. Therefore one sweep over the rows computes the best
//! drift for given residuals. A fit of the robot by generalised least squares that includes the drift takes little
//! more time than a fit without drift.
//!
//! 1. Cross-validation over the fitting rows decides whether there is a drift, and chooses its size and memory (`choose`).
//! 2. The size and the white noise are multiplied by a common factor, so that they agree with the residuals (`scaled`).
//! 3. A fit of model and drift gives the drift of each row (`fit`). [`super::RowSet`] corrects the lengths by it.
//! 4. The covariance of the robot is widened, because the drift is not known exactly (`widens`).

use nalgebra::{DMatrix, DVector};

use crate::calibrate::CalibrateError;
use crate::calibrate::selection::terms::falls;
use crate::instrument::Instrument;
use crate::model::{Model, ParameterId};
use crate::solver::{Loss, LossName, Normal, Prior, ScaledCholesky, stacked};
use crate::statistics::mean;

/// Parameters of a drift, with the errors of the cross-validation that chose it.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Drift {
    /// Standard deviation of the offset \[m\].
    pub size_m: f64,
    /// Correlation length in rows. Over this number of rows the correlation decreases to 1/e.
    pub memory_rows: f64,
    /// Standard deviation of a single length without the drift \[m\]. If rows have different
    /// stated noise, that of the median row.
    pub white_m: f64,
    /// Root mean square error of the rows in the cross-validation, without a drift \[m\].
    pub rms_without_m: f64,
    /// Root mean square error of the rows in the cross-validation, with this drift \[m\].
    pub rms_with_m: f64,
}

/// Number of folds of the cross-validation.
const FOLDS: usize = 8;
/// Size of a drift that is negligible, relative to the standard deviation of a length.
const NO_DRIFT: f64 = 1e-6;
/// Number of reweighted steps of generalised least squares. Three steps are sufficient, because the third step changes no
/// printed digit. The other steps are a margin.
const STEPS: usize = 8;
/// Loss of the residuals, in standard deviations. The influence of a residual is constant beyond the scale.
const HUBER: Loss = Loss { name: LossName::Huber, scale: 3.0 };

impl Drift {
    /// A drift that is negligible compared with `sigma_m`, the standard deviation of a length.
    fn none(sigma_m: f64) -> Self {
        Self { size_m: NO_DRIFT * sigma_m, memory_rows: 1.0, white_m: sigma_m, ..Self::default() }
    }
}

/// Drifts to try. Their standard deviations are multiples of `sigma_m`, which is the standard deviation of a
/// length in the fit without a drift.
fn candidates(sigma_m: f64) -> impl Iterator<Item = Drift> {
    const WHITE: [f64; 3] = [0.3, 0.6, 1.0];
    const SIZES: [f64; 4] = [0.5, 1.5, 5.0, 15.0];
    const MEMORIES: [f64; 4] = [5.0, 15.0, 50.0, 150.0];
    WHITE.into_iter().flat_map(move |white| {
        SIZES.into_iter().flat_map(move |size| {
            MEMORIES.into_iter().map(move |memory_rows| Drift {
                size_m: size * sigma_m,
                memory_rows,
                white_m: white * sigma_m,
                ..Drift::default()
            })
        })
    })
}

/// Solves for the drift `g` of all rows: `(K^-1 + W / s^2) g = W r / s^2` with the white noise `s` and the weights `W` of
/// the rows. The matrix is factored once, because it is the same for all residuals `r` (Thomas 1949).
///
/// `K^-1` is a tridiagonal matrix divided by `size^2 (1 - rho^2)`, where `rho` is the correlation of neighbouring rows. The
/// tridiagonal matrix is, for four rows:
///
/// ```text
///    1       -rho       0        0
///  -rho   1 + rho^2   -rho       0
///    0      -rho    1 + rho^2  -rho
///    0        0       -rho       1
/// ```
struct Sweep {
    /// `W / s^2` of each row. Zero for rows that are not used.
    weights: Vec<f64>,
    /// The common value of all entries next to the diagonal.
    off_diagonal: f64,
    /// Diagonal of the factored matrix.
    pivots: Vec<f64>,
}

impl Sweep {
    fn new(drift: &Drift, weights: &[f64]) -> Self {
        let rho = (-drift.memory_rows.recip()).exp();
        let scale = (drift.size_m.powi(2) * (1.0 - rho * rho)).recip();
        let weights: Vec<f64> = weights.iter().map(|w| w / drift.white_m.powi(2)).collect();
        let off_diagonal = -rho * scale;
        let last = weights.len().saturating_sub(1);
        let mut pivots: Vec<f64> = Vec::with_capacity(weights.len());
        for (row, weight) in weights.iter().enumerate() {
            let diagonal = if row == 0 || row == last { scale } else { scale * (1.0 + rho * rho) };
            let eliminated = pivots.last().map_or(0.0, |pivot| off_diagonal * off_diagonal / pivot);
            pivots.push(diagonal + weight - eliminated);
        }
        Self { weights, off_diagonal, pivots }
    }

    /// The estimated drift of all rows for these residuals \[m\].
    fn drift(&self, residuals: &[f64]) -> Vec<f64> {
        let mut g: Vec<f64> = residuals.iter().zip(&self.weights).map(|(r, w)| r * w).collect();
        for row in 1..g.len() {
            g[row] -= self.off_diagonal / self.pivots[row - 1] * g[row - 1];
        }
        for row in (0..g.len()).rev() {
            let after = g.get(row + 1).map_or(0.0, |next| self.off_diagonal * next);
            g[row] = (g[row] - after) / self.pivots[row];
        }
        g
    }

    /// Multiplies the residuals by the inverse covariance of `g + e`: `(K + s^2 W^-1)^-1 r = W (r - g) / s^2`.
    fn by_inverse_covariance(&self, residuals: &[f64]) -> Vec<f64> {
        let drift = self.drift(residuals);
        residuals.iter().zip(drift).zip(&self.weights).map(|((r, g), w)| w * (r - g)).collect()
    }
}

/// Residuals and Jacobian of the model at the used rows \[m\]. All vectors have one entry for each row of the file. Entries
/// of residuals and Jacobian are zero for rows that are not used.
struct Linear {
    residuals: Vec<f64>,
    /// Noise of each row of the file, relative to the median row.
    relative_noise: Vec<f64>,
    /// Jacobian, with one column for each free parameter.
    columns: Vec<Vec<f64>>,
    /// Priors of the parameters, expressed for the change of each parameter in a step.
    priors: Vec<Prior>,
}

impl Linear {
    fn at(model: &Model, all: &Instrument, used: &[usize]) -> Result<Option<Self>, CalibrateError> {
        let part = all.part(used);
        let problem = part.data_set(model, 1.0)?;
        let Some((residual, jacobian)) = stacked(&*problem, &model.start()) else { return Ok(None) };
        // The problem divides residuals by the relative noise. Multiply by it again, so that residuals are in metres.
        let divided_by = part.relative_noise();
        let over_file = |values: &mut dyn Iterator<Item = f64>| {
            let mut of_rows = vec![0.0; all.samples()];
            for ((&row, value), noise) in used.iter().zip(values).zip(&divided_by) {
                of_rows[row] = noise * value;
            }
            of_rows
        };
        let start = model.start();
        let of_step = |prior: Prior| Prior { value: prior.value - start[prior.column], ..prior };
        Ok(Some(Self {
            residuals: over_file(&mut residual.iter().copied()),
            relative_noise: all.relative_noise(),
            columns: jacobian.column_iter().map(|column| over_file(&mut column.iter().copied())).collect(),
            priors: model.priors().into_iter().map(of_step).collect(),
        }))
    }

    /// Creates the sweep for a drift. The weights of the rows are divided by the squared relative noise.
    fn sweep(&self, drift: &Drift, weights: &[f64]) -> Sweep {
        let by_noise = weights.iter().zip(&self.relative_noise).map(|(weight, noise)| weight / noise.powi(2));
        Sweep::new(drift, &by_noise.collect::<Vec<_>>())
    }

    /// Normal equations of generalised least squares, including the priors.
    fn normal(&self, sweep: &Sweep) -> Normal {
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let weighted: Vec<Vec<f64>> =
            self.columns.iter().map(|column| sweep.by_inverse_covariance(column)).collect();
        let weighted_residuals = sweep.by_inverse_covariance(&self.residuals);
        let size = self.columns.len();
        let mut normal = Normal {
            matrix: DMatrix::from_fn(size, size, |i, j| dot(&self.columns[i], &weighted[j])),
            gradient: DVector::from_fn(size, |i, _| dot(&self.columns[i], &weighted_residuals)),
            squared: dot(&self.residuals, &weighted_residuals),
            rows: self.residuals.len() as f64,
        };
        normal.add_priors(&self.priors, &vec![0.0; size]);
        normal
    }

    /// Computes one step of generalised least squares. `None` if the rows do not determine all parameters.
    fn step(&self, sweep: &Sweep) -> Option<DVector<f64>> {
        let normal = self.normal(sweep);
        Some(-ScaledCholesky::new(normal.matrix)?.solve(&normal.gradient))
    }

    /// Variances of the estimated parameters. `None` if the rows do not determine all of them.
    fn variances(&self, sweep: &Sweep) -> Option<DVector<f64>> {
        Some(ScaledCholesky::new(self.normal(sweep).matrix)?.inverse().diagonal())
    }

    /// Residuals after a step, predicted by the linearisation.
    fn after(&self, step: &DVector<f64>) -> Vec<f64> {
        let mut after = self.residuals.clone();
        for (column, by) in self.columns.iter().zip(step.iter()) {
            after.iter_mut().zip(column).for_each(|(r, j)| *r += j * by);
        }
        after
    }

    /// Mean squared error of each fold, predicted from the other folds \[m^2\]. Each error is
    /// divided by the relative noise of its row.
    fn left_out(&self, drift: &Drift, folds: &[Vec<usize>]) -> Option<Vec<f64>> {
        let of_fold = |fold: &Vec<usize>| {
            let mut weights = vec![0.0; self.residuals.len()];
            let others = folds.iter().filter(|other| *other != fold).flatten();
            others.for_each(|&row| weights[row] = 1.0);
            let sweep = self.sweep(drift, &weights);
            let after = self.after(&self.step(&sweep)?);
            let drift_m = sweep.drift(&after);
            let error = |&row: &usize| (after[row] - drift_m[row]) / self.relative_noise[row];
            let squared: f64 = fold.iter().map(|row| error(row).powi(2)).sum();
            Some(squared / fold.len() as f64)
        };
        folds.iter().map(of_fold).collect()
    }

    /// Chooses the drift that predicts left-out rows best. `None` if it is not significantly better than no drift. `sigma_m`
    /// is the standard deviation of a length in the fit without a drift.
    fn choose(&self, folds: &[Vec<usize>], sigma_m: f64) -> Option<Drift> {
        let without = self.left_out(&Drift::none(sigma_m), folds)?;
        let rms_without_m = mean(&without).sqrt();
        let tried = candidates(sigma_m).filter_map(|drift| {
            let with = self.left_out(&drift, folds)?;
            Some((Drift { rms_without_m, rms_with_m: mean(&with).sqrt(), ..drift }, with))
        });
        let best = tried.min_by(|a, b| a.0.rms_with_m.total_cmp(&b.0.rms_with_m));
        best.filter(|(_, with)| falls(&without, with)).map(|(best, _)| best)
    }

    /// Multiplies the size and the white noise of the drift by a common factor. The cross-validation cannot determine this
    /// factor, because predictions depend only on the ratio of size to white noise.
    ///
    /// Let `r` be the residuals of the fit to the rows `fitting`, and `C` their covariance according to the drift. If the
    /// factor is correct, the expected value of `r^T C^-1 r` is the number of rows minus the number of columns. The factor
    /// is chosen so that the two are equal.
    fn scaled(&self, drift: Drift, fitting: &[usize]) -> Drift {
        let mut weights = vec![0.0; self.residuals.len()];
        fitting.iter().for_each(|&row| weights[row] = 1.0);
        let sweep = self.sweep(&drift, &weights);
        let Some(step) = self.step(&sweep) else { return drift };
        let after = self.after(&step);
        let squared: f64 = after.iter().zip(sweep.by_inverse_covariance(&after)).map(|(r, by)| r * by).sum();
        let freedom = fitting.len().saturating_sub(self.columns.len()).max(1);
        let factor = (squared / freedom as f64).sqrt();
        let is_usable = factor.is_finite() && factor > 0.0;
        let scaled = Drift { size_m: factor * drift.size_m, white_m: factor * drift.white_m, ..drift };
        if is_usable { scaled } else { drift }
    }
}

/// Finds a drift that improves the prediction of left-out fitting rows. Returns the drift and its value at every row \[m\].
/// Rows that were not used also have a value, predicted from their neighbours.
///
/// Before the call, `model` must be at the fit without a drift. `sigma_m` is the standard deviation of a length in this fit.
/// If a drift is found, `model` is at the fit with this drift afterwards.
///
/// # Errors
/// [`CalibrateError::Cost`] if the rows lack data that the cost needs.
pub(super) fn find(
    model: &mut Model,
    all: &Instrument,
    fitting: &[usize],
    sigma_m: f64,
) -> Result<Option<(Drift, Vec<f64>)>, CalibrateError> {
    let Some(linear) = Linear::at(model, all, fitting)? else { return Ok(None) };
    let in_file = |fold: &Vec<usize>| fold.iter().filter_map(|&index| fitting.get(index).copied()).collect();
    let folds = all.part(fitting).independent(FOLDS);
    let folds: Vec<Vec<usize>> = folds.iter().filter(|fold| !fold.is_empty()).map(in_file).collect();
    let Some(chosen) = linear.choose(&folds, sigma_m) else { return Ok(None) };
    let drift = linear.scaled(chosen, fitting);
    let drift_m = fit(model, all, fitting, &drift)?;
    Ok(Some((drift, drift_m)))
}

/// Fits the model and the drift together. Returns the drift of every row \[m\].
pub(super) fn fit(
    model: &mut Model,
    all: &Instrument,
    fitting: &[usize],
    drift: &Drift,
) -> Result<Vec<f64>, CalibrateError> {
    let mut weights = vec![0.0; all.samples()];
    fitting.iter().for_each(|&row| weights[row] = 1.0);
    let mut drift_m = vec![0.0; all.samples()];
    for _ in 0..STEPS {
        let Some(linear) = Linear::at(model, all, fitting)? else { break };
        let sweep = linear.sweep(drift, &weights);
        let Some(step) = linear.step(&sweep) else { break };
        let after = linear.after(&step);
        drift_m = sweep.drift(&after);
        for &row in fitting {
            let white_m = drift.white_m * linear.relative_noise[row];
            weights[row] = HUBER.weight(((after[row] - drift_m[row]) / white_m).powi(2));
        }
        let x: Vec<f64> = model.start().iter().zip(step.iter()).map(|(x, by)| x + by).collect();
        model.adopt(&x);
    }
    Ok(drift_m)
}

/// Factor, at least 1, by which the standard deviations of the robot with this drift are larger than with white noise
/// `sigma_m` alone. They are larger because the drift absorbs some of the information and because errors of neighbouring
/// lengths are correlated. The factor is the root mean square over the columns of the robot.
pub(super) fn widens(
    model: &Model,
    all: &Instrument,
    fitting: &[usize],
    drift: &Drift,
    sigma_m: f64,
) -> Result<f64, CalibrateError> {
    let Some(linear) = Linear::at(model, all, fitting)? else { return Ok(1.0) };
    let mut weights = vec![0.0; all.samples()];
    fitting.iter().for_each(|&row| weights[row] = 1.0);
    let variances = |drift: &Drift| linear.variances(&linear.sweep(drift, &weights));
    let (Some(with), Some(without)) = (variances(drift), variances(&Drift::none(sigma_m))) else {
        return Ok(1.0);
    };
    let is_of_robot = model.columns().map(|parameter| matches!(parameter.id, ParameterId::Robot { .. }));
    let of_robot = is_of_robot.zip(with.iter().zip(&without)).filter(|(of_robot, _)| *of_robot);
    let ratios: Vec<f64> = of_robot.map(|(_, (with, without))| with / without).collect();
    Ok(mean(&ratios).sqrt().max(1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Compares the sweep with the formula `K (K + S)^-1 r` for dense matrices. One row is not used.
    #[test]
    fn the_sweep_is_the_best_prediction_of_the_random_walk() {
        let drift =
            Drift { size_m: 2.0, memory_rows: 3.0, white_m: 0.5, rms_without_m: 0.0, rms_with_m: 0.0 };
        let residuals = [0.3, -1.0, 0.0, 2.0, 1.5, -0.2];
        let counted = [0, 1, 3, 4, 5];
        let covariance = |i: usize, j: usize| 4.0 * (-(i.abs_diff(j) as f64) / drift.memory_rows).exp();
        let total = DMatrix::from_fn(5, 5, |i, j| {
            covariance(counted[i], counted[j]) + if i == j { 0.25 } else { 0.0 }
        });
        let r = DVector::from_fn(5, |i, _| residuals[counted[i]]);
        let weights = total.lu().solve(&r).unwrap_or_else(|| DVector::zeros(5));
        let found = Sweep::new(&drift, &[1.0, 1.0, 0.0, 1.0, 1.0, 1.0]).drift(&residuals);
        for (row, found) in found.iter().enumerate() {
            let expected: f64 = (0..5).map(|j| covariance(row, counted[j]) * weights[j]).sum();
            assert!((found - expected).abs() < 1e-12, "row {row}: {found} {expected}");
        }
    }
}
