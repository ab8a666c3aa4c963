//! Tests whether something changed during the measurement of a data set, given its model at the solution. The result is the
//! most likely change of each data set with those that the residuals do not exclude, or an error that refuses a ball-bar run.
//!
//! Possible changes: an encoder slips, a joint offset steps, the bar or another instrument is displaced, or a clock steps.
//! Each of these quantities may also drift linearly. Other checks do not detect such a change, because the fit distributes
//! it over link parameters and error terms, and because held-out samples contain the same error.
//!
//! All possible changes are tested on the residuals of the same solution. The false alarm rate applies to all tests together
//! ([`change_point`]). A large change refuses a ball-bar run. All other changes are listed in the report.

use std::collections::HashSet;
use std::{fmt, iter};

use crate::calibrate::CalibrateError;
use crate::instrument::{Cause, Instrument, Run};
use crate::kinematics::{DhLink, LinkParameter};
use crate::model::{ParameterId, Role, Unit};
use crate::prepare::{Deviations, PoorFit, PrepareError, PrepareOptions};
use crate::solver::{self, Course, LossName, change_point};

/// Probability of a false alarm in a data set without change.
const FALSE_ALARMS: f64 = 1e-4;
/// A clock step above this value refuses a run \[s\]. In this time, a joint at 0.15 rad/s
/// turns by the default `slip_min_mrad`.
const CLOCK_S_MIN: f64 = 0.002;
/// Lever arm \[m\], about the length of the rod. Multiplied by the angle `slip_min_mrad`, it gives the minimum displacement
/// of the bar's base that refuses a run.
const LEVER_M: f64 = 0.5;
/// A change refuses a run only if it explains at least this fraction of the squared residuals. If the fraction is smaller,
/// model errors dominate. Model errors can look like a change if the robot's path differs between parts of the run.
const EXPLAINED: f64 = 0.3;
/// Maximum number of samples that the test of a data set uses. A change that is significant only with
/// more samples is too small to matter.
const SAMPLES_MAX: usize = 3000;

/// How a change develops over time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum When {
    /// A step at this time after the first sample \[s\].
    At(f64),
    /// A step after this fraction of the rows. Used if the robot stood still at each row, because such rows have no time.
    After(f64),
    /// A linear drift from the first sample to the last.
    Drift,
}

/// A statistically significant change in a data set.
#[derive(Debug, Clone, PartialEq)]
pub struct Changed {
    /// Index of the data set, from 0.
    pub data_set: usize,
    /// The change that explains the residuals best.
    pub likeliest: Change,
    /// Other steps and drifts that the residuals do not exclude, the most likely first.
    pub others: Vec<Change>,
}

/// A change of one cause that may have occurred.
#[derive(Debug, Clone, PartialEq)]
pub struct Change {
    /// Part that changed, with its parameters.
    pub cause: Cause,
    /// Whether the change is a step or a drift, and the time of a step.
    pub when: When,
    /// Change of each parameter of `cause`, in the order of `cause.ids`, SI.
    pub by: Vec<f64>,
    /// Fraction of the squared residuals that the change explains.
    pub explained: f64,
}

/// Returns the error of the first run for which the preparation found no geometry that fits the bar angles. If the solve
/// fails too, this error is reported instead of the solver's error, because it is more informative.
pub(super) fn poor_fit(runs: &[Run]) -> Option<CalibrateError> {
    let refusal = |run: &Run| Some(run.instrument.prepared()?.poor_fit.as_ref()?.refusal());
    let first = runs.iter().enumerate().find_map(|(number, run)| Some((number, refusal(run)?)));
    first.map(|(run, error)| CalibrateError::Prepare { run, error: Box::new(error) })
}

/// Tests each data set for a change, at the solution. `sigmas` contains the residual standard deviation of each data set.
///
/// # Errors
/// [`CalibrateError::Prepare`] for the first ball-bar run that has a large change, or whose bar angles do not fit any
/// geometry.
pub(super) fn checked(
    runs: &[Run],
    sigmas: &[f64],
    options: &PrepareOptions,
) -> Result<Vec<Changed>, CalibrateError> {
    let mut changed = Vec::new();
    for (data_set, (run, sigma)) in runs.iter().zip(sigmas).enumerate() {
        changed.extend(change_of_run(data_set, run, *sigma)?);
    }
    refuse(runs, &changed, options)?;
    Ok(changed)
}

