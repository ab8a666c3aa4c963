//! Compares interpolated logs with an analytic motion.
#![allow(clippy::unwrap_used, reason = "tests")]

use identify::kinematics::Joints;
use identify::logs::{LogError, RobotLog, Stream};

/// Stamps of a 250 Hz log \[s\]. Their intervals vary by +-40 %.
fn uneven_stamps(duration_s: f64) -> Vec<f64> {
    let mut t = 0.0;
    let mut stamps = vec![];
    while t <= duration_s {
        stamps.push(t);
        t += 0.004 * (1.0 + 0.4 * (stamps.len() as f64 * 1.7).sin());
    }
    stamps
}

fn joint(t: f64, j: usize) -> (f64, f64) {
    let rate = 1.0 + j as f64;
    ((rate * t).sin(), rate * (rate * t).cos())
}

fn log(t_s: Vec<f64>) -> RobotLog {
    let q_rad = t_s.iter().map(|&t| Joints::from_fn(6, |j| joint(t, j).0)).collect();
    RobotLog { q_rad: Stream::new(0, t_s, q_rad).into(), ..RobotLog::default() }
}

#[test]
fn value_and_rate_follow_the_motion_between_uneven_stamps_and_at_the_ends() {
    let log = log(uneven_stamps(2.0));
    let interpolated = log.spline().unwrap();
    let end = log.q_rad.duration_s();
    for k in 0..=4000 {
        let t = end * f64::from(k) / 4000.0;
        let point = interpolated.at(t).unwrap();
        for j in 0..6 {
            let (q, qd) = joint(t, j);
            assert!((point.value[j] - q).abs() < 2e-8, "joint {j} at {t}: {}", point.value[j] - q);
            assert!((point.rate[j] - qd).abs() < 2e-5, "joint {j} at {t}: {}", point.rate[j] - qd);
        }
    }
}

#[test]
fn a_cubic_is_reproduced_exactly() {
    let t = [0.0, 0.1, 0.35, 0.4, 0.9, 1.0];
    let cubic = |t: f64| 1.0 - 2.0 * t + 3.0 * t * t - 4.0 * t * t * t;
    let spline =
        Stream::new(0, t.to_vec(), t.map(|t| [cubic(t)]).to_vec()).with_gap_limit(1.0).spline().unwrap();
    for k in 0..=100 {
        let t = f64::from(k) / 100.0;
        let point = spline.at(t).unwrap();
        assert!((point.value[0] - cubic(t)).abs() < 1e-12);
        assert!((point.rate[0] - (-2.0 + 6.0 * t - 12.0 * t * t)).abs() < 1e-10);
    }
}

#[test]
fn value_rate_and_acceleration_are_continuous_at_the_knots() {
    let t: Vec<f64> = (0..9).map(f64::from).collect();
    let values = [0.0, 1.0, -1.0, 3.0, 0.5, 0.2, 4.0, 4.0, 0.0].map(|v| [v]);
    let spline = Stream::new(0, t, values.to_vec()).with_gap_limit(2.0).spline().unwrap();
    for knot in 1..8 {
        let (h, knot) = (1e-5, f64::from(knot));
        let [before, at, after] = [knot - h, knot, knot + h].map(|t| spline.at(t).unwrap());
        assert!((before.value[0] - after.value[0]).abs() < 1e-3);
        let (left, right) = ((at.rate[0] - before.rate[0]) / h, (after.rate[0] - at.rate[0]) / h);
        assert!((left - right).abs() < 1e-2, "{left} {right}");
    }
}

#[test]
fn nothing_is_said_outside_the_log_or_inside_a_hole() {
    let t_s: Vec<f64> = uneven_stamps(2.0).into_iter().filter(|t| !(0.9..1.1).contains(t)).collect();
    let log = log(t_s);
    let interpolated = log.spline().unwrap();
    let end = log.q_rad.duration_s();
    assert!(interpolated.at(-1e-9).is_none() && interpolated.at(end + 1e-9).is_none());
    assert!(interpolated.at(0.0).is_some() && interpolated.at(end).is_some());
    assert!(interpolated.at(f64::NAN).is_none());
    assert!(interpolated.at(1.0).is_none());
    for t in [0.5, 1.5] {
        assert!((interpolated.at(t).unwrap().value[2] - joint(t, 2).0).abs() < 1e-8);
    }
}

#[test]
fn a_log_of_single_samples_far_apart_is_refused() {
    let mut log = log((0..100).map(f64::from).collect());
    log.q_rad.gap_limit_s = 0.05;
    assert!(matches!(log.spline(), Err(LogError::NoContinuousPart { .. })));
}

#[test]
fn there_is_no_value_beyond_a_log_however_far() {
    let t: Vec<f64> = (0..9).map(f64::from).collect();
    let spline =
        Stream::new(0, t.clone(), t.iter().map(|t| [t * t]).collect()).with_gap_limit(2.0).spline().unwrap();
    for t in [-1e-9, 8.0 + 1e-9, 1e20, 1e300, f64::INFINITY, f64::NEG_INFINITY, f64::NAN] {
        assert!(spline.at(t).is_none() && !spline.covers(t), "{t}");
    }
    assert!(spline.covers(0.0) && spline.covers(8.0));
}
