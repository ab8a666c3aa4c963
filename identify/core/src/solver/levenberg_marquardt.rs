//! Minimises a [`LeastSquares`] problem by the Levenberg-Marquardt method.
//!
//! Each step solves `(H + lambda D) step = -g` with `H = J^T W J` and `g = J^T W r`. `W` contains the robust weights; priors
//! are added to `H` and `g`. `D` is the largest diagonal of `H` so far. The damping `lambda` follows Nielsen's rule: a step
//! that lowers the cost is accepted and reduces the damping, any other step is refused and increases it.
//!
//! References: Marquardt 1963; More 1978 (monotone scaling); Nielsen, IMM-REP-1999-05 (damping by the gain ratio);
//! Madsen, Nielsen, Tingleff 2004.

use nalgebra::DVector;

use super::information::identifiability::{at_solution, require_start};
use super::pass::{Pass, PassError, Products, SampleFit, Taking};
use super::{LeastSquares, Normal, Options, ScaledCholesky, Solution, SolveError, Summary, Termination};

/// Cost, normal equations and sample fits at a point. Cost and normal equations include the priors.
struct QuadraticModel {
    cost: f64,
    normal: Normal,
    fits: Vec<SampleFit>,
}

/// Computes the model at the point of a pass. `Normal::rows` is not needed here and stays zero.
fn quadratic_model(pass: &Pass<'_>) -> Result<QuadraticModel, PassError> {
    let Pass { problem, x, .. } = *pass;
    let (products, fits) = pass.run(|| Products::new(problem.columns()))?;
    let mut normal = products.normal(0.0);
    let cost_of_samples: f64 = fits.iter().map(|fit| fit.cost).sum();
    let cost_of_priors = normal.add_priors(problem.priors(), x);
    Ok(QuadraticModel { cost: 0.5 * (cost_of_samples + cost_of_priors), normal, fits })
}

/// Damping `lambda` and scaling `D`, updated after each step.
struct Damping {
    lambda: f64,
    /// Factor on `lambda` at the next refused step.
    growth: f64,
    /// The diagonal `D`: for each column, the largest squared norm so far.
    scale_squared: DVector<f64>,
}

impl Damping {
    fn new(lambda: f64, normal: &Normal) -> Self {
        let mut damping = Self { lambda, growth: 2.0, scale_squared: DVector::zeros(normal.gradient.len()) };
        damping.rescale(normal);
        damping
    }

    fn rescale(&mut self, normal: &Normal) {
        for (largest, squared_norm) in self.scale_squared.iter_mut().zip(normal.matrix.diagonal().iter()) {
            *largest = largest.max(*squared_norm);
        }
    }

    /// Solves `(H + lambda D) step = -g`. Returns the step and its predicted decrease of the cost,
    /// `(lambda step^T D step - step^T g) / 2`. `None` if the matrix cannot be factorised.
    ///
    /// For a column without effect on the residuals the step is zero, so such a column does not make the matrix singular.
    /// The identifiability at the solution lists such columns.
    fn step(&self, model: &QuadraticModel, lambda: f64) -> Option<(DVector<f64>, f64)> {
        let Normal { matrix, gradient, .. } = &model.normal;
        let step = -ScaledCholesky::damped(matrix.clone(), &self.scale_squared, lambda)?.solve(gradient);
        let predicted = 0.5 * (lambda * self.scaled_norm(&step).powi(2) - step.dot(gradient));
        Some((step, predicted))
    }

    fn accept(&mut self, gain: f64) {
        // Nielsen's rule. After an accurate prediction, the damping falls by the factor 0.1 rather than Nielsen's 1/3.
        self.lambda *= (1.0 - (2.0 * gain - 1.0).powi(3)).max(0.1);
        self.growth = 2.0;
    }

    fn refuse(&mut self) {
        self.lambda *= self.growth;
        self.growth *= 2.0;
    }

    fn exhausted(&self) -> bool {
        self.lambda > 1e20
    }

