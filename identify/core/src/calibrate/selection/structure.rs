//! Finds the parameters that the poses of a run can identify, independent of noise. Computes the rank of the cost's Jacobian
//! at poses that fit the nominal geometry exactly. Used for the selection `all_identifiable`. `identify examine` fixes
//! dependent parameters in the same order ([`redundant`]).

use crate::calibrate::CalibrateError;
use crate::cost::{Length, LoopProblem, Position, PositionAngles, Residual, Transform, fill_in};
use crate::instrument::CostName;
use crate::kinematics::{LinkParameter, robot_inverse};
use crate::model::{Model, Observation, ParameterId, PerObservation, RobotMotion, Role, thesis_fixed};
use crate::solver::{Identifiability, Options, identifiability};

/// Maximum number of poses. More poses do not change the rank.
const POSES_MAX: usize = 300;

/// Position of a parameter in the order in which dependent parameters are fixed, the first one lowest. First are the
/// parameters that the thesis fixes (TFRT-6017 section 3.3). The bar's other parameters follow, because they are not needed
/// afterwards, then the robot's. The pose of the bar's base is last.
fn preference(id: ParameterId, axes: usize) -> usize {
    let of_thesis = thesis_fixed(axes);
    of_thesis.iter().position(|fixed| *fixed == id).unwrap_or(match id {
        ParameterId::Bar { .. } => of_thesis.len(),
        ParameterId::Robot { .. } => of_thesis.len() + 1,
        _ => of_thesis.len() + 2,
    })
}

/// Poses in which the ends of robot and bar coincide exactly for the nominal geometry. Also returns the robot's joints in
/// these poses. If the ends differed by millimetres, dependent parameters would have small singular values instead of
/// zero, and would appear independent.
fn consistent_poses(
    model: &Model,
    motion: &impl RobotMotion,
    observations: &[Observation],
) -> (Vec<Observation>, PerObservation) {
    let geometry = model.geometry(&[]);
    let every = observations.len().div_ceil(POSES_MAX).max(1);
    // Set the bar angles without encoder. Then compute the robot's joints that reach the bar's end.
    let mut poses: Vec<Observation> = observations.iter().step_by(every).copied().collect();
    fill_in(&geometry, motion, &mut poses);
    let bar = geometry.bar_chain();
    let mut joints = Vec::new();
    poses.retain_mut(|pose| {
        let Some(state) = motion.at(geometry.clock.robot_time_s(pose.t_s)) else { return false };
        let Ok(q) = robot_inverse(&geometry.robot, &bar.forward(&pose.bar_rad), &state.q) else {
            return false;
        };
        pose.t_s = PerObservation::time_s(joints.len());
        joints.push(q);
        true
    });
    (poses, PerObservation(joints))
}

/// Whether the parameter is a link parameter (except Hayati's rotations) or part of the pose of the bar's base.
pub fn is_geometry(id: ParameterId) -> bool {
    match id {
        ParameterId::Robot { parameter, .. } => parameter != LinkParameter::Beta,
        ParameterId::Bar { .. } | ParameterId::Base { .. } | ParameterId::BaseRotation { .. } => true,
        _ => false,
    }
}

/// The largest set of parameters that the poses determine, without the parameters of the clocks. In each group of dependent
/// parameters, the first one in the order of `preference` is fixed.
///
/// # Errors
/// [`CalibrateError`] if a parameter does not exist, or if the poses lack data that the cost needs.
pub fn identifiable(
    model: &Model,
    motion: &impl RobotMotion,
    observations: &[Observation],
    cost: CostName,
) -> Result<Vec<ParameterId>, CalibrateError> {
    let mut model = model.clone();
    let (poses, joints) = consistent_poses(&model, motion, observations);
    // These poses have no time, so the clock parameters have no effect.
    for id in [ParameterId::ClockShift, ParameterId::ClockSkew] {
        model.set_value(id, 0.0)?;
    }
    match cost {
        CostName::Pose | CostName::Transform => reduce(model, &joints, &poses, Transform),
        CostName::PositionAngles => reduce(model, &joints, &poses, PositionAngles),
        CostName::Position => reduce(model, &joints, &poses, Position),
        CostName::Length => reduce(model, &joints, &poses, Length),
    }
}

/// Fixes redundant parameters until the poses determine all free parameters. Returns the free parameters.
fn reduce<R: Residual + Copy>(
    mut model: Model,
    joints: &PerObservation,
    poses: &[Observation],
    residual: R,
) -> Result<Vec<ParameterId>, CalibrateError> {
    let robot = model.robot().clone();
    model.free_only(|id| is_geometry(id) && R::depends_on(id, &robot));
    loop {
        let free: Vec<ParameterId> = model.columns().map(|parameter| parameter.id).collect();
        let problem = LoopProblem::new(&model, joints, poses, residual, 1.0)?;
        let rank = identifiability(&problem, &model.start(), &Options::default())?;
        let to_fix = redundant(&rank, &free, model.axes());
        if to_fix.is_empty() {
            return Ok(free);
        }
        model.set_roles(to_fix, Role::Fixed)?;
    }
}

/// The parameters to fix among the `free` ones: parameters without effect, and in each dependent group the first parameter
/// in the order of `preference`. The robot has `axes` axes.
pub fn redundant(found: &Identifiability, free: &[ParameterId], axes: usize) -> Vec<ParameterId> {
    let ids_of = |columns: &[usize]| -> Vec<ParameterId> {
        columns.iter().filter_map(|column| free.get(*column).copied()).collect()
    };
    let of_groups = found
        .groups
        .iter()
        .filter_map(|group| ids_of(&group.columns).into_iter().min_by_key(|id| preference(*id, axes)));
    ids_of(&found.zero_columns).into_iter().chain(of_groups).collect()
}
