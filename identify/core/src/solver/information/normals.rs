//! Normal equations of folds, linearised at a point `x`. A fold is a set of samples, usually a segment of a run, that can be
//! left out of a solution as a whole. Errors of gears and encoders are correlated over seconds. Folds of several seconds are
//! therefore nearly independent, while single samples are not.
//!
//! Because `|r + J dx|^2 = r^T r + 2 (J^T r) dx + dx (J^T J) dx`, a fold is described by three sums: `r^T r`, `J^T r` and
//! `J^T J`. One pass over the samples computes the sums of each fold, with the columns of all candidate terms. The following
//! computations then need only small matrices and no further pass: steps, covariances, the jackknife, the selection of
//! terms, scales of priors, and predictions of held-out folds. `calibrate` uses all of them.

use std::num::NonZeroUsize;
use std::ops::{Add, AddAssign, Sub};

use nalgebra::{DMatrix, DVector, SymmetricEigen};
use statrs::distribution::{ContinuousCDF, FisherSnedecor};

use super::covariance::{Spread, UncertaintySource};
use crate::solver::pass::{Pass, PassError, Products, Taking, threads_for, weighed_rows};
use crate::solver::{LeastSquares, Options, Prior, ScaledCholesky, SolveError, Subset};
use crate::threads::on_threads;

/// Normal equations of some samples, linearised at a point.
#[derive(Debug, Clone, PartialEq)]
pub struct Normal {
    /// `J^T W J`
    pub matrix: DMatrix<f64>,
    /// `J^T W r`
    pub gradient: DVector<f64>,
    /// `r^T W r`
    pub squared: f64,
    /// Number of residual entries, each counted with its weight.
    pub rows: f64,
}

impl Normal {
    /// Normal equations without rows.
    pub fn zeros(columns: usize) -> Self {
        Self {
            matrix: DMatrix::zeros(columns, columns),
            gradient: DVector::zeros(columns),
            squared: 0.0,
            rows: 0.0,
        }
    }

    /// Predicted sum of squares after a step.
    pub fn after(&self, step: &DVector<f64>) -> f64 {
        self.squared + 2.0 * self.gradient.dot(step) + step.dot(&(&self.matrix * step))
    }

    /// Normal equations of the same rows at a point that differs by `step`.
    #[must_use]
    fn moved(&self, step: &DVector<f64>) -> Self {
        Self { gradient: &self.gradient + &self.matrix * step, squared: self.after(step), ..self.clone() }
    }

    /// Normal equations of the same rows for a selection of the columns, in this order.
    fn only(&self, columns: &[usize]) -> Self {
        let count = columns.len();
        Self {
            matrix: DMatrix::from_fn(count, count, |i, j| self.matrix[(columns[i], columns[j])]),
            gradient: self.gradient.select_rows(columns),
            ..*self
        }
    }

    /// Adds the priors of some columns, for the parameter values `x`. Returns the sum of the priors' squared residuals,
    /// which is not added to `squared`.
    pub fn add_priors(&mut self, priors: &[Prior], x: &[f64]) -> f64 {
        let mut squared = 0.0;
        for prior in priors {
            let (column, weight) = (prior.column, prior.sigma.powi(-2));
            let error = x[column] - prior.value;
            self.matrix[(column, column)] += weight;
            self.gradient[column] += weight * error;
            squared += weight * error * error;
        }
        squared
    }
}

impl AddAssign<&Self> for Normal {
    fn add_assign(&mut self, other: &Self) {
        self.matrix += &other.matrix;
        self.gradient += &other.gradient;
        self.squared += other.squared;
        self.rows += other.rows;
    }
}

impl Add for &Normal {
    type Output = Normal;

    fn add(self, other: Self) -> Normal {
        let mut sum = self.clone();
        sum += other;
        sum
    }
}

impl Sub for &Normal {
    type Output = Normal;

    fn sub(self, other: Self) -> Normal {
        Normal {
            matrix: &self.matrix - &other.matrix,
            gradient: &self.gradient - &other.gradient,
            squared: self.squared - other.squared,
            rows: self.rows - other.rows,
        }
    }
}

/// Normal equations of every fold at one point, with prior knowledge of the columns.
#[derive(Debug, Clone)]
pub struct Normals {
    folds: Vec<Normal>,
    /// Sum of all folds.
    total: Normal,
    /// Normal equations of the samples of prior knowledge ([`LeastSquares::is_known`]), which belong to no fold.
    known: Normal,
    priors: Vec<Prior>,
    /// Point of the linearisation.
    x: Vec<f64>,
}

