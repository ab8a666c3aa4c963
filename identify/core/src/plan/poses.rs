//! Selects poses for a calibration with a tracker or a draw-wire (`identify plan poses`). Stages:
//!
//! 1. `random_postures` draws many reachable postures, the candidates.
//! 2. `PoseSelection` selects the candidates with the least expected position error. Poses are selected one by one, the best
//!    first (greedy). Each pose is then exchanged for a better one, if there is one (Fedorov 1972).
//! 3. `short_tour` puts the selected poses into a short order, and `way` finds a collision-free path to each pose.
//!
//! The criterion is Bayesian I-optimality (Chaloner and Verdinelli 1995): the mean variance of positions over all
//! candidates. The parameters are errors of links, loads and gears, with the priors of a calibration. The priors are
//! necessary because harmonics of gears have hundreds of amplitudes, more than a few poses determine. Without priors, the
//! best poses would be at the ends of the joints' ranges and would not determine the errors in the middle.

use std::f64::consts::PI;

use nalgebra::{DMatrix, DMatrixView, DVector, Point3};
use rand::seq::index;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use shared::config::{JointKind, RobotConfig};

use super::{Bodies, Design, way};
use crate::calibrate::IdentifyConfig;
use crate::calibrate::rows::{WAVES_PER_TURN_MAX, groups, rows_min};
use crate::calibrate::selection::terms::CandidateGroup;
use crate::cost::{LoopProblem, MeasuredLength, MeasuredPose, MeasuredPosition, PoseNoise, Residual};
use crate::instrument::{Tracker, Wire, standing};
use crate::kinematics::{Joints, Pose, Trace, Tracer, flange_chain};
use crate::logs::{LengthRow, PoseRow};
use crate::model::{
    Coordinate, DriveTrain, JointState, Model, ModelError, Observation, Owner, ParameterId, PerObservation,
    Placement, Role,
};
use crate::solver::{ScaledCholesky, stacked};
use crate::statistics::{largest_difference, mean, median};
use crate::threads::{each, threads_there};

use super::optimum::optimum;

/// Prior standard deviation of the pose of the instrument and of the target \[m, rad\]. It is much larger than the standard
/// deviation after the measurements. A still larger value would cause rounding errors in the information about gears.
const PLACE_SIGMA: f64 = 0.02;
/// Number of exchanges that are tried, but each pose is tried at least once. The first round over all poses
/// improves the selection most.
const EXCHANGES: usize = 100;
/// Number of random selections of the same size for comparison.
const RANDOM_CHOICES: usize = 5;
/// A parameter counts as undetermined if its standard deviation after the measurements exceeds this fraction of
/// its prior standard deviation.
const UNDETERMINED: f64 = 0.9;

/// What is measured at each pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum MeasuredQuantity {
    /// Position and orientation of a probe, by a tracker
    Poses,
    /// Position of a reflector, by a tracker
    Positions,
    /// Length of a draw-wire
    Lengths,
}

impl MeasuredQuantity {
    /// Number of values that are measured at a pose.
    fn rows(self) -> usize {
        match self {
            Self::Poses => MeasuredPose::ROWS,
            Self::Positions => MeasuredPosition::ROWS,
            Self::Lengths => MeasuredLength::ROWS,
        }
    }

    /// Smallest number of poses from which a robot can be calibrated without other data.
    pub fn poses_min(self) -> usize {
        rows_min(&match self {
            Self::Poses | Self::Positions => Tracker::new(&[]).into(),
            Self::Lengths => Wire::new(&[]).into(),
        })
    }
}

/// Why poses cannot be selected.
#[derive(Debug, thiserror::Error)]
pub enum PosesError {
    /// There are fewer candidates than requested poses.
    #[error("{wanted} of {found} poses cannot be chosen; give a smaller --count, or more candidates")]
    TooFew {
        /// Number of requested poses.
        wanted: usize,
        /// Number of available candidates.
        found: usize,
    },
    /// Too few random postures are free of collisions.
    #[error(
        "only {found} of {tried} random postures keep {clearance_mm:.0} mm from links, floor and boxes; check --floor and --box, or \
         give a smaller --link-radius-mm"
    )]
    NoRoom {
        /// Number of free postures.
        found: usize,
        /// Number of postures tried.
        tried: usize,
        /// Least distance \[mm\].
        clearance_mm: f64,
    },
    /// A candidate has derivatives that are not finite.
    #[error("the robot has no derivatives at a candidate; check the links of its configuration")]
    NotFinite,
    /// The model lacks a parameter.
    #[error(transparent)]
    Model(#[from] ModelError),
}

