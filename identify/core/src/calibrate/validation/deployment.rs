//! A calibration for what can be applied: the best geometry for a controller that takes only part of the model.
//!
//! Errors of one axis resemble each other: an offset, a ratio, a compliance and a slow wave of a gear partly take each other's
//! place. A geometry that was found beside terms which nobody then applies is not the best one without them, and can be worse
//! than the nominal one. So each deployment has its own fit, of what it takes and nothing else of the robot.

use serde::{Deserialize, Serialize};

use crate::calibrate::pipeline::{Solved, refit};
use crate::calibrate::{CalibrateError, Calibration};
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

impl Deployed {
    /// Of the calibration for a deployment.
    pub fn new(deployment: Deployment, found: Calibration) -> Self {
        Self { deployment, model: found.model().clone(), solution: found.solved.solution }
    }
}

impl Calibration {
    /// The calibration for a deployment: its best fit to the same samples; none where the solve does not converge.
    ///
    /// # Errors
    /// [`CalibrateError`].
    pub fn deployed(
        &self,
        deployment: Deployment,
        watch: Option<&dyn Watch>,
    ) -> Result<Option<Self>, CalibrateError> {
        let found = fitted(&self.runs, deployment, self.loss, watch)?;
        Ok(found.map(|Fitted { runs, columns, solution, sigmas }| {
            let solved = Solved { columns, solution, sigmas, ..self.solved.clone() };
            Self { runs, solved, ..self.clone() }
        }))
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
