//! Compares the solver with certified results, with another solver, and with Monte Carlo simulations.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "figures of a run")]

use crate::support::other_solver::Other;
use crate::support::{Cell, noisy_poses};
use identify::cost::{LoopProblem, Residual, Transform};
use identify::model::Selection;
use identify::solver::{
    LeastSquares, Linearisation, LossName, Options, Prior, ResidualNoise, SolveError, Termination,
    minimise_robust, solve,
};
use levenberg_marquardt::LevenbergMarquardt;
use nalgebra::{DMatrix, DVector};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use rand_distr::StandardNormal;

/// A function that returns residual and gradient of row `k` at `x`.
type Row<'a> = dyn Fn(&[f64], usize) -> (f64, Vec<f64>) + Sync + 'a;

/// A least-squares problem with scalar rows that a function computes.
struct Rows<'a> {
    columns: usize,
    samples: usize,
    row: &'a Row<'a>,
    priors: Vec<Prior>,
}

impl<'a> Rows<'a> {
    fn new(columns: usize, samples: usize, row: &'a Row<'a>) -> Self {
        Self { columns, samples, row, priors: Vec::new() }
    }
}

impl LeastSquares for Rows<'_> {
    fn columns(&self) -> usize {
        self.columns
    }

    fn samples(&self) -> usize {
        self.samples
    }

    fn rows(&self) -> usize {
        1
    }

    fn priors(&self) -> &[Prior] {
        &self.priors
    }

    fn at<'a>(&'a self, x: &[f64]) -> Linearisation<'a> {
        let x = x.to_vec();
        Box::new(move |k, residual, block| {
            let (value, gradient) = (self.row)(&x, k);
            residual[0] = value;
            for (column, derivative) in gradient.into_iter().enumerate() {
                block.column_mut(column)[0] = derivative;
            }
            // An infinite residual means that the row has no value.
            value != f64::INFINITY
        })
    }
}

fn other_solver(problem: &dyn LeastSquares, start: &[f64]) -> DVector<f64> {
    let (end, report) = LevenbergMarquardt::new().minimize(Other::new(problem, start));
    assert!(report.termination.was_successful(), "{report:?}");
    end.x
}

fn close(found: &[f64], expected: &[f64], relative: f64) {
    for (found, expected) in found.iter().zip(expected) {
        let error = (found - expected).abs() / expected.abs().max(1e-300);
        assert!(error < relative, "{found} instead of {expected}");
    }
}

/// Two columns only have an effect as their sum, and one of them has a wide prior. The solver must determine both,
/// even if the samples are very accurate.
#[test]
fn a_prior_determines_its_parameter_whatever_the_samples_are_worth() {
    for noise in [1.0, 1e-4, 1e-9] {
        let row = move |x: &[f64], k: usize| {
            let t = k as f64 / 40.0;
            ((x[0] + x[1] + t * x[2] - 3.0) / noise, vec![noise.recip(), noise.recip(), t / noise])
        };
        let mut rows = Rows::new(3, 40, &row);
        let options = Options { noise: ResidualNoise::Known, ..Options::default() };
        let solved = |rows: &Rows<'_>| solve(rows, &[2.0, 0.5, 0.3], &options).unwrap().identified();
        let error = solved(&rows).unwrap_err().to_string();
        assert!(error.contains("2 of 3") && error.contains("x0|x1 (fix 1)"), "{error}");
        rows.priors = vec![Prior { column: 1, value: 0.5, sigma: 2.0 }];
        let found = solved(&rows).unwrap();
        assert_eq!((found.identifiability.rank, found.identifiability.rank_of_samples), (3, 2));
        let sigma = |column| found.covariance.sigma(column).unwrap();
        close(&[sigma(1)], &[2.0], 1e-6);
        assert!(sigma(2) < noise, "{} {noise}", sigma(2));
    }
}

/// Data set Misra1a of NIST StRD: `y = b1 (1 - exp(-b2 x))`.
const MISRA1A: [(f64, f64); 14] = [
    (10.07, 77.6),
    (14.73, 114.9),
    (17.94, 141.1),
    (23.93, 190.8),
    (29.61, 239.9),
    (35.18, 289.0),
    (40.02, 332.8),
    (44.82, 378.4),
    (50.76, 434.8),
    (55.05, 477.3),
    (61.01, 536.8),
    (66.40, 593.1),
    (75.47, 689.1),
    (81.78, 760.0),
];

