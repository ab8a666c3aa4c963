//! Levenberg-Marquardt with Marquardt's column scaling and Nielsen's damping.
//!
//! References: Marquardt 1963; More 1978 (scaling that only grows); Nielsen, IMM-REP-1999-05 (damping by the gain
//! ratio); Madsen, Nielsen, Tingleff 2004.

use nalgebra::{DMatrix, DVector};

use super::identifiability::{at_solution, require_start};
use super::pass::{Pass, PassError, Products, SampleFit, Taking};
use super::{Options, Problem, Solution, SolveError, Summary, Termination};

/// Normal equations at a point.
struct Linearization {
    cost: f64,
    normal: DMatrix<f64>,
    gradient: DVector<f64>,
    fits: Vec<SampleFit>,
}

fn linearize<P: Problem>(pass: &Pass<'_, P>) -> Result<Linearization, PassError> {
    let Pass { problem, x, loss, .. } = *pass;
    let (products, fits) = pass.run(|| Products::new(problem.columns()))?;
    let (mut normal, mut gradient) = products.normal_equations();
    let mut twice: f64 = fits.iter().filter(|fit| fit.present).map(|fit| loss.rho(fit.squared)).sum();
    for prior in problem.priors() {
        let (column, weight) = (prior.column, prior.sigma.powi(-2));
        let error = x[column] - prior.value;
        normal[(column, column)] += weight;
        gradient[column] += weight * error;
        twice += weight * error * error;
    }
    Ok(Linearization { cost: 0.5 * twice, normal, gradient, fits })
}

/// Damping and scaling between steps.
struct Damping {
    lambda: f64,
    growth: f64,
    /// Squared column norms, the largest seen so far.
    scale_squared: DVector<f64>,
}

impl Damping {
    fn new(lambda: f64, normal: &DMatrix<f64>) -> Self {
        let mut damping = Self { lambda, growth: 2.0, scale_squared: DVector::zeros(normal.nrows()) };
        damping.rescale(normal);
        damping
    }

    fn rescale(&mut self, normal: &DMatrix<f64>) {
        for (scale, found) in self.scale_squared.iter_mut().zip(normal.diagonal().iter()) {
            *scale = scale.max(*found);
        }
    }

    /// Step of `(H + lambda D) step = -g` and the decrease it promises.
    ///
    /// A column that does nothing gets no step, rather than a singular matrix: it is named afterwards.
    fn step(&self, at: &Linearization) -> Option<(DVector<f64>, f64)> {
        let inverse_scale = self.scale_squared.map(|s| if s > 0.0 { s.sqrt().recip() } else { 0.0 });
        let mut scaled = at.normal.clone();
        for (j, mut column) in scaled.column_iter_mut().enumerate() {
            column.component_mul_assign(&inverse_scale);
            column *= inverse_scale[j];
            column[j] += if self.scale_squared[j] > 0.0 { self.lambda } else { 1.0 };
        }
        let scaled_gradient = at.gradient.component_mul(&inverse_scale);
        let scaled_step = scaled.cholesky()?.solve(&-&scaled_gradient);
        let predicted = 0.5 * (self.lambda * scaled_step.norm_squared() - scaled_step.dot(&scaled_gradient));
        Some((scaled_step.component_mul(&inverse_scale), predicted))
    }

