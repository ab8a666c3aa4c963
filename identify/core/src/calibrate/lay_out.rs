//! Prepares a calibration. Input: data sets, nominal robot and configuration. Output: the model of each data set and the
//! plan of the solve ([`LaidOut`]).
//!
//! Each model starts at the nominal robot. The configuration sets the roles of its parameters (free, fixed, prior). The
//! start value of the instrument's pose comes from the preparation of a ball-bar run, or from a fit to the rows of a file.

use std::collections::BTreeSet;

use shared::config::{BallBarConfig, RobotConfig};

use super::config::{IdentifyConfig, SelectionName};
use super::data_sets::{BarRun, DataSets};
use super::error::CalibrateError;
use super::pipeline::{Plan, estimate, residual_unit_of};
use super::rows::{self, RowSet};
use super::selection::candidates::candidate_groups;
use super::selection::choose::CommonPrior;
use super::selection::structure::identifiable;
use crate::instrument::{BallBar, CostName, Run, ScaleFrom};
use crate::kinematics::{BAR_JOINTS, Chain, LinkParameter, ball_bar_chain, flange_chain, robot_chain};
use crate::model::{Axis, DriveTrain, Group, Model, ModelError, Parameter, ParameterId, Role, Unit};
use crate::prepare::Prepared;
use crate::solver::{LossName, Watch};

/// Data sets with their models at the nominal robot, and the plan of the solve.
pub(super) struct LaidOut<'w> {
    /// Ball-bar runs, followed by the files of rows. A run of a file contains only the rows that the fit uses.
    pub(super) runs: Vec<Run>,
    pub(super) rows: Vec<RowSet>,
    pub(super) plan: Plan<'w>,
}

/// Creates the models of all data sets. If `held_out` is true, a fifth of each file of rows is not used by the fit.
///
/// # Errors
/// [`CalibrateError`] if names, data or positions of instruments are not consistent with the robot.
pub(super) fn lay_out<'w>(
    data: &DataSets<'_>,
    robot: &RobotConfig,
    config: &IdentifyConfig,
    held_out: bool,
    watch: Option<&'w dyn Watch>,
) -> Result<LaidOut<'w>, CalibrateError> {
    let flange = flange_chain(robot);
    let mut runs = bar_runs(&data.bars, robot, config)?;
    // For each file of rows: check the rows, hold some out, and estimate the pose of the instrument with the nominal robot.
    let mut sets = Vec::new();
    let is_only_file = data.bars.is_empty() && data.rows.len() == 1;
    for file in &data.rows {
        let data_set = runs.len() + 1;
        let contradicting = rows::checked(&file.instrument, is_only_file, &flange)
            .map_err(|error| CalibrateError::Rows { data_set, error })?;
        let set = RowSet::new(file.grouped(&flange), contradicting, held_out);
        let model = file.instrument.fitted_out(Model::alone(&flange));
        let model = model.with_drives(DriveTrain::from_robot(robot, &flange)).with(config.named());
        let mut run = Run { instrument: set.fitting(), model };
        place_instrument(&mut run, &set, data_set, config, watch, &flange)?;
        runs.push(run);
        sets.push(set);
    }
    // Record the errors of the nominal robot before the link parameters are free.
    for (set, Run { model, .. }) in sets.iter_mut().zip(&mut runs[data.bars.len()..]) {
        set.judge_nominal(model)?;
        config.set_link_roles(model)?;
    }
    // If no instrument measures a known length, the scale of the robot and of the distances between faces is undetermined.
    // In this case fix the longest link length. The covariance still includes the tolerance of this length.
    if !runs.is_empty() && runs.iter().all(|run| run.instrument.scale() == ScaleFrom::Robot) {
        let longest = longest_length(&runs[0].model);
        for Run { model, .. } in &mut runs {
            longest.iter().try_for_each(|id| config.consider(model, *id))?;
        }
    }
    config.require_known(runs.iter().map(|run| &run.model))?;
    let groups = candidate_groups(data, &mut runs, config)?;
    let tolerances = tolerances(&runs, config);
    let plan = Plan {
        loss: config.loss.unwrap_or(residual_unit_of(&runs).map_or(LossName::Huber, CostName::usual_loss)),
        groups,
        fix: config.fix.clone(),
        common: common_priors(&runs, &tolerances, config),
        tolerances,
        watch,
    };
    Ok(LaidOut { runs, rows: sets, plan })
}