fn misra1a(b: &[f64], k: usize) -> (f64, Vec<f64>) {
    let (y, x) = MISRA1A[k];
    let e = (-b[1] * x).exp();
    (b[0] * (1.0 - e) - y, vec![1.0 - e, b[0] * x * e])
}

/// Data set MGH10 (Meyer) of NIST StRD: `y = b1 exp(b2 / (x + b3))` for x = 50, 55 ... 125.
const MGH10: [f64; 16] = [
    34780.0, 28610.0, 23650.0, 19630.0, 16370.0, 13720.0, 11540.0, 9744.0, 8261.0, 7030.0, 6005.0, 5147.0,
    4427.0, 3820.0, 3307.0, 2872.0,
];

fn mgh10(b: &[f64], k: usize) -> (f64, Vec<f64>) {
    let x = 50.0 + 5.0 * k as f64;
    let e = (b[1] / (x + b[2])).exp();
    let value = b[0] * e;
    (value - MGH10[k], vec![e, value / (x + b[2]), -value * b[1] / (x + b[2]).powi(2)])
}

fn rosenbrock(x: &[f64], k: usize) -> (f64, Vec<f64>) {
    match k {
        0 => (10.0 * (x[1] - x[0] * x[0]), vec![-20.0 * x[0], 10.0]),
        _ => (1.0 - x[0], vec![-1.0, 0.0]),
    }
}

#[test]
fn misra1a_has_its_certified_parameters_and_standard_deviations() {
    let problem = Rows::new(2, 14, &misra1a);
    for start in [[500.0, 0.0001], [250.0, 0.0005]] {
        let solution = solve(&problem, &start, &Options::default()).unwrap().identified().unwrap();
        assert!(solution.summary.termination.converged());
        close(&solution.x, &[2.3894212918e2, 5.5015643181e-4], 1e-8);
        close(&[2.0 * solution.summary.cost_end], &[1.2455138894e-1], 1e-9);
        let sigma = [solution.covariance.sigma(0).unwrap(), solution.covariance.sigma(1).unwrap()];
        close(&sigma, &[2.7070075241, 7.2668688436e-6], 1e-7);
    }
}

#[test]
fn meyers_problem_has_its_certified_parameters_and_standard_deviations() {
    let problem = Rows::new(3, 16, &mgh10);
    let start = [0.02, 4000.0, 250.0];
    let options = Options { iterations_max: 1000, ..Options::default() };
    let solution = solve(&problem, &start, &options).unwrap();
    println!("Meyer: {:?}", solution.summary);
    assert!(solution.summary.termination.converged());
    close(&solution.x, &[5.6096364710e-3, 6.1813463463e3, 3.4522363462e2], 1e-6);
    close(&[2.0 * solution.summary.cost_end], &[8.7945855171e1], 1e-8);
    let sigma: Vec<f64> = (0..3).map(|i| solution.covariance.sigma(i).unwrap()).collect();
    close(&sigma, &[1.5687892471e-4, 2.3309021107e1, 7.8486103508e-1], 1e-4);
    close(&solution.x, other_solver(&problem, &start).as_slice(), 1e-6);
}

#[test]
fn rosenbrocks_valley_ends_at_one_one() {
    let problem = Rows::new(2, 2, &rosenbrock);
    let solution = solve(&problem, &[-1.2, 1.0], &Options::default()).unwrap();
    assert!(solution.summary.termination.converged());
    close(&solution.x, &[1.0, 1.0], 1e-10);
}

/// Solves 60 noisy poses of the reference set-up with the 38 parameters of the thesis.
#[test]
fn the_closed_chain_with_noise_ends_where_another_solver_ends() {
    let cell = Cell::irb2400();
    let (observations, motion) = noisy_poses(&cell, 60, 21, 1e-3);
    let mut model = cell.model();
    model.select(Selection::Thesis, Transform::depends_on);
    let problem = LoopProblem::new(&model, &motion, &observations, Transform, 1.0).unwrap();
    let ours = solve(&problem, &model.start(), &Options::default()).unwrap();
    assert!(ours.summary.termination.converged());
    let theirs = other_solver(&problem, &model.start());
    for (column, (ours, theirs)) in ours.x.iter().zip(theirs.iter()).enumerate() {
        assert!((ours - theirs).abs() < 1e-8, "{}: {ours} against {theirs}", problem.column_name(column));
    }
}

fn decay_data(random: &mut StdRng, sigma: f64) -> Vec<f64> {
    (0..40)
        .map(|k| 2.0 * (-0.05 * f64::from(k)).exp() + 0.5 + sigma * random.sample::<f64, _>(StandardNormal))
        .collect()
}