/// Robot, instrument and noise of the measurements.
#[derive(Debug, Clone, Copy)]
pub struct PoseRequest<'a> {
    /// Configuration of the robot.
    pub robot: &'a RobotConfig,
    /// Quantity measured at each pose.
    pub measures: MeasuredQuantity,
    /// Position of the reflector, the probe or the wire's end in the flange frame \[m\].
    pub target_m: [f64; 3],
    /// Point where the wire leaves the instrument, in the robot's base frame \[m\]; unused for a tracker.
    pub anchor_m: [f64; 3],
    /// Standard deviation of a measurement, including the robot's repeatability and unmodelled errors.
    pub noise: PoseNoise,
}

/// Expected accuracy of parameters of one type, such as all links.
#[derive(Debug, Clone, PartialEq)]
pub struct Determined {
    /// Name for display in reports.
    pub name: String,
    /// Parameters of this group.
    pub ids: Vec<ParameterId>,
    /// Standard deviation of each parameter after the measurements, divided by the standard deviation before the measurements.
    pub left: Vec<f64>,
    /// Root mean square of the standard deviations before the measurements, SI.
    pub prior: f64,
    /// Root mean square of the standard deviations after the measurements, SI.
    pub sigma: f64,
}

impl Determined {
    /// Parameters that the poses hardly determine.
    pub fn undetermined(&self) -> impl Iterator<Item = ParameterId> + '_ {
        self.ids.iter().zip(&self.left).filter(|(_, left)| **left > UNDETERMINED).map(|(id, _)| *id)
    }
}

/// The selected poses and their expected accuracy.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedPoses {
    /// Indices of the selected candidates, in the order of the motion.
    pub chosen: Vec<usize>,
    /// Joints at the poses \[rad, m\]. They can differ from the candidate by a whole turn of a joint, if the arm reaches the
    /// pose only in this way.
    pub joints: Vec<Joints>,
    /// Expected RMS position error over the candidates without a calibration \[m\].
    pub before_m: f64,
    /// Expected RMS position error after a calibration with these poses \[m\].
    pub position_m: f64,
    /// Expected RMS position error after a calibration with an equal number of random poses \[m\]. It is the median
    /// over several random selections.
    pub random_m: f64,
    /// Expected accuracy of links, loads and gears.
    pub determined: Vec<Determined>,
    /// Path of the arm from the previous pose to each pose. The first entry is [`Way::Straight`].
    pub ways: Vec<Way>,
}

/// Path of an arm to a pose.
#[derive(Debug, Clone, PartialEq)]
pub enum Way {
    /// A straight line in joint space, free of collisions with the given bodies.
    Straight,
    /// Straight lines in joint space through these postures \[rad, m\].
    Through(Vec<Joints>),
    /// No path with the required clearance was found.
    Blocked,
}

impl PlannedPoses {
    /// Numbers (from 1) of the poses to which no path was found.
    pub fn blocked(&self) -> Vec<usize> {
        let numbered = self.ways.iter().zip(1..);
        numbered.filter(|(way, _)| **way == Way::Blocked).map(|(_, number)| number).collect()
    }

    /// Postures of each move: the previous pose, the intermediate postures, and the pose.
    pub fn moves(&self) -> impl Iterator<Item = Vec<Joints>> + '_ {
        self.joints.windows(2).zip(self.ways.iter().skip(1)).map(|(pair, way)| {
            let between: &[Joints] = if let Way::Through(postures) = way { postures } else { &[] };
            [&pair[..1], between, &pair[1..]].concat()
        })
    }
}

