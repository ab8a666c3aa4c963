//! How well the identified parameters are known.
//!
//! First order: the covariance of least squares with independent noise of equal size on the (weighted) residual rows,
//! `s^2 (J^T J)^-1`, from singular values, never from the inverted normal matrix. It tells nothing of effects that
//! the model leaves out. Priors count as measurements. Parameters that only appear in combinations have none.

use std::fmt;

use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF, StudentsT};

use super::Problem;
use super::identifiability::ScaledSpectrum;
use super::pass::{SampleFit, weighed_rows};

/// What a residual row is worth.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Noise {
    /// Residuals are whitened: standard deviation one.
    Known,
    /// All rows have one unknown standard deviation, estimated from what is left at the solution.
    Estimated,
}

impl Noise {
    /// The factor `s^2`.
    pub(super) fn variance_factor<P: Problem>(self, problem: &P, x: &[f64], fits: &[SampleFit]) -> f64 {
        match self {
            Self::Known => 1.0,
            Self::Estimated => {
                let priors = problem.priors();
                let of_priors =
                    priors.iter().filter_map(|p| x.get(p.column).map(|x| ((x - p.value) / p.sigma).powi(2)));
                let of_samples = fits.iter().filter(|fit| fit.present).map(|fit| fit.weight * fit.squared);
                let sum: f64 = of_samples.chain(of_priors).sum();
                // A sample of weight w counts as w samples.
                let freedom = weighed_rows(fits) + priors.len() as f64 - problem.columns() as f64;
                if freedom > 0.0 { sum / freedom } else { f64::NAN }
            }
        }
    }
}

/// What standard deviations rest on.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum SigmasFrom {
    /// Noise that is independent from sample to sample: too small where errors last for many samples.
    #[default]
    IndependentNoise,
    /// How much the solution moves where one of so many folds is left out.
    Jackknife {
        /// Folds that were left out in turn.
        folds: usize,
    },
}

impl SigmasFrom {
    /// Degrees of freedom of Student's t; none where sigmas are as good as known.
    pub fn freedom(self) -> Option<f64> {
        match self {
            Self::IndependentNoise => None,
            Self::Jackknife { folds } => Some(folds.saturating_sub(1).max(1) as f64),
        }
    }

    /// Standard deviations on either side of a value between which the true one lies with 95 %: 1.96, more where few folds
    /// tell the sigma.
    pub fn sigmas_of_95(self) -> f64 {
        const NORMAL: f64 = 1.96;
        let student = self.freedom().and_then(|freedom| StudentsT::new(0.0, 1.0, freedom).ok());
        student.map_or(NORMAL, |student| student.inverse_cdf(0.975))
    }
}

impl fmt::Display for SigmasFrom {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::IndependentNoise => {
                f.write_str("noise independent from sample to sample; errors that last make them larger")
            }
            Self::Jackknife { folds } => write!(f, "solutions without each of {folds} segments"),
        }
    }
}

/// Covariance of the free parameters that are identified.
#[derive(Debug, Clone, PartialEq)]
pub struct Covariance {
    matrix: DMatrix<f64>,
    determined: Vec<bool>,
    /// What it rests on.
    pub sigmas_from: SigmasFrom,
    /// The factor on the unit covariance: one for known noise, the estimated variance of a residual row otherwise.
    pub variance_factor: f64,
}

impl Covariance {
    pub(super) fn new(spectrum: &ScaledSpectrum, undetermined: &[usize], variance_factor: f64) -> Self {
        let columns = spectrum.lengths.len();
        let mut factor = spectrum.v_transposed.rows(0, spectrum.rank).transpose();
        for (i, mut column) in factor.column_iter_mut().enumerate() {
            column /= spectrum.singular_values[i];
        }
        for (mut row, &length) in factor.row_iter_mut().zip(spectrum.lengths.iter()) {
            row *= if length > 0.0 { length.recip() } else { 0.0 };
        }
        let matrix = &factor * factor.transpose() * variance_factor;
        let determined = (0..columns).map(|column| !undetermined.contains(&column)).collect();
        Self { matrix, determined, sigmas_from: SigmasFrom::IndependentNoise, variance_factor }
    }

    /// The same columns with the covariance that the jackknife over `folds` gave.
    pub fn by_jackknife(self, matrix: DMatrix<f64>, folds: usize) -> Self {
        if matrix.shape() != self.matrix.shape() {
            return self;
        }
        Self { matrix, sigmas_from: SigmasFrom::Jackknife { folds }, ..self }
    }

    fn is_determined(&self, column: usize) -> bool {
        self.determined.get(column).copied().unwrap_or(false)
    }

    /// Covariance of two columns in their units; none where one is not identified.
    pub fn between(&self, a: usize, b: usize) -> Option<f64> {
        (self.is_determined(a) && self.is_determined(b)).then(|| self.matrix[(a, b)])
    }

    /// Standard deviation of a column; none where it is not identified.
    pub fn sigma(&self, column: usize) -> Option<f64> {
        self.between(column, column).map(f64::sqrt)
    }

    /// Correlation of two columns, -1 to 1; none where one is not identified.
    pub fn correlation(&self, a: usize, b: usize) -> Option<f64> {
        Some(self.between(a, b)? / (self.sigma(a)? * self.sigma(b)?))
    }

    /// Pairs of columns by the size of their correlation, those above `least`, largest first.
    pub fn strongest_correlations(&self, least: f64) -> Vec<(usize, usize, f64)> {
        let columns = self.determined.len();
        let mut pairs: Vec<(usize, usize, f64)> = (0..columns)
            .flat_map(|a| (0..a).map(move |b| (b, a)))
            .filter_map(|(a, b)| Some((a, b, self.correlation(a, b)?)))
            .filter(|(_, _, correlation)| correlation.abs() > least)
            .collect();
        pairs.sort_by(|x, y| y.2.abs().total_cmp(&x.2.abs()));
        pairs
    }
}
