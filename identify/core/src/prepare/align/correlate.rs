//! Finds the shift at which two sets of signals match best. It is used for the clocks of recordings and trackers.
//!
//! The method is a normalised cross-correlation in which samples may be unknown (Padfield, "Masked object registration in
//! the Fourier domain", IEEE Trans. Image Processing 21, 2012). At each shift, only the `n` samples that both logs contain
//! are compared. Their means and variances are computed from the same `n` samples. The result is therefore not biased if one
//! log is ten times longer than the other, or if a log has gaps. In the following formula, `a` and `b` are the values of the
//! two logs, and the sums run over these samples. The numerator and the two variances are each summed over the channels:
//!
//! `r = (sum ab - sum a sum b / n) / sqrt((sum aa - (sum a)^2 / n) (sum bb - (sum b)^2 / n))`
//!
//! Each sum is computed for all shifts at once, as an inverse transform of a product of Fourier transforms.

use std::sync::Arc;

use rustfft::num_complex::Complex;
use rustfft::{Fft, FftPlanner};

use crate::statistics::mean;
use crate::threads::each;

/// Signals on a common uniform grid.
#[derive(Debug, Clone, PartialEq)]
pub struct Channels {
    /// Whether the signals are known, for each grid point.
    pub known: Vec<bool>,
    /// Values of each channel at each grid point. Values at unknown points are ignored.
    pub values: Vec<Vec<f64>>,
}

/// A shift at which two sets of signals match.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Match {
    /// Shift in grid steps, with a fraction: sample `i` of the second set corresponds to sample `i + shift` of the first set.
    pub shift: f64,
    /// Correlation at this shift, -1 to 1.
    pub correlation: f64,
    /// Number of grid points that were compared at this shift.
    pub overlap: usize,
    /// Highest correlation at a clearly different shift; 0 if there is none.
    pub runner_up: f64,
}

/// Shifts that differ by more than this number of grid steps count as clearly different.
const APART: i64 = 100;
/// Correlations that differ by no more than this count as equally good, which occurs if the motion repeats. The match with
/// the longer overlap is then selected.
const TIE: f64 = 0.02;

/// Finds the shift with the highest correlation, among the shifts at which at least `overlap_min` points overlap. `None` if
/// there is no such shift, or if the signals do not vary.
pub fn correlate(first: &Channels, second: &Channels, overlap_min: usize) -> Option<Match> {
    let mut matches = candidates(first, second, overlap_min, usize::MAX);
    let highest = matches.first()?.correlation;
    matches.retain(|matched| matched.correlation >= highest - TIE);
    longest_overlap(matches, |matched| matched)
}

/// Returns the match with the longest overlap among equally good matches. An overlap counts as longer only if it is longer
/// by more than a tenth; otherwise the earlier match is returned.
pub(in crate::prepare) fn longest_overlap<T>(found: Vec<T>, matched: impl Fn(&T) -> &Match) -> Option<T> {
    found.into_iter().reduce(|best, other| {
        if matched(&other).overlap as f64 > 1.1 * matched(&best).overlap as f64 { other } else { best }
    })
}

/// Returns the best matches at clearly different shifts, at most `count`, with the highest correlation first.
pub fn candidates(first: &Channels, second: &Channels, overlap_min: usize, count: usize) -> Vec<Match> {
    let scores = scores(first, second, overlap_min);
    let mut peaks: Vec<(usize, f64)> = (0..scores.len())
        .filter(|&index| is_peak(&scores, index))
        .filter_map(|index| Some((index, scores[index].correlation?)))
        .collect();
    peaks.sort_by(|a, b| b.1.total_cmp(&a.1));
    let mut distinct: Vec<(usize, f64)> = Vec::new();
    for (index, correlation) in peaks {
        let near = |other: usize| (scores[index].shift - scores[other].shift).abs() <= APART;
        if !distinct.iter().any(|&(other, _)| near(other)) {
            distinct.push((index, correlation));
        }
        // One more match than `count` is needed, as the runner-up if `count` is 1.
        if distinct.len() > count {
            break;
        }
    }
    let correlation_of = |rank: usize| distinct.get(rank).map_or(0.0, |(_, value)| value.max(0.0));
    let matches = distinct.iter().enumerate().take(count).map(|(rank, &(index, correlation))| Match {
        shift: scores[index].shift as f64 + vertex(&scores, index),
        correlation,
        overlap: scores[index].overlap,
        runner_up: if rank == 0 { correlation_of(1) } else { correlation_of(0) },
    });
    matches.collect()
}

