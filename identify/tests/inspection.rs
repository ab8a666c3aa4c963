//! `inspect` reports faults of a log without a solve. A log without faults causes no reports.
#![allow(clippy::unwrap_used, reason = "tests")]

use crate::support::{bar, irb2400};
use identify::inspect::{self, curves};
use identify::kinematics::Joints;
use identify::logs::{RobotLog, Stream, ValueOrigin};
use identify::report::table;
use identify::simulate::{self, Experiment, Simulated};
use shared::config::JointKind;
use shared::recording::Recording;

fn simulated() -> Simulated {
    simulate::run(&Experiment::new(&irb2400(), &bar())).unwrap()
}

/// The simulated recording, written to a file and read again.
fn recording() -> Recording {
    let directory = tempfile::tempdir().unwrap();
    let (robot, bar) = (irb2400(), bar());
    simulate::write(directory.path(), &simulated(), &robot, &bar).unwrap();
    Recording::open(&directory.path().join("recording.mcap")).unwrap()
}

fn sentences(recording: &Recording) -> String {
    inspect::recording(recording).suspicious.join("\n")
}

#[test]
fn a_sound_recording_and_its_log_are_not_suspected() {
    let inspection = inspect::recording(&recording());
    assert_eq!(inspection.suspicious, Vec::<String>::new());
    assert_eq!(inspection.joints.len(), 5);
    let log = inspect::robot_log(&simulated().robot_log, &irb2400());
    assert_eq!(log.suspicious, Vec::<String>::new());
    assert_eq!(log.joints.len(), 6);
}

#[test]
fn counts_that_jump_are_suspected_by_the_encoder_s_name() {
    let mut jumped = recording();
    for cycle in &mut jumped.cycles[5000..] {
        cycle.encoders[2].count = cycle.encoders[2].count.wrapping_add(3_000_000);
    }
    let told = sentences(&jumped);
    assert!(told.contains("b3") && told.contains("slipped"), "{told}");
}

#[test]
fn clocks_that_jump_and_counters_with_a_new_origin_are_suspected() {
    let mut odd = recording();
    odd.cycles[4000].sample_time = odd.cycles[3990].sample_time;
    odd.cycles[8000..].iter_mut().for_each(|cycle| cycle.origin = 1);
    let told = sentences(&odd);
    assert!(told.contains("time does not increase at 1") && told.contains("new origin at 1"), "{told}");
}

#[test]
fn frozen_and_commanded_logs_are_suspected() {
    let mut log: RobotLog = simulated().robot_log;
    log.origin = ValueOrigin::Commanded;
    // At the highest speed, the joints are repeated for 30 rows and then jump.
    let step = |row: &usize| (log.q_rad[row + 30][0] - log.q_rad[*row][0]).abs();
    let fastest = (0..log.q_rad.len() - 30).max_by(|a, b| step(a).total_cmp(&step(b))).unwrap();
    let held = log.q_rad[fastest];
    log.q_rad[fastest..fastest + 30].fill(held);
    let told = inspect::robot_log(&log, &irb2400()).suspicious.join("\n");
    assert!(told.contains("29 rows repeat") && told.contains("commanded ones"), "{told}");
}

#[test]
fn a_joint_that_does_not_move_is_suspected() {
    let mut log = simulated().robot_log;
    log.q_rad.iter_mut().for_each(|q| q[3] = 0.1);
    let told = inspect::robot_log(&log, &irb2400()).suspicious.join("\n");
    assert!(told.contains("q4 moved by less than 5 degrees"), "{told}");
}

/// Joint 1 is a slide that moves by 20 mm in a second. Joint 4 moves so little that it is treated as standing still.
#[test]
fn a_slide_is_shown_in_millimetres_and_a_still_joint_of_the_robot_has_no_plug() {
    let mut robot = irb2400();
    robot.links[0].joint = JointKind::Prismatic;
    let t_s: Vec<f64> = (0..=100).map(|row| 0.01 * f64::from(row)).collect();
    let at = |t_s: &f64| Joints::from([0.02 * t_s, 0.5 * t_s, 0.5 * t_s, 0.1, 0.5 * t_s, 0.5 * t_s]);
    let q_rad = t_s.iter().map(at).collect();
    let log = RobotLog { q_rad: Stream::new(0, t_s, q_rad).into(), ..RobotLog::default() };
    let found = inspect::robot_log(&log, &robot);
    let [slide, turned] = [&found.joints[0], &found.joints[1]];
    let is_near = |found: f64, expected: f64| (found - expected).abs() < 1e-9;
    assert!(is_near(slide.range[1], 20.0) && is_near(slide.speed_max, 20.0), "{slide:?}");
    assert!(is_near(turned.range[1], 0.5_f64.to_degrees()), "{turned:?}");
    let text = table::inspection(&found);
    assert!(text.contains("to mm") && text.contains("to deg"), "{text}");
    let told = found.suspicious.join("\n");
    assert!(told.contains("q4 moved by less than 5 degrees: check what the logger reads"), "{told}");
    assert!(!told.contains("q1") && !told.contains("plug"), "{told}");
    let units = curves::of_robot(&log, &robot).into_iter().map(|curve| curve.unit);
    assert_eq!(units.take(2).collect::<Vec<_>>(), ["mm", "deg"]);
}