/// Finds the most significant change in one data set. `None` if no change is significant.
fn change_of_run(
    data_set: usize,
    Run { instrument, model }: &Run,
    sigma: f64,
) -> Result<Option<Changed>, CalibrateError> {
    // Also estimate the parameters that are fixed at uncertain values. Otherwise their errors could be reported as a change.
    let model =
        &model.with_considered(|parameter, sigma| Some(Role::Prior { value: parameter.value, sigma }));
    let can_change =
        |id: &ParameterId| instrument.identifies(*id, model.robot()) && model.parameter(*id).is_some();
    // Possible causes: a step of each robot joint's offset, and the causes of the instrument. Keep only parameters
    // that the samples identify.
    let joints = model.robot().links.iter().enumerate();
    let joints = joints.map(|(link, DhLink { joint, .. })| Cause::joint(link, *joint));
    let mut causes: Vec<Cause> = joints.chain(instrument.causes(&model.geometry(&[]))).collect();
    causes.iter_mut().for_each(|cause| cause.ids.retain(can_change));
    causes.retain(|cause| !cause.ids.is_empty());
    // Free the parameters of all causes. `alternatives` contains the columns of each cause, `estimated` the
    // columns of the fit.
    let mut with_causes = model.clone();
    for &id in causes.iter().flat_map(|cause| &cause.ids) {
        if model.column_of(id).is_none() {
            with_causes.set_role(id, Role::Free)?;
        }
    }
    let column = |id: &ParameterId| with_causes.column_of(*id);
    let alternatives: Vec<Vec<usize>> =
        causes.iter().map(|cause| cause.ids.iter().filter_map(column).collect()).collect();
    let estimated: Vec<usize> = model.columns().filter_map(|parameter| column(&parameter.id)).collect();
    let problem = instrument.data_set(&with_causes, sigma)?;
    // Exclude the samples that represent known properties of the instrument, then thin the others.
    let measured = || (0..problem.samples()).filter(|sample| !problem.is_known(*sample));
    let every = measured().count().div_ceil(SAMPLES_MAX).max(1);
    let samples: Vec<usize> = measured().step_by(every).collect();
    let loss = LossName::Huber.for_spread(1.0, problem.rows());
    let x = with_causes.start();
    let found = change_point(&*problem, &x, loss, &samples, &estimated, &alternatives, FALSE_ALARMS);
    let possible = |found: solver::Change| {
        let when = match found.course {
            Course::Step(first_after) => time_of_step(instrument, &samples, first_after)?,
            Course::Drift => When::Drift,
        };
        let cause = causes.get(found.alternative)?.clone();
        Some(Change { cause, when, by: found.by, explained: found.explained })
    };
    let mut possible: Vec<Change> = found.into_iter().filter_map(possible).collect();
    // A tracker is one cause with or without a rotation. The first is the more likely of the two.
    let mut names = HashSet::new();
    possible.retain(|change| names.insert((change.cause.name.clone(), change.when == When::Drift)));
    let mut possible = possible.into_iter();
    Ok(possible.next().map(|likeliest| Changed { data_set, likeliest, others: possible.collect() }))
}

/// Time of a step. `first_after` is the first sample after the step, as an index into the tested `samples`.
fn time_of_step(instrument: &Instrument, samples: &[usize], first_after: usize) -> Option<When> {
    let Some(first_s) = instrument.first_s() else {
        return Some(When::After(first_after as f64 / samples.len() as f64));
    };
    let time_s = |index: usize| instrument.time_s(*samples.get(index)?);
    // The step lies between two samples, which may be far apart. Use the middle of this interval.
    Some(When::At(0.5 * (time_s(first_after.checked_sub(1)?)? + time_s(first_after)?) - first_s))
}

impl Changed {
    /// Largest displacement at the end of an arm with this reach that one of the possible changes causes \[m\].
    pub fn displacement_m(&self, reach_m: f64) -> f64 {
        self.possible().map(|change| change.displacement_m(reach_m)).fold(0.0, f64::max)
    }

    /// The most likely change and the others.
    fn possible(&self) -> impl Iterator<Item = &Change> {
        iter::once(&self.likeliest).chain(&self.others)
    }
}

