//! Any mix of instruments on one robot, in one solve: they share the robot, and each data set counts as much as what its own
//! residuals show it to be worth.

use shared::config::RobotConfig;

use super::IdentifyConfig;
use super::ball_bar::{CalibrateError, RunInput, prepared_runs, solve};
use super::config::SelectionName;
use super::deployment::{Deployed, Deployment, deployed, fitted};
use super::links::{free_links, link_ids};
use super::pipeline::{Plan, Solved, estimate, waves_per_turn};
use super::rows::{self, RowErrors};
use super::split::HoldOut;
use crate::instrument::{
    Contact, ContactError, ContactRow, Instrument, LengthRow, Measures, PoseRow, Run, SocketTable, Standing,
    Tracker, Wire,
};
use crate::kinematics::{Chain, Joints, flange_chain};
use crate::model::{DriveTrain, Model, ModelError, ParameterId, Role};
use crate::solver::{LossName, Watch};

/// Decides which groups of rows come together where nobody says so.
pub const SEED: u64 = 1;

/// What was measured on one robot.
#[derive(Debug, Clone, Default)]
pub struct DataSets<'a> {
    /// Runs with the ball-bar.
    pub bars: Vec<RunInput<'a>>,
    /// Files of other instruments.
    pub rows: Vec<Rows>,
}

/// Rows of one set-up, in the order in which the robot went there.
#[derive(Debug, Clone)]
pub struct Rows {
    /// What was measured.
    pub measured: Measured,
    /// Which are left out together; none: as is usual for the instrument.
    pub hold_out: Option<HoldOut>,
    /// Decides which groups come together.
    pub seed: Option<u64>,
}

/// What an instrument measured at poses at which the robot stood still.
#[derive(Debug, Clone)]
pub enum Measured {
    /// A tracker.
    Poses(Vec<PoseRow>),
    /// A draw-wire or a telescoping bar.
    Lengths(Vec<LengthRow>),
    /// A ball in sockets, with what is known of these.
    Contacts(Vec<ContactRow>, SocketTable),
}

impl From<Measured> for Rows {
    fn from(measured: Measured) -> Self {
        Self { measured, hold_out: None, seed: None }
    }
}

impl Rows {
    /// What is left out together: regions where there are poses, parts of the file where lengths, single rows of a ball in
    /// sockets, unless somebody says so.
    pub fn hold_out(&self) -> HoldOut {
        self.hold_out.unwrap_or(match self.measured {
            Measured::Poses(_) => HoldOut::Regions,
            Measured::Lengths(_) => HoldOut::Blocks,
            Measured::Contacts(..) => HoldOut::Rows,
        })
    }

    /// Decides which groups come together.
    pub fn seed(&self) -> u64 {
        self.seed.unwrap_or(SEED)
    }

    /// Joints of each row.
    pub fn joints(&self) -> Vec<Joints> {
        match &self.measured {
            Measured::Poses(rows) => rows.iter().map(|row| row.joints_rad).collect(),
            Measured::Lengths(rows) => rows.iter().map(|row| row.joints_rad).collect(),
            Measured::Contacts(rows, _) => rows.iter().map(|row| row.joints_rad).collect(),
        }
    }

    /// The instrument with the nominal robot.
    fn at_nominal(&self, robot: &Chain) -> Result<(Instrument, Model), ContactError> {
        Ok(match &self.measured {
            Measured::Poses(rows) => {
                let tracker = Tracker::new(self.standing(rows, |row| row.joints_rad, robot));
                (Instrument::Tracker(tracker), Model::measured_pose(robot))
            }
            Measured::Lengths(rows) => {
                let wire = Wire::new(self.standing(rows, |row| row.joints_rad, robot));
                (Instrument::Wire(wire), Model::measured_length(robot))
            }
            Measured::Contacts(rows, table) => {
                let contact = Contact::new(self.standing(rows, |row| row.joints_rad, robot), table)?;
                let model = Model::contact(robot, contact.sockets().names().len());
                (Instrument::Contact(contact), model)
            }
        })
    }

    fn standing<R: Copy>(&self, rows: &[R], joints: impl Fn(&R) -> Joints, robot: &Chain) -> Standing<R> {
        Standing::of_file(rows, joints, robot, self.hold_out(), self.seed())
    }
}

