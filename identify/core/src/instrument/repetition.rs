//! Divides a ball-bar run into segments whose errors are independent, even if the motion repeats. Errors of gears and
//! encoders are equal in all repetitions of a motion. If a repetition is held out and another one is fitted, their errors
//! are not independent. Therefore all repetitions must be in the same segment.
//!
//! The period of the motion is estimated in three steps:
//!
//! 1. For each sample, the later sample with the most similar joints is found.
//! 2. The start value is the shortest time between such samples that occurs often enough ([`REPEATED_MIN`]).
//! 3. Gauss-Newton refines the period.

use std::ops::Range;

use super::segments;
use crate::model::{JointState, RobotMotion};
use crate::statistics::largest_difference;

/// Maximum number of samples of a run that are compared with each other.
const COMPARED_MAX: usize = 600;
/// Minimum time between two samples that may be repetitions of each other \[s\]. Samples that
/// are closer in time are neighbours.
const APART_S: f64 = 5.0;
/// First test: two poses are similar if the difference of each joint is less than this \[rad, m\]. The limit is large,
/// because the samples of two repetitions are not at the same phase.
const ALIKE_MAX: f64 = 0.1;
/// Second test: two motions are equal if the root mean square difference of their joints is less than this \[rad, m\].
const SAME_MAX: f64 = 2e-3;
/// Bin width of the histogram of times between similar poses \[s\].
const BIN_S: f64 = 0.5;
/// Minimum number of segments.
const SEGMENTS_MIN: usize = 8;
/// Minimum fraction of the samples that belong to a repeated motion. Only half of these samples have a later repetition.
const REPEATED_MIN: f64 = 0.4;

/// Divides a run, which was measured at `times_s`, into at most `count` segments. Returns the samples of each segment. All
/// repetitions of a motion are in the same segment.
///
/// If the motion repeats, there are fewer segments. Each segment of one period then lasts as long as a segment of a run
/// without repetitions, because errors of gears and bearings are correlated over seconds.
pub fn independent_segments(motion: &impl RobotMotion, times_s: &[f64], count: usize) -> Vec<Vec<usize>> {
    let samples: Vec<usize> = (0..times_s.len()).collect();
    let span_s = times_s.last().zip(times_s.first()).map_or(0.0, |(last, first)| last - first);
    let (in_order, distinct_s) = match period_s(motion, times_s) {
        Some(period_s) => (sorted_by_phase(samples, times_s, period_s), period_s.min(span_s)),
        None => (samples, span_s),
    };
    let distinct_part = if span_s > 0.0 { distinct_s / span_s } else { 1.0 };
    let count = count.min(((count as f64 * distinct_part) as usize).max(SEGMENTS_MIN));
    let ranges = segments(&[0, in_order.len()], count);
    ranges.into_iter().map(|range: Range<usize>| in_order[range].to_vec()).collect()
}

fn sorted_by_phase(mut samples: Vec<usize>, times_s: &[f64], period_s: f64) -> Vec<usize> {
    let Some(&begin_s) = times_s.first() else { return samples };
    let phase_s = |sample: usize| times_s.get(sample).map_or(0.0, |t_s| (t_s - begin_s).rem_euclid(period_s));
    samples.sort_by(|&a, &b| phase_s(a).total_cmp(&phase_s(b)));
    samples
}

/// Period of a motion that was sampled at `times_s` \[s\]. `None` if the motion does not repeat.
pub fn period_s(motion: &impl RobotMotion, times_s: &[f64]) -> Option<f64> {
    let every = times_s.len().div_ceil(COMPARED_MAX).max(1);
    let states: Vec<(f64, JointState)> =
        times_s.iter().step_by(every).filter_map(|&t_s| Some((t_s, motion.at(t_s)?))).collect();
    // Histogram of the times from each sample to the most similar later sample.
    let mut bins: Vec<usize> = Vec::new();
    for (index, (t_s, state)) in states.iter().enumerate() {
        let later = states.iter().skip(index + 1).filter(|(later_s, _)| later_s - t_s > APART_S);
        let differences =
            later.map(|(later_s, other)| (later_s - t_s, largest_difference(&state.q, &other.q)));
        let most_similar =
            differences.min_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, difference)| *difference < ALIKE_MAX);
        let Some((apart_s, _)) = most_similar else { continue };
        let bin = (apart_s / BIN_S) as usize;
        bins.resize(bins.len().max(bin + 1), 0);
        bins[bin] += 1;
    }
    // Half of the repeated samples have a later repetition. Their times are in one bin or in two adjacent ones. At least ten
    // samples are needed, because fewer could be similar by chance.
    let needed = (0.5 * REPEATED_MIN * states.len() as f64).max(10.0) as usize;
    let first_bin = bins.windows(2).position(|pair| pair[0] + pair[1] >= needed)?;
    refine(motion, &states, (first_bin + 1) as f64 * BIN_S)
}

/// Refines the period by Gauss-Newton: minimises `sum |q(t + period) - q(t)|^2` for the joints `q`. `None` if the joints of
/// the repetitions still differ afterwards.
fn refine(motion: &impl RobotMotion, states: &[(f64, JointState)], start_s: f64) -> Option<f64> {
    const STEPS: usize = 8;
    let mut period_s = start_s;
    for step in 0..=STEPS {
        let pairs: Vec<(JointState, JointState)> =
            states.iter().filter_map(|(t_s, state)| Some((*state, motion.at(t_s + period_s)?))).collect();
        // `gradient` is the sum of rate times difference, `curvature` of the squared rate, and `squared` of the squared
        // difference. The rate is the derivative of the difference by the period.
        let (mut gradient, mut curvature, mut squared) = (0.0, 0.0, 0.0);
        for (state, repeated) in &pairs {
            for joint in 0..state.q.len() {
                let difference = repeated.q[joint] - state.q[joint];
                gradient += repeated.qd[joint] * difference;
                curvature += repeated.qd[joint].powi(2);
                squared += difference * difference;
            }
        }
        let entries = pairs.first()?.0.q.len() * pairs.len();
        if step == STEPS {
            let same = (squared / entries as f64).sqrt() < SAME_MAX;
            return (same && pairs.len() as f64 >= 0.5 * REPEATED_MIN * states.len() as f64)
                .then_some(period_s);
        }
        period_s -= gradient / curvature.max(f64::MIN_POSITIVE);
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Joints that oscillate, each at its own frequency \[Hz\].
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
