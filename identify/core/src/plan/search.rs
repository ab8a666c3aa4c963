//! Improves a path by changing one point at a time, until the time has elapsed (random local search).
//!
//! 1. Several random paths are generated, and the best one is kept.
//! 2. The path is divided into pieces, one for each move. Each piece has its own information
//!    (Fisher information, see `information`).
//! 3. A change is tried: a point of the path is moved, sometimes towards the most informative poses, or the speed of a move
//!    is changed, or a move is added. The information is recomputed only for the pieces near the change.
//! 4. The change is kept if it improves the criterion and the path still satisfies all constraints. The search
//!    continues with step 3.

use std::time::{Duration, Instant};

use rand::Rng;
use rand::seq::IndexedRandom;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

use super::optimum::goals;
use super::random::{point, random_route_until, speed_rad_s};
use super::{Bodies, Constraints, Design, Information, Obstacle, Path, PlanError, Route, Visited};
use crate::kinematics::Joints;
use crate::model::JointState;
use crate::solver::Normal;

/// Number of random paths at the start. The best one is improved.
const STARTS: u64 = 8;
/// Standard deviation of the change of a point, for each joint of the bar \[rad\].
const NUDGE_RAD: f64 = 0.3;
/// The constraints are checked at every pose, but only one of this number of poses contributes to the information.
const LOOKS_PER_POSE: usize = 2;
/// At the end of the changed moves, the robot's joints before and after the change are compared \[rad, m\]. If they differ
/// by less than this, they are the same solution of the inverse kinematics, so the later moves remain valid.
const SAME_MAX: f64 = 1e-3;

/// Additional margins of the search. They are needed because constraints are evaluated only at poses that are [`LOOK_S`]
/// apart. Between two poses, a quantity can exceed its values at both poses by the acceleration times `LOOK_S^2 / 8`. At 5
/// rad/s² this is 2 mrad, or 3 mm at the end of an arm. For angles and clearance the margin is added to the limit; the other
/// limits are multiplied by a factor.
///
/// [`LOOK_S`]: super::constraints::LOOK_S
const ANGLE_ROOM_DEG: f64 = 0.2;
const CLEARANCE_ROOM_M: f64 = 0.004;
const SPEED_PART: f64 = 0.95;
const ACCELERATION_PART: f64 = 0.85;
const DEXTERITY_PART: f64 = 1.03;

/// Progress of a search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SearchProgress {
    /// Number of changes tried.
    pub tried: usize,
    /// Number of tried changes that were kept.
    pub taken: usize,
    /// Current value of the criterion.
    pub score: f64,
}

/// Best path of a search.
#[derive(Debug, Clone)]
pub struct BestPath {
    /// Path of bar and robot.
    pub route: Route,
    /// Normal equations of the path.
    pub normal: Normal,
    /// Values of the criterion for the random paths at the start, in the order of their generation.
    pub random_scores: Vec<f64>,
    /// Number of changes tried and kept, and the final value of the criterion.
    pub progress: SearchProgress,
}

/// A path divided into pieces. A piece lasts from the start of a move to the start of the next move.
pub(super) struct Pieces {
    path: Path,
    /// The robot's joints at the start of each piece, and at the end of the path.
    robot_rad: Vec<Joints>,
    /// Information of each piece.
    normals: Vec<Normal>,
}

/// Searches until `budget` has elapsed or `is_over` returns true. The argument of `is_over` is `None` until the improvement
/// of a path begins.
///
/// # Errors
/// [`PlanError`] if no path is found.
pub fn search(
    constraints: &Constraints<'_>,
    information: &Information,
    seed: u64,
    budget: Duration,
    mut is_over: impl FnMut(Option<&SearchProgress>) -> bool,
) -> Result<BestPath, PlanError> {
    let begun = Instant::now();
    let design = tight_design(constraints.design);
    let tight = tightened(constraints, &design);
    let constraints = &tight;
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (mut best, mut random_scores) = (None, Vec::new());
    let mut last_error = None;
    // Generates random paths and keeps the best one.
    for _ in 0..STARTS {
        // The search for the first path may use all of the time. Further random paths are generated only
        // during the first quarter.
        let until = if best.is_none() { budget } else { budget / 4 };
        let mut is_over = || begun.elapsed() > until || is_over(None);
        let route = random_route_until(constraints, &mut random, &mut is_over);
        match route.and_then(|route| Pieces::divide(constraints, information, &route, &mut is_over)) {
            Ok(pieces) => {
                let score = information.score(&pieces.total(information));
                random_scores.push(score);
                if best.as_ref().is_none_or(|(least, _)| score < *least) {
                    best = Some((score, pieces));
                }
            }
            Err(error) => last_error = Some(error),
        }
        if is_over() {
            break;
        }
    }
    let Some((mut score, mut pieces)) = best else {
        let ended = PlanError::Ended { duration_s: constraints.design.duration_s };
        return Err(last_error.unwrap_or(ended));
    };
    // Improves this path by random changes.
    let mut progress = SearchProgress { tried: 0, taken: 0, score };
    let mut total = pieces.total(information);
    let mut found_goals = None;
    while begun.elapsed() < budget && !is_over(Some(&progress)) {
        progress.tried += 1;
        let goals = found_goals.get_or_insert_with(|| goals(constraints, information, &mut random));
        let Some(changed) = pieces.changed(constraints, information, goals, &mut random) else { continue };
        let new_total = changed.total(information);
        let new_score = information.score(&new_total);
        if new_score < score {
            (score, total, pieces) = (new_score, new_total, changed);
            progress = SearchProgress { taken: progress.taken + 1, score, ..progress };
        }
    }
    let route = Route { path: pieces.path, robot_rad: pieces.robot_rad };
    Ok(BestPath { route, normal: total, random_scores, progress })
}

