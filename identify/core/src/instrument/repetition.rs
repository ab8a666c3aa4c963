//! Segments of a run whose errors are independent, also if its motion repeats; the bar's folds. Repetitions share the errors of
//! gears and encoders, so a repetition that is held out is not independent of the fitted ones.
//!
//! The period is estimated from the time between each sample and the later one with the most similar joints: the shortest time
//! that enough samples share ([`REPEATED_MIN`]), refined by Gauss-Newton.

use std::ops::Range;

use super::segments;
use crate::model::{JointState, RobotMotion};
use crate::statistics::largest_difference;

/// Highest number of samples of a run that are compared with each other.
const COMPARED_MAX: usize = 600;
/// Samples closer in time than this are neighbours, not repetitions \[s\].
const APART_S: f64 = 5.0;
/// First test: two poses are similar if no joint differs by more, because samples of two repetitions are offset in time
/// \[rad, m\].
const ALIKE_MAX: f64 = 0.1;
/// Second test: two motions are the same if the root mean square difference of the joints is at most this \[rad, m\].
const SAME_MAX: f64 = 2e-3;
/// Bin width of the histogram of periods \[s\].
const BIN_S: f64 = 0.5;
/// Lowest number of segments.
const SEGMENTS_MIN: usize = 8;
/// Part of the samples that must belong to a repeated motion; half of those have a later repetition.
const REPEATED_MIN: f64 = 0.4;

/// Samples of each segment of a run measured at `times_s`: at most `count` segments. All repetitions of a motion are in one
/// segment. A repeating run has fewer segments, so that each lasts as long as in a run without repetitions: errors of gears and
/// bearings are correlated over seconds.
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

/// Period of a motion sampled at `times_s` \[s\]; `None` if it does not repeat.
pub fn period_s(motion: &impl RobotMotion, times_s: &[f64]) -> Option<f64> {
    let every = times_s.len().div_ceil(COMPARED_MAX).max(1);
    let states: Vec<(f64, JointState)> =
        times_s.iter().step_by(every).filter_map(|&t_s| Some((t_s, motion.at(t_s)?))).collect();
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
    // The period lies in one bin or between two. Fewer than ten samples could be similar by chance.
    let needed = (0.5 * REPEATED_MIN * states.len() as f64).max(10.0) as usize;
    let first_bin = bins.windows(2).position(|pair| pair[0] + pair[1] >= needed)?;
    refine(motion, &states, (first_bin + 1) as f64 * BIN_S)
}

/// Minimises `sum |q(t + period) - q(t)|^2` over the period by Gauss-Newton. `None` if the joints then still differ.
fn refine(motion: &impl RobotMotion, states: &[(f64, JointState)], start_s: f64) -> Option<f64> {
    const STEPS: usize = 8;
    let mut period_s = start_s;
    for step in 0..=STEPS {
        let pairs: Vec<(JointState, JointState)> =
            states.iter().filter_map(|(t_s, state)| Some((*state, motion.at(t_s + period_s)?))).collect();
        // Sums of rate times difference, of squared rates (the derivatives) and of squared differences.
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
