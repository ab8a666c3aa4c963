//! Instruments that measure the robot, one file each with its measurements, residuals, start values and outliers. `calibrate`
//! uses them as [`Measures`]. The robot model does not depend on instruments, and instruments do not depend on the estimator.

mod ball_bar;
mod cause;
mod contact;
mod deviation;
mod faces;
mod known;
mod repetition;
mod rows;
mod sockets;
mod touch;
mod tracker;
mod wire;

use std::fmt;
use std::ops::{Deref, DerefMut};

pub use ball_bar::{BallBar, CostName, NoiseConfig};
pub use cause::Cause;
pub use contact::{Contact, ContactError, ContactRow};
pub use deviation::{Apart, Deviation, PoseError};
pub use faces::{FaceTable, Faces, KnownAngle, Spacing, Touched};
pub use known::{Contradiction, Knowns};
pub use rows::{HoldOut, Mistake, RejectedRow, Rejection, RowError, Rows, SEED, standing};
pub(crate) use rows::{faulty, gross_rows, segments, without};
pub use sockets::{KnownDistance, PlacedSocket, SocketTable, Sockets};
pub use touch::{Touch, TouchRow};
pub use tracker::{PoseRow, Tracker};
pub use wire::{LengthRow, Wire};

use crate::cost::{AngleNoise, CostError, DataSet};
use crate::kinematics::{Chain, Joints};
use crate::model::{Clock, Geometry, JointState, Model, ModelError, ParameterId};
use crate::prepare::{EncoderMap, Prepared};

/// The interface of an instrument to the estimator.
pub trait Measures: Boxed + fmt::Debug + Send + Sync {
    /// Name in messages and files.
    fn name(&self) -> &'static str;

    /// Name of the minimised cost.
    fn cost(&self) -> &'static str;

    /// The cost in whose unit the residuals are until their noise is estimated; `None` if they are in standard deviations from
    /// the start.
    fn residual_unit_of(&self) -> Option<CostName> {
        None
    }

    /// Source of the scale of all lengths.
    fn scale(&self) -> ScaleFrom;

    /// Standard deviation of a reading of the median sample at the last solution, relative to the sigma of the data set.
    fn noise(&self) -> Noise;

    /// Number of samples in use.
    fn samples(&self) -> usize;

    /// Adds the parameters of the instrument to the model of a robot, with value zero.
    fn fitted_out(&self, robot: Model) -> Model {
        robot
    }

    /// Sets start values of the instrument's parameters for the robot of the model, and frees those that are not in `fix`.
    /// Returns false if the samples do not determine a start.
    ///
    /// # Errors
    /// [`ModelError`] if the model is of another instrument.
    fn place(&self, model: &mut Model, fix: &[ParameterId]) -> Result<bool, ModelError>;

    /// The samples as residuals at the parameters of the model, divided by `sigma`.
    ///
    /// # Errors
    /// [`CostError`] if the residual cannot be computed from the samples.
    fn data_set<'a>(&'a self, model: &'a Model, sigma: f64) -> Result<Box<dyn DataSet + 'a>, CostError>;

    /// State that the robot reports at a sample; `None` outside its log.
    fn reported(&self, sample: usize, clock: &Clock) -> Option<JointState>;

    /// Whether the samples separate the parameter of this robot from the others that are usually free.
    fn identifies(&self, id: ParameterId, robot: &Chain) -> bool;

    /// Changes at one instant that can occur during a measurement.
    fn causes(&self, geometry: &Geometry) -> Vec<Cause>;

    /// Updates quantities that depend on the geometry, before a solve that starts at the model. Returns the noise of a
    /// measurement, in its unit, if the instrument estimates it: its residuals are then in standard deviations.
    fn adapt(&mut self, model: &Model) -> Option<f64>;

    /// Estimates the noise of the readings from the residuals at a solution, and weights them by it.
    fn learn_noise(&mut self, _model: &Model) {}

    /// Leaves out samples that are outliers at the model, and includes those that no longer are. Returns whether the set of
    /// samples in use has changed.
    fn screen(&mut self, _model: &Model) -> bool {
        false
    }

    /// At most `count` groups of samples with independent errors.
    fn independent(&self, count: usize) -> Vec<Vec<usize>>;

