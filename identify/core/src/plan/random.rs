//! Generates a random path on the bar's sphere within all constraints. The path consists of moves between random points;
//! each move is checked before it is added. If no next move is found, the last few moves are removed (a backtrack). If no
//! first move is found, the path gets another start.
//!
//! The path is the start of a search, or the path of a simulated experiment. Because the points are random in all five bar
//! joints, the path excites all joints in all directions, which manual paths seldom do.

use std::collections::BTreeMap;

use rand::Rng;

use super::{Constraints, Design, Move, Obstacle, Path, Visited};
use crate::kinematics::Joints;
use crate::model::JointState;
use crate::statistics::largest_size;

/// Largest number of points that are tried for the start or for one move.
const TRIES: usize = 300;
/// Largest number of starts without a feasible first move. An arm of seven axes needs some seconds for each of them.
const STARTS: usize = 5;
/// Largest number of backtracks that do not make the path longer.
const RETREATS: usize = 60;
/// Number of moves removed in a backtrack.
const MOVES_GIVEN_UP: usize = 4;
/// Fraction of the way to a random point that a move covers.
const PART_OF_WAY: std::ops::Range<f64> = 0.3..1.0;
/// Smallest number of moves of a path that excites all joints.
const MOVES_MIN: usize = 4;
/// Least duration of a path \[s\]. It is sufficient for `MOVES_MIN` moves and the standstills between them. Of the trials
/// with 13 s, only one in three found a path.
pub const DURATION_S_MIN: f64 = 15.0;
/// Range from which a move's peak speed is drawn, relative to the design's highest speed.
const SPEED_RANGE: std::ops::Range<f64> = 0.5..1.0;

/// Why no random path was found.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PlanError {
    /// The robot cannot hold the bar at any point of the sphere.
    #[error(
        "no pose of the robot holds the bar of {length_m} m at base {base_m:?} m (mostly because of {obstacle}); \
         give another --base, --posture or bar length: `identify plan place` proposes them"
    )]
    NoStart {
        /// Length of the bar \[m\].
        length_m: f64,
        /// Base of the bar in the robot's base frame \[m\].
        base_m: [f64; 3],
        /// Constraint that was violated most often.
        obstacle: Obstacle,
    },
    /// The requested duration is too short for the fewest moves.
    #[error(
        "a run of {duration_s} s is too short for the {MOVES_MIN} moves that excite all joints; give a --duration of at least \
         {DURATION_S_MIN} s"
    )]
    TooShort {
        /// Requested duration \[s\].
        duration_s: f64,
    },
    /// The search was cancelled, or its time elapsed, before a path was complete.
    #[error(
        "the search ended before the first path of {duration_s} s was complete; give a longer --budget, or a shorter --duration and let \
         the robot drive the path twice"
    )]
    Ended {
        /// Requested duration \[s\].
        duration_s: f64,
    },
    /// The path cannot be continued.
    #[error(
        "the path gets stuck after {moves} moves, {time_s:.1} of {duration_s} s (mostly because of {obstacle}); \
         give another --seed, --base, bar length or --duration"
    )]
    Stuck {
        /// Number of moves found.
        moves: usize,
        /// Duration of the path so far \[s\].
        time_s: f64,
        /// Requested duration \[s\].
        duration_s: f64,
        /// Constraint that was violated most often.
        obstacle: Obstacle,
    },
}

/// Number of violations of each constraint.
type Obstacles = BTreeMap<Obstacle, usize>;

fn most_frequent(obstacles: &Obstacles) -> Obstacle {
    let most = obstacles.iter().max_by_key(|(_, count)| **count);
    most.map_or(Obstacle::Reach, |(obstacle, _)| *obstacle)
}

/// A path of the bar within the constraints, with the robot's joints.
#[derive(Debug, Clone, PartialEq)]
pub struct Route {
    /// Path of the bar.
    pub path: Path,
    /// The robot's joints \[rad, m\]. The first entry is at the start of the path. For a random path, the following entries
    /// are at the end of each move. For a searched path, they are at the start of each further move, and the last entry is
    /// at the end of the path.
    pub robot_rad: Vec<Joints>,
}

