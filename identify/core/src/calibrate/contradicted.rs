//! Priors, and the scale of all lengths, that the samples contradict: the stated uncertainty of one of them is too small. The
//! covariance of the solution gets an additional source for each contradiction, of its size. Steps of [`super::calibrate`];
//! `evaluate::limits` states them.

use std::fmt;

use nalgebra::{DMatrix, DVector};
use statrs::distribution::{ContinuousCDF, Normal};

use super::pipeline::Solved;
use crate::instrument::Run;
use crate::kinematics::LinkParameter;
use crate::model::{Column, Model, Parameter, ParameterId, Role};
use crate::solver::{Covariance, Solution, UncertaintySource};

/// Standard deviation of a robot's length errors \[m\]: the default of `tolerance_mm_mrad`.
pub(crate) const LENGTH_SIGMA_M: f64 = 1e-3;
/// Probability of a false report of a wrong scale.
const OTHER_SCALE_BY_CHANCE: f64 = 1e-3;
/// Probability of a false report if all priors are correct.
const STRAINED_BY_CHANCE: f64 = 1e-3;
/// Relative nonlinearity of a prior's influence. The influence on a parameter that the samples do not determine is linear
/// except for this part.
const NONLINEAR: f64 = 0.1;
/// A deviation of more standard deviations of its prior is not an error of this kind: another cause has its shape where the
/// robot was measured, and not elsewhere.
const OTHER_CAUSE: f64 = 10.0;
/// Minimum fraction of a deviation that remains with the prior. A smaller fraction is not accurate.
const REMAINING_MIN: f64 = 0.01;

/// All contradictions of a calibration.
#[derive(Debug, Clone, PartialEq)]
pub struct Contradicted {
    /// Priors, the most contradicted first.
    pub priors: Vec<ContradictedPrior>,
    /// The scale of all lengths.
    pub scale: Option<OtherScale>,
}

impl Contradicted {
    /// Tests the solution of all data sets.
    pub(super) fn new(runs: &[Run], solved: &Solved) -> Self {
        let scale = other_scale(&runs[0].model, &solved.solution);
        Self { priors: strained_priors(runs, solved), scale }
    }

    /// The covariance of a solution with a source for each contradiction, of the size of the contradiction. The solution may be
    /// another fit to the same samples; its first columns are those of `model`.
    pub(super) fn added_to(&self, Solved { solution, columns, .. }: &Solved, model: &Model) -> Covariance {
        let mut covariance = solution.covariance.clone();
        for prior in &self.priors {
            let Some(column) = columns.all().iter().position(|own| *own == prior.column) else { continue };
            // Shift of all estimates if the prior is wrong by the deviation of the estimate without it.
            let shift = solution.covariance.by_prior_on_all(column, prior.s0) * prior.times_without();
            covariance = covariance.with_source(UncertaintySource::Contradicted { column }, &shift);
        }
        if let Some(OtherScale { relative, .. }) = self.scale {
            let mut shift = DVector::zeros(covariance.spread().by_source.nrows());
            lengths(model, solution).for_each(|length| shift[length.column] = relative * length.nominal_m);
            covariance = covariance.with_source(UncertaintySource::OtherScale, &shift);
        }
        covariance
    }
}

/// Contradicted priors, the most contradicted first: the test of Evans and Moshonov (2006) for each of the `n` priors, with
/// probability [`STRAINED_BY_CHANCE`] of a false report in all.
fn strained_priors(runs: &[Run], Solved { solution, columns, .. }: &Solved) -> Vec<ContradictedPrior> {
    // The first data set that has a column provides its prior, as in the solve.
    let parameters: Vec<Vec<Parameter>> =
        runs.iter().map(|run| run.model.columns().copied().collect()).collect();
    let parameters = columns.gather(&parameters);
    let of_columns = columns.all().iter().zip(&parameters).enumerate();
    let mut priors: Vec<ContradictedPrior> = of_columns
        .filter_map(|(index, (column, parameter))| {
            ContradictedPrior::new(index, *column, parameter, solution)
        })
        .collect();
    let sigmas_from = &solution.covariance.sigmas_from;
    let sigmas_max = sigmas_from.sigmas_within(STRAINED_BY_CHANCE / priors.len().max(1) as f64);
    priors.retain(|prior| prior.spread > 0.0 && prior.times() > sigmas_max);
    priors.sort_by(|a, b| b.times().total_cmp(&a.times()));
    priors
}

/// A parameter with a prior, in SI units.
#[derive(Debug, Clone, PartialEq)]
pub struct ContradictedPrior {
    column: Column,
    /// Estimated minus expected value.
    off: f64,
    /// Standard deviation of the prior.
    s0: f64,
    /// Standard deviation of the estimate.
    s: f64,
    /// Shift of the estimate if the prior is off by its standard deviation.
    g: f64,
    /// Standard deviation of `off` if all priors are correct.
    spread: f64,
}