impl Change {
    /// Magnitude of the change, SI. If the parameters of the cause have two units, only the parameters with the unit of the
    /// first one are included. For a tracker, the magnitude is therefore the displacement without the rotation.
    pub fn size(&self) -> f64 {
        let components = self.by.iter().zip(&self.cause.ids);
        let of_unit = components.filter(|(_, id)| id.unit() == self.cause.unit());
        of_unit.map(|(by, _)| by * by).sum::<f64>().sqrt()
    }

    /// Change of the first parameter. A cause that is an encoder, a joint, a clock or a
    /// length offset has only one parameter.
    fn first_component(&self) -> f64 {
        self.by.first().copied().unwrap_or_default()
    }

    /// Displacement that the change causes at the end of an arm with this reach \[m\]. Zero for a step or drift of a clock,
    /// because a clock does not change the geometry.
    fn displacement_m(&self, reach_m: f64) -> f64 {
        match self.cause.unit() {
            Unit::Radian => self.size() * reach_m,
            Unit::Second => 0.0,
            _ => self.size(),
        }
    }

    /// Returns the error that refuses a ball-bar run because of this change. `None` if the change is a drift, is below its
    /// limit, or has a cause that never refuses a run.
    fn refusal(&self, options: &PrepareOptions) -> Option<PrepareError> {
        let When::At(at_s) = self.when else { return None };
        let slip_min_rad = options.slip_min_mrad * 1e-3;
        // The estimated offset has the opposite sign of the error in the reported angle.
        let by_mrad = -self.first_component() * 1e3;
        let (error, size_min) = match self.cause.ids.first()? {
            ParameterId::Bar { link, .. } => {
                (PrepareError::EncoderSlip { joint: *link as u8 + 1, at_s, by_mrad }, slip_min_rad)
            }
            // The limit is an angle, so a step of a prismatic joint never refuses a run.
            ParameterId::Robot { link, parameter: LinkParameter::Theta } => {
                (PrepareError::JointStep { joint: *link as u8 + 1, at_s, by_mrad }, slip_min_rad)
            }
            ParameterId::Base { .. } => {
                (PrepareError::BaseMoved { at_s, by_mm: self.size() * 1e3 }, LEVER_M * slip_min_rad)
            }
            ParameterId::ClockShift => {
                (PrepareError::ClockJump { at_s, by_ms: self.first_component() * 1e3 }, CLOCK_S_MIN)
            }
            _ => return None,
        };
        (self.size() > size_min).then_some(error)
    }
}

/// Refuses the first ball-bar run that has a large change, or for which the preparation found no
/// geometry that fits the bar angles.
fn refuse(runs: &[Run], changed: &[Changed], options: &PrepareOptions) -> Result<(), CalibrateError> {
    for (run, Run { instrument, model }) in runs.iter().enumerate() {
        let Some(prepared) = instrument.prepared() else { continue };
        let poor_fit = prepared.poor_fit.as_ref();
        let of_run = changed.iter().filter(|changed| changed.data_set == run);
        let mut likeliest =
            of_run.map(|changed| &changed.likeliest).filter(|change| change.explained > EXPLAINED);
        let error = likeliest.find_map(|change| change.refusal(options));
        let error = error.map(|error| error.resting_on(Deviations::at(prepared, model.geometry(&[]))));
        if let Some(error) = error.or_else(|| poor_fit.map(PoorFit::refusal)) {
            return Err(CalibrateError::Prepare { run, error: Box::new(error) });
        }
    }
    Ok(())
}

impl fmt::Display for Changed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.likeliest)?;
        self.others.iter().try_for_each(|other| write!(f, ", or {other}"))
    }
}

impl fmt::Display for Change {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { cause: Cause { name, ids }, when, .. } = self;
        let unit = self.cause.unit();
        let size = match ids[..] {
            // The estimated offset has the opposite sign of the error in the angle.
            [ParameterId::Bar { .. }] => format!("{:+.2}", -self.first_component() * unit.display_factor()),
            [_] => format!("{:+.2}", self.first_component() * unit.display_factor()),
            _ => format!("{:.2}", self.size() * unit.display_factor()),
        };
        let by = format!("by {size} {}", unit.display_symbol());
        match when {
            When::At(at_s) => write!(f, "{name} steps {by} {at_s:.1} s after the first sample"),
            When::After(part) => write!(f, "{name} steps {by} after about {:.0} % of the rows", part * 100.0),
            When::Drift => write!(f, "{name} drifts {by} from the first sample to the last"),
        }
    }
}