impl Normals {
    /// Computes the normal equations in one pass over the samples of all folds at `x`, with the weights of the
    /// options' loss. Samples without a value are left out.
    ///
    /// # Errors
    /// [`SolveError`] if a residual or derivative is not finite, or the pass was cancelled.
    pub fn new(
        problem: &dyn LeastSquares,
        x: &[f64],
        options: &Options<'_>,
        folds: &[Vec<usize>],
    ) -> Result<Self, SolveError> {
        let is_measured = |sample: &usize| !problem.is_known(*sample);
        let measured = |fold: &Vec<usize>| fold.iter().copied().filter(is_measured).collect();
        let mut sets: Vec<Vec<usize>> = folds.iter().map(measured).collect();
        // The samples of prior knowledge form an additional set after the folds.
        sets.push((0..problem.samples()).filter(|sample| problem.is_known(*sample)).collect());
        // Each set is summed by one thread; different sets are summed in parallel.
        let one_thread = Options { threads: Some(NonZeroUsize::MIN), ..*options };
        let sum = |set: usize| {
            let subset = Subset { of: problem, samples: sets[set].clone() };
            let pass = Pass::new(&subset, x, &one_thread, Taking::WhatIsThere);
            let (products, fits) =
                pass.run(|| Products::new(problem.columns())).map_err(|error| match error {
                    PassError::NotFinite(place) => PassError::NotFinite(sets[set][place]),
                    other => other,
                })?;
            Ok(products.normal(weighed_rows(&fits)))
        };
        let mut folds = on_threads(threads_for(problem, options).min(sets.len()), sets.len(), sum)
            .map_err(|error: PassError| error.at_start(problem.samples()))?;
        let known = folds.pop().unwrap_or_else(|| Normal::zeros(problem.columns()));
        let mut total = Normal::zeros(problem.columns());
        folds.iter().for_each(|fold| total += fold);
        Ok(Self { folds, total, known, priors: problem.priors().to_vec(), x: x.to_vec() })
    }

    /// Priors of the columns.
    pub fn priors(&self) -> &[Prior] {
        &self.priors
    }

    /// Replaces the priors; the samples stay unchanged.
    #[must_use]
    pub fn with_priors(self, priors: Vec<Prior>) -> Self {
        Self { priors, ..self }
    }

    /// Normal equations of each fold, without priors.
    pub fn of_folds(&self) -> &[Normal] {
        &self.folds
    }

    /// Normal equations of all data: the sum of all folds, the samples of prior knowledge, and the priors.
    pub fn whole(&self) -> Normal {
        let mut whole = &self.total + &self.known;
        whole.add_priors(&self.priors, &self.x);
        whole
    }

    /// Overdispersion: the variance of the folds' gradients `g_k`, divided by their variance for independent noise of
    /// variance one. It is averaged over all directions: `n / (n - 1) sum g_k^T H^-1 g_k / tr(H^-1 N)` for `n` folds. `H` is
    /// the normal matrix of all data and priors, `N` that of all folds. If errors are not correlated within a fold, the
    /// result is 1 (design effect, Kish 1965). `None` for fewer than two folds, or if the result is not finite.
    pub fn overdispersion(&self) -> Option<f64> {
        let (matrix, count) = (self.whole().matrix, self.folds() as f64);
        if count < 2.0 {
            return None;
        }
        let factor = factor_with_ridge(matrix)?;
        let scatter: f64 =
            self.folds.iter().map(|fold| fold.gradient.dot(&factor.solve(&fold.gradient))).sum();
        let expected = factor.inverse().dot(&self.total.matrix);
        Some(scatter * count / ((count - 1.0) * expected)).filter(|ratio| ratio.is_finite())
    }

    /// Logarithm of the evidence of the samples with these priors, up to a constant (MacKay 1992). `dispersion` is the
    /// assumed variance of the residuals, relative to independent noise. `None` if columns are linearly dependent.
    pub fn evidence(&self, priors: &[Prior], dispersion: f64) -> Option<f64> {
        let mut posterior = &self.total + &self.known;
        posterior.matrix /= dispersion;
        posterior.gradient /= dispersion;
        posterior.squared /= dispersion;
        posterior.squared += posterior.add_priors(priors, &self.x);
        let factor = ScaledCholesky::new(posterior.matrix.clone())?;
        let step = -factor.solve(&posterior.gradient);
        let log_sigmas: f64 = priors.iter().map(|prior| prior.sigma.ln()).sum();
        Some(-0.5 * (posterior.after(&step) + factor.log_determinant()) - log_sigmas)
    }

