//! Rows that no robot like the configured one can have given: refused, with what most likely went wrong.
//!
//! A fit with priors always ends somewhere. What gives a mistake away is where it ends: beyond the links' tolerances, no
//! better on rows that it has not seen, further from the rows than joints are ever off, or with a step in time.

use std::fmt;

use nalgebra::Vector3;
use statrs::distribution::{ContinuousCDF, StudentsT};

use super::likely::{likely, likely_of_all};
use super::{RowSet, is_surely_worse};
use crate::calibrate::CalibrateError;
use crate::instrument::{Apart, Instrument, Mistake, PoseError, Rows, Run};
use crate::kinematics::Chain;
use crate::model::{Model, ParameterId, Role, Unit};
use crate::statistics::{median_size, quantile};

/// What the rows cannot be.
#[derive(Debug, Clone, PartialEq)]
pub enum Reason {
    /// A link is further from nominal than tolerances allow.
    Link {
        /// Which number.
        id: ParameterId,
        /// Off nominal \[m, rad\].
        correction: f64,
        /// Its tolerance, one standard deviation \[m, rad\].
        sigma: f64,
    },
    /// The robot is further from the rows than its joints can be off.
    TooFar {
        /// Median distance \[m\].
        median_m: f64,
        /// What joints of this arm can make of it \[m\].
        limit_m: f64,
    },
    /// Rows that the fit has not seen are further from the calibrated robot than from the nominal one.
    WorseThanNominal {
        /// Root mean squares \[m\].
        nominal_m: f64,
        /// Root mean squares \[m\].
        calibrated_m: f64,
    },
    /// Positions fit where orientations are beyond what any robot is off.
    Turned {
        /// Angle between the nominal robot and what was measured \[rad\].
        turned_rad: f64,
    },
    /// Tracker, probe or robot were moved.
    Moved(Step),
}

impl fmt::Display for Reason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Link { id, correction, sigma } => {
                let unit = id.unit();
                write!(
                    f,
                    "{id} would be {:.1} {} from nominal, {:.0} times its tolerance",
                    correction * unit.display_factor(),
                    unit.display_symbol(),
                    (correction / sigma).abs()
                )
            }
            Self::TooFar { median_m, limit_m } => write!(
                f,
                "the calibrated robot stays {:.1} mm from the rows, and joints that turn wrong explain {:.1} mm",
                median_m * 1e3,
                limit_m * 1e3
            ),
            Self::WorseThanNominal { nominal_m, calibrated_m } => write!(
                f,
                "held-out rows are {:.3} mm from the calibrated robot and {:.3} mm from the nominal one",
                calibrated_m * 1e3,
                nominal_m * 1e3
            ),
            Self::Turned { turned_rad } => write!(
                f,
                "the orientations are {turned_rad:.2} rad from those of the nominal robot, as if angles were in another order, frame \
                 or unit than [rotation] of the mapping says, or it is another robot"
            ),
            Self::Moved(step) => write!(f, "{step}"),
        }
    }
}

/// A sudden change of where the robot is seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Step {
    /// First row after it, from 1.
    pub row: usize,
    /// Its size \[m\].
    pub moved_m: f64,
}

impl Step {
    /// The nominal robot fits the rows before and after it far better than all of them: its own errors step where the path
    /// goes to another place, by less.
    fn explains(&self, instrument: &Instrument, robot: &Chain) -> bool {
        likely(instrument, robot, &[Mistake::Moved(self.row - 1)]).is_some()
    }
}

impl fmt::Display for Step {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { row, moved_m } = self;
        write!(
            f,
            "near row {row} the positions step by {:.2} mm: tracker, target or robot were moved; give the rows before and after it \
             different names in a column, and name that as `station` in the mapping",
            moved_m * 1e3
        )
    }
}