/// Whether a target is on the axis of the last joint, so that the last joint does not move the target. `target_m` is the
/// position in the flange frame \[m\].
pub fn is_on_last_axis(robot: &RobotConfig, target_m: &[f64; 3]) -> bool {
    const NEAR_M: f64 = 1e-3;
    let (mut trace, axes) = (Trace::default(), robot.axes());
    let arm = flange_chain(robot);
    Tracer::new(&arm).trace(&Joints::zeros(axes), &mut trace);
    let target_m = arm.forward(&Joints::zeros(axes)) * Point3::from(*target_m);
    let turned = trace.point_twists(target_m.coords, axes).last();
    turned.is_some_and(|twist| twist.linear.norm() < NEAR_M)
}

/// Random postures that are free of collisions. Joints are within the limits, reduced by the design's margin. Revolute
/// joints are also within half a turn of zero.
///
/// # Errors
/// [`PosesError::NoRoom`] if too few of the random postures are free of collisions.
pub fn random_postures(
    robot: &RobotConfig,
    bodies: &Bodies,
    design: &Design,
    count: usize,
    seed: u64,
) -> Result<Vec<Joints>, PosesError> {
    const TRIES_EACH: usize = 100;
    let (arm, mut random) = (flange_chain(robot), ChaCha8Rng::seed_from_u64(seed));
    let mut ranges = design.limits_with_margin(&arm, &robot.joint_limits());
    limit_to_half_turns(&mut ranges, robot);
    let mut found = Vec::with_capacity(count);
    let mut tried = 0;
    while found.len() < count {
        if tried == TRIES_EACH * count {
            let clearance_mm = bodies.clearance_m_min * 1e3;
            return Err(PosesError::NoRoom { found: found.len(), tried, clearance_mm });
        }
        tried += 1;
        let q = Joints::random(&ranges, &mut random);
        if bodies.is_clear(&arm, &q) {
            found.push(q);
        }
    }
    Ok(found)
}

/// Limits the ranges of revolute axes to half a turn in each direction. Angles beyond it give the same poses.
pub(super) fn limit_to_half_turns(ranges: &mut [[f64; 2]], robot: &RobotConfig) {
    for ([low, high], kind) in ranges.iter_mut().zip(robot.joint_kinds()) {
        if kind == JointKind::Revolute {
            (*low, *high) = (low.max(-PI), high.min(PI));
        }
    }
}

/// Selects `count` of the candidates, and plans the moves between them. A move is a straight line in joint space if this
/// line is clear of `bodies`; otherwise it has intermediate postures. Without `bodies`, all moves are straight.
///
/// # Errors
/// [`PosesError`] if there are fewer candidates than `count`, or if a candidate has no finite derivatives.
pub fn poses(
    request: &PoseRequest<'_>,
    candidates: &[Joints],
    count: usize,
    bodies: Option<&Bodies>,
    seed: u64,
) -> Result<PlannedPoses, PosesError> {
    if count == 0 || count > candidates.len() {
        return Err(PosesError::TooFew { wanted: count, found: candidates.len() });
    }
    let known = PriorModel::new(request)?;
    let at_rest: Vec<JointState> = candidates.iter().map(|q| JointState::at_rest(*q)).collect();
    let jacobian = known.measurement_rows(&at_rest)?;
    let weight = known.weight(&standing(candidates.iter().copied()))?;
    let chosen = PoseSelection::new(&known, &jacobian, &weight).best(count);

    // Find the order of the poses, and a path to each of them.
    let arm = flange_chain(request.robot);
    let is_clear =
        |from: &Joints, to: &Joints| bodies.is_none_or(|bodies| bodies.is_way_clear(&arm, from, to));
    let order = short_tour(&chosen, candidates, |a, b| is_clear(&candidates[a], &candidates[b]));
    let range = request.robot.joint_limits();
    let turns: Vec<bool> = request.robot.joint_kinds().map(|kind| kind == JointKind::Revolute).collect();
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (mut joints, mut ways) = (Vec::with_capacity(count), Vec::with_capacity(count));
    for &pose in &order {
        let (to, way) = match joints.last() {
            None => (candidates[pose], Way::Straight),
            Some(from) => way::to_posture(*from, candidates[pose], (&range, &turns), is_clear, &mut random),
        };
        joints.push(to);
        ways.push(way);
    }
    // RMS position error over the candidates, for a given covariance of the parameters.
    let position_m = |covariance: &DMatrix<f64>| weight.dot(covariance).max(0.0).sqrt();
    // Random selections for comparison.
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut random_m = Vec::new();
    for _ in 0..RANDOM_CHOICES {
        let sample = index::sample(&mut random, candidates.len(), count).into_vec();
        let covariance = known.covariance_in_order(sample.iter().map(|&pose| candidates[pose]))?;
        random_m.extend(covariance.as_ref().map(position_m));
    }
    // The covariance is computed for the candidates instead of `joints`, which may differ from them by whole turns. A whole
    // turn changes only the effect of an error of a gear's ratio.
    let in_order = order.iter().map(|&pose| candidates[pose]);
    let covariance = known.covariance_in_order(in_order)?.ok_or(PosesError::NotFinite)?;
    Ok(PlannedPoses {
        joints,
        before_m: known.robot_variance_before(&weight).max(0.0).sqrt(),
        position_m: position_m(&covariance),
        random_m: median(&mut random_m).unwrap_or(f64::INFINITY),
        determined: known.determined(&covariance),
        chosen: order,
        ways,
    })
}

