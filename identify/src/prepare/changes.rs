//! What can change during a run, what it is called, and what becomes of the run.

use std::fmt;

use super::{PrepareError, PrepareOptions};
use crate::kinematics::{AXES_MAX, BAR_JOINTS, LinkParameter};
use crate::model::{Axis, ParameterId};
use crate::solver::{Change, Course, Loss, Problem, change_point};

/// Of so many runs in which nothing changes one is said to have a change: a run is looked at twice, once with each half.
const FALSE_ALARMS: f64 = 1e-4;
/// Smaller steps of a clock are said and do not refuse a run \[s\]: at 0.15 rad/s they are what `slip_min_mrad` is.
const CLOCK_S_MIN: f64 = 0.002;
/// Nor does a base of the bar that moves by less \[m\]: at an arm's length of half a metre that is `slip_min_mrad`, too.
const BASE_M_MIN: f64 = 0.000_15;
/// Samples that are looked at, at most: what only more would show is too small to matter.
pub(super) const SAMPLES_MAX: usize = 3000;

/// What can change.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Cause {
    /// The offset of the encoder of this bar joint, from 0.
    Encoder(usize),
    /// The offset of this joint of the robot, from 0.
    RobotJoint(usize),
    /// Where the bar stands.
    Base,
    /// The time of one log against the other.
    Clock,
}

impl Cause {
    fn all() -> impl Iterator<Item = Self> {
        let encoders = (0..BAR_JOINTS).map(Self::Encoder);
        encoders.chain((0..AXES_MAX).map(Self::RobotJoint)).chain([Self::Base, Self::Clock])
    }

    /// The parameters that change with it.
    fn ids(self) -> Vec<ParameterId> {
        match self {
            Self::Encoder(link) => vec![ParameterId::Bar { link, parameter: LinkParameter::Theta }],
            Self::RobotJoint(link) => vec![ParameterId::Robot { link, parameter: LinkParameter::Theta }],
            Self::Base => Axis::ALL.map(ParameterId::Base).to_vec(),
            Self::Clock => vec![ParameterId::ClockShift],
        }
    }
}

/// Parameters that a change is told by; where one is not among the columns, that change is not looked for.
pub(crate) fn changing() -> impl Iterator<Item = ParameterId> {
    Cause::all().flat_map(Cause::ids)
}

/// A change of a run that is certain.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Changed {
    cause: Cause,
    /// None: it drifts.
    at_s: Option<f64>,
    /// SI.
    by: Vec<f64>,
}

/// The change that samples in the order of time show of a problem at `x`, by the first of which `time_s` counts \[s\]; none
/// where a sound run shows as much ([`change_point`]). `columns` are those of a parameter.
pub(crate) fn changed(
    problem: &impl Problem,
    x: &[f64],
    loss: Loss,
    columns: impl Fn(ParameterId) -> Vec<usize>,
    time_s: impl Fn(usize) -> Option<f64>,
) -> Option<Changed> {
    let every = problem.samples().div_ceil(SAMPLES_MAX).max(1);
    let samples: Vec<usize> = (0..problem.samples()).step_by(every).collect();
    let directions = |cause: Cause| -> Vec<Vec<usize>> { cause.ids().into_iter().map(&columns).collect() };
    let known = |(_, directions): &(Cause, Vec<Vec<usize>>)| directions.iter().all(|one| !one.is_empty());
    let all = Cause::all().map(|cause| (cause, directions(cause))).filter(known);
    let (causes, alternatives): (Vec<Cause>, Vec<_>) = all.unzip();
    let Change { alternative, course, by } =
        change_point(problem, x, loss, &samples, &alternatives, 0.5 * FALSE_ALARMS)?;
    let at_s = match course {
        // The first sample that shows it: an encoder that slips at rest moves then, and only then.
        Course::Step(at) => Some(time_s(*samples.get(at)?)?),
        Course::Drift => None,
    };
    Some(Changed { cause: *causes.get(alternative)?, at_s, by })
}

impl Changed {
    /// Why a run with it is refused: a step that is larger than what a calibration may carry.
    pub fn refusal(&self, options: &PrepareOptions) -> Option<PrepareError> {
        let at_s = self.at_s?;
        let by = self.by.first().copied()?;
        let size = self.by.iter().map(|by| by * by).sum::<f64>().sqrt();
        let slip_min_rad = options.slip_min_mrad * 1e-3;
        // What an encoder or a joint shows too much its offset has to take away.
        let by_mrad = -by * 1e3;
        let (error, least) = match self.cause {
            Cause::Encoder(joint) => {
                (PrepareError::EncoderSlip { joint: joint as u8 + 1, at_s, by_mrad }, slip_min_rad)
            }
            Cause::RobotJoint(joint) => {
                (PrepareError::RobotStep { joint: joint as u8 + 1, at_s, by_mrad }, slip_min_rad)
            }
            Cause::Base => (PrepareError::BaseMoved { at_s, by_mm: size * 1e3 }, BASE_M_MIN),
            Cause::Clock => (PrepareError::ClockJump { at_s, by_ms: by * 1e3 }, CLOCK_S_MIN),
        };
        (size > least).then_some(error)
    }
}

impl fmt::Display for Changed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let by = self.by.first().copied().unwrap_or_default();
        let (what, size) = match self.cause {
            Cause::Encoder(joint) => {
                (format!("the encoder of joint {}", joint + 1), format!("{:+.3} mrad", -by * 1e3))
            }
            Cause::RobotJoint(joint) => (
                format!("the logged angle of the robot's joint {}", joint + 1),
                format!("{:+.3} mrad", -by * 1e3),
            ),
            Cause::Base => {
                let size = self.by.iter().map(|by| by * by).sum::<f64>().sqrt();
                ("the base of the bar".to_owned(), format!("{:.3} mm", size * 1e3))
            }
            Cause::Clock => ("the robot's clock".to_owned(), format!("{:+.3} ms", by * 1e3)),
        };
        match self.at_s {
            Some(at_s) => write!(f, "{what} moves by {size} at {at_s:.2} s after the first sample"),
            None => write!(f, "{what} drifts by {size} from the first sample to the last"),
        }
    }
}