#[test]
fn a_column_that_freezes_for_a_while_is_suspected_by_name_and_a_joint_that_stands_is_not() {
    let mut log = simulated().robot_log;
    let (from, to) = (log.q_rad.len() / 4, log.q_rad.len() / 2);
    let held = log.q_rad[from][1];
    log.q_rad[from..to].iter_mut().for_each(|q| q[1] = held);
    let told = inspect::robot_log(&log, &irb2400()).suspicious.join("\n");
    assert!(told.contains("q2 is constant from"), "{told}");
    assert!(!told.contains("q1 is constant") && !told.contains("q3 is constant"), "{told}");
    // After the rest, the joint continues from the position at which it rested.
    let by = log.q_rad[to][1] - held;
    log.q_rad[to..].iter_mut().for_each(|q| q[1] -= by);
    let told = inspect::robot_log(&log, &irb2400()).suspicious.join("\n");
    assert!(!told.contains("is constant from"), "{told}");
}

#[test]
fn a_joint_that_is_faster_than_any_robot_is_suspected_with_its_speed() {
    let mut log = simulated().robot_log;
    let middle = log.q_rad.len() / 2;
    log.q_rad[middle][2] += 1.0;
    let told = inspect::robot_log(&log, &irb2400()).suspicious.join("\n");
    assert!(told.contains("q3 reaches 1") && told.contains("no robot is so fast"), "{told}");
}

#[test]
fn joints_that_begin_anew_after_a_turn_are_as_fast_as_they_were() {
    let mut log = simulated().robot_log;
    let speed = |log: &RobotLog| inspect::robot_log(log, &irb2400()).joints[5].speed_max;
    let expected = speed(&log);
    let middle = log.q_rad.len() / 2;
    let end_rad = log.q_rad[middle][5];
    log.q_rad.iter_mut().filter(|q| q[5] > end_rad).for_each(|q| q[5] -= std::f64::consts::TAU);
    assert!((speed(&log) - expected).abs() < 1e-6 * expected);
    let facts = inspect::robot_log(&log, &irb2400()).facts;
    assert!(facts.iter().any(|(what, value)| what == "unwrapped" && value.starts_with("q6, ")), "{facts:?}");
}

#[test]
fn curves_keep_extremes_and_holes_and_stay_small() {
    let Simulated { mut robot_log, cycles, encoders, .. } = simulated();
    let of_bar = curves::of_bar(&cycles, &encoders);
    assert_eq!(
        of_bar.iter().map(|curve| curve.name.as_str()).collect::<Vec<_>>(),
        ["b1", "b2", "b3", "b4", "b5"]
    );
    // A spike of one row remains in the data. Ten missing seconds are not interpolated.
    let spike = robot_log.q_rad.len() / 3;
    robot_log.q_rad[spike][2] = 3.0;
    let until_s = robot_log.q_rad.duration_s() / 2.0 + 10.0;
    let missing = |t_s: f64| (until_s - 10.0..until_s).contains(&t_s);
    let q_rad = &robot_log.q_rad;
    robot_log.q_rad =
        q_rad.filter_map(0..q_rad.len(), |row, q| (!missing(q_rad.t_s[row])).then_some(*q)).into();
    for (joint, curve) in curves::of_robot(&robot_log, &irb2400()).iter().enumerate() {
        assert_eq!(curve.parts.len(), 2);
        assert!(curve.parts[0].last().unwrap().0 < until_s - 9.9 && curve.parts[1][0].0 >= until_s);
        let points: Vec<(f64, f64)> = curve.parts.iter().flatten().copied().collect();
        assert!(points.len() < 1700 && points.is_sorted_by(|a, b| a.0 < b.0), "{}", points.len());
        let highest = |values: &mut dyn Iterator<Item = f64>| values.fold(f64::NEG_INFINITY, f64::max);
        let of_log = highest(&mut robot_log.q_rad.iter().map(|row| row[joint].to_degrees()));
        assert_eq!(highest(&mut points.iter().map(|point| point.1)), of_log);
    }
}

#[test]
fn a_recording_without_a_valid_cycle_has_no_curves() {
    let Simulated { mut cycles, encoders, .. } = simulated();
    cycles.iter_mut().flat_map(|cycle| &mut cycle.encoders).for_each(|sample| sample.valid = false);
    assert!(curves::of_bar(&cycles, &encoders).is_empty());
}
