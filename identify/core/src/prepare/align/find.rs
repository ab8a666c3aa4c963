//! Finds the clock, encoder map and offsets at which a recording fits a robot log. These are steps 4
//! to 6 of [`prepare`](crate::prepare).
//!
//! 1. The *window* is the section of the recording with the most motion. The speeds of the joints in the window are
//!    correlated with those of the robot's log. Each peak is a *candidate*: a rate and a shift of the clocks.
//! 2. At each candidate the angles are compared. If an encoder map fits, the candidate becomes a *hypothesis*: a clock, an
//!    encoder map, and offsets.
//! 3. The most likely hypotheses are refined (`refine`). The result of each refinement is a *fit*.
//! 4. The fit with the smallest residuals is extended from the window to the whole recording.

use std::ops::Range;
use std::sync::Arc;

use super::clock::SHIFT_SIGMA_S;
use super::correlate::{Match, candidates};
use super::rate::rates;
use super::refine::{AlignmentFit, refine};
use super::speeds::{grid_step_s, measured_speeds, predicted_speeds, without_order};
use super::window::{Best, CANDIDATES, WINDOW_S, best, extended, liveliest, no_match, overlap_min_s};
use crate::kinematics::{BAR_JOINTS, Chain, Joints, mirroring_joints};
use crate::logs::{CubicSpline, Stream};
use crate::model::{ClockRelation, Observation};
use crate::prepare::encoders::encoder_map::{AnglePair, EncoderMap, EncoderMapReport, find_encoder_map};
use crate::prepare::encoders::segments::{OffsetFit, fit_offsets};
use crate::prepare::encoders::slip::large_slip;
use crate::prepare::samples::select::{select, spaced};
use crate::prepare::{BarReading, Channels, ComparedLog, Predictor, PrepareError, PrepareOptions};
use crate::threads::{each, rows};

/// A recording, and the robot's log in which the motion of the recording is searched for.
pub(in crate::prepare) struct AlignmentSearch<'a> {
    pub readings: &'a Stream<BarReading>,
    /// Joints of the recording's encoders, 1 to 5.
    pub recorded_joints: &'a [u8],
    /// Number of origins of the counters.
    pub origins: usize,
    pub log: &'a Arc<CubicSpline<Joints>>,
    pub log_duration_s: f64,
    pub predictor: &'a Predictor<'a>,
    /// Nominal robot and bar.
    pub chains: [&'a Chain; 2],
    pub options: &'a PrepareOptions,
}

/// A recording aligned with a robot log.
#[derive(Debug, Clone)]
pub(in crate::prepare) struct AlignedRecording {
    /// How the speeds of both logs match.
    pub matched: Match,
    /// Whether another shift fits equally well.
    pub ambiguous: bool,
    /// Joint and direction of each encoder.
    pub encoder_map: EncoderMapReport,
    /// Refined offsets of each origin, and configurations, from samples of the whole recording.
    pub offset_fit: OffsetFit,
    /// The refined fit. The bar times of its clock count from the first reading.
    pub fit: AlignmentFit,
}

/// Largest number of hypotheses that are refined.
const FITTED_MAX: usize = 4;
/// Hypotheses are refined if their spread is at most this factor times the smallest spread. The geometry is still nominal,
/// so the correct hypothesis need not have the smallest spread.
const NEAR_BEST: f64 = 2.0;
/// Between two successive samples whose angles are compared, a joint must travel by at least this angle \[rad\].
const PAIRS_APART_RAD: f64 = 0.01;
/// Largest number of samples whose angles are compared.
const PAIRS_MAX: usize = 3000;
/// Largest number of samples of a refinement.
const FIT_MAX: usize = 1500;
/// In windows longer than [`WINDOW_S`] only every `LONG_STRIDE`-th sample is used.
const LONG_STRIDE: usize = 5;
/// Longest gap in the readings within a segment \[s\]. During a longer gap the bar may pass a singular pose.
const HOLE_S: f64 = 1.0;
/// Shifts that differ by less than this number of grid steps count as the same.
const SAME_STEPS: f64 = 5.0;

/// A clock with the encoder map and the offsets that were found from the angles at this clock, before refinement.
pub(in crate::prepare) struct Hypothesis {
    matched: Match,
    clock: ClockRelation,
    encoder_map: EncoderMapReport,
    offset_fit: OffsetFit,
}

