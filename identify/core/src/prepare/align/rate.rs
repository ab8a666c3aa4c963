//! The rate of one clock against another, from parts of a run that are matched one by one.
//!
//! Over a part of some seconds two clocks do not drift apart measurably. The shifts of the parts lie on a line
//! `s = s0 + rate m` over their middles `m`. A part alone may match in several places, all parts together in one: the
//! correlations are summed along lines ("slant stack") before any peak is chosen. A clock that was set in the middle of the run
//! is another explanation of shifts that differ: two levels instead of a slope. The one that leaves smaller squares is taken.
//! Used by `find` before the correlation.

use std::ops::Range;

use super::correlate::Correlations;
use super::speeds::grid_step_s;
use crate::prepare::Channels;
use crate::threads::each;

/// Largest rate less one: clocks of controllers and instruments differ by less, quartz by a hundredth of it.
const RATE_MAX: f64 = 0.0105;
/// The fit of the angles corrects smaller differences of shifts \[s\]: a joint turns by 6 mrad in this time.
const BRIDGED_S: f64 = 0.02;
/// Step of the grid on which parts are matched \[s\]; peaks are found between its points.
const STEP_S: f64 = 0.05;
/// Longest part \[s\]: at the largest rate its ends are shifted by 0.1 s.
const PART_S: f64 = 20.0;
/// Number of parts of a short run, and of a long one.
const PARTS: [usize; 2] = [6, 16];
/// Share of a part that must lie in the other log.
const OVERLAP_MIN: f64 = 0.6;
/// A peak of a part belongs to the line if it is so near, in grid steps.
const NEAR: i64 = 2;

/// A part of a run, compared with the whole of the other log.
struct RunPart {
    /// Its middle since the middle of the run, in grid steps.
    middle: f64,
    /// Half of its length in grid steps.
    half_length: f64,
    correlations: Correlations,
}

impl RunPart {
    /// Place of the part's first sample in the other log, where the run's middle is at `run_middle` of that log, in grid steps.
    fn shift(&self, run_middle: f64, rate: f64) -> f64 {
        run_middle + (1.0 + rate) * self.middle - self.half_length
    }
}

/// Rates, less one, at which two logs are to be compared: that of clocks that run alike, and the one on which the parts of the run
/// agree if it is clearly another one.
///
/// `window` are the samples of the run that are compared, at the times `t_s` \[s\]. `speeds_of_log` gives the speeds of the
/// other log, which is `log_s` long, on a grid with a step \[s\]; `speeds_of_part` those of some samples of the run.
pub(in crate::prepare) fn rates(
    t_s: &[f64],
    window: &Range<usize>,
    log_s: f64,
    speeds_of_log: impl FnOnce(f64) -> Channels,
    speeds_of_part: impl Fn(Range<usize>, f64) -> Channels + Sync,
) -> Vec<f64> {
    let times_s = t_s.get(window.clone()).unwrap_or_default();
    let (Some(first_s), Some(last_s)) = (times_s.first(), times_s.last()) else { return vec![0.0] };
    let run_s = last_s - first_s;
    let step_s = STEP_S.max(grid_step_s(log_s));
    let count = ((run_s / PART_S) as usize).clamp(PARTS[0], PARTS[1]);
    let part_s = PART_S.min(run_s / count as f64);
    let log_speeds = speeds_of_log(step_s);
    let row_at = |since_s: f64| window.start + times_s.partition_point(|t_s| *t_s < first_s + since_s);
    let parts: Vec<RunPart> = each(count, |number| {
        let from_s = number as f64 * (run_s - part_s) / (count - 1) as f64;
        let rows = row_at(from_s)..row_at(from_s + part_s);
        let begins_s = t_s.get(rows.start)? - first_s;
        let part_speeds = speeds_of_part(rows, step_s);
        let half_length = 0.5 * part_speeds.known.len() as f64;
        let middle = (begins_s - 0.5 * run_s) / step_s + half_length;
        let overlap_min = (OVERLAP_MIN * 2.0 * half_length) as usize;
        let correlations = Correlations::new(&log_speeds, &part_speeds, overlap_min);
        Some(RunPart { middle, half_length, correlations })
    })
    .into_iter()
    .flatten()
    .collect();
    let rate = common_rate(&parts, log_speeds.known.len()).unwrap_or_default();
    // The shift at the ends of the run.
    if 0.5 * rate.abs() * run_s > BRIDGED_S { vec![0.0, rate] } else { vec![0.0] }
}