/// Lower bound of the RMS position error over the candidates \[m\]. It holds for every selection of `count` poses, including
/// selections with repeated poses. No other selection can improve on a given one by more than the difference to this bound.
///
/// # Errors
/// [`PosesError`] if a candidate has no finite derivatives.
pub fn poses_position_m_min(
    request: &PoseRequest<'_>,
    candidates: &[Joints],
    count: usize,
) -> Result<f64, PosesError> {
    let known = PriorModel::new(request)?;
    let at_rest: Vec<JointState> = candidates.iter().map(|q| JointState::at_rest(*q)).collect();
    let (rows, rows_per_pose) = (known.measurement_rows(&at_rest)?, request.measures.rows());
    let weight = known.weight(&standing(candidates.iter().copied()))?;
    let prior = DMatrix::from_diagonal(&DVector::from_vec(known.prior.clone()).map(f64::recip));
    let best = optimum(&prior, (&rows, rows_per_pose), count as f64, &weight);
    best.map(|best| best.variance_min.sqrt()).ok_or(PosesError::NotFinite)
}

/// The parameters of a calibration with their priors.
struct PriorModel<'a> {
    request: &'a PoseRequest<'a>,
    model: Model,
    groups: Vec<CandidateGroup>,
    ids: Vec<ParameterId>,
    /// Prior variance of each column.
    prior: Vec<f64>,
}

