//! Calibration for deployment: the best geometry for a controller that applies only some of the estimated parameters.
//!
//! Errors of the same axis are correlated: an offset, a ratio, a compliance and a slow gear wave can partly replace each
//! other. If the controller ignores some terms, a geometry that was estimated together with them is therefore not the best
//! one. It can even be worse than the nominal geometry. Therefore there is a separate fit for each deployment, which
//! estimates only the robot parameters that the controller applies.

use serde::{Deserialize, Serialize};

use crate::calibrate::pipeline::{Solved, refit};
use crate::calibrate::rows::widen_for_drifts;
use crate::calibrate::{CalibrateError, Calibration};
use crate::instrument::Run;
use crate::kinematics::Chain;
use crate::model::{Model, ModelError, Owner, ParameterId, Role};
use crate::solver::{LossName, Solution, Watch};

/// The parameters that a controller applies.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Deployment {
    /// The offset of each joint.
    Offsets,
    /// All parameters of all links.
    Dh,
    /// All link parameters and error terms of joints. A program outside the controller applies the error terms.
    Full,
}

impl Deployment {
    /// The deployments that do not apply all parameters.
    pub const PARTIAL: [Self; 2] = [Self::Offsets, Self::Dh];

    /// Whether the controller does not apply this parameter of the robot.
    fn leaves_out(self, id: ParameterId, robot: &Chain) -> bool {
        match id {
            ParameterId::Robot { link, parameter } => {
                self == Self::Offsets && !robot.is_offset(link, parameter)
            }
            _ => id.owner() == Owner::Robot && self != Self::Full,
        }
    }

    /// Sets the parameters that the controller does not apply to their nominal values and fixes them.
    fn restrict(self, model: &mut Model) -> Result<(), ModelError> {
        let robot = model.robot().clone();
        model.reset_to_nominal(|id| self.leaves_out(id, &robot));
        model.set_roles(model.ids().into_iter().filter(|id| self.leaves_out(*id, &robot)), Role::Fixed)
    }
}

/// Result of the fit for one deployment.
#[derive(Debug, Clone)]
pub struct Deployed {
    /// The parameters that the controller applies.
    pub deployment: Deployment,
    /// Model of the first data set at the solution of the fit.
    pub model: Model,
    /// Solution of the fit.
    pub solution: Solution,
}

impl Deployed {
    /// Converts a calibration for this deployment, of which only the model and the solution are kept.
    pub fn new(deployment: Deployment, found: Calibration) -> Self {
        Self { deployment, model: found.model().clone(), solution: found.solved.solution }
    }
}

impl Calibration {
    /// Returns the calibration for a deployment, which is the best fit to the same samples. `None` if the
    /// solve does not converge.
    ///
    /// # Errors
    /// [`CalibrateError`] if the solve fails for another reason.
    pub fn deployed(
        &self,
        deployment: Deployment,
        watch: Option<&dyn Watch>,
    ) -> Result<Option<Self>, CalibrateError> {
        let Some((runs, mut solved)) = fitted(&self.runs, &self.solved, deployment, self.loss, watch)? else {
            return Ok(None);
        };
        widen_for_drifts(&runs, &self.rows, &mut solved)?;
        solved.solution.covariance = self.contradicted.added_to(&solved, &runs[0].model);
        Ok(Some(Self { runs, solved, ..self.clone() }))
    }
}

/// Fits the parameters that a deployment applies. `runs` and `solved` are at the solution with all parameters.
/// `None` if the solve does not converge.
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
