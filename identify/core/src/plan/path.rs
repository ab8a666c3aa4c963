//! Motion of the bar's joints, smooth to the second derivative.

use serde::{Deserialize, Serialize};

use super::Design;
use crate::statistics::largest_size;

/// Number of moves between two standstills.
const MOVES_PER_STOP: usize = 3;
/// A move begins this part of its own or the former's duration before the former ends, whichever is shorter.
const OVERLAP: f64 = 0.3;
/// Standstill before the first and after the last move, in units of the design's.
const END_STANDSTILLS: f64 = 2.0;

/// One move from point to point along the minimum-jerk profile `10 u^3 - 15 u^4 + 6 u^5`: speed and acceleration are
/// zero at both ends (Flash and Hogan 1985).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Move {
    /// Start time \[s\].
    pub start_s: f64,
    /// Duration \[s\].
    pub duration_s: f64,
    /// Motion of each joint \[rad\].
    pub by_rad: [f64; 5],
    /// Bar joints at the end of all previous moves \[rad\].
    pub from_rad: [f64; 5],
}

impl Move {
    /// Peak of the profile's speed over its mean.
    const PEAK_SPEED: f64 = 1.875;
    /// Least duration of a move, to avoid large jerks \[s\].
    const DURATION_S_MIN: f64 = 0.5;

    /// End time \[s\].
    pub fn end_s(&self) -> f64 {
        self.start_s + self.duration_s
    }

    /// Bar joints at the end of this move and all previous ones \[rad\].
    pub(super) fn end_rad(&self) -> [f64; 5] {
        std::array::from_fn(|joint| self.from_rad[joint] + self.by_rad[joint])
    }

    /// Highest speed of its fastest joint \[rad/s\].
    pub(super) fn peak_speed_rad_s(&self) -> f64 {
        Self::PEAK_SPEED * largest_size(self.by_rad) / self.duration_s
    }

    fn progress(&self, t_s: f64) -> f64 {
        let u = ((t_s - self.start_s) / self.duration_s).clamp(0.0, 1.0);
        u * u * u * (10.0 + u * (6.0 * u - 15.0))
    }
}

/// A start and a sum of moves: if two overlap in time, the corner between them is rounded.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Path {
    /// Bar joints before the first move \[rad\].
    pub start_rad: [f64; 5],
    /// Moves in the order of their start; at most neighbours overlap.
    pub moves: Vec<Move>,
    /// Duration of the recording \[s\]; the path is at rest before 0 and after its last move.
    pub duration_s: f64,
}

impl Path {
    /// A path at rest for the duration of the design's run.
    pub fn at_rest(start_rad: [f64; 5], design: &Design) -> Self {
        Self { start_rad, moves: Vec::new(), duration_s: design.duration_s }
    }

    /// Bar joints at its end \[rad\].
    pub fn end_rad(&self) -> [f64; 5] {
        self.moves.last().map_or(self.start_rad, Move::end_rad)
    }

    /// Adds a move to `to_rad`, whose fastest joint reaches `speed_rad_s`, with a start time that continues the path.
    pub fn push(&mut self, to_rad: &[f64; 5], speed_rad_s: f64, design: &Design) -> Move {
        let from_rad = self.end_rad();
        let by_rad: [f64; 5] = std::array::from_fn(|i| to_rad[i] - from_rad[i]);
        let duration_s = (Move::PEAK_SPEED * largest_size(by_rad) / speed_rad_s).max(Move::DURATION_S_MIN);
        let start_s = match self.moves.last() {
            None => END_STANDSTILLS * design.standstill_s,
            Some(last) if self.moves.len().is_multiple_of(MOVES_PER_STOP) => {
                last.end_s() + design.standstill_s
            }
            Some(last) => last.end_s() - OVERLAP * last.duration_s.min(duration_s),
        };
        let step = Move { start_s, duration_s, by_rad, from_rad };
        self.moves.push(step);
        step
    }

    /// Whether its last move ends early enough for the standstill at the end.
    pub fn is_in_time(&self, design: &Design) -> bool {
        self.moves.last().map_or(0.0, Move::end_s) <= self.duration_s - END_STANDSTILLS * design.standstill_s
    }

    /// Bar joints at `t_s` \[rad\].
    pub fn at(&self, t_s: f64) -> [f64; 5] {
        let moves_begun = self.moves.partition_point(|step| step.start_s <= t_s);
        // All except the last two are complete: a path of ten hours is evaluated as fast as one of two minutes.
        let last_two = self.moves.get(moves_begun.saturating_sub(2)..moves_begun).unwrap_or_default();
        let mut joints = last_two.first().map_or(self.start_rad, |step| step.from_rad);
        for step in last_two {
            let progress = step.progress(t_s);
            for (joint, by) in joints.iter_mut().zip(step.by_rad) {
                *joint += progress * by;
            }
        }
        joints
    }
}
