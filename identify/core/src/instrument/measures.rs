//! [`Measures`]: what the estimator, its checks and the reports need of an instrument. Most methods have a default, which is that
//! of an instrument without this part.

use std::fmt;

use super::{
    Boxed, Cause, CostName, Deviation, Doubt, HoldOut, Instrument, Mistake, Noise, PoseError, RejectedRow,
    RowError, ScaleFrom, Section,
};
use crate::cost::{CostError, DataSet};
use crate::kinematics::{Chain, Joints};
use crate::model::{Clock, Geometry, JointState, Model, ModelError, ParameterId};
use crate::prepare::Prepared;

/// The interface of an instrument to the estimator.
pub trait Measures: Boxed + fmt::Debug + Send + Sync {
    // What it is.

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

    /// Name in tables of what is fitted besides the robot.
    fn parts(&self) -> &'static str {
        self.name()
    }

    /// Groups of samples that are reported separately.
    fn sections(&self) -> Vec<Section> {
        Vec::new()
    }

    // Its samples.

    /// Number of samples in use.
    fn samples(&self) -> usize;

    /// State that the robot reports at a sample; `None` outside its log.
    fn reported(&self, sample: usize, clock: &Clock) -> Option<JointState>;

    /// Joints of the robot at each sample, as known when it was read.
    fn joints(&self) -> Vec<Joints> {
        let clock = Clock::default();
        (0..self.samples()).map(|sample| self.reported(sample, &clock).unwrap_or_default().q).collect()
    }

    /// Time of a sample on the instrument's clock, since its reference time \[s\]; `None` for rows of a robot at rest.
    fn time_s(&self, _sample: usize) -> Option<f64> {
        None
    }

    /// Time of the first sample that was measured, used or not, on the same clock \[s\]: times in messages count from it.
    fn first_s(&self) -> Option<f64> {
        self.time_s(0)
    }

    /// The alignment of the instrument's log with the robot's; `None` for an instrument that does not measure continuously.
    fn prepared(&self) -> Option<&Prepared> {
        None
    }

    /// The instrument with a part of its samples.
    fn part(&self, samples: &[usize]) -> Instrument;

    /// At most `count` groups of samples with independent errors.
    fn independent(&self, count: usize) -> Vec<Vec<usize>>;

    /// Sets the group of each sample, held out together, and the `seed` of the assignment of groups to folds.
    fn group(&mut self, _groups: &[usize], _seed: u64) {}

    /// Default way to hold samples out.
    fn hold_out(&self) -> HoldOut {
        HoldOut::Rows
    }

    /// Fewest samples of a fit with this instrument alone.
    fn samples_min(&self) -> usize {
        0
    }

    // Its parameters and residuals.

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

    /// Whether the samples separate the parameter from the others that are usually free.
    fn identifies(&self, id: ParameterId, robot: &Chain) -> bool;

    /// The samples as residuals at the parameters of the model, divided by `sigma`.
    ///
    /// # Errors
    /// [`CostError`] if the residual cannot be computed from the samples.
    fn data_set<'a>(&'a self, model: &'a Model, sigma: f64) -> Result<Box<dyn DataSet + 'a>, CostError>;

    /// Robot minus measurement in every sample, used or not; NaN outside the robot's log and for set-ups that the geometry
    /// lacks.
    fn deviations(&self, geometry: &Geometry) -> Vec<Deviation>;

    /// Sizes of [`Measures::deviations`].
    fn errors(&self, geometry: &Geometry) -> Vec<PoseError> {
        self.deviations(geometry).into_iter().map(PoseError::from).collect()
    }

    /// [`Measures::deviations`] as numbers: signed differences of lengths, or distances of positions \[m\].
    fn residuals_m(&self, geometry: &Geometry) -> Vec<f64> {
        self.deviations(geometry).iter().map(Deviation::signed_m).collect()
    }

    // The weights of its samples.

    /// Updates quantities that depend on the geometry, before a solve that starts at the model. Returns the noise of a
    /// measurement, in its unit, if the instrument estimates it: its residuals are then in standard deviations.
    fn adapt(&mut self, model: &Model) -> Option<f64>;

    /// Estimates the noise of the readings from the residuals at a solution, and weights them by it.
    fn learn_noise(&mut self, _model: &Model) {}

    /// Noise of each sample relative to the median one, from uncertainties that files state, as of the last
    /// [`Measures::adapt`].
    fn relative_noise(&self) -> Vec<f64> {
        vec![1.0; self.samples()]
    }

    /// Estimates the relative noise from these samples alone, at the model.
    fn weigh_by(&mut self, _model: &Model, _samples: &[usize]) {}

    /// Lag-one autocorrelation of the residuals, as of the last [`Measures::learn_noise`], and its standard deviation for white
    /// noise: approximately the part of the variance that is correlated.
    fn autocorrelation(&self) -> Option<[f64; 2]> {
        None
    }

    // Samples that are left out.

    /// Samples whose own data contradict each other.
    ///
    /// # Errors
    /// [`RowError`] if samples are invalid, or too few to locate the instrument.
    fn contradicting(&self, _robot: &Chain) -> Result<Vec<RejectedRow>, RowError> {
        Ok(Vec::new())
    }

    /// Leaves out samples that are outliers at the model, and includes those that no longer are. Returns whether the set of
    /// samples in use has changed.
    fn screen(&mut self, _model: &Model) -> bool {
        false
    }

    /// Whether outliers are determined again at each solve ([`Measures::screen`]).
    fn judges_gross(&self) -> bool {
        false
    }

    /// Samples that are left out of the fit.
    fn rejected(&self) -> &[RejectedRow] {
        &[]
    }

    /// Samples that cannot be measurements at the model, whether they were fitted or held out.
    fn misplaced(&self, _model: &Model) -> Vec<RejectedRow> {
        Vec::new()
    }

    /// Possible reasons, as text, why samples are left out, with the number of each sample.
    fn remarks(&self, _geometry: &Geometry) -> Vec<(usize, String)> {
        Vec::new()
    }

    // What may be wrong with the measurement or its file.

    /// Changes at one instant that can occur during a measurement.
    fn causes(&self, geometry: &Geometry) -> Vec<Cause>;

    /// Reasons why the figures at a solution may be wrong.
    fn doubts(&self, _geometry: &Geometry) -> Vec<Doubt> {
        Vec::new()
    }

    /// Mistakes that a file of this instrument can contain, for an arm with this number of axes.
    fn mistakes(&self, _axes: usize) -> Vec<Mistake> {
        Vec::new()
    }

    /// The samples with a mistake undone, one result for each direction that it can have; empty if it cannot be undone.
    fn undone(&self, _mistake: Mistake, _robot: &Chain) -> Vec<Instrument> {
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