/// A robot calibrated from a mix.
#[derive(Debug, Clone)]
pub struct MixedCalibration {
    /// Data sets with their parameters at the solution: runs with the ball-bar, then files of rows, each in their order.
    pub runs: Vec<Run>,
    /// The solve of all.
    pub solved: Solved,
    /// The best geometry for who applies less than that.
    pub deployed: Vec<Deployed>,
}

/// Options of the ball-bar alone that a mix cannot follow.
///
/// # Errors
/// [`CalibrateError::Mixed`] names one that was given.
fn check(config: &IdentifyConfig) -> Result<(), CalibrateError> {
    let given = [
        ("selection", config.selection != SelectionName::default()),
        ("free", !config.free.is_empty()),
        ("priors", !config.priors.is_empty()),
        ("ransac", config.ransac),
    ];
    match given.into_iter().find(|(_, given)| *given) {
        Some((option, _)) => Err(CalibrateError::Mixed { option }),
        None => Ok(()),
    }
}

/// Data sets with their models at the nominal robot, what is free in them, and how they are solved.
fn laid_out<'w>(
    data: &DataSets<'_>,
    robot: &RobotConfig,
    config: &IdentifyConfig,
    watch: Option<&'w dyn Watch>,
) -> Result<(Vec<Run>, Plan<'w>), CalibrateError> {
    check(config)?;
    let fix = config.fix.iter().map(|name| name.parse()).collect::<Result<Vec<ParameterId>, ModelError>>()?;
    let flange = flange_chain(robot);
    let mut runs = prepared_runs(&data.bars, robot, config)?;
    for Run { instrument, model } in &mut runs {
        let named = IdentifyConfig { fix: Vec::new(), ..config.clone() };
        named.set_roles(model, &[], |id| instrument.identifies(id))?;
        if let Some(force) = instrument.bar().and_then(|bar| bar.prepared.force.as_ref()) {
            config.free_for_force(model, force.parameter())?;
        }
    }
    let bars = runs.len();
    for (number, rows) in data.rows.iter().enumerate() {
        let of_set = rows.at_nominal(&flange);
        let (instrument, model) =
            of_set.map_err(|error| CalibrateError::Contact { data_set: bars + number + 1, error })?;
        runs.push(Run { instrument, model: model.with_drives(DriveTrain::of(robot, &flange)) });
    }
    for (number, Run { instrument, model }) in runs.iter_mut().enumerate() {
        if !instrument.place(model, &fix)? {
            return Err(CalibrateError::NoPlace { data_set: number + 1 });
        }
        free_robot(model, &flange, &fix, config.tolerance_mm_mrad * 1e-3)?;
    }
    known_somewhere(&runs, &fix)?;
    let kinds = if bars > 0 {
        let Run { instrument, model } = &runs[0];
        config.kinds(model, |id| instrument.identifies(id))
    } else {
        let measured =
            |run: &Run| Ok(run.instrument.samples() * run.instrument.data_set(&run.model, 1.0)?.rows());
        let measured = runs.iter().map(measured).sum::<Result<_, CalibrateError>>()?;
        let last = waves_per_turn(measured, flange.links.len());
        for run in &mut runs {
            run.model = run.model.clone().with_joint_waves(ParameterId::joint_waves(last));
        }
        let known = |id: &ParameterId| runs.iter().any(|run| run.model.parameter(*id).is_some());
        rows::kinds(last, |id| known(id) && !fix.contains(id))
    };
    let plan = Plan {
        loss: config.loss.unwrap_or(LossName::Huber),
        ransac: false,
        kinds,
        fix,
        tolerances: link_ids(&flange),
        prepare: config.prepare.clone(),
        watch,
    };
    Ok((runs, plan))
}

/// Estimates the robot from all data sets together, each number of its links expected at nominal within the configured
/// tolerance, which is scaled until left-out groups of samples are predicted best; runs with the ball-bar alone as
/// [`super::ball_bar::calibrate_runs`] does. `watch` sees each solve and may end it.
///
/// # Errors
/// [`CalibrateError`].
pub fn calibrate(
    data: &DataSets<'_>,
    robot: &RobotConfig,
    config: &IdentifyConfig,
    watch: Option<&dyn Watch>,
) -> Result<MixedCalibration, CalibrateError> {
    if data.rows.is_empty() {
        let mut runs = prepared_runs(&data.bars, robot, config)?;
        let solved = solve(&mut runs, config, watch)?;
        return Ok(MixedCalibration { runs, solved, deployed: Vec::new() });
    }
    let (mut runs, plan) = laid_out(data, robot, config, watch)?;
    let solved = estimate(&mut runs, &plan)?;
    if let Some(found) = rows::of_mix(&runs, &flange_chain(robot)) {
        return Err(CalibrateError::Implausible { found });
    }
    let deployed = deployed(&runs, plan.loss)?;
    Ok(MixedCalibration { runs, solved, deployed })
}

