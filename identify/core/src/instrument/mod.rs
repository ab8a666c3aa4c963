//! What closes the loop beside the robot: one file for each instrument, with its measurements and its residual. The robot
//! knows no instrument, and no instrument knows how robots are estimated.

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

/// What an estimator asks of an instrument.
pub trait Measures: Boxed + fmt::Debug + Send + Sync {
    /// Name in messages and files.
    fn name(&self) -> &'static str;

    /// Name of what is minimised.
    fn cost(&self) -> &'static str;

    /// The cost in whose unit residuals are until their noise is found; `None` if they are standard deviations from the start.
    fn in_unit_of(&self) -> Option<CostName> {
        None
    }

    /// What fixes the scale of all lengths.
    fn scale(&self) -> ScaleFrom;

    /// Standard deviation of a reading at the last solution: of the median sample, over the sigma of the data set.
    fn noise(&self) -> Noise;

    /// Number of samples.
    fn samples(&self) -> usize;

    /// The model of a robot with what is the instrument's own, at zero.
    fn fitted_out(&self, robot: Model) -> Model {
        robot
    }

    /// Sets where the instrument stands for the robot as the model has it, and frees what is its own but for parameters in
    /// `fix`. False where that does not follow from the samples.
    ///
    /// # Errors
    /// [`ModelError`] where the model is that of another instrument.
    fn place(&self, model: &mut Model, fix: &[ParameterId]) -> Result<bool, ModelError>;

    /// The samples where the model is, residuals over `sigma`.
    ///
    /// # Errors
    /// [`CostError`] where the samples are not what the residual needs.
    fn data_set<'a>(&'a self, model: &'a Model, sigma: f64) -> Result<Box<dyn DataSet + 'a>, CostError>;

    /// What the robot reports at a sample; none outside its log.
    fn reported(&self, sample: usize, clock: &Clock) -> Option<JointState>;

    /// The samples separate the parameter from the others that are usually free.
    fn identifies(&self, id: ParameterId) -> bool;

    /// What of it can change while it measures.
    fn causes(&self, geometry: &Geometry) -> Vec<Cause>;

    /// Takes over what hangs on the geometry, before a solve from where the model is. The noise of a measurement, in its unit,
    /// where the instrument estimates that by itself: its residuals are then in standard deviations.
    fn adapt(&mut self, model: &Model) -> Option<f64>;

    /// Finds the noise of its readings in what is left where the model is, which is at a solution, and weighs by that.
    fn learn_noise(&mut self, _model: &Model) {}

    /// Leaves out samples that do not belong with the rest where the model is, and takes back those that do; whether other ones
    /// take part now.
    fn screen(&mut self, _model: &Model) -> bool {
        false
    }

    /// At most `count` groups of samples, with errors that have nothing in common.
    fn independent(&self, count: usize) -> Vec<Vec<usize>>;

    /// Some of the samples.
    fn part(&self, samples: &[usize]) -> Instrument;

    /// Sets which samples are left out together, by the group of each; `seed` decides which groups come together.
    fn group(&mut self, _groups: &[usize], _seed: u64) {}

    /// The usual way to leave samples out.
    fn hold_out(&self) -> HoldOut {
        HoldOut::Rows
    }

    /// Robot minus measurement in every sample, used or not; NaN outside the robot's log and for set-ups that the geometry lacks.
    fn deviations(&self, geometry: &Geometry) -> Vec<Deviation>;

    /// The sizes of [`Measures::deviations`].
    fn errors(&self, geometry: &Geometry) -> Vec<PoseError> {
        self.deviations(geometry).into_iter().map(PoseError::from).collect()
    }

    /// Samples that the fit leaves out.
    fn rejected(&self) -> &[RejectedRow] {
        &[]
    }

