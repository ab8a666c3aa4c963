//! The minimum of a [`LeastSquares`] problem by Levenberg-Marquardt: steps `(H + lambda D) step = -g` with `H = J^T W J` and
//! `g = J^T W r` (robust weights `W`, priors added), `D` the largest diagonal of `H` so far, and Nielsen's rule for the damping
//! `lambda`.
//!
//! References: Marquardt 1963; More 1978 (monotone scaling); Nielsen, IMM-REP-1999-05 (damping by the gain
//! ratio); Madsen, Nielsen, Tingleff 2004.

use nalgebra::DVector;

use super::information::identifiability::{at_solution, require_start};
use super::pass::{Pass, PassError, Products, SampleFit, Taking};
use super::{LeastSquares, Normal, Options, ScaledCholesky, Solution, SolveError, Summary, Termination};

/// Cost and normal equations at a point, with the priors.
struct QuadraticModel {
    cost: f64,
    normal: Normal,
    fits: Vec<SampleFit>,
}

/// Reduces the samples of a pass to the model at its point. The number of rows is not needed here and stays zero.
fn quadratic_model(pass: &Pass<'_>) -> Result<QuadraticModel, PassError> {
    let Pass { problem, x, .. } = *pass;
    let (products, fits) = pass.run(|| Products::new(problem.columns()))?;
    let mut normal = products.normal(0.0);
    let cost_of_samples: f64 = fits.iter().map(|fit| fit.cost).sum();
    let cost_of_priors = normal.add_priors(problem.priors(), x);
    Ok(QuadraticModel { cost: 0.5 * (cost_of_samples + cost_of_priors), normal, fits })
}

/// Damping and scaling, updated after each step.
struct Damping {
    lambda: f64,
    /// Factor on `lambda` at the next refused step.
    growth: f64,
    /// The diagonal `D`: squared column norms, the largest seen so far.
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

    /// Step of `(H + lambda D) step = -g`, and the decrease of the cost that it predicts, `(lambda step^T D step - step^T g) / 2`.
    ///
    /// A column without effect gets a step of zero, instead of a singular matrix: identifiability names it afterwards.
    fn step(&self, model: &QuadraticModel, lambda: f64) -> Option<(DVector<f64>, f64)> {
        let Normal { matrix, gradient, .. } = &model.normal;
        let step = -ScaledCholesky::damped(matrix.clone(), &self.scale_squared, lambda)?.solve(gradient);
        let predicted = 0.5 * (lambda * self.scaled_norm(&step).powi(2) - step.dot(gradient));
        Some((step, predicted))
    }

    fn accept(&mut self, gain: f64) {
        // Nielsen's rule, with a faster decrease (0.1 in place of 1/3) of the damping if the prediction was accurate.
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

/// Largest cosine between the residual and a column.
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

/// If no step lowers the cost, the solve counts as converged when the best step predicts a smaller decrease than this part of a
/// residual's variance: every parameter is then within a thousandth of its standard deviation of the minimum, at the level of
/// rounding errors.
const NEGLIGIBLE_PART: f64 = 1e-6;

/// Whether the current point is a minimum, tested with the step at the initial, small damping: a refused trial or heavy damping
/// must not count as convergence. A step that predicts a decrease of at most `negligible` counts as zero.
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

/// The iteration. It can end at a minimum only at the start or after an accepted step.
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

/// Increases the damping until a step lowers the cost; false if none does.
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
            // Shorter steps predict a decrease below the rounding error.
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

/// The descent of [`solve`] without rank and covariance, for studies that solve thousands of times.
///
/// # Errors
/// As [`solve`].
pub fn minimise(
    problem: &dyn LeastSquares,
    start: &[f64],
    options: &Options<'_>,
) -> Result<(Vec<f64>, Summary), SolveError> {
    find_minimum(problem, start, options).map(|(x, summary, _)| (x.as_slice().to_vec(), summary))
}

/// The minimum, its summary, and each sample's fit there.
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
    let (cost_start, residual_rms_start) = (first.cost, residual_rms(&first.fits));
    let end = descend(problem, first, x, options)?;
    let summary = Summary {
        termination: end.termination,
        iterations: end.iterations,
        evaluations: end.evaluations,
        cost_start,
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
/// Free parameters that the samples do not determine stay near their start. [`Solution::identifiability`] names them;
/// [`Solution::identified`] returns an error for them.
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
