//! Normal equations of the runs at their models, and the covariance of a solution. Steps of `pipeline::estimate`; `selection` tests
//! terms with the same normal equations.

use nalgebra::DMatrix;

use super::error::CalibrateError;
use super::pipeline::{LEFT_OUT, Solver, is_own, problem_with_models};
use crate::cost::{CostError, SharedColumns};
use crate::instrument::Run;
use crate::model::{Model, Parameter, ParameterId, Role};
use crate::solver::{Considered, Covariance, Loss, Normals, Options, Solution, Source, influence};

/// Models of all runs, which may estimate more parameters than those of the solve, and the map of their columns.
struct Models {
    of_runs: Vec<Model>,
    columns: SharedColumns,
}

impl Models {
    /// Values of the columns.
    fn start(&self) -> Vec<f64> {
        self.columns.gather(&self.of_runs.iter().map(Model::start).collect::<Vec<_>>())
    }
}

/// The prior that includes a considered term; `None` for other parameters.
fn prior_of_term(parameter: &Parameter, sigma: f64) -> Option<Role> {
    parameter.id.term().map(|_| Role::Prior { value: parameter.value, sigma })
}

/// For each column of `model` the standard deviation of its parameter, if the run has it as [`Role::Considered`]; otherwise zero.
fn considered_sigmas(model: &Model, run: &Run) -> Vec<f64> {
    let sigma = |column: &Parameter| match run.model.role(column.id) {
        Some(Role::Considered { sigma }) => sigma,
        _ => 0.0,
    };
    model.columns().map(sigma).collect()
}

impl Solver<'_> {
    /// The models of the runs, each changed by `change`.
    fn models(&self, change: impl Fn(&Model) -> Model) -> Models {
        let of_runs: Vec<Model> = self.runs.iter().map(|run| change(&run.model)).collect();
        let columns = SharedColumns::new(&of_runs, |id| is_own(id, &self.own_lengths));
        Models { of_runs, columns }
    }

    /// Normal equations of the independent groups of all runs at the models' values, and the run of each group; `None` if
    /// residuals are not finite.
    fn normals(
        &self,
        models: &Models,
        loss: Loss,
        count: usize,
    ) -> Result<Option<(Normals, Vec<usize>)>, CostError> {
        let problem = problem_with_models(self.runs, &models.of_runs, &models.columns, &self.sigmas)?;
        let (mut of_run, mut groups) = (Vec::new(), Vec::new());
        for (number, (run, start)) in self.runs.iter().zip(problem.starts()).enumerate() {
            for group in run.instrument.independent(count) {
                of_run.push(number);
                groups.push(group.into_iter().map(|sample| start + sample).collect());
            }
        }
        let options = Options { loss, ..Options::default() };
        let normals = Normals::new(&problem, &models.start(), &options, &groups).ok();
        Ok(normals.map(|normals| (normals, of_run)))
    }

    /// The free columns, their parameters, and [`Self::normals`] at the current models.
    pub(super) fn normals_here(
        &self,
        loss: Loss,
        count: usize,
    ) -> Result<(SharedColumns, Vec<ParameterId>, Option<Normals>), CostError> {
        let models = self.models(Model::clone);
        let normals = self.normals(&models, loss, count)?.map(|(normals, _)| normals);
        let ids_of = |model: &Model| model.columns().map(|parameter| parameter.id).collect();
        let ids: Vec<Vec<ParameterId>> = models.of_runs.iter().map(ids_of).collect();
        let ids = models.columns.gather(&ids);
        Ok((models.columns, ids, normals))
    }

    /// Covariance of the solution: by the jackknife if there are enough groups, with the contribution of parameters that are
    /// fixed at uncertain values.
    ///
    /// It is unknown whether excluded terms exist. With these terms and their priors, both the covariance and the solution
    /// differ, and both differences are included (the mean squared error of a solution without them, if they are as expected).
    pub(super) fn covariance(
        &self,
        columns: &SharedColumns,
        solution: &Solution,
    ) -> Result<Covariance, CalibrateError> {
        self.begins("uncertainty");
        let mut covariance = solution.covariance.clone();
        let models = self.models(|model| model.with_considered(prior_of_term));
        let all = models.columns.names();
        let column_in_all = |name: &String| all.iter().position(|other| other == name);
        let estimated: Vec<usize> = columns.names().iter().filter_map(column_in_all).collect();
        let left_out: Vec<usize> = (0..all.len()).filter(|column| !estimated.contains(column)).collect();
        if let Some((normals, of_run)) = self.normals(&models, solution.loss, LEFT_OUT)?
            && let Some(mut spread) = normals.jackknife(|group| of_run[group])
        {
            if !left_out.is_empty()
                && let Some(step) = normals.step()
            {
                spread.add(Source::LeftOut, &step);
            }
            let names = left_out.iter().map(|column| all[*column].clone()).collect();
            covariance = covariance.by_jackknife(spread.of(&estimated, &left_out), normals.folds(), names);
        }
        Ok(match self.considered(columns, solution.loss)? {
            Some(considered) => covariance.with_considered(considered),
            None => covariance,
        })
    }

    /// Effect of the errors of [`Role::Considered`] parameters on the solution; `None` if there are none.
    fn considered(&self, columns: &SharedColumns, loss: Loss) -> Result<Option<Considered>, CalibrateError> {
        // `Self::covariance` includes considered terms with their priors.
        let free = |parameter: &Parameter, _| parameter.id.term().is_none().then_some(Role::Free);
        let models = self.models(|model| model.with_considered(free));
        let all = models.columns.names();
        let column_of = |name: &String| columns.names().iter().position(|other| other == name);
        let considered: Vec<usize> =
            (0..all.len()).filter(|column| column_of(&all[*column]).is_none()).collect();
        if considered.is_empty() {
            return Ok(None);
        }
        let sigmas = models.of_runs.iter().zip(&*self.runs).map(|(model, run)| considered_sigmas(model, run));
        let sigmas = models.columns.gather(&sigmas.collect::<Vec<_>>());
        let problem = problem_with_models(self.runs, &models.of_runs, &models.columns, &self.sigmas)?;
        let options = Options { loss, ..Options::default() };
        let found = influence(&problem, &models.start(), &considered, &options)?;
        let mut change = DMatrix::zeros(columns.names().len(), considered.len());
        for (row, name) in found.estimated.iter().enumerate() {
            if let Some(column) = column_of(name) {
                change.row_mut(column).copy_from(&found.change.row(row));
            }
        }
        let sigmas = considered.iter().map(|column| sigmas[*column]).collect();
        Ok(Some(Considered { names: found.held, sigmas, change }))
    }
}
