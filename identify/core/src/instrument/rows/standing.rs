//! Rows that were measured while the robot stood still. Used by tracker, wire, contact and touch. From the joints of
//! consecutive rows it determines two things: which rows belong to the same pose, and the direction of the last motion of
//! each joint. The direction is needed for backlash.

use std::collections::BTreeMap;

use super::{RowError, split};
use crate::kinematics::{Chain, Joints};
use crate::logs::JointMistake;
use crate::model::{JointState, Observation, ParameterId, PerObservation, SetUp};
use crate::statistics::largest_difference;

/// A joint keeps its last direction of motion if it has moved by less than this since the previous pose \[rad, m\].
const MOVED_MIN: f64 = 1e-3;

/// State of the robot at each pose, in the order of the poses. The rate of a joint is not a speed but the sign of its last
/// motion, +1 or -1 \[rad/s, m/s\]. It is 0 before the first motion of the joint.
pub fn standing(joints_rad: impl Iterator<Item = Joints>) -> Vec<JointState> {
    let mut directions = Joints::default();
    let mut previous: Option<Joints> = None;
    let states = joints_rad.map(|q| {
        let at_rest = JointState::at_rest(q);
        if let Some(previous) = previous.replace(q) {
            for (joint, direction) in directions.iter_mut().enumerate() {
                let moved = q[joint] - previous[joint];
                if moved.abs() > MOVED_MIN {
                    *direction = moved.signum();
                }
            }
        } else {
            // The first pose: set the direction of each joint to zero.
            directions = at_rest.qd;
        }
        JointState { qd: directions, ..at_rest }
    });
    states.collect()
}

/// Number of the pose of each row. Consecutive rows without a motion between them belong to the same pose and have the same
/// error of the robot. An example are rows of two or more targets.
pub(super) fn poses(joints_rad: &[Joints]) -> Vec<usize> {
    let mut pose = 0;
    let mut first_of_pose = joints_rad.first();
    let numbers = joints_rad.iter().map(|q| {
        let moved = |first: &Joints| largest_difference(first, q) > MOVED_MIN;
        if first_of_pose.is_some_and(moved) {
            pose += 1;
            first_of_pose = Some(q);
        }
        pose
    });
    numbers.collect()
}

/// Observations that contain only a time, see [`Standing::observations`]. There is one for each row.
fn observations(rows: usize) -> Vec<Observation> {
    (0..rows).map(|row| Observation::time_only(PerObservation::time_s(row))).collect()
}

/// Rows of one file, in the order in which the robot visited them. Rows have no measured time.
/// The time of row `i` is `i` seconds.
#[derive(Debug, Clone)]
pub(in crate::instrument) struct Standing<R> {
    /// Measurement of each row.
    pub(in crate::instrument) rows: Vec<R>,
    /// State of the robot at each row.
    pub(in crate::instrument) states: Vec<JointState>,
    /// Observation of each row, which contains only the time. The measurements are in `rows`.
    pub(in crate::instrument) observations: Vec<Observation>,
    /// Group of each row. Rows of the same group are held out together.
    pub(in crate::instrument) groups: Vec<usize>,
    seed: u64,
}

impl<R: Copy> Standing<R> {
    /// Creates the rows. `joints_rad` returns the joints of a row. Each pose is a separate group
    /// until [`Standing::group`] is called.
    pub(in crate::instrument) fn new(rows: &[R], joints_rad: impl Fn(&R) -> Joints) -> Self {
        let joints_rad: Vec<Joints> = rows.iter().map(joints_rad).collect();
        Self {
            rows: rows.to_vec(),
            states: standing(joints_rad.iter().copied()),
            observations: observations(rows.len()),
            groups: poses(&joints_rad),
            seed: super::SEED,
        }
    }

    /// Sets the group of each row. All rows of a group are held out together. Groups are
    /// assigned to folds at random, with `seed`.
    pub(in crate::instrument) fn group(&mut self, groups: &[usize], seed: u64) {
        (self.groups, self.seed) = (groups.to_vec(), seed);
    }

    /// The joints of each row.
    pub(in crate::instrument) fn joints(&self) -> Vec<Joints> {
        self.states.iter().map(|state| state.q).collect()
    }

