//! The estimation: from runs with start models to the models at the solution, with covariance, for any instruments on one robot.
//! Steps: solve until the weight of each data set agrees with its residuals, without its outliers; choose terms on left-out
//! groups of samples; solve again; compute the covariance. Used for calibrations, their deployments and to place an instrument.
//!
//! Ball-bars alone share one unit of residuals, that of their cost, and one sigma (standard deviation of a residual). With any
//! other instrument each data set has its own sigma, and the residuals of the solve are in standard deviations.

use nalgebra::DMatrix;

use super::change;
use super::error::CalibrateError;
use super::rows::WAVES_PER_TURN_MAX;
use super::selection::choose::CommonPrior;
use super::selection::line_spectrum::Shown;
use super::selection::terms::{Candidate, CandidateGroup, mean};
use crate::cost::{CostError, DataSets, SharedColumns};
use crate::instrument::{CostName, Run, ScaleFrom};
use crate::model::{Group, Model, ModelError, Parameter, ParameterId, Phase, Role};
use crate::solver::{
    Considered, Covariance, GoodShare, Loss, LossName, Normals, Options, Problem, Solution, Source, Summary,
    Watch, influence, minimise, minimise_robust, solve,
};

/// Standard deviation one: residuals as defined in the thesis, or already whitened (`pose`).
const UNWEIGHTED: f64 = 1.0;
/// Lower limit of the residual standard deviation against priors, in the unit of the residual.
const SIGMA_MIN: f64 = 1e-9;
/// Whitened residuals below this are rounding errors that no term could explain.
const RESIDUAL_MIN: f64 = 1e-3;
/// Relative cost tolerance of all solves except the last: no reported value changes by more.
const COST_TOLERANCE: f64 = 1e-6;
/// Relative cost tolerance of the last solve. With ten thousand residuals every parameter is within a ten-thousandth of its
/// standard deviation; a smaller tolerance is close to rounding.
const COST_TOLERANCE_LAST: f64 = 1e-12;
/// The weights have converged when the noise decreases by less than this fraction.
const CONVERGED: f64 = 0.02;
/// Maximum number of solves until the weights have converged.
const ROUNDS_MAX: usize = 20;
/// Number of groups of each data set that are held out in turn to choose terms.
pub(super) const HELD_OUT: usize = 8;
/// Number of groups of each data set that are left out in turn for the covariance.
pub(super) const LEFT_OUT: usize = 30;

/// Settings of a solve, in addition to the data sets, whose models have their roles and start values.
#[derive(Debug, Clone)]
pub struct Plan<'a> {
    /// Robust loss, which reduces the weight of samples with large residuals.
    pub loss: LossName,
    /// Groups of terms to try; a line spectrum without parameters is detected in the residuals.
    pub groups: Vec<CandidateGroup>,
    /// Parameters that stay fixed.
    pub fix: Vec<ParameterId>,
    /// Parameters whose priors are widened until left-out groups are predicted best.
    pub tolerances: Vec<ParameterId>,
    /// Priors whose widths the samples determine.
    pub(super) common: Vec<CommonPrior>,
    /// Observes each solve and may cancel it.
    pub watch: Option<&'a dyn Watch>,
}

impl Plan<'_> {
    /// Plan for rows of one instrument, with default settings.
    pub fn new(loss: LossName, groups: Vec<CandidateGroup>) -> Self {
        Plan { loss, groups, fix: Vec::new(), tolerances: Vec::new(), common: Vec::new(), watch: None }
    }
}

/// Highest order of joint waves to try: left-out groups could not support more than one amplitude per four measured values of
/// each axis.
pub(super) fn waves_per_turn(measured: usize, axes: usize) -> u8 {
    const MEASURED_PER_WAVE: usize = 4;
    let orders = measured / (MEASURED_PER_WAVE * Phase::ALL.len() * axes.max(1));
    u8::try_from(orders).unwrap_or(u8::MAX).min(WAVES_PER_TURN_MAX)
}