/// Nothing of a calibration is what no robot like the nominal one explains; `sets` are those of the `files`, and `runs` where
/// they were solved.
///
/// # Errors
/// [`CalibrateError::Implausible`] with the mistake that is likely.
pub(in crate::calibrate) fn unless_implausible(
    files: &[Rows],
    sets: &[RowSet],
    runs: &[Run],
    robot: &Chain,
) -> Result<(), CalibrateError> {
    let link = runs.first().and_then(|run| furthest_link(&run.model));
    let mut found: Vec<String> = link.iter().map(Reason::to_string).collect();
    let first = runs.len() - sets.len();
    for ((number, run), (file, set)) in runs.iter().enumerate().skip(first).zip(files.iter().zip(sets)) {
        let place = if runs.len() > 1 { format!("data set {}: ", number + 1) } else { String::new() };
        let reasons = of_set(set, &file.instrument, &run.model, robot);
        found.extend(reasons.iter().map(|reason| format!("{place}{reason}")));
    }
    if found.is_empty() {
        return Ok(());
    }
    Err(CalibrateError::Implausible { found: found.join("; "), likely: likely_of_all(files, robot) })
}

fn of_set(set: &RowSet, instrument: &Instrument, model: &Model, robot: &Chain) -> Vec<Reason> {
    let [.., errors] = &set.errors.stages;
    let steps = [step(set.whole(), model), set.step];
    let step = steps.into_iter().flatten().find(|step| step.explains(instrument, robot));
    let found = [turned(set), too_far(errors, robot), worse_than_nominal(set), step.map(Reason::Moved)];
    found.into_iter().flatten().collect()
}

/// Tolerances are standard deviations: of 30 numbers one is beyond this by chance once in 50 000 robots.
const SIGMAS_MAX: f64 = 5.0;
/// What lengths of links are off at most in arms that were typed by hand, one standard deviation \[m\].
const LINK_M: f64 = 1e-2;
/// And angles, zeros of joints among them \[rad\].
const LINK_RAD: f64 = 2e-2;

fn furthest_link(model: &Model) -> Option<Reason> {
    let link = |id: ParameterId| {
        let parameter = model.parameter(id)?;
        let Role::Prior { value, .. } = parameter.role else { return None };
        let sigma = if id.unit() == Unit::Metre { LINK_M } else { LINK_RAD };
        Some((id, parameter.value - value, sigma))
    };
    let links = model.ids().into_iter();
    let links = links.filter(|id| matches!(id, ParameterId::Robot { .. })).filter_map(link);
    let size = |(_, correction, sigma): &(ParameterId, f64, f64)| (correction / sigma).abs();
    let (id, correction, sigma) = links.max_by(|a, b| size(a).total_cmp(&size(b)))?;
    (correction.abs() > SIGMAS_MAX * sigma).then_some(Reason::Link { id, correction, sigma })
}

fn turned(set: &RowSet) -> Option<Reason> {
    /// The nominal robot's orientation is better than this, any wrong order is worse \[rad\].
    const WRONG_RAD: f64 = 0.1;
    /// Part of the rows that are better: of one in five that is no measurement nothing follows for the others.
    const PART: f64 = 0.78;
    let nominal = || set.errors.fitted.iter().filter_map(|row| set.errors.stages[0].get(*row));
    let mut turned_rad: Vec<f64> = nominal().map(|error| error.rotation_rad).collect::<Option<_>>()?;
    let turned_rad = quantile(&mut turned_rad, PART);
    let fits = median_size(nominal().map(|error| error.position_m)) < SIGMAS_MAX * LINK_M;
    (fits && turned_rad > WRONG_RAD).then_some(Reason::Turned { turned_rad })
}

/// What joints of industrial arms are off at most once their links are known: gears, resolvers, and commanded angles rounded to a
/// tenth of a degree \[rad\].
const JOINT_ERROR_RAD_MAX: f64 = 2e-3;

