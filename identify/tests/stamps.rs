//! Logs with stamps as real controllers write them. Stamps derive from a regular clock. The
//! rows must get the times of this clock.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::collections::BTreeSet;

use identify::inspect;
use identify::kinematics::Joints;
use identify::logs::{RobotLog, Stamps, Stream};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

use crate::support::irb2400;
use crate::support::stamped::stamped;

/// A log of a minute with smooth motion and rests.
fn log(rate_hz: f64) -> RobotLog {
    let t_s: Vec<f64> = (0..(60.0 * rate_hz) as usize).map(|row| row as f64 / rate_hz).collect();
    let at = |t_s: f64| {
        // Rests of a second every 20 s.
        let along = t_s - (std::f64::consts::TAU * t_s / 20.0).sin() * 20.0 / std::f64::consts::TAU;
        Joints::from_fn(6, |joint| 0.4 * (along * (0.5 + 0.13 * joint as f64) + joint as f64).sin())
    };
    let q_rad = t_s.iter().map(|t_s| at(*t_s)).collect();
    RobotLog { q_rad: Stream::new(0, t_s, q_rad).into(), ..RobotLog::default() }
}

/// The log as it is read from a file that has these stamps \[s\].
fn read_back(log: &RobotLog, stamps_s: Vec<f64>) -> RobotLog {
    stamped(log, &irb2400(), stamps_s.into_iter().map(|stamp_s| Some(stamp_s + 100.0)), 6)
}

/// Largest difference between two series of times, after their mean difference and rate are subtracted \[s\]. A calibration
/// estimates the mean difference and the rate.
fn apart_s(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    let middle = 0.5 * (a.len() - 1) as f64;
    let by: Vec<f64> = a.iter().zip(b).map(|(a, b)| a - b).collect();
    let mean = by.iter().sum::<f64>() / by.len() as f64;
    let (mut along, mut squares) = (0.0, 0.0);
    for (row, by) in by.iter().enumerate() {
        along += (row as f64 - middle) * (by - mean);
        squares += (row as f64 - middle).powi(2);
    }
    let left = |(row, by): (usize, &f64)| by - mean - along / squares * (row as f64 - middle);
    by.iter().enumerate().map(left).fold(0.0, |most, left| most.max(left.abs()))
}

fn never_back(mut stamps_s: Vec<f64>) -> Vec<f64> {
    (1..stamps_s.len()).for_each(|row| stamps_s[row] = stamps_s[row].max(stamps_s[row - 1] + 1e-6));
    stamps_s
}

fn jittered(times_s: &[f64], sigma_s: f64, random: &mut ChaCha8Rng) -> Vec<f64> {
    let noise = Normal::new(0.0, sigma_s).unwrap();
    never_back(times_s.iter().map(|t_s| t_s + noise.sample(random)).collect())
}

fn stamps(log: &RobotLog) -> &Stamps {
    log.quality.stamps.as_ref().unwrap()
}

#[test]
#[ignore = "takes more than four seconds"]
fn stamps_of_every_kind_lead_back_to_the_clock_behind_them() {
    for rate_hz in [50.0, 250.0, 1000.0] {
        let log = log(rate_hz);
        let mut random = ChaCha8Rng::seed_from_u64(7);
        // The clock of the controller is fast by 37 ppm.
        let times_s: Vec<f64> = log.q_rad.t_s.iter().map(|t_s| t_s * (1.0 + 37e-6)).collect();
        let rounded = |step_ms: f64| {
            let step_s = step_ms * 1e-3;
            times_s.iter().map(|t_s| (t_s / step_s).round() * step_s).collect::<Vec<f64>>()
        };
        let batched: Vec<f64> = (0..times_s.len())
            .map(|row| times_s[(row / 5 * 5 + 4).min(times_s.len() - 1)] + (row % 5) as f64 * 20e-6)
            .collect();
        let mut equal = times_s.clone();
        (1..equal.len()).filter(|_| random.random_bool(0.05)).for_each(|row| equal[row] = equal[row - 1]);
        let late = times_s.iter().map(|t_s| t_s + if random.random_bool(0.02) { 0.01 } else { 0.0 });
        let late = never_back(late.collect());
        let kinds = [
            ("perfect", times_s.clone(), 2e-6),
            ("rounded to 1 ms", rounded(1.0), 8e-4),
            ("rounded to 4 ms", rounded(4.0), 1.2e-3),
            ("rounded to 10 ms", rounded(10.0), 1.5e-3),
            ("rounded to 15.6 ms", rounded(15.6), 1.5e-3),
            ("jitter of 0.5 ms", jittered(&times_s, 5e-4, &mut random), 1e-4),
            ("jitter of 2 ms", jittered(&times_s, 2e-3, &mut random), 3e-4),
            ("batched", batched, 2e-4),
            ("equal", equal, 1e-4),
            ("late", late, 1e-4),
        ];
        for (what, stamps_s, limit_s) in kinds {
            let back = read_back(&log, stamps_s);
            let error_s = apart_s(&back.q_rad.t_s, &times_s);
            assert!(error_s < limit_s, "{what}, {rate_hz} Hz: {:.4} ms", error_s * 1e3);
        }
    }
}

