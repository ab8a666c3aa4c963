//! Finds a path over the bar's sphere that robot and bar can follow: random points, each move tried before it is taken.
//!
//! Random points in all five bar joints excite every direction of the pose, which a hand-made path seldom does; the
//! seed makes another path of the same experiment.

use nalgebra::Matrix6;
use rand::Rng;

use super::{Design, Move, Path};
use crate::kinematics::{Chain, Joints, Trace, Tracer, robot_inverse, singularity_margin_rad};

/// Time between two looks at a move \[s\].
const LOOK_S: f64 = 0.05;
/// Points tried before giving up.
const TRIES: usize = 300;
/// How often corners without a way out may be left again before the path grows.
const RETREATS: usize = 60;
/// Moves given up then.
const MOVES_GIVEN_UP: usize = 4;
/// A move goes this part of the way to a random point.
const PART_OF_WAY: std::ops::Range<f64> = 0.3..1.0;
/// Every how many points the robot stands still.
const MOVES_PER_STOP: usize = 3;
/// A move begins this part of its own or the former's duration before the former ends, whichever is shorter.
const OVERLAP: f64 = 0.3;
/// Standstill before the first and after the last move, in units of the design's.
const END_STANDSTILLS: f64 = 2.0;
/// Fewest moves of a path that excites all joints.
const MOVES_MIN: usize = 4;
/// Range of a move's peak speed, in parts of the design's.
const SPEED_RANGE: std::ops::Range<f64> = 0.5..1.0;

/// Why no path was found.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PlanError {
    /// Nowhere on the sphere can the robot hold the bar.
    #[error(
        "no pose of the robot holds the bar of {length_m} m at base {base_m:?} m ({obstacle} in the way most often); \
         give another --base, --posture or bar length"
    )]
    NoStart {
        /// Length of the bar.
        length_m: f64,
        /// Base of the bar.
        base_m: [f64; 3],
        /// What stood in the way most often.
        obstacle: Obstacle,
    },
    /// The path ends in a corner.
    #[error(
        "the path gets stuck after {moves} moves, {time_s:.1} of {duration_s} s ({obstacle} in the way most often); \
         give another --seed, --base, bar length or --duration"
    )]
    Stuck {
        /// Moves found.
        moves: usize,
        /// Duration of the path so far \[s\].
        time_s: f64,
        /// Duration asked for \[s\].
        duration_s: f64,
        /// What stood in the way most often.
        obstacle: Obstacle,
    },
}

/// What makes a pose unusable.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Obstacle {
    /// The bar is near a singular pose.
    BarSingularity,
    /// The robot does not reach the pose.
    Reach,
    /// A joint limit of the robot.
    JointLimit,
    /// The robot's wrist is nearly straight.
    Wrist,
    /// The robot is near another singular posture.
    RobotSingularity,
    /// A robot joint would have to move too fast.
    Speed,
}

impl std::fmt::Display for Obstacle {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::BarSingularity => "singular poses of the bar",
            Self::Reach => "the robot's reach",
            Self::JointLimit => "joint limits of the robot",
            Self::Wrist => "the straight wrist",
            Self::RobotSingularity => "singular postures of the robot",
            Self::Speed => "the robot's joint speed",
        })
    }
}

/// How often each obstacle was met.
#[derive(Default)]
struct Obstacles([usize; 6]);

impl Obstacles {
    fn count(&mut self, obstacle: Obstacle) {
        self.0[obstacle as usize] += 1;
    }

    fn worst(&self) -> Obstacle {
        let all = [
            Obstacle::BarSingularity,
            Obstacle::Reach,
            Obstacle::JointLimit,
            Obstacle::Wrist,
            Obstacle::RobotSingularity,
            Obstacle::Speed,
        ];
        all.into_iter().max_by_key(|&obstacle| self.0[obstacle as usize]).unwrap_or(Obstacle::Reach)
    }
}

struct Planner<'a> {
    robot: &'a Chain,
    tracer: Tracer,
    bar: &'a Chain,
    limits_rad: Vec<[f64; 2]>,
    design: &'a Design,
}

/// What trying to add a move came to.
enum Extension {
    Reached(Waypoint),
    TimeIsUp,
    None,
}