/// A joint solve of all runs.
#[derive(Debug, Clone)]
pub struct Solved {
    /// Map from the columns of each run to those of the solution.
    pub columns: SharedColumns,
    /// Solution of the last solve.
    pub solution: Solution,
    /// Models of the runs before any term was accepted.
    pub without_terms: Vec<Model>,
    /// Groups of terms that were tried, with the results.
    pub candidates: Vec<Candidate>,
    /// Scale factor of the link tolerances.
    pub prior_scale: f64,
    /// Standard deviation of a residual of each run.
    pub sigmas: Vec<f64>,
}

/// The prior that includes a considered term; `None` for other parameters.
fn prior_of_term(parameter: &Parameter, sigma: f64) -> Option<Role> {
    parameter.id.term().map(|_| Role::Prior { value: parameter.value, sigma })
}

/// Standard deviation of a residual relative to priors; residuals of `pose` are already whitened.
fn residual_sigma(cost: CostName, reached: &Summary) -> f64 {
    if cost == CostName::Pose { UNWEIGHTED } else { reached.residual_rms.max(SIGMA_MIN) }
}

/// The least-squares problem of all runs at the values of their models.
pub(super) fn problem<'p>(
    runs: &'p [Run],
    columns: &'p SharedColumns,
    sigmas: &[f64],
) -> Result<DataSets<'p>, CostError> {
    let sets = runs.iter().zip(sigmas).map(|(run, sigma)| run.instrument.data_set(&run.model, *sigma));
    Ok(DataSets::new(sets.collect::<Result<_, _>>()?, columns))
}

/// The cost that defines the unit of the residuals of all data sets; `None` if they differ.
pub(super) fn residual_unit_of(runs: &[Run]) -> Option<CostName> {
    let mut costs = runs.iter().map(|run| run.instrument.residual_unit_of());
    let first = costs.next()??;
    costs.all(|cost| cost == Some(first)).then_some(first)
}

/// Runs that are solved together.
pub(super) struct Solver<'a> {
    pub(super) runs: &'a mut [Run],
    pub(super) plan: &'a Plan<'a>,
    /// Standard deviation of a residual of each run.
    pub(super) sigmas: Vec<f64>,
    /// Those of rod and plate lengths that differ between runs.
    own_lengths: Vec<ParameterId>,
    /// Waves that were detected in residuals.
    pub(super) shown: Shown,
}

/// Solves, chooses terms, solves again, and sets the models to the solution.
///
/// # Errors
/// [`CalibrateError`] if the runs do not fit their residuals or do not determine all free parameters.
pub fn estimate(runs: &mut [Run], plan: &Plan<'_>) -> Result<Solved, CalibrateError> {
    let poor_fit = change::poor_fit(runs);
    estimate_in_steps(runs, plan).map_err(|error| match poor_fit {
        // If angles fit no geometry, that error is more informative than the failed solve.
        Some(poor_fit) if error.is_of_solve() => poor_fit,
        _ => error,
    })
}

fn estimate_in_steps(runs: &mut [Run], plan: &Plan<'_>) -> Result<Solved, CalibrateError> {
    let mut solver = Solver::new(runs, plan);
    solver.begins("links");
    let (mut columns, mut solution) = solver.solve_with_weights()?;
    if solver.replaces_compliance_by_play(solution.loss)? {
        (columns, solution) = solver.solve_with_weights()?;
    }
    let rms_start = solution.summary.residual_rms_start;
    let without_terms = solver.runs.iter().map(|run| run.model.clone()).collect();
    let mut candidates = Vec::new();
    let mut scale = 1.0;
    let has_choices = !(plan.groups.is_empty() && plan.tolerances.is_empty() && plan.common.is_empty());
    if has_choices && solution.summary.residual_rms > RESIDUAL_MIN * solver.unit() {
        // Of the costs of the ball-bar only `pose` has a noise model.
        let estimates_noise = solver.residual_unit_of().is_none_or(|cost| cost == CostName::Pose);
        // Accepted terms reduce the noise: the second selection weights their priors with it.
        let rounds = if estimates_noise { 2 } else { 1 };
        for _ in 0..rounds {
            let further_scale;
            (candidates, further_scale) = solver.choose_terms(&solution)?;
            scale *= further_scale;
            if estimates_noise {
                solution.loss = solver.minimise_whitened(plan.loss)?;
                solver.learn_noise();
                solver.fit_common_priors(solution.loss)?;
            }
            if solver.residual_unit_of().is_none() {
                solver.estimate_sigmas()?;
            }
        }
        if estimates_noise || scale != 1.0 || candidates.iter().any(|candidate| candidate.accepted) {
            (columns, solution) = if solver.residual_unit_of().is_some() {
                // Accepted terms reduce the residuals, so the scale of the loss is estimated again.
                solver.minimise_bars()?;
                solver.last_solve()?
            } else {
                solver.solve_with_weights()?
            };
        }
    }
    solution.summary.residual_rms_start = rms_start;
    solution.covariance = solver.covariance(&columns, &solution)?;
    let sigmas = solver.sigmas;
    Ok(Solved { columns, solution, without_terms, candidates, prior_scale: scale, sigmas })
}

