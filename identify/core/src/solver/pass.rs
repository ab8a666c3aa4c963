//! One pass over all samples of a problem at `x`, with one or several threads. A pass computes residuals and Jacobians,
//! applies the weights of the robust loss, and reduces the rows by a [`Fold`], for example to normal equations. Every solve
//! and every analysis of a solution uses passes. A [`Fold`] has no relation to the folds of a cross-validation.
//!
//! Samples are divided into parts, which are ranges of consecutive samples. The size of a part depends only on the number of
//! samples. Each part is reduced separately, and the reduced parts are merged in order. The result is therefore independent
//! of the number of threads. A pass needs memory for a few dozen normal matrices and one small record for each sample.

use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};

use nalgebra::{DMatrix, DVector};

use super::panel::{RowPanel, fold_triangles, width};
use super::{LeastSquares, Linearisation, Normal, Options, Progress, SolveError};
use crate::threads::{on_threads, threads_there};

/// Smallest number of samples of a part, about a millisecond of work.
const PART_SAMPLES_MIN: usize = 128;
/// Highest number of parts, to bound the memory of partial sums.
const PARTS_MAX: usize = 64;
/// A pass uses one more thread for each multiple of this number of Jacobian entries. This number of entries takes about a
/// millisecond; the start of a thread takes some 50 us.
const ENTRIES_PER_THREAD: usize = 1 << 17;

/// Residual, loss and weight of one sample in a pass.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct SampleFit {
    /// Whether the sample has a value at this point. If not, the other fields are zero.
    pub(super) present: bool,
    /// Squared norm of the residual, unweighted.
    pub(super) squared: f64,
    /// Robust loss `rho` of the squared norm.
    pub(super) cost: f64,
    /// Weight of the sample under the robust loss.
    pub(super) weight: f64,
    /// Number of entries of the residual.
    pub(super) rows: usize,
}

/// Number of residual entries of the samples in use, each counted with its weight.
pub(super) fn weighed_rows(fits: &[SampleFit]) -> f64 {
    fits.iter().map(|fit| fit.weight * fit.rows as f64).sum()
}

/// Why a pass over the samples failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum PassError {
    /// A sample in use has no value at this point.
    Lost,
    /// A residual or derivative of the sample with this index is not finite.
    NotFinite(usize),
    /// Cancelled by the observer.
    Cancelled,
}

impl PassError {
    /// The error of a solve, if this error occurred in the first pass.
    pub(super) fn at_start(self, samples: usize) -> SolveError {
        match self {
            Self::NotFinite(sample) => SolveError::NotFinite { sample },
            Self::Lost => SolveError::NoSamples { samples },
            Self::Cancelled => SolveError::Cancelled { iterations: 0 },
        }
    }
}

/// Selects the samples of a pass.
#[derive(Debug, Clone, Copy)]
pub(super) enum Taking<'a> {
    /// All samples that have a value. The first pass uses this variant, and its samples are then the samples in use.
    WhatIsThere,
    /// Exactly the samples that are present in these fits.
    These(&'a [SampleFit]),
}

/// Accumulates the rows of a range of samples in a reduced form.
pub(super) trait Fold: Send {
    /// Adds the rows of a panel, and may overwrite the panel. The error contains the index of a sample with a number
    /// that is not finite.
    fn fold(&mut self, panel: &mut RowPanel) -> Result<(), PassError>;

    /// Adds `later`, the reduced form of the samples that follow.
    fn merge(&mut self, later: Self);
}

/// Discards the rows. Used if only the fits of the samples are needed.
impl Fold for () {
    fn fold(&mut self, panel: &mut RowPanel) -> Result<(), PassError> {
        require_finite(panel)
    }

    fn merge(&mut self, (): ()) {}
}

/// The matrix `[J r]^T [J r]`, as its lower triangle.
pub(super) struct Products {
    columns: usize,
    sums: Vec<f64>,
}

impl Products {
    pub(super) fn new(columns: usize) -> Self {
        Self { columns, sums: vec![0.0; width(columns).pow(2)] }
    }

    /// Normal equations of the rows. `rows` is the weighted number of rows.
    pub(super) fn normal(&self, rows: f64) -> Normal {
        let side = width(self.columns);
        let product = |i: usize, j: usize| self.sums[i.min(j) * side + i.max(j)];
        let residual = self.columns;
        Normal {
            matrix: DMatrix::from_fn(self.columns, self.columns, product),
            gradient: DVector::from_fn(self.columns, |i, _| product(i, residual)),
            squared: product(residual, residual),
            rows,
        }
    }
}

