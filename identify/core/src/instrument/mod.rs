//! Instruments that measure the robot: ball-bar, tracker, wire, and a tip in sockets or on faces. The file of each
//! instrument contains its residuals, start values and outlier tests. Its rows are defined in `logs`. `calibrate` uses
//! all instruments through the trait [`Measures`]. The model of the robot does not depend on instruments, and
//! instruments do not depend on the estimator.

mod ball_bar;
mod cause;
mod description;
mod deviation;
mod measures;
mod repetition;
mod rows;
mod tip;
mod tracker;
mod wire;

use std::ops::{Deref, DerefMut};

pub use ball_bar::{BallBar, CostName, NoiseConfig};
pub use cause::Cause;
use description::set_scale_prior;
pub use description::{Noise, ScaleFrom, Section};
pub use deviation::{Apart, Deviation, PoseError};
pub use measures::Measures;
pub use rows::{HoldOut, Mistake, RejectedRow, Rejection, RowError, Rows, SEED, standing};
pub(crate) use rows::{faulty, gross_rows, segments, without};
pub use tip::{
    Artefact, Contact, FaceTable, Faces, KnownAngle, KnownDistance, Knowns, PlacedSocket, SocketTable,
    Sockets, Spacing, Tip, Touch, Touched,
};
pub use tracker::Tracker;
pub use wire::Wire;

use crate::kinematics::Joints;
use crate::model::Model;

/// Copies an instrument of any type. Needed because `dyn Measures` cannot implement `Clone`.
pub trait Boxed {
    /// A copy of the instrument with all its samples.
    fn boxed(&self) -> Instrument;
}

impl<M: Measures + Clone + 'static> Boxed for M {
    fn boxed(&self) -> Instrument {
        self.clone().into()
    }
}

/// An instrument of any type with its samples.
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
    /// Joints that the robot reports at each sample, with the clock of the model. Samples outside the
    /// robot's log are omitted.
    pub fn poses(&self, model: &Model) -> impl Iterator<Item = Joints> {
        let clock = model.geometry(&[]).clock;
        (0..self.samples()).filter_map(move |sample| Some(self.reported(sample, &clock)?.q))
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

/// A data set: one run or file of one instrument, with the parameters of its fit.
#[derive(Debug, Clone)]
pub struct Run {
    /// Instrument with its samples.
    pub instrument: Instrument,
    /// Parameters of robot and instrument.
    pub model: Model,
}
