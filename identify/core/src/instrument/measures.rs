//! The trait [`Measures`]: the functions of an instrument that the estimator, its checks and the reports use. Most
//! functions have a default for instruments without the feature.

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
    // Description of the instrument.

    /// Name in messages and files.
    fn name(&self) -> &'static str;

    /// Name of the minimised cost.
    fn cost(&self) -> &'static str;

    /// The cost that defines the unit of the residuals. `None` for instruments other than the ball-bar: the solver then
    /// estimates a noise for each data set, and residuals are in standard deviations.
    fn residual_unit_of(&self) -> Option<CostName> {
        None
    }

    /// Quantity that determines the scale of all lengths.
    fn scale(&self) -> ScaleFrom;

    /// Standard deviation of a reading of the median sample at the last solution. Multiply by the sigma of the data set.
    fn noise(&self) -> Noise;

    /// Name, in tables, of the parts that are fitted in addition to the robot.
    fn parts(&self) -> &'static str {
        self.name()
    }

    /// Groups of samples that are reported separately.
    fn sections(&self) -> Vec<Section> {
        Vec::new()
    }

    // The samples.

    /// Number of samples in use.
    fn samples(&self) -> usize;

    /// State that the robot reports at a sample; `None` outside its log.
    fn reported(&self, sample: usize, clock: &Clock) -> Option<JointState>;

    /// Joints of the robot at each sample, before any fit changes the clock.
    fn joints(&self) -> Vec<Joints> {
        let clock = Clock::default();
        (0..self.samples()).map(|sample| self.reported(sample, &clock).unwrap_or_default().q).collect()
    }

    /// Time of a sample on the instrument's clock, relative to the reference time \[s\]. `None` for rows of
    /// a robot at rest.
    fn time_s(&self, _sample: usize) -> Option<f64> {
        None
    }

    /// Time of the first measured sample, whether it is used or not, on the same clock \[s\]. Times in messages
    /// are relative to it.
    fn first_s(&self) -> Option<f64> {
        self.time_s(0)
    }

    /// Alignment of the instrument's log with the robot's. `None` for instruments that do not measure continuously.
    fn prepared(&self) -> Option<&Prepared> {
        None
    }

    /// Copies the instrument with only these samples.
    fn part(&self, samples: &[usize]) -> Instrument;

    /// Divides the samples into at most `count` groups whose errors are independent of each other.
    fn independent(&self, count: usize) -> Vec<Vec<usize>>;

    /// Sets the group of each sample. Samples of a group are held out together. `seed` is that of the random assignment
    /// of groups to folds.
    fn group(&mut self, _groups: &[usize], _seed: u64) {}

    /// How samples are held out by default.
    fn hold_out(&self) -> HoldOut {
        HoldOut::Rows
    }

    /// Minimum number of samples for a fit with this instrument alone.
    fn samples_min(&self) -> usize {
        0
    }

    // Parameters and residuals.

    /// Adds the parameters of the instrument to the model of a robot. Their values are zero.
    fn fitted_out(&self, robot: Model) -> Model {
        robot
    }

    /// Estimates start values of the instrument's parameters, for the robot of the model. Frees those that are not in
    /// `fix`. Returns false if the samples do not determine start values.
    ///
    /// # Errors
    /// [`ModelError`] if the model was made for another instrument.
    fn place(&self, model: &mut Model, fix: &[ParameterId]) -> Result<bool, ModelError>;

    /// Whether the samples can separate this parameter from the other parameters that are usually free.
    fn identifies(&self, id: ParameterId, robot: &Chain) -> bool;

    /// The residuals of the samples, divided by `sigma`, as a function of the free parameters of the model.
    ///
    /// # Errors
    /// [`CostError`] if the samples lack data that the residuals need.
    fn data_set<'a>(&'a self, model: &'a Model, sigma: f64) -> Result<Box<dyn DataSet + 'a>, CostError>;

    /// Robot minus measurement of every sample, whether it is used or not. NaN outside the robot's log, and for stations or
    /// targets that the geometry does not contain.
    fn deviations(&self, geometry: &Geometry) -> Vec<Deviation>;

    /// Absolute sizes of [`Measures::deviations`].
    fn errors(&self, geometry: &Geometry) -> Vec<PoseError> {
        self.deviations(geometry).into_iter().map(PoseError::from).collect()
    }

    /// [`Measures::deviations`] as one number each: signed difference of lengths, or distance of positions \[m\].
    fn residuals_m(&self, geometry: &Geometry) -> Vec<f64> {
        self.deviations(geometry).iter().map(Deviation::signed_m).collect()
    }

    // Weights of the samples.

    /// Updates quantities that depend on the geometry. Called before a solve, which starts at the model. If the
    /// instrument estimates its noise, returns the noise of a measurement in its unit. Residuals are in standard
    /// deviations in this case.
    fn adapt(&mut self, model: &Model) -> Option<f64>;

    /// Estimates the noise of the readings from the residuals at a solution. Later residuals are weighted with this noise.
    fn learn_noise(&mut self, _model: &Model) {}

    /// Noise of each sample relative to the median sample, from uncertainties that the file states. Computed
    /// by the last [`Measures::adapt`].
    fn relative_noise(&self) -> Vec<f64> {
        vec![1.0; self.samples()]
    }

    /// Estimates the relative noise at the model, from these samples alone.
    fn weigh_by(&mut self, _model: &Model, _samples: &[usize]) {}

    /// Lag-one autocorrelation of the residuals, and its standard deviation for white noise. Computed by the last
    /// [`Measures::learn_noise`]. The autocorrelation is approximately the correlated fraction of the variance.
    fn autocorrelation(&self) -> Option<[f64; 2]> {
        None
    }

    // Samples that are excluded.

    /// Finds samples whose own data contradict each other.
    ///
    /// # Errors
    /// [`RowError`] if samples are invalid, or too few to determine the pose of the instrument.
    fn contradicting(&self, _robot: &Chain) -> Result<Vec<RejectedRow>, RowError> {
        Ok(Vec::new())
    }

    /// Excludes samples that are outliers at the model. Uses samples again that are not outliers any more. Returns whether
    /// the set of used samples has changed.
    fn screen(&mut self, _model: &Model) -> bool {
        false
    }

    /// Whether outliers are determined again after each solve, by [`Measures::screen`].
    fn judges_gross(&self) -> bool {
        false
    }

    /// Samples that are excluded from the fit.
    fn rejected(&self) -> &[RejectedRow] {
        &[]
    }

    /// Samples that cannot be measurements of this model, whether they were fitted or held out.
    fn misplaced(&self, _model: &Model) -> Vec<RejectedRow> {
        Vec::new()
    }

    /// Possible reasons why samples are excluded, as text, with the number of each sample.
    fn remarks(&self, _geometry: &Geometry) -> Vec<(usize, String)> {
        Vec::new()
    }

    // Possible errors of the measurement or its file.

    /// Parts that can change at one instant during a measurement.
    fn causes(&self, geometry: &Geometry) -> Vec<Cause>;

    /// Reasons why the results at a solution may be wrong.
    fn doubts(&self, _geometry: &Geometry) -> Vec<Doubt> {
        Vec::new()
    }

    /// Mistakes that a file of this instrument can contain. `axes` is the number of axes of the robot.
    fn mistakes(&self, _axes: usize) -> Vec<Mistake> {
        Vec::new()
    }

    /// The samples with a mistake corrected. If the mistake can have two directions, a result for each. Empty if it cannot
    /// be corrected in the samples.
    fn undone(&self, _mistake: Mistake, _robot: &Chain) -> Vec<Instrument> {
        Vec::new()
    }

    /// Measured lengths \[m\]; empty for instruments without lengths.
    fn lengths_m(&self) -> Vec<f64> {
        Vec::new()
    }

    /// The instrument with each length increased by its entry of `by_m` \[m\]. `None` for instruments without lengths.
    fn longer_by(&self, _by_m: &[f64]) -> Option<Instrument> {
        None
    }
}
