//! Processing of the readings before the alignment: unwrapping of counters and joints, and the moving average. The tests
//! also check how reports show this processing.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::f64::consts::TAU;

use crate::support::minute::{prepared, run};
use identify::logs::Unwrapped;
use identify::prepare::{SampleStatus, bar_angles, unwrapped_log};
use identify::simulate::Effects;

fn middle(values: impl Iterator<Item = f64>) -> f64 {
    let (low, high) = values
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)));
    0.5 * (low + high)
}

/// Checks that the readings in use have no jump. They may differ from the recorded readings by whole periods and a constant.
/// `sign` is 1 if counts increase with the angle, and -1 if they decrease.
fn assert_continuous(one: &Unwrapped, sign: f64) {
    let points = &one.points;
    assert!(points.len() > 20 && points.windows(2).all(|pair| pair[0].t_s < pair[1].t_s));
    let largest =
        |values: Vec<f64>| values.windows(2).map(|pair| (pair[1] - pair[0]).abs()).fold(0.0, f64::max);
    let shown = largest(points.iter().map(|point| point.shown_rad).collect());
    let used = largest(points.iter().map(|point| point.continuous_rad).collect());
    assert!(shown > 0.9 * one.period_rad && used < 0.1 * one.period_rad, "{}: {shown} {used}", one.name);
    let apart: Vec<f64> =
        points.iter().map(|point| (sign * point.shown_rad - point.continuous_rad) / one.period_rad).collect();
    for periods in apart.iter().map(|periods| periods - apart[0]) {
        assert!((periods - periods.round()).abs() < 1e-6, "{}: {periods}", one.name);
    }
}

#[test]
fn counters_and_joints_that_begin_anew_change_nothing_and_are_shown() {
    let as_it_was = run(Effects::NONE);
    let mut wrapped = as_it_was.clone();
    // Only the counter of b3 wraps in the middle of its motion.
    let middle_count = middle(wrapped.cycles.iter().map(|cycle| f64::from(cycle.encoders[2].count))) as u32;
    for cycle in &mut wrapped.cycles {
        cycle.encoders[2].count = cycle.encoders[2].count.wrapping_sub(middle_count);
    }
    // The controller reports joint 6 within one turn, so the angle wraps within the motion of the joint.
    let end_rad = middle(wrapped.robot_log.q_rad.iter().map(|q| q[5]));
    wrapped.robot_log.q_rad.iter_mut().filter(|q| q[5] > end_rad).for_each(|q| q[5] -= TAU);
    let [expected, found] = [&as_it_was, &wrapped].map(|run| prepared(run, ""));
    assert!(expected.timeline.unwrapped_encoders.is_empty() && expected.timeline.unwrapped_joints.is_empty());

    let [of_bar] = &found.timeline.unwrapped_encoders[..] else { panic!("{:?}", found.timeline) };
    assert_eq!(of_bar.name, "b3");
    let sign = wrapped.encoders[2].scale.direction.sign() as f64;
    assert_continuous(of_bar, sign);
    let [of_robot] = &found.timeline.unwrapped_joints[..] else { panic!("{:?}", found.timeline) };
    assert_eq!((of_robot.name.as_str(), of_robot.period_rad), ("q6", TAU));
    assert_continuous(of_robot, 1.0);
    let crossed = as_it_was.robot_log.q_rad.windows(2);
    assert_eq!(
        of_robot.wraps,
        crossed.filter(|pair| (pair[0][5] > end_rad) != (pair[1][5] > end_rad)).count()
    );

    // Samples and clocks are the same as before. Only the offset of the encoder differs.
    assert_eq!(found.observations.len(), expected.observations.len());
    assert_eq!(found.alignment.clock_difference_ns, expected.alignment.clock_difference_ns);
    for (a, b) in found.observations.iter().zip(&expected.observations) {
        let apart = [0, 1, 3, 4].map(|joint| (a.bar_rad[joint] - b.bar_rad[joint]).abs());
        assert!(a.t_s == b.t_s && apart.iter().all(|apart| *apart < 1e-9), "{a:?} {b:?}");
    }
}

