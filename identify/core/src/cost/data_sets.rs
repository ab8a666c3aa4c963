//! Combines the data sets of one robot into one problem for a calibration. The data sets can differ in path, bar, position
//! of the bar, or instrument.
//!
//! Each data set has an index, `run`, and its own model. A parameter that the models share, such as a link of the robot,
//! has one column in the combined problem. A parameter with a separate value in each run, such as the bar's position, has
//! one column per run.

use crate::model::{Column, Model, ParameterId};
use crate::solver::{LeastSquares, Linearisation, Prior};

/// Whitened samples of one instrument, independent of the type of residual.
pub trait DataSet: LeastSquares {
    /// As [`LeastSquares::at`], but writes the Jacobian into the columns of the combined problem. Parameter `i` of this data
    /// set is column `columns[i]` of the combined problem.
    fn at_into<'a>(&'a self, x: &[f64], columns: &'a [usize]) -> Linearisation<'a>;
}

/// Map from the columns of each run to the columns of the combined problem.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SharedColumns {
    /// For each run, the columns of its parameters in the combined problem.
    of_runs: Vec<Vec<usize>>,
    all: Vec<Column>,
}

impl SharedColumns {
    /// Assigns the columns of all models. `is_own` returns true for parameters with a separate value in each run. Any
    /// other parameter has one column, which is created for the first run that contains the parameter. The columns of the
    /// first run come first, in the order of its model.
    pub fn new<'m>(
        models: impl IntoIterator<Item = &'m Model>,
        is_own: impl Fn(ParameterId) -> bool,
    ) -> Self {
        let mut shared: Vec<(ParameterId, usize)> = Vec::new();
        let mut combined = Self { of_runs: Vec::new(), all: Vec::new() };
        for (run, model) in models.into_iter().enumerate() {
            let column_of = |id: ParameterId| {
                let is_own = is_own(id);
                if let Some((_, column)) = shared.iter().find(|(other, _)| !is_own && *other == id) {
                    return *column;
                }
                let column = combined.all.len();
                combined.all.push(Column { id, data_set: if is_own { run } else { 0 } });
                if !is_own {
                    shared.push((id, column));
                }
                column
            };
            let columns = model.columns().map(|parameter| parameter.id).map(column_of).collect();
            combined.of_runs.push(columns);
        }
        combined
    }

    /// Combined columns of one run, in the order of its model.
    pub fn of_run(&self, run: usize) -> &[usize] {
        self.of_runs.get(run).map_or(&[], Vec::as_slice)
    }

    /// The combined columns, in the order of the solution's values.
    pub fn all(&self) -> &[Column] {
        &self.all
    }

    /// The parameter values of one run, selected from the values `x` of the combined problem.
    pub fn values(&self, run: usize, x: &[f64]) -> Vec<f64> {
        self.of_run(run).iter().map(|&column| x.get(column).copied().unwrap_or_default()).collect()
    }

    /// Converts values from the columns of each run to the combined columns. For a column that several runs share,
    /// the value of the first of these runs is used.
    pub fn gather<T: Clone>(&self, values_of_runs: &[Vec<T>]) -> Vec<T> {
        let first_value = |column: usize| {
            let value_in_run = |(columns, values): (&Vec<usize>, &Vec<T>)| {
                let index = columns.iter().position(|combined| *combined == column)?;
                values.get(index).cloned()
            };
            self.of_runs.iter().zip(values_of_runs).find_map(value_in_run)
        };
        (0..self.all.len()).filter_map(first_value).collect()
    }
}

/// The samples of all data sets, one set after the other.
pub struct CombinedDataSets<'a> {
    sets: Vec<Box<dyn DataSet + 'a>>,
    columns: &'a SharedColumns,
    /// Largest number of residuals of a sample.
    rows: usize,
    priors: Vec<Prior>,
    /// Index of the first sample of each set, then the total number of samples.
    starts: Vec<usize>,
}

impl<'a> CombinedDataSets<'a> {
    /// Combines data sets. `columns` was built from the models of these sets, in the same order.
    pub fn new(sets: Vec<Box<dyn DataSet + 'a>>, columns: &'a SharedColumns) -> Self {
        let mut starts = vec![0];
        for set in &sets {
            starts.push(starts.last().copied().unwrap_or_default() + set.samples());
        }
        let mut priors: Vec<Prior> = Vec::new();
        for (run, set) in sets.iter().enumerate() {
            for prior in set.priors() {
                let Some(&column) = columns.of_run(run).get(prior.column) else { continue };
                // The prior of a shared parameter is used once, although each run has it.
                if priors.iter().all(|known| known.column != column) {
                    priors.push(Prior { column, ..*prior });
                }
            }
        }
        let rows = sets.iter().map(|set| set.rows()).max().unwrap_or_default();
        Self { sets, columns, rows, priors, starts }
    }

    /// Index of the first sample of each set, then the total number of samples.
    pub fn starts(&self) -> &[usize] {
        &self.starts
    }

    /// Index of the set to which a sample belongs.
    fn set_index(&self, sample: usize) -> usize {
        self.starts.partition_point(|start| *start <= sample).saturating_sub(1)
    }

    /// The set to which a sample belongs, and the sample's index in it.
    fn locate(&self, sample: usize) -> Option<(&(dyn DataSet + 'a), usize)> {
        let set = self.set_index(sample);
        Some((self.sets.get(set)?.as_ref(), sample - self.starts[set]))
    }
}

impl LeastSquares for CombinedDataSets<'_> {
    fn columns(&self) -> usize {
        self.columns.all().len()
    }

    fn column_name(&self, column: usize) -> String {
        self.columns.all().get(column).map_or_else(|| format!("column {column}"), ToString::to_string)
    }

    fn samples(&self) -> usize {
        self.starts.last().copied().unwrap_or_default()
    }

    fn rows(&self) -> usize {
        self.rows
    }

    fn rows_of(&self, sample: usize) -> usize {
        self.locate(sample).map_or(0, |(set, sample)| set.rows_of(sample))
    }

    fn is_known(&self, sample: usize) -> bool {
        self.locate(sample).is_some_and(|(set, sample)| set.is_known(sample))
    }

    fn priors(&self) -> &[Prior] {
        &self.priors
    }

    fn at<'a>(&'a self, x: &[f64]) -> Linearisation<'a> {
        let sets = self.sets.iter().enumerate();
        let mut linearisations: Vec<Linearisation<'a>> = sets
            .map(|(run, set)| set.at_into(&self.columns.values(run, x), self.columns.of_run(run)))
            .collect();
        Box::new(move |sample, residual, block| {
            let run = self.set_index(sample);
            let linearise = linearisations.get_mut(run);
            linearise.is_some_and(|linearise| linearise(sample - self.starts[run], residual, block))
        })
    }
}