impl<'a> PriorModel<'a> {
    /// Sets up the parameters of a calibration. A calibration tries several standard deviations for the prior of each group
    /// of joint terms; here the middle one is used.
    fn new(request: &'a PoseRequest<'a>) -> Result<Self, ModelError> {
        let flange = flange_chain(request.robot);
        let (model, owner) = match request.measures {
            // A wire does not measure the position of its end. For the position error, a tracker in the robot's base is
            // therefore added to the model.
            MeasuredQuantity::Lengths => (
                Model::alone(&flange).with_set_ups(Owner::Wire, [1, 1]).with_set_ups(Owner::Tracker, [1, 1]),
                Owner::Wire,
            ),
            MeasuredQuantity::Poses | MeasuredQuantity::Positions => {
                (Model::alone(&flange).with_set_ups(Owner::Tracker, [1, 1]), Owner::Tracker)
            }
        };
        let turns_probe =
            |id: &ParameterId| matches!(id, ParameterId::Probe { coordinate: Coordinate::Rotation(_), .. });
        let is_of_instrument = |id: &ParameterId| {
            id.owner() == owner && (request.measures == MeasuredQuantity::Poses || !turns_probe(id))
        };
        // The scale of the instrument is treated as known, because its contribution is the same for all poses. Plans of
        // paths treat the plate in the same way.
        let instrument: Vec<ParameterId> = model.ids().into_iter().filter(is_of_instrument).collect();
        let waves = ParameterId::joint_waves(WAVES_PER_TURN_MAX);
        let mut model = model.with_drives(DriveTrain::from_robot(request.robot, &flange)).with(waves);
        IdentifyConfig::default().set_link_roles(&mut model)?;
        for id in model.ids() {
            match id {
                ParameterId::Attachment { axis, .. }
                | ParameterId::Probe { coordinate: Coordinate::Position(axis), .. } => {
                    model.set_value(id, request.target_m[axis.index()])?;
                }
                ParameterId::Anchor { axis, .. } => model.set_value(id, request.anchor_m[axis.index()])?,
                _ => {}
            }
        }
        for id in instrument {
            let value = model.parameter(id).map_or(0.0, |parameter| parameter.value);
            model.set_role(id, Role::Prior { value, sigma: PLACE_SIGMA })?;
        }
        let mut groups = groups(WAVES_PER_TURN_MAX, |id| model.parameter(*id).is_some());
        for group in &mut groups {
            group.sigma *= group.scales.get((group.scales.len() - 1) / 2).copied().unwrap_or(1.0);
            model.set_roles(group.ids.iter().copied(), Role::Prior { value: 0.0, sigma: group.sigma })?;
        }
        let ids: Vec<ParameterId> = model.columns().map(|parameter| parameter.id).collect();
        let mut prior = vec![PLACE_SIGMA.powi(2); ids.len()];
        model.priors().iter().for_each(|known| prior[known.column] = known.sigma.powi(2));
        Ok(Self { request, model, groups, ids, prior })
    }

    /// Rows of the Jacobian at each pose, divided by the standard deviations of the measured values.
    fn measurement_rows(&self, states: &[JointState]) -> Result<DMatrix<f64>, PosesError> {
        let (count, noise) = (states.len(), self.request.noise);
        match self.request.measures {
            MeasuredQuantity::Poses => {
                let (rows, noise) = (&self.tracker_rows(states), &vec![noise; count]);
                self.whitened_rows(states, MeasuredPose { rows, noise }, 1.0)
            }
            MeasuredQuantity::Positions => self.position_rows(states, noise),
            MeasuredQuantity::Lengths => {
                // The derivatives do not depend on the measured length.
                let (rows, relative_noise) = (&vec![LengthRow::default(); count], vec![1.0; count]);
                self.whitened_rows(states, MeasuredLength { rows, relative_noise }, noise.position_m)
            }
        }
    }

    /// Rows that a tracker in the robot's base would measure.
    fn tracker_rows(&self, states: &[JointState]) -> Vec<PoseRow> {
        let geometry = self.model.geometry(&[]);
        let probe = geometry.tracker.probes.first().map_or_else(Pose::identity, Placement::pose);
        let row = |state: &JointState| {
            let target = geometry.robot_end(state) * probe;
            let (position_m, rotation) = (target.translation.vector, Some(target.rotation));
            PoseRow { position_m, rotation, ..PoseRow::default() }
        };
        states.iter().map(row).collect()
    }

    /// Rows of the Jacobian of the target's position, divided by this noise.
    fn position_rows(&self, states: &[JointState], noise: PoseNoise) -> Result<DMatrix<f64>, PosesError> {
        let (rows, noise) = (&self.tracker_rows(states), &vec![noise; states.len()]);
        self.whitened_rows(states, MeasuredPosition { rows, noise }, 1.0)
    }

    /// Derivatives of the residual with respect to all columns, one row for each measured value, divided by `sigma`.
    fn whitened_rows<R: Residual>(
        &self,
        states: &[JointState],
        residual: R,
        sigma: f64,
    ) -> Result<DMatrix<f64>, PosesError> {
        let observations: Vec<Observation> =
            (0..states.len()).map(|pose| Observation::time_only(PerObservation::time_s(pose))).collect();
        let motion = states.to_vec();
        let problem = LoopProblem::new(&self.model, &motion, &observations, residual, sigma).ok();
        let rows = problem.and_then(|problem| stacked(&problem, &self.model.start()));
        rows.map(|(_, jacobian)| jacobian).ok_or(PosesError::NotFinite)
    }