/// Solves for the free parameters from the current values, without trying other terms, and sets the models to the solution.
/// Returns the column map, the solution, and the standard deviation of a residual of each run.
///
/// # Errors
/// As [`estimate`].
pub(super) fn refit(
    runs: &mut [Run],
    loss: LossName,
    watch: Option<&dyn Watch>,
) -> Result<(SharedColumns, Solution, Vec<f64>), CalibrateError> {
    let plan = Plan { watch, ..Plan::new(loss, Vec::new()) };
    let mut solver = Solver::new(runs, &plan);
    let (columns, mut solution) = solver.solve_with_weights()?;
    solution.covariance = solver.covariance(&columns, &solution)?;
    Ok((columns, solution, solver.sigmas))
}

/// Those of rod and plate lengths that differ between the runs with a bar.
pub(super) fn differ(runs: &[Run]) -> Vec<ParameterId> {
    let differs = |id: &ParameterId| {
        let bars = runs.iter().filter(|run| run.instrument.scale() == ScaleFrom::Plate);
        let mut lengths = bars.filter_map(|run| run.model.parameter(*id).map(|length| length.nominal));
        let first = lengths.next();
        lengths.any(|length| Some(length) != first)
    };
    let axes = runs.first().map_or(0, |run| run.model.axes());
    ParameterId::known_lengths(axes).into_iter().filter(differs).collect()
}

/// Whether each data set has its own value. The robot is shared by all and the bar by all runs with one. Instruments are set
/// up anew, and encoders have new offsets.
pub(super) fn is_own(id: ParameterId, own_lengths: &[ParameterId]) -> bool {
    // A different bar has a different compliance.
    let length = if id.group() == Group::Force { ParameterId::ROD } else { id };
    id.block().of_run || own_lengths.contains(&length)
}

impl<'a> Solver<'a> {
    fn new(runs: &'a mut [Run], plan: &'a Plan<'a>) -> Self {
        let own_lengths = differ(runs);
        let sigmas = vec![UNWEIGHTED; runs.len()];
        Self { runs, plan, sigmas, own_lengths, shown: Shown::default() }
    }

    pub(super) fn columns(&self) -> SharedColumns {
        SharedColumns::new(self.runs.iter().map(|run| &run.model), |id| is_own(id, &self.own_lengths))
    }

    pub(super) fn start(&self, columns: &SharedColumns) -> Vec<f64> {
        columns.gather(&self.runs.iter().map(|run| run.model.start()).collect::<Vec<_>>())
    }

    fn adopt(&mut self, columns: &SharedColumns, x: &[f64]) {
        for (number, run) in self.runs.iter_mut().enumerate() {
            run.model.adopt(&columns.values(number, x));
        }
    }

    /// The cost that defines the unit of the residuals of all data sets; `None` if they differ.
    pub(super) fn residual_unit_of(&self) -> Option<CostName> {
        residual_unit_of(self.runs)
    }

    /// Factor of reported residuals: the unit of the cost, if all data sets share one.
    fn unit(&self) -> f64 {
        let first = self.sigmas.first().copied().unwrap_or(UNWEIGHTED);
        if self.residual_unit_of().is_some() { first } else { UNWEIGHTED }
    }