/// Correlations of two sets of signals at all shifts.
pub(in crate::prepare) struct Correlations(Vec<Score>);

impl Correlations {
    /// Computes the correlations at shifts at which at least `overlap_min` points overlap.
    pub fn new(first: &Channels, second: &Channels, overlap_min: usize) -> Self {
        Self(scores(first, second, overlap_min))
    }

    fn index(&self, shift: i64) -> Option<usize> {
        usize::try_from(shift - self.0.first()?.shift).ok().filter(|index| *index < self.0.len())
    }

    /// Correlation at a shift in grid steps; 0 if the signals overlap too little or do not vary.
    pub fn at(&self, shift: i64) -> f64 {
        self.index(shift).and_then(|index| self.0[index].correlation).unwrap_or_default()
    }

    /// Returns the highest positive peak within `reach` grid steps of a shift: its shift, with a fraction, and its correlation.
    pub fn peak_near(&self, shift: i64, reach: i64) -> Option<(f64, f64)> {
        let near = (shift - reach..=shift + reach).filter_map(|shift| self.index(shift));
        let peaks = near.filter(|index| is_peak(&self.0, *index));
        let highest = peaks.filter_map(|index| Some((index, self.0[index].correlation?)));
        let (index, correlation) = highest.max_by(|a, b| a.1.total_cmp(&b.1))?;
        (correlation > 0.0).then(|| (self.0[index].shift as f64 + vertex(&self.0, index), correlation))
    }
}

/// Correlation at a shift in grid steps, computed from `overlap` grid points.
#[derive(Clone, Copy)]
struct Score {
    shift: i64,
    overlap: usize,
    /// `None` if the overlap is too short or the signals do not vary in it.
    correlation: Option<f64>,
}

fn is_peak(scores: &[Score], index: usize) -> bool {
    let Some(here) = scores[index].correlation else { return false };
    let at_most_here = |neighbour: Option<&Score>| {
        neighbour.and_then(|score| score.correlation).is_none_or(|value| value <= here)
    };
    at_most_here(index.checked_sub(1).and_then(|before| scores.get(before)))
        && at_most_here(scores.get(index + 1))
}

/// Position of the maximum of the parabola through a peak and its two neighbours, relative to the peak: -0.5 to 0.5 grid steps.
fn vertex(scores: &[Score], peak: usize) -> f64 {
    let correlation = |index: usize| scores.get(index).and_then(|score| score.correlation);
    let left = peak.checked_sub(1).and_then(correlation);
    let (Some(left), Some(here), Some(right)) = (left, correlation(peak), correlation(peak + 1)) else {
        return 0.0;
    };
    let bend = left - 2.0 * here + right;
    if bend < 0.0 { (0.5 * (left - right) / bend).clamp(-0.5, 0.5) } else { 0.0 }
}

