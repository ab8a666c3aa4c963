//! Estimates the rate of one clock relative to another, from parts of a run. `find` uses this rate for
//! the correlation of speeds.
//!
//! A *part* is a section of some seconds, in which two clocks do not drift apart measurably. Each part is correlated with
//! the whole of the other log. The shifts `s` of the parts lie on a line `s = s0 + rate m`, where `m` is the middle of a
//! part. A single part may match at several shifts, but all parts together match on one line only. The correlations are
//! therefore summed along lines ("slant stack") before any peak is chosen.
//!
//! Shifts also differ if a clock was set during the run. The shifts then have two levels instead of a slope. The explanation
//! that leaves the smaller sum of squares is used.

use std::ops::Range;

use super::correlate::Correlations;
use super::speeds::grid_step_s;
use crate::prepare::Channels;
use crate::threads::each;

/// Largest rate minus one that is searched for. The rates of controller and instrument clocks differ by less than this, and
/// the rates of quartz clocks by a hundredth of this.
const RATE_MAX: f64 = 0.0105;
/// Largest error of a shift that the fit of the angles corrects \[s\]. During this time a joint turns by 6 mrad.
const BRIDGED_S: f64 = 0.02;
/// Smallest step of the grid on which parts are matched \[s\]. Peaks are interpolated between grid points.
const STEP_S: f64 = 0.05;
/// Longest part \[s\]. At the largest rate the ends of such a part are shifted by 0.1 s.
const PART_S: f64 = 20.0;
/// Smallest and largest number of parts of a run.
const PARTS: [usize; 2] = [6, 16];
/// Fraction of a part that must overlap with the other log.
const OVERLAP_MIN: f64 = 0.6;
/// Largest distance of a part's peak from the line to which it belongs, in grid steps.
const NEAR: i64 = 2;

/// A part of a run, and its correlations with the whole of the other log.
struct RunPart {
    /// Middle of the part minus the middle of the run, in grid steps.
    middle: f64,
    /// Half the length of the part, in grid steps.
    half_length: f64,
    correlations: Correlations,
}

impl RunPart {
    /// Grid index in the other log that corresponds to the first sample of this part. The middle of the run is at index
    /// `run_middle` of the other log, and the rate minus one is `rate`.
    fn shift(&self, run_middle: f64, rate: f64) -> f64 {
        run_middle + (1.0 + rate) * self.middle - self.half_length
    }
}

/// Returns the rates minus one at which two logs are to be compared. The first is 0, for clocks with equal rates. The second
/// is the rate at which the parts of the run agree, if it is clearly different from 0.
///
/// `window` is the range of samples of the run that are compared, and `t_s` are the times of all samples \[s\]. The other
/// log is `log_s` long. `speeds_of_log` returns the speeds of the other log on a grid with the given step \[s\].
/// `speeds_of_part` returns the speeds of a range of samples of the run on such a grid.
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
    // The parts are spread evenly over the run. In a long run there are gaps between them.
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
    // At the ends of the run, the shift differs from the shift in the middle by the rate times half the length of the run.
    if 0.5 * rate.abs() * run_s > BRIDGED_S { vec![0.0, rate] } else { vec![0.0] }
}

/// The largest sum of the parts' correlations at one rate (minus one), and the index of the run's middle in the other
/// log at this sum.
struct StackedCorrelations {
    rate: f64,
    run_middle: f64,
    sum: f64,
}

/// The rate minus one of the line on which the parts match best. `log_points` is the length of the other log in grid steps.
/// `None` if the parts match nowhere, or if a clock step explains the shifts better.
fn common_rate(parts: &[RunPart], log_points: usize) -> Option<f64> {
    let reach = parts.iter().map(|part| part.middle.abs()).fold(0.0, f64::max);
    // The difference between two successive rates moves the outermost part by one grid step.
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
    // The lines that were tried differ by whole grid steps. A line fitted through the peaks near the best of
    // them is more accurate.
    let peak = |part: &RunPart| {
        let on_line = part.shift(best.run_middle, best.rate).round() as i64;
        let (shift, weight) = part.correlations.peak_near(on_line, NEAR)?;
        Some(Peak { middle: part.middle, delay: shift - part.shift(best.run_middle, 0.0), weight })
    };
    let peaks: Vec<Peak> = parts.iter().filter_map(peak).collect();
    let (slope, squares) = slope_and_squares(&peaks);
    let squares_of_step =
        |index: usize| squares_about_mean(&peaks[..index]) + squares_about_mean(&peaks[index..]);
    // If the clock was set between two parts, the shifts are constant before and after this instant, because the
    // rate did not change.
    let is_clock_step = (1..peaks.len()).any(|index| squares_of_step(index) < squares);
    (slope.is_finite() && !is_clock_step).then(|| slope.clamp(-RATE_MAX, RATE_MAX))
}

/// The shift at which a part matches best.
struct Peak {
    /// Middle of the part minus the middle of the run, in grid steps.
    middle: f64,
    /// Shift of the part minus the shift that it would have with equal rates, in grid steps.
    delay: f64,
    /// Correlation at the shift of the part.
    weight: f64,
}

/// Mean of a value over the peaks, weighted by their correlations.
fn weighted_mean(peaks: &[Peak], value: impl Fn(&Peak) -> f64) -> f64 {
    let weights: f64 = peaks.iter().map(|peak| peak.weight).sum();
    peaks.iter().map(|peak| peak.weight * value(peak)).sum::<f64>() / weights
}

/// Slope of the weighted least-squares line through the peaks, and the weighted sum of the squared residuals.
fn slope_and_squares(peaks: &[Peak]) -> (f64, f64) {
    let middle = weighted_mean(peaks, |peak| peak.middle);
    let delay = weighted_mean(peaks, |peak| peak.delay);
    let product = |peak: &Peak| (peak.middle - middle) * (peak.delay - delay);
    let slope = weighted_mean(peaks, product) / weighted_mean(peaks, |peak| (peak.middle - middle).powi(2));
    let square = |peak: &Peak| (peak.delay - delay - slope * (peak.middle - middle)).powi(2);
    (slope, peaks.iter().map(|peak| peak.weight * square(peak)).sum())
}

/// Weighted sum of the squared differences between the delays of the peaks and their mean.
fn squares_about_mean(peaks: &[Peak]) -> f64 {
    let delay = weighted_mean(peaks, |peak| peak.delay);
    peaks.iter().map(|peak| peak.weight * (peak.delay - delay).powi(2)).sum()
}
