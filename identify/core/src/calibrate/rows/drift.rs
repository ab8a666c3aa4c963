//! A zero of the instrument that wanders along the file.
//!
//! A wire that is wound anew, slips or warms up measures with another zero from then on: rows next to each other are off
//! together. The drift is a stationary random walk (Ornstein and Uhlenbeck 1930) over the number of the row, with a size
//! and a length of memory; residuals are `r = f - l = g + e` with `g` drift and `e` white. Its covariance has a
//! tridiagonal inverse, so that the best drift for given residuals costs one sweep, and the least squares of the robot
//! with the drift taken out (generalised least squares) little more than without.
//!
//! Whether there is a drift, its size and its memory are decided by fitting rows left out in turn.

use nalgebra::{DMatrix, DVector};

use crate::calibrate::CalibrateError;
use crate::calibrate::selection::terms::{falls, mean};
use crate::cost::{DataSets, SharedColumns};
use crate::instrument::Instrument;
use crate::model::{Model, ParameterId};
use crate::solver::{Loss, Normal, Prior, ScaledCholesky, stacked};

/// Size and memory of a drift.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Drift {
    /// Standard deviation of the zero \[m\].
    pub size_m: f64,
    /// Rows after which it has forgotten two thirds.
    pub memory_rows: f64,
    /// Standard deviation of a single length beside it, of rows that state theirs that of the median one \[m\].
    pub white_m: f64,
    /// Root mean square of fitting rows left out in turn, without a drift \[m\].
    pub rms_without_m: f64,
    /// And with it \[m\].
    pub rms_with_m: f64,
}

/// Parts of the fitting rows that are left out in turn.
const FOLDS: usize = 8;
/// So small, in standard deviations of a length, that it is none.
const NONE: f64 = 1e-6;
/// Steps of the generalised least squares; the third changes nothing that is printed.
const STEPS: usize = 8;
/// Beyond this many standard deviations a row pulls no harder.
const HUBER: Loss = Loss::Huber { scale: 3.0 };

/// Sizes and memories to choose from: standard deviations in those of a length as it fits without a drift.
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
                rms_without_m: 0.0,
                rms_with_m: 0.0,
            })
        })
    })
}

/// Solves for the drift of all rows: `(K^-1 + W / s^2) g = W r / s^2`, factored once (Thomas 1949).
struct Sweep {
    /// `W / s^2` of each row, zero for rows that do not count.
    weights: Vec<f64>,
    off_diagonal: f64,
    pivots: Vec<f64>,
}

impl Sweep {
    fn new(drift: &Drift, weights: &[f64]) -> Self {
        let memory = (-drift.memory_rows.recip()).exp();
        let scale = (drift.size_m.powi(2) * (1.0 - memory * memory)).recip();
        let weights: Vec<f64> = weights.iter().map(|w| w / drift.white_m.powi(2)).collect();
        let off_diagonal = -memory * scale;
        let last = weights.len().saturating_sub(1);
        let mut pivots: Vec<f64> = Vec::with_capacity(weights.len());
        for (row, weight) in weights.iter().enumerate() {
            let inner = if row == 0 || row == last { scale } else { scale * (1.0 + memory * memory) };
            let before = pivots.last().map_or(0.0, |pivot| off_diagonal * off_diagonal / pivot);
            pivots.push(inner + weight - before);
        }
        Self { weights, off_diagonal, pivots }
    }

    /// The drift behind residuals of all rows \[m\].
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

    /// What is left of residuals without the drift, over the white variance: the inverse covariance times them.
    fn whitened(&self, residuals: &[f64]) -> Vec<f64> {
        let drift = self.drift(residuals);
        residuals.iter().zip(drift).zip(&self.weights).map(|((r, g), w)| w * (r - g)).collect()
    }
}

/// Residuals and Jacobian of the rows that take part \[m\], spread over all rows of the file.
struct Linear {
    residuals: Vec<f64>,
    /// Noise of each row over that of the median one.
    relative_noise: Vec<f64>,
    /// A column for each free parameter.
    columns: Vec<Vec<f64>>,
    /// On the step.
    priors: Vec<Prior>,
}

