//! Calibration from poses with a position or a whole pose measured at each: a tracker and its probe on the flange.
//!
//! Unknown are the place of the tracker, the mounting of the probe, the robot's links, with priors from tolerances, and the
//! errors of its joints, each kind only if fitting rows left out are predicted better with it. Held-out rows take no part in
//! any of this; the figures on them are what counts.

mod error;
mod figures;
mod implausible;
mod terms;
mod validate;

use super::ball_bar::CalibrateError;
use super::links::{TOLERANCE, free_links, link_ids};
use super::pipeline::{Plan, Solved, estimate};
use super::split::{self, HoldOut, Split};
use super::terms::Candidate;
use crate::cost::PoseNoise;
use crate::instrument::{Instrument, Measures, PoseRow, Run, Standing, Tracker, standing};
use crate::kinematics::Chain;
use crate::model::{Model, ModelError, ParameterId};
use crate::solver::{LossName, Solution};

pub use error::PoseError;
pub use figures::{PoseFigures, RowErrors, Sizes, Stages};
pub use implausible::{Likely, Mistake, Step, likely, misfit};
pub(super) use terms::kinds;
pub use validate::validate;

/// Highest order of the joints' waves that is tried as a rule: there is no finer tooth near the output of a strain wave gear.
pub const WAVES_PER_TURN_MAX: u8 = 64;

/// How the calibration is done.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseOptions {
    /// What is held out together, from the figures and from each fold of the choice of joint errors.
    pub hold_out: HoldOut,
    /// Part of the rows that the fit never sees.
    pub held_out: f64,
    /// Decides which.
    pub seed: u64,
    /// How much rows count that do not fit.
    pub loss: LossName,
    /// Prior of the links' lengths around nominal, one standard deviation \[m\].
    pub link_sigma_m: f64,
    /// Prior of the links' angles around nominal, one standard deviation \[rad\].
    pub link_sigma_rad: f64,
    /// Highest order of the joints' waves that is tried.
    pub waves_per_turn_max: u8,
    /// Joint errors may be taken.
    pub joint_errors: bool,
    /// Parameters that stay where they start: links at nominal, the probe on the flange, no joint error.
    pub fix: Vec<ParameterId>,
}

impl Default for PoseOptions {
    fn default() -> Self {
        Self {
            hold_out: HoldOut::default(),
            held_out: 0.2,
            seed: 1,
            loss: LossName::Huber,
            link_sigma_m: 1e-2,
            link_sigma_rad: 2e-2,
            waves_per_turn_max: WAVES_PER_TURN_MAX,
            joint_errors: true,
            fix: Vec::new(),
        }
    }
}

/// Fewest rows of a fit: as many numbers as tracker, probe and links together, twice.
const ROWS_MIN: usize = 20;

fn check(rows: &[PoseRow], options: &PoseOptions) -> Result<(), PoseError> {
    check_rows(rows)?;
    for (option, value) in
        [("link_sigma_m", options.link_sigma_m), ("link_sigma_rad", options.link_sigma_rad)]
    {
        if !(value.is_finite() && value > 0.0) {
            return Err(PoseError::BadOption { option, value, remedy: "give a number above zero" });
        }
    }
    if !(0.0..0.9).contains(&options.held_out) {
        let (option, value) = ("held_out", options.held_out);
        return Err(PoseError::BadOption { option, value, remedy: "give a part from 0 to below 0.9" });
    }
    Ok(())
}

fn check_rows(rows: &[PoseRow]) -> Result<(), PoseError> {
    for (index, row) in rows.iter().enumerate() {
        let rotation = row.rotation.iter().flat_map(|rotation| rotation.matrix().iter());
        let mut numbers = row.joints_rad.iter().chain(row.position_m.iter()).chain(rotation);
        if !numbers.all(|number| number.is_finite()) {
            return Err(PoseError::BadRow { row: index + 1 });
        }
    }
    Ok(())
}

/// Outcome of a calibration by measured poses.
#[derive(Debug, Clone)]
pub struct PoseReport {
    /// Name of the cost: positions alone or whole poses.
    pub cost: &'static str,
    /// Rows that the fit saw.
    pub fitted: Stages,
    /// Rows that it did not see.
    pub held_out: Stages,
    /// Each row.
    pub errors: RowErrors,
    /// Kinds of joint errors, taken or not.
    pub terms: Vec<Candidate>,
    /// Standard deviations that the last solve assumed, from the spread of the residuals.
    pub noise: PoseNoise,
    /// The last solve.
    pub solution: Solution,
    /// The calibrated model.
    pub model: Model,
}