    /// Mean of `J^T J` over these poses, where `J` are the derivatives of the target's position \[m²\].
    fn weight(&self, states: &[JointState]) -> Result<DMatrix<f64>, PosesError> {
        let unit = PoseNoise { position_m: 1.0, rotation_rad: 1.0 };
        let rows = self.position_rows(states, unit)?;
        Ok(squared(&rows) / states.len().max(1) as f64)
    }

    /// Covariance after measurements whose Jacobian has these rows; `None` if they leave a parameter undetermined.
    fn covariance(&self, rows: &DMatrix<f64>) -> Option<DMatrix<f64>> {
        let mut normal = squared(rows);
        self.prior
            .iter()
            .enumerate()
            .for_each(|(column, variance)| normal[(column, column)] += variance.recip());
        Some(ScaledCholesky::new(normal)?.inverse())
    }

    /// Covariance after measurements at these poses in this order. The order determines the direction in which each joint
    /// arrives at a pose, and therefore its backlash. Moves are straight.
    fn covariance_in_order(
        &self,
        poses: impl Iterator<Item = Joints>,
    ) -> Result<Option<DMatrix<f64>>, PosesError> {
        Ok(self.covariance(&self.measurement_rows(&standing(poses))?))
    }

    fn is_of_robot(id: ParameterId) -> bool {
        id.owner() == Owner::Robot
    }

    /// Mean squared position error due to links, loads and gears before the measurements \[m²\].
    fn robot_variance_before(&self, weight: &DMatrix<f64>) -> f64 {
        let columns = self.ids.iter().zip(&self.prior).enumerate();
        let of_robot = columns.filter(|(_, (id, _))| Self::is_of_robot(**id));
        of_robot.map(|(column, (_, variance))| weight[(column, column)] * variance).sum()
    }

    fn determined(&self, covariance: &DMatrix<f64>) -> Vec<Determined> {
        let links = self.ids.iter().filter(|id| matches!(id, ParameterId::Robot { .. })).copied().collect();
        let links = ("links, lengths and angles alike".to_owned(), links);
        let groups = self.groups.iter().map(|group| (group.name.clone(), group.ids.clone()));
        let determined = |(name, ids): (String, Vec<ParameterId>)| {
            let columns: Vec<usize> =
                (0..self.ids.len()).filter(|column| ids.contains(&self.ids[*column])).collect();
            let left = |&column: &usize| (covariance[(column, column)].max(0.0) / self.prior[column]).sqrt();
            let rms =
                |variance: &dyn Fn(usize) -> f64| mean(columns.iter().map(|&column| variance(column))).sqrt();
            Determined {
                left: columns.iter().map(left).collect(),
                prior: rms(&|column| self.prior[column]),
                sigma: rms(&|column| covariance[(column, column)]),
                name,
                ids: columns.iter().map(|&column| self.ids[column]).collect(),
            }
        };
        std::iter::once(links).chain(groups).map(determined).collect()
    }
}

/// The selected poses, and the gain from the selection of each further candidate.
///
/// Let `P` be the covariance, `W` the weight, and `J` the Jacobian of one pose in units of standard deviations. The
/// selection of this pose reduces `tr(W P)` by the gain `tr((I + J P J^T)^-1 J P W P J^T)`. The matrices `J P J^T` and
/// `J P W P J^T` are small. They are stored for all candidates, one below the other, and updated after each selection:
///
/// ```text
///             jacobian (J)    jpj (J P J^T)    jpwpj (J P W P J^T)
/// pose 0      rows x columns  rows x rows      rows x rows
/// pose 1      rows x columns  rows x rows      rows x rows
/// ..
/// ```
struct PoseSelection<'k> {
    jacobian: &'k DMatrix<f64>,
    weight: &'k DMatrix<f64>,
    covariance: DMatrix<f64>,
    /// Number of rows of a pose.
    rows: usize,
    /// `J P J^T` of all candidates, one below the other.
    jpj: DMatrix<f64>,
    /// `J P W P J^T` of all candidates, one below the other.
    jpwpj: DMatrix<f64>,
    /// For each candidate, whether it is selected.
    taken: Vec<bool>,
}