    /// Gradients of the folds at the solution for the columns `kept`. They serve to test whether further columns are needed.
    /// `None` if the columns `kept` are linearly dependent.
    pub fn scores(&self, kept: &[usize], priors: &[Prior]) -> Option<Scores> {
        let priors = priors_among(priors, kept);
        let x: Vec<f64> = kept.iter().map(|&column| self.x[column]).collect();
        let samples = &self.total + &self.known;
        let mut of_kept = samples.only(kept);
        of_kept.add_priors(&priors, &x);
        let factor = ScaledCholesky::new(of_kept.matrix).filter(ScaledCholesky::is_complete)?;
        let mut step = DVector::zeros(self.x.len());
        for (column, newton) in kept.iter().zip(&factor.solve(&of_kept.gradient)) {
            step[*column] = -newton;
        }
        let folds = self.folds.iter().filter(|fold| fold.rows > 0.0);
        let gradients = folds.map(|fold| &fold.gradient + &fold.matrix * &step).collect();
        Some(Scores { gradients, matrix: samples.matrix, kept: kept.to_vec(), factor })
    }

    /// Effective number of parameters that each fold determines: `tr(H^-1 N)`, with the normal matrix `H` of all data and
    /// `N` of the fold. If priors or other folds contribute to the same parameters, it is less than the number of parameters
    /// that the fold alone can determine (MacKay 1992). `None` if columns are linearly dependent.
    pub fn taken(&self) -> Option<Vec<f64>> {
        let inverse = self.covariance()?;
        Some(self.folds.iter().map(|fold| inverse.dot(&fold.matrix)).collect())
    }

    /// Number of folds with samples.
    pub fn folds(&self) -> usize {
        self.folds.iter().filter(|fold| fold.rows > 0.0).count()
    }

    /// Normal equations of the same samples at another point. They are exact if the residuals are linear
    /// between the two points, which holds for small terms.
    #[must_use]
    pub fn about(&self, x: &[f64]) -> Self {
        let step = DVector::from_column_slice(x) - DVector::from_column_slice(&self.x);
        Self {
            folds: self.folds.iter().map(|fold| fold.moved(&step)).collect(),
            total: self.total.moved(&step),
            known: self.known.moved(&step),
            priors: self.priors.clone(),
            x: x.to_vec(),
        }
    }

    /// For each fold, the mean squared residual that a solution without this fold predicts. The solution estimates `columns`
    /// and leaves other columns unchanged, also in directions that the other folds do not determine.
    pub fn held_out(&self, columns: &[usize], priors: &[Prior]) -> Option<Vec<f64>> {
        let (total, known) = (self.total.only(columns), self.known.only(columns));
        self.predicted(|fold| self.error_without(fold, columns, priors, [&total, &known]))
    }

    /// As [`Self::held_out`], but the estimated columns can differ between folds: `columns` returns them for the
    /// index of a fold.
    pub fn held_out_each(&self, columns: impl Fn(usize) -> Vec<usize>, priors: &[Prior]) -> Option<Vec<f64>> {
        self.predicted(|fold| {
            let columns = columns(fold);
            let (total, known) = (self.total.only(&columns), self.known.only(&columns));
            self.error_without(fold, &columns, priors, [&total, &known])
        })
    }

    /// Mean squared residual that the solution for `columns` without the fold of this number predicts for it. `total` and
    /// `known` have only these columns.
    fn error_without(
        &self,
        number: usize,
        columns: &[usize],
        priors: &[Prior],
        [total, known]: [&Normal; 2],
    ) -> Option<f64> {
        let x: Vec<f64> = columns.iter().map(|&column| self.x[column]).collect();
        let fold = self.folds[number].only(columns);
        let mut others = total - &fold;
        others += known;
        others.add_priors(&priors_among(priors, columns), &x);
        let step = -factor_with_ridge(others.matrix)?.solve(&others.gradient);
        Some(fold.after(&step) / fold.rows)
    }

    /// The errors of all folds with samples. `error` returns that of the fold of a number.
    fn predicted(&self, error: impl Fn(usize) -> Option<f64>) -> Option<Vec<f64>> {
        let has_samples = |number: &usize| self.folds[*number].rows > 0.0;
        (0..self.folds.len()).filter(has_samples).map(error).collect()
    }

