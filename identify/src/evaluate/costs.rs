//! The cost functions side by side: what each identifies on the same runs, and where it leads the robot.

use super::accuracy::workspace::{Expected, distance_m, workspace_error};
use crate::calibrate::CostName;
use crate::calibrate::ball_bar::BallBarCalibration;
use crate::calibrate::validation::other_costs::OtherCost;
use crate::model::{Model, ParameterId, Unit};
use crate::solver::{Solution, Summary};
use crate::threads::each;

/// What one cost gives.
#[derive(Debug, Clone, PartialEq)]
pub struct CostFigures {
    /// Free parameters, all of them identified.
    pub parameters: usize,
    /// Directions that the samples determine without priors.
    pub rank_of_samples: usize,
    /// Condition number of the column-scaled Jacobian.
    pub condition: f64,
    /// How the solve went; residuals in the cost's own unit.
    pub summary: Summary,
    /// Correction and sigma of each of [`CostComparison::names`], SI; none where the cost leaves it nominal.
    pub robot: Vec<Option<(f64, f64)>>,
    /// Parameters that the calibration identifies and this cost does not.
    pub not_determined: Vec<String>,
    /// Euclidean norm of the differences to the calibration, over the robot's parameters that both identify \[mm|mrad\].
    pub difference_mm_mrad: f64,
    /// Euclidean norm of the sigmas of the robot's parameters \[mm|mrad\].
    pub sigma_mm_mrad: f64,
    /// Sigmas on either side of a parameter that hold 95 %.
    pub sigmas_of_95: f64,
    /// Mean distance of this robot's positions from the calibrated robot's, over the workspace \[m\].
    pub from_calibrated_m: f64,
    /// Expected position error over the workspace.
    pub expected: Expected,
}

/// One cost: its figures, or why there are none.
#[derive(Debug, Clone, PartialEq)]
pub struct CostEntry {
    /// Which.
    pub cost: CostName,
    /// What it gives, or what a person is told instead.
    pub figures: Result<CostFigures, String>,
}

/// All costs that the encoders allow, the calibration's own first.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CostComparison {
    /// The robot's parameters that any of the costs identifies, and their units.
    pub names: Vec<(String, Unit)>,
    /// By cost.
    pub entries: Vec<CostEntry>,
}

/// Sets the calibration beside what the other costs say.
pub fn compare_costs(
    calibration: &BallBarCalibration,
    others: &[OtherCost],
    joint_limits: &[[f64; 2]],
) -> CostComparison {
    let found = others.iter().filter_map(|other| other.found.as_ref().ok());
    let models: Vec<&Model> =
        std::iter::once(&calibration.model).chain(found.map(|(model, _)| model)).collect();
    let named = |id: &ParameterId| {
        matches!(id, ParameterId::Robot { .. }) && models.iter().any(|model| model.column_of(*id).is_some())
    };
    let ids = calibration.model.ids().into_iter();
    let ids: Vec<ParameterId> = ids.filter(named).collect();
    let own = (calibration.cost, Ok((&calibration.model, &calibration.solution)));
    let of_others = others.iter().map(|other| {
        let found = other.found.as_ref().map(|(model, solved)| (model, &solved.solution));
        (other.cost, found.map_err(ToString::to_string))
    });
    let all: Vec<_> = std::iter::once(own).chain(of_others).collect();
    let entries = each(all.len(), |number| {
        let (cost, found) = &all[number];
        let figures = |&(model, solution): &_| figures(calibration, &ids, model, solution, joint_limits);
        CostEntry { cost: *cost, figures: found.as_ref().map(figures).map_err(Clone::clone) }
    });
    CostComparison { names: ids.iter().map(|id| (id.to_string(), id.unit())).collect(), entries }
}

fn figures(
    calibration: &BallBarCalibration,
    ids: &[ParameterId],
    model: &Model,
    solution: &Solution,
    joint_limits: &[[f64; 2]],
) -> CostFigures {
    let found = |id: ParameterId| {
        let sigma = solution.covariance.sigma(model.column_of(id)?)?;
        let parameter = model.parameter(id)?;
        Some((parameter.value - parameter.nominal, sigma))
    };
    let reference = |id: ParameterId| {
        let parameter = calibration.model.parameter(id).filter(|parameter| parameter.role.is_estimated())?;
        Some(parameter.value - parameter.nominal)
    };
    let robot: Vec<Option<(f64, f64)>> = ids.iter().map(|id| found(*id)).collect();
    let shown = |of: &dyn Fn(ParameterId, (f64, f64)) -> Option<f64>| {
        let squares = ids
            .iter()
            .zip(&robot)
            .filter_map(|(id, one)| Some((of(*id, (*one)?)? * id.unit().display_factor()).powi(2)));
        squares.sum::<f64>().sqrt()
    };
    let not_determined =
        calibration.model.columns().filter(|parameter| model.column_of(parameter.id).is_none());
    CostFigures {
        parameters: solution.identifiability.names.len(),
        rank_of_samples: solution.identifiability.rank_of_samples,
        condition: solution.identifiability.weakest().recip(),
        summary: solution.summary,
        not_determined: not_determined.map(|parameter| parameter.id.to_string()).collect(),
        difference_mm_mrad: shown(&|id, (correction, _)| Some(correction - reference(id)?)),
        sigma_mm_mrad: shown(&|_, (_, sigma)| Some(sigma)),
        from_calibrated_m: distance_m(model, &calibration.model, joint_limits),
        expected: workspace_error(model, &solution.covariance, joint_limits).after,
        sigmas_of_95: solution.covariance.sigmas_from.sigmas_of_95(),
        robot,
    }
}