#[test]
fn what_stamps_scatter_by_is_measured_and_said() {
    let log = log(250.0);
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let back = read_back(&log, jittered(&log.q_rad.t_s, 1e-3, &mut random));
    assert!((stamps(&back).jitter_s - 1e-3).abs() < 5e-5, "{:?}", stamps(&back));
    let message = inspect::robot_log(&back, &irb2400()).suspicious.join("\n");
    assert!(
        message.contains("the stamps scatter by 1.0") || message.contains("the stamps scatter by 0.9"),
        "{message}"
    );
    let rounded: Vec<f64> = log.q_rad.t_s.iter().map(|t_s| (t_s * 1.00003 / 0.01).round() * 0.01).collect();
    let message = inspect::robot_log(&read_back(&log, rounded), &irb2400()).suspicious.join("\n");
    assert!(
        message.contains("rounded to 10.0 ms") && message.contains("rows have the stamp of the one before"),
        "{message}"
    );
    // A log without faults causes no remark.
    let perfect = read_back(&log, log.q_rad.t_s.clone());
    assert!(!stamps(&perfect).evened);
    assert_eq!(inspect::robot_log(&perfect, &irb2400()).suspicious, Vec::<String>::new());
}

#[test]
fn rows_that_are_missing_leave_the_others_where_they_were() {
    let whole = log(250.0);
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let some = |_, q: &Joints| random.random_bool(0.85).then_some(*q);
    let log =
        RobotLog { q_rad: whole.q_rad.filter_map(0..whole.q_rad.len(), some).into(), ..RobotLog::default() };
    let exact = read_back(&log, log.q_rad.t_s.clone());
    assert!(apart_s(&exact.q_rad.t_s, &log.q_rad.t_s) < 2e-6);
    let jittered = read_back(&log, jittered(&log.q_rad.t_s, 1e-3, &mut random));
    // During a rest, missing rows cannot be located. This has no effect, because the joints do not move.
    let moves = |t_s: f64| (std::f64::consts::TAU * t_s / 20.0).cos() < 0.7;
    let off =
        jittered.q_rad.t_s.iter().zip(&log.q_rad.t_s).filter(|(_, t_s)| moves(**t_s)).map(|(a, b)| a - b);
    let off: Vec<f64> = off.collect();
    let mean = off.iter().sum::<f64>() / off.len() as f64;
    let rms_s = (off.iter().map(|off| (off - mean).powi(2)).sum::<f64>() / off.len() as f64).sqrt();
    assert!(rms_s < 1e-3, "{rms_s}");
}

/// Three types of stamps: rounded to 4 ms by a clock that drifts to the next multiple about once a minute;
/// with missing rows of 4 ms; and both.
#[test]
fn rounded_stamps_are_no_missing_rows_and_missing_rows_no_rounding() {
    let noise = Normal::new(0.0, 15e-6).unwrap();
    for (missing, ppm) in [(0.0, 50.0), (2e-4, 50.0), (0.01, 50.0), (0.05, 50.0), (0.01, 0.0), (0.05, 0.0)] {
        let mut random = ChaCha8Rng::seed_from_u64(11);
        let mut whole = log(250.0);
        // The motion is so slow that noise hides a single missing row.
        whole.q_rad.iter_mut().flatten().for_each(|q| *q = 0.2 * *q + noise.sample(&mut random));
        let kept: Vec<bool> = whole.q_rad.iter().map(|_| !random.random_bool(missing)).collect();
        let kept_row = |row: usize, q: &Joints| kept[row].then_some(*q);
        let q_rad = whole.q_rad.filter_map(0..whole.q_rad.len(), kept_row);
        let log = RobotLog { q_rad: q_rad.into(), ..RobotLog::default() };
        let times_s: Vec<f64> = log.q_rad.t_s.iter().map(|t_s| t_s * (1.0 + ppm * 1e-6)).collect();
        let stamp = |t_s: &f64| ((t_s + 0.0017) / 0.004).floor() * 0.004;
        let back = read_back(&log, times_s.iter().map(stamp).collect());
        let found = if ppm == 0.0 { 0.0 } else { apart_s(&back.q_rad.t_s, &times_s) };
        assert!(found < 2e-4, "{missing}, {ppm}: {:.3} ms, {:?}", found * 1e3, stamps(&back));
        let [first, last] = [kept.iter().position(|kept| *kept), kept.iter().rposition(|kept| *kept)];
        let lost = kept[first.unwrap()..last.unwrap()].iter().filter(|kept| !**kept).count();
        assert_eq!(stamps(&back).missing, lost, "{missing}, {ppm}");
        assert!(stamps(&back).steps.is_empty(), "{missing}, {ppm}");
    }
}

