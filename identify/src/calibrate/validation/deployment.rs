//! A calibration for what can be applied: the best geometry for a controller that takes only part of the model.
//!
//! Errors of one axis resemble each other: an offset, a ratio, a compliance and a slow wave of a gear partly take each other's
//! place. A geometry that was found beside terms which nobody then applies is not the best one without them, and can be worse
//! than the nominal one. So each deployment has its own fit, of what it takes and nothing else of the robot.

use serde::{Deserialize, Serialize};

use crate::calibrate::ball_bar::{BallBarCalibration, CalibrateError};
use crate::calibrate::pipeline::refit;
use crate::cost::SharedColumns;
use crate::instrument::Run;
use crate::kinematics::LinkParameter;
use crate::model::{Model, ModelError, Owner, ParameterId, Role};
use crate::solver::{LossName, Solution, Watch};

/// What a controller takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Deployment {
    /// The offset of each joint, and nothing else.
    Offsets,
    /// Every number of every link.
    Dh,
    /// Links and the errors of the joints: own compensation.
    Full,
}

impl Deployment {
    /// Those that leave something out.
    pub const PARTIAL: [Self; 2] = [Self::Offsets, Self::Dh];

    fn leaves_out(self, id: ParameterId) -> bool {
        match id {
            ParameterId::Robot { parameter, .. } => {
                self == Self::Offsets && parameter != LinkParameter::Theta
            }
            _ => id.owner() == Owner::Robot && self != Self::Full,
        }
    }

    /// What the deployment leaves out is nominal in the model and stays there.
    fn restrict(self, model: &mut Model) -> Result<(), ModelError> {
        let nominal = |id: &ParameterId| Some((*id, model.parameter(*id)?.nominal));
        let ids = model.ids().into_iter();
        let left_out: Vec<(ParameterId, f64)> =
            ids.filter(|id| self.leaves_out(*id)).filter_map(|id| nominal(&id)).collect();
        for &(id, value) in &left_out {
            model.set_value(id, value)?;
        }
        model.set_roles(left_out.into_iter().map(|(id, _)| id), Role::Fixed)
    }
}

/// The best fit of what a deployment takes.
#[derive(Debug, Clone)]
pub struct Deployed {
    /// Which.
    pub deployment: Deployment,
    /// Of the first run.
    pub model: Model,
    /// The solve.
    pub solution: Solution,
}

/// The runs, which are at the solution of the full model, solved again for each deployment that leaves something out; without
/// those whose solve does not converge.
///
/// # Errors
/// [`CalibrateError`].
pub(in crate::calibrate) fn deployed(
    runs: &[Run],
    loss: LossName,
    watch: Option<&dyn Watch>,
) -> Result<Vec<Deployed>, CalibrateError> {
    let one = |deployment| {
        let found = fitted(runs, deployment, loss, watch)?;
        let of_first = |Fitted { runs, solution, .. }: Fitted| {
            let model = runs.into_iter().next()?.model;
            Some(Deployed { deployment, model, solution })
        };
        Ok(found.and_then(of_first))
    };
    Deployment::PARTIAL.into_iter().filter_map(|deployment| one(deployment).transpose()).collect()
}

impl BallBarCalibration {
    /// The calibration for a deployment: its best fit to the same samples; none where the solve does not converge.
    ///
    /// # Errors
    /// [`CalibrateError`].
    pub fn deployed(&self, deployment: Deployment, loss: LossName) -> Result<Option<Self>, CalibrateError> {
        let Some(Fitted { runs, columns, solution, sigmas }) =
            fitted(&self.all_runs(), deployment, loss, None)?
        else {
            return Ok(None);
        };
        let mut runs = runs.into_iter();
        let Run { instrument, model } = runs.next().ok_or(CalibrateError::NoRun)?;
        let others = runs.collect();
        Ok(Some(Self { instrument, model, others, columns, solution, sigmas, ..self.clone() }))
    }
}

/// Runs at the best fit of what a deployment takes.
pub(in crate::calibrate) struct Fitted {
    pub(in crate::calibrate) runs: Vec<Run>,
    columns: SharedColumns,
    solution: Solution,
    sigmas: Vec<f64>,
}

/// The runs at the best fit of what a deployment takes; none where the solve does not converge.
///
/// # Errors
/// [`CalibrateError`].
pub(in crate::calibrate) fn fitted(
    runs: &[Run],
    deployment: Deployment,
    loss: LossName,
    watch: Option<&dyn Watch>,
) -> Result<Option<Fitted>, CalibrateError> {
    let mut runs = runs.to_vec();
    runs.iter_mut().try_for_each(|run| deployment.restrict(&mut run.model))?;
    match refit(&mut runs, loss, watch) {
        Ok((columns, solution, sigmas)) => Ok(Some(Fitted { runs, columns, solution, sigmas })),
        Err(CalibrateError::NotConverged(_)) => Ok(None),
        Err(error) => Err(error),
    }
}
