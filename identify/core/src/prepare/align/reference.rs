//! The reference time of two aligned logs.

use shared::time::UtcNs;

use super::correlate::Match;
use crate::logs::RobotLog;
use crate::model::ClockRelation;
use crate::prepare::Alignment;

/// The reference time, to which all times of the result refer: the middle of the overlap of both logs. The *other log* is
/// the recording of the bar or the tracker's log.
pub(in crate::prepare) struct ReferenceTime {
    /// Start and end of the overlap of both logs, counted from the other log's first sample \[s\].
    overlap_s: [f64; 2],
    /// Reference time, counted from the other log's first sample \[s\].
    pub t_ref_s: f64,
    /// Reference time on the other log's clock.
    pub t_ref: UtcNs,
    /// Converts times of the other log since the reference time to times since the first stamp of the robot's log.
    pub clock: ClockRelation,
}

impl ReferenceTime {
    /// Finds the reference time. The samples of the other log begin at `first` and end `end_s` later \[s\]. The times of the
    /// other log in `clock` count from `first`.
    pub fn new(first: UtcNs, end_s: f64, clock: ClockRelation, log_duration_s: f64) -> Self {
        let other_time_s = |tau_s: f64| (tau_s - clock.shift_s) / (1.0 + clock.skew);
        let from_s = other_time_s(0.0).clamp(0.0, end_s);
        let overlap_s = [from_s, other_time_s(log_duration_s).clamp(from_s, end_s)];
        let t_ref_s = 0.5 * (overlap_s[0] + overlap_s[1]);
        let t_ref = first.plus_ns((t_ref_s * 1e9).round() as i64);
        Self { overlap_s, t_ref_s, t_ref, clock: clock.counted_from(t_ref_s) }
    }

    pub fn alignment(&self, matched: &Match, ambiguous: bool, log: &RobotLog) -> Alignment {
        let after_first_ns = (self.clock.shift_s * 1e9).round() as i64;
        let robot_ref_ns = log.q_rad.first_stamp_ns.saturating_add(after_first_ns);
        Alignment {
            correlation: matched.correlation,
            runner_up: matched.runner_up,
            ambiguous,
            overlap_s: self.overlap_s[1] - self.overlap_s[0],
            clock_difference_ns: robot_ref_ns.saturating_sub(self.t_ref.0),
            skew: self.clock.skew,
        }
    }
}