fn decay(data: &[f64]) -> impl Fn(&[f64], usize) -> (f64, Vec<f64>) + Sync + '_ {
    |x, k| {
        let t = k as f64;
        let e = (-x[1] * t).exp();
        (x[0] * e + x[2] - data[k], vec![e, -x[0] * t * e, 1.0])
    }
}

#[test]
fn covariance_is_the_spread_over_many_noisy_repeats() {
    const REPEATS: usize = 3000;
    let sigma = 0.02;
    let mut random = StdRng::seed_from_u64(11);
    let mut found = DMatrix::zeros(REPEATS, 3);
    let mut claimed = DMatrix::zeros(3, 3);
    for repeat in 0..REPEATS {
        let data = decay_data(&mut random, sigma);
        let row = decay(&data);
        let solution = solve(&Rows::new(3, 40, &row), &[1.5, 0.1, 0.0], &Options::default()).unwrap();
        found.row_mut(repeat).copy_from_slice(&solution.x);
        claimed += DMatrix::from_fn(3, 3, |i, j| solution.covariance.between(i, j).unwrap()) / REPEATS as f64;
    }
    let mean = found.row_mean();
    found.row_iter_mut().for_each(|mut row| row -= &mean);
    let spread = found.tr_mul(&found) / (REPEATS - 1) as f64;
    for i in 0..3 {
        for j in 0..3 {
            let scale = (spread[(i, i)] * spread[(j, j)]).sqrt();
            let difference = (claimed[(i, j)] - spread[(i, j)]).abs() / scale;
            assert!(difference < 0.08, "({i}, {j}): {} against {}", claimed[(i, j)], spread[(i, j)]);
        }
    }
}

#[test]
fn known_noise_scales_the_covariance_and_estimated_noise_finds_it() {
    let mut random = StdRng::seed_from_u64(12);
    let data = decay_data(&mut random, 0.02);
    let row = decay(&data);
    let problem = Rows::new(3, 40, &row);
    let with = |noise| solve(&problem, &[1.5, 0.1, 0.0], &Options { noise, ..Options::default() }).unwrap();
    let (known, estimated) = (with(ResidualNoise::Known), with(ResidualNoise::Estimated));
    let factor = estimated.covariance.variance_factor.unwrap();
    assert!((factor.sqrt() - 0.02).abs() < 0.005);
    close(
        &[estimated.covariance.sigma(0).unwrap()],
        &[known.covariance.sigma(0).unwrap() * factor.sqrt()],
        1e-9,
    );
    assert!(estimated.covariance.correlation(0, 2).unwrap().abs() < 1.0);
    let strongest = estimated.covariance.strongest_correlations(0.0);
    assert_eq!(strongest.len(), 3);
    assert!(strongest[0].2.abs() >= strongest[2].2.abs());
}

/// Two rows determine two columns, so no residual remains from which noise could be estimated.
#[test]
fn without_a_degree_of_freedom_there_is_no_sigma_unless_the_noise_is_known() {
    let solved = |noise| {
        let options = Options { noise, ..Options::default() };
        solve(&Rows::new(2, 2, &rosenbrock), &[-1.2, 1.0], &options).unwrap().identified().unwrap()
    };
    let estimated = solved(ResidualNoise::Estimated);
    assert_eq!([0, 1].map(|column| estimated.covariance.sigma(column)), [None, None]);
    let error = estimated.require_sigmas().unwrap_err().to_string();
    assert!(error.contains("2 parameters are free"), "{error}");
    let known = solved(ResidualNoise::Known);
    assert!(known.covariance.sigma(0).is_some() && known.require_sigmas().is_ok());
}

/// Row `k` of a problem that determines x0 + x1 and x2. It does not determine x0 and x1 separately, and x3 has no effect.
fn sums(x: &[f64], k: usize) -> (f64, Vec<f64>) {
    let t = k as f64;
    (x[0] + x[1] + t * x[2] - 3.0 - 0.5 * t, vec![1.0, 1.0, t, 0.0])
}

#[test]
fn what_the_samples_do_not_determine_is_named_and_has_no_sigma() {
    let solution = solve(&Rows::new(4, 10, &sums), &[0.2, 0.1, 0.0, 7.0], &Options::default()).unwrap();
    assert_eq!(solution.identifiability.rank, 2);
    assert_eq!(solution.identifiability.zero_columns, [3]);
    assert_eq!(solution.identifiability.groups.len(), 1);
    assert_eq!(solution.identifiability.groups[0].columns, [0, 1]);
    assert_eq!(solution.covariance.sigma(0), None);
    assert!(solution.covariance.sigma(2).is_some());
    assert_eq!(solution.x[3], 7.0, "a column without effect moves nowhere");
    let message = solution.identified().unwrap_err().to_string();
    assert!(message.contains("x3") && message.contains("x0|x1"), "{message}");
}