    fn scaled_norm(&self, v: &DVector<f64>) -> f64 {
        v.iter().zip(self.scale_squared.iter()).map(|(v, s)| v * v * s).sum::<f64>().sqrt()
    }
}

/// Root mean square of the residual entries of the samples in use.
fn residual_rms(fits: &[SampleFit]) -> f64 {
    let (count, sum) =
        fits.iter().fold((0usize, 0.0), |(count, sum), fit| (count + fit.rows, sum + fit.squared));
    if count == 0 { 0.0 } else { (sum / count as f64).sqrt() }
}

/// Largest cosine of the angle between the residual and a column of the Jacobian.
fn gradient_cosine(model: &QuadraticModel) -> f64 {
    let residual_norm = (2.0 * model.cost).sqrt();
    if residual_norm == 0.0 {
        return 0.0;
    }
    let squared_norms = model.normal.matrix.diagonal();
    let columns = model.normal.gradient.iter().zip(squared_norms.iter()).filter(|(_, d)| **d > 0.0);
    columns.map(|(g, d)| (g / (d.sqrt() * residual_norm)).abs()).fold(0.0, f64::max)
}

/// State of the iteration.
struct Descent {
    x: DVector<f64>,
    /// The model at `x`.
    model: QuadraticModel,
    termination: Termination,
    iterations: usize,
    evaluations: usize,
}

/// Limit for convergence when no step lowers the cost: the best step predicts a decrease below this fraction of a
/// residual's variance. Every parameter is then within a thousandth of its standard deviation of the minimum. Rounding
/// errors prevent a closer approach.
const NEGLIGIBLE_PART: f64 = 1e-6;

/// Tests whether the current point is a minimum. Returns the criterion that is met, or `None`. The test uses a step with the
/// small initial damping, because a step that is short due to heavy damping does not indicate convergence. A predicted
/// decrease of at most `negligible` counts as zero.
fn at_minimum(
    now: &Descent,
    damping: &Damping,
    options: &Options<'_>,
    negligible: f64,
) -> Option<Termination> {
    if now.model.cost == 0.0 {
        return Some(Termination::ZeroResidual);
    }
    if gradient_cosine(&now.model) <= options.gradient_tolerance {
        return Some(Termination::SmallGradient);
    }
    let (step, predicted) = damping.step(&now.model, options.damping_start)?;
    if damping.scaled_norm(&step) <= options.step_tolerance * damping.scaled_norm(&now.x) {
        return Some(Termination::SmallStep);
    }
    (predicted <= negligible).then_some(Termination::SmallDecrease)
}

/// Iterates until the point is a minimum, no step lowers the cost, or the iteration limit is reached. The test for a minimum
/// takes place at the start, after each accepted step, and once when no step is accepted.
fn descend(
    problem: &dyn LeastSquares,
    start: QuadraticModel,
    x: DVector<f64>,
    options: &Options<'_>,
) -> Result<Descent, SolveError> {
    let mut damping = Damping::new(options.damping_start, &start.normal);
    let mut now =
        Descent { x, model: start, termination: Termination::IterationLimit, iterations: 0, evaluations: 1 };
    loop {
        let negligible = options.cost_tolerance * now.model.cost;
        if let Some(termination) = at_minimum(&now, &damping, options, negligible) {
            now.termination = termination;
            return Ok(now);
        }
        if now.iterations == options.iterations_max {
            return Ok(now);
        }
        if !accept_step(problem, &mut now, &mut damping, options)? {
            let rows: usize = now.model.fits.iter().map(|fit| fit.rows).sum();
            let variance = 2.0 * now.model.cost / rows.max(1) as f64;
            now.termination = at_minimum(&now, &damping, options, NEGLIGIBLE_PART * variance)
                .unwrap_or(Termination::NoDecrease);
            return Ok(now);
        }
    }
}

