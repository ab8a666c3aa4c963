//! Computes the effect of the moving average on both logs, for reports.
//!
//! The readings of both logs before the average are compared with their averages, joint by joint. The differences at
//! standstill show the noise that the average removes. In motion, the differences also show fast changes of the motion
//! that the average removes.

use std::borrow::Cow;

use serde::Serialize;
use shared::time::UtcNs;

use super::bar_angles::BarReading;
use super::standstill::Standstill;
use crate::kinematics::BAR_JOINTS;
use crate::logs::{RobotLog, Row, Stream};
use crate::prepare::encoders::encoder_map::EncoderMap;

/// Time that is shown before and after the instant of the largest speed, in widths of the average.
const SHOWN_WIDTHS: f64 = 5.0;
/// Smallest time that is shown before and after this instant \[s\].
const SHOWN_S_MIN: f64 = 1.0;

/// One reading of one joint, compared with its average.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct AveragedPoint {
    /// Bar time since [`crate::prepare::Prepared::t_ref`] \[s\].
    pub t_s: f64,
    /// Speed computed from the readings \[rad/s\].
    pub speed_rad_s: f64,
    /// Speed computed from the averages \[rad/s\].
    pub averaged_rad_s: f64,
    /// Reading minus average \[rad\].
    pub removed_rad: f64,
}

/// Effect of the average on the joints of one log.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct AveragedJoints {
    /// Root mean square of reading minus average at standstills of robot and bar, by joint \[rad\]. It shows the noise.
    /// `None` without encoder or standstill.
    pub still_rad: Vec<Option<f64>>,
    /// Root mean square of reading minus average in motion, by joint \[rad\]. It contains the noise, and fast changes of the
    /// motion that the average does not follow. `None` without encoder or motion.
    pub moving_rad: Vec<Option<f64>>,
    /// The joint with the largest averaged speed, counted from 1; 0 if no joint moves.
    pub fastest_joint: usize,
    /// Readings of this joint around the instant of its largest speed.
    pub fastest: Vec<AveragedPoint>,
}

/// Effect of the moving average on both logs.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Averaged {
    /// Width of the average \[s\].
    pub width_s: f64,
    /// Effect on the robot's log.
    pub robot: AveragedJoints,
    /// Effect on the recording, by bar joint.
    pub bar: AveragedJoints,
}

/// Both logs before they were averaged, and the width of the average.
pub(in crate::prepare) struct BeforeAverage<'a> {
    pub width_s: f64,
    pub readings: Stream<BarReading>,
    pub log: Cow<'a, RobotLog>,
}

impl BeforeAverage<'_> {
    /// Compares the readings of both logs with their averages, which are computed again here. `standstills` are in bar time
    /// since `t_ref` \[s\]. `bar_time_s` converts a time since the first stamp of the robot's log to bar time since `t_ref`.
    pub fn compare(
        &self,
        t_ref: UtcNs,
        bar_time_s: impl Fn(f64) -> f64,
        encoder_map: &EncoderMap,
        standstills: &[Standstill],
    ) -> Averaged {
        let mut bar = AveragingComparison::new(BAR_JOINTS);
        // Counters have another offset after a restart, so each part between restarts is averaged separately.
        for part in self.readings.parts_within(f64::INFINITY) {
            let part = self.readings.slice(part);
            let begins_s = UtcNs(part.first_stamp_ns).seconds_since(t_ref);
            let angles = part.map(|reading| encoder_map.applied(&reading.recorded_rad));
            bar.add(&angles, |t_s| begins_s + t_s, self.width_s, standstills);
        }
        let mut robot = AveragingComparison::new(self.log.axes());
        robot.add(&self.log.q_rad, bar_time_s, self.width_s, standstills);
        let mut bar = bar.finish();
        let measured = encoder_map.measured();
        for rms_rad in [&mut bar.still_rad, &mut bar.moving_rad] {
            let unmeasured = rms_rad.iter_mut().zip(measured).filter(|(_, measured)| !measured);
            unmeasured.for_each(|(rms, _)| *rms = None);
        }
        Averaged { width_s: self.width_s, robot: robot.finish(), bar }
    }
}

/// Sum and number of squared values.
#[derive(Debug, Clone, Copy, Default)]
struct Squares {
    sum: f64,
    count: usize,
}

impl Squares {
    fn add(&mut self, value: f64) {
        self.sum += value * value;
        self.count += 1;
    }

