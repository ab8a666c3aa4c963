//! Effect of the moving average on both logs, for reports.

use std::borrow::Cow;

use serde::Serialize;
use shared::time::UtcNs;

use super::bar_angles::BarReading;
use super::standstill::Standstill;
use crate::kinematics::BAR_JOINTS;
use crate::logs::{RobotLog, Row, Stream};
use crate::prepare::encoders::encoder_map::EncoderMap;

/// Part of the log that a picture shows on either side, in widths of the average.
const WIDTHS_ASIDE: f64 = 5.0;
/// Shortest such part \[s\].
const ASIDE_S_MIN: f64 = 1.0;

/// A reading and its average.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct AveragedPoint {
    /// Bar time since [`crate::prepare::Prepared::t_ref`] \[s\].
    pub t_s: f64,
    /// Speed from the readings \[rad/s\].
    pub speed_rad_s: f64,
    /// Speed from the averages \[rad/s\].
    pub averaged_rad_s: f64,
    /// Reading minus average \[rad\].
    pub removed_rad: f64,
}

/// Effect of the average on the joints of one log.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct AveragedJoints {
    /// Root mean square of reading minus average of each joint at standstills of robot and bar: noise \[rad\]. `None` without
    /// encoder or standstill.
    pub still_rad: Vec<Option<f64>>,
    /// The same of all other readings: noise, and the bends of the motion.
    pub moving_rad: Vec<Option<f64>>,
    /// The joint that was fastest of all, from 1.
    pub fastest_joint: usize,
    /// Its readings about that moment.
    pub fastest: Vec<AveragedPoint>,
}

/// Effect of the moving average.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Averaged {
    /// Over which time \[s\].
    pub width_s: f64,
    /// To the robot's log.
    pub robot: AveragedJoints,
    /// To the recording, by the joints on which the encoders sit.
    pub bar: AveragedJoints,
}

/// Both logs before they were averaged.
pub(in crate::prepare) struct BeforeAverage<'a> {
    pub width_s: f64,
    pub readings: Stream<BarReading>,
    pub log: Cow<'a, RobotLog>,
}

impl BeforeAverage<'_> {
    /// Averages both once more and compares. `standstills` count from `t_ref`, and `robot_time_s` takes a time of the robot's log
    /// there.
    pub fn compared(
        &self,
        t_ref: UtcNs,
        robot_time_s: impl Fn(f64) -> f64,
        encoder_map: &EncoderMap,
        standstills: &[Standstill],
    ) -> Averaged {
        let mut bar = Comparison::new(BAR_JOINTS);
        // Counters that restart have any offset: each part is compared separately.
        for part in self.readings.parts_within(f64::INFINITY) {
            let part = self.readings.slice(part);
            let begins_s = UtcNs(part.first_stamp_ns).seconds_since(t_ref);
            let angles = part.map(|reading| encoder_map.applied(&reading.recorded_rad));
            bar.add(&angles, |t_s| begins_s + t_s, self.width_s, standstills);
        }
        let mut robot = Comparison::new(self.log.axes());
        robot.add(&self.log.q_rad, robot_time_s, self.width_s, standstills);
        let mut bar = bar.finish();
        let measured = encoder_map.measured();
        for of_joints in [&mut bar.still_rad, &mut bar.moving_rad] {
            of_joints
                .iter_mut()
                .zip(measured)
                .filter(|(_, measured)| !measured)
                .for_each(|(rms, _)| *rms = None);
        }
        Averaged { width_s: self.width_s, robot: robot.finish(), bar }
    }
}

/// Sum and number of squares.
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

/// Readings beside their averages, part by part of a log.
#[derive(Debug, Clone)]
struct Comparison {
    still: Vec<Squares>,
    moving: Vec<Squares>,
    fastest_rad_s: f64,
    fastest_joint: usize,
    fastest: Vec<AveragedPoint>,
}

impl Comparison {
    fn new(joints: usize) -> Self {
        let none = vec![Squares::default(); joints];
        Self { still: none.clone(), moving: none, fastest_rad_s: 0.0, fastest_joint: 0, fastest: Vec::new() }
    }

    /// Adds a part; `standstills` are in the order of time.
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
            let next = standstills.partition_point(|one| one.to_s < *t_s);
            let still = standstills.get(next).is_some_and(|one| one.from_s <= *t_s);
            let squares = if still { &mut self.still } else { &mut self.moving };
            for (squares, (shown, average)) in
                squares.iter_mut().zip(row.numbers().iter().zip(average.numbers()))
            {
                squares.add(shown - average);
            }
        }
        let joints = self.still.len();
        let point = |at: usize, joint: usize| point(&t_s, rows, &averages, at, joint);
        let fastest = (1..averages.len().saturating_sub(1))
            .flat_map(|at| (0..joints).map(move |joint| (at, joint)))
            .filter_map(|(at, joint)| Some((point(at, joint)?.averaged_rad_s.abs(), at, joint)))
            .max_by(|a, b| a.0.total_cmp(&b.0));
        let Some((speed_rad_s, at, joint)) = fastest.filter(|one| one.0 > self.fastest_rad_s) else { return };
        let aside_s = ASIDE_S_MIN.max(WIDTHS_ASIDE * width_s);
        let from = t_s.partition_point(|t| *t < t_s[at] - aside_s).max(1);
        let to = t_s.partition_point(|t| *t <= t_s[at] + aside_s).min(averages.len() - 1);
        (self.fastest_rad_s, self.fastest_joint) = (speed_rad_s, joint + 1);
        self.fastest = (from..to).filter_map(|at| point(at, joint)).collect();
    }

    fn finish(self) -> AveragedJoints {
        let rms = |of_joints: Vec<Squares>| of_joints.into_iter().map(Squares::rms).collect();
        AveragedJoints {
            still_rad: rms(self.still),
            moving_rad: rms(self.moving),
            fastest_joint: self.fastest_joint,
            fastest: self.fastest,
        }
    }
}

/// A reading of one joint between its neighbours; `None` beside a hole.
fn point<R: Row>(
    t_s: &[f64],
    rows: &[R],
    averages: &[Option<R>],
    at: usize,
    joint: usize,
) -> Option<AveragedPoint> {
    let [before, here, after] = [at - 1, at, at + 1].map(|at| averages[at].map(|row| row.numbers()[joint]));
    let (before, here, after) = (before?, here?, after?);
    let shown = |at: usize| rows[at].numbers()[joint];
    let time_s = t_s[at + 1] - t_s[at - 1];
    Some(AveragedPoint {
        t_s: t_s[at],
        speed_rad_s: (shown(at + 1) - shown(at - 1)) / time_s,
        averaged_rad_s: (after - before) / time_s,
        removed_rad: shown(at) - here,
    })
}
