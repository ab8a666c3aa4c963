//! Uncertainty of the identified parameters, from the singular values of the Jacobian at the solution, or
//! from the jackknife (`normals`).
//!
//! The covariance from singular values is that of least squares to first order, `s^2 (J^T J)^-1`. It assumes
//! independent noise of equal size on the weighted residual rows. It is never computed from the inverted normal
//! matrix. It does not contain effects that the model omits. Priors count as measurements. Parameters that are only
//! determined in combinations have no covariance.
//!
//! Every covariance is represented as `S S^T`. Each column of `S` is the contribution of one source of uncertainty: the
//! errors of some samples, a prior, or the value of a parameter that was not estimated. The matrix `S` is a [`Spread`].

use std::fmt;
use std::ops::Range;

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF, Normal, StudentsT};

use super::identifiability::ScaledSpectrum;
use crate::solver::LeastSquares;
use crate::solver::pass::{SampleFit, weighed_rows};

/// Standard deviation of a residual row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ResidualNoise {
    /// One: the residuals are whitened.
    Known,
    /// Unknown, equal for all rows, and estimated from the residuals at the solution.
    Estimated,
}

impl ResidualNoise {
    /// The factor `s^2` on the covariance. `None` if the number of degrees of freedom is not positive.
    pub(in crate::solver) fn variance_factor(
        self,
        problem: &dyn LeastSquares,
        x: &[f64],
        fits: &[SampleFit],
    ) -> Option<f64> {
        match self {
            Self::Known => Some(1.0),
            Self::Estimated => {
                let priors = problem.priors();
                let of_priors =
                    priors.iter().filter_map(|p| x.get(p.column).map(|x| ((x - p.value) / p.sigma).powi(2)));
                let of_samples = fits.iter().filter(|fit| fit.present).map(|fit| fit.weight * fit.squared);
                let sum: f64 = of_samples.chain(of_priors).sum();
                // A sample of weight w counts as w samples for the degrees of freedom.
                let freedom = weighed_rows(fits) + priors.len() as f64 - problem.columns() as f64;
                (freedom > 0.0).then(|| sum / freedom)
            }
        }
    }
}

/// How standard deviations were computed, which determines the assumption behind them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum SigmasFrom {
    /// Assumes that noise is independent from sample to sample. If errors are correlated over many samples, the standard
    /// deviations are too small.
    #[default]
    IndependentNoise,
    /// Standard deviations from the jackknife: from the changes of the solution when each fold in turn is left out.
    Jackknife {
        /// Number of folds.
        folds: usize,
    },
}

impl SigmasFrom {
    /// Degrees of freedom of Student's t for a confidence interval. `None` if the standard deviations are treated as exact.
    pub fn freedom(self) -> Option<f64> {
        match self {
            Self::IndependentNoise => None,
            Self::Jackknife { folds } => Some(folds.saturating_sub(1).max(1) as f64),
        }
    }

    /// Half-width of a 95 % confidence interval, in standard deviations. It is 1.96, or more if the standard deviation is
    /// estimated from few folds.
    pub fn sigmas_of_95(self) -> f64 {
        self.sigmas_within(0.05)
    }

    /// Half-width, in standard deviations, of a confidence interval that misses the true value with probability `chance`.
    pub fn sigmas_within(self, chance: f64) -> f64 {
        let student = self.freedom().and_then(|freedom| StudentsT::new(0.0, 1.0, freedom).ok());
        let upper = 1.0 - 0.5 * chance;
        student.map_or_else(|| Normal::standard().inverse_cdf(upper), |student| student.inverse_cdf(upper))
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

/// A source of uncertainty of a solution.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UncertaintySource {
    /// Errors of all samples, and the priors, as one source.
    Together,
    /// Errors of the samples of one data set.
    Samples {
        /// Index of the data set, from 0.
        data_set: usize,
    },
    /// The prior of a column.
    Prior {
        /// Column with the prior.
        column: usize,
    },
    /// Prior knowledge that is represented by samples.
    Known,
    /// Model terms that were left out of the solution. They may be nonzero in the robot.
    LeftOut,
    /// The prior of a column, if the samples contradict this prior. The contribution is the change of the solution when
    /// the prior is removed.
    Contradicted {
        /// Column with the prior.
        column: usize,
    },
    /// A common relative error of all lengths of the robot, estimated from the deviations of the lengths
    /// from their nominal values.
    OtherScale,
    /// The value of a considered parameter, which is uncertain but not estimated.
    Considered {
        /// Column of the parameter in the covariance. Columns of considered parameters follow those of the solution.
        column: usize,
    },
}

impl UncertaintySource {
    /// Whether the contribution is estimated from the scatter of samples (type A of the GUM) rather than from
    /// a specification (type B).
    pub const fn is_statistical(self) -> bool {
        matches!(self, Self::Together | Self::Samples { .. })
    }
}

/// The matrix `S` with the source of each of its columns.
#[derive(Debug, Clone, PartialEq)]
pub struct Spread {
    /// Each column is the effect of one standard deviation of a source, in the parameters' units.
    pub by_source: DMatrix<f64>,
    /// Source of each column.
    pub sources: Vec<UncertaintySource>,
}

impl Spread {
    /// Creates the matrix from the contributions of the sources, which have one row for each parameter.
    pub fn new(parameters: usize, columns: &[(UncertaintySource, DVector<f64>)]) -> Self {
        let mut by_source = DMatrix::zeros(parameters, columns.len());
        for (mut column, (_, contribution)) in by_source.column_iter_mut().zip(columns) {
            column.copy_from(contribution);
        }
        Self { by_source, sources: columns.iter().map(|(source, _)| *source).collect() }
    }