/// Near a rest, the motion hardly shows whether a row is missing or the clock has drifted to the next multiple of 4 ms.
#[test]
fn rows_that_are_lost_near_a_rest_are_missing_rows() {
    let noise = Normal::new(0.0, 15e-6).unwrap();
    for (seed, lost) in (0..).zip([1, 1, 1, 1, 1, 1, 1, 1, 2, 2, 3, 3, 6, 6, 20, 20]) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut whole = log(250.0);
        whole.q_rad.iter_mut().flatten().for_each(|q| *q += noise.sample(&mut random));
        let near_rest =
            |row: &usize| [20.0, 40.0].iter().any(|rest_s| (*row as f64 / 250.0 - rest_s).abs() < 2.5);
        let near: Vec<usize> = (0..whole.q_rad.len()).filter(near_rest).collect();
        let missing: BTreeSet<usize> =
            rand::seq::index::sample(&mut random, near.len(), lost).iter().map(|at| near[at]).collect();
        let kept_row = |row: usize, q: &Joints| (!missing.contains(&row)).then_some(*q);
        let q_rad = whole.q_rad.filter_map(0..whole.q_rad.len(), kept_row);
        let log = RobotLog { q_rad: q_rad.into(), ..RobotLog::default() };
        let back = read_back(&log, log.q_rad.t_s.clone());
        let found = stamps(&back);
        assert!(!found.evened && found.missing == lost, "seed {seed}, {lost} lost: {found:?}");
    }
}

#[test]
fn a_step_of_the_stamps_that_the_motion_does_not_share_is_taken_out_and_said() {
    let log = log(250.0);
    for by_s in [0.0005, 0.002, 0.004, 0.05] {
        let stamp = |t_s: f64| t_s * (1.0 + 37e-6) + if t_s > 33.0 { by_s } else { 0.0 };
        let stepped = log.q_rad.t_s.iter().map(|t_s| stamp(*t_s));
        let back = read_back(&log, stepped.collect());
        assert!(apart_s(&back.q_rad.t_s, &log.q_rad.t_s) < 2e-5, "{by_s}: {:?}", stamps(&back));
        let step = stamps(&back).steps[0];
        assert!((step.by_s - by_s).abs() < 2e-5 && (step.at_s - 33.0).abs() < 0.1, "{step:?}");
        assert!(inspect::robot_log(&back, &irb2400()).suspicious.join("\n").contains("the stamps step by +"));
    }
}

/// A step of the clock must not count as missing rows. This also holds if the step is a whole number of periods and a
/// rest of unknown length follows.
#[test]
fn a_clock_that_is_set_by_seconds_or_an_hour_leaves_no_row_missing() {
    let log = log(250.0);
    for (by_s, at_s) in [(0.5, 33.0), (2.0, 29.5), (10.0, 33.0), (3600.0, 13.0)] {
        let stamp = |t_s: f64| t_s + if t_s > at_s { by_s } else { 0.0 };
        let back = read_back(&log, log.q_rad.t_s.iter().map(|t_s| stamp(*t_s)).collect());
        let Stamps { missing, steps, .. } = stamps(&back);
        assert!(*missing == 0 && steps.len() == 1, "{by_s} s: {missing} missing, {steps:?}");
        assert!((steps[0].by_s - by_s).abs() < 2e-5, "{steps:?}");
        assert!(apart_s(&back.q_rad.t_s, &log.q_rad.t_s) < 2e-5, "{by_s} s");
    }
}

#[test]
fn no_step_is_said_of_stamps_that_only_scatter() {
    let log = log(100.0);
    for seed in 0..60 {
        let mut random = ChaCha8Rng::seed_from_u64(1000 + seed);
        let sigma_s = [1e-4, 5e-4, 2e-3][seed as usize % 3];
        let back = read_back(&log, jittered(&log.q_rad.t_s, sigma_s, &mut random));
        assert_eq!(stamps(&back).steps, Vec::new(), "{seed}, {sigma_s} s");
        assert!(stamps(&back).evened);
    }
}

/// If a program samples at irregular times and stamps its samples correctly, there is no regular clock to recover.
#[test]
fn stamps_that_are_right_stay_as_they_are_even_if_rows_come_as_they_like() {
    let even = log(100.0);
    let mut random = ChaCha8Rng::seed_from_u64(9);
    let mut t_s = 0.0;
    let mut uneven = RobotLog::default();
    let dense = log(10_000.0);
    while t_s < even.q_rad.duration_s() {
        uneven.q_rad.t_s.push(t_s);
        uneven.q_rad.rows.push(dense.q_rad[(t_s * 10_000.0).round() as usize]);
        t_s += (random.random_range(0.004..0.016_f64) * 10_000.0).round() / 10_000.0;
    }
    let back = read_back(&uneven, uneven.q_rad.t_s.clone());
    assert!(apart_s(&back.q_rad.t_s, &uneven.q_rad.t_s) < 2e-6, "{:?}", back.quality.stamps);
    assert!(!inspect::robot_log(&back, &irb2400()).suspicious.join("\n").contains("clock"));
}
