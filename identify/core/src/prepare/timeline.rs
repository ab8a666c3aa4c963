//! Overview of a run for reports.
//!
//! The input is the recording, the status of each cycle, the valid samples, and the joints predicted from the robot's
//! log. The output has at most [`Timeline::POINTS_MAX`] points, so a run of ten hours is thinned to a few thousand.
//! Each point represents the same number of consecutive cycles. The overview also lists standstills, jitter, and the
//! effect of a moving average.

use serde::Serialize;
use shared::recording::schema::CycleRecord;
use shared::time::UtcNs;

use super::readings::both_logs::BothLogs;
use super::readings::standstill::{Jitter, MOVING_RAD_S, Readings, Standstill, standstills};
use super::{Averaged, EncoderMap, Predictor};
use crate::kinematics::{BAR_JOINTS, Configuration, Joints, wrapped};
use crate::logs::Unwrapped;
use crate::model::ClockRelation;
use crate::statistics::largest_difference;
use crate::threads::rows;

/// Status of a bus cycle.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum SampleStatus {
    /// Valid, but beyond the wanted number of samples, or hardly moved since the last kept sample. Also the status of a
    /// valid cycle that is not classified yet.
    #[default]
    Thinned,
    /// Neither robot nor bar moves.
    Standstill,
    /// Too near to an end or a gap of the recording for a moving average.
    NotAveraged,
    /// At a time that the robot's log does not cover.
    Outside,
    /// In an origin of the counters with too few readings to find the offsets of this origin.
    OtherOrigin,
    /// Near a singular pose of the bar.
    Singular,
    /// The run has a force log, but the log has no force at this time.
    NoForce,
    /// Used by the solve.
    Kept,
    /// At least one encoder has no valid sample in this cycle, for example because its data are stale or flagged.
    Invalid,
    /// The time stamp is not later than the time stamp of the cycle before.
    TimeNotIncreasing,
    /// The residual of a joint angle in the refined fit is much larger than in the other samples.
    Outlier,
}

/// One instant of the timeline, which represents `cycles_per_point` consecutive cycles.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct TimelinePoint {
    /// Bar time since [`super::Prepared::t_ref`] \[s\].
    pub t_s: f64,
    /// The highest status among the cycles of this point. Later entries of [`SampleStatus`] are higher. A single outlier is
    /// therefore visible even if the point covers a minute.
    pub status: SampleStatus,
    /// Largest speed of any bar joint, over 0.1 s \[rad/s\]; `None` if the cycle is not valid or
    /// neighbouring samples are missing.
    pub bar_speed_rad_s: Option<f64>,
    /// Largest speed of any robot joint, over 0.1 s \[rad/s\]; `None` outside the robot's log.
    pub robot_speed_rad_s: Option<f64>,
    /// Whether `bar_speed_rad_s` is above [`super::MOVING_RAD_S`].
    pub bar_moves: Option<bool>,
    /// Whether `robot_speed_rad_s` is above [`super::MOVING_RAD_S`].
    pub robot_moves: Option<bool>,
    /// Measured bar joints with offsets added, in one configuration of the bar, each in (-pi, pi] \[rad\]. Joints without
    /// encoder have the predicted value. `None` for invalid cycles.
    pub measured_rad: Option<[f64; BAR_JOINTS]>,
    /// Bar joints predicted from the robot's log, in the same configuration \[rad\]; `None` outside the log.
    pub predicted_rad: Option<[f64; BAR_JOINTS]>,
    /// Robot joints at this instant \[rad\]; `None` outside the robot's log.
    pub robot_rad: Option<Joints>,
    /// Predicted distance of the bar from its nearest singular pose \[rad\].
    pub margin_rad: Option<f64>,
}

impl TimelinePoint {
    /// Measured minus predicted joints \[rad\]; 0 for joints without encoder.
    pub fn off_rad(&self) -> Option<[f64; BAR_JOINTS]> {
        let (measured, predicted) = (self.measured_rad?, self.predicted_rad?);
        Some(std::array::from_fn(|joint| wrapped(measured[joint] - predicted[joint])))
    }
}

