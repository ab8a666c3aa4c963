//! What changes of the robot while rows are measured: the zero of a joint that steps (a resolver that slipped, a robot mastered
//! anew) or drifts (gears that warm up). Nothing else tells of it: the fit spreads it over links and terms, and held-out rows
//! are wrong in the same way.
//!
//! A change is one more column of the problem, `c = J_theta f(t)`, with a step or a line `f` over the file. About the solution,
//! with everything else solved anew, its size is `-c' r / c' M c`, `M = I - J N^-1 J'`. What is left lasts from row to row: how
//! much more it is worth than white noise follows from how the joint's local zero differs between neighbouring blocks of rows,
//! which neither step nor drift changes (von Neumann 1941); Student's t judges the size.

use std::fmt;

use nalgebra::{DMatrix, DVector};
use statrs::distribution::{ContinuousCDF, StudentsT};

use crate::calibrate::ball_bar::CalibrateError;
use crate::cost::{DataSets, SharedColumns};
use crate::instrument::Run;
use crate::kinematics::LinkParameter;
use crate::model::{ParameterId, Role};
use crate::solver::{ScaledCholesky, stacked};

/// Of files in which nothing changes, one in so many is said to have a change.
const FALSE_ALARMS: f64 = 1e-3;
/// Blocks of rows whose errors count as independent.
const BLOCKS: usize = 30;
/// Places of a step that are tried.
const PLACES: usize = 9;
/// Residuals of so many standard deviations count half.
const HALF: f64 = 3.0;
/// Part of a column that the others must leave of it.
const INDEPENDENT: f64 = 1e-3;

/// The zero of a joint that did not stay.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Changed {
    /// From 0.
    pub data_set: usize,
    /// From 0.
    pub joint: usize,
    /// What the joint really turned by more at the end of the file than at its beginning \[rad\].
    pub by_rad: f64,
    /// The part of the file after which it does; none where it drifts from the first row to the last.
    pub from: Option<f64>,
}

impl fmt::Display for Changed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { joint, by_rad, from, .. } = self;
        write!(f, "the zero of joint {} ", joint + 1)?;
        match from {
            Some(part) => {
                write!(f, "steps by {:+.2} mrad after about {:.0} % of the rows", by_rad * 1e3, part * 100.0)
            }
            None => write!(f, "drifts by {:+.2} mrad from the first row to the last", by_rad * 1e3),
        }
    }
}

/// The most certain change in each data set with rows; `sigmas` are what residuals of each are worth.
///
/// # Errors
/// [`CalibrateError::Cost`].
pub(in crate::calibrate) fn changed(runs: &[Run], sigmas: &[f64]) -> Result<Vec<Changed>, CalibrateError> {
    let mut all = Vec::new();
    for (data_set, (run, sigma)) in runs.iter().zip(sigmas).enumerate() {
        if run.instrument.bar().is_none() {
            all.extend(of_run(run, *sigma)?.map(|found| Changed { data_set, ..found }));
        }
    }
    Ok(all)
}

/// How a zero changes over a file, at a part of it.
#[derive(Clone, Copy)]
enum Course {
    Drift,
    Step(f64),
}

impl Course {
    fn all() -> impl Iterator<Item = Self> + Clone {
        let steps = (1..=PLACES).map(|place| Self::Step(place as f64 / (PLACES + 1) as f64));
        std::iter::once(Self::Drift).chain(steps)
    }

    fn at(self, part: f64) -> f64 {
        match self {
            Self::Drift => part - 0.5,
            Self::Step(from) => f64::from(u8::from(part >= from)),
        }
    }
}

