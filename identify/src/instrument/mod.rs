//! What closes the loop beside the robot: one file for each instrument, with its measurements and its residual. The robot
//! knows no instrument, and no instrument knows how robots are estimated.

mod ball_bar;

use std::fmt;
use std::ops::{Deref, DerefMut};

pub use ball_bar::BallBar;

use crate::cost::{CostError, DataSet};
use crate::model::{Clock, JointState, Model, ParameterId};

/// What an estimator asks of an instrument.
pub trait Measures: fmt::Debug + Sync {
    /// Number of samples.
    fn samples(&self) -> usize;

    /// The samples where the model is, residuals over `sigma`.
    ///
    /// # Errors
    /// [`CostError`] where the samples are not what the residual needs.
    fn data_set<'a>(&'a self, model: &'a Model, sigma: f64) -> Result<Box<dyn DataSet + 'a>, CostError>;

    /// What the robot reports at a sample; none outside its log.
    fn reported(&self, sample: usize, clock: &Clock) -> Option<JointState>;

    /// The samples can tell the parameter from the others that are usually free.
    fn tells(&self, id: ParameterId) -> bool;

    /// Takes over what hangs on the geometry, before a solve from where the model is.
    fn adapt(&mut self, model: &Model);

    /// At most `count` groups of samples, with errors that have nothing in common.
    fn independent(&self, count: usize) -> Vec<Vec<usize>>;

    /// Every so manieth sample.
    fn thinned(&self, every: usize) -> Instrument;
}

/// The instruments.
#[derive(Debug, Clone)]
pub enum Instrument {
    /// The sensed double ball-bar.
    BallBar(BallBar),
}

impl Deref for Instrument {
    type Target = dyn Measures;

    fn deref(&self) -> &Self::Target {
        match self {
            Self::BallBar(of) => of,
        }
    }
}

impl DerefMut for Instrument {
    fn deref_mut(&mut self) -> &mut Self::Target {
        match self {
            Self::BallBar(of) => of,
        }
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