    /// The matrix of [`Self::whole`] and its factor. `None` if columns are linearly dependent.
    fn factored(&self) -> Option<(DMatrix<f64>, ScaledCholesky)> {
        let matrix = self.whole().matrix;
        let factor = ScaledCholesky::new(matrix.clone()).filter(ScaledCholesky::is_complete)?;
        Some((matrix, factor))
    }

    /// Covariance of the solution `x` for independent noise of variance one on every residual entry. `None` if the
    /// samples and priors do not determine every column.
    pub fn covariance(&self) -> Option<DMatrix<f64>> {
        Some(self.factored()?.1.inverse())
    }

    /// Step from `x` to the solution of the linearised problem. `None` if the samples and priors do not determine every column.
    pub fn step(&self) -> Option<DVector<f64>> {
        Some(-self.factored()?.1.solve(&self.whole().gradient))
    }

    /// Solutions without each fold in turn, linearised at `x`. `None` for a fold if the other folds and the priors do
    /// not determine every column.
    pub fn without_each(&self) -> Vec<Option<Vec<f64>>> {
        let whole = self.whole();
        let without = |fold: &Normal| {
            let others = &whole - fold;
            let factor = ScaledCholesky::new(others.matrix).filter(ScaledCholesky::is_complete)?;
            let step = factor.solve(&others.gradient);
            Some(self.x.iter().zip(&step).map(|(x, step)| x - step).collect())
        };
        self.folds.iter().map(without).collect()
    }

    /// Spread of the solution `x` by the jackknife over folds, which uses the change of the solution when one fold is left
    /// out. Errors may be correlated within a fold, but different folds must be independent. The contributions of the priors
    /// are added. `data_set` returns the data set of a fold.
    ///
    /// The covariance of this spread is approximately `H^-1 (sum g g') H^-1`, with the normal matrix `H` and the gradient
    /// `g` of a fold (a sandwich, Liang and Zeger 1986). It is corrected for the influence of each fold on the solution
    /// (Bell and McCaffrey 2002, CR3). `None` for fewer than two folds, or if the other folds do not determine every column.
    pub fn jackknife(&self, data_set: impl Fn(usize) -> usize) -> Option<Spread> {
        let count = self.folds() as f64;
        if count < 2.0 {
            return None;
        }
        let (whole, factor) = self.factored()?;
        let mut contributions = Vec::new();
        for (number, fold) in self.folds.iter().enumerate().filter(|(_, fold)| fold.rows > 0.0) {
            let others = ScaledCholesky::new(&whole - &fold.matrix).filter(ScaledCholesky::is_complete)?;
            // At the solution, all gradients add up to zero. The gradient of the other folds is therefore the negative
            // gradient of this fold.
            let change = others.solve(&fold.gradient) * ((count - 1.0) / count).sqrt();
            contributions.push((UncertaintySource::Samples { data_set: data_set(number) }, change));
        }
        // The priors with their weights `P` contribute the covariance `H^-1 P H^-1`. For ordinary priors `P` is
        // diagonal, and each prior is a source. For samples of prior knowledge `P` is not diagonal, so the eigenvectors
        // of `P` are the sources.
        let inverse = factor.inverse();
        for &Prior { column, sigma, .. } in &self.priors {
            contributions.push((UncertaintySource::Prior { column }, inverse.column(column) / sigma));
        }
        let known = SymmetricEigen::new(self.known.matrix.clone());
        let weighted = known.eigenvectors.column_iter().zip(&known.eigenvalues);
        for (direction, weight) in weighted.filter(|(_, weight)| **weight > 0.0) {
            contributions.push((UncertaintySource::Known, &inverse * direction * weight.sqrt()));
        }
        Some(Spread::new(self.x.len(), &contributions))
    }
}

/// Gradients of folds at the solution for some columns.
pub struct Scores {
    /// Gradient of each fold, for all columns.
    gradients: Vec<DVector<f64>>,
    /// Normal matrix of all samples, for all columns.
    matrix: DMatrix<f64>,
    /// Columns of the solution, `kept` in [`Normals::scores`].
    kept: Vec<usize>,
    /// Factor of the normal matrix of the kept columns, with priors.
    factor: ScaledCholesky,
}

