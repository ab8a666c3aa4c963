//! Changes during a run or a file of rows: an encoder slips, a joint offset steps, the bar or another instrument is moved, a
//! clock steps, or one of them drifts. Other checks do not detect this: the fit distributes the change over links and terms,
//! and held-out samples have the same error. All hypotheses are tested on the same residuals, those of the solution with its
//! terms, at one false alarm rate ([`change_point`]). A large change refuses a ball-bar run; others are in the report.

use std::fmt;

use crate::calibrate::CalibrateError;
use crate::instrument::{Cause, Instrument, Run};
use crate::kinematics::{DhLink, LinkParameter};
use crate::model::{ParameterId, Role, Unit};
use crate::prepare::{Deviations, PoorFit, PrepareError, PrepareOptions};
use crate::solver::{Change, Course, LossName, change_point};

/// Probability of a false alarm in a data set without change.
const FALSE_ALARMS: f64 = 1e-4;
/// Minimum clock step that refuses a run \[s\]: at 0.15 rad/s it corresponds to `slip_min_mrad`.
const CLOCK_S_MIN: f64 = 0.002;
/// Minimum displacement of the bar's base that refuses a run, per radian of `slip_min_mrad` \[m\]: about the rod's length.
const LEVER_M: f64 = 0.5;
/// Minimum fraction of the squared residuals that a change must explain to refuse a run. Below this fraction model errors
/// dominate. These can look like a change if the parts of the path differ.
const EXPLAINED: f64 = 0.3;
/// Maximum number of samples tested: a change that needs more samples is too small to matter.
const SAMPLES_MAX: usize = 3000;

/// Course of a change in time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum When {
    /// A step, this long after the first sample \[s\].
    At(f64),
    /// A step, after this fraction of the rows (robot at rest, no time).
    After(f64),
    /// A linear drift from the first sample to the last.
    Drift,
}

/// A statistically significant change.
#[derive(Debug, Clone, PartialEq)]
pub struct Changed {
    /// Index of the data set, from 0.
    pub data_set: usize,
    /// The cause that explains the change best.
    pub cause: Cause,
    /// Time of the change.
    pub when: When,
    /// Change of each parameter of the cause, in its order, SI.
    pub by: Vec<f64>,
    /// Fraction of the squared residuals that the change explains.
    pub explained: f64,
}

/// Refusal of the first run whose angles fit no geometry. It replaces the error of a solve that failed for this reason.
pub(super) fn poor_fit(runs: &[Run]) -> Option<CalibrateError> {
    let refusal = |run: &Run| Some(run.instrument.prepared()?.poor_fit.as_ref()?.refusal());
    let first = runs.iter().enumerate().find_map(|(number, run)| Some((number, refusal(run)?)));
    first.map(|(run, error)| CalibrateError::Prepare { run, error: Box::new(error) })
}

/// Changes in data sets at their solution; `sigmas` are the residual standard deviations of each data set.
///
/// # Errors
/// [`CalibrateError::Prepare`] with the first ball-bar run that has a large change, or whose angles fit no geometry.
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

/// The most significant change in one data set.
fn change_of_run(
    data_set: usize,
    Run { instrument, model }: &Run,
    sigma: f64,
) -> Result<Option<Changed>, CalibrateError> {
    // Parameters fixed at uncertain values are estimated as well, so that their errors are not reported as a change.
    let model =
        &model.with_considered(|parameter, sigma| Some(Role::Prior { value: parameter.value, sigma }));
    let can_change =
        |id: &ParameterId| instrument.identifies(*id, model.robot()) && model.parameter(*id).is_some();
    let joints = model.robot().links.iter().enumerate();
    let joints = joints.map(|(link, DhLink { joint, .. })| Cause::joint(link, *joint));
    let mut causes: Vec<Cause> = joints.chain(instrument.causes(&model.geometry(&[]))).collect();
    causes.iter_mut().for_each(|cause| cause.ids.retain(can_change));
    causes.retain(|cause| !cause.ids.is_empty());
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
    // Without the samples that state known properties of the instrument.
    let measured = || (0..problem.samples()).filter(|sample| !problem.is_known(*sample));
    let every = measured().count().div_ceil(SAMPLES_MAX).max(1);
    let samples: Vec<usize> = measured().step_by(every).collect();
    let loss = LossName::Huber.for_spread(1.0, problem.rows());
    let x = with_causes.start();
    let found = change_point(&*problem, &x, loss, &samples, &estimated, &alternatives, FALSE_ALARMS);
    Ok(found.and_then(|Change { alternative, course, by, explained }| {
        let when = match course {
            Course::Step(first_after) => time_of_step(instrument, &samples, first_after)?,
            Course::Drift => When::Drift,
        };
        Some(Changed { data_set, cause: causes.get(alternative)?.clone(), when, by, explained })
    }))
}