    /// The instrument with a part of its samples.
    fn part(&self, samples: &[usize]) -> Instrument;

    /// Sets the group of each sample, held out together, and the `seed` of the assignment of groups to folds.
    fn group(&mut self, _groups: &[usize], _seed: u64) {}

    /// Default way to hold samples out.
    fn hold_out(&self) -> HoldOut {
        HoldOut::Rows
    }

    /// Robot minus measurement in every sample, used or not; NaN outside the robot's log and for set-ups that the geometry
    /// lacks.
    fn deviations(&self, geometry: &Geometry) -> Vec<Deviation>;

    /// Sizes of [`Measures::deviations`].
    fn errors(&self, geometry: &Geometry) -> Vec<PoseError> {
        self.deviations(geometry).into_iter().map(PoseError::from).collect()
    }

    /// Samples that are left out of the fit.
    fn rejected(&self) -> &[RejectedRow] {
        &[]
    }

    /// Name in tables of what is fitted besides the robot.
    fn parts(&self) -> &'static str {
        self.name()
    }

    /// Groups of samples that are reported separately.
    fn sections(&self) -> Vec<Section> {
        Vec::new()
    }

    /// Possible reasons, as text, why samples are left out, with the number of each sample.
    fn remarks(&self, _geometry: &Geometry) -> Vec<(usize, String)> {
        Vec::new()
    }

    /// How the log and the robot's were aligned; `None` for an instrument without continuous measurement.
    fn prepared(&self) -> Option<&Prepared> {
        None
    }

    /// Time of a sample on the instrument's clock, since its reference time \[s\]; `None` for rows of a robot at rest.
    fn time_s(&self, _sample: usize) -> Option<f64> {
        None
    }

    /// Time of the first sample that was measured, used or not, on the same clock \[s\]: times in messages count from it.
    fn first_s(&self) -> Option<f64> {
        self.time_s(0)
    }

    /// Reasons why the figures at a solution may be wrong.
    fn doubts(&self, _geometry: &Geometry) -> Vec<Doubt> {
        Vec::new()
    }

    /// Lag-one autocorrelation of the residuals, as of the last [`Measures::learn_noise`], and its standard deviation for white
    /// noise. Above zero by the part of the variance that is correlated.
    fn autocorrelation(&self) -> Option<[f64; 2]> {
        None
    }

    /// Noise of each sample relative to the median one, from uncertainties that files state, as of the last
    /// [`Measures::adapt`].
    fn relative_noise(&self) -> Vec<f64> {
        vec![1.0; self.samples()]
    }

    /// Estimates the relative noise from these samples alone, at the model.
    fn weigh_by(&mut self, _model: &Model, _samples: &[usize]) {}

    /// Samples whose own data contradict each other.
    ///
    /// # Errors
    /// [`RowError`] if samples are invalid, or too few to locate the instrument.
    fn contradicting(&self, _robot: &Chain) -> Result<Vec<RejectedRow>, RowError> {
        Ok(Vec::new())
    }

    /// Fewest samples of a fit with this instrument alone.
    fn samples_min(&self) -> usize {
        0
    }

    /// Samples that cannot be measurements at the model, whether they were fitted or held out.
    fn misplaced(&self, _model: &Model) -> Vec<RejectedRow> {
        Vec::new()
    }

    /// Whether outliers are determined again at each solve ([`Measures::screen`]).
    fn judges_gross(&self) -> bool {
        false
    }

    /// Joints of the robot at each sample, as known when it was read.
    fn joints(&self) -> Vec<Joints> {
        let clock = Clock::default();
        (0..self.samples()).map(|sample| self.reported(sample, &clock).unwrap_or_default().q).collect()
    }

    /// Mistakes that a file of this instrument can contain, for an arm with this number of axes.
    fn mistakes(&self, _axes: usize) -> Vec<Mistake> {
        Vec::new()
    }

    /// The samples with a mistake undone, one result for each direction that it can have; empty if it cannot be undone.
    fn undone(&self, _mistake: Mistake) -> Vec<Instrument> {
        Vec::new()
    }

    /// Measured lengths \[m\]; empty for instruments without lengths.
    fn lengths_m(&self) -> Vec<f64> {
        Vec::new()
    }

    /// The same with each length increased by `by_m` \[m\]; `None` for an instrument without lengths.
    fn longer_by(&self, _by_m: &[f64]) -> Option<Instrument> {
        None
    }
}