impl Hypothesis {
    /// Root of the sum of the squared spreads of all joints \[rad\].
    fn spread_rad(&self) -> f64 {
        self.offset_fit.spread_rad.iter().map(|spread| spread * spread).sum::<f64>().sqrt()
    }
}

/// A refined fit with the encoder map of its hypothesis.
struct MappedFit {
    encoder_map: EncoderMapReport,
    fit: AlignmentFit,
}

impl AlignmentSearch<'_> {
    /// Finds the best alignment.
    ///
    /// # Errors
    /// [`PrepareError::NoMatch`], [`PrepareError::NoSpeeds`], [`PrepareError::ClockJump`], [`PrepareError::EncoderSlip`],
    /// and the errors of [`find_encoder_map`].
    pub fn run(&self) -> Result<AlignedRecording, PrepareError> {
        let step_s = grid_step_s(self.log_duration_s);
        let window = self.liveliest();
        let Best { matched, ambiguous, fit: MappedFit { encoder_map, fit } } =
            self.best_fit(&window, step_s)?;
        let (mut offset_fit, fit) = self.extended(window, &encoder_map.used, &fit)?;
        offset_fit.correct(&fit.offsets_by_rad);
        Ok(AlignedRecording { matched, ambiguous, encoder_map, offset_fit, fit })
    }

    /// Returns the best fit of the window.
    fn best_fit(&self, window: &Range<usize>, step_s: f64) -> Result<Best<MappedFit>, PrepareError> {
        let (hypotheses, refusal) = self.hypotheses(window, step_s)?;
        let fits = self.fits(window, self.most_likely(window, hypotheses));
        // The fits are compared by the 90 % quantile of the residuals, not by the median. If the shift is wrong by a
        // repetition of the motion, many samples still fit well, because the repetitions are similar.
        let best = best(fits, |mapped| mapped.fit.sigma_of_most_rad, |_, _| true);
        let spread_max_rad = self.options.spread_max_mrad * 1e-3;
        let fits_poorly = best.as_ref().is_none_or(|best| best.fit.fit.sigma_of_most_rad > spread_max_rad);
        // A single shift fits only one side of a large clock step, so a poor fit may be due to such a step.
        if fits_poorly && let Some(jump) = self.jump_between_parts(window, step_s) {
            return Err(jump);
        }
        best.ok_or_else(|| refusal.unwrap_or(PrepareError::NothingToFit))
    }

    /// Extends the offsets and the fit of the window to all samples.
    fn extended(
        &self,
        window: Range<usize>,
        encoder_map: &EncoderMap,
        fit: &AlignmentFit,
    ) -> Result<(OffsetFit, AlignmentFit), PrepareError> {
        let measured = encoder_map.measured();
        let fit_offsets_and_refine = |window: &Range<usize>, fit: &AlignmentFit| {
            let offset_fit = self.offset_fit(&self.pairs(window, fit.clock), encoder_map);
            let fit = self.refined(&offset_fit, &measured, fit.clock, Some(fit))?;
            Some((offset_fit, fit))
        };
        let in_window = fit_offsets_and_refine(&window, fit).ok_or(PrepareError::NothingToFit)?;
        let refit = |window: &Range<usize>, (_, fit): &(_, AlignmentFit)| fit_offsets_and_refine(window, fit);
        extended(&self.readings.t_s, window, in_window, refit)
    }

    /// Returns a hypothesis for each candidate at which an encoder map fits. Also returns the error of one of the other
    /// candidates, if there are any.
    fn hypotheses(
        &self,
        window: &Range<usize>,
        step_s: f64,
    ) -> Result<(Vec<Hypothesis>, Option<PrepareError>), PrepareError> {
        let mut hypotheses = Vec::new();
        let mut refusal = None;
        for candidate in self.shifts(window, step_s)? {
            match self.hypothesis(window, candidate, step_s) {
                Ok(hypothesis) => hypotheses.push(hypothesis),
                Err(error) => {
                    // The first error is kept. A slip of an encoder replaces any other error, because a slip at one
                    // candidate is also the cause of the errors at the other candidates.
                    let is_slip = matches!(error, PrepareError::EncoderSlip { .. });
                    refusal = refusal.filter(|_| !is_slip).or(Some(error));
                }
            }
        }
        Ok((hypotheses, refusal))
    }

    /// Selects at most [`FITTED_MAX`] hypotheses with different clocks, the most likely first.
    fn most_likely(&self, window: &Range<usize>, mut hypotheses: Vec<Hypothesis>) -> Vec<Hypothesis> {
        let least_rad = hypotheses.iter().map(Hypothesis::spread_rad).fold(f64::INFINITY, f64::min);
        let highest = hypotheses.iter().map(|other| other.matched.correlation).fold(0.0, f64::max);
        // If a motion repeats, many hypotheses have nearly the same spread. The hypothesis whose speeds match best
        // is therefore always selected.
        let has_highest = |hypothesis: &Hypothesis| hypothesis.matched.correlation >= highest;
        hypotheses.retain(|other| has_highest(other) || other.spread_rad() <= NEAR_BEST * least_rad);
        hypotheses.sort_by(|a, b| {
            has_highest(b).cmp(&has_highest(a)).then(a.spread_rad().total_cmp(&b.spread_rad()))
        });
        // Candidates at different rates may lead to the same clock.
        let mut distinct: Vec<Hypothesis> = Vec::new();
        for hypothesis in hypotheses {
            if !distinct.iter().any(|other| self.is_same(window, other.clock, hypothesis.clock)) {
                distinct.push(hypothesis);
            }
        }
        distinct.truncate(FITTED_MAX);
        distinct
    }

    /// Refines the hypotheses. Of several fits that end at the same clock, only the best is returned.
    fn fits(&self, window: &Range<usize>, hypotheses: Vec<Hypothesis>) -> Vec<(Match, MappedFit)> {
        let mut fits: Vec<(Match, MappedFit)> = Vec::new();
        for Hypothesis { matched, clock, encoder_map, offset_fit } in hypotheses {
            let measured = encoder_map.used.measured();
            let Some(fit) = self.refined(&offset_fit, &measured, clock, None) else { continue };
            let mut others = fits.iter_mut();
            let same_clock = others.find(|(_, other)| self.is_same(window, other.fit.clock, fit.clock));
            match same_clock {
                Some((_, other)) if other.fit.sigma_of_most_rad <= fit.sigma_of_most_rad => {}
                Some(worse) => *worse = (matched, MappedFit { encoder_map, fit }),
                None => fits.push((matched, MappedFit { encoder_map, fit })),
            }
        }
        fits
    }

    fn margin_rad(&self) -> f64 {
        self.options.singular_margin_deg.to_radians()
    }

    /// The section of the recording with the most motion, at most [`WINDOW_S`] long.
    fn liveliest(&self) -> Range<usize> {
        let travel_rad = |pair: [usize; 2]| {
            let [a, b] = pair.map(|sample| &self.readings[sample]);
            let differences = a.recorded_rad.iter().zip(&b.recorded_rad).map(|(a, b)| (a - b).abs());
            if a.origin == b.origin { differences.sum::<f64>() } else { 0.0 }
        };
        liveliest(&self.readings.t_s, travel_rad)
    }

    /// Time from the first sample to a sample \[s\].
    fn time_s(&self, sample: usize) -> f64 {
        self.readings.t_s.get(sample).copied().unwrap_or_default()
    }

    /// Whether the difference between two clocks is less than the accuracy of the correlation of speeds
    /// ([`SHIFT_SIGMA_S`]) in the whole window.
    fn is_same(&self, window: &Range<usize>, clock: ClockRelation, other: ClockRelation) -> bool {
        let ends_s = [window.start, window.end.saturating_sub(1)].map(|sample| self.time_s(sample));
        ends_s
            .into_iter()
            .all(|t_s| (clock.robot_time_s(t_s) - other.robot_time_s(t_s)).abs() < SHIFT_SIGMA_S)
    }

    /// Returns the candidates. Each candidate is the rate of the clocks minus one, and a match of the speeds at this rate.
    /// The shift of the match is in grid steps. It is valid for bar times that count from the first sample of the window.
    fn shifts(&self, window: &Range<usize>, step_s: f64) -> Result<Vec<(f64, Match)>, PrepareError> {
        let joints = self.joints();
        let speeds_of_log = |step_s| without_order(&self.predicted(step_s));
        let speeds_of_part = |samples, step_s| {
            without_order(&measured_speeds(&self.readings.slice(samples), &joints, step_s, 0.0))
        };
        let from_robot = self.predicted(step_s);
        let (mut candidates, mut refusal) = (Vec::new(), None);
        for rate in rates(&self.readings.t_s, window, self.log_duration_s, speeds_of_log, speeds_of_part) {
            match self.candidates(window, &from_robot, rate, step_s) {
                Ok(matches) => candidates.extend(matches.into_iter().map(|matched| (rate, matched))),
                Err(error) => refusal = Some(error),
            }
        }
        match refusal {
            Some(refusal) if candidates.is_empty() => {
                Err(self.jump_between_parts(window, step_s).unwrap_or(refusal))
            }
            _ => Ok(candidates),
        }
    }

    /// Returns the matches of the speeds at one rate of the clocks; `rate` is this rate minus one. The speeds are correlated
    /// in two ways: joint by joint, and as one channel that does not depend on the order of the joints. The second way finds
    /// shifts even if encoders were recorded on wrong joints.
    fn candidates(
        &self,
        window: &Range<usize>,
        from_robot: &Channels,
        rate: f64,
        step_s: f64,
    ) -> Result<Vec<Match>, PrepareError> {
        let readings = self.readings.slice(window.clone());
        let window_s = readings.duration_s();
        let needed_s = overlap_min_s(self.options, window_s, self.log_duration_s);
        let overlap_min = (needed_s / step_s) as usize;
        let from_bar = measured_speeds(&readings, &self.joints(), step_s, rate);
        // The speeds of robot and bar, joint by joint and then combined into one channel.
        let by_joint = [from_robot.clone(), from_bar];
        let unordered = by_joint.each_ref().map(without_order);
        let compared = [unordered, by_joint];
        let found = each(compared.len(), |number| {
            let [robot, bar] = &compared[number];
            candidates(robot, bar, overlap_min, CANDIDATES)
        });
        let [unordered, mut matches]: [Vec<Match>; 2] = found.try_into().unwrap_or_default();
        let best = matches.iter().chain(&unordered).max_by(|a, b| a.correlation.total_cmp(&b.correlation));
        let highest = best.map(|best| (best.correlation, best.overlap as f64 * step_s));
        let is_high = |matched: &Match| matched.correlation >= self.options.correlation_min;
        matches.retain(is_high);
        for matched in unordered.into_iter().filter(is_high) {
            if !matches.iter().any(|other| (other.shift - matched.shift).abs() < SAME_STEPS) {
                matches.push(matched);
            }
        }
        if matches.is_empty() {
            return Err(no_match(ComparedLog::Recording, highest, needed_s, self.options));
        }
        Ok(matches)
    }

    /// Joints of the recorded encoders, counted from 0.
    pub(in crate::prepare) fn joints(&self) -> Vec<usize> {
        self.recorded_joints.iter().map(|joint| usize::from(*joint) - 1).collect()
    }

    /// Speeds of the recorded joints, predicted from the robot's log.
    pub(in crate::prepare) fn predicted(&self, step_s: f64) -> Channels {
        predicted_speeds(self.predictor, self.log_duration_s, &self.joints(), self.margin_rad(), step_s)
    }

    /// Finds encoder map, offsets and configurations at a candidate. The candidate is the rate of the clocks minus one,
    /// and a match of the speeds at this rate.
    pub(in crate::prepare) fn hypothesis(
        &self,
        window: &Range<usize>,
        (skew, matched): (f64, Match),
        step_s: f64,
    ) -> Result<Hypothesis, PrepareError> {
        let since_window = ClockRelation { shift_s: matched.shift * step_s, skew };
        let clock = since_window.counted_from(-self.time_s(window.start));
        let pairs = self.pairs(window, clock);
        let slip = large_slip(&pairs, &self.readings.t_s, self.recorded_joints, self.options);
        let encoder_map = match (find_encoder_map(&pairs, self.recorded_joints, self.options), slip) {
            (Ok(_) | Err(PrepareError::NoEncoderMap { .. }), Some(slip)) => return Err(slip),
            // Wrong signs of robot joints have the same effect as wrong directions of encoders. The message
            // also names these joints.
            (Err(PrepareError::Mirrored { stated, .. }), _) => {
                return Err(PrepareError::Mirrored { joints: mirroring_joints(self.chains[0]), stated });
            }
            (found, _) => found?,
        };
        let offset_fit = self.offset_fit(&pairs, &encoder_map.used);
        Ok(Hypothesis { matched, clock, encoder_map, offset_fit })
    }

    /// Pairs of measured and predicted angles at samples of the window, spread over the motion. A segment ends at singular
    /// poses of the bar, at changes of the counters' origin and at gaps.
    fn pairs(&self, window: &Range<usize>, clock: ClockRelation) -> Vec<AnglePair> {
        let window_s = self.time_s(window.end.saturating_sub(1)) - self.time_s(window.start);
        let stride = if window_s > 1.1 * WINDOW_S { LONG_STRIDE } else { 1 };
        let mut pairs: Vec<AnglePair> = Vec::new();
        let (mut segment, mut segment_ends, mut last_sample) = (0, false, None::<usize>);
        let within = window.start..window.end.min(self.readings.len());
        let samples: Vec<usize> = within.step_by(stride).collect();
        let predicted = |index: usize| {
            let bar = self.predictor.at(clock.robot_time_s(self.time_s(samples[index])));
            bar.filter(|bar| bar.margin_rad > self.margin_rad())
        };
        for (&sample, bar) in samples.iter().zip(rows(samples.len(), predicted)) {
            let (reading, t_s) = (&self.readings[sample], self.time_s(sample));
            let is_interrupted = last_sample.is_some_and(|last| {
                self.readings[last].origin != reading.origin || t_s - self.time_s(last) > HOLE_S
            });
            last_sample = Some(sample);
            // After an interruption or a singular pose, the next pair begins a new segment.
            segment_ends |= is_interrupted || bar.is_none();
            let Some(bar) = bar else { continue };
            if std::mem::take(&mut segment_ends) {
                segment += 1;
            }
            let BarReading { origin, recorded_rad, .. } = *reading;
            pairs.push(AnglePair { sample, origin, segment, recorded_rad, predicted_rad: bar.joints_rad });
        }
        let angles: Vec<[f64; BAR_JOINTS]> = pairs.iter().map(|pair| pair.recorded_rad).collect();
        let kept = select(&angles, PAIRS_APART_RAD, PAIRS_MAX);
        kept.into_iter().filter_map(|index| pairs.get(index).copied()).collect()
    }

    /// Finds offsets and configurations from pairs of measured and predicted angles.
    fn offset_fit(&self, pairs: &[AnglePair], encoder_map: &EncoderMap) -> OffsetFit {
        // This limit is wider than the limit for a whole run. A short segment may lie where the errors of the
        // nominal geometry are largest.
        let limit_rad = 4.0 * self.options.spread_max_mrad * 1e-3;
        fit_offsets(self.predictor.bar_links(), pairs, encoder_map, self.origins, limit_rad)
    }

    /// Runs [`refine`] on a selection of the samples of an offset fit. The selected samples are spread over the motion.
    /// `start` is an earlier fit, if there is one.
    fn refined(
        &self,
        offset_fit: &OffsetFit,
        measured: &[bool; BAR_JOINTS],
        clock: ClockRelation,
        start: Option<&AlignmentFit>,
    ) -> Option<AlignmentFit> {
        let angles: Vec<[f64; BAR_JOINTS]> = offset_fit.fitting.iter().map(|(_, angles)| *angles).collect();
        let kept = if angles.len() > FIT_MAX { select(&angles, 0.0, FIT_MAX) } else { spaced(&angles, 0.0) };
        let sample = |index: usize| {
            let (sample, bar_rad) = *offset_fit.fitting.get(index)?;
            let origin = self.readings.get(sample)?.origin;
            let observation = Observation::bar(self.time_s(sample), bar_rad);
            Some(Observation { measured: *measured, origin, ..observation })
        };
        let samples: Vec<Observation> = kept.into_iter().filter_map(sample).collect();
        refine(self.log, self.chains, self.predictor.base_m(), measured, &samples, clock, start)
    }
}