impl ContradictedPrior {
    /// The prior of a parameter; `None` if it has none.
    ///
    /// A correct prior of `x0` with sigma `s0` shifts the estimate `x` (sigma `s`) by `g` if it is off by `s0`. Then `x - x0` has
    /// the variance `(s0 - g)^2` ([`NONLINEAR`] of `g` is added as a tolerance) plus the variance of `x` from all other sources:
    /// samples, other priors, errors of fixed parameters. If the sources are unknown, use that of independent noise,
    /// `s^2 (1 - g / s0)`: `s0^2 - s^2` in all if the noise is known.
    fn new(
        index: usize,
        column: Column,
        parameter: &Parameter,
        Solution { x, covariance, .. }: &Solution,
    ) -> Option<Self> {
        let Role::Prior { value, sigma: s0 } = parameter.role else { return None };
        let s = covariance.sigma(index)?;
        let (g, variance_of_others) = covariance.by_prior(index).map_or_else(
            || {
                let g = covariance.by_prior_on_all(index, s0)[index];
                (g, s.powi(2) * (1.0 - g / s0))
            },
            |g| (g, s.powi(2) - g.powi(2)),
        );
        let spread = (variance_of_others + (s0 - g).powi(2) + (NONLINEAR * g).powi(2)).max(0.0).sqrt();
        Some(Self { column, off: x.get(index)? - value, s0, s, g, spread })
    }

    /// Whether it invalidates the result: it has another cause, or the prior biases the result by more than the uncertainty
    /// (without it the estimate would differ more from the expected value).
    pub fn is_serious(&self) -> bool {
        self.off.abs() > OTHER_CAUSE * self.s0 || self.off.abs() * self.g > self.s * (self.s0 - self.g)
    }

    /// Deviation of the estimate, relative to its standard deviation if all priors are correct.
    fn times(&self) -> f64 {
        self.off.abs() / self.spread
    }

    /// Deviation of the estimate without this prior, in standard deviations of the prior: `(s0 - g) / s0` of it remains with it.
    fn times_without(&self) -> f64 {
        self.off.abs() / (self.s0 - self.g).max(REMAINING_MIN * self.s0)
    }
}

impl fmt::Display for ContradictedPrior {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { column, off, s0, .. } = self;
        let unit = column.id.unit();
        let (factor, symbol) = (unit.display_factor(), unit.display_symbol());
        write!(out, "{column} by {:+.3} {symbol} (expected within {:.3})", off * factor, s0 * factor)
    }
}

/// An estimated length of robot or bar; `off_m` is the estimated minus the nominal value.
pub(crate) struct LengthEstimate {
    pub(crate) id: ParameterId,
    column: usize,
    nominal_m: f64,
    pub(crate) off_m: f64,
}

impl fmt::Display for LengthEstimate {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{} by {:+.1} mm", self.id, self.off_m * 1e3)
    }
}

/// The estimated lengths of robot and bar; the first columns of the solution are those of `model`.
pub(crate) fn lengths(model: &Model, solution: &Solution) -> impl Iterator<Item = LengthEstimate> {
    let solved = model.columns().zip(&solution.x).enumerate();
    solved.filter_map(|(column, (parameter, x))| match parameter.id {
        ParameterId::Robot { parameter: LinkParameter::A | LinkParameter::D, .. }
        | ParameterId::Bar { parameter: LinkParameter::A | LinkParameter::D, .. } => {
            let off_m = x - parameter.nominal;
            Some(LengthEstimate { id: parameter.id, column, nominal_m: parameter.nominal, off_m })
        }
        _ => None,
    })
}

/// A common relative error of all lengths of the robot.
#[derive(Debug, Clone, PartialEq)]
pub struct OtherScale {
    /// Estimated error, positive if the estimated lengths are too long.
    pub relative: f64,
    /// Its absolute value in standard deviations.
    pub sigmas: f64,
}

/// A common relative error `s` of all robot lengths, which is that of the scale: generalised least squares of `off = s L`
/// with the covariance `(1 mm)^2 I + P`, from manufacturing and from the estimate. It is reported with probability
/// [`OTHER_SCALE_BY_CHANCE`] if the scale is correct.
fn other_scale(model: &Model, solution: &Solution) -> Option<OtherScale> {
    let covariance = &solution.covariance;
    let of_robot = |length: &LengthEstimate| {
        matches!(length.id, ParameterId::Robot { .. })
            && length.id != ParameterId::plate(model.axes())
            && covariance.sigma(length.column).is_some()
    };
    let lengths: Vec<LengthEstimate> = lengths(model, solution).filter(of_robot).collect();
    let nominal_m = DVector::from_iterator(lengths.len(), lengths.iter().map(|length| length.nominal_m));
    let off_m = DVector::from_iterator(lengths.len(), lengths.iter().map(|length| length.off_m));
    let length_covariance = DMatrix::from_fn(lengths.len(), lengths.len(), |row, column| {
        let estimated = covariance.between(lengths[row].column, lengths[column].column).unwrap_or(0.0);
        estimated + if row == column { LENGTH_SIGMA_M.powi(2) } else { 0.0 }
    });
    // With `C` this covariance: `s = (L' C^-1 off) / (L' C^-1 L)`.
    let weighted = length_covariance.cholesky()?.solve(&nominal_m);
    let (along, information) = (weighted.dot(&off_m), weighted.dot(&nominal_m));
    let sigmas = (along / information.sqrt()).abs();
    let sigmas_max = Normal::standard().inverse_cdf(1.0 - OTHER_SCALE_BY_CHANCE / 2.0);
    (sigmas > sigmas_max).then(|| OtherScale { relative: along / information, sigmas })
}
