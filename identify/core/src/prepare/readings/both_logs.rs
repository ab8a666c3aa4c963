//! Makes both logs continuous and, optionally, averages them. The logs from before the average are retained, to report the
//! effect of the average.

use std::borrow::Cow;

use shared::recording::schema::{CycleRecord, EncoderInfo};
use shared::time::UtcNs;

use super::averaged::{Averaged, BeforeAverage};
use super::bar_angles::{BarAngles, bar_angles};
use super::standstill::Standstill;
use super::unwrap::{unwrapped_counters, unwrapped_log};
use crate::logs::{RobotLog, Unwrapped};
use crate::model::ClockRelation;
use crate::prepare::{EncoderMap, PrepareError, PrepareOptions};
use crate::threads::both;

/// Both logs after they were made continuous and, optionally, averaged.
pub(in crate::prepare) struct BothLogs<'a> {
    pub angles: BarAngles,
    pub log: Cow<'a, RobotLog>,
    /// First the encoders of the bar that wrapped, then the joints of the robot that wrapped.
    pub unwrapped: [Vec<Unwrapped>; 2],
    /// Both logs before they were averaged; `None` without an average.
    before: Option<BeforeAverage<'a>>,
}

impl<'a> BothLogs<'a> {
    /// Makes both logs continuous, and averages them if the options contain a width.
    ///
    /// # Errors
    /// As [`bar_angles`].
    pub fn new(
        cycles: &[CycleRecord],
        encoders: &[EncoderInfo],
        log: &'a RobotLog,
        options: &PrepareOptions,
    ) -> Result<Self, PrepareError> {
        let read_bar = || {
            let angles = bar_angles(cycles, encoders)?;
            Ok::<_, PrepareError>((unwrapped_counters(cycles, encoders, &angles), angles))
        };
        let (bar, (mut log, unwrapped_joints)) = both(read_bar, || unwrapped_log(log));
        let (unwrapped_encoders, mut angles) = bar?;
        let width_s = options.moving_average_ms * 1e-3;
        let before = (width_s > 0.0).then(|| {
            let readings = angles.average(width_s);
            let (before, after) = (readings.len(), angles.readings.len());
            tracing::debug!(before, after, width_s, "moving average over both logs");
            let averaged = RobotLog { q_rad: log.q_rad.averaged(width_s).into(), ..(*log).clone() };
            BeforeAverage { width_s, readings, log: std::mem::replace(&mut log, Cow::Owned(averaged)) }
        });
        Ok(Self { angles, log, unwrapped: [unwrapped_encoders, unwrapped_joints], before })
    }

    /// Computes the effect of the average; `None` if the logs were not averaged. `clock` and the standstills are for
    /// bar times since `t_ref`.
    pub fn averaged(
        &self,
        t_ref: UtcNs,
        clock: ClockRelation,
        encoder_map: &EncoderMap,
        standstills: &[Standstill],
    ) -> Option<Averaged> {
        let before = self.before.as_ref()?;
        // Robot time counts from the first row of a log. The first rows have no average, so the averaged log begins later
        // than the original log. `clock` is for the averaged log.
        let first_ns = before.log.q_rad.first_stamp_ns;
        let begins_s = self.log.q_rad.first_stamp_ns.saturating_sub(first_ns) as f64 * 1e-9;
        let bar_time_s = |tau_s| (tau_s - begins_s - clock.shift_s) / (1.0 + clock.skew);
        Some(before.compare(t_ref, bar_time_s, encoder_map, standstills))
    }
}