/// Overview of the preparation for reports.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Timeline {
    /// Points in the order of time, spread evenly over the cycles of the recording; at most [`Timeline::POINTS_MAX`].
    pub points: Vec<TimelinePoint>,
    /// Number of cycles that each point represents.
    pub cycles_per_point: usize,
    /// Intervals of bar time in which neither robot nor bar moves.
    pub standstills: Vec<Standstill>,
    /// Noise of the encoders at standstill (figure 5.2 of the thesis).
    pub jitter: Jitter,
    /// Encoders that wrapped and were made continuous.
    pub unwrapped_encoders: Vec<Unwrapped>,
    /// Robot joints that wrapped and were made continuous.
    pub unwrapped_joints: Vec<Unwrapped>,
    /// Effect of the moving average, if there is one.
    pub averaged: Option<Averaged>,
}

impl Timeline {
    /// Largest number of points of a timeline.
    pub const POINTS_MAX: usize = 3000;
}

/// Results of the preparation from which the timeline is made.
pub(super) struct PreparedRun<'a> {
    /// All cycles of the recording.
    pub cycles: &'a [CycleRecord],
    /// Readings of the recording and of the robot's log.
    pub both: &'a BothLogs<'a>,
    /// Reference time on the bar's clock.
    pub t_ref: UtcNs,
    /// Converts bar time since `t_ref` to the time of the robot's log, counted from its first stamp.
    pub clock: ClockRelation,
    /// Status of every cycle.
    pub statuses: &'a [SampleStatus],
    /// Samples of all valid cycles, in the order of time.
    pub samples: &'a [Sample],
    /// Joint and direction of each encoder.
    pub encoder_map: &'a EncoderMap,
    /// Configuration of the bar in which all angles are shown.
    pub configuration: Configuration,
    /// The robot's log and the bar joints predicted from it.
    pub predictor: &'a Predictor<'a>,
}

/// A valid sample of the bar.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sample {
    /// Index of the sample's cycle in the recording.
    pub cycle: usize,
    /// Bar time since the reference time \[s\].
    pub t_s: f64,
    /// Bar joints with offsets added \[rad\].
    pub bar_rad: [f64; BAR_JOINTS],
}

/// Half the time over which speeds are averaged \[s\].
const SPEED_REACH_S: f64 = 0.05;

