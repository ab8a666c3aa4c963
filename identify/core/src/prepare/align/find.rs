//! Where in the robot's log the recording lies: candidates from the speeds, the best of them by the angles.

use std::ops::Range;
use std::sync::Arc;

use super::clock::{ClockFit, SHIFT_SIGMA_S};
use super::correlate::{Match, candidates};
use super::rate::rates;
use super::refine::{Fit, FitSample, refine};
use super::speeds::{grid_step_s, measured_speeds, predicted_speeds, without_order};
use super::window::{CANDIDATES, WINDOW_S, liveliest, overlap_min_s, wider};
use crate::kinematics::{BAR_JOINTS, Chain, Joints, mirroring_joints};
use crate::logs::{CubicSpline, Stream};
use crate::prepare::encoders::encoder_map::{AnglePair, EncoderMap, EncoderMapReport, find_encoder_map};
use crate::prepare::encoders::segments::{Pair, Settled, settle};
use crate::prepare::encoders::slip::large_slip;
use crate::prepare::samples::select::{select, spaced};
use crate::prepare::{BarReading, Channels, Predictor, PrepareError, PrepareOptions};
use crate::threads::{each, rows};

/// What is searched, and in what.
pub(in crate::prepare) struct Search<'a> {
    pub readings: &'a Stream<BarReading>,
    /// Of the recording, 1 to 5.
    pub recorded_joints: &'a [u8],
    pub origins: usize,
    pub log: &'a Arc<CubicSpline<Joints>>,
    pub log_duration_s: f64,
    pub predictor: &'a Predictor<'a>,
    /// Nominal robot and bar.
    pub chains: [&'a Chain; 2],
    pub options: &'a PrepareOptions,
}

/// The logs brought together.
#[derive(Debug, Clone)]
pub(in crate::prepare) struct Found {
    /// How the speeds match.
    pub matched: Match,
    /// Another shift fits as well.
    pub ambiguous: bool,
    /// Which encoder is which.
    pub encoder_map: EncoderMapReport,
    /// Offsets by origin, refined, and configurations, on all samples.
    pub settled: Settled,
    /// The fine fit; its times are those of the samples.
    pub fit: Fit,
}

/// Candidates that are fitted.
const FITTED_MAX: usize = 4;
/// On nominal geometry, candidates within this factor of the best may turn out to be the better one.
const NEAR_BEST: f64 = 2.0;
/// Two fits whose residuals differ by less than this factor are equally good: the motion repeats itself.
const TIE: f64 = 1.2;
/// Travel between samples that are compared \[rad\], and how many there are at most.
const PAIRS_APART_RAD: f64 = 0.01;
const PAIRS_MAX: usize = 3000;
/// Samples of a refinement at most.
const FIT_MAX: usize = 1500;
/// In windows longer than [`WINDOW_S`] only every so many-th sample is looked at.
const LONG_STRIDE: usize = 5;
/// The bar may pass a singular pose unseen in a hole of this length \[s\].
const HOLE_S: f64 = 1.0;

/// A shift, and how the angles fit there.
pub(in crate::prepare) struct Hypothesis {
    matched: Match,
    clock: ClockFit,
    encoder_map: EncoderMapReport,
    spread_rad: f64,
}

/// Leaves those whose residuals are as small as the smallest.
pub(in crate::prepare) fn retain_sharpest<T>(fits: &mut Vec<T>, spread: impl Fn(&T) -> f64) {
    let sharpest = fits.iter().map(&spread).fold(f64::INFINITY, f64::min);
    fits.retain(|fit| spread(fit) <= TIE * sharpest);
}

/// Of equally good ones: the motion repeats itself, and the longest overlap is most likely.
pub(in crate::prepare) fn of_longest_overlap<T>(fits: Vec<T>, matched: impl Fn(&T) -> &Match) -> Option<T> {
    fits.into_iter().reduce(|best, other| {
        if matched(&other).overlap as f64 > 1.1 * matched(&best).overlap as f64 { other } else { best }
    })
}