/// The design with additional margins for the motion between two evaluated poses.
pub(super) fn tight_design(design: &Design) -> Design {
    Design {
        robot_speed_rad_s: SPEED_PART * design.robot_speed_rad_s,
        robot_speed_m_s: design.robot_speed_m_s.map(|speed_m_s| SPEED_PART * speed_m_s),
        bar_margin_deg: design.bar_margin_deg + ANGLE_ROOM_DEG,
        wrist_margin_deg: design.wrist_margin_deg + ANGLE_ROOM_DEG,
        limit_margin_deg: design.limit_margin_deg + ANGLE_ROOM_DEG,
        dexterity_min: DEXTERITY_PART * design.dexterity_min,
        ..design.clone()
    }
}

/// The constraints with the design of [`tight_design`], and with additional margins for clearance and acceleration.
pub(super) fn tightened<'a>(constraints: &Constraints<'a>, design: &'a Design) -> Constraints<'a> {
    let Constraints { limits, bodies, acceleration_rad_s2, .. } = constraints;
    let farther =
        |bodies: Bodies| Bodies { clearance_m_min: bodies.clearance_m_min + CLEARANCE_ROOM_M, ..bodies };
    Constraints::new(constraints.robot, constraints.bar, limits, design)
        .with(bodies.clone().map(farther), ACCELERATION_PART * acceleration_rad_s2)
}

impl Pieces {
    /// Divides a path into pieces and computes their information.
    pub(super) fn divide(
        constraints: &Constraints<'_>,
        information: &Information,
        route: &Route,
        is_over: &mut impl FnMut() -> bool,
    ) -> Result<Self, PlanError> {
        let mut pieces = Self { path: route.path.clone(), robot_rad: Vec::new(), normals: Vec::new() };
        pieces.robot_rad.extend(route.robot_rad.first());
        let (moves, duration_s) = (pieces.path.moves.len(), pieces.path.duration_s);
        for index in 0..moves {
            if is_over() {
                return Err(PlanError::Ended { duration_s });
            }
            pieces.redo(constraints, information, index..index + 1).map_err(|obstacle| {
                let time_s = pieces.span_s(index).0;
                PlanError::Stuck { moves: index, time_s, duration_s, obstacle }
            })?;
        }
        Ok(pieces)
    }

    /// Start and end of piece `index` \[s\].
    fn span_s(&self, index: usize) -> (f64, f64) {
        let start_s = |index: usize| self.path.moves.get(index).map(|step| step.start_s);
        let end_s = start_s(index + 1).unwrap_or(self.path.duration_s);
        (start_s(index).unwrap_or(0.0), end_s)
    }

    /// Recomputes the pieces with the indices `pieces`, after their moves have changed or been added: the robot's joints,
    /// and the Fisher information. Each piece starts at the joints at which the previous piece ends.
    fn redo(
        &mut self,
        constraints: &Constraints<'_>,
        information: &Information,
        pieces: std::ops::Range<usize>,
    ) -> Result<(), Obstacle> {
        for index in pieces {
            let (from_s, until_s) = self.span_s(index);
            let near_rad = self.robot_rad.get(index).copied().unwrap_or_default();
            let robot = constraints.follow(&self.path, from_s, until_s, &near_rad)?;
            let last = *robot.last().unwrap_or(&near_rad);
            match self.robot_rad.get_mut(index + 1) {
                Some(next) => *next = last,
                None => self.robot_rad.push(last),
            }
            let normal = piece_information(&self.path, information, from_s, until_s, &robot);
            match self.normals.get_mut(index) {
                Some(known) => *known = normal,
                None => self.normals.push(normal),
            }
        }
        Ok(())
    }