impl PoseReport {
    /// Standard deviation of a parameter, SI; none where it was fixed.
    pub fn sigma(&self, id: ParameterId) -> Option<f64> {
        self.solution.covariance.sigma(self.model.column_of(id)?)
    }
}

/// The model with tracker and probe where they are for its robot, which stays.
fn placed(tracker: &Tracker, mut model: Model, fix: &[ParameterId]) -> Result<Model, PoseError> {
    if !tracker.place(&mut model, fix)? {
        return Err(PoseError::PosesOnALine);
    }
    let mut runs = [Run { instrument: Instrument::Tracker(tracker.clone()), model }];
    estimate(&mut runs, &Plan::new(LossName::Huber, Vec::new()))?;
    let [Run { model, .. }] = runs;
    Ok(model)
}

/// Calibrates a robot from poses measured by a tracker; rows in the order in which the robot went there.
///
/// `robot` is the nominal chain to the flange.
///
/// # Errors
/// [`PoseError`] for rows, options or geometry that allow no calibration.
pub fn calibrate(rows: &[PoseRow], robot: &Chain, options: &PoseOptions) -> Result<PoseReport, PoseError> {
    check(rows, options)?;
    let joints = || rows.iter().map(|row| row.joints_rad);
    let (groups, states) = (options.hold_out.groups(robot, joints()), standing(joints()));
    let Split { fitting, held_out } = split::split(&groups, options.held_out, options.seed);
    if fitting.len() < ROWS_MIN {
        return Err(PoseError::TooFewRows { rows: fitting.len(), needed: ROWS_MIN });
    }
    let mut model = Model::measured_pose(robot);
    let with_waves = model.clone().with_joint_waves(ParameterId::joint_waves(options.waves_per_turn_max));
    if let Some(&id) = options.fix.iter().find(|id| with_waves.parameter(**id).is_none()) {
        return Err(ModelError::NotInModel { id }.into());
    }
    let all = Tracker::new(Standing::new(rows, &states, &groups, options.seed));
    let chosen = all.chosen(&fitting);
    let placed = placed(&chosen, model, &options.fix);
    model = placed.map_err(|error| explained(error, rows, robot))?;
    let nominal = all.apart(&model.geometry(&[]));
    let nominal_step = implausible::step(&all, &model);
    let sigmas = [options.link_sigma_m, options.link_sigma_rad];
    free_links(&mut model, &link_ids(robot), &options.fix, sigmas, TOLERANCE)?;
    let kinds = if options.joint_errors {
        model = model.with_joint_waves(ParameterId::joint_waves(options.waves_per_turn_max));
        terms::kinds(options.waves_per_turn_max, |id| {
            with_waves.parameter(*id).is_some() && !options.fix.contains(id)
        })
    } else {
        Vec::new()
    };
    let mut runs = [Run { instrument: Instrument::Tracker(chosen), model }];
    let estimated = estimate(&mut runs, &Plan::new(options.loss, kinds));
    let Solved { solution, without_terms, candidates, .. } =
        estimated.map_err(|error| explained(error.into(), rows, robot))?;
    let [Run { instrument, model }] = runs;
    let Instrument::Tracker(tracker) = instrument else { return Err(CalibrateError::NoRun.into()) };
    let links = without_terms.first().map_or_else(Vec::new, |model| all.apart(&model.geometry(&[])));
    let joints = all.apart(&model.geometry(&[]));
    let steps = [implausible::step(&all, &model), nominal_step];
    let errors = RowErrors { stages: [nominal, links, joints], fitted: fitting, held_out };
    let report = PoseReport {
        cost: tracker.cost(),
        fitted: errors.of(&errors.fitted),
        held_out: errors.of(&errors.held_out),
        errors,
        terms: candidates,
        noise: tracker.noise,
        solution,
        model,
    };
    let reasons = implausible::reasons(&report, steps, rows, robot, options);
    if reasons.is_empty() {
        return Ok(report);
    }
    let found = reasons.iter().map(ToString::to_string).collect::<Vec<_>>().join("; ");
    Err(PoseError::Implausible { found, likely: implausible::likely_of_all(rows, robot) })
}

/// A solve that failed, with the mistake that explains it, where one does.
fn explained(error: PoseError, rows: &[PoseRow], robot: &Chain) -> PoseError {
    let PoseError::Calibrate(error) = error else { return error };
    match implausible::likely_of_all(rows, robot) {
        Some(likely) => PoseError::Implausible { found: error.to_string(), likely: Some(likely) },
        None => error.into(),
    }
}