    /// What is fitted of it beside the robot, as tables call it.
    fn parts(&self) -> &'static str {
        self.name()
    }

    /// Groups of its samples that have figures of their own.
    fn sections(&self) -> Vec<Section> {
        Vec::new()
    }

    /// What may explain why samples take no part, in words, with the number of each.
    fn remarks(&self, _geometry: &Geometry) -> Vec<(usize, String)> {
        Vec::new()
    }

    /// How its log and the robot's were brought together, where it has measured all the time.
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

    /// What makes its figures doubtful at a solution.
    fn doubts(&self, _geometry: &Geometry) -> Vec<Doubt> {
        Vec::new()
    }

    /// Correlation of what the model leaves with what it leaves one sample later, as of the last [`Measures::learn_noise`], and one
    /// standard deviation of that for white noise: above zero by the part of the variance that lasts.
    fn autocorrelation(&self) -> Option<[f64; 2]> {
        None
    }

    /// Noise of each of these over that of the median one, where files state what rows are worth, as of the last [`Measures::adapt`].
    fn relative_noise(&self) -> Vec<f64> {
        vec![1.0; self.samples()]
    }

    /// The same by what these samples alone show where the model is.
    fn weigh_by(&mut self, _model: &Model, _samples: &[usize]) {}

    /// Samples whose own data contradict each other; all others are measurements.
    ///
    /// # Errors
    /// [`RowError`] where they are none, or cannot say where the instrument stands.
    fn contradicting(&self, _robot: &Chain) -> Result<Vec<RejectedRow>, RowError> {
        Ok(Vec::new())
    }

    /// Fewest samples of a fit that has nothing else.
    fn samples_min(&self) -> usize {
        0
    }

    /// Samples that cannot be measurements where the model is, whether a fit saw them or not.
    fn misplaced(&self, _model: &Model) -> Vec<RejectedRow> {
        Vec::new()
    }

    /// Samples with gross residuals are found anew at each solve ([`Measures::screen`]).
    fn judges_gross(&self) -> bool {
        false
    }

    /// The joints of the robot at each sample, as far as they were known when it was read.
    fn joints(&self) -> Vec<Joints> {
        let clock = Clock::default();
        (0..self.samples()).map(|sample| self.reported(sample, &clock).unwrap_or_default().q).collect()
    }

    /// Mistakes that a file of this instrument may have, for an arm with this number of axes.
    fn mistakes(&self, _axes: usize) -> Vec<Mistake> {
        Vec::new()
    }

    /// The samples without a mistake, in each direction that it may have; empty if it cannot be undone.
    fn undone(&self, _mistake: Mistake) -> Vec<Instrument> {
        Vec::new()
    }

    /// Lengths that were read \[m\]; empty for other instruments.
    fn lengths_m(&self) -> Vec<f64> {
        Vec::new()
    }

    /// The same with each length longer by `by_m`; `None` for an instrument without lengths, whose zero could wander.
    fn longer_by(&self, _by_m: &[f64]) -> Option<Instrument> {
        None
    }
}

/// Samples that have something of the instrument in common.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Section {
    /// What a person calls it.
    pub name: String,
    /// What the names of its parameters begin with.
    pub parameters: String,
    /// Its samples, used or not.
    pub samples: Vec<usize>,
}

/// What makes the figures of a data set doubtful.
#[derive(Debug, Clone, PartialEq)]
pub enum Doubt {
    /// The encoders sit or count otherwise than the recording says.
    OtherEncoders(EncoderMap),
    /// Another alignment in time fits nearly as well.
    MotionRepeats,
    /// Rows contradict what is known of sockets or faces.
    OtherTable(Vec<Contradiction>),
}

/// What fixes the scale of all lengths.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ScaleFrom {
    /// Of the ball-bar.
    Plate,
    /// Its positions.
    Tracker,
    /// Its lengths.
    Wire,
    /// Their table.
    Sockets,
    /// Known distances between faces.
    Faces,
    /// Nothing that is measured: the robot's own file.
    Robot,
}

/// Standard deviation of a reading.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Noise {
    /// Of bar encoders and robot joints.
    Angles(AngleNoise),
    /// Of a coordinate or a length \[m\].
    Length(f64),
}

impl Section {
    /// A section for each named part of an instrument, whose parameters are numbered from 1; `part_of` gives that of each sample.
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

/// Which other part of an instrument a sample fits best, in words; `off_m` is its distance from each.
fn nearest(names: &[String], own: usize, off_m: impl Fn(usize) -> f64) -> String {
    let near = (0..names.len()).min_by(|a, b| off_m(*a).total_cmp(&off_m(*b)));
    near.filter(|near| *near != own).map_or_else(String::new, |near| {
        format!(", {:.2} mm from `{}`: look for a wrong name", off_m(near) * 1e3, names[near])
    })
}

/// What makes a copy of an instrument of any kind.
pub trait Boxed {
    /// A copy with all its samples.
    fn boxed(&self) -> Instrument;
}

impl<M: Measures + Clone + 'static> Boxed for M {
    fn boxed(&self) -> Instrument {
        self.clone().into()
    }
}

/// An instrument of any kind, with its samples.
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
    /// What the robot reports at each sample; the model has the clocks.
    pub fn poses(&self, model: &Model) -> impl Iterator<Item = Joints> {
        let clock = model.geometry(&[]).clock;
        (0..self.samples()).filter_map(move |sample| Some(self.reported(sample, &clock)?.q))
    }

    /// The model of the nominal robot with what is the instrument's own.
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

/// One run or file of one instrument, and the parameters there.
#[derive(Debug, Clone)]
pub struct Run {
    /// What was measured.
    pub instrument: Instrument,
    /// Robot and instrument.
    pub model: Model,
}