    /// Information of the whole path: the sum over all pieces.
    pub(super) fn total(&self, information: &Information) -> Normal {
        let mut total = Normal::zeros(information.columns());
        self.normals.iter().for_each(|normal| total += normal);
        total
    }

    /// A random variant of the path: one point is moved, one move's speed is changed, or one move is added. `None` if the
    /// variant violates a constraint.
    fn changed(
        &self,
        constraints: &Constraints<'_>,
        information: &Information,
        goals: &[[f64; 5]],
        random: &mut ChaCha8Rng,
    ) -> Option<Self> {
        let design = constraints.design;
        let count = self.path.moves.len();
        // The index `count`, after the last move, adds a move.
        let index = random.random_range(0..=count);
        let old_rad = self.path.moves.get(index).map_or_else(|| self.path.end_rad(), |step| step.end_rad());
        let to_rad = match random.random_range(0..4) {
            // Change only the speed.
            0 if index < count => old_rad,
            // Move by a fraction of the way to a random point.
            1 => {
                let (goal, part) = (point(design, random), random.random_range(0.2..1.0));
                std::array::from_fn(|i| old_rad[i] + part * (goal[i] - old_rad[i]))
            }
            // Move to an informative pose, or by a fraction of the way to it.
            2 if let Some(goal) = goals.choose(random) => {
                let part = if random.random() { 1.0 } else { random.random_range(0.2..1.0) };
                std::array::from_fn(|i| old_rad[i] + part * (goal[i] - old_rad[i]))
            }
            // Move by a random displacement.
            _ => std::array::from_fn(|i| {
                let by: f64 = StandardNormal.sample(random);
                let [low, high] = design.bar_range_deg[i].map(f64::to_radians);
                (old_rad[i] + NUDGE_RAD * by).clamp(low, high)
            }),
        };
        // Most variants fail because the robot does not reach the new point, so this is checked first.
        constraints.robot_at(&to_rad, self.robot_rad.get(index + 1).or(self.robot_rad.last())?).ok()?;
        let mut path = Path::at_rest(self.path.start_rad, design);
        for (position, step) in self.path.moves.iter().enumerate() {
            let (to, speed) = if position == index {
                (to_rad, speed_rad_s(design, random))
            } else {
                (step.end_rad(), step.peak_speed_rad_s())
            };
            path.push(&to, speed, design);
        }
        if index == count {
            path.push(&to_rad, speed_rad_s(design, random), design);
        }
        if !path.is_in_time(design) {
            return None;
        }
        let mut changed = Self { path, robot_rad: self.robot_rad.clone(), normals: self.normals.clone() };
        // The change affects the path from the start of the previous move to the end of the second next move.
        let first = index.saturating_sub(1);
        let last = (index + 3).min(changed.path.moves.len());
        changed.redo(constraints, information, first..last).ok()?;
        let is_same = |a: &Joints, b: &Joints| a.iter().zip(b.iter()).all(|(a, b)| (a - b).abs() < SAME_MAX);
        let later_moves_are_unchanged = last == changed.path.moves.len()
            || is_same(changed.robot_rad.get(last)?, self.robot_rad.get(last)?);
        later_moves_are_unchanged.then_some(changed)
    }
}

/// Information of a piece of the path, which lasts from `from_s` to `until_s`. `robot` are the joints at equal time steps in
/// this interval. The robot's speeds are computed from differences of neighbouring poses.
fn piece_information(
    path: &Path,
    information: &Information,
    from_s: f64,
    until_s: f64,
    robot: &[Joints],
) -> Normal {
    let step_s = (until_s - from_s) / (robot.len().max(2) - 1) as f64;
    let state = |look: usize| {
        let (before, after) = (look.saturating_sub(1), (look + 1).min(robot.len() - 1));
        let apart_s = (after - before).max(1) as f64 * step_s;
        let qd = Joints::from_fn(robot[look].len(), |i| (robot[after][i] - robot[before][i]) / apart_s);
        JointState { qd, ..JointState::at_rest(robot[look]) }
    };
    let looks = (0..robot.len()).step_by(LOOKS_PER_POSE);
    let robot = looks.clone().map(state).collect();
    let bar_rad: Vec<[f64; 5]> = looks.map(|look| path.at(from_s + step_s * look as f64)).collect();
    let period_s = (until_s - from_s) / bar_rad.len().max(1) as f64;
    information.normal(&Visited { bar_rad, robot }, period_s)
}