/// Largest sum of the parts' correlations at a rate less one, and the place of the run's middle in the other log there.
struct StackedCorrelations {
    rate: f64,
    run_middle: f64,
    sum: f64,
}

/// The rate less one on whose line the parts match best; `log_points` is the length of the other log in grid steps.
fn common_rate(parts: &[RunPart], log_points: usize) -> Option<f64> {
    let reach = parts.iter().map(|part| part.middle.abs()).fold(0.0, f64::max);
    // From rate to rate the outermost part moves by one grid step.
    let rates_max = (RATE_MAX * reach).ceil() as i64;
    let stacks = each((2 * rates_max + 1) as usize, |number| {
        let rate = (number as i64 - rates_max) as f64 / reach.max(1.0);
        let mut sums = vec![0.0; log_points];
        for part in parts {
            let first = part.shift(0.0, rate).round() as i64;
            sums.iter_mut().zip(first..).for_each(|(sum, shift)| *sum += part.correlations.at(shift));
        }
        let (run_middle, sum) = sums.into_iter().enumerate().max_by(|a, b| a.1.total_cmp(&b.1))?;
        Some(StackedCorrelations { rate, run_middle: run_middle as f64, sum })
    });
    let matching = stacks.into_iter().flatten().filter(|stack| stack.sum > 0.0);
    let best = matching.max_by(|a, b| a.sum.total_cmp(&b.sum))?;
    // A line through the peaks near it is finer than the steps between lines.
    let peak = |part: &RunPart| {
        let on_line = part.shift(best.run_middle, best.rate).round() as i64;
        let (shift, weight) = part.correlations.peak_near(on_line, NEAR)?;
        Some(Peak { middle: part.middle, delay: shift - part.shift(best.run_middle, 0.0), weight })
    };
    let peaks: Vec<Peak> = parts.iter().filter_map(peak).collect();
    let (slope, squares) = slope_and_squares(&peaks);
    let squares_of_step =
        |index: usize| squares_about_mean(&peaks[..index]) + squares_about_mean(&peaks[index..]);
    // A clock that is set in between runs as before on both sides.
    let is_clock_step = (1..peaks.len()).any(|index| squares_of_step(index) < squares);
    (slope.is_finite() && !is_clock_step).then(|| slope.clamp(-RATE_MAX, RATE_MAX))
}

/// Where a part matches best.
struct Peak {
    /// Middle of the part since the middle of the run, in grid steps.
    middle: f64,
    /// Its shift less the one at equal rates, in grid steps.
    delay: f64,
    /// Correlation at its shift.
    weight: f64,
}

fn weighted_mean(peaks: &[Peak], value: impl Fn(&Peak) -> f64) -> f64 {
    let weights: f64 = peaks.iter().map(|peak| peak.weight).sum();
    peaks.iter().map(|peak| peak.weight * value(peak)).sum::<f64>() / weights
}

/// Slope of the line through peaks, and the weighted sum of their squared distances from it.
fn slope_and_squares(peaks: &[Peak]) -> (f64, f64) {
    let middle = weighted_mean(peaks, |peak| peak.middle);
    let delay = weighted_mean(peaks, |peak| peak.delay);
    let product = |peak: &Peak| (peak.middle - middle) * (peak.delay - delay);
    let slope = weighted_mean(peaks, product) / weighted_mean(peaks, |peak| (peak.middle - middle).powi(2));
    let square = |peak: &Peak| (peak.delay - delay - slope * (peak.middle - middle)).powi(2);
    (slope, peaks.iter().map(|peak| peak.weight * square(peak)).sum())
}

/// Weighted sum of the squared distances of peaks from their mean.
fn squares_about_mean(peaks: &[Peak]) -> f64 {
    let delay = weighted_mean(peaks, |peak| peak.delay);
    peaks.iter().map(|peak| peak.weight * (peak.delay - delay).powi(2)).sum()
}
