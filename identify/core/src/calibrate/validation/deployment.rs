//! Calibration for deployment: the best geometry for a controller that applies only part of the model.
//!
//! Errors of one axis are correlated: an offset, a ratio, a compliance and a slow gear wave partly replace each other. If only
//! part of the model is applied, a geometry estimated together with the other terms is not the best one, and can be worse than
//! the nominal one. Therefore each deployment has its own fit, of the robot parameters that it applies and no others.

use serde::{Deserialize, Serialize};

use crate::calibrate::pipeline::{Solved, refit};
use crate::calibrate::{CalibrateError, Calibration};
use crate::instrument::Run;
use crate::kinematics::Chain;
use crate::model::{Model, ModelError, Owner, ParameterId, Role};
use crate::solver::{LossName, Solution, Watch};

/// The part of the model that a controller applies.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Deployment {
    /// The offset of each joint only.
    Offsets,
    /// All parameters of all links.
    Dh,
    /// Links and joint errors, with compensation outside the controller.
    Full,
}

impl Deployment {
    /// The deployments that apply only part of the model.
    pub const PARTIAL: [Self; 2] = [Self::Offsets, Self::Dh];

    fn leaves_out(self, id: ParameterId, robot: &Chain) -> bool {
        match id {
            ParameterId::Robot { link, parameter } => {
                self == Self::Offsets && !robot.is_offset(link, parameter)
            }
            _ => id.owner() == Owner::Robot && self != Self::Full,
        }
    }

    /// Sets the parameters that the deployment does not apply to nominal and fixes them.
    fn restrict(self, model: &mut Model) -> Result<(), ModelError> {
        let robot = model.robot().clone();
        model.reset_to_nominal(|id| self.leaves_out(id, &robot));
        model.set_roles(model.ids().into_iter().filter(|id| self.leaves_out(*id, &robot)), Role::Fixed)
    }
}

/// The best fit of the parameters that a deployment applies.
#[derive(Debug, Clone)]
pub struct Deployed {
    /// The part of the model that is applied.
    pub deployment: Deployment,
    /// Model of the first run at the fit.
    pub model: Model,
    /// Solution of the fit.
    pub solution: Solution,
}

impl Deployed {
    /// The fit for a deployment, from its calibration.
    pub fn new(deployment: Deployment, found: Calibration) -> Self {
        Self { deployment, model: found.model().clone(), solution: found.solved.solution }
    }
}

impl Calibration {
    /// The calibration for a deployment: its best fit to the same samples; `None` if the solve does not converge.
    ///
    /// # Errors
    /// [`CalibrateError`] if the solve fails for another reason.
    pub fn deployed(
        &self,
        deployment: Deployment,
        watch: Option<&dyn Watch>,
    ) -> Result<Option<Self>, CalibrateError> {
        let found = fitted(&self.runs, &self.solved, deployment, self.loss, watch)?;
        Ok(found.map(|(runs, mut solved)| {
            solved.solution.covariance = self.contradicted.added_to(&solved, &runs[0].model);
            Self { runs, solved, ..self.clone() }
        }))
    }
}

/// The runs at the best fit of the parameters that a deployment applies, from their solution with all; `None` if the solve does
/// not converge.
///
/// # Errors
/// [`CalibrateError`] if the solve fails for another reason.
pub(in crate::calibrate) fn fitted(
    runs: &[Run],
    solved: &Solved,
    deployment: Deployment,
    loss: LossName,
    watch: Option<&dyn Watch>,
) -> Result<Option<(Vec<Run>, Solved)>, CalibrateError> {
    let mut runs = runs.to_vec();
    runs.iter_mut().try_for_each(|run| deployment.restrict(&mut run.model))?;
    match refit(&mut runs, loss, watch, solved.clone()) {
        Ok(solved) => Ok(Some((runs, solved))),
        Err(CalibrateError::NotConverged(_)) => Ok(None),
        Err(error) => Err(error),
    }
}