/// Increases the damping until a step lowers the cost, and accepts this step. Returns false if no step lowers the cost.
fn accept_step(
    problem: &dyn LeastSquares,
    now: &mut Descent,
    damping: &mut Damping,
    options: &Options<'_>,
) -> Result<bool, SolveError> {
    while !damping.exhausted() {
        let Some((step, predicted)) = damping.step(&now.model, damping.lambda) else {
            damping.refuse();
            continue;
        };
        if predicted <= options.cost_tolerance * now.model.cost {
            // A larger damping would give a shorter step with a still smaller predicted decrease.
            return Ok(false);
        }
        let trial_x = &now.x + &step;
        let mut pass = Pass::new(problem, trial_x.as_slice(), options, Taking::These(&now.model.fits));
        (pass.progress.iteration, pass.progress.cost) = (now.iterations, Some(now.model.cost));
        let trial = quadratic_model(&pass);
        now.evaluations += 1;
        match trial {
            Err(PassError::Cancelled) => return Err(SolveError::Cancelled { iterations: now.iterations }),
            Ok(trial) if trial.cost < now.model.cost => {
                damping.accept((now.model.cost - trial.cost) / predicted);
                damping.rescale(&trial.normal);
                now.x = trial_x;
                now.model = trial;
                now.iterations += 1;
                return Ok(true);
            }
            _ => damping.refuse(),
        }
    }
    Ok(false)
}

/// Minimises like [`solve`], but does not compute rank and covariance. Used by studies that solve thousands of problems.
///
/// # Errors
/// The errors of [`solve`].
pub fn minimise(
    problem: &dyn LeastSquares,
    start: &[f64],
    options: &Options<'_>,
) -> Result<(Vec<f64>, Summary), SolveError> {
    find_minimum(problem, start, options).map(|(x, summary, _)| (x.as_slice().to_vec(), summary))
}

/// Returns the minimum, its summary, and the fit of each sample at the minimum.
fn find_minimum(
    problem: &dyn LeastSquares,
    start: &[f64],
    options: &Options<'_>,
) -> Result<(DVector<f64>, Summary, Vec<SampleFit>), SolveError> {
    let columns = problem.columns();
    if columns == 0 {
        return Err(SolveError::NothingFree);
    }
    require_start(problem, start)?;
    let x = DVector::from_column_slice(start);
    let first = quadratic_model(&Pass::new(problem, start, options, Taking::WhatIsThere))
        .map_err(|error| error.at_start(problem.samples()))?;
    let samples_used = first.fits.iter().filter(|fit| fit.present).count();
    if samples_used == 0 {
        return Err(SolveError::NoSamples { samples: problem.samples() });
    }
    let residual_rms_start = residual_rms(&first.fits);
    let end = descend(problem, first, x, options)?;
    let summary = Summary {
        termination: end.termination,
        iterations: end.iterations,
        evaluations: end.evaluations,
        cost_end: end.model.cost,
        residual_rms_start,
        residual_rms: residual_rms(&end.model.fits),
        samples_used,
        samples_left_out: problem.samples() - samples_used,
    };
    Ok((end.x, summary, end.model.fits))
}

/// Minimises a problem from `start`, and evaluates identifiability and covariance at the minimum.
///
/// Free parameters that the samples do not determine stay near their start. They are listed in
/// [`Solution::identifiability`], and [`Solution::identified`] returns an error if there are any.
///
/// # Errors
/// [`SolveError`] if the solve cannot start or was cancelled.
pub fn solve(
    problem: &dyn LeastSquares,
    start: &[f64],
    options: &Options<'_>,
) -> Result<Solution, SolveError> {
    let (x, summary, fits) = find_minimum(problem, start, options)?;
    let (identifiability, covariance) =
        at_solution(problem, x.as_slice(), options, &fits, summary.iterations)?;
    let sample_weights = fits.iter().map(|fit| fit.weight).collect();
    let x = x.as_slice().to_vec();
    Ok(Solution { x, summary, identifiability, covariance, loss: options.loss, sample_weights })
}