    fn rms(self) -> Option<f64> {
        (self.count > 0).then(|| (self.sum / self.count as f64).sqrt())
    }
}

/// Collects the differences between readings and averages of one log, one continuous part after the other.
#[derive(Debug, Clone)]
struct AveragingComparison {
    still: Vec<Squares>,
    moving: Vec<Squares>,
    fastest_rad_s: f64,
    fastest_joint: usize,
    fastest: Vec<AveragedPoint>,
}

impl AveragingComparison {
    fn new(joints: usize) -> Self {
        let none = vec![Squares::default(); joints];
        Self { still: none.clone(), moving: none, fastest_rad_s: 0.0, fastest_joint: 0, fastest: Vec::new() }
    }

    /// Adds a part of the log. `time_s` converts times of `rows` to the time of `standstills`. The standstills are in
    /// the order of time.
    fn add<R: Row>(
        &mut self,
        rows: &Stream<R>,
        time_s: impl Fn(f64) -> f64,
        width_s: f64,
        standstills: &[Standstill],
    ) {
        let averages = rows.averages(width_s);
        let t_s: Vec<f64> = rows.t_s.iter().map(|t_s| time_s(*t_s)).collect();
        for ((t_s, row), average) in t_s.iter().zip(rows.iter()).zip(&averages) {
            let Some(average) = average else { continue };
            let next = standstills.partition_point(|standstill| standstill.to_s < *t_s);
            let is_still = standstills.get(next).is_some_and(|standstill| standstill.from_s <= *t_s);
            let sums = if is_still { &mut self.still } else { &mut self.moving };
            let removed =
                row.numbers().iter().zip(average.numbers()).map(|(logged, average)| logged - average);
            sums.iter_mut().zip(removed).for_each(|(squares, removed)| squares.add(removed));
        }
        // Finds the largest averaged speed in this part. If it exceeds that of earlier parts, the readings
        // around it are stored.
        let joints = self.still.len();
        let point_at = |row: usize, joint: usize| point(&t_s, rows, &averages, row, joint);
        let rows_and_joints =
            (1..averages.len().saturating_sub(1)).flat_map(|row| (0..joints).map(move |joint| (row, joint)));
        let fastest = rows_and_joints
            .filter_map(|(row, joint)| Some((point_at(row, joint)?.averaged_rad_s.abs(), row, joint)))
            .max_by(|(a_rad_s, ..), (b_rad_s, ..)| a_rad_s.total_cmp(b_rad_s));
        let is_new_maximum = |(rad_s, ..): &(f64, usize, usize)| *rad_s > self.fastest_rad_s;
        let Some((rad_s, row, joint)) = fastest.filter(is_new_maximum) else {
            return;
        };
        let shown_s = SHOWN_S_MIN.max(SHOWN_WIDTHS * width_s);
        let from = t_s.partition_point(|t| *t < t_s[row] - shown_s).max(1);
        let to = t_s.partition_point(|t| *t <= t_s[row] + shown_s).min(averages.len() - 1);
        (self.fastest_rad_s, self.fastest_joint) = (rad_s, joint + 1);
        self.fastest = (from..to).filter_map(|row| point_at(row, joint)).collect();
    }

    fn finish(self) -> AveragedJoints {
        let rms = |by_joint: Vec<Squares>| by_joint.into_iter().map(Squares::rms).collect();
        AveragedJoints {
            still_rad: rms(self.still),
            moving_rad: rms(self.moving),
            fastest_joint: self.fastest_joint,
            fastest: self.fastest,
        }
    }
}

/// Compares the reading of a joint in a row with its average. Speeds are computed from the rows before and after, so the row
/// must be neither the first nor the last. `None` if one of these three rows has no average.
fn point<R: Row>(
    t_s: &[f64],
    rows: &[R],
    averages: &[Option<R>],
    row: usize,
    joint: usize,
) -> Option<AveragedPoint> {
    let average = |row: usize| averages[row].map(|average| average.numbers()[joint]);
    let (average_before, average_here, average_after) = (average(row - 1)?, average(row)?, average(row + 1)?);
    let logged = |row: usize| rows[row].numbers()[joint];
    let time_s = t_s[row + 1] - t_s[row - 1];
    Some(AveragedPoint {
        t_s: t_s[row],
        speed_rad_s: (logged(row + 1) - logged(row - 1)) / time_s,
        averaged_rad_s: (average_after - average_before) / time_s,
        removed_rad: logged(row) - average_here,
    })
}
