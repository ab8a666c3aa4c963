//! Levenberg-Marquardt with Marquardt's column scaling and Nielsen's damping.
//!
//! References: Marquardt 1963; More 1978 (scaling that only grows); Nielsen, IMM-REP-1999-05 (damping by the gain
//! ratio); Madsen, Nielsen, Tingleff 2004.

use nalgebra::DVector;

use super::information::identifiability::{at_solution, require_start};
use super::pass::{Pass, PassError, Products, SampleFit, Taking};
use super::{Normal, Options, Problem, ScaledCholesky, Solution, SolveError, Summary, Termination};

/// Cost and normal equations at a point, with the priors.
struct QuadraticModel {
    cost: f64,
    normal: Normal,
    fits: Vec<SampleFit>,
}

fn quadratic_model(pass: &Pass<'_>) -> Result<QuadraticModel, PassError> {
    let Pass { problem, x, .. } = *pass;
    let (products, fits) = pass.run(|| Products::new(problem.columns()))?;
    let mut normal = products.normal(0.0);
    let of_samples: f64 = fits.iter().map(|fit| fit.cost).sum();
    let of_priors = normal.add_priors(problem.priors(), x);
    Ok(QuadraticModel { cost: 0.5 * (of_samples + of_priors), normal, fits })
}

/// Damping and scaling between steps.
struct Damping {
    lambda: f64,
    growth: f64,
    /// Squared column norms, the largest seen so far.
    scale_squared: DVector<f64>,
}

impl Damping {
    fn new(lambda: f64, normal: &Normal) -> Self {
        let mut damping = Self { lambda, growth: 2.0, scale_squared: DVector::zeros(normal.gradient.len()) };
        damping.rescale(normal);
        damping
    }

    fn rescale(&mut self, normal: &Normal) {
        for (scale, found) in self.scale_squared.iter_mut().zip(normal.matrix.diagonal().iter()) {
            *scale = scale.max(*found);
        }
    }

