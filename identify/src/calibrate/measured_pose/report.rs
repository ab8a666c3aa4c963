//! What a calibration by measured poses found.

use nalgebra::DVector;

use super::terms::{self, Left};
use super::{Apart, Fit, PoseError, PoseFigures, Stages, TermReport};
use crate::calibrate::cross_validation::Normal;
use crate::cost::PoseNoise;
use crate::model::{Model, ParameterId};
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

/// Standard deviations at the solution: of the inverse of the normal matrix with the priors, column-scaled.
pub(super) fn sigmas(fit: &Fit<'_>, model: &Model) -> Result<Vec<(ParameterId, f64)>, PoseError> {
    let folds: Vec<usize> = (0..fit.fitting.len()).map(|row| row % terms::FOLDS).collect();
    let left = Left {
        rows: fit.rows,
        directions: fit.directions,
        fitting: fit.fitting,
        folds: &folds,
        weighing: fit.weighing(model),
    };
    let mut normal = Normal::zeros(model.columns().len());
    left.normals(model)?.iter().for_each(|fold| normal += fold);
    for prior in model.priors() {
        normal.matrix[(prior.column, prior.column)] += prior.sigma.powi(-2);
    }
    let scale: DVector<f64> =
        normal.matrix.diagonal().map(|entry| if entry > 0.0 { entry.sqrt().recip() } else { 0.0 });
    let mut scaled = normal.matrix;
    for (j, mut column) in scaled.column_iter_mut().enumerate() {
        column.component_mul_assign(&scale);
        column *= scale[j];
    }
    let Some(factor) = scaled.cholesky() else { return Ok(Vec::new()) };
    let variances = factor.inverse().diagonal();
    let sigma = |(column, parameter): (usize, &crate::model::Parameter)| {
        (parameter.id, variances[column].max(0.0).sqrt() * scale[column])
    };
    Ok(model.columns().enumerate().map(sigma).collect())
}