/// Samples that share a part of the instrument, such as a station.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Section {
    /// Name of the section in reports.
    pub name: String,
    /// Prefix of the names of its parameters.
    pub parameters: String,
    /// Its samples, used or not.
    pub samples: Vec<usize>,
}

/// Reason why the figures of a data set may be wrong.
#[derive(Debug, Clone, PartialEq)]
pub enum Doubt {
    /// The encoder map or a counting direction differs from that of the recording.
    OtherEncoders(EncoderMap),
    /// Another time alignment fits nearly as well, because the motion repeats.
    MotionRepeats,
    /// Rows contradict the table of sockets or faces.
    OtherTable(Vec<Contradiction>),
}

/// Source of the scale of all lengths.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ScaleFrom {
    /// Dimensions of the ball-bar.
    Plate,
    /// Positions measured by the tracker.
    Tracker,
    /// Lengths measured by the wire.
    Wire,
    /// Table of the sockets.
    Sockets,
    /// Known distances between faces.
    Faces,
    /// The robot's file alone: nothing measured has a scale.
    Robot,
}

/// Standard deviation of a reading.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Noise {
    /// Bar encoders and robot joints.
    Angles(AngleNoise),
    /// A coordinate or a length \[m\].
    Length(f64),
}

impl Section {
    /// One section for each named part, with parameters numbered from 1; `part_of` yields the part of each sample, from 0.
    fn each(names: &[String], parameters: &str, part_of: impl Iterator<Item = usize>) -> Vec<Self> {
        let mut sections: Vec<Self> = (1..)
            .zip(names)
            .map(|(number, name)| Self {
                name: name.clone(),
                parameters: format!("{parameters}{number}"),
                samples: Vec::new(),
            })
            .collect();
        for (sample, part) in part_of.enumerate() {
            if let Some(section) = sections.get_mut(part) {
                section.samples.push(sample);
            }
        }
        sections
    }
}

/// Text that names the other part which a sample fits best; `off_m` returns its distance from each part. Empty if its own is
/// nearest.
fn nearest(names: &[String], own: usize, off_m: impl Fn(usize) -> f64) -> String {
    let nearest = (0..names.len()).min_by(|a, b| off_m(*a).total_cmp(&off_m(*b)));
    nearest.filter(|part| *part != own).map_or_else(String::new, |part| {
        format!(", {:.2} mm from `{}`: look for a wrong name", off_m(part) * 1e3, names[part])
    })
}

/// Copies an instrument of any kind.
pub trait Boxed {
    /// A copy with all its samples.
    fn boxed(&self) -> Instrument;
}

impl<M: Measures + Clone + 'static> Boxed for M {
    fn boxed(&self) -> Instrument {
        self.clone().into()
    }
}

/// An instrument of any kind with its samples.
#[derive(Debug)]
pub struct Instrument(Box<dyn Measures>);

impl<M: Measures + 'static> From<M> for Instrument {
    fn from(of: M) -> Self {
        Self(Box::new(of))
    }
}

impl Clone for Instrument {
    fn clone(&self) -> Self {
        self.0.boxed()
    }
}

impl Instrument {
    /// Joints that the robot reports at each sample, with the clock of the model.
    pub fn poses(&self, model: &Model) -> impl Iterator<Item = Joints> {
        let clock = model.geometry(&[]).clock;
        (0..self.samples()).filter_map(move |sample| Some(self.reported(sample, &clock)?.q))
    }

    /// Model of the nominal robot with the parameters of the instrument.
    pub fn at_nominal(&self, robot: &Chain) -> Model {
        self.fitted_out(Model::alone(robot))
    }
}

impl Deref for Instrument {
    type Target = dyn Measures;

    fn deref(&self) -> &Self::Target {
        self.0.as_ref()
    }
}

impl DerefMut for Instrument {
    fn deref_mut(&mut self) -> &mut Self::Target {
        self.0.as_mut()
    }
}

/// One run or file of one instrument, with the parameters of its fit.
#[derive(Debug, Clone)]
pub struct Run {
    /// Instrument with its samples.
    pub instrument: Instrument,
    /// Parameters of robot and instrument.
    pub model: Model,
}
