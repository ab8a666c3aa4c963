//! The rate of one clock against another, from parts of a run that are matched one by one.
//!
//! Over a part of some seconds two clocks do not drift apart measurably. Over the run the shifts of its parts lie on a line whose slope is the
//! rate. A part alone may match in several places, all parts together in one: the correlations are summed along lines
//! ("slant stack") before any peak is chosen. A clock that was set in the middle of the run is another explanation of shifts that
//! differ: two levels instead of a slope. The one that leaves smaller squares is taken.

use std::ops::Range;

use super::correlate::{Correlations, correlations};
use super::speeds::grid_step_s;
use crate::prepare::Channels;
use crate::threads::each;

/// Clocks of controllers and instruments differ by less than this; quartz by a hundredth of it.
const RATE_MAX: f64 = 0.0105;
/// The fit of the angles corrects smaller differences of shifts \[s\]: a joint turns by 6 mrad in this time.
const BRIDGED_S: f64 = 0.02;
/// Step of the grid on which parts are matched \[s\]; peaks are found between its points.
const STEP_S: f64 = 0.05;
/// Longest part \[s\]: at the largest rate its ends are shifted by 0.1 s.
const PART_S: f64 = 20.0;
/// Parts of a short run, and of a long one.
const PARTS: [usize; 2] = [6, 16];
/// Share of a part that must lie in the other log.
const OVERLAP: f64 = 0.6;
/// A peak of a part belongs to the line if it is so near, in grid steps.
const NEAR: i64 = 2;

/// A part of a run, compared with the whole of the other log.
struct Part {
    /// Its middle since the middle of the run, in grid steps.
    middle: f64,
    /// Half of its length in grid steps.
    half: f64,
    correlations: Correlations,
}

impl Part {
    /// Shift of the part in grid steps where the run's middle is at `origin` of the other log.
    fn shift(&self, origin: f64, rate: f64) -> f64 {
        origin + (1.0 + rate) * self.middle - self.half
    }
}

/// Rates, less one, at which two logs are to be compared: that of clocks that run alike, and the one on which the parts of the run
/// agree if it is clearly another one.
///
/// `window` is the part of the run that is compared, by its times `t_s` \[s\]; `whole` gives the speeds of the other log, which is
/// `whole_s` long, at a step \[s\], `part` those of a part of the run.
pub(in crate::prepare) fn rates(
    t_s: &[f64],
    window: &Range<usize>,
    whole_s: f64,
    whole: impl FnOnce(f64) -> Channels,
    part: impl Fn(Range<usize>, f64) -> Channels + Sync,
) -> Vec<f64> {
    let times_s = t_s.get(window.clone()).unwrap_or_default();
    let (Some(first_s), Some(last_s)) = (times_s.first(), times_s.last()) else { return vec![0.0] };
    let run_s = last_s - first_s;
    let step_s = STEP_S.max(grid_step_s(whole_s));
    let count = ((run_s / PART_S) as usize).clamp(PARTS[0], PARTS[1]);
    let part_s = PART_S.min(run_s / count as f64);
    let whole = whole(step_s);
    let row_at = |since_s: f64| window.start + times_s.partition_point(|t_s| *t_s < first_s + since_s);
    let parts: Vec<Part> = each(count, |number| {
        let from_s = number as f64 * (run_s - part_s) / (count - 1) as f64;
        let rows = row_at(from_s)..row_at(from_s + part_s);
        let begins_s = t_s.get(rows.start)? - first_s;
        let channels = part(rows, step_s);
        let half = 0.5 * channels.known.len() as f64;
        let middle = (begins_s - 0.5 * run_s) / step_s + half;
        let overlap_min = (OVERLAP * 2.0 * half) as usize;
        Some(Part { middle, half, correlations: correlations(&whole, &channels, overlap_min) })
    })
    .into_iter()
    .flatten()
    .collect();
    let rate = rate(&parts, whole.known.len()).unwrap_or_default();
    if 0.5 * rate.abs() * run_s > BRIDGED_S { vec![0.0, rate] } else { vec![0.0] }
}

/// The rate less one on whose line the parts match best.
fn rate(parts: &[Part], points: usize) -> Option<f64> {
    let reach = parts.iter().map(|part| part.middle.abs()).fold(0.0, f64::max);
    let most = (RATE_MAX * reach).ceil() as i64;
    let stacks = each((2 * most + 1) as usize, |place| {
        let rate = (place as i64 - most) as f64 / reach.max(1.0);
        let mut sums = vec![0.0; points];
        for part in parts {
            let first = part.shift(0.0, rate).round() as i64;
            sums.iter_mut().zip(first..).for_each(|(sum, shift)| *sum += part.correlations.at(shift));
        }
        let best = sums.into_iter().enumerate().max_by(|a, b| a.1.total_cmp(&b.1))?;
        Some((rate, best.0 as f64, best.1))
    });
    let matching = stacks.into_iter().flatten().filter(|(.., sum)| *sum > 0.0);
    let (coarse, origin, _) = matching.max_by(|a, b| a.2.total_cmp(&b.2))?;
    // A line through the peaks near it is finer than the steps between lines.
    let peak = |part: &Part| {
        let line = part.shift(origin, coarse).round() as i64;
        let (shift, weight) = part.correlations.peak_near(line, NEAR)?;
        Some(Peak { middle: part.middle, later: shift - part.shift(origin, 0.0), weight })
    };
    let peaks: Vec<Peak> = parts.iter().filter_map(peak).collect();
    let (slope, squares) = line(&peaks);
    let set_at = |at: usize| level(&peaks[..at]) + level(&peaks[at..]);
    // A clock that is set in between runs as before on both sides.
    let is_set = (1..peaks.len()).any(|at| set_at(at) < squares);
    (slope.is_finite() && !is_set).then(|| slope.clamp(-RATE_MAX, RATE_MAX))
}

/// Where a part matches best.
struct Peak {
    /// Middle of the part since the middle of the run, in grid steps.
    middle: f64,
    /// Its shift less the one at equal rates, in grid steps.
    later: f64,
    weight: f64,
}

fn mean(peaks: &[Peak], of: impl Fn(&Peak) -> f64) -> f64 {
    let weights: f64 = peaks.iter().map(|peak| peak.weight).sum();
    peaks.iter().map(|peak| peak.weight * of(peak)).sum::<f64>() / weights
}

/// Slope of the line through peaks, and their weighted squares from it.
fn line(peaks: &[Peak]) -> (f64, f64) {
    let [middle, later] = [mean(peaks, |peak| peak.middle), mean(peaks, |peak| peak.later)];
    let product = |peak: &Peak| (peak.middle - middle) * (peak.later - later);
    let slope = mean(peaks, product) / mean(peaks, |peak| (peak.middle - middle).powi(2));
    let square = |peak: &Peak| (peak.later - later - slope * (peak.middle - middle)).powi(2);
    (slope, peaks.iter().map(|peak| peak.weight * square(peak)).sum())
}

/// Weighted squares of peaks from their mean.
fn level(peaks: &[Peak]) -> f64 {
    let later = mean(peaks, |peak| peak.later);
    peaks.iter().map(|peak| peak.weight * (peak.later - later).powi(2)).sum()
}