/// Estimates the pose of an instrument from its rows, with the nominal robot.
fn place_instrument(
    run: &mut Run,
    set: &RowSet,
    data_set: usize,
    config: &IdentifyConfig,
    watch: Option<&dyn Watch>,
    flange: &Chain,
) -> Result<(), CalibrateError> {
    if !run.instrument.place(&mut run.model, &config.fix)? {
        return Err(CalibrateError::NoPlace { data_set });
    }
    // Fix the scale during this fit, because errors of the nominal robot would bias it. The later fit also estimates the
    // robot and therefore separates the scale from these errors.
    let scale = run.model.role(ParameterId::Scale);
    if scale.is_some() {
        run.model.set_role(ParameterId::Scale, Role::Fixed)?;
    }
    if run.model.columns().len() > 0 {
        let plan = Plan { watch, ..Plan::new(LossName::Huber) };
        let placed = estimate(std::slice::from_mut(run), &plan);
        // If lengths have a wrong unit, this fit may fail. An error that names the wrong unit is more useful than the error
        // of the failed fit, so check the unit first.
        rows::unless_other_unit(set.whole(), &run.model, flange)?;
        placed?;
    }
    if let Some(role) = scale {
        run.model.set_role(ParameterId::Scale, role)?;
    }
    Ok(())
}

/// The longest link length of the robot that is estimated.
fn longest_length(model: &Model) -> Option<ParameterId> {
    let is_length = |parameter: &&Parameter| {
        let id = parameter.id;
        matches!(id, ParameterId::Robot { .. }) && id.unit() == Unit::Metre && parameter.role.is_estimated()
    };
    let lengths = model.parameters().iter().filter(is_length);
    let longest = lengths.max_by(|a, b| a.nominal.abs().total_cmp(&b.nominal.abs()))?;
    Some(longest.id)
}

/// Bar joints that have an encoder in all runs.
pub(super) fn measured<'p>(runs: impl Iterator<Item = &'p Prepared>) -> [bool; BAR_JOINTS] {
    runs.fold([true; BAR_JOINTS], |all, run| std::array::from_fn(|joint| all[joint] && run.measured[joint]))
}

/// Creates the ball-bar runs. Sets the initial values of their parameters from the preparation, and the
/// roles of the parameters.
fn bar_runs(
    bars: &[BarRun<'_>],
    robot: &RobotConfig,
    config: &IdentifyConfig,
) -> Result<Vec<Run>, CalibrateError> {
    let measured = measured(bars.iter().map(|run| &run.prepared));
    let cost = config.cost.unwrap_or_else(|| CostName::for_encoders(&measured));
    let start_run = |BarRun { prepared, bar }: &BarRun<'_>| {
        // There are hundreds of possible waves. The model starts with the waves that the configuration names. Waves that are
        // detected in residuals are added later.
        let named = config.named().filter(|id| matches!(id, ParameterId::JointWave { .. }));
        let model = start_model(prepared, robot, bar)?.with(named);
        let sigmas_m = config.known_length_sigmas_m(bar, model.axes());
        let prepared = prepared.clone();
        let bar = BallBar { prepared, cost, configured: config.noise, estimated: None, measured, sigmas_m };
        Ok(Run { instrument: bar.into(), model })
    };
    let mut runs = bars.iter().map(start_run).collect::<Result<Vec<_>, CalibrateError>>()?;
    // The list of identifiable parameters is needed only if the selection depends on the poses.
    let identifiable_ids = match (config.selection.fixed(), bars.first(), runs.first()) {
        (None, Some(BarRun { prepared, .. }), Some(Run { model, .. })) => {
            let Prepared { motion, observations, measured, .. } = prepared;
            identifiable(model, motion, observations, cost.unweighted(measured))?
        }
        _ => Vec::new(),
    };
    let mut fixed = config.fix.clone();
    let plate = runs.first().map(|run| ParameterId::plate(run.model.axes()));
    fixed.extend(plate.filter(|_| config.selection == SelectionName::Thesis));
    for Run { instrument, model } in &mut runs {
        config.set_roles(model, &identifiable_ids, |id, robot| instrument.identifies(id, robot))?;
        instrument.place(model, &fixed)?;
        if let Some(force) = instrument.prepared().and_then(|prepared| prepared.force.as_ref()) {
            config.free_for_force(model, force.parameter())?;
        }
    }
    Ok(runs)
}