    /// Adds a source. `contribution` is the change of each parameter for an error of one standard deviation in the source.
    pub fn add(&mut self, source: UncertaintySource, contribution: &DVector<f64>) {
        let count = self.sources.len();
        self.by_source.resize_horizontally_mut(count + 1, 0.0);
        self.by_source.column_mut(count).copy_from(contribution);
        self.sources.push(source);
    }

    /// Selects rows: first the rows `places`, then the rows `left_out` of terms that were left out of the solution. A prior
    /// of a column that is not among `places` becomes [`UncertaintySource::LeftOut`].
    #[must_use]
    pub fn select(&self, places: &[usize], left_out: &[usize]) -> Self {
        let source = |source: &UncertaintySource| match *source {
            UncertaintySource::Prior { column } => match places.iter().position(|place| *place == column) {
                Some(column) => UncertaintySource::Prior { column },
                None => UncertaintySource::LeftOut,
            },
            other => other,
        };
        Self {
            by_source: self.by_source.select_rows(&[places, left_out].concat()),
            sources: self.sources.iter().map(source).collect(),
        }
    }

    /// The covariance `S S^T`.
    pub fn covariance(&self) -> DMatrix<f64> {
        &self.by_source * self.by_source.transpose()
    }
}

/// Considered parameters: their values are uncertain but not estimated.
#[derive(Debug, Clone, PartialEq)]
pub struct Considered {
    /// Standard deviations of their values.
    pub sigmas: Vec<f64>,
    /// Change of the estimate per error of the considered value. The matrix has one row for each column of the solution,
    /// and one column for each considered parameter.
    pub change: DMatrix<f64>,
}

/// Covariance of the estimated parameters, of left-out terms, and of considered parameters. The columns are in this order.
#[derive(Debug, Clone, PartialEq)]
pub struct Covariance {
    matrix: DMatrix<f64>,
    /// Covariance of least squares for noise of variance one.
    unit: DMatrix<f64>,
    spread: Spread,
    determined: Vec<bool>,
    /// Number of estimated columns, which are the first columns.
    estimated: usize,
    /// Number of columns of left-out terms, which follow the estimated columns.
    left_out: usize,
    /// Assumption behind the standard deviations.
    pub sigmas_from: SigmasFrom,
    /// Factor `s^2` on the unit covariance: one for known noise, otherwise the estimated variance of a residual row. `None`
    /// if the number of degrees of freedom is not positive.
    pub variance_factor: Option<f64>,
}

impl Covariance {
    /// Covariance `s^2 D^-1 V Sigma^-2 V^T D^-1`, with the variance factor `s^2` and the column lengths `D`. `Sigma` are the
    /// singular values of the scaled Jacobian and `V` its right singular vectors, both up to the rank.
    pub(in crate::solver) fn new(
        spectrum: &ScaledSpectrum,
        undetermined: &[usize],
        variance_factor: Option<f64>,
    ) -> Self {
        let columns = spectrum.lengths.len();
        let mut factor = spectrum.v_transposed.rows(0, spectrum.rank).transpose();
        for (i, mut column) in factor.column_iter_mut().enumerate() {
            column /= spectrum.singular_values[i];
        }
        for (mut row, &length) in factor.row_iter_mut().zip(spectrum.lengths.iter()) {
            row *= if length > 0.0 { length.recip() } else { 0.0 };
        }
        // Without a variance factor `has_sigmas` is false, and no entry is returned.
        let variance = variance_factor.unwrap_or_default();
        let unit = &factor * factor.transpose();
        let matrix = &unit * variance;
        let by_source = factor * variance.sqrt();
        let spread = Spread { sources: vec![UncertaintySource::Together; by_source.ncols()], by_source };
        let determined = (0..columns).map(|column| !undetermined.contains(&column)).collect();
        let (sigmas_from, estimated) = (SigmasFrom::IndependentNoise, columns);
        Self { matrix, unit, spread, determined, estimated, left_out: 0, sigmas_from, variance_factor }
    }