/// Time of a step; `first_after` is the first sample after it, as an index into the tested `samples`.
fn time_of_step(instrument: &Instrument, samples: &[usize], first_after: usize) -> Option<When> {
    let Some(first_s) = instrument.first_s() else {
        return Some(When::After(first_after as f64 / samples.len() as f64));
    };
    let time_s = |index: usize| instrument.time_s(*samples.get(index)?);
    // The middle of the interval between two samples, which may be long.
    Some(When::At(0.5 * (time_s(first_after.checked_sub(1)?)? + time_s(first_after)?) - first_s))
}

impl Changed {
    /// Magnitude of the change, SI; for a tracker, which can also turn, the distance.
    pub fn size(&self) -> f64 {
        let components = self.by.iter().zip(&self.cause.ids);
        let of_unit = components.filter(|(_, id)| id.unit() == self.cause.unit());
        of_unit.map(|(by, _)| by * by).sum::<f64>().sqrt()
    }

    /// Change of the first parameter: the only one of an encoder, a joint, a clock or a length offset.
    fn first_component(&self) -> f64 {
        self.by.first().copied().unwrap_or_default()
    }

    /// Displacement of the end of an arm with this reach \[m\]; zero for a clock, which does not change the geometry.
    pub fn displacement_m(&self, reach_m: f64) -> f64 {
        match self.cause.unit() {
            Unit::Radian => self.size() * reach_m,
            Unit::Second => 0.0,
            _ => self.size(),
        }
    }

    /// The reason to refuse a ball-bar run with this change: a step above the limit; `None` otherwise.
    fn refusal(&self, options: &PrepareOptions) -> Option<PrepareError> {
        let When::At(at_s) = self.when else { return None };
        let slip_min_rad = options.slip_min_mrad * 1e-3;
        // The offset has the opposite sign of the error in the reported angle.
        let by_mrad = -self.first_component() * 1e3;
        let (error, size_min) = match self.cause.ids.first()? {
            ParameterId::Bar { link, .. } => {
                (PrepareError::EncoderSlip { joint: *link as u8 + 1, at_s, by_mrad }, slip_min_rad)
            }
            // The limit is an angle, so a prismatic joint is not refused.
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

/// Refuses ball-bar runs with a large change, and runs whose angles fitted no geometry in the preparation, for which a
/// change may be the cause.
fn refuse(runs: &[Run], changed: &[Changed], options: &PrepareOptions) -> Result<(), CalibrateError> {
    for (run, Run { instrument, model }) in runs.iter().enumerate() {
        let Some(prepared) = instrument.prepared() else { continue };
        let poor_fit = prepared.poor_fit.as_ref();
        let of_run = changed.iter().filter(|change| change.data_set == run && change.explained > EXPLAINED);
        let error = of_run.filter_map(|change| change.refusal(options)).next();
        let error = error.map(|error| error.resting_on(Deviations::at(prepared, model.geometry(&[]))));
        if let Some(error) = error.or_else(|| poor_fit.map(PoorFit::refusal)) {
            return Err(CalibrateError::Prepare { run, error: Box::new(error) });
        }
    }
    Ok(())
}

impl fmt::Display for Changed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { cause: Cause { name, ids }, when, .. } = self;
        let unit = self.cause.unit();
        let size = match ids[..] {
            // The offset has the opposite sign of the error in the angle.
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