/// Generates a path through random points, with the duration of the design.
///
/// # Errors
/// [`PlanError`] if base and length of the bar, ranges and robot do not allow a path.
pub fn random_route(constraints: &Constraints<'_>, random: &mut impl Rng) -> Result<Route, PlanError> {
    random_route_until(constraints, random, &mut || false)
}

/// As [`random_route`], but the search also ends if `is_over` returns true. `is_over` is called before each trial of a move.
pub(super) fn random_route_until(
    constraints: &Constraints<'_>,
    random: &mut impl Rng,
    is_over: &mut impl FnMut() -> bool,
) -> Result<Route, PlanError> {
    let duration_s = constraints.design.duration_s;
    if duration_s < DURATION_S_MIN {
        return Err(PlanError::TooShort { duration_s });
    }
    let mut route = route_at_rest(constraints, random)?;
    fill(constraints, &mut route, random, is_over)?;
    Ok(route)
}

/// A random bar posture within the design's ranges \[rad\].
pub(super) fn point(design: &Design, random: &mut impl Rng) -> [f64; 5] {
    design.bar_range_deg.map(|[low, high]| (low + (high - low) * random.random::<f64>()).to_radians())
}

/// A random peak speed of the bar's fastest joint in a move \[rad/s\].
pub(super) fn speed_rad_s(design: &Design, random: &mut impl Rng) -> f64 {
    design.bar_speed_rad_s * random.random_range(SPEED_RANGE)
}

/// Random poses on the sphere in no particular order, each with a speed that the robot can reach. They represent the poses
/// that a path can visit without a change of the robot's configuration. All poses have the configuration of shoulder, elbow
/// and wrist that the robot has at `near_rad`. Returns fewer than `count` poses if too few trials succeed.
pub(super) fn random_poses(
    constraints: &Constraints<'_>,
    mut near_rad: Joints,
    count: usize,
    random: &mut impl Rng,
) -> Visited {
    /// Time step along the motion of a pose \[s\].
    const STEP_S: f64 = 1e-3;
    const TRIES_EACH: usize = 200;
    let design = constraints.design;
    let mut visited = Visited::default();
    let configuration = constraints.bent(&near_rad);
    for _ in 0..TRIES_EACH * count {
        if visited.robot.len() == count {
            break;
        }
        let [bar_rad, goal_rad] = [(); 2].map(|()| point(design, random));
        let Ok(q) = constraints.robot_at(&bar_rad, &near_rad) else { continue };
        if constraints.bent(&q) != configuration {
            continue;
        }
        let by_rad: [f64; 5] = std::array::from_fn(|i| goal_rad[i] - bar_rad[i]);
        let part = speed_rad_s(design, random) * STEP_S / largest_size(by_rad).max(1e-9);
        let next_rad: [f64; 5] = std::array::from_fn(|i| bar_rad[i] + part * by_rad[i]);
        let Ok(next) = constraints.inverse(&constraints.bar.forward(&next_rad), &q) else { continue };
        let qd = Joints::from_fn(q.len(), |i| (next[i] - q[i]) / STEP_S);
        let speeds = qd.iter().zip(design.speeds_max(constraints.robot));
        let speed_factor = speeds.map(|(qd, speed_max)| speed_max / qd.abs().max(1e-9)).fold(1.0, f64::min);
        visited.bar_rad.push(bar_rad);
        visited.robot.push(JointState { qd: qd.map(|qd| speed_factor * qd), ..JointState::at_rest(q) });
        near_rad = q;
    }
    visited
}

/// A path without moves at a random start.
fn route_at_rest(constraints: &Constraints<'_>, random: &mut impl Rng) -> Result<Route, PlanError> {
    let (start_rad, robot_rad) = start(constraints, random)?;
    Ok(Route { path: Path::at_rest(start_rad, constraints.design), robot_rad: vec![robot_rad] })
}

