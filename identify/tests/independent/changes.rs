//! Runs in which something changes at one instant, and runs without a change. The tests check the messages of the program by
//! type and size of the change.
#![allow(clippy::print_stdout, reason = "figures of a run")]

use super::campaign::{Outcome, calibrate, chosen, number, sizes};
use super::*;
use crate::support::campaign::step;

/// Prefix of the reason of a refusal.
const REFUSED: &str = "REFUSED";

/// Type and size of an error that is added to a run.
#[derive(Debug, Clone, Copy)]
enum Injected {
    Nothing,
    /// Step of the encoder of a bar joint: joint from 0, size \[mrad\].
    Encoder(usize, f64),
    /// Linear drift of the encoder of a bar joint: joint from 0, total drift from the first cycle to the last \[mrad\].
    Drift(usize, f64),
    /// Step of the true minus the logged angle of a robot joint: joint from 0, size \[mrad\].
    Joint(usize, f64),
    /// Displacement of the bar's base along x \[mm\].
    Base(f64),
    /// Step of the bar's stamps \[ms\]. Stamps of the bar are too irregular to reveal the step on their own.
    Clock(f64),
    /// Delay of a drive in the whole log: drive from 0, delay \[ms\].
    LateJoint(usize, f64),
    /// Ratio error of a drive in the whole log: drive from 0, true minus logged motion \[%\].
    Ratio(usize, f64),
    /// Rotation of the plate about the axis of the flange in the whole run \[deg\].
    Plate(f64),
}

impl Injected {
    /// Whether the error is the same from the first row to the last.
    fn lasts(self) -> bool {
        matches!(self, Self::LateJoint(..) | Self::Ratio(..) | Self::Plate(_))
    }

    /// Texts that the program must output: the first if it refuses the run, the second if it warns.
    fn named(self) -> [String; 2] {
        let both = |refused: &str, warned: &str| [refused.to_owned(), warned.to_owned()];
        match self {
            Self::Nothing => both(REFUSED, "Something changed"),
            Self::Encoder(joint, _) => [
                format!("the encoder of joint {} slips", joint + 1),
                format!("the encoder of joint {} steps by", joint + 1),
            ],
            Self::Drift(joint, _) => {
                both("no drift is refused", &format!("the encoder of joint {} drifts by", joint + 1))
            }
            Self::Joint(joint, _) => [
                format!("the log of the robot's joint {} steps", joint + 1),
                format!("the zero of joint {} steps by", joint + 1),
            ],
            Self::Base(_) => both("the base of the bar moves by", "the base of the bar steps by"),
            Self::Clock(_) => both("a clock jumps", "the robot's clock steps by"),
            Self::LateJoint(joint, _) => {
                both("no late joint is refused", &format!("later than the others: joint {} by ", joint + 1))
            }
            Self::Ratio(joint, _) => {
                let joint = joint + 1;
                [format!("joint {joint} turns by another part"), format!("Joint {joint} turns by ")]
            }
            Self::Plate(_) => both("the offset plate is rotated by", "The offset plate is rotated by"),
        }
    }
}

impl Run {
    /// True angles of the robot, interpolated between the rows of the log \[rad\].
    fn true_angles(&self, time_s: f64) -> RowVector6<f64> {
        let after = self.true_rows.partition_point(|row| row.0 <= time_s).clamp(1, self.true_rows.len() - 1);
        let [(from_s, from), (to_s, to)] = [self.true_rows[after - 1], self.true_rows[after]];
        let part = (time_s - from_s) / (to_s - from_s);
        RowVector6::from_fn(|_, joint| from[joint] + part * (to[joint] - from[joint]))
    }

    /// Writes the files of a run with a change. The change occurs after the fraction `part` of the run.
    fn write_changed(&self, injected: Injected, part: f64, directory: &Path) -> Files {
        let (mut rows, mut cycles) = (self.rows.clone(), self.cycles.clone());
        let at_s = part * self.motion.duration_s;
        for (time_s, counts) in &mut cycles {
            let (late, along) = (*time_s > at_s, *time_s / self.motion.duration_s);
            let by = match injected {
                Injected::Encoder(joint, mrad) if late => (joint, mrad),
                Injected::Drift(joint, mrad) => (joint, mrad * along),
                _ => (0, 0.0),
            };
            let count = &mut counts[by.0];
            let more = by.1 * 1e-3 / std::f64::consts::TAU * COUNTS_PER_TURN;
            *count = count.wrapping_add_signed(more.round() as i32);
            if let (Injected::Clock(ms), true) = (injected, late) {
                *time_s += ms * 1e-3;
            }
        }
        let raw_from_joints = self.robot.joints_from_raw.try_inverse().unwrap();
        for (row, (time_s, angles)) in
            rows.iter_mut().zip(&self.true_rows).filter(|(_, truth)| injected.lasts() || truth.0 > at_s)
        {
            let mut more = RowVector6::zeros();
            match injected {
                Injected::Joint(joint, mrad) => more[joint] = -mrad * 1e-3,
                Injected::Base(mm) => {
                    let bar_rad = self.motion.bar_rad(*time_s);
                    let mut pose = self.true_bar.pose(&bar_rad, self.motion.longer_m(&bar_rad));
                    pose[(0, 3)] += mm * 1e-3;
                    let moved = self.true_arm.inverse_near(&pose, angles).unwrap();
                    more = RowVector6::from_fn(|_, joint| moved[joint] - angles[joint]);
                }
                Injected::Plate(deg) => more[5] = deg.to_radians(),
                _ => {}
            }
            let mut raw = more * raw_from_joints;
            // The errors are errors of the log's columns, not of joints.
            let reported = |time_s: f64| self.true_angles(time_s) * raw_from_joints;
            match injected {
                Injected::LateJoint(column, ms) => {
                    raw[column] += reported(*time_s - ms * 1e-3)[column] - reported(*time_s)[column];
                }
                Injected::Ratio(column, percent) => raw[column] -= percent * 1e-2 * reported(*time_s)[column],
                _ => {}
            }
            (0..6).for_each(|joint| row.1[joint] += raw[joint]);
        }
        self.write_as(&rows, &cycles, directory)
    }
}

