//! What a calibration by measured poses found.

use super::{Apart, Fit, PoseError, PoseFigures, Stages, TermReport};
use crate::cost::PoseNoise;
use crate::model::{Model, Parameter, ParameterId};
use crate::solver::{Identifiability, Summary};

/// Outcome of a calibration by measured poses.
#[derive(Debug, Clone)]
pub struct PoseReport {
    /// Name of the cost: positions alone or whole poses.
    pub cost: &'static str,
    /// Rows that the fit saw.
    pub fitted: Stages,
    /// Rows that it did not see.
    pub held_out: Stages,
    /// Kinds of joint errors, taken or not.
    pub terms: Vec<TermReport>,
    /// Standard deviations that the last solve assumed, from the spread of the residuals.
    pub noise: PoseNoise,
    /// Standard deviation of each parameter that was estimated, SI, from rows and priors.
    pub sigmas: Vec<(ParameterId, f64)>,
    /// How the last solve went.
    pub summary: Summary,
    /// What the rows tell of tracker, probe and links; joint errors have priors.
    pub identifiability: Identifiability,
    /// The calibrated model.
    pub model: Model,
}

/// Figures of chosen rows after each stage.
pub(super) fn stages([nominal, links, joints]: [&[Apart]; 3], chosen: &[usize]) -> Stages {
    let figures = |errors: &[Apart]| {
        let of_chosen: Vec<Apart> = chosen.iter().filter_map(|&row| errors.get(row).copied()).collect();
        PoseFigures::of(&of_chosen)
    };
    Stages { nominal: figures(nominal), links: figures(links), joints: figures(joints) }
}

/// Standard deviations at the solution for noise that is independent from row to row.
pub(super) fn sigmas(fit: &Fit<'_>, model: &Model) -> Result<Vec<(ParameterId, f64)>, PoseError> {
    let all: Vec<usize> = (0..fit.fitting.len()).collect();
    let normals = fit.samples.normals(model, fit.weighing(model), &[all])?;
    let Some(covariance) = normals.and_then(|normals| normals.covariance()) else { return Ok(Vec::new()) };
    let variances = covariance.diagonal();
    let sigma = |(parameter, variance): (&Parameter, &f64)| (parameter.id, variance.max(0.0).sqrt());
    Ok(model.columns().zip(variances.iter()).map(sigma).collect())
}