#[test]
fn a_prior_makes_a_weak_direction_known_and_the_samples_rank_still_shows_it() {
    let mut problem = Rows::new(4, 10, &sums);
    problem.priors =
        vec![Prior { column: 0, value: 1.0, sigma: 0.1 }, Prior { column: 3, value: 2.0, sigma: 0.5 }];
    let options = Options { noise: ResidualNoise::Known, ..Options::default() };
    let solution = solve(&problem, &[0.2, 0.1, 0.0, 7.0], &options).unwrap().identified().unwrap();
    assert_eq!((solution.identifiability.rank, solution.identifiability.rank_of_samples), (4, 2));
    for (found, expected) in solution.x.iter().zip([1.0, 2.0, 0.5, 2.0]) {
        assert!((found - expected).abs() < 1e-9);
    }
    close(&[solution.covariance.sigma(3).unwrap()], &[0.5], 1e-9);
    close(&[solution.covariance.sigma(0).unwrap()], &[0.1], 1e-9);
}

#[test]
fn robust_losses_ignore_outliers_that_pull_least_squares_away() {
    let mut random = StdRng::seed_from_u64(13);
    let mut data = decay_data(&mut random, 0.01);
    data.iter_mut().step_by(5).for_each(|y| *y += 1.5);
    let row = decay(&data);
    let problem = Rows::new(3, 40, &row);
    let error = |loss| {
        let start = [1.5, 0.1, 0.0];
        let (x, _) = minimise_robust(&problem, &start, loss, &Options::default()).unwrap();
        (x[0] - 2.0).abs() + (x[2] - 0.5).abs()
    };
    let plain = error(LossName::None);
    assert!(plain > 0.2, "{plain}");
    for loss in [LossName::Cauchy, LossName::GemanMcclure] {
        assert!(error(loss) < 0.1, "{loss:?}: {}", error(loss));
    }
    assert!(error(LossName::Huber) < 0.5 * plain);
}

#[test]
fn samples_without_a_value_are_left_out_and_counted() {
    let row = |x: &[f64], k: usize| {
        let (r, j) = sums(x, k);
        (if k < 4 { f64::INFINITY } else { r }, j)
    };
    let solution = solve(&Rows::new(4, 10, &row), &[0.0; 4], &Options::default()).unwrap();
    assert_eq!((solution.summary.samples_used, solution.summary.samples_left_out), (6, 4));
    assert_eq!(solution.sample_weights[0], 0.0);
}

#[test]
fn a_solve_that_cannot_start_says_why() {
    let nothing = |_: &[f64], _: usize| (f64::INFINITY, vec![0.0]);
    let nan = |_: &[f64], k: usize| (if k == 3 { f64::NAN } else { 0.0 }, vec![1.0]);
    let options = Options::default();
    assert_eq!(
        solve(&Rows::new(1, 5, &nothing), &[0.0], &options).unwrap_err(),
        SolveError::NoSamples { samples: 5 }
    );
    assert_eq!(
        solve(&Rows::new(1, 5, &nan), &[0.0], &options).unwrap_err(),
        SolveError::NotFinite { sample: 3 }
    );
    assert_eq!(solve(&Rows::new(0, 5, &nan), &[], &options).unwrap_err(), SolveError::NothingFree);
    assert_eq!(
        solve(&Rows::new(1, 5, &nan), &[], &options).unwrap_err(),
        SolveError::StartLength { found: 0, expected: 1 }
    );
}

#[test]
fn an_iteration_limit_is_not_called_convergence() {
    let options = Options { iterations_max: 2, ..Options::default() };
    let solution = solve(&Rows::new(2, 2, &rosenbrock), &[-1.2, 1.0], &options).unwrap();
    assert_eq!(solution.summary.termination, Termination::IterationLimit);
    assert!(!solution.summary.termination.converged());
}

/// The derivatives have the wrong sign, so every step increases the cost.
#[test]
fn steps_that_were_all_refused_are_not_called_convergence() {
    let climbing = |x: &[f64], k: usize| (x[0] - k as f64, vec![-1.0]);
    let solution = solve(&Rows::new(1, 5, &climbing), &[9.0], &Options::default()).unwrap();
    assert_eq!(solution.summary.termination, Termination::NoDecrease);
    assert!(!solution.summary.termination.converged());
    assert_eq!((solution.x[0], solution.summary.iterations), (9.0, 0));
}

