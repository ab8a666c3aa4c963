//! The estimation. Input: the runs of any instruments on one robot, each with a start model. Output: the
//! models at the solution, with their covariance. Used for calibrations, for fits to a deployment, and to
//! estimate the pose of an instrument.
//!
//! 1. Solves until the weight of each data set agrees with the size of its residuals (`solve_links`). Outliers are excluded.
//! 2. Chooses the error terms and the widths of priors that predict left-out groups of samples best (`choose`).
//! 3. Solves again with the chosen terms (`solve_with_terms`).
//! 4. Computes the covariance (`add_covariance`).
//!
//! A sigma is the standard deviation of a residual. If all data sets are ball-bar runs, they share one sigma, and their
//! residuals have the unit of the cost. Otherwise each data set has its own sigma, and residuals are in standard deviations.

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

/// Sigma of residuals that need no weight. These are residuals as defined in the thesis, or residuals of the cost
/// `pose`, which are whitened already.
const UNWEIGHTED: f64 = 1.0;
/// Lower limit of a sigma, in the unit of the residual. A sigma determines the weight of the samples
/// relative to the priors.
const SIGMA_MIN: f64 = 1e-9;
/// Smaller whitened residuals are only rounding errors. No error term can explain them.
const RESIDUAL_MIN: f64 = 1e-3;
/// Relative cost tolerance of all solves except the last. A smaller tolerance would change reported
/// values by no more than this fraction.
const COST_TOLERANCE: f64 = 1e-6;
/// Relative cost tolerance of the last solve. With ten thousand residuals, every parameter is then within a ten-thousandth
/// of its standard deviation. Rounding errors prevent a much smaller tolerance.
const COST_TOLERANCE_LAST: f64 = 1e-12;
/// The weights have converged if the noise decreases by less than this fraction from one solve to the next.
const CONVERGED: f64 = 0.02;
/// Maximum number of solves until the weights have converged.
const ROUNDS_MAX: usize = 20;
/// Number of groups into which each data set is divided for the choice of terms. Each group is held out in turn.
pub(super) const HELD_OUT: usize = 8;
/// Number of groups into which each data set is divided for the covariance. Each group is left out in turn.
pub(super) const LEFT_OUT: usize = 30;

/// Settings of a solve. The roles and start values of parameters are not part of the settings, because the
/// models of the data sets contain them.
#[derive(Debug, Clone)]
pub struct Plan<'a> {
    /// Robust loss, which reduces the weight of samples with large residuals.
    pub loss: LossName,
    /// Groups of error terms to try. If the group of the line spectrum has no parameters, its waves
    /// are first detected in the residuals.
    pub groups: Vec<CandidateGroup>,
    /// Parameters that stay fixed.
    pub fix: Vec<ParameterId>,
    /// Link parameters whose priors are widened by a common factor. The chosen factor is the one
    /// that predicts left-out groups best.
    pub tolerances: Vec<ParameterId>,
    /// Groups of priors. Each group has a common factor of its standard deviations, which is estimated from the samples.
    pub(super) common: Vec<CommonPrior>,
    /// Observes each solve and may cancel it.
    pub watch: Option<&'a dyn Watch>,
}

impl Plan<'_> {
    /// Settings that try no error terms and do not change the widths of priors.
    pub fn new(loss: LossName) -> Self {
        let (groups, fix, tolerances, common) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        Plan { loss, groups, fix, tolerances, common, watch: None }
    }
}

/// Result of a joint solve of all runs.
#[derive(Debug, Clone)]
pub struct Solved {
    /// Map from the columns of each run to the columns of the solution.
    pub columns: SharedColumns,
    /// Solution of the last solve.
    pub solution: Solution,
    /// Columns of the covariance: first the columns of the solution, then excluded error terms, then considered parameters.
    pub covariance_columns: Vec<Column>,
    /// Groups of terms that were tried, with the result of each group.
    pub candidates: Vec<Candidate>,
    /// Factor by which the tolerances of link parameters were widened.
    pub prior_scale: f64,
    /// Standard deviation of a residual of each run.
    pub sigmas: Vec<f64>,
}

/// Sigma of the residuals after a solve. It determines the weight of the residuals relative to the priors. For the cost `pose`
/// it is 1, because these residuals are whitened already.
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

