//! Several runs of one robot as one problem: other paths, speeds, bar lengths and places of the bar.

use super::problem::LoopPoint;
use super::{LoopProblem, Residual};
use crate::model::{Model, ParameterId, RobotMotion};
use crate::solver::{Block, Prior, Problem};

/// Where the columns of each run are among those of all runs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SharedColumns {
    /// For each run the column of each of its parameters.
    of_run: Vec<Vec<usize>>,
    names: Vec<String>,
}

impl SharedColumns {
    /// `own` tells which parameters each run has for itself; the others are those of the first run that has them. All of
    /// the first run come first, in its order; those of run `n` alone are called `ox@n`.
    pub fn new<'m>(models: impl IntoIterator<Item = &'m Model>, own: impl Fn(ParameterId) -> bool) -> Self {
        let mut shared: Vec<(ParameterId, usize)> = Vec::new();
        let mut columns = Self { of_run: Vec::new(), names: Vec::new() };
        for (run, model) in models.into_iter().enumerate() {
            let column_of = |id: ParameterId| {
                let own = own(id);
                if let Some((_, column)) = shared.iter().find(|(other, _)| !own && *other == id) {
                    return *column;
                }
                let column = columns.names.len();
                columns.names.push(if run > 0 && own { format!("{id}@{}", run + 1) } else { id.to_string() });
                if !own {
                    shared.push((id, column));
                }
                column
            };
            let of_run = model.columns().map(|parameter| parameter.id).map(column_of).collect();
            columns.of_run.push(of_run);
        }
        columns
    }

    /// Columns of one run, in the order of its model.
    pub fn of_run(&self, run: usize) -> &[usize] {
        self.of_run.get(run).map_or(&[], Vec::as_slice)
    }

    /// Names of all columns.
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// The values of one run out of those of all.
    pub fn values(&self, run: usize, x: &[f64]) -> Vec<f64> {
        self.of_run(run).iter().map(|&column| x.get(column).copied().unwrap_or_default()).collect()
    }

    /// One value for each column, from each run's own values; the first run that has a column decides.
    pub fn gather<T: Clone>(&self, of_runs: &[Vec<T>]) -> Vec<T> {
        let first = |column: usize| {
            let of_run = |(columns, values): (&Vec<usize>, &Vec<T>)| {
                let at = columns.iter().position(|own| *own == column)?;
                values.get(at).cloned()
            };
            self.of_run.iter().zip(of_runs).find_map(of_run)
        };
        (0..self.names.len()).filter_map(first).collect()
    }
}

/// Samples of all runs one after the other.
#[derive(Debug)]
pub struct SeveralRuns<'a, R, M> {
    runs: Vec<LoopProblem<'a, R, M>>,
    columns: &'a SharedColumns,
    priors: Vec<Prior>,
    /// First sample of each run, and their total.
    starts: Vec<usize>,
}

impl<'a, R: Residual, M: RobotMotion> SeveralRuns<'a, R, M> {
    /// `columns` are those of the runs' models.
    pub fn new(runs: Vec<LoopProblem<'a, R, M>>, columns: &'a SharedColumns) -> Self {
        let mut starts = vec![0];
        for run in &runs {
            starts.push(starts.last().copied().unwrap_or_default() + run.samples());
        }
        let mut priors: Vec<Prior> = Vec::new();
        for (run, problem) in runs.iter().enumerate() {
            for prior in problem.priors() {
                let Some(&column) = columns.of_run(run).get(prior.column) else { continue };
                // What is known of a shared parameter is known once.
                if priors.iter().all(|known| known.column != column) {
                    priors.push(Prior { column, ..*prior });
                }
            }
        }
        Self { runs, columns, priors, starts }
    }

    /// First sample of each run, and their total.
    pub fn starts(&self) -> &[usize] {
        &self.starts
    }
}

impl<R: Residual, M: RobotMotion> Problem for SeveralRuns<'_, R, M> {
    type Point = Vec<LoopPoint>;

    fn columns(&self) -> usize {
        self.columns.names().len()
    }

    fn column_name(&self, column: usize) -> String {
        self.columns.names().get(column).cloned().unwrap_or_else(|| format!("column {column}"))
    }

    fn samples(&self) -> usize {
        self.starts.last().copied().unwrap_or_default()
    }

    fn rows(&self) -> usize {
        R::ROWS
    }

    fn priors(&self) -> &[Prior] {
        &self.priors
    }

    fn point(&self, x: &[f64]) -> Vec<LoopPoint> {
        self.runs
            .iter()
            .enumerate()
            .map(|(run, problem)| problem.point(&self.columns.values(run, x)))
            .collect()
    }

    fn sample(
        &self,
        point: &mut Vec<LoopPoint>,
        sample: usize,
        residual: &mut [f64],
        block: &mut Block<'_>,
    ) -> bool {
        let run = self.starts.partition_point(|start| *start <= sample).saturating_sub(1);
        let (Some(problem), Some(point)) = (self.runs.get(run), point.get_mut(run)) else { return false };
        problem.sample_into(point, sample - self.starts[run], residual, block, self.columns.of_run(run))
    }
}
