//! The solve of one or several runs: what is free, which terms stay, and how far to trust the result.

use super::ball_bar::CalibrateError;
use super::config::{CostName, IdentifyConfig, SelectionName};
use super::ripple::Ripple;
use super::structure::identifiable;
use super::sudden;
use super::terms::{Candidate, Offer, TermGroup, prior_scale, select};
use crate::cost::{CostError, DataSets, SharedColumns};
use crate::instrument::{BallBar, Instrument, Measures, Run};
use crate::kinematics::LinkParameter;
use crate::model::{Model, ModelError, ParameterId, Role};
use crate::prepare::PrepareOptions;
use crate::solver::{Loss, LossName, Normals, Options, Solution, Watch, solve_from_subsets, solve_robust};

/// The thesis' residuals enter as it defines them; `pose` is whitened by itself.
const UNWEIGHTED: f64 = 1.0;
/// Residuals without any error still count as this uncertain against priors \[m, m^2 or matrix entry\].
const SIGMA_MIN: f64 = 1e-9;
/// Whitened residuals below this are rounding: there is nothing left that a term could explain.
const RESIDUAL_MIN: f64 = 1e-3;
/// Segments of each run that are held out in turn to choose terms.
const HELD_OUT: usize = 8;
/// Segments of each run that are left out in turn for the covariance.
const LEFT_OUT: usize = 30;

/// A solve of all runs.
#[derive(Debug, Clone)]
pub struct Solved {
    /// Which columns of the solution are whose.
    pub columns: SharedColumns,
    /// The solve.
    pub solution: Solution,
    /// Kinds of terms that were tried.
    pub candidates: Vec<Candidate>,
    /// Scale of the links' tolerances.
    pub prior_scale: f64,
}

/// What a residual of a solve is worth against priors, one standard deviation: `pose` is whitened by itself.
pub(super) fn residual_sigma(cost: CostName, solution: &Solution) -> f64 {
    if cost == CostName::Pose { UNWEIGHTED } else { solution.summary.residual_rms.max(SIGMA_MIN) }
}

/// All runs where their models are.
pub(super) fn problem<'p>(
    runs: &'p [Run],
    columns: &'p SharedColumns,
    sigma: f64,
) -> Result<DataSets<'p>, CostError> {
    let sets = runs.iter().map(|run| run.instrument.data_set(&run.model, sigma));
    Ok(DataSets::new(sets.collect::<Result<_, _>>()?, columns))
}

/// Runs that are solved together.
struct Solver<'a> {
    runs: &'a mut [Run],
    loss: LossName,
    ransac: bool,
    watch: Option<&'a dyn Watch>,
    /// The runs' bars differ in length.
    lengths_differ: bool,
}

/// Selects, solves, chooses terms, solves again and leaves the models at the solution.
///
/// # Errors
/// [`CalibrateError`] where the runs do not suit the cost or do not determine what is free.
pub fn solve(
    runs: &mut [Run],
    config: &IdentifyConfig,
    watch: Option<&dyn Watch>,
) -> Result<Solved, CalibrateError> {
    let first = runs.first().ok_or(CalibrateError::NoRun)?;
    let Instrument::BallBar(BallBar { prepared, cost, measured, .. }) = &first.instrument;
    let cost = *cost;
    let free = match config.selection.fixed() {
        Some(_) => Vec::new(),
        None => {
            identifiable(&first.model, &prepared.motion, &prepared.observations, cost.unweighed(measured))?
        }
    };
    for Run { instrument, model } in &mut *runs {
        config.set_roles(model, &free, |id| instrument.tells(id))?;
        let Instrument::BallBar(BallBar { prepared, .. }) = instrument;
        if let Some(force) = &prepared.force {
            config.free_for_force(model, force.parameter())?;
        }
    }
    let loss = config.loss_for(cost);
    let lengths_differ = lengths_differ(runs);
    let mut solver = Solver { runs, loss, ransac: config.ransac, watch, lengths_differ };
    let (_, first) = solver.solve(UNWEIGHTED)?;
    // Whitening, angles without encoder and the worth of a residual against priors were those of the nominal geometry;
    // now they are those of the solution.
    let sigma = residual_sigma(cost, &first);
    let (mut columns, mut solution) = solver.solve(sigma)?;
    let mut candidates = Vec::new();
    let mut scale = 1.0;
    if solution.summary.residual_rms > RESIDUAL_MIN * sigma {
        (candidates, scale) = solver.choose_terms(sigma, &solution, config)?;
        if scale != 1.0 || candidates.iter().any(|candidate| candidate.accepted) {
            (columns, solution) = solver.solve(sigma)?;
        }
    }
    solution.summary.residual_rms_start = first.summary.residual_rms_start;
    solver.check_changes(sigma, solution.loss, &config.prepare)?;
    if let Some(normals) = solver.normals(&columns, sigma, solution.loss, LEFT_OUT)?
        && let Some(covariance) = normals.jackknife()
    {
        solution.covariance = solution.covariance.by_jackknife(covariance, normals.folds());
    }
    Ok(Solved { columns, solution, candidates, prior_scale: scale })
}

