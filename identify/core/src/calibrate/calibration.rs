//! What a calibration is, whatever it was measured with.

use super::change::Changed;
use super::lay_out::measured;
use super::pipeline::Solved;
use super::rows::RowSet;
use crate::instrument::{CostName, Run};
use crate::kinematics::{BAR_JOINTS, Joints};
use crate::model::{Model, ParameterId};
use crate::prepare::Prepared;
use crate::solver::{LossName, Solution};

/// A calibrated robot.
#[derive(Debug, Clone)]
pub struct Calibration {
    /// Data sets with their parameters at the solution, one at least: runs with the ball-bar, then files of rows, each in their
    /// order. The columns of the first come first in the solution.
    pub runs: Vec<Run>,
    /// What the stages of the calibration say of each file of rows.
    pub rows: Vec<RowSet>,
    /// The solve of all.
    pub solved: Solved,
    /// What did not stay while it was measured, but so little that it is not refused.
    pub changed: Vec<Changed>,
    /// How much samples counted that do not fit.
    pub loss: LossName,
}

impl Calibration {
    /// Parameters of the robot and of the first data set.
    pub fn model(&self) -> &Model {
        &self.runs[0].model
    }

    /// The solve of all data sets.
    pub fn solution(&self) -> &Solution {
        &self.solved.solution
    }

    /// Standard deviation of a parameter of the first data set, SI; none where it was fixed.
    pub fn sigma(&self, id: ParameterId) -> Option<f64> {
        let column = self.model().column_of(id)?;
        self.solution().covariance.sigma(*self.solved.columns.of_run(0).get(column)?)
    }

    /// Cost of the runs with a ball-bar.
    pub fn cost(&self) -> Option<CostName> {
        self.runs.iter().find_map(|run| run.instrument.in_unit_of())
    }

    /// What was minimised, in reports.
    pub fn cost_name(&self) -> &'static str {
        let mut names = self.runs.iter().map(|run| run.instrument.cost());
        let first = names.next().filter(|first| names.all(|name| name == *first));
        first.unwrap_or("each instrument's own")
    }

    /// Preparation and parameters of each run with a ball-bar, the first one first.
    pub fn bar_runs(&self) -> impl Iterator<Item = (&Prepared, &Model)> {
        self.runs.iter().filter_map(|run| Some((run.instrument.prepared()?, &run.model)))
    }

    /// How the logs of the first run with a ball-bar were brought together; none without any.
    pub fn prepared(&self) -> Option<&Prepared> {
        self.bar_runs().next().map(|(prepared, _)| prepared)
    }

    /// Bar joints with an encoder in every run.
    pub fn measured(&self) -> [bool; BAR_JOINTS] {
        measured(self.bar_runs().map(|(prepared, _)| prepared))
    }

    /// What the robot reports at each sample of all data sets.
    pub fn poses(&self) -> impl Iterator<Item = Joints> {
        self.runs.iter().flat_map(|run| run.instrument.poses(&run.model))
    }

    /// Copies of the data sets with at most so many samples in all, evenly taken: for figures that need no more.
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
