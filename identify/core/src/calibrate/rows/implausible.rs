//! Rows that no robot like the configured one can have given: refused, with what most likely went wrong.
//!
//! A fit with priors always ends somewhere. What gives a mistake away is where it ends: beyond the links' tolerances, no
//! better on rows that it has not seen, further from the rows than joints are ever off, or with a step in time.

use std::fmt;

use nalgebra::Vector3;
use statrs::distribution::{ContinuousCDF, StudentsT};

use super::tracker::{ROWS_MIN, check_rows, placed};
use super::{PoseFigures, RowSet, Sizes, is_surely_worse};
use crate::calibrate::CalibrateError;
use crate::calibrate::pipeline::{Plan, estimate};
use crate::instrument::{
    Apart, Instrument, Measures, PoseError, PoseRow, Run, Standing, Tracker, Wire, standing,
};
use crate::instrument::{Measured, Rows};
use crate::kinematics::Chain;
use crate::logs::JointMistake;
use crate::model::{Model, ParameterId, Role, Unit};
use crate::solver::LossName;
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
                "the nominal robot fits the positions, and its orientation is {turned_rad:.2} rad off, as if angles were in \
                 another order, frame or unit than [rotation] of the mapping says"
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
    pub(super) fn explains(&self, rows: &[PoseRow], robot: &Chain) -> bool {
        likely(rows, robot, &[Mistake::Moved(self.row - 1)]).is_some()
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

/// What goes wrong between robot, tracker and file before anybody calibrates.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mistake {
    /// Of the joints.
    Joints(JointMistake),
    /// Joints stand in the row before or after what was measured there.
    RowsShifted,
    /// Two axes of the positions are exchanged, or one has the other sign.
    Mirrored,
    /// From this row on, from 0, tracker, target or robot stand elsewhere.
    Moved(usize),
    /// Lengths are this many thousandths of what they are read as.
    LengthUnit(u32),
    /// Lengths and twists stand in the row of the next joint: Craig's convention, read as the standard one.
    ModifiedTable,
}

impl fmt::Display for Mistake {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Joints(mistake) => write!(f, "{mistake}"),
            Self::RowsShifted => {
                write!(f, "each row's joints belong to the measurement of the row before or after it")
            }
            Self::Mirrored => {
                write!(f, "two axes of the positions are exchanged or one has the other sign")
            }
            Self::Moved(row) => write!(f, "tracker, target or robot were moved near row {}", row + 1),
            Self::LengthUnit(thousandths) => write!(
                f,
                "the lengths are {} times as long as read, in another unit than `unit` of the mapping",
                f64::from(*thousandths) / 1e3
            ),
            Self::ModifiedTable => write!(
                f,
                "the robot's table is in the modified convention and read as the standard one (convention = \"modified\")"
            ),
        }
    }
}

impl Mistake {
    /// All that can be made with the joints of an arm.
    pub fn of_joints(axes: usize) -> Vec<Self> {
        JointMistake::all(axes).into_iter().map(Self::Joints).collect()
    }

    fn all(axes: usize, rows: usize) -> Vec<Self> {
        let others = [Self::RowsShifted, Self::Mirrored, Self::ModifiedTable];
        let moved = (1..BLOCKS).map(|block| Self::Moved(block * rows / BLOCKS));
        [Self::of_joints(axes), others.to_vec(), moved.collect()].concat()
    }

    /// Distance of the nominal robot from the rows without the mistake \[m\]; none where nothing can be placed.
    fn undone_m(self, rows: &[PoseRow], robot: &Chain) -> Option<f64> {
        if let Self::Moved(row) = self {
            let (before, after) = rows.split_at_checked(row)?;
            let part = |rows: &[PoseRow]| Some(misfit_m(rows, robot)?.powi(2) * rows.len() as f64);
            return Some(((part(before)? + part(after)?) / rows.len() as f64).sqrt());
        }
        let ways = self.undone(rows, robot);
        ways.iter().filter_map(|(rows, robot)| misfit_m(rows, robot)).min_by(f64::total_cmp)
    }

