//! Poses at which the robot stood still while something was measured: what tracker, wire and contact have in common.

use super::split;
use crate::instrument::HoldOut;
use crate::kinematics::{Chain, Joints};
use crate::model::{JointState, RobotMotion};

/// A joint that moved less than this since the pose before keeps the direction that it had \[rad\].
const MOVED_RAD_MIN: f64 = 1e-3;

/// Each pose as its robot stands there: rates are the way each joint last moved, by the poses in the order in which the robot
/// went there, at one radian per second; 0 where it has not yet moved.
pub fn standing(joints_rad: impl Iterator<Item = Joints>) -> Vec<JointState> {
    let mut ways = Joints::default();
    let mut before: Option<Joints> = None;
    let each = joints_rad.map(|q| {
        let at_rest = JointState::at_rest(q);
        if let Some(before) = before.replace(q) {
            for (joint, way) in ways.iter_mut().enumerate() {
                let moved = q[joint] - before[joint];
                if moved.abs() > MOVED_RAD_MIN {
                    *way = moved.signum();
                }
            }
        } else {
            ways = at_rest.qd;
        }
        JointState { qd: ways, ..at_rest }
    });
    each.collect()
}

/// The number of each row's pose: rows that follow each other without a motion, such as those of several targets, have the
/// robot's error there in common.
pub fn poses(joints_rad: &[Joints]) -> Vec<usize> {
    let (mut number, mut first) = (0, joints_rad.first());
    let each = joints_rad.iter().map(|q| {
        let moved = |first: &Joints| first.iter().zip(q.iter()).any(|(a, b)| (a - b).abs() > MOVED_RAD_MIN);
        if first.is_some_and(moved) {
            (number, first) = (number + 1, Some(q));
        }
        number
    });
    each.collect()
}

/// Rows of one set-up, in the order in which the robot went there; sample `i` has time `i`.
#[derive(Debug, Clone)]
pub struct Standing<R> {
    /// What was measured.
    pub(super) rows: Vec<R>,
    /// How the robot stood at each.
    pub(super) states: Vec<JointState>,
    /// Group of each row: rows of one group are held out together.
    groups: Vec<usize>,
    seed: u64,
}

impl<R: Copy> Standing<R> {
    /// Rows with how the robot stood at each, and their groups; `seed` decides which groups come together.
    pub fn new(rows: &[R], states: &[JointState], groups: &[usize], seed: u64) -> Self {
        Self { rows: rows.to_vec(), states: states.to_vec(), groups: groups.to_vec(), seed }
    }

    /// All rows of a file, of which `joints_rad` gives the joints.
    pub fn of_file(
        rows: &[R],
        joints_rad: impl Fn(&R) -> Joints,
        robot: &Chain,
        hold_out: HoldOut,
        seed: u64,
    ) -> Self {
        let joints = || rows.iter().map(&joints_rad);
        Self::new(rows, &standing(joints()), &hold_out.groups(robot, joints()), seed)
    }

    /// Some of the rows.
    pub(super) fn chosen(&self, rows: &[usize]) -> Self {
        Self {
            rows: rows.iter().map(|&row| self.rows[row]).collect(),
            states: rows.iter().map(|&row| self.states[row]).collect(),
            groups: rows.iter().map(|&row| self.groups[row]).collect(),
            seed: self.seed,
        }
    }

    /// At most `count` folds of the rows by their groups, each with rows of all classes as far as there are enough.
    pub(super) fn independent(&self, count: usize, class: impl Fn(&R) -> usize) -> Vec<Vec<usize>> {
        split::all_in_folds(&self.groups, count, self.seed, |row| class(&self.rows[row]))
    }
}

impl<R: Sync> RobotMotion for Standing<R> {
    fn at(&self, tau_s: f64) -> Option<JointState> {
        if !(tau_s > -0.5 && tau_s < self.states.len() as f64) {
            return None;
        }
        self.states.get(tau_s.round() as usize).copied()
    }
}