impl PreparedRun<'_> {
    pub fn timeline(&self) -> Timeline {
        let cycles_per_point = self.statuses.len().div_ceil(Timeline::POINTS_MAX).max(1);
        let points = self
            .statuses
            .chunks(cycles_per_point)
            .enumerate()
            .filter_map(|(chunk, statuses)| {
                let noteworthy = statuses.iter().enumerate().max_by_key(|(_, status)| **status);
                noteworthy.map(|(index, status)| self.point(chunk * cycles_per_point + index, *status))
            })
            .collect();
        let (standstills, jitter) = standstills(&self.readings_at_standstill(), &self.encoder_map.measured());
        let averaged = self.both.averaged(self.t_ref, self.clock, self.encoder_map, &standstills);
        let [unwrapped_encoders, unwrapped_joints] = self.both.unwrapped.clone();
        Timeline {
            points,
            cycles_per_point,
            standstills,
            jitter,
            unwrapped_encoders,
            unwrapped_joints,
            averaged,
        }
    }

    fn point(&self, cycle: usize, status: SampleStatus) -> TimelinePoint {
        let sample = self.samples.binary_search_by_key(&cycle, |sample| sample.cycle).ok();
        let time = self.cycles.get(cycle).map(|cycle| cycle.sample_time);
        let t_s = time.map_or(0.0, |time| time.seconds_since(self.t_ref));
        let tau_s = self.clock.robot_time_s(t_s);
        let predicted = self.predictor.at(tau_s);
        let predicted_rad = predicted.map(|bar| self.in_configuration(&bar.joints_rad));
        let bar_speed_rad_s = sample.and_then(|index| bar_speed_rad_s(self.samples, index));
        let robot_speed_rad_s = self.robot_speed_rad_s(tau_s);
        let moves = |speed: Option<f64>| speed.map(|speed| speed > MOVING_RAD_S);
        let measured = sample.and_then(|index| self.samples.get(index));
        TimelinePoint {
            t_s,
            status,
            bar_speed_rad_s,
            robot_speed_rad_s,
            bar_moves: moves(bar_speed_rad_s),
            robot_moves: moves(robot_speed_rad_s),
            measured_rad: measured.map(|sample| self.shown(&sample.bar_rad, predicted_rad)),
            predicted_rad,
            robot_rad: self.predictor.robot_at(tau_s),
            margin_rad: predicted.map(|bar| bar.margin_rad),
        }
    }

    /// Measured joints in the configuration that is shown. Joints without encoder have the predicted value, if there is one.
    fn shown(
        &self,
        bar_rad: &[f64; BAR_JOINTS],
        predicted_rad: Option<[f64; BAR_JOINTS]>,
    ) -> [f64; BAR_JOINTS] {
        let measured = self.encoder_map.measured();
        let filled = std::array::from_fn(|joint| match predicted_rad {
            Some(predicted_rad) if !measured[joint] => predicted_rad[joint],
            _ => bar_rad[joint],
        });
        self.in_configuration(&filled)
    }

    /// Converts bar joints to the configuration that is shown.
    fn in_configuration(&self, bar_rad: &[f64; BAR_JOINTS]) -> [f64; BAR_JOINTS] {
        self.configuration.carry(self.predictor.bar_links(), bar_rad)
    }

    /// Largest speed of any robot joint at `tau_s`, the time since the log's first stamp \[rad/s\]; `None` outside the log.
    fn robot_speed_rad_s(&self, tau_s: f64) -> Option<f64> {
        let before = self.predictor.robot_at(tau_s - SPEED_REACH_S)?;
        let after = self.predictor.robot_at(tau_s + SPEED_REACH_S)?;
        Some(largest_difference(&after, &before) / (2.0 * SPEED_REACH_S))
    }

    /// Readings of the samples at which neither robot nor bar moves.
    fn readings_at_standstill(&self) -> Vec<Readings> {
        let slow = |speed: Option<f64>| speed.is_some_and(|speed| speed < MOVING_RAD_S);
        let tau_s = |index: usize| self.clock.robot_time_s(self.samples[index].t_s);
        let is_still = rows(self.samples.len(), |index| {
            slow(bar_speed_rad_s(self.samples, index)) && slow(self.robot_speed_rad_s(tau_s(index)))
        });
        let reading = |index: usize| {
            let Sample { t_s, bar_rad, .. } = self.samples[index];
            Some(Readings { t_s, bar_rad, robot_rad: self.predictor.robot_at(tau_s(index))? })
        };
        (0..self.samples.len()).filter(|index| is_still[*index]).filter_map(reading).collect()
    }
}

/// Largest speed of any bar joint around sample `index` \[rad/s\], from two samples about [`SPEED_REACH_S`] before and after
/// it; `None` if no sample before or after it is near enough.
fn bar_speed_rad_s(samples: &[Sample], index: usize) -> Option<f64> {
    let t_s = samples.get(index)?.t_s;
    let reach_s = SPEED_REACH_S * 1.01;
    // On each side, the farthest sample that is still within the reach.
    let from = samples.partition_point(|sample| sample.t_s < t_s - reach_s);
    let to = samples.partition_point(|sample| sample.t_s <= t_s + reach_s);
    let before = samples.get(from..index)?.first()?;
    let after = samples.get(index + 1..to)?.last()?;
    Some(largest_difference(&after.bar_rad, &before.bar_rad) / (after.t_s - before.t_s))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_slow_at_the_highest_rate_too() {
        for rate_hz in [100, 1000] {
            let sample = |cycle: usize| Sample {
                cycle,
                t_s: cycle as f64 / rate_hz as f64,
                bar_rad: [if cycle.is_multiple_of(7) { 75e-6 } else { 0.0 }; BAR_JOINTS],
            };
            let samples: Vec<Sample> = (0..rate_hz).map(sample).collect();
            let speed = |index: usize| bar_speed_rad_s(&samples, index);
            let fastest = (1..rate_hz - 1).filter_map(speed).fold(0.0, f64::max);
            assert!(fastest < MOVING_RAD_S, "{rate_hz} Hz: {fastest}");
            assert_eq!([speed(0), speed(rate_hz - 1)], [None, None]);
        }
    }
}