impl Scores {
    /// Tests whether the parameters of the columns `tried` are zero. Returns the probability of gradients at least this
    /// large if they are. This is Rao's score test. Because errors within a fold are correlated, the variance of the
    /// gradients is estimated from the scatter of the folds (Hotelling's T squared). `None` if there are too few folds.
    pub fn chance(&self, tried: &[usize]) -> Option<f64> {
        let (count, size) = (self.gradients.len(), tried.len());
        let fisher = FisherSnedecor::new(size as f64, count.checked_sub(size)? as f64).ok()?;
        // For each tried column, the coefficients of the kept columns that explain it. With these coefficients, the
        // explained component is removed from the gradients.
        let coefficients: Vec<DVector<f64>> = tried
            .iter()
            .map(|&column| {
                let products = self.kept.iter().map(|&row| self.matrix[(row, column)]);
                self.factor.solve(&DVector::from_iterator(self.kept.len(), products))
            })
            .collect();
        let score = |gradient: &DVector<f64>| {
            let kept = gradient.select_rows(&self.kept);
            let remaining =
                tried.iter().zip(&coefficients).map(|(&column, by)| gradient[column] - by.dot(&kept));
            DVector::from_iterator(size, remaining)
        };
        let scores: Vec<DVector<f64>> = self.gradients.iter().map(score).collect();
        let mean = scores.iter().sum::<DVector<f64>>() / count as f64;
        let scatter: DMatrix<f64> =
            scores.iter().map(|score| (score - &mean) * (score - &mean).transpose()).sum();
        let covariance =
            ScaledCholesky::new(scatter / (count as f64 - 1.0)).filter(ScaledCholesky::is_complete)?;
        let t_squared = count as f64 * mean.dot(&covariance.solve(&mean));
        let f = t_squared * (count - size) as f64 / (size as f64 * (count as f64 - 1.0));
        Some(fisher.sf(f))
    }
}

/// Factor of a normal matrix whose rows need not determine every direction. A step with it is zero in the other directions.
fn factor_with_ridge(matrix: DMatrix<f64>) -> Option<ScaledCholesky> {
    const RIDGE: f64 = 1e-12;
    let diagonal = matrix.diagonal();
    ScaledCholesky::damped(matrix, &diagonal, RIDGE)
}

