//! The estimation: from runs with start models to the models at the solution, with covariance, for any instruments on one robot.
//! Steps: solve until the weight of each data set agrees with its residuals, without its outliers; choose terms on left-out
//! groups of samples; solve again; compute the covariance. Used for calibrations, their deployments and to place an instrument.
//!
//! Ball-bars alone share one unit of residuals, that of their cost, and one sigma (standard deviation of a residual). With any
//! other instrument each data set has its own sigma, and the residuals of the solve are in standard deviations.

use super::change;
use super::error::CalibrateError;
use super::selection::choose::CommonPrior;
use super::selection::line_spectrum::DetectedWaves;
use super::selection::terms::{Candidate, CandidateGroup};
use crate::cost::{CombinedDataSets, CostError, SharedColumns};
use crate::instrument::{CostName, Run, ScaleFrom};
use crate::model::{Column, Group, Model, ModelError, ParameterId, Role};
use crate::solver::{
    GoodShare, LeastSquares, Loss, LossName, Normals, Options, Solution, Summary, Watch, minimise,
    minimise_robust, solve,
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
    /// A solve that tries no terms and no other widths of priors.
    pub fn new(loss: LossName) -> Self {
        let (groups, fix, tolerances, common) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        Plan { loss, groups, fix, tolerances, common, watch: None }
    }
}

/// A joint solve of all runs.
#[derive(Debug, Clone)]
pub struct Solved {
    /// Map from the columns of each run to those of the solution.
    pub columns: SharedColumns,
    /// Solution of the last solve.
    pub solution: Solution,
    /// Columns of its covariance: those of the solution, then left-out terms and considered parameters.
    pub covariance_columns: Vec<Column>,
    /// Models of the runs before any term was accepted.
    pub without_terms: Vec<Model>,
    /// Groups of terms that were tried, with the results.
    pub candidates: Vec<Candidate>,
    /// Scale factor of the link tolerances.
    pub prior_scale: f64,
    /// Standard deviation of a residual of each run.
    pub sigmas: Vec<f64>,
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
) -> Result<CombinedDataSets<'p>, CostError> {
    problem_with_models(runs, runs.iter().map(|run| &run.model), columns, sigmas)
}

/// The least-squares problem of all runs with these models, one for each run.
pub(super) fn problem_with_models<'p>(
    runs: &'p [Run],
    models: impl IntoIterator<Item = &'p Model>,
    columns: &'p SharedColumns,
    sigmas: &[f64],
) -> Result<CombinedDataSets<'p>, CostError> {
    let sets = runs.iter().zip(models).zip(sigmas);
    let sets = sets.map(|((run, model), sigma)| run.instrument.data_set(model, *sigma));
    Ok(CombinedDataSets::new(sets.collect::<Result<_, _>>()?, columns))
}

/// Factor, at least 1, that increases the `sigma` of one data set for the correlation of its errors: correlated errors carry less
/// information than independent ones. It is the root of their [`Normals::overdispersion`]. `alone` has residuals in their own
/// unit, so its dispersion has to be divided by `sigma^2`. `groups` are independent groups of its samples.
fn correlation_factor(alone: &dyn LeastSquares, model: &Model, groups: &[Vec<usize>], sigma: f64) -> f64 {
    let loss = LossName::Cauchy.for_spread(sigma, alone.rows());
    let options = Options { loss, ..Options::default() };
    let normals = Normals::new(alone, &model.start(), &options, groups).ok();
    let dispersion = normals.and_then(|normals| normals.overdispersion());
    (dispersion.unwrap_or(1.0) / sigma.powi(2)).max(1.0).sqrt()
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
    /// Rod and plate lengths that differ between runs.
    pub(super) own_lengths: Vec<ParameterId>,
    /// Waves that were detected in residuals.
    pub(super) waves: DetectedWaves,
}

/// Solves, chooses terms, solves again, and sets the models to the solution.
///
/// # Errors
/// [`CalibrateError`] if samples lack what their cost needs, or do not determine all free parameters.
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
    let (mut columns, mut solution) = solver.solve_links()?;
    let rms_start = solution.summary.residual_rms_start;
    let without_terms = solver.runs.iter().map(|run| run.model.clone()).collect();
    let TermChoice { candidates, prior_scale, needs_solve } = solver.choose(&mut solution)?;
    if needs_solve {
        (columns, solution) = solver.solve_with_terms()?;
    }
    solution.summary.residual_rms_start = rms_start;
    let covariance_columns = solver.add_covariance(&columns, &mut solution)?;
    let sigmas = solver.sigmas;
    Ok(Solved { columns, solution, covariance_columns, without_terms, candidates, prior_scale, sigmas })
}