    /// The same rows, after a mistake in their joints is corrected.
    pub(in crate::instrument) fn undone(&self, mistake: JointMistake, robot: &Chain) -> Self {
        let undone = self.states.iter().map(|state| mistake.undone(&state.q, robot.joint_kinds()));
        Self { states: standing(undone), ..self.clone() }
    }

    /// Two possible corrections if joints are in the wrong rows: each measurement gets the joints of the next
    /// row, or those of the previous row.
    pub(in crate::instrument) fn shifted(&self) -> [Self; 2] {
        let count = self.rows.len().saturating_sub(1);
        if count == 0 {
            return [self.clone(), self.clone()];
        }
        let without_last: Vec<usize> = (0..count).collect();
        let without_first: Vec<usize> = (1..=count).collect();
        let combined = |rows: &[usize], joints: &[usize]| Self {
            states: self.chosen(joints).states,
            ..self.chosen(rows)
        };
        [combined(&without_last, &without_first), combined(&without_first, &without_last)]
    }

    /// Checks that all numbers are finite: the joints of each row, and the numbers that `numbers` returns for it.
    pub(in crate::instrument) fn ensure_finite<'r, N: Iterator<Item = f64>>(
        &'r self,
        numbers: impl Fn(&'r R) -> N,
    ) -> Result<(), RowError> {
        for (index, (row, state)) in self.rows.iter().zip(&self.states).enumerate() {
            if !state.q.iter().copied().chain(numbers(row)).all(f64::is_finite) {
                return Err(RowError::BadRow { row: index + 1, what: "a number that is not finite" });
            }
        }
        Ok(())
    }

    /// Checks that there are not too many stations and targets. If there are two or more, also checks that each has enough
    /// rows to be located when any part of the file is held out. `needed` contains the name and the minimum number of rows,
    /// first of a station and then of a target.
    pub(in crate::instrument) fn ensure_each_has_rows(
        &self,
        set_up: impl Fn(&R) -> SetUp,
        needed: [(&'static str, usize); 2],
    ) -> Result<(), RowError> {
        let index_of: [fn(SetUp) -> usize; 2] = [|set_up| set_up.station, |set_up| set_up.target];
        for (index_of, (what, needed)) in index_of.into_iter().zip(needed) {
            let mut counts = BTreeMap::<usize, usize>::new();
            self.rows.iter().for_each(|row| *counts.entry(index_of(set_up(row))).or_default() += 1);
            let (count, most) = (counts.len(), ParameterId::SET_UPS_MAX);
            if count > most {
                return Err(RowError::TooManySetUps { what, count, most });
            }
            if let Some((index, rows)) = counts.iter().find(|(_, rows)| count > 1 && **rows < needed) {
                return Err(RowError::TooFewOfSetUp { what, number: index + 1, rows: *rows, needed });
            }
        }
        Ok(())
    }

    /// Copies only these rows.
    pub(in crate::instrument) fn chosen(&self, rows: &[usize]) -> Self {
        Self {
            rows: rows.iter().map(|&row| self.rows[row]).collect(),
            states: rows.iter().map(|&row| self.states[row]).collect(),
            observations: observations(rows.len()),
            groups: rows.iter().map(|&row| self.groups[row]).collect(),
            seed: self.seed,
        }
    }

    /// Divides the rows into at most `count` folds. The rows of a group stay in one fold. Each fold contains rows of
    /// all classes if there are enough rows.
    pub(in crate::instrument) fn independent(
        &self,
        count: usize,
        class: impl Fn(&R) -> usize,
    ) -> Vec<Vec<usize>> {
        split::folds(&self.groups, count, self.seed, |row| class(&self.rows[row]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The first axis is prismatic, so its values are in metres instead of radians.
    #[test]
    fn a_pose_ends_where_a_joint_moves_by_more_than_a_millimetre_or_a_milliradian() {
        let rows = [[0.5, 1.0], [0.5008, 1.0], [0.5012, 1.0], [0.5012, 1.0012]].map(Joints::from_array);
        assert_eq!(poses(&rows), [0, 0, 1, 2]);
    }
}