impl Linear {
    fn at(model: &Model, all: &Instrument, chosen: &[usize]) -> Result<Option<Self>, CalibrateError> {
        let (part, own) = (all.part(chosen), SharedColumns::new([model], |_| false));
        let problem = DataSets::new(vec![part.data_set(model, 1.0)?], &own);
        let Some((residual, jacobian)) = stacked(&problem, &model.start()) else { return Ok(None) };
        let weighed_by = part.relative_noise();
        let spread = |values: &mut dyn Iterator<Item = f64>| {
            let mut of_file = vec![0.0; all.samples()];
            for ((&row, value), noise) in chosen.iter().zip(values).zip(&weighed_by) {
                of_file[row] = noise * value;
            }
            of_file
        };
        let start = model.start();
        let of_step = |prior: Prior| Prior { value: prior.value - start[prior.column], ..prior };
        Ok(Some(Self {
            residuals: spread(&mut residual.iter().copied()),
            relative_noise: all.relative_noise(),
            columns: jacobian.column_iter().map(|column| spread(&mut column.iter().copied())).collect(),
            priors: model.priors().into_iter().map(of_step).collect(),
        }))
    }

    /// The sweep over rows that count by their noise, times these weights.
    fn sweep(&self, drift: &Drift, weights: &[f64]) -> Sweep {
        let by_noise = weights.iter().zip(&self.relative_noise).map(|(weight, noise)| weight / noise.powi(2));
        Sweep::new(drift, &by_noise.collect::<Vec<_>>())
    }

    /// Normal equations of generalised least squares, with the priors.
    fn normal(&self, sweep: &Sweep) -> Normal {
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let whitened: Vec<Vec<f64>> = self.columns.iter().map(|column| sweep.whitened(column)).collect();
        let residual = sweep.whitened(&self.residuals);
        let size = self.columns.len();
        let mut normal = Normal {
            matrix: DMatrix::from_fn(size, size, |i, j| dot(&self.columns[i], &whitened[j])),
            gradient: DVector::from_fn(size, |i, _| dot(&self.columns[i], &residual)),
            squared: dot(&self.residuals, &residual),
            rows: self.residuals.len() as f64,
        };
        normal.add_priors(&self.priors, &vec![0.0; size]);
        normal
    }

    /// The step of generalised least squares.
    fn step(&self, sweep: &Sweep) -> Option<DVector<f64>> {
        let normal = self.normal(sweep);
        Some(-ScaledCholesky::new(normal.matrix)?.solve(&normal.gradient))
    }

    /// Variances of the columns; none where they are not determined.
    fn variances(&self, sweep: &Sweep) -> Option<DVector<f64>> {
        Some(ScaledCholesky::new(self.normal(sweep).matrix)?.inverse().diagonal())
    }

    /// Residuals after a step.
    fn after(&self, step: &DVector<f64>) -> Vec<f64> {
        let mut after = self.residuals.clone();
        for (column, by) in self.columns.iter().zip(step.iter()) {
            after.iter_mut().zip(column).for_each(|(r, j)| *r += j * by);
        }
        after
    }

    /// Mean squared error of each fold, left out in turn, in the noise of the median row \[m^2\].
    fn left_out(&self, drift: &Drift, folds: &[Vec<usize>]) -> Option<Vec<f64>> {
        let error = |fold: &Vec<usize>| {
            let mut weights = vec![0.0; self.residuals.len()];
            let others = folds.iter().filter(|other| *other != fold).flatten();
            others.for_each(|&row| weights[row] = 1.0);
            let sweep = self.sweep(drift, &weights);
            let after = self.after(&self.step(&sweep)?);
            let known = sweep.drift(&after);
            let error = |&row: &usize| (after[row] - known[row]) / self.relative_noise[row];
            let squared: f64 = fold.iter().map(|row| error(row).powi(2)).sum();
            Some(squared / fold.len() as f64)
        };
        folds.iter().map(error).collect()
    }
}