/// Terms that were tried, and the scale of the tolerances.
struct TermChoice {
    candidates: Vec<Candidate>,
    prior_scale: f64,
    /// Whether the solution without terms is no longer the minimum.
    needs_solve: bool,
}

/// Solves for the free parameters from the current values, without trying other terms, and sets the models to the solution. The
/// terms were chosen in the solve `before`.
///
/// # Errors
/// As [`estimate`].
pub(super) fn refit(
    runs: &mut [Run],
    loss: LossName,
    watch: Option<&dyn Watch>,
    before: Solved,
) -> Result<Solved, CalibrateError> {
    let plan = Plan { watch, ..Plan::new(loss) };
    let mut solver = Solver::new(runs, &plan);
    let (columns, mut solution) = solver.solve_with_weights()?;
    let covariance_columns = solver.add_covariance(&columns, &mut solution)?;
    Ok(Solved { columns, solution, covariance_columns, sigmas: solver.sigmas, ..before })
}

/// Rod and plate lengths that differ between the runs with a bar.
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
        Self { runs, plan, sigmas, own_lengths, waves: DetectedWaves::default() }
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

    /// Solves without the terms to choose from, with play or compliance of the bar.
    fn solve_links(&mut self) -> Result<(SharedColumns, Solution), CalibrateError> {
        let (columns, solution) = self.solve_with_weights()?;
        if self.replaces_compliance_by_play(solution.loss)? {
            return self.solve_with_weights();
        }
        Ok((columns, solution))
    }

    /// Chooses terms and widths of priors at the solution without terms, and sets roles and sigmas accordingly. The solution
    /// receives the loss of the improved models.
    fn choose(&mut self, solution: &mut Solution) -> Result<TermChoice, CalibrateError> {
        let plan = self.plan;
        let mut candidates = Vec::new();
        let mut prior_scale = 1.0;
        let has_choices = !(plan.groups.is_empty() && plan.tolerances.is_empty() && plan.common.is_empty());
        let has_residuals = solution.summary.residual_rms > RESIDUAL_MIN * self.unit();
        if !(has_choices && has_residuals) {
            return Ok(TermChoice { candidates, prior_scale, needs_solve: false });
        }
        // Of the costs of the ball-bar only `pose` has a noise model.
        let estimates_noise = self.residual_unit_of().is_none_or(|cost| cost == CostName::Pose);
        // Accepted terms reduce the noise: the second selection weights their priors with it.
        let rounds = if estimates_noise { 2 } else { 1 };
        for _ in 0..rounds {
            let further_scale;
            (candidates, further_scale) = self.choose_terms(solution)?;
            prior_scale *= further_scale;
            if estimates_noise {
                solution.loss = self.minimise_whitened(plan.loss)?;
                self.learn_noise();
                self.fit_common_priors(solution.loss)?;
            }
            if self.residual_unit_of().is_none() {
                self.estimate_sigmas()?;
            }
        }
        let has_accepted = candidates.iter().any(|candidate| candidate.accepted);
        let needs_solve = estimates_noise || prior_scale != 1.0 || has_accepted;
        Ok(TermChoice { candidates, prior_scale, needs_solve })
    }

    /// Solves again with the chosen terms.
    fn solve_with_terms(&mut self) -> Result<(SharedColumns, Solution), CalibrateError> {
        if self.residual_unit_of().is_none() {
            return self.solve_with_weights();
        }
        // Accepted terms reduce the residuals, so the scale of the loss is estimated again.
        self.minimise_bars()?;
        self.last_solve()
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
        // The first solve was whitened with the noise before this estimate. The last starts near the same solution, so the
        // ratio of the rms there converts that of the first start.
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
    /// with `p` effective parameters for its `n` residuals. Without the factor, if there are as many terms as residuals, these
    /// would decrease with each fit, down to zero.
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
                *sigma *= correlation_factor(&*alone, model, &instrument.independent(LEFT_OUT), *sigma);
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
            if of_bars { loss.for_spread_at(&problem, &start) } else { loss.for_spread(1.0, problem.rows()) };
        let solution = solve(&problem, &start, &Options { loss, ..options });
        drop(problem);
        let mut solution = solution?.identified()?;
        solution.summary.residual_rms_start *= self.unit();
        solution.summary.residual_rms *= self.unit();
        solution.summary.require_converged()?;
        self.adopt(&columns, &solution.x);
        Ok((columns, solution))
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