    /// Solves repeatedly until the weights of the residuals agree with their size.
    fn solve_with_weights(&mut self) -> Result<(SharedColumns, Solution), CalibrateError> {
        match self.residual_unit_of() {
            Some(cost) => self.solve_bars(cost),
            None => self.solve_any_instruments(),
        }
    }

    fn solve_bars(&mut self, cost: CostName) -> Result<(SharedColumns, Solution), CalibrateError> {
        self.sigmas.fill(UNWEIGHTED);
        let first = self.minimise_bars()?;
        self.learn_noise();
        // Whitening, angles without encoder, and the weight of residuals against priors were computed at the nominal
        // geometry; now they are computed at the solution. A weight that is too small keeps the solution near its priors,
        // where residuals are large. Repeat until the weight no longer increases.
        let mut sigma = residual_sigma(cost, &first);
        for _ in 0..ROUNDS_MAX {
            self.sigmas.fill(sigma);
            let remaining = residual_sigma(cost, &self.minimise_bars()?);
            if remaining > 1.0 - CONVERGED {
                break;
            }
            sigma = (sigma * remaining).max(SIGMA_MIN);
        }
        let (columns, mut solution) = self.last_solve()?;
        // Convert to the unit of the estimated noise.
        let unit = solution.summary.residual_rms_start / first.residual_rms.max(SIGMA_MIN);
        let unit = if cost == CostName::Pose { unit } else { UNWEIGHTED };
        solution.summary.residual_rms_start = unit * first.residual_rms_start;
        Ok((columns, solution))
    }

    fn solve_any_instruments(&mut self) -> Result<(SharedColumns, Solution), CalibrateError> {
        let mut noise = self.estimate_sigmas()?;
        for _ in 0..ROUNDS_MAX {
            // The Cauchy loss suppresses outliers during these iterations.
            self.minimise_whitened(LossName::Cauchy)?;
            self.learn_noise();
            let screened = self.screen();
            let before = std::mem::replace(&mut noise, self.estimate_sigmas()?);
            if !screened && noise.iter().zip(&before).all(|(now, before)| *now > (1.0 - CONVERGED) * before) {
                break;
            }
        }
        self.last_solve()
    }

    /// Estimates the noise of the readings from the residuals of the current models.
    fn learn_noise(&mut self) {
        for Run { instrument, model } in &mut *self.runs {
            instrument.learn_noise(model);
        }
    }

    /// Excludes the outliers of each data set; true if the set of used samples changed.
    fn screen(&mut self) -> bool {
        let runs = self.runs.iter_mut();
        runs.fold(false, |others, Run { instrument, model }| instrument.screen(model) || others)
    }

    /// Factor by which the errors of each data set exceed its residuals, because the fit adapts to them: `sqrt(n / (n - p))`,
    /// with `p` effective parameters for its `n` numbers. Without the factor, if terms are as many as numbers, residuals would
    /// decrease with each fit, down to zero.
    fn errors_per_residual(&self) -> Result<Vec<f64>, CostError> {
        let columns = self.columns();
        let all = problem(self.runs, &columns, &self.sigmas)?;
        let samples_of_runs: Vec<Vec<usize>> =
            all.starts().windows(2).map(|run| (run[0]..run[1]).collect()).collect();
        let normals = Normals::new(&all, &self.start(&columns), &Options::default(), &samples_of_runs).ok();
        let factors = normals.and_then(|normals| {
            let rows = normals.of_folds().iter().map(|of_run| of_run.rows);
            Some(normals.taken()?.into_iter().zip(rows).map(|(p, n)| (n / (n - p).max(1.0)).sqrt()).collect())
        });
        Ok(factors.unwrap_or_else(|| vec![UNWEIGHTED; self.runs.len()]))
    }