/// The least-squares problem of all runs at the values of `models`, which contains one model for each run.
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

/// Factor, at least 1, by which the `sigma` of a data set increases because its errors are correlated. Correlated errors
/// contain less information than independent ones. The factor is the square root of [`Normals::overdispersion`].
///
/// The errors of different `groups` of samples are independent of each other. The residuals of `alone` are not divided by
/// `sigma`, so the dispersion is divided by `sigma^2`.
fn correlation_factor(alone: &dyn LeastSquares, model: &Model, groups: &[Vec<usize>], sigma: f64) -> f64 {
    let loss = LossName::Cauchy.for_spread(sigma, alone.rows());
    let options = Options { loss, ..Options::default() };
    let normals = Normals::new(alone, &model.start(), &options, groups).ok();
    let dispersion = normals.and_then(|normals| normals.overdispersion());
    (dispersion.unwrap_or(1.0) / sigma.powi(2)).max(1.0).sqrt()
}

/// The cost that defines the unit of the residuals, if all data sets have the same cost. Otherwise `None`, and
/// residuals are in standard deviations.
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
    /// Waves of the line spectrum that were detected in residuals.
    pub(super) waves: DetectedWaves,
}

/// Solves, chooses error terms, solves again, and sets the models to the solution.
///
/// # Errors
/// [`CalibrateError`] if the samples lack data that their cost needs, or do not determine all free parameters.
pub fn estimate(runs: &mut [Run], plan: &Plan<'_>) -> Result<Solved, CalibrateError> {
    let poor_fit = change::poor_fit(runs);
    estimate_in_steps(runs, plan).map_err(|error| match poor_fit {
        // If the angles do not fit any geometry, that error is more informative than the error of the failed solve.
        Some(poor_fit) if error.is_of_solve() => poor_fit,
        _ => error,
    })
}

fn estimate_in_steps(runs: &mut [Run], plan: &Plan<'_>) -> Result<Solved, CalibrateError> {
    let mut solver = Solver::new(runs, plan);
    solver.begins("links");
    let (mut columns, mut solution) = solver.solve_links()?;
    let rms_start = solution.summary.residual_rms_start;
    let TermChoice { candidates, prior_scale, needs_solve } = solver.choose(&mut solution)?;
    if needs_solve {
        (columns, solution) = solver.solve_with_terms()?;
    }
    solution.summary.residual_rms_start = rms_start;
    let covariance_columns = solver.add_covariance(&columns, &mut solution)?;
    let sigmas = solver.sigmas;
    Ok(Solved { columns, solution, covariance_columns, candidates, prior_scale, sigmas })
}

/// Result of the choice of terms.
struct TermChoice {
    candidates: Vec<Candidate>,
    prior_scale: f64,
    /// Whether another solve is needed, because the choice has changed terms, priors or weights.
    needs_solve: bool,
}

/// Solves for the free parameters from the current values and sets the models to the solution. No terms are tried, because
/// the solve that returned `before` has chosen them.
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

