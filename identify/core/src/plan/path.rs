//! A path of the bar's joints over time. It consists of moves from point to point, and is smooth to the second derivative.

use serde::{Deserialize, Serialize};

use super::Design;
use crate::statistics::largest_size;

/// Number of moves between two standstills of the bar.
const MOVES_PER_STOP: usize = 3;
/// Two moves without a standstill between them overlap in time. The overlap is this fraction of the shorter move.
const OVERLAP: f64 = 0.3;
/// Duration of the standstill before the first move and after the last move, in multiples of the design's standstill.
const END_STANDSTILLS: f64 = 2.0;

/// One move from point to point, with the minimum-jerk profile `10 u^3 - 15 u^4 + 6 u^5`, where `u` runs from 0 to 1. Speed
/// and acceleration are zero at both ends (Flash and Hogan 1985).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Move {
    /// Start time \[s\].
    pub start_s: f64,
    /// Duration \[s\].
    pub duration_s: f64,
    /// Change of each joint during the move \[rad\].
    pub by_rad: [f64; 5],
    /// Bar joints when all previous moves are complete \[rad\].
    pub from_rad: [f64; 5],
}

impl Move {
    /// Peak speed of the profile divided by its mean speed.
    const PEAK_SPEED: f64 = 1.875;
    /// Least duration of a move, to avoid large jerks \[s\].
    const DURATION_S_MIN: f64 = 0.5;

    /// End time \[s\].
    pub fn end_s(&self) -> f64 {
        self.start_s + self.duration_s
    }

    /// Bar joints when this move and all previous moves are complete \[rad\].
    pub(super) fn end_rad(&self) -> [f64; 5] {
        std::array::from_fn(|joint| self.from_rad[joint] + self.by_rad[joint])
    }

    /// Highest speed of the fastest joint in this move \[rad/s\].
    pub(super) fn peak_speed_rad_s(&self) -> f64 {
        Self::PEAK_SPEED * largest_size(self.by_rad) / self.duration_s
    }

    fn progress(&self, t_s: f64) -> f64 {
        let u = ((t_s - self.start_s) / self.duration_s).clamp(0.0, 1.0);
        u * u * u * (10.0 + u * (6.0 * u - 15.0))
    }
}

/// A path of the bar: start joints plus the sum of its moves. Where two moves overlap in time, the path rounds
/// the corner between them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Path {
    /// Bar joints before the first move \[rad\].
    pub start_rad: [f64; 5],
    /// Moves in the order of their start. A move can overlap only with its neighbours.
    pub moves: Vec<Move>,
    /// Duration of the recording \[s\]. The path is at rest before 0 and after its last move.
    pub duration_s: f64,
}

impl Path {
    /// A path without moves, with the duration of the design's run.
    pub fn at_rest(start_rad: [f64; 5], design: &Design) -> Self {
        Self { start_rad, moves: Vec::new(), duration_s: design.duration_s }
    }

    /// Bar joints at the end of the path \[rad\].
    pub fn end_rad(&self) -> [f64; 5] {
        self.moves.last().map_or(self.start_rad, Move::end_rad)
    }

    /// Adds a move to `to_rad`. The fastest joint reaches the peak speed `speed_rad_s`. If a standstill is due, the move
    /// starts after the standstill, otherwise shortly before the end of the previous move.
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

    /// Whether the last move ends early enough for the standstill at the end of the path.
    pub fn is_in_time(&self, design: &Design) -> bool {
        self.moves.last().map_or(0.0, Move::end_s) <= self.duration_s - END_STANDSTILLS * design.standstill_s
    }

    /// Bar joints at `t_s` \[rad\].
    pub fn at(&self, t_s: f64) -> [f64; 5] {
        let moves_begun = self.moves.partition_point(|step| step.start_s <= t_s);
        // Only the last two moves that have begun can still be incomplete, so only these two are evaluated. The computing
        // time therefore does not depend on the length of the path.
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