    /// Estimates the sigma of each data set from its own residuals (variance components). Returns the noise of each in its own
    /// unit.
    fn estimate_sigmas(&mut self) -> Result<Vec<f64>, CostError> {
        let is_joint = self.runs.len() > 1;
        let mut noise = Vec::new();
        let factors = self.errors_per_residual()?;
        for ((Run { instrument, model }, sigma), factor) in
            self.runs.iter_mut().zip(&mut self.sigmas).zip(factors)
        {
            // An instrument that estimates its noise gives residuals in standard deviations.
            let own_noise = instrument.adapt(model);
            let alone = instrument.data_set(model, UNWEIGHTED)?;
            *sigma = factor
                * match own_noise {
                    Some(_) => UNWEIGHTED,
                    None => GoodShare::HALF.spread_at(&*alone, &model.start()).max(SIGMA_MIN),
                };
            if is_joint {
                // Correlated errors carry less information than independent ones.
                let groups = instrument.independent(LEFT_OUT);
                let loss = LossName::Cauchy.for_spread(*sigma, alone.rows());
                let options = Options { loss, ..Options::default() };
                let normals = Normals::new(&*alone, &model.start(), &options, &groups).ok();
                let dispersion = normals.and_then(|normals| normals.overdispersion());
                *sigma *= (dispersion.unwrap_or(1.0) / sigma.powi(2)).max(1.0).sqrt();
            }
            noise.push(own_noise.unwrap_or(1.0) * *sigma);
        }
        Ok(noise)
    }

    /// Improves the models, with residuals in standard deviations, without rank analysis and covariance: for hundreds of
    /// columns and for all solves except the last. Returns the loss.
    fn minimise_whitened(&mut self, loss: LossName) -> Result<Loss, CalibrateError> {
        let columns = self.columns();
        let problem = problem(self.runs, &columns, &self.sigmas)?;
        let loss = loss.for_spread(1.0, problem.rows());
        let watch = self.plan.watch;
        let options = Options { loss, cost_tolerance: COST_TOLERANCE, watch, ..Options::default() };
        let (x, _) = minimise(&problem, &self.start(&columns), &options)?;
        drop(problem);
        self.adopt(&columns, &x);
        Ok(loss)
    }

    /// Adapts each instrument to its current model, such as the angles of bar joints without encoder.
    fn adapt_instruments(&mut self) {
        for Run { instrument, model } in &mut *self.runs {
            instrument.adapt(model);
        }
    }

    pub(super) fn begins(&self, stage: &str) {
        if let Some(watch) = self.plan.watch {
            watch.begins(stage);
        }
    }

    /// Moves the models of ball-bar runs near their solution, where the residuals determine the weights. The scale of the loss is
    /// estimated at the same time.
    fn minimise_bars(&mut self) -> Result<Summary, CalibrateError> {
        self.adapt_instruments();
        let columns = self.columns();
        let Plan { loss, watch, .. } = *self.plan;
        let options = Options { cost_tolerance: COST_TOLERANCE, watch, ..Options::default() };
        let problem = problem(self.runs, &columns, &self.sigmas)?;
        let (x, reached) = minimise_robust(&problem, &self.start(&columns), loss, &options)?;
        drop(problem);
        self.adopt(&columns, &x);
        Ok(reached)
    }

    /// The last solve, from near the solution; sets the models to the solution.
    fn last_solve(&mut self) -> Result<(SharedColumns, Solution), CalibrateError> {
        let of_bars = self.residual_unit_of().is_some();
        if of_bars {
            self.adapt_instruments();
        }
        let columns = self.columns();
        let start = self.start(&columns);
        let Plan { loss, watch, .. } = *self.plan;
        let options = Options { cost_tolerance: COST_TOLERANCE_LAST, watch, ..Options::default() };
        let problem = problem(self.runs, &columns, &self.sigmas)?;
        // The noise has converged. Residuals are in standard deviations, except those of the ball-bar alone.
        let loss =
            if of_bars { loss.settled(&problem, &start) } else { loss.for_spread(1.0, problem.rows()) };
        let solution = solve(&problem, &start, &Options { loss, ..options });
        drop(problem);
        let mut solution = solution?.identified()?;
        solution.summary.residual_rms_start *= self.unit();
        solution.summary.residual_rms *= self.unit();
        solution.summary.require_converged()?;
        self.adopt(&columns, &solution.x);
        Ok((columns, solution))
    }