/// Link parameters whose tolerances are widened if the samples require it. Standard deviations stated by the
/// user are not changed.
fn tolerances(runs: &[Run], config: &IdentifyConfig) -> Vec<ParameterId> {
    let known_lengths = ParameterId::known_lengths(runs.first().map_or(0, |run| run.model.axes()));
    let has_tolerance = |parameter: &&Parameter| {
        let id = parameter.id;
        let is_link = matches!(id.group(), Group::Link | Group::InPlaceOfAnother);
        let is_stated = known_lengths.contains(&id) || config.priors.contains_key(&id);
        is_link && matches!(parameter.role, Role::Prior { .. }) && !is_stated
    };
    let columns = runs.iter().flat_map(|run| run.model.columns());
    let ids: BTreeSet<ParameterId> = columns.filter(has_tolerance).map(|parameter| parameter.id).collect();
    ids.into_iter().collect()
}

/// Priors of the harmonics of the encoders, and priors of the joint offsets. For each of these two groups, the samples
/// determine a common factor of the standard deviations.
fn common_priors(runs: &[Run], tolerances: &[ParameterId], config: &IdentifyConfig) -> Vec<CommonPrior> {
    let is_offset =
        |link, parameter| runs.first().is_some_and(|run| run.model.robot().is_offset(link, parameter));
    let is_zero = |id: &ParameterId| matches!(*id, ParameterId::Robot { link, parameter } if is_offset(link, parameter));
    let zeros = tolerances.iter().copied().filter(is_zero);
    let priors = [
        CommonPrior::new(runs, config.harmonics(), CommonPrior::HARMONICS),
        CommonPrior::new(runs, zeros, CommonPrior::ZEROS),
    ];
    priors.into_iter().filter(|common| !common.sigmas.is_empty()).collect()
}

/// Model of a ball-bar run before the solve. Robot and bar are nominal. The position of the bar, the encoder offsets and the
/// clock skew have the values that the preparation estimated.
fn start_model(prepared: &Prepared, robot: &RobotConfig, bar: &BallBarConfig) -> Result<Model, ModelError> {
    let arm = robot_chain(robot, bar);
    let mut model = Model::ball_bar(&arm, &ball_bar_chain(bar))
        .with_drives(DriveTrain::from_robot(robot, &arm))
        .with(changed_offsets(prepared));
    for axis in Axis::ALL {
        model.set_value(ParameterId::Base { axis }, prepared.base_m[axis.index()])?;
    }
    for offset in &prepared.offsets {
        let link = usize::from(offset.joint) - 1;
        let theta = ParameterId::Bar { link, parameter: LinkParameter::Theta };
        let nominal = model.parameter(theta).map_or(0.0, |parameter| parameter.nominal);
        model.set_value(theta, nominal + offset.offset_rad)?;
    }
    model.set_value(ParameterId::ClockSkew, prepared.alignment.skew)?;
    Ok(model)
}

/// Offset parameters of encoders whose counters lost their origin during the run. Each origin has its own parameters.
/// Origins without samples have none.
fn changed_offsets(prepared: &Prepared) -> impl Iterator<Item = ParameterId> {
    let has_samples = |number: usize| prepared.observations.iter().any(|one| one.origin == number);
    let spans = prepared.origins.iter().filter(move |span| {
        (1..=ParameterId::LAST_ORIGIN).contains(&span.number) && has_samples(span.number)
    });
    spans.flat_map(|span| {
        let changed = (0..BAR_JOINTS).filter(|joint| span.shift_rad[*joint] != 0.0);
        changed.map(|joint| ParameterId::EncoderOffset { origin: span.number, joint })
    })
}