impl<'k> PoseSelection<'k> {
    fn new(known: &PriorModel<'_>, jacobian: &'k DMatrix<f64>, weight: &'k DMatrix<f64>) -> Self {
        let rows = known.request.measures.rows();
        let covariance = DMatrix::from_diagonal(&known.prior.clone().into());
        let mut jp = jacobian.clone();
        jp.column_iter_mut().zip(&known.prior).for_each(|(mut column, variance)| column *= *variance);
        let jpw = times(&jp, weight);
        let mut jpj = DMatrix::zeros(jacobian.nrows(), rows);
        let mut jpwpj = jpj.clone();
        for first in (0..jacobian.nrows()).step_by(rows) {
            let jp_of_pose = jp.rows(first, rows);
            jpj.rows_mut(first, rows).copy_from(&(jp_of_pose * jacobian.rows(first, rows).transpose()));
            jpwpj.rows_mut(first, rows).copy_from(&(jpw.rows(first, rows) * jp_of_pose.transpose()));
        }
        let taken = vec![false; jacobian.nrows() / rows];
        Self { jacobian, weight, covariance, rows, jpj, jpwpj, taken }
    }

    /// Selects `count` candidates one by one, the best first. Then exchanges single poses, until no exchange improves the
    /// selection or the maximum number of exchanges is reached.
    fn best(mut self, count: usize) -> Vec<usize> {
        let mut chosen: Vec<usize> = (0..count).filter_map(|_| self.take_best()).collect();
        for _ in 0..(EXCHANGES / count).max(1) {
            let mut exchanged = false;
            for pose in &mut chosen {
                if self.change(*pose, -1.0)
                    && let Some(better) = self.take_best()
                {
                    exchanged |= better != *pose;
                    *pose = better;
                }
            }
            if !exchanged {
                break;
            }
        }
        chosen
    }

    /// Selects the candidate with the largest gain. `None` if all candidates are selected, or if rounding
    /// errors prevent the selection.
    fn take_best(&mut self) -> Option<usize> {
        let unselected = (0..self.taken.len()).filter(|&pose| !self.taken[pose]);
        let best = unselected.map(|pose| (pose, self.gain(pose))).max_by(|a, b| a.1.total_cmp(&b.1))?.0;
        self.change(best, 1.0).then_some(best)
    }

    fn rows_of<'m>(&self, stacked: &'m DMatrix<f64>, pose: usize) -> DMatrixView<'m, f64> {
        stacked.rows(pose * self.rows, self.rows)
    }

    /// Reduction of `tr(W P)` if the pose is selected.
    fn gain(&self, pose: usize) -> f64 {
        let jpwpj = self.rows_of(&self.jpwpj, pose).into_owned();
        let sum = self.rows_of(&self.jpj, pose) + DMatrix::identity(self.rows, self.rows);
        sum.cholesky().map_or(0.0, |factor| factor.solve(&jpwpj).trace())
    }

    /// Adds a pose to the selection (`sign` 1) or removes it (-1). Returns false if rounding errors prevent this.
    ///
    /// Let `C C^T = I + sign J P J^T` and `L = P J^T C^-T` for this pose. The new covariance is `P - sign L L^T`. With this
    /// formula, `J P J^T` and `J P W P J^T` of every candidate are updated, using the candidate's own `J`.
    fn change(&mut self, pose: usize, sign: f64) -> bool {
        let identity = DMatrix::<f64>::identity(self.rows, self.rows);
        let Some(factor) = (identity + self.rows_of(&self.jpj, pose) * sign).cholesky() else { return false };
        let jp = self.rows_of(self.jacobian, pose) * &self.covariance;
        let Some(l_transposed) = factor.l().solve_lower_triangular(&jp) else { return false };
        let l = l_transposed.transpose();
        let wl = self.weight * &l;
        let lwl = l.tr_mul(&wl);
        let rows = self.rows;
        // `L` and `P W L` are put side by side in one matrix, so that one product with all rows is sufficient.
        let mut both = DMatrix::zeros(l.nrows(), 2 * rows);
        both.columns_mut(0, rows).copy_from(&l);
        both.columns_mut(rows, rows).copy_from(&(&self.covariance * wl));
        let products = times(self.jacobian, &both);
        for first in (0..products.nrows()).step_by(rows) {
            let jl = products.view((first, 0), (rows, rows));
            let jpwl = products.view((first, rows), (rows, rows));
            let mut jpj = self.jpj.rows_mut(first, self.rows);
            jpj -= sign * jl * jl.transpose();
            let mut jpwpj = self.jpwpj.rows_mut(first, self.rows);
            let mixed = jl * jpwl.transpose();
            jpwpj += jl * &lwl * jl.transpose() - (&mixed + mixed.transpose()) * sign;
        }
        self.covariance -= &l * l.transpose() * sign;
        self.taken[pose] = sign > 0.0;
        true
    }
}