    /// The least-squares problem of all runs with other models.
    fn problem_with_models<'p>(
        &'p self,
        models: &'p [Model],
        columns: &'p SharedColumns,
    ) -> Result<DataSets<'p>, CostError> {
        let sets = self.runs.iter().zip(models).zip(&self.sigmas);
        let sets = sets.map(|((run, model), sigma)| run.instrument.data_set(model, *sigma));
        Ok(DataSets::new(sets.collect::<Result<_, _>>()?, columns))
    }

    /// Normal equations of the independent groups of all runs at the models' values, and the run of each group; `None` if
    /// residuals are not finite.
    fn normals(
        &self,
        models: &[Model],
        columns: &SharedColumns,
        loss: Loss,
        count: usize,
    ) -> Result<Option<(Normals, Vec<usize>)>, CostError> {
        let problem = self.problem_with_models(models, columns)?;
        let (mut of_run, mut groups) = (Vec::new(), Vec::new());
        for (number, (run, start)) in self.runs.iter().zip(problem.starts()).enumerate() {
            for group in run.instrument.independent(count) {
                of_run.push(number);
                groups.push(group.into_iter().map(|sample| start + sample).collect());
            }
        }
        let options = Options { loss, ..Options::default() };
        let start = columns.gather(&models.iter().map(Model::start).collect::<Vec<_>>());
        let normals = Normals::new(&problem, &start, &options, &groups).ok();
        Ok(normals.map(|normals| (normals, of_run)))
    }

    /// The free columns, their parameters, and [`Self::normals`] at the current models.
    pub(super) fn normals_here(
        &self,
        loss: Loss,
        count: usize,
    ) -> Result<(SharedColumns, Vec<ParameterId>, Option<Normals>), CostError> {
        let columns = self.columns();
        let models: Vec<Model> = self.runs.iter().map(|run| run.model.clone()).collect();
        let normals = self.normals(&models, &columns, loss, count)?.map(|(normals, _)| normals);
        let ids = columns.gather(&self.ids());
        Ok((columns, ids, normals))
    }

    /// Covariance of the solution: by the jackknife if there are enough groups, with the contribution of parameters that are
    /// fixed at uncertain values.
    ///
    /// It is unknown whether excluded terms exist. With these terms and their priors, both the covariance and the solution
    /// differ, and both differences are included (the mean squared error of a solution without them, if they are as expected).
    fn covariance(&self, columns: &SharedColumns, solution: &Solution) -> Result<Covariance, CalibrateError> {
        self.begins("uncertainty");
        let mut covariance = solution.covariance.clone();
        let models: Vec<Model> =
            self.runs.iter().map(|run| run.model.with_considered(prior_of_term)).collect();
        let all = SharedColumns::new(&models, |id| is_own(id, &self.own_lengths));
        let column_in_all = |name: &String| all.names().iter().position(|other| other == name);
        let estimated: Vec<usize> = columns.names().iter().filter_map(column_in_all).collect();
        let left_out: Vec<usize> =
            (0..all.names().len()).filter(|column| !estimated.contains(column)).collect();
        if let Some((normals, of_run)) = self.normals(&models, &all, solution.loss, LEFT_OUT)?
            && let Some(mut spread) = normals.jackknife(|group| of_run[group])
        {
            if !left_out.is_empty()
                && let Some(step) = normals.step()
            {
                spread.add(Source::LeftOut, &step);
            }
            let names = left_out.iter().map(|column| all.names()[*column].clone()).collect();
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
        let models: Vec<Model> = self.runs.iter().map(|run| run.model.with_considered(free)).collect();
        let all = SharedColumns::new(&models, |id| is_own(id, &self.own_lengths));
        let column_of = |name: &String| columns.names().iter().position(|other| other == name);
        let considered: Vec<usize> =
            (0..all.names().len()).filter(|column| column_of(&all.names()[*column]).is_none()).collect();
        if considered.is_empty() {
            return Ok(None);
        }
        let sigmas_of_run = |(model, run): (&Model, &Run)| -> Vec<f64> {
            let role = |id| run.model.parameter(id).map(|parameter| parameter.role);
            let sigma = |id| match role(id) {
                Some(Role::Considered { sigma }) => sigma,
                _ => 0.0,
            };
            model.columns().map(|parameter| sigma(parameter.id)).collect()
        };
        let sigmas = all.gather(&models.iter().zip(&*self.runs).map(sigmas_of_run).collect::<Vec<_>>());
        let start = all.gather(&models.iter().map(Model::start).collect::<Vec<_>>());
        let problem = self.problem_with_models(&models, &all)?;
        let found = influence(&problem, &start, &considered, &Options { loss, ..Options::default() })?;
        let mut change = DMatrix::zeros(columns.names().len(), considered.len());
        for (row, name) in found.estimated.iter().enumerate() {
            if let Some(column) = column_of(name) {
                change.row_mut(column).copy_from(&found.change.row(row));
            }
        }
        let sigmas = considered.iter().map(|column| sigmas[*column]).collect();
        Ok(Some(Considered { names: found.held, sigmas, change }))
    }

    /// An axial force elongates the bar as a spring, or takes up its play. If play predicts left-out groups better, it is freed
    /// instead of compliance.
    fn replaces_compliance_by_play(&mut self, loss: Loss) -> Result<bool, CalibrateError> {
        const PLAY_OR_COMPLIANCE: [ParameterId; 2] = [ParameterId::BarPlay, ParameterId::BarCompliance];
        let estimates_compliance = |run: &Run| {
            let role = |id| run.model.parameter(id).map(|parameter| parameter.role);
            PLAY_OR_COMPLIANCE.map(role) == [Some(Role::Fixed), Some(Role::Free)]
        };
        if !self.runs.iter().any(estimates_compliance) || self.plan.fix.contains(&ParameterId::BarPlay) {
            return Ok(false);
        }
        self.set_roles(&PLAY_OR_COMPLIANCE, Role::Free)?;
        let (columns, ids, normals) = self.normals_here(loss, HELD_OUT)?;
        let error_without = |excluded: ParameterId| {
            let kept: Vec<usize> = (0..ids.len()).filter(|column| ids[*column] != excluded).collect();
            // Compliance has its estimated value; without compliance it is zero.
            let mut about = self.start(&columns);
            about.iter_mut().zip(&ids).filter(|(_, id)| **id == excluded).for_each(|(value, _)| *value = 0.0);
            let normals = normals.as_ref()?.about(&about);
            normals.held_out(&kept, normals.priors()).map(|errors| mean(&errors))
        };
        let [with_compliance, with_play] = PLAY_OR_COMPLIANCE.map(error_without);
        let play_is_better =
            with_compliance.zip(with_play).is_some_and(|(compliance, play)| play < compliance);
        let excluded = PLAY_OR_COMPLIANCE[usize::from(play_is_better)];
        self.set_roles(&[excluded], Role::Fixed)?;
        self.set_to_zero(&[excluded])?;
        Ok(play_is_better)
    }

    fn ids(&self) -> Vec<Vec<ParameterId>> {
        self.runs.iter().map(|run| run.model.columns().map(|parameter| parameter.id).collect()).collect()
    }

    /// Sets a role in every model that has the parameter and whose samples identify it.
    pub(super) fn set_roles(&mut self, ids: &[ParameterId], role: Role) -> Result<(), ModelError> {
        for Run { instrument, model } in &mut *self.runs {
            for &id in ids {
                if model.parameter(id).is_some() && instrument.identifies(id, model.robot()) {
                    model.set_role(id, role)?;
                }
            }
        }
        Ok(())
    }

    pub(super) fn set_to_zero(&mut self, ids: &[ParameterId]) -> Result<(), ModelError> {
        for Run { model, .. } in &mut *self.runs {
            for &id in ids {
                if model.parameter(id).is_some() {
                    model.set_value(id, 0.0)?;
                }
            }
        }
        Ok(())
    }
}