/// Whether each data set has its own value of a parameter. The parameters of the robot are common to all data sets, and
/// those of the bar to all runs with a bar, except lengths that differ. The pose of an instrument and the offsets of
/// encoders have a value for each data set, because the instrument is set up anew.
pub(super) fn is_own(id: ParameterId, own_lengths: &[ParameterId]) -> bool {
    // If the lengths differ, the bars are different and have different compliances.
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

    /// The cost that defines the unit of the residuals, if all data sets have the same one. Otherwise `None`.
    pub(super) fn residual_unit_of(&self) -> Option<CostName> {
        residual_unit_of(self.runs)
    }

    /// Factor that converts residuals for reports. If all data sets have the same cost, it converts to the
    /// unit of this cost. Otherwise it is 1.
    fn unit(&self) -> f64 {
        let first = self.sigmas.first().copied().unwrap_or(UNWEIGHTED);
        if self.residual_unit_of().is_some() { first } else { UNWEIGHTED }
    }

    /// Solves without candidate error terms. The bar has either compliance or play: the one
    /// that predicts left-out groups better.
    fn solve_links(&mut self) -> Result<(SharedColumns, Solution), CalibrateError> {
        let (columns, solution) = self.solve_with_weights()?;
        if self.replaces_compliance_by_play(solution.loss)? {
            return self.solve_with_weights();
        }
        Ok((columns, solution))
    }

    /// Chooses terms and widths of priors, starting at the solution without terms. Sets the roles of the terms and the
    /// sigmas. Also sets the loss of `solution`, which depends on the improved models.
    fn choose(&mut self, solution: &mut Solution) -> Result<TermChoice, CalibrateError> {
        let plan = self.plan;
        let mut candidates = Vec::new();
        let mut prior_scale = 1.0;
        let has_choices = !(plan.groups.is_empty() && plan.tolerances.is_empty() && plan.common.is_empty());
        let has_residuals = solution.summary.residual_rms > RESIDUAL_MIN * self.unit();
        if !(has_choices && has_residuals) {
            return Ok(TermChoice { candidates, prior_scale, needs_solve: false });
        }
        // Of the costs of the ball-bar, only `pose` has a noise model.
        let estimates_noise = self.residual_unit_of().is_none_or(|cost| cost == CostName::Pose);
        // Accepted terms reduce the noise, so the samples get more weight relative to the priors of the terms. A second
        // round chooses again with this weight.
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
        // Accepted terms reduce the residuals, so the scale of the loss must be estimated again.
        self.minimise_bars()?;
        self.last_solve()
    }

    /// Solves repeatedly until the weight of the residuals agrees with their size.
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
        // The first solve used three quantities that were computed at the nominal geometry: the whitening, the angles of
        // joints without encoder, and the weight of residuals relative to priors. Now compute them at the solution.
        //
        // If the weight is too small, the priors keep the solution near the nominal geometry, where residuals are large.
        // Therefore repeat until the weight no longer increases.
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
        // The noise estimate above changes the unit of whitened residuals. The first solve used the old unit, the last solve
        // uses the new one. The first solve ended near the point where the last solve starts. The ratio of the two rms
        // values at this point converts the rms at the start of the first solve to the new unit.
        let unit = solution.summary.residual_rms_start / first.residual_rms.max(SIGMA_MIN);
        let unit = if cost == CostName::Pose { unit } else { UNWEIGHTED };
        solution.summary.residual_rms_start = unit * first.residual_rms_start;
        Ok((columns, solution))
    }

    fn solve_any_instruments(&mut self) -> Result<(SharedColumns, Solution), CalibrateError> {
        let mut noise = self.estimate_sigmas()?;
        for _ in 0..ROUNDS_MAX {
            // The Cauchy loss reduces the influence of outliers in these iterations.
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

    /// Determines the outliers of each data set and excludes them. Returns whether the set of used samples has changed.
    fn screen(&mut self) -> bool {
        let runs = self.runs.iter_mut();
        runs.fold(false, |others, Run { instrument, model }| instrument.screen(model) || others)
    }

    /// Factor by which the errors of each data set are larger than its residuals. Residuals are smaller, because the fit
    /// adapts to the errors. The factor is `sqrt(n / (n - p))` for `n` residuals and `p` effective parameters.
    ///
    /// Without the factor, a fit with about as many terms as residuals would reduce the estimated
    /// noise in each round, down to zero.
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

    /// Estimates the sigma of each data set from its own residuals (variance components). Returns the noise of each data
    /// set, in the unit of its measurements.
    fn estimate_sigmas(&mut self) -> Result<Vec<f64>, CostError> {
        let is_joint = self.runs.len() > 1;
        let mut noise = Vec::new();
        let factors = self.errors_per_residual()?;
        for ((Run { instrument, model }, sigma), factor) in
            self.runs.iter_mut().zip(&mut self.sigmas).zip(factors)
        {
            // If an instrument estimates its own noise, its residuals are in standard deviations.
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

    /// Minimises the cost and sets the models to the minimum. Residuals are in standard deviations. The rank
    /// analysis and the covariance are omitted, because they are slow for hundreds of columns and are needed only
    /// in the last solve. Returns the loss.
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

    /// Updates quantities of the instruments that depend on the models, such as the angles of bar joints without encoder.
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

    /// Minimises the cost of ball-bar runs and sets the models to the minimum. The residuals there determine the weights of
    /// the next solve. Also estimates the scale of the loss.
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

    /// The last solve, which starts near the solution. Sets the models to the solution.
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
        // The noise has converged, so the scale of the loss is fixed. Residuals are in standard deviations,
        // except if all runs are ball-bar runs.
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