#[test]
fn a_log_without_jumps_is_taken_as_it_is_and_one_with_them_moves_by_whole_turns() {
    let log = run(Effects::NONE).robot_log;
    let (same, none) = unwrapped_log(&log);
    assert!(*same == log && none.is_empty());
    // Ten seconds are missing, during which joint 6 turned by more than half a turn.
    let mut holed = log.clone();
    let at = holed.q_rad.t_s.len() / 2;
    holed.q_rad.t_s[at..].iter_mut().for_each(|t_s| *t_s += 10.0);
    holed.q_rad[at..].iter_mut().for_each(|q| q[5] += 4.0);
    let (same, none) = unwrapped_log(&holed);
    assert!(*same == holed && none.is_empty());
    let mut wrapped = log.clone();
    for q in wrapped.q_rad.iter_mut() {
        q[3] = (3.0 * q[3]).sin().atan2((3.0 * q[3]).cos());
    }
    let (continuous, _) = unwrapped_log(&wrapped);
    for (row, (q, truth)) in continuous.q_rad.iter().zip(log.q_rad.iter()).enumerate() {
        let turns = (q[3] - 3.0 * truth[3] - continuous.q_rad[0][3] + 3.0 * log.q_rad[0][3]) / TAU;
        assert!(turns.abs() < 1e-9, "row {row}: {turns} turns");
    }
}

#[test]
fn the_average_takes_noise_and_in_motion_hardly_more_than_at_standstill() {
    let noisy = run(Effects { robot_noise_urad: 30.0, encoder_noise_urad: 30.0, ..Effects::NONE });
    assert_eq!(prepared(&noisy, "").timeline.averaged, None);
    let found = prepared(&noisy, "moving_average_ms = 100.0");
    let averaged = found.timeline.averaged.unwrap();
    // The average needs readings over its whole width, so some samples at each end of the recording are not averaged.
    assert_eq!((averaged.width_s, found.counts.of(SampleStatus::NotAveraged)), (0.1, 20));
    for side in [&averaged.bar, &averaged.robot] {
        for (still, moving) in side.still_rad.iter().zip(&side.moving_rad) {
            let (still, moving) = (still.unwrap() * 1e6, moving.unwrap() * 1e6);
            // The average contains a small fraction of the noise of each reading. Therefore the difference between reading
            // and average is slightly smaller than the noise of a reading.
            assert!((25.0..30.5).contains(&still) && (moving - still).abs() < 3.0, "{still} {moving}");
        }
        let fastest = &side.fastest;
        assert!((100..=600).contains(&fastest.len()), "{}", fastest.len());
        let about_line = |of: fn(&identify::prepare::AveragedPoint) -> f64| {
            let values: Vec<f64> = fastest.iter().map(of).collect();
            let bend = |w: &[f64]| (w[0] - 2.0 * w[1] + w[2]).powi(2);
            values.windows(3).map(bend).sum::<f64>().sqrt()
        };
        let (read, averaged) = (about_line(|one| one.speed_rad_s), about_line(|one| one.averaged_rad_s));
        assert!(averaged < 0.2 * read, "speeds are smoother: {averaged} {read}");
    }
    // The reported speed must be that of the true motion.
    let truth_s = found.t_ref.seconds_since(noisy.truth.clock.bar_start);
    let joint = averaged.bar.fastest_joint - 1;
    let point = averaged.bar.fastest[averaged.bar.fastest.len() / 2];
    let path = |by_s: f64| noisy.motion.path.at(truth_s + point.t_s + by_s)[joint];
    let speed_rad_s = (path(1e-3) - path(-1e-3)) / 2e-3;
    assert!((speed_rad_s.abs() - point.averaged_rad_s.abs()).abs() < 0.01, "{speed_rad_s} {point:?}");
}

#[test]
fn readings_keep_the_order_of_time_and_begin_near_zero_wherever_counters_start_anew() {
    let mut run = run(Effects::NONE);
    let middle = run.cycles.len() / 2;
    // The terminals restart, and from then on their clock is half a second behind.
    for cycle in &mut run.cycles[middle..] {
        cycle.origin += 1;
        cycle.sample_time = cycle.sample_time.plus_ns(-500_000_000);
        cycle.encoders.iter_mut().for_each(|sample| sample.count = sample.count.wrapping_add(1 << 30));
    }
    let angles = bar_angles(&run.cycles, &run.encoders).unwrap();
    let late = angles.statuses.iter().filter(|status| **status == SampleStatus::TimeNotIncreasing).count();
    let readings = &angles.readings;
    assert!((49..=51).contains(&late) && readings.len() + late == run.cycles.len(), "{late}");
    assert!(readings.t_s.windows(2).all(|pair| pair[1] > pair[0]));
    let parts = readings.parts();
    assert_eq!((parts.len(), angles.origins()), (2, 2));
    for (origin, part) in parts.into_iter().enumerate() {
        assert!(readings[part.clone()].iter().all(|reading| reading.origin == origin));
        assert!(readings[part.start].recorded_rad.iter().all(|angle| angle.abs() <= 0.5 * TAU + 1e-9));
        let time = run.cycles[readings[part.start].cycle].sample_time;
        assert_eq!(readings.stamp_ns(part.start), Some(time.0));
    }
}