/// Takes a drift where left-out fitting rows ask for it, with that of every row \[m\], also of rows that did not take part:
/// there it is what their neighbours say. The model, which stands at its fit without one, is then at that with it.
///
/// # Errors
/// [`CalibrateError::Cost`].
pub(super) fn find(
    model: &mut Model,
    all: &Instrument,
    fitting: &[usize],
    sigma_m: f64,
) -> Result<Option<(Drift, Vec<f64>)>, CalibrateError> {
    let folds = all.part(fitting).independent(FOLDS);
    let Some(drift) = choose(model, all, fitting, &folds, sigma_m)? else { return Ok(None) };
    let drift_m = fit(model, all, fitting, &drift)?;
    Ok(Some((drift, drift_m)))
}

/// The drift that predicts left-out fitting rows best, none where it is not clearly better than none. The model stands at
/// its fit without drift; `folds` are places among the fitting rows.
fn choose(
    model: &Model,
    all: &Instrument,
    fitting: &[usize],
    folds: &[Vec<usize>],
    sigma_m: f64,
) -> Result<Option<Drift>, CalibrateError> {
    let Some(linear) = Linear::at(model, all, fitting)? else { return Ok(None) };
    let of_fold = |fold: &Vec<usize>| fold.iter().filter_map(|&place| fitting.get(place).copied()).collect();
    let folds: Vec<Vec<usize>> = folds.iter().filter(|fold| !fold.is_empty()).map(of_fold).collect();
    let none = Drift {
        size_m: NONE * sigma_m,
        memory_rows: 1.0,
        white_m: sigma_m,
        rms_without_m: 0.0,
        rms_with_m: 0.0,
    };
    let Some(without) = linear.left_out(&none, &folds) else { return Ok(None) };
    let rms_without_m = mean(&without).sqrt();
    let judged = candidates(sigma_m).filter_map(|drift| {
        let with = linear.left_out(&drift, &folds)?;
        Some((Drift { rms_without_m, rms_with_m: mean(&with).sqrt(), ..drift }, with))
    });
    let best = judged.min_by(|a, b| a.0.rms_with_m.total_cmp(&b.0.rms_with_m));
    Ok(best.filter(|(_, with)| falls(&without, with)).map(|(best, _)| best))
}

/// Fits the model with the drift taken out of its residuals; the drift of every row \[m\].
pub(super) fn fit(
    model: &mut Model,
    all: &Instrument,
    fitting: &[usize],
    drift: &Drift,
) -> Result<Vec<f64>, CalibrateError> {
    let mut weights = vec![0.0; all.samples()];
    fitting.iter().for_each(|&row| weights[row] = 1.0);
    let mut known = vec![0.0; all.samples()];
    for _ in 0..STEPS {
        let Some(linear) = Linear::at(model, all, fitting)? else { break };
        let sweep = linear.sweep(drift, &weights);
        let Some(step) = linear.step(&sweep) else { break };
        let after = linear.after(&step);
        known = sweep.drift(&after);
        for &row in fitting {
            let white_m = drift.white_m * linear.relative_noise[row];
            weights[row] = HUBER.weight(((after[row] - known[row]) / white_m).powi(2));
        }
        let x: Vec<f64> = model.start().iter().zip(step.iter()).map(|(x, by)| x + by).collect();
        model.adopt(&x);
    }
    Ok(known)
}

/// How many times less certain the robot is than where the drift were known and what is left of the lengths, `sigma_m`, the
/// only error: the drift takes what it can of both, and lengths next to each other tell less than others.
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
    let known = Drift { size_m: NONE * sigma_m, memory_rows: 1.0, white_m: sigma_m, ..*drift };
    let variances = |drift: &Drift| linear.variances(&linear.sweep(drift, &weights));
    let (Some(with), Some(without)) = (variances(drift), variances(&known)) else { return Ok(1.0) };
    let robot = model.columns().map(|parameter| matches!(parameter.id, ParameterId::Robot { .. }));
    let ratios = robot.zip(with.iter().zip(&without)).filter(|(of_robot, _)| *of_robot);
    let ratios: Vec<f64> = ratios.map(|(_, (with, without))| with / without).collect();
    Ok(mean(&ratios).sqrt().max(1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The sweep against the dense formula `K (K + S)^-1 r`, with a row that does not count.
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