    /// Step of `(H + lambda D) step = -g` and the decrease it promises.
    ///
    /// A column that does nothing gets no step, rather than a singular matrix: it is named afterwards.
    fn step(&self, at: &QuadraticModel, lambda: f64) -> Option<(DVector<f64>, f64)> {
        let Normal { matrix, gradient, .. } = &at.normal;
        let step = -ScaledCholesky::damped(matrix.clone(), &self.scale_squared, lambda)?.solve(gradient);
        let predicted = 0.5 * (lambda * self.scaled_norm(&step).powi(2) - step.dot(gradient));
        Some((step, predicted))
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
fn residual_rms(fits: &[SampleFit]) -> f64 {
    let (count, sum) =
        fits.iter().fold((0usize, 0.0), |(count, sum), fit| (count + fit.rows, sum + fit.squared));
    if count == 0 { 0.0 } else { (sum / count as f64).sqrt() }
}

/// Largest cosine between the residual and a column.
fn gradient_cosine(at: &QuadraticModel) -> f64 {
    let norm = (2.0 * at.cost).sqrt();
    if norm == 0.0 {
        return 0.0;
    }
    let diagonal = at.normal.matrix.diagonal();
    let cosines = at.normal.gradient.iter().zip(diagonal.iter()).filter(|(_, d)| **d > 0.0);
    cosines.map(|(g, d)| (g / (d.sqrt() * norm)).abs()).fold(0.0, f64::max)
}

/// What the descent hands on.
struct Descent {
    x: DVector<f64>,
    at: QuadraticModel,
    termination: Termination,
    iterations: usize,
    evaluations: usize,
}

/// Where no step lowers the cost any more the solve has converged all the same if the best step promises less than this part
/// of a residual's variance: every parameter is then within a thousandth of its standard deviation of the minimum, and what
/// is left is rounding.
const NEGLIGIBLE: f64 = 1e-6;

/// Where the descent stands is a minimum, as far as the step says that hardly any damping holds back: neither a trial that
/// was refused nor heavy damping can pass for one. A step that promises no more than `negligible` is none.
fn at_minimum(
    now: &Descent,
    damping: &Damping,
    options: &Options<'_>,
    negligible: f64,
) -> Option<Termination> {
    if now.at.cost == 0.0 {
        return Some(Termination::ZeroResidual);
    }
    if gradient_cosine(&now.at) <= options.gradient_tolerance {
        return Some(Termination::SmallGradient);
    }
    let (step, promised) = damping.step(&now.at, options.damping_start)?;
    if damping.scaled_norm(&step) <= options.step_tolerance * damping.scaled_norm(&now.x) {
        return Some(Termination::SmallStep);
    }
    (promised <= negligible).then_some(Termination::SmallDecrease)
}

/// The iteration itself. Only the start and accepted steps can end it at a minimum.
fn descend(
    problem: &dyn Problem,
    start: QuadraticModel,
    x: DVector<f64>,
    options: &Options<'_>,
) -> Result<Descent, SolveError> {
    let mut damping = Damping::new(options.damping_start, &start.normal);
    let mut now =
        Descent { x, at: start, termination: Termination::IterationLimit, iterations: 0, evaluations: 1 };
    loop {
        let negligible = options.cost_tolerance * now.at.cost;
        if let Some(termination) = at_minimum(&now, &damping, options, negligible) {
            now.termination = termination;
            return Ok(now);
        }
        if now.iterations == options.iterations_max {
            return Ok(now);
        }
        if !accept_step(problem, &mut now, &mut damping, options)? {
            let used: usize = now.at.fits.iter().map(|fit| fit.rows).sum();
            let variance = 2.0 * now.at.cost / used.max(1) as f64;
            now.termination =
                at_minimum(&now, &damping, options, NEGLIGIBLE * variance).unwrap_or(Termination::NoDecrease);
            return Ok(now);
        }
    }
}

/// Tries shorter and shorter steps until one lowers the cost; false where none does.
fn accept_step(
    problem: &dyn Problem,
    now: &mut Descent,
    damping: &mut Damping,
    options: &Options<'_>,
) -> Result<bool, SolveError> {
    while !damping.exhausted() {
        let Some((step, predicted)) = damping.step(&now.at, damping.lambda) else {
            damping.refuse();
            continue;
        };
        if predicted <= options.cost_tolerance * now.at.cost {
            // Shorter steps promise nothing that could be told from rounding.
            return Ok(false);
        }
        let trial_x = &now.x + &step;
        let mut pass = Pass::new(problem, trial_x.as_slice(), options, Taking::These(&now.at.fits));
        pass.progress = (now.iterations, options.iterations_max, Some(now.at.cost));
        let trial = quadratic_model(&pass);
        now.evaluations += 1;
        match trial {
            Err(PassError::Cancelled) => return Err(SolveError::Cancelled { iterations: now.iterations }),
            Ok(trial) if trial.cost < now.at.cost => {
                damping.accept((now.at.cost - trial.cost) / predicted);
                damping.rescale(&trial.normal);
                now.x = trial_x;
                now.at = trial;
                now.iterations += 1;
                return Ok(true);
            }
            _ => damping.refuse(),
        }
    }
    Ok(false)
}

/// The descent of [`solve`] alone, without a word on rank and covariance: for studies that solve thousands of times.
///
/// # Errors
/// As [`solve`].
pub fn minimise(
    problem: &dyn Problem,
    start: &[f64],
    options: &Options<'_>,
) -> Result<(Vec<f64>, Summary), SolveError> {
    descended(problem, start, options).map(|(x, summary, _)| (x.as_slice().to_vec(), summary))
}

/// The minimum, how it was reached, and each sample's fit there.
fn descended(
    problem: &dyn Problem,
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
        cost_end: end.at.cost,
        residual_rms_start,
        residual_rms: residual_rms(&end.at.fits),
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
pub fn solve(problem: &dyn Problem, start: &[f64], options: &Options<'_>) -> Result<Solution, SolveError> {
    let (x, summary, fits) = descended(problem, start, options)?;
    let (identifiability, covariance) = at_solution(problem, x.as_slice(), options, &fits)?;
    let sample_weights = fits.iter().map(|fit| fit.weight).collect();
    let x = x.as_slice().to_vec();
    Ok(Solution { x, summary, identifiability, covariance, loss: options.loss, sample_weights })
}
