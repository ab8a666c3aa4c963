//! Detects priors that the samples contradict, and a contradicted scale of all lengths. The stated uncertainty of a
//! contradicted quantity is too small. Therefore the covariance of the solution gets an additional source of uncertainty
//! for each contradiction, as large as the contradiction. The tests are steps of [`super::calibrate`].
//! `evaluate::limits` reports the contradictions.

use std::fmt;

use nalgebra::{DMatrix, DVector};
use statrs::distribution::{ContinuousCDF, Normal};

use super::pipeline::Solved;
use crate::instrument::Run;
use crate::kinematics::LinkParameter;
use crate::model::{Column, Model, Parameter, ParameterId, Role};
use crate::solver::{Covariance, Solution, UncertaintySource};

/// Standard deviation of the length errors of a robot's links \[m\]: the default of `tolerance_mm_mrad`.
pub(crate) const LENGTH_SIGMA_M: f64 = 1e-3;
/// Probability that a scale is reported as wrong although it is correct.
const OTHER_SCALE_BY_CHANCE: f64 = 1e-3;
/// Probability that any prior is reported although all priors are correct.
const STRAINED_BY_CHANCE: f64 = 1e-3;
/// Relative error of the influence of a prior on its estimate. The influence is computed by linearisation. It has about
/// this error if the samples do not determine the parameter.
const NONLINEAR: f64 = 0.1;
/// If an estimate deviates by more than this number of standard deviations of its prior, the parameter is not the cause.
/// The actual cause resembles an error of the parameter only in the poses in which the robot was measured.
const OTHER_CAUSE: f64 = 10.0;
/// Minimum fraction of a deviation that remains if the prior is used. Smaller fractions cannot be computed accurately.
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

    /// Returns the covariance of a solution with an additional source for each contradiction, as large as
    /// the contradiction. The solution may belong to another fit to the same samples. Its first columns must
    /// be those of `model`.
    pub(super) fn added_to(&self, Solved { solution, columns, .. }: &Solved, model: &Model) -> Covariance {
        let mut covariance = solution.covariance.clone();
        for prior in &self.priors {
            let Some(column) = columns.all().iter().position(|own| *own == prior.column) else { continue };
            // Change of all estimates, if the prior is wrong by as much as the estimate without the prior deviates from it.
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
/// [`STRAINED_BY_CHANCE`] is the probability that any of them is reported although all are correct.
fn strained_priors(runs: &[Run], Solved { solution, columns, .. }: &Solved) -> Vec<ContradictedPrior> {
    // As in the solve, the prior of a column is taken from the first data set that has the column.
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

/// An estimate with a prior, and the test quantities of their contradiction, in SI units.
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
    /// Computes the quantities for a parameter. `None` if it has no prior.
    ///
    /// The prior expects `x0` with the standard deviation `s0`. The estimate is `x` with the standard deviation `s`. If the
    /// prior is wrong by `s0`, the estimate changes by `g`. If the prior is correct, the variance of `x - x0` is
    /// `(s0 - g)^2` plus the variance of `x` from all other sources. These are the samples, other priors, and errors of
    /// fixed parameters. The fraction [`NONLINEAR`] of `g` is added as a tolerance.
    ///
    /// If the covariance does not separate the sources, the variance from the others is `s^2 (1 - g / s0)`, as for
    /// independent noise. For a known noise the sum of the two is then `s0^2 - s^2`.
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

    /// Whether the contradiction invalidates the result. This is so if it has another cause, or if the prior biases the
    /// estimate by more than its uncertainty. The bias is the change of the estimate when the prior is removed.
    pub fn is_serious(&self) -> bool {
        self.off.abs() > OTHER_CAUSE * self.s0 || self.off.abs() * self.g > self.s * (self.s0 - self.g)
    }

    /// Deviation of the estimate, relative to its standard deviation if all priors are correct.
    fn times(&self) -> f64 {
        self.off.abs() / self.spread
    }

    /// Deviation of the estimate if this prior is removed, in standard deviations of the prior. With the prior only the
    /// fraction `(s0 - g) / s0` of it remains.
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
    /// Estimated error, positive if the estimated lengths are too long.
    pub relative: f64,
    /// Absolute value of the error, in standard deviations.
    pub sigmas: f64,
}

/// Estimates a common relative error `s` of all robot lengths, which a wrong scale would cause. Uses generalised least
/// squares of `off = s L`, with the nominal lengths `L`. The covariance is `(1 mm)^2 I + P`: manufacturing tolerances plus
/// the covariance of the estimates.
///
/// `None` if `s` is not significant. If the scale is correct, `s` is reported with the probability
/// [`OTHER_SCALE_BY_CHANCE`].
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
    // With this covariance `C`: `s = (L' C^-1 off) / (L' C^-1 L)`.
    let weighted = length_covariance.cholesky()?.solve(&nominal_m);
    let (along, information) = (weighted.dot(&off_m), weighted.dot(&nominal_m));
    let sigmas = (along / information.sqrt()).abs();
    let sigmas_max = Normal::standard().inverse_cdf(1.0 - OTHER_SCALE_BY_CHANCE / 2.0);
    (sigmas > sigmas_max).then(|| OtherScale { relative: along / information, sigmas })
}
