//! Normal equations of the runs at the values of their models, and the covariance of a solution. `pipeline::estimate`
//! computes the covariance as its last step. `selection` uses the same normal equations to test error terms.

use nalgebra::DMatrix;

use super::error::CalibrateError;
use super::pipeline::{LEFT_OUT, Solver, is_own, problem_with_models};
use crate::cost::{CostError, SharedColumns};
use crate::instrument::Run;
use crate::model::{Column, Model, Parameter, ParameterId, Role};
use crate::solver::{Considered, Loss, Normals, Options, SigmasFrom, Solution, UncertaintySource, influence};

/// Models of all runs, and the map from the columns of each model to the columns of the joint problem. These models may have
/// more free parameters than the models of the solve.
struct Models {
    of_runs: Vec<Model>,
    columns: SharedColumns,
}

impl Models {
    /// Current values of all columns.
    fn start(&self) -> Vec<f64> {
        self.columns.gather(&self.of_runs.iter().map(Model::start).collect::<Vec<_>>())
    }
}

/// Prior with which a considered error term is estimated. `None` if the parameter is not an error
/// term. Such a parameter stays fixed.
fn prior_of_term(parameter: &Parameter, sigma: f64) -> Option<Role> {
    parameter.id.term().map(|_| Role::Prior { value: parameter.value, sigma })
}

/// Standard deviations of the parameters of the columns of `model`. The entry of a parameter is zero if the parameter is
/// not [`Role::Considered`] in the run.
fn considered_sigmas(model: &Model, run: &Run) -> Vec<f64> {
    let sigma = |column: &Parameter| match run.model.role(column.id) {
        Some(Role::Considered { sigma }) => sigma,
        _ => 0.0,
    };
    model.columns().map(sigma).collect()
}

impl Solver<'_> {
    /// Copies the models of the runs and changes each copy by `change`.
    fn models(&self, change: impl Fn(&Model) -> Model) -> Models {
        let of_runs: Vec<Model> = self.runs.iter().map(|run| change(&run.model)).collect();
        let columns = SharedColumns::new(&of_runs, |id| is_own(id, &self.own_lengths));
        Models { of_runs, columns }
    }

    /// Normal equations of all runs at the values of `models`, one for each independent group of samples.
    /// Also returns, for each group, the index of its run. `count` is the maximum number of groups of a run.
    /// `None` if residuals are not finite.
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

    /// The columns of the current models, the parameter of each column, and [`Self::normals`] at the current models.
    pub(super) fn normals_here(
        &self,
        loss: Loss,
        count: usize,
    ) -> Result<(SharedColumns, Vec<ParameterId>, Option<Normals>), CostError> {
        let models = self.models(Model::clone);
        let normals = self.normals(&models, loss, count)?.map(|(normals, _)| normals);
        let ids = models.columns.all().iter().map(|column| column.id).collect();
        Ok((models.columns, ids, normals))
    }

    /// Sets the covariance of the solution and returns the columns of the covariance. If there are enough groups, the
    /// covariance is computed by the jackknife. It includes the errors of parameters that are fixed at uncertain values.
    ///
    /// It is unknown whether excluded error terms exist. If they were estimated with their priors, the covariance and the
    /// solution would both change. The result includes both changes. If the priors are correct, the result is the mean
    /// squared error of a solution without these terms.
    pub(super) fn add_covariance(
        &self,
        columns: &SharedColumns,
        solution: &mut Solution,
    ) -> Result<Vec<Column>, CalibrateError> {
        self.begins("uncertainty");
        // `all` contains the columns of the solution and the columns of excluded error terms. `estimated` and `left_out` are
        // the indices of these two groups of columns in `all`.
        let mut of_covariance = columns.all().to_vec();
        let models = self.models(|model| model.with_considered(prior_of_term));
        let all = models.columns.all();
        let column_in_all = |column: &Column| all.iter().position(|other| other == column);
        let estimated: Vec<usize> = columns.all().iter().filter_map(column_in_all).collect();
        let left_out: Vec<usize> = (0..all.len()).filter(|column| !estimated.contains(column)).collect();
        if let Some((normals, of_run)) = self.normals(&models, solution.loss, LEFT_OUT)?
            && let Some(mut spread) = normals.jackknife(|group| of_run[group])
        {
            if !left_out.is_empty()
                && let Some(step) = normals.step()
            {
                spread.add(UncertaintySource::LeftOut, &step);
            }
            of_covariance.extend(left_out.iter().map(|column| all[*column]));
            let spread = spread.select(&estimated, &left_out);
            solution.covariance.replace_by_jackknife(spread, normals.folds(), left_out.len());
        }
        if let Some((considered, of_considered)) = self.considered(columns, solution)? {
            of_covariance.extend(of_considered);
            solution.covariance.add_considered(considered);
        }
        Ok(of_covariance)
    }

    /// Effect of the errors of [`Role::Considered`] parameters on the solution, and the columns of these parameters.
    /// `None` if there are no such parameters.
    fn considered(
        &self,
        columns: &SharedColumns,
        solution: &Solution,
    ) -> Result<Option<(Considered, Vec<Column>)>, CalibrateError> {
        // Error terms are not included here if the jackknife has included them with their priors.
        let by_jackknife = matches!(solution.covariance.sigmas_from, SigmasFrom::Jackknife { .. });
        let free =
            |parameter: &Parameter, _| (!by_jackknife || parameter.id.term().is_none()).then_some(Role::Free);
        let models = self.models(|model| model.with_considered(free));
        let all = models.columns.all();
        let estimated = |column: usize| columns.all().iter().position(|other| *other == all[column]);
        let considered: Vec<usize> = (0..all.len()).filter(|column| estimated(*column).is_none()).collect();
        if considered.is_empty() {
            return Ok(None);
        }
        let sigmas = models.of_runs.iter().zip(&*self.runs).map(|(model, run)| considered_sigmas(model, run));
        let sigmas = models.columns.gather(&sigmas.collect::<Vec<_>>());
        let problem = problem_with_models(self.runs, &models.of_runs, &models.columns, &self.sigmas)?;
        let options = Options { loss: solution.loss, ..Options::default() };
        let found = influence(&problem, &models.start(), &considered, &options)?;
        // The rows of `found.change` are in the order of the estimated columns in `all`. The rows of the result are in the
        // order of the solution, which may differ.
        let mut change = DMatrix::zeros(columns.all().len(), considered.len());
        for (row, column) in (0..all.len()).filter_map(estimated).enumerate() {
            change.row_mut(column).copy_from(&found.change.row(row));
        }
        let sigmas = considered.iter().map(|column| sigmas[*column]).collect();
        let considered = considered.iter().map(|column| all[*column]).collect();
        Ok(Some((Considered { sigmas, change }, considered)))
    }
}