impl Fold for Products {
    fn fold(&mut self, panel: &mut RowPanel) -> Result<(), PassError> {
        panel.add_products(&mut self.sums);
        // The squared norm of a column is finite only if all entries of the column are finite.
        let side = width(self.columns);
        let mut squares = self.sums.iter().step_by(side + 1);
        if squares.all(|square| square.is_finite()) { Ok(()) } else { require_finite(panel) }
    }

    fn merge(&mut self, later: Self) {
        self.sums.iter_mut().zip(later.sums).for_each(|(sum, later)| *sum += later);
    }
}

/// The triangular factor `R` of `[J r] = Q R`.
pub(super) struct Triangle(DMatrix<f64>);

impl Triangle {
    pub(super) fn new(columns: usize) -> Self {
        Self(DMatrix::zeros(columns + 1, columns + 1))
    }

    /// The triangular factor of the Jacobian without the residual.
    pub(super) fn of_jacobian(&self) -> DMatrix<f64> {
        let columns = self.0.ncols() - 1;
        self.0.view((0, 0), (columns, columns)).into_owned()
    }
}

impl Fold for Triangle {
    fn fold(&mut self, panel: &mut RowPanel) -> Result<(), PassError> {
        require_finite(panel)?;
        panel.fold_into_triangle(self.0.as_mut_slice());
        Ok(())
    }

    fn merge(&mut self, later: Self) {
        fold_triangles(&later.0, &mut self.0);
    }
}

/// All rows, stacked without reduction.
#[derive(Default)]
pub(super) struct StackedRows {
    residual: Vec<f64>,
    gradients: Vec<f64>,
}

impl Fold for StackedRows {
    fn fold(&mut self, panel: &mut RowPanel) -> Result<(), PassError> {
        require_finite(panel)?;
        panel.append_to(&mut self.residual, &mut self.gradients);
        Ok(())
    }

    fn merge(&mut self, later: Self) {
        self.residual.extend(later.residual);
        self.gradients.extend(later.gradients);
    }
}

/// A pass, defined by problem, point, samples, and the options for loss, threads and observer.
pub(super) struct Pass<'a> {
    pub(super) problem: &'a dyn LeastSquares,
    pub(super) x: &'a [f64],
    options: &'a Options<'a>,
    taking: Taking<'a>,
    /// Progress for the observer. [`Pass::run`] fills in the number of completed samples.
    pub(super) progress: Progress,
}

impl<'a> Pass<'a> {
    /// Creates a pass that belongs to no iteration of a solve.
    pub(super) fn new(
        problem: &'a dyn LeastSquares,
        x: &'a [f64],
        options: &'a Options<'a>,
        taking: Taking<'a>,
    ) -> Self {
        let (iterations_max, samples) = (options.iterations_max, problem.samples());
        let progress = Progress { iteration: 0, iterations_max, cost: None, samples_done: 0, samples };
        Self { problem, x, options, taking, progress }
    }

    /// Reduces the rows of all samples. `new` creates an empty reduction for each part. Also returns the fit of each sample.
    pub(super) fn run<F: Fold>(&self, new: impl Fn() -> F + Sync) -> Result<(F, Vec<SampleFit>), PassError> {
        let samples = self.problem.samples();
        let part_samples = samples.div_ceil(PARTS_MAX).max(PART_SAMPLES_MIN);
        let parts = samples.div_ceil(part_samples);
        let samples_done = AtomicUsize::new(0);
        let threads = threads_for(self.problem, self.options).clamp(1, parts.max(1));
        let reduced_parts = on_threads(threads, parts, |part| {
            let range = part * part_samples..samples.min((part + 1) * part_samples);
            let result = self.reduce_part(range.clone(), new())?;
            self.report_progress(&samples_done, range.len())?;
            Ok(result)
        })?;
        let mut whole: Option<F> = None;
        let mut fits = Vec::with_capacity(samples);
        for (fold, part_fits) in reduced_parts {
            match &mut whole {
                Some(whole) => whole.merge(fold),
                None => whole = Some(fold),
            }
            fits.extend(part_fits);
        }
        Ok((whole.unwrap_or_else(new), fits))
    }