/// A path for nominal chains, and the robot's joints at its start.
///
/// # Errors
/// [`PlanError`] where base, length, ranges and robot do not go together.
pub fn plan(
    robot: &Chain,
    bar: &Chain,
    limits: &[[f64; 2]],
    design: &Design,
    random: &mut impl Rng,
) -> Result<(Path, Joints), PlanError> {
    let margin_rad = design.limit_margin_deg.to_radians();
    let limits_rad = limits.iter().map(|[low, high]| [low + margin_rad, high - margin_rad]).collect();
    let planner = Planner { robot, tracer: Tracer::new(robot), bar, limits_rad, design };
    let (start_rad, robot_rad) = planner.start(random)?;
    let mut path = Path { start_rad, moves: Vec::new(), duration_s: design.duration_s };
    planner.fill(&mut path, Waypoint { bar_rad: start_rad, robot_rad }, random)?;
    Ok((path, robot_rad))
}

/// A point of the path and the robot's joints there.
#[derive(Clone, Copy)]
struct Waypoint {
    bar_rad: [f64; 5],
    robot_rad: Joints,
}

impl Planner<'_> {
    /// Any bar posture within the design's ranges.
    fn point(&self, random: &mut impl Rng) -> [f64; 5] {
        self.design
            .bar_range_deg
            .map(|[low, high]| (low + (high - low) * random.random::<f64>()).to_radians())
    }

    fn start(&self, random: &mut impl Rng) -> Result<([f64; 5], Joints), PlanError> {
        let posture_rad = self.design.posture_deg.map(f64::to_radians);
        let mut obstacles = Obstacles::default();
        for _ in 0..TRIES {
            let point = self.point(random);
            match self.robot_at(&point, &posture_rad) {
                Ok(robot) => return Ok((point, robot)),
                Err(obstacle) => obstacles.count(obstacle),
            }
        }
        Err(PlanError::NoStart {
            length_m: self.bar.links.iter().map(|link| link.d_m).sum(),
            base_m: self.design.base_m,
            obstacle: obstacles.worst(),
        })
    }

    /// Adds moves until the time is used up. Where no next move is found the last few are given up: a joint near its
    /// limit may leave no way on.
    fn fill(&self, path: &mut Path, start: Waypoint, random: &mut impl Rng) -> Result<(), PlanError> {
        let end_s = self.design.duration_s - END_STANDSTILLS * self.design.standstill_s;
        let mut waypoints = vec![start];
        let mut obstacles = Obstacles::default();
        let (mut retreats, mut longest) = (0, 0);
        while let Some(&from) = waypoints.last() {
            match self.extend(path, &from, end_s, &mut obstacles, random) {
                Extension::Reached(next) => {
                    waypoints.push(next);
                    if waypoints.len() > longest {
                        (retreats, longest) = (0, waypoints.len());
                    }
                }
                Extension::TimeIsUp if path.moves.len() >= MOVES_MIN => return Ok(()),
                Extension::TimeIsUp | Extension::None => {
                    retreats += 1;
                    if retreats > RETREATS {
                        break;
                    }
                    let kept = path.moves.len().saturating_sub(MOVES_GIVEN_UP);
                    path.moves.truncate(kept);
                    waypoints.truncate(kept + 1);
                }
            }
        }
        Err(PlanError::Stuck {
            moves: path.moves.len(),
            time_s: path.moves.last().map_or(0.0, Move::end_s),
            duration_s: self.design.duration_s,
            obstacle: obstacles.worst(),
        })
    }

    /// Tries moves from the last point until one is found.
    fn extend(
        &self,
        path: &mut Path,
        from: &Waypoint,
        end_s: f64,
        obstacles: &mut Obstacles,
        random: &mut impl Rng,
    ) -> Extension {
        for _ in 0..TRIES {
            // Part of the way to a point anywhere: a line stays within the ranges, and a short one is found more easily.
            let (goal, part) = (self.point(random), random.random_range(PART_OF_WAY));
            let bar_rad = std::array::from_fn(|i| from.bar_rad[i] + part * (goal[i] - from.bar_rad[i]));
            let speed = self.design.bar_speed_rad_s * random.random_range(SPEED_RANGE);
            let step = self.next_move(path, &from.bar_rad, &bar_rad, speed);
            if step.end_s() > end_s {
                return Extension::TimeIsUp;
            }
            match self.follow(path, step, &from.robot_rad) {
                Ok(robot_rad) => return Extension::Reached(Waypoint { bar_rad, robot_rad }),
                Err(obstacle) => obstacles.count(obstacle),
            }
        }
        Extension::None
    }

    /// The move from `from` to `to`, timed so that it joins the path.
    fn next_move(&self, path: &Path, from: &[f64; 5], to: &[f64; 5], speed_rad_s: f64) -> Move {
        let by_rad: [f64; 5] = std::array::from_fn(|i| to[i] - from[i]);
        let farthest_rad = by_rad.iter().fold(0.0_f64, |most, by| most.max(by.abs()));
        // Short moves too take some time: no jerks.
        let duration_s = (Move::PEAK_SPEED * farthest_rad / speed_rad_s).max(0.5);
        let start_s = match path.moves.last() {
            None => END_STANDSTILLS * self.design.standstill_s,
            Some(last) if path.moves.len().is_multiple_of(MOVES_PER_STOP) => {
                last.end_s() + self.design.standstill_s
            }
            Some(last) => last.end_s() - OVERLAP * last.duration_s.min(duration_s),
        };
        let from_rad = path.moves.last().map_or(path.start_rad, Move::end_rad);
        Move { start_s, duration_s, by_rad, from_rad }
    }

    /// Adds the move and looks at the motion from its beginning to its end; takes it away again where something is in
    /// the way. Returns the robot's joints at the end.
    fn follow(&self, path: &mut Path, step: Move, before_rad: &Joints) -> Result<Joints, Obstacle> {
        path.moves.push(step);
        let looks = (step.duration_s / LOOK_S).ceil();
        // The robot's joints are known at the former move's end; the nearest solution at this move's beginning is
        // the same branch, because the path between the two was looked at with the former move.
        let mut robot = self.robot_at(&path.at(step.start_s), before_rad);
        for look in 1..=looks as usize {
            let Ok(before) = robot else { break };
            let t_s = step.start_s + step.duration_s * look as f64 / looks;
            robot = self.robot_at(&path.at(t_s), &before).and_then(|now| {
                let travel = now.iter().zip(before).fold(0.0_f64, |most, (a, b)| most.max((a - b).abs()));
                let fast = travel > self.design.robot_speed_rad_s * step.duration_s / looks;
                if fast { Err(Obstacle::Speed) } else { Ok(now) }
            });
        }
        if robot.is_err() {
            path.moves.pop();
        }
        robot
    }

    /// The robot's joints at a bar posture, if both are comfortable there.
    fn robot_at(&self, bar_rad: &[f64; 5], near_rad: &[f64]) -> Result<Joints, Obstacle> {
        if singularity_margin_rad(bar_rad) < self.design.bar_margin_deg.to_radians() {
            return Err(Obstacle::BarSingularity);
        }
        let robot =
            robot_inverse(self.robot, &self.bar.forward(bar_rad), near_rad).map_err(|_| Obstacle::Reach)?;
        if !robot.iter().zip(&self.limits_rad).all(|(q, [low, high])| (*low..=*high).contains(q)) {
            return Err(Obstacle::JointLimit);
        }
        if !self.design.wrist_is_bent(&robot) {
            return Err(Obstacle::Wrist);
        }
        if dexterity(&self.tracer, &robot) < self.design.dexterity_min {
            return Err(Obstacle::RobotSingularity);
        }
        Ok(robot)
    }
}

/// Smallest singular value of the robot's Jacobian, position in m and rotation in rad.
fn dexterity(robot: &Tracer, joints_rad: &[f64]) -> f64 {
    let mut trace = Trace::default();
    robot.trace(joints_rad, &mut trace);
    let mut jacobian = Matrix6::zeros();
    for (mut column, twist) in jacobian.column_iter_mut().zip(trace.joint_twists()) {
        column.fixed_rows_mut::<3>(0).copy_from(&twist.linear);
        column.fixed_rows_mut::<3>(3).copy_from(&twist.angular);
    }
    (jacobian * jacobian.transpose()).symmetric_eigenvalues().min().max(0.0).sqrt()
}