/// Calibrates a run with a change. Returns the messages of the program and the outcome. The messages are the reason of a
/// refusal or the report of a calibration.
fn said_of(run: &Run, injected: Injected, part: f64) -> (String, Outcome) {
    let directory = tempfile::tempdir().unwrap();
    let (files, out) = (run.write_changed(injected, part, directory.path()), directory.path().join("out"));
    let output = calibrate(&files, &out);
    let outcome = Outcome::from_output(run, &output, &out);
    let said = match &outcome {
        Outcome::Refused(_) => outcome.to_string(),
        Outcome::Calibrated { .. } => std::fs::read_to_string(out.join("report.html")).unwrap(),
    };
    (said, outcome)
}

#[test]
#[ignore = "several calibrations: half a minute"]
fn what_changes_is_named_and_nothing_is_named_that_does_not() {
    let sizes = Sizes { duration_s: Some(60.0), ..Sizes::default() };
    let run = Run::new(Robot::irb2400(), Family::Waypoints, &sizes, 11);
    let all = [
        Injected::Nothing,
        Injected::Encoder(2, 1.0),
        Injected::Joint(1, 1.0),
        Injected::Base(1.0),
        Injected::Clock(8.0),
        Injected::Drift(3, 1.0),
    ];
    for injected in all {
        let (told, _) = said_of(&run, injected, 0.45);
        let named = injected.named().iter().any(|name| told.contains(name));
        assert_eq!(named, !matches!(injected, Injected::Nothing), "{injected:?}: {told}");
    }
}

/// `cargo test -p identify --test all changes_by_size -- --ignored --nocapture`. The environment variables of
/// `independent_campaign` select runs. `IDENTIFY_SIZES=none` evaluates only runs without a change. `IDENTIFY_SIZES=lasting`
/// also evaluates runs with an error that lasts from the first row to the last.
#[test]
#[ignore = "five runs with 73 changes each: minutes"]
fn changes_by_size() {
    let (first, seeds) = (number("IDENTIFY_FIRST_SEED", 1), number("IDENTIFY_SEEDS", 1));
    let mut all = vec![Injected::Nothing];
    let wanted = std::env::var("IDENTIFY_SIZES").unwrap_or_default();
    if wanted.is_empty() {
        for size in [0.05, 0.1, 0.2, 0.5, 1.0, 2.0] {
            all.extend((0..5).map(|joint| Injected::Encoder(joint, size)));
            all.extend([Injected::Joint(1, size), Injected::Joint(3, size), Injected::Base(size)]);
            all.push(Injected::Drift(3, size));
        }
        all.extend([0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0].map(Injected::Clock));
    }
    if wanted.is_empty() || wanted == "lasting" {
        all.extend([1.0, 2.0, 5.0].map(|ms| Injected::LateJoint(2, ms)));
        all.extend([0.1, 0.3, 1.0].map(|percent| Injected::Ratio(2, percent)));
        all.extend([2.0, 5.0, 45.0, 90.0].map(Injected::Plate));
    }
    // Each robot has a different path.
    let paths = Robot::all().into_iter().zip(Family::ALL).filter(|(robot, family)| {
        chosen("IDENTIFY_ROBOTS", robot.name) && chosen("IDENTIFY_PATHS", &format!("{family:?}"))
    });
    let mut wrong = Vec::new();
    for (place, (robot, family)) in paths.enumerate() {
        for seed in first..first + seeds {
            let run = Run::new(robot.clone(), family, &sizes(family, seed), seed);
            for injected in all.iter().skip(place % step()).step_by(step()) {
                let (told, outcome) = said_of(&run, *injected, 0.3 + 0.1 * (seed % 5) as f64);
                let [refused, warned] = injected.named();
                let other =
                    || told.lines().find(|line| line.contains(REFUSED) || line.contains("Something changed"));
                let verdict = if told.contains(&refused) {
                    "REFUSED".to_owned()
                } else if told.contains(&warned) {
                    "WARNED".to_owned()
                } else {
                    other().map_or("passes".to_owned(), |other| format!("OTHER {other}"))
                };
                let line =
                    format!("{:8} {family:?} {seed} {injected:?}: {verdict}; {outcome}", run.robot.name);
                println!("{line}");
                if matches!(injected, Injected::Nothing) && verdict != "passes" {
                    wrong.push(line);
                }
            }
        }
    }
    assert!(wrong.is_empty(), "sound runs in which something is said to have changed: {wrong:#?}");
}