impl Search<'_> {
    /// The best alignment.
    ///
    /// # Errors
    /// [`PrepareError::NoMatch`], [`PrepareError::NoSpeeds`], [`PrepareError::ClockJump`], [`PrepareError::EncoderSlip`] and those of
    /// [`find_encoder_map`].
    pub fn run(&self) -> Result<Found, PrepareError> {
        let step_s = grid_step_s(self.log_duration_s);
        let window = self.liveliest();
        let shifts = self.shifts(&window, step_s)?;
        let mut hypotheses = Vec::new();
        let mut refusal = None;
        for shift in shifts {
            match self.hypothesis(&window, shift, step_s) {
                Ok(hypothesis) => hypotheses.push(hypothesis),
                Err(error) => {
                    // A slip is the cause wherever it is seen.
                    let tells = matches!(error, PrepareError::EncoderSlip { .. });
                    refusal = refusal.filter(|_| !tells).or(Some(error));
                }
            }
        }
        let best_rad = hypotheses.iter().map(|one| one.spread_rad).fold(f64::INFINITY, f64::min);
        let closest = hypotheses.iter().map(|one| one.matched.correlation).fold(0.0, f64::max);
        let is_closest = |one: &Hypothesis| one.matched.correlation >= closest;
        hypotheses.retain(|one| is_closest(one) || one.spread_rad <= NEAR_BEST * best_rad);
        // The one whose speeds match best is never left out: where laps repeat each other nearly, many fit nearly.
        hypotheses
            .sort_by(|a, b| is_closest(b).cmp(&is_closest(a)).then(a.spread_rad.total_cmp(&b.spread_rad)));
        // Several rates may lead to one clock, here and after a fit.
        let mut distinct: Vec<Hypothesis> = Vec::new();
        for hypothesis in hypotheses {
            if !distinct.iter().any(|other| self.is_same(&window, other.clock, hypothesis.clock)) {
                distinct.push(hypothesis);
            }
        }
        distinct.truncate(FITTED_MAX);
        let mut fitted: Vec<(Hypothesis, Fit)> = Vec::new();
        for hypothesis in distinct {
            let measured = hypothesis.encoder_map.used.measured();
            let settled = self.settled(&window, hypothesis.clock, &hypothesis.encoder_map.used);
            let fit = self.refined(&settled, &measured, hypothesis.clock, None);
            let Some(fit) = fit else { continue };
            let same = fitted.iter_mut().find(|(_, other)| self.is_same(&window, other.clock, fit.clock));
            match same {
                Some(same) if same.1.sigma_of_most_rad <= fit.sigma_of_most_rad => {}
                Some(same) => *same = (hypothesis, fit),
                None => fitted.push((hypothesis, fit)),
            }
        }
        // By most of the samples, not by half: another lap fits well wherever it is like the right one.
        retain_sharpest(&mut fitted, |(_, fit)| fit.sigma_of_most_rad);
        let ambiguous = fitted.len() > 1;
        let longest = of_longest_overlap(fitted, |(hypothesis, _)| &hypothesis.matched);
        let Some((hypothesis, fit)) = longest else {
            let jump = self.jump_between_parts(&window, step_s);
            return Err(jump.or(refusal).unwrap_or(PrepareError::NothingToFit));
        };
        // One shift fits one side of a clock that jumps far.
        if fit.sigma_of_most_rad > self.options.spread_max_mrad * 1e-3
            && let Some(jump) = self.jump_between_parts(&window, step_s)
        {
            return Err(jump);
        }
        let Hypothesis { matched, encoder_map, .. } = hypothesis;
        let (settled, fit) = self.grown(window, &encoder_map.used, fit)?;
        Ok(Found { matched, ambiguous, encoder_map, settled, fit })
    }

    fn margin_rad(&self) -> f64 {
        self.options.singular_margin_deg.to_radians()
    }

    /// The part of the recording with the most motion.
    fn liveliest(&self) -> Range<usize> {
        let travel_rad = |pair: [usize; 2]| {
            let [a, b] = pair.map(|sample| &self.readings[sample]);
            let steps = a.recorded_rad.iter().zip(&b.recorded_rad).map(|(a, b)| (a - b).abs());
            if a.origin == b.origin { steps.sum::<f64>() } else { 0.0 }
        };
        liveliest(&self.readings.t_s, travel_rad)
    }

    /// Since the first reading \[s\].
    fn time_s(&self, sample: usize) -> f64 {
        self.readings.t_s.get(sample).copied().unwrap_or_default()
    }

    /// Whether two clocks are the same throughout a window, by what the speeds resolve.
    fn is_same(&self, window: &Range<usize>, one: ClockFit, other: ClockFit) -> bool {
        let ends_s = [window.start, window.end.saturating_sub(1)].map(|sample| self.time_s(sample));
        ends_s.into_iter().all(|t_s| (one.tau_s(t_s) - other.tau_s(t_s)).abs() < SHIFT_SIGMA_S)
    }

    /// Rates less one at which the speeds are compared, and shifts at which they match there, for times since the window's first
    /// sample, in grid steps.
    fn shifts(&self, window: &Range<usize>, step_s: f64) -> Result<Vec<(f64, Match)>, PrepareError> {
        let joints = self.joints();
        let whole = |step_s| without_order(&self.predicted(step_s));
        let part = |samples, step_s| {
            without_order(&measured_speeds(&self.readings.slice(samples), &joints, step_s, 0.0))
        };
        let from_robot = self.predicted(step_s);
        let (mut all, mut refusal) = (Vec::new(), None);
        for rate in rates(&self.readings.t_s, window, self.log_duration_s, whole, part) {
            match self.candidates(window, &from_robot, rate, step_s) {
                Ok(found) => all.extend(found.into_iter().map(|matched| (rate, matched))),
                Err(error) => refusal = Some(error),
            }
        }
        let refusal = refusal.filter(|_| all.is_empty());
        refusal.map_or(Ok(all), |refusal| Err(self.jump_between_parts(window, step_s).unwrap_or(refusal)))
    }

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
        let from_robot = from_robot.clone();
        let channels = [[&from_robot, &from_bar].map(without_order), [from_robot, from_bar]];
        let found = each(channels.len(), |number| {
            let [robot, bar] = &channels[number];
            candidates(robot, bar, overlap_min, CANDIDATES)
        });
        let [unordered, mut all]: [Vec<Match>; 2] = found.try_into().unwrap_or_default();
        let best =
            all.iter().chain(&unordered).copied().max_by(|a, b| a.correlation.total_cmp(&b.correlation));
        let high = |one: &Match| one.correlation >= self.options.correlation_min;
        all.retain(high);
        for one in unordered.into_iter().filter(high) {
            if !all.iter().any(|other| (other.shift - one.shift).abs() < 5.0) {
                all.push(one);
            }
        }
        if all.is_empty() {
            let other = "recording";
            return Err(match best {
                Some(Match { correlation, overlap, .. }) => PrepareError::NoMatch {
                    other,
                    correlation,
                    overlap_s: overlap as f64 * step_s,
                    needed: self.options.correlation_min,
                },
                None => PrepareError::NoSpeeds { other, needed_s },
            });
        }
        Ok(all)
    }

    /// Recorded joints from 0.
    pub(in crate::prepare) fn joints(&self) -> Vec<usize> {
        self.recorded_joints.iter().map(|joint| usize::from(*joint) - 1).collect()
    }

    pub(in crate::prepare) fn predicted(&self, step_s: f64) -> Channels {
        predicted_speeds(self.predictor, self.log_duration_s, &self.joints(), self.margin_rad(), step_s)
    }

    /// What the angles say of a rate and a shift there.
    pub(in crate::prepare) fn hypothesis(
        &self,
        window: &Range<usize>,
        (skew, matched): (f64, Match),
        step_s: f64,
    ) -> Result<Hypothesis, PrepareError> {
        let at_start = ClockFit { shift_s: matched.shift * step_s, skew };
        let clock = at_start.counted_from(-self.time_s(window.start));
        let of_samples = self.pairs(window, clock);
        let pairs: Vec<AnglePair> = of_samples.iter().map(|(_, pair)| *pair).collect();
        let timed: Vec<_> = of_samples.iter().map(|(sample, pair)| (self.time_s(*sample), *pair)).collect();
        let slip = large_slip(&timed, self.recorded_joints, self.options);
        let encoder_map = match (find_encoder_map(&pairs, self.recorded_joints, self.options), slip) {
            (Ok(_) | Err(PrepareError::NoEncoderMap { .. }), Some(slip)) => return Err(slip),
            (Err(PrepareError::Mirrored { stated, .. }), _) => {
                return Err(PrepareError::Mirrored { joints: mirroring_joints(self.chains[0]), stated });
            }
            (found, _) => found?,
        };
        let settled = self.settled(window, clock, &encoder_map.used);
        let squares: f64 = settled.spread_rad.iter().map(|spread| spread * spread).sum();
        Ok(Hypothesis { matched, clock, encoder_map, spread_rad: squares.sqrt() })
    }

    /// Samples spread over the motion with what the robot's log predicts there, in segments between singular poses.
    fn pairs(&self, window: &Range<usize>, clock: ClockFit) -> Vec<(usize, AnglePair)> {
        let window_s = self.time_s(window.end.saturating_sub(1)) - self.time_s(window.start);
        let stride = if window_s > 1.1 * WINDOW_S { LONG_STRIDE } else { 1 };
        let mut pairs: Vec<(usize, AnglePair)> = Vec::new();
        let (mut segment, mut broken, mut before) = (0, false, None::<usize>);
        let within = window.start..window.end.min(self.readings.len());
        let places: Vec<usize> = within.step_by(stride).collect();
        let predicted = |place: usize| {
            let bar = self.predictor.at(clock.tau_s(self.time_s(places[place])));
            bar.filter(|bar| bar.margin_rad > self.margin_rad())
        };
        for (&sample, bar) in places.iter().zip(rows(places.len(), predicted)) {
            let (reading, t_s) = (&self.readings[sample], self.time_s(sample));
            let parted = before.is_some_and(|before| {
                self.readings[before].origin != reading.origin || t_s - self.time_s(before) > HOLE_S
            });
            before = Some(sample);
            broken |= parted || bar.is_none();
            let Some(bar) = bar else { continue };
            if std::mem::take(&mut broken) {
                segment += 1;
            }
            let BarReading { recorded_rad, .. } = *reading;
            pairs.push((sample, AnglePair { segment, recorded_rad, predicted_rad: bar.joints_rad }));
        }
        let angles: Vec<[f64; BAR_JOINTS]> = pairs.iter().map(|(_, pair)| pair.recorded_rad).collect();
        let kept = select(&angles, PAIRS_APART_RAD, PAIRS_MAX);
        kept.into_iter().filter_map(|index| pairs.get(index).copied()).collect()
    }

    /// Offsets and configurations at a shift.
    fn settled(&self, window: &Range<usize>, clock: ClockFit, encoder_map: &EncoderMap) -> Settled {
        let pairs: Vec<Pair> = self
            .pairs(window, clock)
            .into_iter()
            .map(|(sample, pair)| Pair {
                sample,
                origin: self.readings.get(sample).map_or(0, |reading| reading.origin),
                segment: pair.segment,
                measured_rad: encoder_map.applied(&pair.recorded_rad),
                predicted_rad: pair.predicted_rad,
            })
            .collect();
        // Wider than the limit for a whole run: a short segment may lie where the nominal geometry is worst.
        let limit_rad = 4.0 * self.options.spread_max_mrad * 1e-3;
        settle(&pairs, &encoder_map.measured(), self.origins, limit_rad)
    }

    fn refined(
        &self,
        settled: &Settled,
        measured: &[bool; BAR_JOINTS],
        clock: ClockFit,
        start: Option<&Fit>,
    ) -> Option<Fit> {
        let angles: Vec<[f64; BAR_JOINTS]> = settled.fitting.iter().map(|(_, angles)| *angles).collect();
        let kept = if angles.len() > FIT_MAX { select(&angles, 0.0, FIT_MAX) } else { spaced(&angles, 0.0) };
        let samples: Vec<FitSample> = kept
            .into_iter()
            .filter_map(|index| {
                let (sample, bar_rad) = *settled.fitting.get(index)?;
                let origin = self.readings.get(sample)?.origin;
                Some(FitSample { t_s: self.time_s(sample), origin, bar_rad })
            })
            .collect();
        refine(self.log, self.chains, self.predictor.base_m(), measured, &samples, clock, start)
    }

    /// The fit extended from its window to the whole recording, step by step: clocks that are known over a quarter of an
    /// hour are known well enough for an hour.
    fn grown(
        &self,
        mut window: Range<usize>,
        encoder_map: &EncoderMap,
        mut fit: Fit,
    ) -> Result<(Settled, Fit), PrepareError> {
        let measured = encoder_map.measured();
        loop {
            let whole = window == (0..self.readings.len());
            let mut settled = self.settled(&window, fit.clock, encoder_map);
            fit =
                self.refined(&settled, &measured, fit.clock, Some(&fit)).ok_or(PrepareError::NothingToFit)?;
            if whole {
                for (offsets, by_rad) in settled.offsets.iter_mut().zip(&fit.offsets_by_rad) {
                    if let Some(offsets) = offsets {
                        offsets.offsets_rad = std::array::from_fn(|j| offsets.offsets_rad[j] + by_rad[j]);
                    }
                }
                return Ok((settled, fit));
            }
            window = wider(&self.readings.t_s, &window);
        }
    }
}