/// Priors of the selected columns. In the result, a column's number is its index in `columns`.
fn priors_among(priors: &[Prior], columns: &[usize]) -> Vec<Prior> {
    let place = |prior: &Prior| {
        let column = columns.iter().position(|column| *column == prior.column)?;
        Some(Prior { column, ..*prior })
    };
    priors.iter().filter_map(place).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::solver::{Linearisation, minimise};

    /// Test problem: a line with noise that is constant within each fold, `r = a + b t - y`.
    struct Line {
        y: Vec<f64>,
        priors: Vec<Prior>,
        /// Prior knowledge of the slope as an additional sample: value and standard deviation.
        slope: Option<[f64; 2]>,
    }

    impl LeastSquares for Line {
        fn columns(&self) -> usize {
            2
        }

        fn samples(&self) -> usize {
            self.y.len() + usize::from(self.slope.is_some())
        }

        fn rows(&self) -> usize {
            1
        }

        fn is_known(&self, sample: usize) -> bool {
            sample == self.y.len()
        }

        fn priors(&self) -> &[Prior] {
            &self.priors
        }

        fn at<'a>(&'a self, x: &[f64]) -> Linearisation<'a> {
            let x = x.to_vec();
            Box::new(move |sample, r, block| {
                if let (Some([slope, sigma]), true) = (self.slope, sample == self.y.len()) {
                    r[0] = (x[1] - slope) / sigma;
                    block.column_mut(1)[0] = sigma.recip();
                    return true;
                }
                let t = sample as f64;
                r[0] = x[0] + x[1] * t - self.y[sample];
                block.column_mut(0)[0] = 1.0;
                block.column_mut(1)[0] = t;
                true
            })
        }
    }

    fn line() -> (Line, Vec<Vec<usize>>) {
        let y = (0..40).map(|k| 1.0 + 0.3 * f64::from(k) + f64::from((k / 8 * 7) % 5)).collect();
        let priors = vec![Prior { column: 1, value: 0.2, sigma: 0.05 }];
        (Line { y, priors, slope: None }, (0..5).map(|fold| (8 * fold..8 * (fold + 1)).collect()).collect())
    }

    fn solved(problem: &dyn LeastSquares) -> Vec<f64> {
        minimise(problem, &[0.0, 0.0], &Options::default()).map(|(x, _)| x).unwrap_or_default()
    }

    #[test]
    fn a_fold_is_predicted_as_by_a_solve_without_it() {
        let (line, folds) = line();
        // The point is far from the solution, which does not matter because the problem is linear.
        let Ok(normals) = Normals::new(&line, &[0.5, -1.0], &Options::default(), &folds) else {
            panic!("finite residuals")
        };
        let predicted = normals.held_out(&[0, 1], normals.priors()).unwrap_or_default();
        for (fold, found) in folds.iter().zip(&predicted) {
            let samples = (0..40).filter(|sample| !fold.contains(sample)).collect();
            let x = solved(&Subset { of: &line, samples });
            let squares = fold.iter().map(|&k| (x[0] + x[1] * k as f64 - line.y[k]).powi(2));
            let expected = squares.sum::<f64>() / 8.0;
            assert!((found - expected).abs() < 1e-9, "{found} {expected}");
        }
        assert_eq!(predicted.len(), 5);
    }

    #[test]
    fn the_jackknife_is_the_spread_of_solutions_without_each_fold() {
        let (mut line, folds) = line();
        line.priors.clear();
        let x = solved(&line);
        let Some(found) = Normals::new(&line, &x, &Options::default(), &folds)
            .ok()
            .and_then(|normals| normals.jackknife(|_| 0))
        else {
            panic!("the line is determined")
        };
        let found = found.covariance();
        let mut expected = DMatrix::zeros(2, 2);
        for fold in &folds {
            let samples = (0..40).filter(|sample| !fold.contains(sample)).collect();
            let moved =
                DVector::from_vec(solved(&Subset { of: &line, samples })) - DVector::from_vec(x.clone());
            expected += 0.8 * &moved * moved.transpose();
        }
        assert!((found - &expected).amax() < 1e-9 * expected.amax());
    }

    #[test]
    fn what_is_known_as_a_sample_counts_as_a_prior_does() {
        let (with_prior, folds) = line();
        let known = Line { slope: Some([0.2, 0.05]), priors: Vec::new(), y: with_prior.y.clone() };
        let normals = |line: &Line| Normals::new(line, &[0.5, -1.0], &Options::default(), &folds);
        let (Ok(known), Ok(prior)) = (normals(&known), normals(&with_prior)) else {
            panic!("finite residuals")
        };
        let [a, b] = [&known, &prior].map(|one| one.held_out(&[0, 1], one.priors()).unwrap_or_default());
        assert!(a.len() == 5 && a.iter().zip(&b).all(|(a, b)| (a - b).abs() < 1e-9), "{a:?} {b:?}");
        let [a, b] = [&known, &prior].map(|one| one.jackknife(|_| 0).map(|spread| spread.covariance()));
        let (Some(a), Some(b)) = (a, b) else { panic!("the line is determined") };
        assert!((&a - &b).amax() < 1e-12 * b.amax().max(1.0), "{a} {b}");
    }

    #[test]
    fn a_sample_of_prior_knowledge_in_a_fold_is_not_counted_twice() {
        let (line, folds) = line();
        let line = Line { slope: Some([0.2, 0.05]), ..line };
        let mut with_known = folds.clone();
        with_known[4].push(40);
        let whole = |folds: &[Vec<usize>]| {
            Normals::new(&line, &[0.5, -1.0], &Options::default(), folds).map(|normals| normals.whole()).ok()
        };
        assert_eq!(whole(&folds), whole(&with_known));
    }

    #[test]
    fn a_fold_that_alone_determines_a_direction_is_predicted_with_it_unchanged() {
        let line = Line { priors: Vec::new(), ..line().0 };
        // The second and third sample are the same, so that without the first, the slope is not determined.
        let three = Subset { of: &line, samples: vec![5, 20, 20] };
        let folds = [vec![0], vec![1], vec![2]];
        let Ok(normals) = Normals::new(&three, &[1.0, 0.0], &Options::default(), &folds) else {
            panic!("finite residuals")
        };
        let held_out = normals.held_out(&[0, 1], &[]).unwrap_or_default();
        // The residual at `t = 20` is -10. With columns of unit length, half of it belongs to each column.
        let expected = (1.0 + 5.0 + 0.25 * 5.0 - line.y[5]).powi(2);
        assert!(held_out.len() == 3 && (held_out[0] - expected).abs() < 1e-2 * expected, "{held_out:?}");
    }

    #[test]
    fn what_no_sample_and_no_prior_shows_has_no_covariance() {
        let line = Line { y: vec![1.0], priors: Vec::new(), slope: None };
        let normals = Normals::new(&line, &[0.0, 0.0], &Options::default(), &[vec![0]]);
        // One sample at `t = 0` does not determine the slope.
        assert_eq!(normals.map(|normals| normals.covariance()).ok(), Some(None));
    }
}
