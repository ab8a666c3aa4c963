//! Detects priors that the samples contradict, and tests whether the scale of all lengths is wrong. If a prior or the scale
//! is contradicted, its stated uncertainty is too small. Therefore each contradiction adds a source of uncertainty to the
//! covariance of the solution, as large as the contradiction. The tests are steps of [`super::calibrate`].
//! `evaluate::limits` reports the contradictions.

use std::fmt;

use nalgebra::{DMatrix, DVector};
use statrs::distribution::{ContinuousCDF, Normal};

use super::pipeline::Solved;
use crate::instrument::Run;
use crate::kinematics::LinkParameter;
use crate::model::{Column, Model, Parameter, ParameterId, Role};
use crate::solver::{Covariance, Solution, UncertaintySource};

/// Standard deviation of the length errors of a robot's links \[m\]. It is the default of `tolerance_mm_mrad`.
pub(crate) const LENGTH_SIGMA_M: f64 = 1e-3;
/// Probability that a scale is reported as wrong although it is correct.
const OTHER_SCALE_BY_CHANCE: f64 = 1e-3;
/// Probability that any prior is reported although all priors are correct.
const STRAINED_BY_CHANCE: f64 = 1e-3;
/// Assumed relative error of `g`, the change of an estimate if its prior is wrong by one standard deviation. `g` is computed
/// by linearisation, which has about this error if the samples do not determine the parameter.
const NONLINEAR: f64 = 0.1;
/// If an estimate differs from its prior by more than this number of the prior's standard deviations, an error of this
/// parameter is not the cause. The actual cause only looks like an error of this parameter in the measured poses.
const OTHER_CAUSE: f64 = 10.0;
/// Minimum of `(s0 - g) / s0`, the fraction of a prior's error that remains as deviation of the estimate from the prior.
/// Smaller fractions cannot be computed accurately.
const REMAINING_MIN: f64 = 0.01;

/// All contradictions that were detected in a calibration.
#[derive(Debug, Clone, PartialEq)]
pub struct Contradicted {
    /// Contradicted priors, the most contradicted first.
    pub priors: Vec<ContradictedPrior>,
    /// Contradicted scale of all lengths. `None` if the scale is not contradicted.
    pub scale: Option<OtherScale>,
}

impl Contradicted {
    /// Tests the priors and the scale at the solution of all data sets.
    pub(super) fn new(runs: &[Run], solved: &Solved) -> Self {
        let scale = other_scale(&runs[0].model, &solved.solution);
        Self { priors: strained_priors(runs, solved), scale }
    }

    /// Adds a source of uncertainty to the covariance of a solution for each contradiction, as large as the
    /// contradiction. Returns the new covariance. The solution may belong to another fit to the same samples. Its
    /// first columns must be those of `model`.
    pub(super) fn added_to(&self, Solved { solution, columns, .. }: &Solved, model: &Model) -> Covariance {
        let mut covariance = solution.covariance.clone();
        for prior in &self.priors {
            let Some(column) = columns.all().iter().position(|own| *own == prior.column) else { continue };
            // Change of all estimates if the prior is wrong by `times_without` standard deviations. This is the deviation of
            // the estimate from the prior if the prior is not used.
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

/// Finds the contradicted priors, the most contradicted first. Each of the `n` priors is tested (Evans and Moshonov 2006).
/// [`STRAINED_BY_CHANCE`] is the probability that at least one prior is reported although all are correct.
fn strained_priors(runs: &[Run], Solved { solution, columns, .. }: &Solved) -> Vec<ContradictedPrior> {
    // If several data sets have the column, the prior of the first one is used, as in the solve.
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

/// An estimated parameter that has a prior, and the quantities that test whether the two contradict each other, in SI units.
#[derive(Debug, Clone, PartialEq)]
pub struct ContradictedPrior {
    column: Column,
    /// Estimate minus the expected value of the prior.
    off: f64,
    /// Standard deviation of the prior.
    s0: f64,
    /// Standard deviation of the estimate.
    s: f64,
    /// Change of the estimate if the prior is wrong by its standard deviation.
    g: f64,
    /// Standard deviation of `off` if all priors are correct.
    spread: f64,
}

impl ContradictedPrior {
    /// Computes the quantities for a parameter. `None` if the parameter has no prior.
    ///
    /// The prior expects the value `x0` with the standard deviation `s0`. The estimate is `x` with the standard deviation
    /// `s`. If the prior is wrong by `s0`, the estimate changes by `g`. If the prior is correct, the variance of `x - x0` is
    /// `(s0 - g)^2` plus the variance of `x` from all other sources: the samples, other priors, and errors of fixed
    /// parameters. The fraction [`NONLINEAR`] of `g` is added as a tolerance.
    ///
    /// If the covariance does not separate its sources, the variance from all other sources is `s^2 (1 - g / s0)`, as for
    /// independent noise. If the noise is also known, `g` is `s^2 / s0`, and the variance of `x - x0` is `s0^2 - s^2`.
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

    /// Whether the contradiction makes the result invalid: either another error is the cause (`OTHER_CAUSE`), or
    /// the prior biases the estimate by more than the uncertainty of the estimate. The bias is the change of the
    /// estimate when the prior is removed.
    pub fn is_serious(&self) -> bool {
        self.off.abs() > OTHER_CAUSE * self.s0 || self.off.abs() * self.g > self.s * (self.s0 - self.g)
    }

    /// Deviation of the estimate from the prior, divided by the standard deviation of this
    /// deviation if all priors are correct.
    fn times(&self) -> f64 {
        self.off.abs() / self.spread
    }

    /// Deviation from the prior of an estimate that does not use the prior, in standard deviations of the prior. If the
    /// estimate uses the prior, only the fraction `(s0 - g) / s0` of this deviation remains.
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

/// An estimated length of robot or bar. `off_m` is the estimate minus the nominal value.
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

/// The estimated lengths of robot and bar. The first columns of the solution must be those of `model`.
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
    /// Estimated relative error, positive if the estimated lengths are too long.
    pub relative: f64,
    /// Absolute value of the error, in standard deviations.
    pub sigmas: f64,
}

/// Estimates a common relative error `s` of all robot lengths, which a wrong scale would cause. Let `L` be the nominal
/// lengths and `off` the estimated minus the nominal lengths. Generalised least squares of `off = s L` gives `s`. The
/// covariance of `off` is `(1 mm)^2 I + P`, with manufacturing tolerances of 1 mm and the covariance `P` of the estimates.
///
/// `None` if `s` is not significant. If the scale is correct, `s` is nevertheless reported with the
/// probability [`OTHER_SCALE_BY_CHANCE`].
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
    // With `C` for `length_covariance`: `s = (L' C^-1 off) / (L' C^-1 L)`.
    let weighted = length_covariance.cholesky()?.solve(&nominal_m);
    let (along, information) = (weighted.dot(&off_m), weighted.dot(&nominal_m));
    let sigmas = (along / information.sqrt()).abs();
    let sigmas_max = Normal::standard().inverse_cdf(1.0 - OTHER_SCALE_BY_CHANCE / 2.0);
    (sigmas > sigmas_max).then(|| OtherScale { relative: along / information, sigmas })
}