    /// Replaces the covariance by that of the jackknife over `folds`. The last `left_out` rows of `spread` belong to terms
    /// that were left out of the solution. The solution sets these terms to zero, although they may be nonzero in the robot.
    pub fn replace_by_jackknife(&mut self, spread: Spread, folds: usize, left_out: usize) {
        assert_eq!(spread.by_source.nrows(), self.determined.len() + left_out);
        self.determined.extend(std::iter::repeat_n(true, left_out));
        self.left_out = left_out;
        self.sigmas_from = SigmasFrom::Jackknife { folds };
        (self.matrix, self.spread) = (spread.covariance(), spread);
    }

    /// Replaces the covariance by the consider covariance (Schmidt 1966). With estimated parameters `x`, considered
    /// parameters `c` and `G = dx / dc`, it is `[[P_xx + G P_cc G^T, G P_cc], [P_cc G^T, P_cc]]`.
    pub fn add_considered(&mut self, Considered { sigmas, change }: Considered) {
        let Spread { by_source, sources } = &mut self.spread;
        let ((rows, columns), count) = (by_source.shape(), sigmas.len());
        assert_eq!(change.shape(), (self.estimated, count));
        by_source.resize_mut(rows + count, columns + count, 0.0);
        by_source.view_mut((0, columns), (self.estimated, count)).copy_from(&change);
        for (index, sigma) in sigmas.into_iter().enumerate() {
            by_source[(rows + index, columns + index)] = 1.0;
            by_source.column_mut(columns + index).scale_mut(sigma);
            sources.push(UncertaintySource::Considered { column: rows + index });
        }
        self.matrix = self.spread.covariance();
        self.determined.extend(std::iter::repeat_n(true, count));
    }

    /// Multiplies contributions to the uncertainty by `times`: those of the samples of one data set, and those of
    /// [`UncertaintySource::Together`].
    pub fn widen(&mut self, data_set: usize, times: f64) {
        let Spread { by_source, sources } = &mut self.spread;
        for (mut column, source) in by_source.column_iter_mut().zip(sources) {
            if matches!(source, UncertaintySource::Together)
                || *source == (UncertaintySource::Samples { data_set })
            {
                column *= times;
            }
        }
        self.matrix = self.spread.covariance();
    }

    /// Adds a source. `contribution` is the change of each column for an error of one standard deviation in the source.
    #[must_use]
    pub(crate) fn with_source(mut self, source: UncertaintySource, contribution: &DVector<f64>) -> Self {
        self.spread.add(source, contribution);
        self.matrix = self.spread.covariance();
        self
    }

    /// Change of all columns for an error of one standard deviation `sigma` in the prior of one column. If the
    /// sources are separated, this is the contribution of the prior. Otherwise it is `P e / sigma`, with the unit
    /// covariance `P` and the unit vector `e` of the column.
    pub(crate) fn by_prior_on_all(&self, column: usize, sigma: f64) -> DVector<f64> {
        let Spread { by_source, sources } = &self.spread;
        let of_prior = sources.iter().position(|source| *source == UncertaintySource::Prior { column });
        of_prior.map_or_else(
            || (self.unit.column(column) / sigma).resize_vertically(by_source.nrows(), 0.0),
            |of| by_source.column(of).into_owned(),
        )
    }

    /// Change of the estimate of a column for an error of one standard deviation in this column's prior. `None` if the
    /// sources are not separated.
    pub fn by_prior(&self, column: usize) -> Option<f64> {
        let Spread { by_source, sources } = &self.spread;
        let of_prior = sources.iter().position(|source| *source == UncertaintySource::Prior { column })?;
        Some(by_source[(column, of_prior)].abs())
    }

    /// Contributions of the sources to the covariance.
    pub fn spread(&self) -> &Spread {
        &self.spread
    }

    /// Columns of the uncertain parameters that were not estimated: left-out terms, then considered parameters.
    pub fn beside(&self) -> Range<usize> {
        self.estimated..self.determined.len()
    }

    /// Columns of estimated parameters and of considered parameters, but not those of left-out terms.
    pub fn stated(&self) -> Vec<usize> {
        (0..self.estimated).chain(self.estimated + self.left_out..self.determined.len()).collect()
    }

    /// Whether there are standard deviations. Those of least squares need a variance factor, and therefore at least one
    /// degree of freedom. Those of the jackknife do not.
    pub fn has_sigmas(&self) -> bool {
        self.variance_factor.is_some() || self.sigmas_from != SigmasFrom::IndependentNoise
    }

    fn is_determined(&self, column: usize) -> bool {
        self.has_sigmas() && self.determined.get(column).copied().unwrap_or(false)
    }

