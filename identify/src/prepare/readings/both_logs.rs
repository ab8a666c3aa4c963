//! Both logs as all later steps get them: continuous, and averaged where that is asked for.

use std::borrow::Cow;

use shared::recording::schema::{CycleRecord, EncoderInfo};
use shared::time::UtcNs;

use super::averaged::{Averaged, BeforeAverage};
use super::bar_angles::{BarAngles, BarSegment, bar_angles};
use super::smooth::{smoothed_log, smoothed_segments};
use super::standstill::Standstill;
use super::unwrap::{unwrapped_counters, unwrapped_log};
use crate::logs::{RobotLog, Unwrapped, default_gap_limit_s};
use crate::prepare::{ClockFit, EncoderMap, PrepareError, PrepareOptions, SampleStatus};

/// What the bar and the robot say.
pub(in crate::prepare) struct BothLogs<'a> {
    pub angles: BarAngles,
    pub log: Cow<'a, RobotLog>,
    /// What began anew in either.
    pub unwrapped: [Vec<Unwrapped>; 2],
    before: Option<Before<'a>>,
}

/// Both before they were averaged.
struct Before<'a> {
    width_s: f64,
    segments: Vec<BarSegment>,
    log: Cow<'a, RobotLog>,
}

impl<'a> BothLogs<'a> {
    /// # Errors
    /// As [`bar_angles`].
    pub fn new(
        cycles: &[CycleRecord],
        encoders: &[EncoderInfo],
        log: &'a RobotLog,
        options: &PrepareOptions,
    ) -> Result<Self, PrepareError> {
        let angles = bar_angles(cycles, encoders)?;
        let of_bar = unwrapped_counters(cycles, encoders, &angles);
        let (log, of_robot) = unwrapped_log(log);
        let unwrapped = [of_bar, of_robot];
        let both = Self { angles, log, unwrapped, before: None };
        let width_s = options.moving_average_ms * 1e-3;
        Ok(if width_s > 0.0 { both.smoothed(width_s) } else { both })
    }

    /// Averaged in the same way.
    fn smoothed(mut self, width_s: f64) -> Self {
        let segments = smoothed_segments(&self.angles.segments, width_s);
        let log = smoothed_log(&self.log, width_s, default_gap_limit_s(&self.log));
        let segments = std::mem::replace(&mut self.angles.segments, segments);
        // Those that have an average get theirs later.
        let valid = self.angles.statuses.iter_mut().filter(|status| **status == SampleStatus::Thinned);
        valid.for_each(|status| *status = SampleStatus::NotAveraged);
        let after = self.angles.segments.len();
        tracing::debug!(before = segments.len(), after, width_s, "moving average over both logs");
        let log = std::mem::replace(&mut self.log, Cow::Owned(log));
        Self { before: Some(Before { width_s, segments, log }), ..self }
    }

    /// What the average did. `clock` fits times since `t_ref`, as the standstills are.
    pub fn averaged(
        &self,
        t_ref: UtcNs,
        clock: ClockFit,
        encoder_map: &EncoderMap,
        standstills: &[Standstill],
    ) -> Option<Averaged> {
        let before = self.before.as_ref()?;
        // The first average is a width after the first row.
        let begins_s = self.log.first_stamp_ns.saturating_sub(before.log.first_stamp_ns) as f64 * 1e-9;
        let compared = BeforeAverage {
            width_s: before.width_s,
            segments: &before.segments,
            bar_time_s: &|segment, at| segment.times.get(at).map_or(0.0, |time| time.seconds_since(t_ref)),
            encoder_map,
            log: &before.log,
            robot_time_s: &|tau_s| (tau_s - begins_s - clock.shift_s) / (1.0 + clock.skew),
            standstills,
        };
        Some(compared.compared())
    }
}
