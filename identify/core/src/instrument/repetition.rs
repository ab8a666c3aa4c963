//! Motions that repeat within a run. Repetitions share the errors of gears and encoders, so a repetition that is held out
//! is not independent of the fitted ones.

use std::ops::Range;

use super::segments;
use crate::model::{JointState, RobotMotion};

/// Highest number of samples of a run that are compared with each other.
const COMPARED_MAX: usize = 600;
/// Samples closer in time than this are neighbours, not repetitions \[s\].
const APART_S: f64 = 5.0;
/// First test: two poses are similar if no joint differs by more, because samples of two repetitions are offset in time
/// \[rad\].
const ALIKE_RAD: f64 = 0.1;
/// Second test: two motions are the same if the root mean square difference of the joints is at most this \[rad\].
const SAME_RAD: f64 = 2e-3;
/// Bin width of the histogram of periods \[s\].
const BIN_S: f64 = 0.5;
/// Lowest number of segments.
const SEGMENTS_MIN: usize = 8;
/// Part of the samples that must have a similar sample one period later.
const SHARE: f64 = 0.4;

/// Samples of each segment of a run measured at `times_s`: at most `count` segments. All repetitions of a motion are in one
/// segment. A repeating run has fewer segments, so that each lasts as long as in a run without repetitions: errors of gears and
/// bearings are correlated over seconds.
pub fn independent_segments(motion: &impl RobotMotion, times_s: &[f64], count: usize) -> Vec<Vec<usize>> {
    let samples: Vec<usize> = (0..times_s.len()).collect();
    let span_s = times_s.last().zip(times_s.first()).map_or(0.0, |(last, first)| last - first);
    let (in_order, distinct_s) = match period_s(motion, times_s) {
        Some(period_s) => (by_phase(samples, times_s, period_s), period_s.min(span_s)),
        None => (samples, span_s),
    };
    let distinct = if span_s > 0.0 { distinct_s / span_s } else { 1.0 };
    let count = count.min(((count as f64 * distinct) as usize).max(SEGMENTS_MIN));
    let parts = segments(&[0, in_order.len()], count);
    parts.into_iter().map(|part: Range<usize>| in_order[part].to_vec()).collect()
}

fn by_phase(mut samples: Vec<usize>, times_s: &[f64], period_s: f64) -> Vec<usize> {
    let Some(&begin_s) = times_s.first() else { return samples };
    let phase_s = |sample: usize| times_s.get(sample).map_or(0.0, |t_s| (t_s - begin_s).rem_euclid(period_s));
    samples.sort_by(|&a, &b| phase_s(a).total_cmp(&phase_s(b)));
    samples
}

/// Period of a motion sampled at `times_s` \[s\]; `None` if it does not repeat.
pub fn period_s(motion: &impl RobotMotion, times_s: &[f64]) -> Option<f64> {
    let every = times_s.len().div_ceil(COMPARED_MAX).max(1);
    let states: Vec<(f64, JointState)> =
        times_s.iter().step_by(every).filter_map(|&t_s| Some((t_s, motion.at(t_s)?))).collect();
    let mut bins: Vec<usize> = Vec::new();
    for (at, (t_s, state)) in states.iter().enumerate() {
        let later = states.iter().skip(at + 1).filter(|(later_s, _)| later_s - t_s > APART_S);
        let alike = later.map(|(later_s, other)| (later_s - t_s, farthest_rad(state, other)));
        let best = alike.min_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, rad)| *rad < ALIKE_RAD);
        let Some((apart_s, _)) = best else { continue };
        let bin = (apart_s / BIN_S) as usize;
        bins.resize(bins.len().max(bin + 1), 0);
        bins[bin] += 1;
    }
    // At least half of the samples of two repetitions have a later one; the period lies in one bin or between two.
    let needed = (0.5 * SHARE * states.len() as f64).max(10.0) as usize;
    let found = bins.windows(2).position(|pair| pair[0] + pair[1] >= needed)?;
    refined(motion, &states, (found + 1) as f64 * BIN_S)
}

fn farthest_rad(a: &JointState, b: &JointState) -> f64 {
    a.q.iter().zip(&b.q).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

/// Refines the period by Gauss-Newton: `q(t + period)` against `q(t)`. `None` if the joints then still differ.
fn refined(motion: &impl RobotMotion, states: &[(f64, JointState)], start_s: f64) -> Option<f64> {
    const STEPS: usize = 8;
    let mut period_s = start_s;
    for step in 0..=STEPS {
        let pairs: Vec<(JointState, JointState)> =
            states.iter().filter_map(|(t_s, state)| Some((*state, motion.at(t_s + period_s)?))).collect();
        let (mut by_rate, mut rate_squared, mut squared) = (0.0, 0.0, 0.0);
        for (state, again) in &pairs {
            for joint in 0..state.q.len() {
                let off = again.q[joint] - state.q[joint];
                by_rate += again.qd[joint] * off;
                rate_squared += again.qd[joint].powi(2);
                squared += off * off;
            }
        }
        let joints = pairs.first()?.0.q.len() * pairs.len();
        if step == STEPS {
            let same = (squared / joints as f64).sqrt() < SAME_RAD;
            return (same && pairs.len() as f64 >= 0.5 * SHARE * states.len() as f64).then_some(period_s);
        }
        period_s -= by_rate / rate_squared.max(f64::MIN_POSITIVE);
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Joints that oscillate at different frequencies \[Hz\].
    struct Swing([f64; 6]);

    impl RobotMotion for Swing {
        fn at(&self, tau_s: f64) -> Option<JointState> {
            let angle = |hz: f64| std::f64::consts::TAU * hz * tau_s;
            (0.0..=120.0).contains(&tau_s).then(|| JointState {
                q: self.0.map(|hz| angle(hz).sin()).into(),
                qd: self.0.map(|hz| std::f64::consts::TAU * hz * angle(hz).cos()).into(),
                qdd: [0.0; 6].into(),
            })
        }
    }

    fn times_s() -> Vec<f64> {
        (0..1200).map(|k| 0.1 * f64::from(k)).collect()
    }

    #[test]
    fn a_motion_that_comes_again_is_seen_with_its_period() {
        let again = Swing([1, 2, 3, 4, 5, 7].map(|swings| f64::from(swings) / 47.3));
        let period_s = period_s(&again, &times_s()).unwrap_or(0.0);
        assert!((period_s - 47.3).abs() < 1e-6, "{period_s}");
    }

    #[test]
    fn a_motion_that_does_not_come_again_has_no_period() {
        let never = Swing([0.01, 0.023, 0.0371, 0.0517, 0.0713, 0.0891]);
        assert_eq!(period_s(&never, &times_s()), None);
    }
}