fn too_far(errors: &[PoseError], robot: &Chain) -> Option<Reason> {
    let limit_m = JOINT_ERROR_RAD_MAX * robot.reach_m();
    let median_m = median_size(errors.iter().map(|error| error.position_m));
    (median_m > limit_m).then_some(Reason::TooFar { median_m, limit_m })
}

fn worse_than_nominal(set: &RowSet) -> Option<Reason> {
    let held_out = set.held_out();
    let [nominal_m, calibrated_m] = [held_out.nominal.position_m.rms, held_out.joints.position_m.rms];
    is_surely_worse(held_out.nominal.rows, [nominal_m, calibrated_m])
        .then_some(Reason::WorseThanNominal { nominal_m, calibrated_m })
}

/// Blocks of the rows, in their order.
const BLOCKS: usize = 40;

/// Median error of each block of rows, by axis, with its first row.
fn blocks(errors_m: &[Vector3<f64>]) -> Vec<(usize, Vector3<f64>)> {
    let size = errors_m.len().div_ceil(BLOCKS).max(1);
    let median = |(number, block): (usize, &[Vector3<f64>])| {
        let of_axis = |axis: usize| {
            let mut of_axis: Vec<f64> = block.iter().map(|error| error[axis]).collect();
            quantile(&mut of_axis, 0.5)
        };
        (number * size, Vector3::new(of_axis(0), of_axis(1), of_axis(2)))
    };
    errors_m.chunks(size).enumerate().map(median).collect()
}

/// The most certain step in time that is left of the positions beside a linear drift, if one is certain.
///
/// Medians of blocks of rows, so that single rows that are wrong make none; Student's t of the step's three coordinates in a
/// line with a step, over all places of the step (Bonferroni). What blocks scatter by includes errors that last.
pub(super) fn step(instrument: &Instrument, model: &Model) -> Option<Step> {
    /// Of runs without a step one in so many has one by chance.
    const FALSE_ALARMS: f64 = 1e-4;
    /// Blocks before and after.
    const BESIDE: usize = 3;
    if !instrument.mistakes(0).iter().any(|mistake| matches!(mistake, Mistake::Moved(_))) {
        return None;
    }
    let deviations = instrument.deviations(&model.geometry(&[])).into_iter();
    let offsets_m = deviations.filter_map(|deviation| match deviation.apart {
        Apart::Place(offset_m) => Some(offset_m),
        Apart::Length(_) => None,
    });
    let blocks = blocks(&offsets_m.collect::<Vec<_>>());
    let count = blocks.len();
    let freedom = count.checked_sub(3).filter(|freedom| *freedom > 2 * BESIDE)? as f64;
    let places = BESIDE..=count - BESIDE;
    let tests = 2.0 * 3.0 * places.clone().count() as f64;
    let certain = StudentsT::new(0.0, 1.0, freedom).ok()?.inverse_cdf(1.0 - FALSE_ALARMS / tests);
    let at = |place: usize| {
        let design = nalgebra::DMatrix::from_fn(count, 3, |block, column| match column {
            0 => 1.0,
            1 => block as f64 / count as f64,
            _ => f64::from(u8::from(block >= place)),
        });
        let inverse = design.tr_mul(&design).try_inverse()?;
        let mut moved_m = Vector3::zeros();
        let mut student: f64 = 0.0;
        for axis in 0..3 {
            let medians =
                nalgebra::DVector::from_iterator(count, blocks.iter().map(|(_, median)| median[axis]));
            let line = &inverse * design.tr_mul(&medians);
            let left = (&medians - &design * &line).norm_squared() / freedom;
            moved_m[axis] = line[2];
            student = student.max(line[2].abs() / (left * inverse[(2, 2)]).sqrt().max(f64::MIN_POSITIVE));
        }
        Some((student, Step { row: blocks[place].0 + 1, moved_m: moved_m.norm() }))
    };
    let (student, step) = places.filter_map(at).max_by(|a, b| a.0.total_cmp(&b.0))?;
    (student > certain).then_some(step)
}