/// Rows of trackers, wires and contacts as predicted by a solve of everything but a fifth of each file's, for each data set in their
/// order; of runs with the ball-bar, which are whole in that solve, nothing.
///
/// # Errors
/// [`CalibrateError`].
pub fn held_out(
    data: &DataSets<'_>,
    robot: &RobotConfig,
    config: &IdentifyConfig,
    watch: Option<&dyn Watch>,
) -> Result<Vec<RowErrors>, CalibrateError> {
    const PARTS: usize = 5;
    let (mut runs, plan) = laid_out(data, robot, config, watch)?;
    let (mut all, mut errors) = (Vec::new(), Vec::new());
    for run in &mut runs {
        let whole = run.instrument.clone();
        let mut of_run = RowErrors::default();
        if whole.bar().is_none() {
            of_run.held_out = whole.independent(PARTS).into_iter().next().unwrap_or_default();
            of_run.held_out.sort_unstable();
            of_run.fitted = (0..whole.samples())
                .filter(|sample| of_run.held_out.binary_search(sample).is_err())
                .collect();
            run.instrument = whole.part(&of_run.fitted);
            let mut nominal = Run { instrument: whole.clone(), model: run.model.clone() };
            nominal.model.set_roles(link_ids(&flange_chain(robot)), Role::Fixed)?;
            if nominal.model.columns().len() > 0 {
                estimate(std::slice::from_mut(&mut nominal), &Plan::new(LossName::Huber, Vec::new()))?;
            }
            of_run.stages[0] = whole.errors(&nominal.model.geometry(&[]));
        }
        all.push(whole);
        errors.push(of_run);
    }
    let solved = estimate(&mut runs, &plan)?;
    let offsets = fitted(&runs, Deployment::Offsets, plan.loss)?.map_or_else(Vec::new, |found| found.runs);
    for ((whole, of_run), run) in all.iter().zip(&mut errors).zip(&offsets) {
        of_run.stages[1] = whole.errors(&run.model.geometry(&[]));
    }
    let models = solved.without_terms.iter().zip(&runs);
    for ((whole, of_run), (links, run)) in all.iter_mut().zip(&mut errors).zip(models) {
        of_run.stages[2] = whole.errors(&links.geometry(&[]));
        of_run.stages[3] = whole.errors(&run.model.geometry(&[]));
        // A ball in another socket than its row says is no measurement that anything could predict.
        if let Instrument::Contact(contact) = whole {
            contact.screen(&run.model);
            let belongs = |row: &usize| contact.rejected().iter().all(|rejected| rejected.row != *row);
            of_run.fitted.retain(belongs);
            of_run.held_out.retain(belongs);
        }
    }
    Ok(errors)
}

/// The same numbers of the robot's links are free in every model; those of the last one belong to what is mounted there.
fn free_robot(model: &mut Model, flange: &Chain, fix: &[ParameterId], sigma: f64) -> Result<(), ModelError> {
    let last = flange.links.len().saturating_sub(1);
    let all: Vec<ParameterId> = model.parameters().iter().map(|parameter| parameter.id).collect();
    let of_links = |id: &ParameterId| matches!(id, ParameterId::Robot { link, .. } if *link < last);
    model.set_roles(all.into_iter().filter(|id| of_links(id) || fix.contains(id)), Role::Fixed)?;
    free_links(model, &link_ids(flange), fix, [sigma, sigma], sigma)
}

/// Every parameter that is fixed by name belongs to some data set.
fn known_somewhere(runs: &[Run], fix: &[ParameterId]) -> Result<(), ModelError> {
    let is_known = |id: &ParameterId| {
        matches!(id, ParameterId::JointWave { .. })
            || runs.iter().any(|run| run.model.parameter(*id).is_some())
    };
    fix.iter().find(|id| !is_known(id)).map_or(Ok(()), |id| Err(ModelError::NotInModel { id: *id }))
}
