//! Lists the parameters that a cost can identify on a robot and a bar, before anything is
//! measured. Used by `identify examine`.
//!
//! The Jacobian of the cost is computed at the nominal parameters, on random poses that robot and bar can reach together.
//! The results are the rank and the dependent columns of the Jacobian, the effect of an error in a fixed parameter on the
//! estimated parameters (thesis TFRT-6017, sections 3.2 and 3.3), and the observability indices of the poses.

mod poses;

pub use poses::{Poses, TooFewPoses};

use shared::config::{BallBarConfig, RobotConfig};

use crate::calibrate::selection::structure::{is_geometry, redundant};
use crate::cost::{
    AngleNoise, Length, LoopProblem, Position, PositionAngles, Residual, Transform, WhitenedPose,
};
use crate::instrument::CostName;
use crate::kinematics::{ball_bar_chain, robot_chain};
use crate::model::{Model, ParameterId, Role, Selection, thesis_fixed};
use crate::simulate::Design;
use crate::solver::{Identifiability, Influence, Observability, Options, identifiability, influence};

/// Noise by which the cost `pose` is weighted. Rank and dependence do not need realistic values, so encoders and
/// robot have the same noise.
const NOISE: AngleNoise = AngleNoise { encoder_rad: 1e-5, robot_rad: 1e-5 };

/// Result of the examination of one cost.
#[derive(Debug, Clone)]
pub struct Examination {
    /// Name of the cost.
    pub cost: CostName,
    /// Identifiability with the 47 parameters of the thesis free: both chains and the position of the bar's base.
    pub all: Identifiability,
    /// Identifiability with these parameters and the two rotations of the base free.
    pub tilted: Identifiability,
    /// Parameters that must be fixed in addition to those that the thesis fixes. On this robot, they depend on other
    /// parameters or have no effect.
    pub further_fixed: Vec<ParameterId>,
    /// Effect of an error in a fixed parameter on the free parameters. Fixed parameters are those that the thesis
    /// fixes and those of `further_fixed`.
    pub influence: Influence,
    /// Observability of the free parameters of the thesis, in mm and mrad.
    pub observability: Observability,
}

/// Examines one cost on the nominal robot and bar. `count` is the number of random poses, and `seed` selects them.
///
/// # Errors
/// [`TooFewPoses`] if robot and bar have too few poses in common. Also errors of model, cost and solver.
pub fn examine(
    robot: &RobotConfig,
    bar: &BallBarConfig,
    cost: CostName,
    count: usize,
    seed: u64,
) -> anyhow::Result<Examination> {
    let design = Design::for_robot(robot);
    let robot_chain = robot_chain(robot, bar);
    let mut bar_chain = ball_bar_chain(bar);
    bar_chain.root_from_base.translation.vector = design.base_m.into();
    let poses = Poses::spread(&robot_chain, &bar_chain, &robot.joint_limits(), &design, count, seed)?;
    let model = Model::ball_bar(&robot_chain, &bar_chain);
    match cost {
        CostName::Pose => {
            let geometry = model.geometry(&[]);
            let pose = WhitenedPose::new(&geometry, &poses.joints, &poses.observations, NOISE);
            examine_with(model, &poses, cost, pose)
        }
        CostName::Transform => examine_with(model, &poses, cost, Transform),
        CostName::PositionAngles => examine_with(model, &poses, cost, PositionAngles),
        CostName::Position => examine_with(model, &poses, cost, Position),
        CostName::Length => examine_with(model, &poses, cost, Length),
    }
}

/// Examines the cost with this residual. Rank and dependent groups are computed with all geometry free, first without and
/// then with the rotations of the bar's base. Influence and observability are computed with the free parameters of the
/// thesis, reduced to those that are independent.
fn examine_with<R: Residual + Clone>(
    mut model: Model,
    poses: &Poses,
    cost: CostName,
    residual: R,
) -> anyhow::Result<Examination> {
    let options = Options::default();
    let identify = |model: &Model| -> anyhow::Result<Identifiability> {
        let problem = LoopProblem::new(model, &poses.joints, &poses.observations, residual.clone(), 1.0)?;
        Ok(identifiability(&problem, &model.start(), &options)?)
    };
    let is_base_rotation = |id| matches!(id, ParameterId::BaseRotation { .. });
    // Rank and groups with all geometry free, without and with the rotations of the base.
    model.free_only(|id| is_geometry(id) && !is_base_rotation(id));
    let all = identify(&model)?;
    model.free_only(is_geometry);
    let tilted = identify(&model)?;

    // Beginning with the free parameters of the thesis, fix further parameters until the remaining ones are independent.
    model.select(Selection::Thesis, R::identifies);
    let mut further_fixed = Vec::new();
    let independent = loop {
        let free: Vec<ParameterId> = model.columns().map(|parameter| parameter.id).collect();
        let identifiability = identify(&model)?;
        let to_fix = redundant(&identifiability, &free, model.axes());
        if to_fix.is_empty() {
            break identifiability;
        }
        model.set_roles(to_fix.iter().copied(), Role::Fixed)?;
        further_fixed.extend(to_fix);
    };
    // Observability of the independent parameters.
    let units: Vec<f64> = model.columns().map(|p| p.id.unit().display_factor().recip()).collect();
    let observability = independent.observability(&units);
    // Influence of the fixed parameters on the free ones.
    let fixed = thesis_fixed(model.axes()).into_iter().chain(further_fixed.iter().copied());
    let fixed: Vec<ParameterId> = fixed.filter(|id| R::depends_on(*id, model.robot())).collect();
    // The fixed parameters are freed, so that the Jacobian has columns for them.
    model.set_roles(fixed.iter().copied(), Role::Free)?;
    let columns: Vec<usize> = fixed.iter().filter_map(|id| model.column_of(*id)).collect();
    let problem = LoopProblem::new(&model, &poses.joints, &poses.observations, residual, 1.0)?;
    let influence = influence(&problem, &model.start(), &columns, &options)?;
    Ok(Examination { cost, all, tilted, further_fixed, influence, observability })
}
