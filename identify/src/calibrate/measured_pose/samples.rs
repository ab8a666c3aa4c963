//! Rows in the form that the costs take.

use nalgebra::{Rotation3, Vector3};

use super::figures::{Apart, quantile};
use super::{PoseError, PoseRow};
use crate::cost::{LoopProblem, MeasuredPose, MeasuredPosition, PoseNoise, Residual};
use crate::kinematics::{Pose, ROBOT_JOINTS, rotation_vector};
use crate::model::{Geometry, JointState, Model, Observation, PerObservation, RobotMotion};
use crate::solver::{self, Loss, Normals, Options, Solution, Summary};

/// A joint that moved less than this since the pose before keeps the direction that it had \[rad\].
const MOVED_RAD_MIN: f64 = 1e-3;

/// The way each joint last moved, by the poses in the order in which the robot went there: -1, 0 (not yet moved) or 1.
pub(super) fn directions(rows: &[PoseRow]) -> Vec<[f64; ROBOT_JOINTS]> {
    let mut direction = [0.0; ROBOT_JOINTS];
    let mut before: Option<&PoseRow> = None;
    let each = rows.iter().map(|row| {
        if let Some(before) = before.replace(row) {
            for (joint, way) in direction.iter_mut().enumerate() {
                let moved = row.joints_rad[joint] - before.joints_rad[joint];
                if moved.abs() > MOVED_RAD_MIN {
                    *way = moved.signum();
                }
            }
        }
        direction
    });
    each.collect()
}

/// Joints at rest, each come from a side: rates are the sides, at one radian per second.
#[derive(Debug)]
pub(super) struct Standing(Vec<JointState>);

impl RobotMotion for Standing {
    fn at(&self, tau_s: f64) -> Option<JointState> {
        if !(tau_s > -0.5 && tau_s < self.0.len() as f64) {
            return None;
        }
        self.0.get(tau_s.round() as usize).copied()
    }
}

/// The joints of a row as its robot stands there.
fn standing(row: &PoseRow, direction: &[f64; ROBOT_JOINTS]) -> JointState {
    JointState { q: row.joints_rad, qd: *direction, qdd: [0.0; ROBOT_JOINTS] }
}

/// Chosen rows.
#[derive(Debug)]
pub(super) struct Samples {
    observations: Vec<Observation>,
    motion: Standing,
    positions_m: Vec<Vector3<f64>>,
    poses: Option<Vec<Pose>>,
}

/// What a solve minimises.
#[derive(Debug, Clone, Copy)]
pub(super) struct Weighing {
    pub(super) noise: PoseNoise,
    pub(super) loss: Loss,
}

impl Samples {
    pub(super) fn of(rows: &[PoseRow], directions: &[[f64; ROBOT_JOINTS]], chosen: &[usize]) -> Self {
        let rows = || chosen.iter().filter_map(|&row| Some((rows.get(row)?, directions.get(row)?)));
        let pose = |row: &PoseRow| Some(Pose::from_parts(row.position_m.into(), row.rotation?));
        Self {
            observations: (0..rows().count())
                .map(|index| Observation::bar(PerObservation::time_s(index), Default::default()))
                .collect(),
            motion: Standing(rows().map(|(row, direction)| standing(row, direction)).collect()),
            positions_m: rows().map(|(row, _)| row.position_m).collect(),
            poses: rows().map(|(row, _)| pose(row)).collect(),
        }
    }

    /// Residuals of each sample.
    pub(super) fn rows(&self) -> usize {
        if self.poses.is_some() { MeasuredPose::ROWS } else { MeasuredPosition::ROWS }
    }