    fn accept(&mut self, gain: f64) {
        // Nielsen's rule, with a faster fall after a step that kept its promise.
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

/// Root mean square of the residual entries of the samples that take part.
fn residual_rms(fits: &[SampleFit], rows: usize) -> f64 {
    let (count, sum) = fits
        .iter()
        .filter(|fit| fit.present)
        .fold((0usize, 0.0), |(count, sum), fit| (count + rows, sum + fit.squared));
    if count == 0 { 0.0 } else { (sum / count as f64).sqrt() }
}

/// Largest cosine between the residual and a column.
fn gradient_cosine(at: &Linearization) -> f64 {
    let norm = (2.0 * at.cost).sqrt();
    if norm == 0.0 {
        return 0.0;
    }
    let diagonal = at.normal.diagonal();
    let cosines = at.gradient.iter().zip(diagonal.iter()).filter(|(_, d)| **d > 0.0);
    cosines.map(|(g, d)| (g / (d.sqrt() * norm)).abs()).fold(0.0, f64::max)
}

/// What the descent hands on.
struct Descent {
    x: DVector<f64>,
    at: Linearization,
    termination: Termination,
    iterations: usize,
    evaluations: usize,
}

/// The iteration itself.
fn descend<P: Problem>(
    problem: &P,
    start: Linearization,
    x: DVector<f64>,
    options: &Options<'_>,
) -> Result<Descent, SolveError> {
    let mut damping = Damping::new(options.damping_start, &start.normal);
    let mut now =
        Descent { x, at: start, termination: Termination::IterationLimit, iterations: 0, evaluations: 1 };
    while now.iterations < options.iterations_max {
        if now.at.cost == 0.0 {
            now.termination = Termination::ZeroResidual;
            return Ok(now);
        }
        if gradient_cosine(&now.at) <= options.gradient_tolerance {
            now.termination = Termination::SmallGradient;
            return Ok(now);
        }
        if damping.exhausted() {
            now.termination = Termination::NoDecrease;
            return Ok(now);
        }
        let Some((step, predicted)) = damping.step(&now.at) else {
            damping.refuse();
            continue;
        };
        let small_step = damping.scaled_norm(&step) <= options.step_tolerance * damping.scaled_norm(&now.x);
        let trial_x = &now.x + &step;
        let taking = Taking::These(&now.at.fits);
        let mut pass = Pass::new(problem, trial_x.as_slice(), options, taking);
        pass.progress = (now.iterations, options.iterations_max, Some(now.at.cost));
        let trial = linearize(&pass);
        now.evaluations += 1;
        if matches!(trial, Err(PassError::Cancelled)) {
            return Err(SolveError::Cancelled { iterations: now.iterations });
        }
        let decrease = trial.as_ref().map_or(f64::NEG_INFINITY, |trial| now.at.cost - trial.cost);
        let negligible = options.cost_tolerance * now.at.cost;
        let small_decrease = decrease.abs() <= negligible && predicted <= negligible;
        if let Ok(trial) = trial
            && decrease > 0.0
        {
            damping.accept(decrease / predicted);
            damping.rescale(&trial.normal);
            now.x = trial_x;
            now.at = trial;
            now.iterations += 1;
        } else {
            damping.refuse();
        }
        if small_step || small_decrease {
            now.termination = if small_step { Termination::SmallStep } else { Termination::SmallDecrease };
            return Ok(now);
        }
    }
    Ok(now)
}

/// The descent of [`solve`] alone, without a word on rank and covariance: for studies that solve thousands of times.
///
/// # Errors
/// As [`solve`].
pub fn minimise<P: Problem>(
    problem: &P,
    start: &[f64],
    options: &Options<'_>,
) -> Result<(Vec<f64>, Summary), SolveError> {
    descended(problem, start, options).map(|(x, summary, _)| (x.as_slice().to_vec(), summary))
}

/// The minimum, how it was reached, and each sample's fit there.
fn descended<P: Problem>(
    problem: &P,
    start: &[f64],
    options: &Options<'_>,
) -> Result<(DVector<f64>, Summary, Vec<SampleFit>), SolveError> {
    let columns = problem.columns();
    if columns == 0 {
        return Err(SolveError::NothingFree);
    }
    require_start(problem, start)?;
    let x = DVector::from_column_slice(start);
    let first = linearize(&Pass::new(problem, start, options, Taking::WhatIsThere))
        .map_err(|error| error.at_start(problem.samples()))?;
    let samples_used = first.fits.iter().filter(|fit| fit.present).count();
    if samples_used == 0 {
        return Err(SolveError::NoSamples { samples: problem.samples() });
    }
    let (cost_start, residual_rms_start) = (first.cost, residual_rms(&first.fits, problem.rows()));
    let end = descend(problem, first, x, options)?;
    let summary = Summary {
        termination: end.termination,
        iterations: end.iterations,
        evaluations: end.evaluations,
        cost_start,
        cost_end: end.at.cost,
        residual_rms_start,
        residual_rms: residual_rms(&end.at.fits, problem.rows()),
        samples_used,
        samples_left_out: problem.samples() - samples_used,
    };
    Ok((end.x, summary, end.at.fits))
}

/// Minimises a problem from `start`, and says at the end what was identified and how well.
///
/// Free parameters that the samples do not determine stay near their start and are named in
/// [`Solution::identifiability`]; [`Solution::identified`] turns them into an error.
///
/// # Errors
/// [`SolveError`] where the solve cannot start or was cancelled.
pub fn solve<P: Problem>(problem: &P, start: &[f64], options: &Options<'_>) -> Result<Solution, SolveError> {
    let (x, summary, fits) = descended(problem, start, options)?;
    let (identifiability, covariance) = at_solution(problem, x.as_slice(), options, &fits)?;
    let sample_weights = fits.iter().map(|fit| fit.weight).collect();
    Ok(Solution { x: x.as_slice().to_vec(), summary, identifiability, covariance, sample_weights })
}
