//! The trait [`Measures`]: the functions of an instrument that the estimator, the checks of the data and the reports use.
//! Most functions have a default, which is that of an instrument without the feature.

use std::fmt;

use super::{
    Boxed, Cause, CostName, Deviation, HoldOut, Instrument, Mistake, Noise, PoseError, RejectedRow, RowError,
    ScaleFrom, Section,
};
use crate::cost::{CostError, DataSet};
use crate::kinematics::{Chain, Joints};
use crate::model::{ClockRelation, Geometry, JointState, Model, ModelError, ParameterId};
use crate::prepare::Prepared;

/// The interface of an instrument to the estimator.
pub trait Measures: Boxed + fmt::Debug + Send + Sync {
    // Description of the instrument.

    /// Name in messages and files.
    fn name(&self) -> &'static str;

    /// Name of the minimised cost.
    fn cost(&self) -> &'static str;

    /// The cost that defines the unit of the residuals. `None` for all instruments except the ball-bar. The solver then
    /// estimates the noise of each data set, and residuals are in standard deviations.
    fn residual_unit_of(&self) -> Option<CostName> {
        None
    }

    /// Quantity that determines the scale of all lengths.
    fn scale(&self) -> ScaleFrom;

    /// Standard deviation of a reading of the median sample, at the last solution. It must be
    /// multiplied by the sigma of the data set.
    fn noise(&self) -> Noise;

    /// Name of the instrument's own parameters in tables, such as `tip and faces`.
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
    fn reported(&self, sample: usize, clock: &ClockRelation) -> Option<JointState>;

    /// Joints of the robot at each sample, before a fit changes the clock.
    fn joints(&self) -> Vec<Joints> {
        let clock = ClockRelation::default();
        (0..self.samples()).map(|sample| self.reported(sample, &clock).unwrap_or_default().q).collect()
    }

    /// Time of a sample on the instrument's clock, relative to the reference time \[s\]. `None` if
    /// the robot stood still at each row.
    fn time_s(&self, _sample: usize) -> Option<f64> {
        None
    }

    /// Time of the first measured sample on the same clock \[s\], even if the sample is not used. Times in
    /// messages are relative to this time.
    fn first_s(&self) -> Option<f64> {
        self.time_s(0)
    }

    /// Alignment of the instrument's log with the robot's. `None` for instruments that do not measure continuously.
    fn prepared(&self) -> Option<&Prepared> {
        None
    }

    /// Copies the instrument with only these samples.
    fn part(&self, samples: &[usize]) -> Instrument;

    /// Divides the samples into at most `count` groups. The errors of different groups are independent.
    fn independent(&self, count: usize) -> Vec<Vec<usize>>;

    /// Sets the group of each sample. All samples of a group are held out together. Groups are
    /// assigned to folds at random, with `seed`.
    fn group(&mut self, _groups: &[usize], _seed: u64) {}

    /// What is held out together by default.
    fn hold_out(&self) -> HoldOut {
        HoldOut::Rows
    }

    /// Minimum number of samples for a calibration with this instrument alone.
    fn samples_min(&self) -> usize {
        0
    }

    // Parameters and residuals.

    /// Adds the parameters of the instrument to the model of a robot, with the value zero.
    fn fitted_out(&self, robot: Model) -> Model {
        robot
    }

    /// Estimates start values of the instrument's parameters for the robot of the model. Frees the instrument's parameters
    /// that are not in `fix`. Returns false if the samples do not determine start values.
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

    /// Robot minus measurement of every sample, including samples that are not used. NaN if the sample is outside the
    /// robot's log, or if the geometry does not contain its station or target.
    fn deviations(&self, geometry: &Geometry) -> Vec<Deviation>;

    /// Absolute sizes of [`Measures::deviations`].
    fn errors(&self, geometry: &Geometry) -> Vec<PoseError> {
        self.deviations(geometry).into_iter().map(PoseError::from).collect()
    }

    /// [`Measures::deviations`] as one number for each sample: signed difference of lengths, or distance of positions \[m\].
    fn residuals_m(&self, geometry: &Geometry) -> Vec<f64> {
        self.deviations(geometry).iter().map(Deviation::signed_m).collect()
    }

    // Weights of the samples.

    /// Updates quantities that depend on the geometry. Called before each solve, with the start model of the solve. If the
    /// instrument estimates its noise, returns the noise of a measurement in the unit of the instrument. In this case its
    /// residuals are in standard deviations.
    fn adapt(&mut self, model: &Model) -> Option<f64>;

    /// Estimates the noise of the readings from the residuals at a solution. Afterwards
    /// residuals are weighted with this noise.
    fn learn_noise(&mut self, _model: &Model) {}

    /// Noise of each sample relative to the median sample, from uncertainties that the file states. The
    /// last [`Measures::adapt`] computed it.
    fn relative_noise(&self) -> Vec<f64> {
        vec![1.0; self.samples()]
    }

    /// Estimates the relative noise from the residuals of these samples at the model.
    fn weigh_by(&mut self, _model: &Model, _samples: &[usize]) {}

    /// Lag-one autocorrelation of the residuals, and its standard deviation if the noise were white. The last
    /// [`Measures::learn_noise`] computed it. The autocorrelation is approximately the correlated fraction of the variance.
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

    /// Determines again which samples are outliers at the model. Excludes outliers and uses all other samples. Returns
    /// whether the set of used samples has changed.
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

    /// Samples that cannot be measurements of this model, among all samples, fitted or held out.
    fn misplaced(&self, _model: &Model) -> Vec<RejectedRow> {
        Vec::new()
    }

    /// Possible reasons why samples were excluded: the number of each sample and a text.
    fn remarks(&self, _geometry: &Geometry) -> Vec<(usize, String)> {
        Vec::new()
    }

    // Possible errors of the measurement or its file.

    /// Causes of a change that this instrument can have during a measurement.
    fn causes(&self, geometry: &Geometry) -> Vec<Cause>;

    /// Reasons why the results at a solution may be wrong, as sentences with a remedy for the report.
    fn doubts(&self, _geometry: &Geometry) -> Vec<String> {
        Vec::new()
    }

    /// Mistakes that a file of this instrument can contain. `axes` is the number of axes of the robot.
    fn mistakes(&self, _axes: usize) -> Vec<Mistake> {
        Vec::new()
    }

    /// The samples after a mistake is corrected. If the mistake can have two directions, there is a result for each. Empty
    /// if the samples do not contain what must be corrected.
    fn undone(&self, _mistake: Mistake, _robot: &Chain) -> Vec<Instrument> {
        Vec::new()
    }

    /// Measured lengths \[m\]; empty for instruments without lengths.
    fn lengths_m(&self) -> Vec<f64> {
        Vec::new()
    }

    /// The instrument with changed lengths: `by_m` contains the increase of each length \[m\].
    /// `None` for instruments without lengths.
    fn longer_by(&self, _by_m: &[f64]) -> Option<Instrument> {
        None
    }
}