/// Correlation at every shift, in the order of the shifts.
fn scores(first: &Channels, second: &Channels, overlap_min: usize) -> Vec<Score> {
    let (first_len, second_len) = (first.known.len(), second.known.len());
    let overlap_min = overlap_min.max(3);
    let transform = FourierTransforms::new(first_len + second_len);
    let masks = each(2, |number| transform.forward(&mask([first, second][number])));
    let overlaps = transform.product(&masks[0], &masks[1]);
    let mut covariance = vec![0.0; overlaps.len()];
    let mut variances = [vec![0.0; overlaps.len()], vec![0.0; overlaps.len()]];
    for (a, b) in first.values.iter().zip(&second.values) {
        // Both signals of a channel are scaled by the same factor. With separate factors, the two signals would be scaled
        // differently if one log covers more motion than the other.
        let scale = inverse_deviation(b, &second.known);
        let (a, b) = (normalised(a, &first.known, scale), normalised(b, &second.known, scale));
        let squared = [&a, &b].map(|signal| signal.iter().map(|value| value * value).collect());
        let signals: [&Vec<f64>; 4] = [&a, &b, &squared[0], &squared[1]];
        let spectra = each(signals.len(), |number| transform.forward(signals[number]));
        // The product of the spectrum of one signal with the mask of the other log gives the sum of this signal over
        // the points at which both logs are known.
        let factors = [
            (&spectra[0], &spectra[1]),
            (&spectra[0], &masks[1]),
            (&masks[0], &spectra[1]),
            (&spectra[2], &masks[1]),
            (&masks[0], &spectra[3]),
        ];
        let sums = each(factors.len(), |number| transform.product(factors[number].0, factors[number].1));
        for (index, overlap) in overlaps.iter().enumerate() {
            let n = overlap.round().max(1.0);
            let [sum_ab, sum_a, sum_b, sum_aa, sum_bb] = std::array::from_fn(|number| sums[number][index]);
            covariance[index] += sum_ab - sum_a * sum_b / n;
            variances[0][index] += sum_aa - sum_a.powi(2) / n;
            variances[1][index] += sum_bb - sum_b.powi(2) / n;
        }
    }
    // All shifts at which the two sets overlap. Negative shifts are at the upper end of the transform.
    (1 - second_len as i64..first_len as i64)
        .map(|shift| {
            let index = shift.rem_euclid(transform.length as i64) as usize;
            let overlap = overlaps[index].round().max(0.0) as usize;
            let (variance_a, variance_b) = (variances[0][index], variances[1][index]);
            // Each channel of the second set has unit variance. A much smaller variance in the overlap means standstill.
            let standstill = 1e-3 * overlap as f64;
            let usable = overlap >= overlap_min && variance_a > standstill && variance_b > standstill;
            let correlation =
                usable.then(|| (covariance[index] / (variance_a * variance_b).sqrt()).clamp(-1.0, 1.0));
            Score { shift, overlap, correlation }
        })
        .collect()
}

/// 1 at known grid points, 0 at unknown ones.
fn mask(channels: &Channels) -> Vec<f64> {
    channels.known.iter().map(|&known| f64::from(u8::from(known))).collect()
}

/// The values at known grid points.
fn known<'a>(values: &'a [f64], known: &'a [bool]) -> impl Iterator<Item = f64> + 'a {
    values.iter().zip(known).filter(|(_, known)| **known).map(|(value, _)| *value)
}

/// One over the standard deviation of the known points. With this factor all channels have the same weight. 0 for a joint
/// that does not move, because its channel contains no information.
fn inverse_deviation(values: &[f64], known_points: &[bool]) -> f64 {
    let middle = mean(known(values, known_points));
    let deviation = mean(known(values, known_points).map(|value| (value - middle).powi(2))).sqrt();
    if deviation > 1e-9 { 1.0 / deviation } else { 0.0 }
}

/// Known points minus their mean, multiplied by `scale`; 0 at unknown points. Subtraction of the mean keeps the sums accurate.
fn normalised(values: &[f64], known_points: &[bool], scale: f64) -> Vec<f64> {
    let middle = mean(known(values, known_points));
    let about = |(value, &known): (&f64, &bool)| if known { (value - middle) * scale } else { 0.0 };
    values.iter().zip(known_points).map(about).collect()
}

/// Fourier transforms of one length. The length is chosen so that the correlation does not wrap around.
struct FourierTransforms {
    length: usize,
    forward: Arc<dyn Fft<f64>>,
    inverse: Arc<dyn Fft<f64>>,
}

impl FourierTransforms {
    fn new(points: usize) -> Self {
        let length = points.max(2).next_power_of_two();
        let mut planner = FftPlanner::new();
        Self { length, forward: planner.plan_fft_forward(length), inverse: planner.plan_fft_inverse(length) }
    }

    fn forward(&self, signal: &[f64]) -> Vec<Complex<f64>> {
        let mut spectrum: Vec<Complex<f64>> = signal.iter().map(|&value| Complex::new(value, 0.0)).collect();
        spectrum.resize(self.length, Complex::default());
        self.forward.process(&mut spectrum);
        spectrum
    }

    /// Computes `sum over i of a[i + shift] b[i]` at every shift, from the spectra of `a` and `b`.
    fn product(&self, a: &[Complex<f64>], b: &[Complex<f64>]) -> Vec<f64> {
        let mut product: Vec<Complex<f64>> = a.iter().zip(b).map(|(a, b)| a * b.conj()).collect();
        self.inverse.process(&mut product);
        product.iter().map(|value| value.re / self.length as f64).collect()
    }
}
