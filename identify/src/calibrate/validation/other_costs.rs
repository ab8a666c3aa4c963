//! The same runs by the other costs that their encoders allow: what each would have said of the robot.

use crate::calibrate::ball_bar::{BallBarCalibration, CalibrateError, solve};
use crate::calibrate::config::{CostName, IdentifyConfig};
use crate::calibrate::pipeline::Solved;
use crate::instrument::{Instrument, Run};
use crate::model::{Group, Model, ModelError, ParameterId, Role, TermGroup};
use crate::solver::{SolveError, Watch};
use crate::threads::each;

/// Samples of all runs that are looked at, at most: more would not change what the costs differ in.
const SAMPLES_MAX: usize = 3000;

/// What another cost says.
#[derive(Debug)]
pub struct OtherCost {
    /// Which.
    pub cost: CostName,
    /// The first run's parameters at its solution, and the solve of all runs; or why there is none.
    pub found: Result<(Model, Solved), CalibrateError>,
}

/// Solves the runs of a calibration by every other cost, from nominal links, with the same selection and the same terms of
/// the axes as far as the cost determines them. What it does not determine stays nominal; clocks stay as calibrated.
///
/// # Errors
/// [`CalibrateError`] where `watch` ended it; a cost without solution is an entry of the answer.
pub fn other_costs(
    calibration: &BallBarCalibration,
    config: &IdentifyConfig,
    watch: Option<&dyn Watch>,
) -> Result<Vec<OtherCost>, CalibrateError> {
    let measured = calibration.measured();
    let allowed = |cost: &CostName| cost.encoders().iter().all(|&joint| measured[joint]);
    let mut runs = calibration.thinned(SAMPLES_MAX);
    runs.iter_mut().try_for_each(|run| at_nominal(&mut run.model))?;
    let others = CostName::ALL.into_iter().filter(|cost| *cost != calibration.cost).filter(allowed);
    let others: Vec<CostName> = others.collect();
    let by_cost = |number: usize| {
        let cost = others[number];
        let mut runs: Vec<Run> = runs.clone();
        for run in &mut runs {
            if let Instrument::BallBar(bar) = &mut run.instrument {
                bar.cost = cost;
            }
        }
        let solved = solve(&mut runs, &same_terms(calibration, config, cost), watch);
        let found = match solved {
            Err(error @ CalibrateError::Solve(SolveError::Cancelled { .. })) => return Err(error),
            Err(error) => Err(error),
            Ok(solved) => Ok((runs.swap_remove(0).model, solved)),
        };
        Ok(OtherCost { cost, found })
    };
    each(others.len(), by_cost).into_iter().collect()
}

/// Links and terms at their nominal values; where the bar stands, its encoders' offsets and the clocks stay: from there
/// every cost finds its own.
fn at_nominal(model: &mut Model) -> Result<(), ModelError> {
    let leans = |id| matches!(id, ParameterId::BaseRotation { .. });
    let found = |id: ParameterId| matches!(id.group(), Group::Placement | Group::Clock) && !leans(id);
    let parameters = model.parameters().to_vec();
    for parameter in parameters {
        match parameter.role {
            // A prior is about where the calibration began.
            Role::Prior { value, .. } => model.set_value(parameter.id, value)?,
            _ if !found(parameter.id) => model.set_value(parameter.id, parameter.nominal)?,
            _ => {}
        }
    }
    Ok(())
}

/// The configuration with the terms that the calibration took, none to choose from.
fn same_terms(calibration: &BallBarCalibration, config: &IdentifyConfig, cost: CostName) -> IdentifyConfig {
    let mut config = config.clone();
    let measured = calibration.measured();
    config.joint_terms.candidates.clear();
    config.bar_length_um = 0.0;
    for parameter in calibration.model.columns().filter(|parameter| cost.identifies(&measured, parameter.id))
    {
        let id = parameter.id;
        let of_selection = id.term() == Some(TermGroup::EncoderHarmonics);
        if let Role::Prior { sigma, .. } = parameter.role
            && id.term().is_some()
            && !of_selection
        {
            config.priors.insert(id.to_string(), sigma * id.unit().display_factor());
        }
    }
    config
}
