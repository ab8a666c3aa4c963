//! Plans paths on the sphere of the ball-bar, and poses for instruments that measure a robot at rest.
//!
//! Paths:
//! - `random` generates a path within the `constraints`. The constraints use the `design` and
//!   compute collisions with `bodies`.
//! - `search` improves a path by its `information`, which gives the expected accuracy of a calibration on the path.
//! - `optimum` computes a bound for the accuracy on any path.
//! - `check` checks any path that is given by the robot's joints.
//! - `programs` writes a path as a program for robot controllers.
//! - `place` proposes positions of the bar.
//!
//! Poses: `poses` selects poses, and `way` plans collision-free moves between them.

mod check;
mod constraints;
mod design;
mod information;
mod optimum;
mod path;
mod place;
mod poses;
mod programs;
mod random;
mod search;
mod way;

pub use check::{CheckError, Checked, PathViolation, check};
pub use constraints::{Bodies, Constraints, Obstacle, Skeleton};
pub use design::Design;
pub use information::{Criterion, ExpectedPosition, Information, Visited, WithTerms};
pub use optimum::{Optimum, position_m_min};
pub use path::{Move, Path};
pub use place::{PlaceRequest, Places, RatedPlace, SecondRun, places};
pub use poses::{
    Determined, MeasuredQuantity, PlannedPoses, PoseRequest, PosesError, Way, is_on_last_axis, poses,
    poses_position_m_min, random_postures,
};
pub use programs::{Language, ProgramError, ProgramPurpose, can_be_programmed, pose_program, program};
pub use random::{DURATION_S_MIN, PlanError, Route, random_route};
pub use search::{BestPath, SearchProgress, search};

use serde::{Deserialize, Serialize};

use crate::kinematics::{InverseError, Joints};
use crate::logs::{RobotLog, Stream, ValueOrigin};

/// Time between two rows of a planned path \[s\].
const ROW_S: f64 = 0.004;

/// Contents of `path.toml`: a path of the bar for `identify simulate --path`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlannedPath {
    /// Name of the robot for which the path was planned.
    pub robot: String,
    /// Centre of the gimbal in the robot's base frame \[m\].
    pub base_m: [f64; 3],
    /// Joints of the nominal robot at the start \[rad\].
    pub robot_start_rad: Joints,
    /// Path of the bar.
    pub path: Path,
}

impl shared::config::Validate for PlannedPath {
    fn validate(&self) -> Result<(), shared::config::Violation> {
        /// One day, longer than any recording \[s\].
        const DURATION_S_MAX: f64 = 86_400.0;
        let numbers = self.base_m.iter().chain(&self.robot_start_rad).chain(&self.path.start_rad);
        let moves = self.path.moves.iter();
        let moves = moves.flat_map(|step| step.by_rad.iter().chain(&step.from_rad).chain([&step.start_s]));
        let is_duration = |duration_s: f64| duration_s > 0.0 && duration_s <= DURATION_S_MAX;
        if numbers.chain(moves).all(|number| number.is_finite())
            && is_duration(self.path.duration_s)
            && self.path.moves.iter().all(|step| is_duration(step.duration_s))
            && self.path.moves.is_sorted_by_key(|step| step.start_s)
        {
            return Ok(());
        }
        let found = "a number is not finite, a duration is not between zero and a day, or moves are not in order of their start";
        Err(shared::config::Violation::new("path", found, "take the file that `identify plan` wrote"))
    }
}

/// Joints of the nominal robot along a path, as a log. The clock of the log is zero at the start of the path.
///
/// # Errors
/// An error of the inverse kinematics, with the time at which it occurred \[s\].
pub fn robot_path(
    robot: &str,
    constraints: &Constraints<'_>,
    route: &Route,
) -> Result<RobotLog, (f64, InverseError)> {
    let rows = (route.path.duration_s / ROW_S).round() as usize;
    let mut near_rad = route.robot_rad.first().copied().unwrap_or_default();
    let (mut t_s, mut q_rad) = (Vec::new(), Vec::new());
    for row in 0..=rows {
        let at_s = row as f64 * ROW_S;
        let target = constraints.bar.forward(&route.path.at(at_s));
        near_rad = constraints.inverse(&target, &near_rad).map_err(|error| (at_s, error))?;
        t_s.push(at_s);
        q_rad.push(near_rad);
    }
    Ok(RobotLog {
        robot: Some(robot.to_owned()),
        clock: "planned".into(),
        origin: ValueOrigin::Commanded,
        q_rad: Stream::new(0, t_s, q_rad).into(),
        ..RobotLog::default()
    })
}
