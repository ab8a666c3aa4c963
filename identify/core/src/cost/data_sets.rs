//! Data sets of one robot as one problem: different paths, bars, positions of the bar, or instruments.

use crate::model::{Model, ParameterId};
use crate::solver::{Linearisation, Prior, Problem};

/// Whitened samples of one instrument, independent of the type of residual.
pub trait DataSet: Problem {
    /// [`Problem::at`], with the derivatives by each parameter in a column that the caller chooses.
    fn at_into<'a>(&'a self, x: &[f64], columns: &'a [usize]) -> Linearisation<'a>;
}

/// Map from the columns of each run to the columns of the joint problem.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SharedColumns {
    /// For each run, the joint column of each of its parameters.
    of_run: Vec<Vec<usize>>,
    names: Vec<String>,
}

impl SharedColumns {
    /// `own` returns true for parameters that each run has for itself; all others are shared with the first run that has them.
    /// Columns of the first run are first, in its order. Parameters that belong to run `n` only are named `ox@n`.
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

    /// Joint columns of one run, in the order of its model.
    pub fn of_run(&self, run: usize) -> &[usize] {
        self.of_run.get(run).map_or(&[], Vec::as_slice)
    }

    /// Names of all joint columns.
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// The parameter values of one run, from those of the joint problem.
    pub fn values(&self, run: usize, x: &[f64]) -> Vec<f64> {
        self.of_run(run).iter().map(|&column| x.get(column).copied().unwrap_or_default()).collect()
    }

    /// One value per joint column, from each run's own values. The first run that has a column provides its value.
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

/// The samples of all data sets, one set after the other.
pub struct DataSets<'a> {
    sets: Vec<Box<dyn DataSet + 'a>>,
    columns: &'a SharedColumns,
    rows: usize,
    priors: Vec<Prior>,
    /// Index of the first sample of each set, then the total number of samples.
    starts: Vec<usize>,
}

impl<'a> DataSets<'a> {
    /// Combines data sets; `columns` are those of the models of the sets.
    pub fn new(sets: Vec<Box<dyn DataSet + 'a>>, columns: &'a SharedColumns) -> Self {
        let mut starts = vec![0];
        for set in &sets {
            starts.push(starts.last().copied().unwrap_or_default() + set.samples());
        }
        let mut priors: Vec<Prior> = Vec::new();
        for (run, set) in sets.iter().enumerate() {
            for prior in set.priors() {
                let Some(&column) = columns.of_run(run).get(prior.column) else { continue };
                // A prior of a shared parameter counts once.
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

    fn set_of(&self, sample: usize) -> usize {
        self.starts.partition_point(|start| *start <= sample).saturating_sub(1)
    }

    fn in_set(&self, sample: usize) -> Option<(&(dyn DataSet + 'a), usize)> {
        let set = self.set_of(sample);
        Some((self.sets.get(set)?.as_ref(), sample - self.starts[set]))
    }
}

impl Problem for DataSets<'_> {
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
        self.rows
    }

    fn rows_of(&self, sample: usize) -> usize {
        self.in_set(sample).map_or(0, |(set, sample)| set.rows_of(sample))
    }

    fn is_known(&self, sample: usize) -> bool {
        self.in_set(sample).is_some_and(|(set, sample)| set.is_known(sample))
    }

    fn priors(&self) -> &[Prior] {
        &self.priors
    }

    fn at<'a>(&'a self, x: &[f64]) -> Linearisation<'a> {
        let numbered = self.sets.iter().enumerate();
        let mut of_sets: Vec<Linearisation<'a>> = numbered
            .map(|(run, set)| set.at_into(&self.columns.values(run, x), self.columns.of_run(run)))
            .collect();
        Box::new(move |sample, residual, block| {
            let run = self.set_of(sample);
            of_sets.get_mut(run).is_some_and(|set| set(sample - self.starts[run], residual, block))
        })
    }
}
