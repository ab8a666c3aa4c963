//! Efficiency of the cost `pose`: its errors relative to the Cramer-Rao bound, the coverage of its intervals, and the effect
//! of gross outliers. `CAMPAIGNS=full` evaluates more seeds.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "figures of a run")]

use crate::support::campaign::size;
use crate::support::{Cell, spread_poses};
use identify::cost::{AngleNoise, LoopProblem, Residual, Transform, WhitenedPose};
use identify::model::{Model, Observation, ParameterId, PerObservation, Selection};
use identify::simulate::THESIS_ERRORS;
use identify::solver::{LossName, Options, ResidualNoise, Solution, minimise, minimise_robust, solve};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use rand_distr::StandardNormal;

const NOISE: AngleNoise = AngleNoise { encoder_rad: 10e-6, robot_rad: 10e-6 };

fn seeds() -> u64 {
    size(40, 200)
}

struct Setup {
    model: Model,
    truth: Vec<f64>,
    observations: Vec<Observation>,
    joints: PerObservation,
}

impl Setup {
    fn new(poses: usize) -> Self {
        let cell = Cell::irb2400();
        let mut model = cell.model();
        model.select(Selection::Cell, WhitenedPose::identifies);
        let mut true_model = model.clone();
        for (name, error) in THESIS_ERRORS {
            let id: ParameterId = name.parse().unwrap();
            let value = true_model.parameter(id).unwrap().value;
            true_model.set_value(id, value + error * 1e-3).unwrap();
        }
        let truth = true_model.start();
        let geometry = true_model.geometry(&truth);
        let (observations, joints) = spread_poses(&geometry.robot, &geometry.bar_chain(), poses, 3);
        Self { model, truth, observations, joints }
    }

    fn measured(&self, seed: u64) -> (Vec<Observation>, PerObservation) {
        let (mut observations, mut joints) = (self.observations.clone(), self.joints.clone());
        let mut random = StdRng::seed_from_u64(seed);
        let mut noise = |sigma: f64| sigma * random.sample::<f64, _>(StandardNormal);
        observations.iter_mut().flat_map(|o| &mut o.bar_rad).for_each(|b| *b += noise(NOISE.encoder_rad));
        joints.0.iter_mut().flatten().for_each(|q| *q += noise(NOISE.robot_rad));
        (observations, joints)
    }

    /// Solves in the same way as a calibration: residuals are whitened at the nominal
    /// geometry, and again at the first solution.
    fn pose(&self, (observations, joints): &(Vec<Observation>, PerObservation), loss: LossName) -> Solution {
        let solve_from = |x: &[f64]| {
            let whitened = WhitenedPose::new(&self.model.geometry(x), joints, observations, NOISE);
            let problem = LoopProblem::new(&self.model, joints, observations, whitened, 1.0).unwrap();
            let options = Options::default();
            let (x, _) = minimise_robust(&problem, x, loss, &options).unwrap();
            let loss = loss.for_spread_at(&problem, &x);
            solve(&problem, &x, &Options { loss, ..options }).unwrap()
        };
        let first = solve_from(&self.model.start());
        solve_from(&first.x).identified().unwrap()
    }

    fn transform(&self, (observations, joints): &(Vec<Observation>, PerObservation)) -> Vec<f64> {
        let problem = LoopProblem::new(&self.model, joints, observations, Transform, 1.0).unwrap();
        minimise(&problem, &self.model.start(), &Options::default()).unwrap().0
    }

    /// Standard deviations at the true parameters for known noise. They are the lower bound for any unbiased estimate.
    fn bound(&self) -> Vec<f64> {
        let geometry = self.model.geometry(&self.truth);
        let whitened = WhitenedPose::new(&geometry, &self.joints, &self.observations, NOISE);
        let problem = LoopProblem::new(&self.model, &self.joints, &self.observations, whitened, 1.0).unwrap();
        let options = Options { noise: ResidualNoise::Known, ..Options::default() };
        let solution = solve(&problem, &self.truth, &options).unwrap();
        (0..self.truth.len()).map(|column| solution.covariance.sigma(column).unwrap()).collect()
    }

    fn errors(&self, x: &[f64]) -> Vec<f64> {
        x.iter().zip(&self.truth).map(|(x, truth)| x - truth).collect()
    }
}

/// Root mean square error of each parameter divided by its bound, averaged over the parameters.
fn over_bound(errors: &[Vec<f64>], bound: &[f64]) -> f64 {
    let of = |(column, bound): (usize, &f64)| {
        let squares: f64 = errors.iter().map(|error| error[column].powi(2)).sum();
        (squares / errors.len() as f64).sqrt() / bound
    };
    bound.iter().enumerate().map(of).sum::<f64>() / bound.len() as f64
}

#[test]
#[ignore = "dozens of solves: a quarter of a minute"]
fn pose_reaches_the_cramer_rao_bound_and_its_intervals_hold() {
    let setup = Setup::new(1500);
    let bound = setup.bound();
    let (mut plain, mut huber, mut transform) = (Vec::new(), Vec::new(), Vec::new());
    let mut inside = 0usize;
    for seed in 0..seeds() {
        let measured = setup.measured(seed);
        plain.push(setup.errors(&setup.pose(&measured, LossName::None).x));
        let solution = setup.pose(&measured, LossName::Huber);
        let errors = setup.errors(&solution.x);
        inside += errors
            .iter()
            .enumerate()
            .filter(|(column, error)| error.abs() < 1.96 * solution.covariance.sigma(*column).unwrap())
            .count();
        huber.push(errors);
        transform.push(setup.errors(&setup.transform(&measured)));
    }
    let coverage = inside as f64 / (huber.len() * bound.len()) as f64;
    let [plain, huber, transform] = [plain, huber, transform].map(|errors| over_bound(&errors, &bound));
    println!(
        "{} seeds, RMS error over the bound: pose {plain:.3}, with huber {huber:.3}, transform {transform:.3}; \
         95 % intervals hold in {:.1} %",
        seeds(),
        100.0 * coverage,
    );
    assert!(plain < 1.05, "{plain}");
    assert!(huber < 1.05, "{huber}");
    assert!((0.93..0.97).contains(&coverage), "{coverage}");
}

#[test]
fn a_fifth_of_gross_outliers_makes_the_error_at_most_half_larger() {
    let setup = Setup::new(500);
    let bound = setup.bound();
    let seeds = seeds() / 4;
    let (mut clean, mut spoiled) = (Vec::new(), Vec::new());
    let losses = [LossName::Cauchy, LossName::GemanMcclure];
    for seed in 0..seeds {
        let mut measured = setup.measured(seed);
        clean.push(setup.errors(&setup.pose(&measured, LossName::None).x));
        let mut random = StdRng::seed_from_u64(1000 + seed);
        for observation in &mut measured.0 {
            if random.random_bool(0.2) {
                let joint = random.random_range(0..5);
                observation.bar_rad[joint] += random.random_range(-0.1..0.1);
            }
        }
        spoiled.push(losses.map(|loss| setup.errors(&setup.pose(&measured, loss).x)));
    }
    let clean = over_bound(&clean, &bound);
    for (i, loss) in losses.into_iter().enumerate() {
        let errors: Vec<Vec<f64>> = spoiled.iter().map(|errors| errors[i].clone()).collect();
        let ratio = over_bound(&errors, &bound) / clean;
        println!("{loss:?}: error with 20 % outliers over the clean one {ratio:.3}");
        assert!(ratio < 1.5, "{loss:?} {ratio}");
    }
}
