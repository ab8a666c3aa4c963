//! The result of a calibration, independent of the type of its instruments.

use super::change::Changed;
use super::contradicted::Contradicted;
use super::lay_out::measured;
use super::pipeline::Solved;
use super::rows::RowSet;
use crate::instrument::{CostName, Run};
use crate::kinematics::{BAR_JOINTS, Joints};
use crate::model::{Model, ParameterId};
use crate::prepare::Prepared;
use crate::solver::{LossName, Solution};

/// A calibrated robot, with the data sets and the solve from which it was computed.
#[derive(Debug, Clone)]
pub struct Calibration {
    /// One or more data sets, with their models at the solution. Ball-bar runs are first, followed by the files of rows,
    /// each in the order of the input. The estimated parameters of the first data set are the first columns of the solution.
    pub runs: Vec<Run>,
    /// For each file of rows: the errors after each stage, the rejected rows and the drift.
    pub rows: Vec<RowSet>,
    /// The joint solve of all data sets.
    pub solved: Solved,
    /// Priors that the samples contradict, and the scale of all lengths if the samples contradict it. The covariance in
    /// `solved` already includes these contradictions.
    pub contradicted: Contradicted,
    /// Changes during the measurement that were detected but did not cause a refusal.
    pub changed: Vec<Changed>,
    /// Robust loss, which reduces the weight of samples with large residuals.
    pub loss: LossName,
}

impl Calibration {
    /// Parameters of the robot and of the first data set.
    pub fn model(&self) -> &Model {
        &self.runs[0].model
    }

    /// Solution of the joint solve.
    pub fn solution(&self) -> &Solution {
        &self.solved.solution
    }

    /// Standard deviation of a parameter of the first data set, SI. `None` if the parameter was not estimated.
    pub fn sigma(&self, id: ParameterId) -> Option<f64> {
        let column = self.model().column_of(id)?;
        self.solution().covariance.sigma(*self.solved.columns.of_run(0).get(column)?)
    }

    /// Cost of the ball-bar runs. `None` without ball-bar runs.
    pub fn cost(&self) -> Option<CostName> {
        self.runs.iter().find_map(|run| run.instrument.residual_unit_of())
    }

    /// Name of the minimised cost, for reports.
    pub fn cost_name(&self) -> &'static str {
        let mut names = self.runs.iter().map(|run| run.instrument.cost());
        let first = names.next().filter(|first| names.all(|name| name == *first));
        first.unwrap_or("each instrument's own")
    }

    /// Preparation and parameters of each ball-bar run, in order.
    pub fn bar_runs(&self) -> impl Iterator<Item = (&Prepared, &Model)> {
        self.runs.iter().filter_map(|run| Some((run.instrument.prepared()?, &run.model)))
    }

    /// Preparation of the first ball-bar run, which contains the alignment of its logs. `None` without ball-bar runs.
    pub fn prepared(&self) -> Option<&Prepared> {
        self.bar_runs().next().map(|(prepared, _)| prepared)
    }

    /// For each bar joint, whether it has an encoder in every run.
    pub fn measured(&self) -> [bool; BAR_JOINTS] {
        measured(self.bar_runs().map(|(prepared, _)| prepared))
    }

    /// Whether the encoders give the position of the bar's end: those of the first two joints exist in every run.
    pub fn measures_end(&self) -> bool {
        let [first, second, ..] = self.measured();
        first && second
    }

    /// Joint positions that the robot reported at each sample of all data sets.
    pub fn poses(&self) -> impl Iterator<Item = Joints> {
        self.runs.iter().flat_map(|run| run.instrument.poses(&run.model))
    }

    /// Copies of the data sets, thinned to about `samples_max` samples in total. Used for
    /// statistics that do not need all samples.
    pub(super) fn thinned(&self, samples_max: usize) -> Vec<Run> {
        let samples: usize = self.runs.iter().map(|run| run.instrument.samples()).sum();
        let every = samples.div_ceil(samples_max.max(1)).max(1);
        let thinned = |run: &Run| Run {
            instrument: run
                .instrument
                .part(&(0..run.instrument.samples()).step_by(every).collect::<Vec<_>>()),
            model: run.model.clone(),
        };
        self.runs.iter().map(thinned).collect()
    }
}