fn of_run(Run { instrument, model }: &Run, sigma: f64) -> Result<Option<Changed>, CalibrateError> {
    let zero = |joint| ParameterId::Robot { link: joint, parameter: LinkParameter::Theta };
    let turns =
        |joint: &usize| instrument.identifies(zero(*joint)) && model.parameter(zero(*joint)).is_some();
    let mut with_zeros = model.clone();
    for id in (0..model.axes()).filter(turns).map(zero) {
        if model.column_of(id).is_none() {
            with_zeros.set_role(id, Role::Free)?;
        }
    }
    let columns = SharedColumns::new([&with_zeros], |_| false);
    let set = instrument.data_set(&with_zeros, sigma)?;
    let numbers = set.rows().max(1);
    let all = stacked(&DataSets::new(vec![set], &columns), &with_zeros.start());
    let Some((mut r, mut j)) = all else { return Ok(None) };
    let rows = r.len() / numbers;
    for row in 0..rows {
        let size = r.rows(row * numbers, numbers).norm_squared() / numbers as f64;
        let weight = (1.0 + size / HALF.powi(2)).recip().sqrt();
        r.rows_mut(row * numbers, numbers).scale_mut(weight);
        j.rows_mut(row * numbers, numbers).scale_mut(weight);
    }
    let ids: Vec<ParameterId> = with_zeros.columns().map(|parameter| parameter.id).collect();
    let column = |id: ParameterId| ids.iter().position(|other| *other == id);
    let estimated: Vec<usize> = model.columns().filter_map(|parameter| column(parameter.id)).collect();
    let of_estimated = j.select_columns(&estimated);
    let mut normal = of_estimated.tr_mul(&of_estimated);
    for prior in model.priors() {
        normal[(prior.column, prior.column)] += prior.sigma.powi(-2);
    }
    let Some(factor) = ScaledCholesky::new(normal) else { return Ok(None) };
    let joints: Vec<(usize, usize)> =
        (0..model.axes()).filter_map(|joint| Some((joint, column(zero(joint))?))).collect();
    let tests = joints.len() * Course::all().count();
    // Differences of neighbours have two thirds of the freedom of as many independent ones.
    let Ok(student) = StudentsT::new(0.0, 1.0, 2.0 / 3.0 * (BLOCKS - 1) as f64) else { return Ok(None) };
    let certain = student.inverse_cdf(1.0 - FALSE_ALARMS / (2 * tests.max(1)) as f64);
    let tried = joints.iter().flat_map(|&at| Course::all().map(move |course| (at, course)));
    let found = tried.filter_map(|((joint, column), course)| {
        let c = DVector::from_fn(r.len(), |number, _| {
            j[(number, column)] * course.at((number / numbers) as f64 / rows as f64)
        });
        let (by_rad, fall) = judged(&c, &r, &of_estimated, &factor)?;
        let t = (fall / lasting(&j.column(column).into_owned(), &r, numbers)).sqrt();
        let from = match course {
            Course::Drift => None,
            Course::Step(from) => Some(from),
        };
        (t > certain).then_some((Changed { data_set: 0, joint, by_rad, from }, fall))
    });
    Ok(found.max_by(|a, b| a.1.total_cmp(&b.1)).map(|(found, _)| found))
}

/// Variance of a joint's local zeros in that of white noise, and no less.
fn lasting(of_joint: &DVector<f64>, r: &DVector<f64>, numbers: usize) -> f64 {
    let block = numbers * (r.len() / numbers).div_ceil(BLOCKS).max(1);
    let whitened = |first: usize| {
        let count = block.min(r.len() - first);
        let (of_joint, r) = (of_joint.rows(first, count), r.rows(first, count));
        of_joint.dot(&r) / of_joint.norm().max(f64::MIN_POSITIVE)
    };
    let blocks: Vec<f64> = (0..r.len()).step_by(block).map(whitened).collect();
    let differences = blocks.windows(2).map(|pair| 0.5 * (pair[1] - pair[0]).powi(2));
    let white = r.norm_squared() / r.len().max(1) as f64;
    (differences.sum::<f64>() / blocks.len().saturating_sub(1).max(1) as f64).max(white)
}

/// Size of a change and how much the sum of squares falls with it; none where the other columns do the same.
fn judged(
    c: &DVector<f64>,
    r: &DVector<f64>,
    j: &DMatrix<f64>,
    factor: &ScaledCholesky,
) -> Option<(f64, f64)> {
    let own = c - j * factor.solve(&j.tr_mul(c));
    let (s, p) = (c.dot(&own), c.dot(r));
    (s > INDEPENDENT * c.norm_squared()).then(|| (-p / s, p * p / s))
}