    /// The cost in question.
    pub(super) fn cost(&self) -> &'static str {
        if self.poses.is_some() { MeasuredPose::NAME } else { MeasuredPosition::NAME }
    }

    /// Solves for what is free in the model, takes the solution over, and tells of rank and covariance.
    pub(super) fn solve(&self, model: &mut Model, weighing: Weighing) -> Result<Solution, PoseError> {
        let solution = match &self.poses {
            Some(measured) => {
                self.solved(model, MeasuredPose { measured, noise: weighing.noise }, 1.0, weighing)
            }
            None => self.solved(model, self.position(), weighing.noise.position_m, weighing),
        }?;
        model.adopt(&solution.x);
        Ok(solution)
    }

    fn position(&self) -> MeasuredPosition<'_> {
        MeasuredPosition { measured_m: &self.positions_m }
    }

    fn solved<R: Residual + Sync>(
        &self,
        model: &Model,
        residual: R,
        sigma: f64,
        weighing: Weighing,
    ) -> Result<Solution, PoseError> {
        let problem = LoopProblem::new(model, &self.motion, &self.observations, residual, sigma)?;
        let options = Options { loss: weighing.loss, ..Options::default() };
        Ok(solver::solve(&problem, &model.start(), &options)?.identified()?)
    }

    /// The same without a word on rank and covariance, for models of hundreds of columns.
    pub(super) fn minimise(&self, model: &mut Model, weighing: Weighing) -> Result<Summary, PoseError> {
        let (x, summary) = match &self.poses {
            Some(measured) => {
                self.minimised(model, MeasuredPose { measured, noise: weighing.noise }, 1.0, weighing)
            }
            None => self.minimised(model, self.position(), weighing.noise.position_m, weighing),
        }?;
        model.adopt(&x);
        Ok(summary)
    }

    fn minimised<R: Residual + Sync>(
        &self,
        model: &Model,
        residual: R,
        sigma: f64,
        weighing: Weighing,
    ) -> Result<(Vec<f64>, Summary), PoseError> {
        /// Nothing that is reported changes by more.
        const COST_TOLERANCE: f64 = 1e-6;
        let problem = LoopProblem::new(model, &self.motion, &self.observations, residual, sigma)?;
        let options = Options { loss: weighing.loss, cost_tolerance: COST_TOLERANCE, ..Options::default() };
        Ok(solver::minimise(&problem, &model.start(), &options)?)
    }

    /// Normal equations of each fold (places among the samples) at the model's values, weighed by the loss. None where a
    /// number is not finite.
    pub(super) fn normals(
        &self,
        model: &Model,
        weighing: Weighing,
        folds: &[Vec<usize>],
    ) -> Result<Option<Normals>, PoseError> {
        match &self.poses {
            Some(measured) => {
                let residual = MeasuredPose { measured, noise: weighing.noise };
                self.normals_of(model, residual, 1.0, weighing.loss, folds)
            }
            None => self.normals_of(model, self.position(), weighing.noise.position_m, weighing.loss, folds),
        }
    }

    fn normals_of<R: Residual + Sync>(
        &self,
        model: &Model,
        residual: R,
        sigma: f64,
        loss: Loss,
        folds: &[Vec<usize>],
    ) -> Result<Option<Normals>, PoseError> {
        let problem = LoopProblem::new(model, &self.motion, &self.observations, residual, sigma)?;
        let options = Options { loss, ..Options::default() };
        Ok(Normals::new(&problem, &model.start(), &options, folds))
    }
}

/// Robot and tracker apart, in every row.
pub(super) fn apart(geometry: &Geometry, rows: &[PoseRow], directions: &[[f64; ROBOT_JOINTS]]) -> Vec<Apart> {
    let (place, probe) = (geometry.tracker.place.pose(), geometry.tracker.probe.pose());
    let one = |(row, direction): (&PoseRow, &[f64; ROBOT_JOINTS])| {
        let held = geometry.robot_end(&standing(row, direction)) * probe;
        let seen_m = place.transform_point(&row.position_m.into()).coords;
        let angle = |rotation: Rotation3<f64>| {
            rotation_vector((held.rotation.inverse() * place.rotation * rotation).matrix()).norm()
        };
        Apart { position_m: (held.translation.vector - seen_m).norm(), rotation_rad: row.rotation.map(angle) }
    };
    rows.iter().zip(directions).map(one).collect()
}

/// Standard deviations of a coordinate and of an angle that are behind errors which are mostly normal, by their medians.
pub(super) fn noise(errors: &[Apart], chosen: &[usize]) -> PoseNoise {
    /// Median of the norm of three standard normal numbers.
    const MEDIAN_OF_THREE: f64 = 1.538;
    /// Data without any noise still need a unit.
    const LEAST: f64 = 1e-9;
    let median = |of: fn(&Apart) -> f64| {
        let mut sizes: Vec<f64> = chosen.iter().filter_map(|&row| errors.get(row)).map(of).collect();
        sizes.sort_by(f64::total_cmp);
        (quantile(&sizes, 0.5) / MEDIAN_OF_THREE).max(LEAST)
    };
    PoseNoise {
        position_m: median(|error| error.position_m),
        rotation_rad: median(|error| error.rotation_rad.unwrap_or(0.0)),
    }
}