fn lengths_differ(runs: &[Run]) -> bool {
    let length = |run: &Run| run.model.parameter(ParameterId::ROD).map(|rod| rod.nominal);
    runs.windows(2).any(|pair| length(&pair[0]) != length(&pair[1]))
}

/// What a run has for itself: robot and bar are those of all runs, but the bar is set up anew and its encoders count from
/// new zeros.
fn is_own(id: ParameterId, lengths_differ: bool) -> bool {
    match id {
        ParameterId::Base(_) | ParameterId::BaseRotation(_) => true,
        ParameterId::Harmonic { .. } | ParameterId::Zero { .. } | ParameterId::BarWave { .. } => true,
        ParameterId::ClockShift | ParameterId::ClockSkew => true,
        ParameterId::Bar { parameter: LinkParameter::Theta, .. } => true,
        // Another bar gives way by another amount.
        ParameterId::ROD | ParameterId::BarCompliance | ParameterId::BarPlay => lengths_differ,
        _ => false,
    }
}

impl Solver<'_> {
    fn columns(&self) -> SharedColumns {
        SharedColumns::new(self.runs.iter().map(|run| &run.model), |id| is_own(id, self.lengths_differ))
    }

    fn start(&self, columns: &SharedColumns) -> Vec<f64> {
        columns.gather(&self.runs.iter().map(|run| run.model.start()).collect::<Vec<_>>())
    }

    /// One solve from where the models are; they are left at its solution.
    fn solve(&mut self, sigma: f64) -> Result<(SharedColumns, Solution), CalibrateError> {
        for Run { instrument, model } in &mut *self.runs {
            instrument.adapt(model);
        }
        let columns = self.columns();
        let start = self.start(&columns);
        let solve_by = if self.ransac { solve_from_subsets } else { solve_robust };
        let options = Options { watch: self.watch, ..Options::default() };
        let solution = solve_by(&problem(self.runs, &columns, sigma)?, &start, self.loss, &options)?;
        let mut solution = solution.identified()?;
        solution.summary.residual_rms_start *= sigma;
        solution.summary.residual_rms *= sigma;
        solution.summary.require_converged()?;
        for (number, run) in self.runs.iter_mut().enumerate() {
            run.model.adopt(&columns.values(number, &solution.x));
        }
        Ok((columns, solution))
    }

    /// Normal equations of the segments of all runs where the models are; none where residuals are not finite.
    fn normals(
        &self,
        columns: &SharedColumns,
        sigma: f64,
        loss: Loss,
        count: usize,
    ) -> Result<Option<Normals>, CostError> {
        let problem = problem(self.runs, columns, sigma)?;
        let of_run = |(run, start): (&Run, &usize)| {
            let groups = run.instrument.independent(count).into_iter();
            groups.map(|group| group.into_iter().map(|sample| start + sample).collect()).collect::<Vec<_>>()
        };
        let segments: Vec<Vec<usize>> = self.runs.iter().zip(problem.starts()).flat_map(of_run).collect();
        let options = Options { loss, ..Options::default() };
        Ok(Normals::new(&problem, &self.start(columns), &options, &segments))
    }

    /// Tries each group of terms on held-out segments, gives those that stay their priors, and finds the priors' scale.
    fn choose_terms(
        &mut self,
        sigma: f64,
        solution: &Solution,
        config: &IdentifyConfig,
    ) -> Result<(Vec<Candidate>, f64), CalibrateError> {
        let groups = config.candidates();
        if groups.contains(&TermGroup::Ripple) {
            self.offer_ripple(sigma, &solution.sample_weights)?;
        }
        let offered = |id: ParameterId| TermGroup::of(id).is_some_and(|group| groups.contains(&group));
        self.set_terms(config, |run, id| {
            offered(id) && run.instrument.tells(id) && is_fixed(&run.model, id)
        })?;
        let columns = self.columns();
        let normals = self.normals(&columns, sigma, solution.loss, HELD_OUT)?;
        let ids = columns.gather(&self.ids());
        let of_group = |group: Option<TermGroup>| -> Vec<usize> {
            let offered = |id: ParameterId| TermGroup::of(id).filter(|of| groups.contains(of));
            ids.iter()
                .enumerate()
                .filter(|(_, id)| offered(**id) == group)
                .map(|(column, _)| column)
                .collect()
        };
        let (kinds, offers): (Vec<TermGroup>, Vec<Offer>) = groups
            .iter()
            .map(|group| (*group, Offer { columns: of_group(Some(*group)), scales: vec![1.0] }))
            .filter(|(_, offer)| !offer.columns.is_empty())
            .unzip();
        let Some(normals) = normals else {
            self.leave_out(|group| groups.contains(&group))?;
            return Ok((Vec::new(), 1.0));
        };
        let mut kept = of_group(None);
        let verdicts = select(&normals, &kept, &offers);
        let report = verdicts.into_iter().map(|verdict| {
            let columns = &offers[verdict.offer].columns;
            if verdict.accepted {
                kept.extend(columns);
            }
            Candidate {
                group: kinds[verdict.offer],
                parameters: columns.len(),
                held_out_before: verdict.before.sqrt(),
                held_out_after: verdict.after.sqrt(),
                accepted: verdict.accepted,
            }
        });
        let report: Vec<Candidate> = report.collect();
        let accepted = |group| report.iter().any(|candidate| candidate.accepted && candidate.group == group);
        self.leave_out(|group| groups.contains(&group) && !accepted(group))?;
        if config.selection != SelectionName::Automatic {
            return Ok((report, 1.0));
        }
        // Terms were weighed above, and what a person gave stays as it is.
        let tolerance = |id: ParameterId| {
            let of_link = matches!(id, ParameterId::Robot { .. } | ParameterId::Bar { .. });
            of_link && !config.priors.contains_key(&id.to_string())
        };
        let scale = prior_scale(&normals, &kept, |column| ids.get(column).copied().is_some_and(tolerance));
        self.scale_priors(scale, tolerance)?;
        Ok((report, scale))
    }

    /// Each run with the weights of its samples.
    fn weighed<'a>(&'a self, weights: &'a [f64]) -> impl Iterator<Item = (&'a Run, &'a [f64])> {
        let mut rest = weights;
        self.runs.iter().map(move |run| {
            let (own, others) = rest.split_at(run.instrument.samples().min(rest.len()));
            rest = others;
            (run, own)
        })
    }

    /// No encoder slips and no clock jumps, as far as the solution with all of its terms tells: what these could bend towards
    /// is not told.
    ///
    /// # Errors
    /// [`CalibrateError::Prepare`] for the first run where one does.
    fn check_changes(&self, sigma: f64, loss: Loss, options: &PrepareOptions) -> Result<(), CalibrateError> {
        for (number, Run { instrument, model }) in self.runs.iter().enumerate() {
            let Instrument::BallBar(bar) = instrument;
            let columns = SharedColumns::new([model], |_| false);
            let problem = DataSets::new(vec![bar.data_set(model, sigma)?], &columns);
            if let Some(error) = sudden::change(model, &bar.prepared, &problem, loss, options) {
                return Err(CalibrateError::Prepare { run: number, error: Box::new(error) });
            }
        }
        Ok(())
    }

    /// Gives all models the waves of the axes that what is left shows.
    fn offer_ripple(&mut self, sigma: f64, weights: &[f64]) -> Result<(), CalibrateError> {
        let mut ripple = Ripple::default();
        for (run, weights) in self.weighed(weights) {
            ripple.add(run, sigma, weights)?;
        }
        let found = ripple.found();
        for run in &mut *self.runs {
            run.model = run.model.clone().with_joint_waves(found.iter().copied());
        }
        Ok(())
    }

    fn ids(&self) -> Vec<Vec<ParameterId>> {
        self.runs.iter().map(|run| run.model.columns().map(|parameter| parameter.id).collect()).collect()
    }

    /// Gives terms their priors.
    fn set_terms(
        &mut self,
        config: &IdentifyConfig,
        wanted: impl Fn(&Run, ParameterId) -> bool,
    ) -> Result<(), ModelError> {
        for run in &mut *self.runs {
            let all: Vec<ParameterId> = run.model.parameters().iter().map(|parameter| parameter.id).collect();
            for id in all {
                if wanted(run, id) && !config.fix.contains(&id.to_string()) {
                    run.model.set_role(id, config.term_role(id))?;
                }
            }
        }
        Ok(())
    }

    /// Fixes the terms of some groups at zero, but those that were asked for by name.
    fn leave_out(&mut self, group: impl Fn(TermGroup) -> bool) -> Result<(), ModelError> {
        for run in &mut *self.runs {
            let all: Vec<ParameterId> = run.model.columns().map(|parameter| parameter.id).collect();
            for id in all.into_iter().filter(|id| TermGroup::of(*id).is_some_and(&group)) {
                if run.model.parameter(id).is_some_and(|parameter| parameter.value == 0.0) {
                    run.model.set_role(id, Role::Fixed)?;
                }
            }
        }
        Ok(())
    }

    fn scale_priors(&mut self, scale: f64, which: impl Fn(ParameterId) -> bool) -> Result<(), ModelError> {
        for run in &mut *self.runs {
            let priors: Vec<(ParameterId, Role)> =
                run.model.columns().map(|parameter| (parameter.id, parameter.role)).collect();
            for (id, role) in priors.into_iter().filter(|(id, _)| which(*id)) {
                if let Role::Prior { value, sigma } = role {
                    run.model.set_role(id, Role::Prior { value, sigma: sigma * scale })?;
                }
            }
        }
        Ok(())
    }
}

fn is_fixed(model: &Model, id: ParameterId) -> bool {
    model.parameter(id).is_some_and(|parameter| parameter.role == Role::Fixed)
}