    /// The rows and the robot without the mistake: more than one way where it has a direction.
    fn undone(self, rows: &[PoseRow], robot: &Chain) -> Vec<(Vec<PoseRow>, Chain)> {
        let shifted = |joints: &[PoseRow], measured: &[PoseRow]| {
            let pair = |(at, seen): (&PoseRow, &PoseRow)| PoseRow { joints_rad: at.joints_rad, ..*seen };
            (joints.iter().zip(measured).map(pair).collect(), robot.clone())
        };
        match self {
            Self::Joints(mistake) => {
                let undone = |row: &PoseRow| PoseRow { joints_rad: mistake.undone(&row.joints_rad), ..*row };
                vec![(rows.iter().map(undone).collect(), robot.clone())]
            }
            Self::RowsShifted => {
                let later = rows.get(1..).unwrap_or_default();
                vec![shifted(rows, later), shifted(later, rows)]
            }
            Self::Mirrored => {
                let mirrored = |row: &PoseRow| PoseRow {
                    position_m: row.position_m.component_mul(&Vector3::new(1.0, 1.0, -1.0)),
                    rotation: None,
                    ..*row
                };
                vec![(rows.iter().map(mirrored).collect(), robot.clone())]
            }
            Self::Moved(_) | Self::LengthUnit(_) => Vec::new(),
            Self::ModifiedTable => {
                let mut read = robot.clone();
                let next = robot.links.iter().skip(1).map(|link| (link.a_m, link.alpha_rad));
                for (link, (a_m, alpha_rad)) in read.links.iter_mut().zip(next.chain([(0.0, 0.0)])) {
                    (link.a_m, link.alpha_rad) = (a_m, alpha_rad);
                }
                vec![(rows.to_vec(), read)]
            }
        }
    }
}

/// A mistake whose undoing brings the nominal robot to the rows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Likely {
    /// What went wrong.
    pub mistake: Mistake,
    /// Root mean square distance of the nominal robot from the rows as they are \[m\].
    pub as_read_m: f64,
    /// And without the mistake \[m\].
    pub undone_m: f64,
}

impl fmt::Display for Likely {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { mistake, as_read_m, undone_m } = self;
        write!(
            f,
            "{mistake}: so the nominal robot is {:.1} mm from the rows, as read {:.1} mm",
            undone_m * 1e3,
            as_read_m * 1e3
        )
    }
}

/// Rows that distinguish one robot from another: what is wrong is wrong in all.
const TRIED: usize = 60;

/// How far a robot is from some of the rows, tracker and probe placed by the same; none where they cannot be.
pub fn misfit(rows: &[PoseRow], robot: &Chain) -> Option<PoseFigures> {
    let every = rows.len().div_ceil(TRIED).max(1);
    let some: Vec<PoseRow> = rows.iter().step_by(every).copied().collect();
    check_rows(&some).ok().filter(|()| some.len() >= ROWS_MIN)?;
    let all: Vec<usize> = (0..some.len()).collect();
    let states = standing(some.iter().map(|row| row.joints_rad));
    let tracker = Tracker::new(Standing::new(&some, &states, &all, 0));
    let model = placed(&tracker, Model::measured_pose(robot)).ok()?;
    Some(PoseFigures::of(&tracker.errors(&model.geometry(&[]))))
}

/// Root mean square distance of a robot from the rows at the end of a tool \[m\].
fn misfit_m(rows: &[PoseRow], robot: &Chain) -> Option<f64> {
    /// Length of the tool: orientations count by where it ends.
    const TOOL_M: f64 = 0.1;
    let figures = misfit(rows, robot)?;
    Some(figures.position_m.rms.hypot(TOOL_M * figures.rotation_rad.map_or(0.0, |sizes| sizes.rms)))
}

/// Nominal arms are nearer to rows that are read right \[m\].
const NEAR_M: f64 = 0.05;

/// The mistake among these that brings the nominal robot to the rows, where one does.
pub fn likely(rows: &[PoseRow], robot: &Chain, mistakes: &[Mistake]) -> Option<Likely> {
    /// Undoing a mistake leaves less than this part of the distance: what is left is the robot's own error, millimetres
    /// where mistakes make centimetres.
    const LEFT: f64 = 0.3;
    // Where no place of the tracker can be found, any is better.
    let as_read_m = misfit_m(rows, robot).unwrap_or(f64::INFINITY);
    let of =
        |&mistake: &Mistake| Some(Likely { mistake, as_read_m, undone_m: mistake.undone_m(rows, robot)? });
    let best = mistakes.iter().filter_map(of).min_by(|a, b| a.undone_m.total_cmp(&b.undone_m))?;
    (best.undone_m < NEAR_M.min(LEFT * as_read_m)).then_some(best)
}