/// A random bar posture, and the robot's joints at this posture \[rad, m\]. If several solutions exist, the joints nearest
/// to the design's posture are used.
pub(super) fn start(
    constraints: &Constraints<'_>,
    random: &mut impl Rng,
) -> Result<([f64; 5], Joints), PlanError> {
    let design = constraints.design;
    let mut obstacles = Obstacles::default();
    for _ in 0..TRIES {
        let point = point(design, random);
        let near_rad = design.posture_rad(constraints.robot, &constraints.limits, random);
        match constraints.robot_at(&point, &near_rad) {
            Ok(robot) => return Ok((point, robot)),
            Err(obstacle) => *obstacles.entry(obstacle).or_default() += 1,
        }
    }
    Err(PlanError::NoStart {
        length_m: constraints.bar.links.iter().map(|link| link.d_m).sum(),
        base_m: design.base_m,
        obstacle: most_frequent(&obstacles),
    })
}

/// Result of the search for the next move.
enum Extension {
    /// A move was added.
    Added,
    /// The next move would end too late, so the path is complete.
    PathFull,
    /// None of the tried moves is feasible.
    NoneFeasible,
    /// The search was cancelled, or its time has elapsed.
    SearchEnded,
}

/// Adds moves until the duration is reached. If no next move is found, the last few moves are removed, because a joint near
/// its limit may prevent every continuation. If this is the case at the start, another start is used.
fn fill(
    constraints: &Constraints<'_>,
    route: &mut Route,
    random: &mut impl Rng,
    is_over: &mut impl FnMut() -> bool,
) -> Result<(), PlanError> {
    let duration_s = constraints.design.duration_s;
    let mut obstacles = Obstacles::default();
    let (mut retreats, mut longest, mut starts) = (0, 0, 1);
    loop {
        match extend(constraints, route, &mut obstacles, random, is_over) {
            Extension::SearchEnded => return Err(PlanError::Ended { duration_s }),
            Extension::Added => {
                if route.path.moves.len() > longest {
                    (retreats, longest) = (0, route.path.moves.len());
                }
            }
            Extension::PathFull if route.path.moves.len() >= MOVES_MIN => return Ok(()),
            Extension::NoneFeasible if route.path.moves.is_empty() => {
                if starts == STARTS {
                    break;
                }
                starts += 1;
                *route = route_at_rest(constraints, random)?;
            }
            Extension::PathFull | Extension::NoneFeasible => {
                retreats += 1;
                if retreats > RETREATS {
                    break;
                }
                let kept = route.path.moves.len().saturating_sub(MOVES_GIVEN_UP);
                route.path.moves.truncate(kept);
                route.robot_rad.truncate(kept + 1);
            }
        }
    }
    Err(PlanError::Stuck {
        moves: route.path.moves.len(),
        time_s: route.path.moves.last().map_or(0.0, Move::end_s),
        duration_s,
        obstacle: most_frequent(&obstacles),
    })
}

/// Adds one move: tries random moves from the last point until one is feasible.
fn extend(
    constraints: &Constraints<'_>,
    route: &mut Route,
    obstacles: &mut Obstacles,
    random: &mut impl Rng,
    is_over: &mut impl FnMut() -> bool,
) -> Extension {
    let design = constraints.design;
    let from_rad = route.path.end_rad();
    for _ in 0..TRIES {
        if is_over() {
            return Extension::SearchEnded;
        }
        // The move covers a fraction of the line to a random point. All points on this line are within the ranges. A short
        // move is more often feasible than a long one.
        let (goal, part) = (point(design, random), random.random_range(PART_OF_WAY));
        let to_rad = std::array::from_fn(|i| from_rad[i] + part * (goal[i] - from_rad[i]));
        let step = route.path.push(&to_rad, speed_rad_s(design, random), design);
        if !route.path.is_in_time(design) {
            route.path.moves.pop();
            return Extension::PathFull;
        }
        // `near_rad` are the joints at the end of the previous move, but this move may start slightly before that end. The
        // path between the two instants was checked with the previous move. The nearest solution at the start of this move
        // is therefore in the same configuration.
        let Some(near_rad) = route.robot_rad.last() else { return Extension::NoneFeasible };
        match constraints.follow(&route.path, step.start_s, step.end_s(), near_rad) {
            Ok(robot) => {
                route.robot_rad.extend(robot.last());
                return Extension::Added;
            }
            Err(obstacle) => *obstacles.entry(obstacle).or_default() += 1,
        }
        route.path.moves.pop();
    }
    Extension::NoneFeasible
}