/// Matrix product, computed on all threads. Each thread multiplies some rows of `left`, which has many rows.
pub(super) fn times(left: &DMatrix<f64>, right: &DMatrix<f64>) -> DMatrix<f64> {
    let rows_per_part = left.nrows().div_ceil(threads_there()).max(1);
    let parts = each(left.nrows().div_ceil(rows_per_part), |part| {
        let first = part * rows_per_part;
        left.rows(first, rows_per_part.min(left.nrows() - first)) * right
    });
    let mut product = DMatrix::zeros(left.nrows(), right.ncols());
    for (number, part) in parts.iter().enumerate() {
        product.rows_mut(number * rows_per_part, part.nrows()).copy_from(part);
    }
    product
}

/// The product `J^T J`, where `J` is `rows`.
pub(super) fn squared(rows: &DMatrix<f64>) -> DMatrix<f64> {
    times(&rows.transpose(), rows)
}

/// Orders the chosen poses in a short tour. The tour starts at the pose nearest to joints of zero. From each pose it
/// continues to the nearest remaining pose that a clear straight line reaches, or to the nearest remaining pose if no such
/// line exists. The tour is then shortened by reversing sections of it (2-opt, Croes 1958). The distance between two poses
/// is their largest joint difference, which determines the duration of the move.
fn short_tour(
    chosen: &[usize],
    candidates: &[Joints],
    is_clear: impl Fn(usize, usize) -> bool,
) -> Vec<usize> {
    let zeros = candidates.first().map_or_else(Joints::default, |q| Joints::zeros(q.len()));
    let distance = |a: usize, b: usize| largest_difference(&candidates[a], &candidates[b]);
    // Sorted by decreasing distance, so that the nearest pose can be removed from the end.
    let mut remaining = chosen.to_vec();
    remaining.sort_by(|a, b| {
        largest_difference(&zeros, &candidates[*b]).total_cmp(&largest_difference(&zeros, &candidates[*a]))
    });
    let mut order: Vec<usize> = remaining.pop().into_iter().collect();
    while let Some(&here) = order.last() {
        remaining.sort_by(|a, b| distance(here, *b).total_cmp(&distance(here, *a)));
        let nearest_clear = remaining.iter().rposition(|&pose| is_clear(here, pose));
        let Some(next) = nearest_clear.or(remaining.len().checked_sub(1)) else { break };
        order.push(remaining.remove(next));
    }
    // Reverse sections while this shortens the tour. Before the first pose and after the last pose, the distance counts as
    // zero, and every move counts as possible.
    let length =
        |from: Option<&usize>, to: Option<&usize>| from.zip(to).map_or(0.0, |(a, b)| distance(*a, *b));
    let may_follow =
        |from: Option<&usize>, to: Option<&usize>| from.zip(to).is_none_or(|(a, b)| is_clear(*a, *b));
    let mut shorter = true;
    while shorter {
        shorter = false;
        for first in 1..order.len() {
            for last in first + 1..order.len() {
                let (before, after) = (order.get(first - 1), order.get(last + 1));
                let (begin, end) = (order.get(first), order.get(last));
                let gain =
                    length(before, begin) + length(end, after) - length(before, end) - length(begin, after);
                if gain > 1e-9 && may_follow(before, end) && may_follow(begin, after) {
                    order[first..=last].reverse();
                    shorter = true;
                }
            }
        }
    }
    order
}