/// The most likely of all mistakes, in the first of these files that shows one.
pub(in crate::calibrate) fn likely_of_all(files: &[Rows], robot: &Chain) -> Option<Likely> {
    let of = |file: &Rows| {
        let rows = file.measured.poses()?;
        likely(rows, robot, &Mistake::all(robot.links.len(), rows.len()))
    };
    files.iter().find_map(of)
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
        let reasons = of_set(set, file, &run.model, robot);
        found.extend(reasons.iter().map(|reason| format!("{place}{reason}")));
    }
    if found.is_empty() {
        return Ok(());
    }
    Err(CalibrateError::Implausible { found: found.join("; "), likely: likely_of_all(files, robot) })
}

/// Refuses the lengths of a wire that are in another unit than the mapping states. `nominal` has the nominal robot, the wire fitted to it.
///
/// Lengths whose variation the nominal robot does not explain, and does explain where they are in another usual unit, are in that.
///
/// # Errors
/// [`CalibrateError::Implausible`] with the unit.
pub(in crate::calibrate) fn unless_other_unit(
    file: &Rows,
    whole: &Instrument,
    nominal: &Model,
) -> Result<(), CalibrateError> {
    /// m read as mm, cm as mm, inches as mm or as m, and each the other way round \[1/1000\].
    const THOUSANDTHS: [u32; 6] = [1_000_000, 10_000, 25_400, 100, 39, 1];
    /// The nominal robot leaves less than this part of the variation of lengths that are read right: its own millimetres of decimetres.
    const UNEXPLAINED: f64 = 0.3;
    let (Measured::Lengths(rows), Instrument::Wire(wire)) = (&file.measured, whole) else { return Ok(()) };
    let spread_m = |wire: &Wire| {
        let lengths_m = || wire.lengths_m();
        let mean_m = lengths_m().sum::<f64>() / rows.len().max(1) as f64;
        Sizes::of(lengths_m().map(|length_m| length_m - mean_m)).rms
    };
    let left_m = |wire: &Wire, model: &Model| median_size(wire.residuals_m(&model.geometry(&[])).into_iter());
    let (varies_m, as_read_m) = (spread_m(wire), left_m(wire, nominal));
    if as_read_m < NEAR_M.min(UNEXPLAINED * varies_m) {
        return Ok(());
    }
    let mut start = nominal.clone();
    for parameter in nominal.parameters() {
        start.set_value(parameter.id, parameter.nominal)?;
    }
    let undone = |thousandths: &u32| {
        let other = wire.times(f64::from(*thousandths) * 1e-3);
        let mut run = Run { instrument: Instrument::Wire(other.clone()), model: start.clone() };
        run.instrument.place(&mut run.model, &[]).ok().filter(|placed| *placed)?;
        estimate(std::slice::from_mut(&mut run), &Plan::new(LossName::Huber, Vec::new())).ok()?;
        let undone_m = left_m(&other, &run.model);
        let part = undone_m / spread_m(&other);
        let mistake = Mistake::LengthUnit(*thousandths);
        (undone_m < NEAR_M && part < UNEXPLAINED).then_some((part, Likely { mistake, as_read_m, undone_m }))
    };
    let best = THOUSANDTHS.iter().filter_map(undone).min_by(|a, b| a.0.total_cmp(&b.0));
    let Some((_, likely)) = best else { return Ok(()) };
    let found = format!(
        "the lengths vary by {:.3} mm (RMS), which the nominal robot does not explain",
        varies_m * 1e3
    );
    Err(CalibrateError::Implausible { found, likely: Some(likely) })
}

fn of_set(set: &RowSet, file: &Rows, model: &Model, robot: &Chain) -> Vec<Reason> {
    let [.., errors] = &set.errors.stages;
    let step = file.measured.poses().and_then(|rows| {
        let steps = [set.step(model), set.step];
        steps.into_iter().flatten().find(|step| step.explains(rows, robot))
    });
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
pub(super) fn step(tracker: &Tracker, model: &Model) -> Option<Step> {
    /// Of runs without a step one in so many has one by chance.
    const FALSE_ALARMS: f64 = 1e-4;
    /// Blocks before and after.
    const BESIDE: usize = 3;
    let deviations = tracker.deviations(&model.geometry(&[])).into_iter();
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