    /// Covariance of two columns in their units. `None` if one of them is not identified, or if [`Self::has_sigmas`] is false.
    pub fn between(&self, a: usize, b: usize) -> Option<f64> {
        (self.is_determined(a) && self.is_determined(b)).then(|| self.matrix[(a, b)])
    }

    /// Standard deviation of a column. `None` if the column is not identified, or if [`Self::has_sigmas`] is false.
    pub fn sigma(&self, column: usize) -> Option<f64> {
        self.between(column, column).map(f64::sqrt)
    }

    /// Standard deviation of a column, without the sources that were added because the samples contradict a prior or the
    /// scale of all lengths. `None` under the conditions of [`Self::sigma`].
    pub fn sigma_before_contradictions(&self, column: usize) -> Option<f64> {
        let Spread { by_source, sources } = &self.spread;
        let is_added = |source: &UncertaintySource| {
            matches!(source, UncertaintySource::Contradicted { .. } | UncertaintySource::OtherScale)
        };
        let added = sources.iter().enumerate().filter(|(_, source)| is_added(source));
        let added: f64 = added.map(|(index, _)| by_source[(column, index)].powi(2)).sum();
        Some((self.between(column, column)? - added).max(0.0).sqrt())
    }

    /// Correlation of two columns, -1 to 1. `None` if one of them is not identified.
    pub fn correlation(&self, a: usize, b: usize) -> Option<f64> {
        Some(self.between(a, b)? / (self.sigma(a)? * self.sigma(b)?))
    }

    /// Pairs of estimated or considered columns whose correlation is larger than `least` in magnitude, strongest first.
    pub fn strongest_correlations(&self, least: f64) -> Vec<(usize, usize, f64)> {
        let columns = self.stated();
        let pairs =
            columns.iter().enumerate().flat_map(|(a, column)| columns[..a].iter().map(|b| (*b, *column)));
        let mut pairs: Vec<(usize, usize, f64)> = pairs
            .filter_map(|(a, b)| Some((a, b, self.correlation(a, b)?)))
            .filter(|(_, _, correlation)| correlation.abs() > least)
            .collect();
        pairs.sort_by(|x, y| y.2.abs().total_cmp(&x.2.abs()));
        pairs
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two columns with `J^T J = [[2, 1], [1, 2]]`. The first column has a prior with a standard deviation of one.
    #[test]
    fn a_wrong_prior_changes_the_solution_alike_for_known_and_estimated_noise() {
        let unit = DMatrix::from_row_slice(2, 2, &[2.0, -1.0, -1.0, 2.0]) / 3.0;
        let covariance = |factor: f64| Covariance {
            matrix: &unit * factor,
            unit: unit.clone(),
            spread: Spread::new(2, &[]),
            determined: vec![true; 2],
            estimated: 2,
            left_out: 0,
            sigmas_from: SigmasFrom::IndependentNoise,
            variance_factor: Some(factor),
        };
        let change = |covariance: &Covariance| covariance.by_prior_on_all(0, 1.0);
        let expected = DVector::from_vec(vec![2.0, -1.0]) / 3.0;
        for factor in [1.0, 4.0] {
            assert!((change(&covariance(factor)) - &expected).amax() < 1e-12);
        }
        // Errors of other sources change the solution, but not its change by this prior.
        let mut with_others = covariance(4.0);
        with_others.widen(0, 3.0);
        with_others
            .add_considered(Considered { sigmas: vec![2.0], change: DMatrix::from_element(2, 1, 1.0) });
        assert!((change(&with_others) - expected.resize_vertically(3, 0.0)).amax() < 1e-12);
    }

    #[test]
    fn of_some_parameters_the_priors_of_the_others_are_those_of_what_was_left_out() {
        let sources = [
            UncertaintySource::Samples { data_set: 0 },
            UncertaintySource::Prior { column: 1 },
            UncertaintySource::Prior { column: 2 },
        ];
        let columns = sources.map(|source| (source, DVector::from_vec(vec![1.0, 2.0, 3.0])));
        let mut spread = Spread::new(3, &columns);
        spread.add(UncertaintySource::LeftOut, &DVector::from_vec(vec![4.0, 5.0, 6.0]));
        let expected = [
            sources[0],
            UncertaintySource::LeftOut,
            UncertaintySource::Prior { column: 0 },
            UncertaintySource::LeftOut,
        ];
        assert_eq!(spread.select(&[2, 0], &[1]).sources, expected);
        let of = spread.select(&[2, 0], &[]);
        assert_eq!(of.sources, expected);
        assert_eq!(of.covariance(), DMatrix::from_row_slice(2, 2, &[63.0, 33.0, 33.0, 19.0]));
    }
}