/// At the minimum, one sample has no value, as beyond the end of a log.
#[test]
fn a_minimum_that_costs_a_sample_is_not_called_convergence() {
    let row = |x: &[f64], k: usize| {
        let beyond = k == 0 && x[0] > 2.0;
        (if beyond { f64::INFINITY } else { x[0] - 5.0 + 0.1 * k as f64 }, vec![1.0])
    };
    let solution = solve(&Rows::new(1, 5, &row), &[0.0], &Options::default()).unwrap();
    assert!(!solution.summary.termination.converged(), "{}", solution.summary.termination);
    assert!(solution.x[0] <= 2.0);
}

/// A straight line. The samples have one, two, three, one, two, three .. rows.
struct Ragged<'a>(&'a [f64]);

impl LeastSquares for Ragged<'_> {
    fn columns(&self) -> usize {
        2
    }

    fn samples(&self) -> usize {
        self.0.len() / 2
    }

    fn rows(&self) -> usize {
        3
    }

    fn rows_of(&self, sample: usize) -> usize {
        sample % 3 + 1
    }

    fn at<'a>(&'a self, x: &[f64]) -> Linearisation<'a> {
        let x = x.to_vec();
        Box::new(move |sample, residual, block| {
            let first = sample / 3 * 6 + [0, 1, 3][sample % 3];
            for (row, r) in residual.iter_mut().enumerate() {
                let t = (first + row) as f64;
                *r = x[0] + x[1] * t - self.0[first + row];
                block.column_mut(0)[row] = 1.0;
                block.column_mut(1)[row] = t;
            }
            true
        })
    }
}

/// Measured samples with one row `x_j - k` each, where `j` is each of two columns in turn. A
/// known sample with three rows follows.
struct BesideKnown {
    measured: usize,
}

impl LeastSquares for BesideKnown {
    fn columns(&self) -> usize {
        2
    }

    fn samples(&self) -> usize {
        self.measured + 1
    }

    fn rows(&self) -> usize {
        1
    }

    fn rows_of(&self, sample: usize) -> usize {
        if self.is_known(sample) { 3 } else { 1 }
    }

    fn is_known(&self, sample: usize) -> bool {
        sample == self.measured
    }

    fn at<'a>(&'a self, x: &[f64]) -> Linearisation<'a> {
        let x = x.to_vec();
        Box::new(move |sample, residual, block| {
            for (row, r) in residual.iter_mut().enumerate() {
                let column = (sample + row) % 2;
                *r = x[column] - (sample + row) as f64;
                block.column_mut(column)[row] = 1.0;
            }
            true
        })
    }
}

/// The solution of each column must be the mean of the numbers `k` of its rows. Rows are reduced in blocks. The result must
/// not depend on the position of the known sample's rows in a block.
#[test]
fn a_known_sample_with_more_rows_than_the_measured_ones_counts_whole() {
    for measured in 230..=250 {
        let numbers = |column: usize| (column..measured + 3).step_by(2).map(|number| number as f64);
        let mean = |column: usize| numbers(column).sum::<f64>() / numbers(column).count() as f64;
        let solution = solve(&BesideKnown { measured }, &[0.0; 2], &Options::default()).unwrap();
        for column in 0..2 {
            let error = solution.x[column] - mean(column);
            assert!(error.abs() < 1e-9, "{measured} measured samples: x{column} is off by {error}");
        }
    }
}

#[test]
fn samples_of_different_numbers_of_residuals_count_by_each_of_them() {
    let mut random = StdRng::seed_from_u64(17);
    let noisy = |k: i32| 1.0 + 0.3 * f64::from(k) + random.sample::<f64, _>(StandardNormal);
    let data: Vec<f64> = (0..600).map(noisy).collect();
    let row = |x: &[f64], k: usize| (x[0] + x[1] * k as f64 - data[k], vec![1.0, k as f64]);
    let options = Options::default();
    let ragged = solve(&Ragged(&data), &[0.0, 0.0], &options).unwrap();
    let single = solve(&Rows::new(2, 600, &row), &[0.0, 0.0], &options).unwrap();
    close(&ragged.x, &single.x, 1e-9);
    let sigmas = |of: &identify::solver::Solution| [0, 1].map(|column| of.covariance.sigma(column).unwrap());
    close(&sigmas(&ragged), &sigmas(&single), 1e-9);
    close(&[ragged.summary.residual_rms], &[single.summary.residual_rms], 1e-9);
}