    /// Adds `samples` to the number of completed samples and reports the total to the observer.
    fn report_progress(&self, samples_done: &AtomicUsize, samples: usize) -> Result<(), PassError> {
        let Some(watch) = self.options.watch else { return Ok(()) };
        let samples_done = samples_done.fetch_add(samples, Ordering::Relaxed) + samples;
        let goes_on = watch.goes_on(&Progress { samples_done, ..self.progress });
        if goes_on { Ok(()) } else { Err(PassError::Cancelled) }
    }

    /// Reduces the samples of one part, in order.
    fn reduce_part<F: Fold>(
        &self,
        samples: Range<usize>,
        mut fold: F,
    ) -> Result<(F, Vec<SampleFit>), PassError> {
        let mut linearisation = self.problem.at(self.x);
        let mut panel = RowPanel::new(self.problem.columns(), self.problem.rows());
        let mut fits = Vec::with_capacity(samples.len());
        for sample in samples {
            if !panel.has_room(self.problem.rows_of(sample)) {
                fold.fold(&mut panel)?;
                panel.clear();
            }
            fits.push(self.add_sample(&mut linearisation, sample, &mut panel)?);
        }
        if !panel.is_empty() {
            fold.fold(&mut panel)?;
        }
        Ok((fold, fits))
    }

    /// Adds the weighted rows of a sample to the panel.
    fn add_sample(
        &self,
        linearisation: &mut Linearisation<'_>,
        sample: usize,
        panel: &mut RowPanel,
    ) -> Result<SampleFit, PassError> {
        if let Taking::These(fits) = self.taking
            && !fits.get(sample).is_some_and(|fit| fit.present)
        {
            return Ok(SampleFit::default());
        }
        let rows = self.problem.rows_of(sample);
        let (residual, mut block) = panel.next(rows);
        if !linearisation(sample, residual, &mut block) {
            residual.fill(0.0);
            block.clear();
            return match self.taking {
                Taking::WhatIsThere => Ok(SampleFit::default()),
                Taking::These(_) => Err(PassError::Lost),
            };
        }
        let squared: f64 = residual.iter().map(|r| r * r).sum();
        if !squared.is_finite() {
            return Err(PassError::NotFinite(sample));
        }
        let Options { loss, .. } = *self.options;
        let loss = if rows == self.problem.rows() { loss } else { loss.of_rows(rows, self.problem.rows()) };
        let weight = loss.weight(squared);
        if weight != 1.0 {
            let factor = weight.sqrt();
            residual.iter_mut().for_each(|r| *r *= factor);
            block.scale(factor);
        }
        panel.keep(sample, rows);
        Ok(SampleFit { present: true, squared, cost: loss.rho(squared), weight, rows })
    }
}

fn require_finite(panel: &RowPanel) -> Result<(), PassError> {
    panel.not_finite().map_or(Ok(()), |sample| Err(PassError::NotFinite(sample)))
}

/// Number of threads for a pass over all samples of a problem. Without a number in the options, it follows from the
/// number of Jacobian entries.
pub(super) fn threads_for(problem: &dyn LeastSquares, options: &Options<'_>) -> usize {
    let efficient = || {
        let threads = problem.samples() * problem.rows() * problem.columns() / ENTRIES_PER_THREAD;
        if threads > 1 { threads_there().min(threads) } else { 1 }
    };
    options.threads.map_or_else(efficient, usize::from)
}

/// Runs a pass over all samples with a value, without loss and observer.
fn run_unweighted<F: Fold>(
    problem: &dyn LeastSquares,
    x: &[f64],
    new: impl Fn() -> F + Sync,
) -> Result<(F, Vec<SampleFit>), PassError> {
    Pass::new(problem, x, &Options::default(), Taking::WhatIsThere).run(new)
}

/// Fit of each sample at `x`, without loss. Empty if a residual or derivative is not finite.
pub(super) fn fits(problem: &dyn LeastSquares, x: &[f64]) -> Vec<SampleFit> {
    run_unweighted(problem, x, || ()).map(|((), fits)| fits).unwrap_or_default()
}

/// Residuals and Jacobian of all samples that have a value at `x`, stacked, without loss and priors. For inspection and for
/// other solvers. `None` if a residual or derivative is not finite.
pub fn stacked(problem: &dyn LeastSquares, x: &[f64]) -> Option<(DVector<f64>, DMatrix<f64>)> {
    let (rows, _) = run_unweighted(problem, x, StackedRows::default).ok()?;
    let count = rows.residual.len();
    Some((
        DVector::from_vec(rows.residual),
        DMatrix::from_row_slice(count, problem.columns(), &rows.gradients),
    ))
}
