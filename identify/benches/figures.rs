//! Prints the figures of speed and memory that the project must hold: `cargo bench -p identify --bench figures`.
//!
//! - Duration of one iteration at 1500 poses x 12 residuals x 40 parameters on one core. Duration of a whole solve, and that
//!   of the crate `levenberg-marquardt` on the same residuals and Jacobian. The two solvers run alternately, so that other
//!   load of the machine affects both.
//! - Time per pose for ten thousand to a million poses, on one thread and on all threads, and the memory that a solve adds.
//! - Duration of a whole calibration with default settings of a two-minute run, without reading the files.
#![allow(clippy::unwrap_used, reason = "a benchmark stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "its figures")]

#[path = "../tests/support/mod.rs"]
mod support;

use std::hint::black_box;
use std::num::NonZeroUsize;
use std::time::{Duration, Instant};

use identify::calibrate::{IdentifyConfig, calibrate_run};
use identify::cost::{AngleNoise, LoopProblem, Residual, Transform, WhitenedPose};
use identify::model::{Model, Observation, PerObservation, Selection};
use identify::simulate::{Experiment, run};
use identify::solver::{LeastSquares, Options, minimise, solve};
use levenberg_marquardt::LevenbergMarquardt;
use support::other_solver::Other;
use support::{Cell, noisy_poses};

const POSES: usize = 1500;
const RUNS: usize = 15;

fn timed<T>(work: impl FnOnce() -> T) -> Duration {
    let began = Instant::now();
    black_box(work());
    began.elapsed()
}

fn ms(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}

/// Shortest and median duration [ms]. The shortest one is that of the code alone. Longer durations include
/// other work of the machine.
fn shortest_and_median(mut durations: Vec<Duration>) -> (f64, f64) {
    durations.sort();
    (ms(durations[0]), ms(durations[durations.len() / 2]))
}

fn alone() -> Options<'static> {
    Options { threads: NonZeroUsize::new(1), ..Options::default() }
}

fn model() -> Model {
    let mut model = Cell::irb2400().model();
    model.select(Selection::Cell, Transform::identifies);
    model
}

/// Duration of one pass, including the step that follows it [ms]. It is measured as the duration of a solve of three
/// iterations, divided by its number of passes.
fn iteration(problem: &dyn LeastSquares, start: &[f64]) -> f64 {
    let options = Options { iterations_max: 3, ..alone() };
    let passes = minimise(problem, start, &options).unwrap().1.evaluations as f64;
    let runs = (0..RUNS).map(|_| timed(|| minimise(problem, start, &options).unwrap()));
    let (shortest, median) = shortest_and_median(runs.collect());
    println!(
        "  {:>2} rows x {:>2} columns: {:.2} ms (median {:.2})",
        problem.rows(),
        problem.columns(),
        shortest / passes,
        median / passes
    );
    shortest / passes
}

fn beside_another_solver() {
    println!("\none iteration, {POSES} poses, one thread:");
    let model = model();
    let (observations, joints) = noisy_poses(&Cell::irb2400(), POSES, 1, 1e-3);
    let problem = LoopProblem::new(&model, &joints, &observations, Transform, 1.0).unwrap();
    let start = model.start();
    iteration(&problem, &start);
    let noise = AngleNoise { encoder_rad: 1e-5, robot_rad: 1e-5 };
    let pose = WhitenedPose::new(&model.geometry(&start), &joints, &observations, noise);
    iteration(&LoopProblem::new(&model, &joints, &observations, pose, 1.0).unwrap(), &start);

    println!("\nwhole solve with rank and covariance, beside levenberg-marquardt:");
    let (mut ours, mut theirs) = (Vec::new(), Vec::new());
    for _ in 0..RUNS {
        ours.push(timed(|| solve(&problem, &start, &alone()).unwrap()));
        theirs.push(timed(|| LevenbergMarquardt::new().minimize(Other::new(&problem, &start))));
    }
    let ((ours, _), (theirs, _)) = (shortest_and_median(ours), shortest_and_median(theirs));
    println!("  ours {ours:.1} ms, levenberg-marquardt {theirs:.1} ms: {:.1} times", theirs / ours);
}

/// Resident memory of this process, current and maximum [MB].
fn memory_mb() -> Option<(f64, f64)> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let of = |key: &str| {
        let line = status.lines().find(|line| line.starts_with(key))?;
        Some(line.split_whitespace().nth(1)?.parse::<f64>().ok()? / 1e3)
    };
    Some((of("VmRSS:")?, of("VmHWM:")?))
}

fn by_poses() {
    println!("\none iteration by the number of poses (12 rows x 40 columns):");
    let model = model();
    let start = model.start();
    let (some, joints) = noisy_poses(&Cell::irb2400(), 10_000, 1, 1e-3);
    for poses in [10_000, 100_000, 1_000_000] {
        let joints = PerObservation(joints.0.iter().cycle().take(poses).copied().collect());
        let observations: Vec<Observation> = some
            .iter()
            .cycle()
            .take(poses)
            .enumerate()
            .map(|(index, one)| Observation { t_s: PerObservation::time_s(index), ..*one })
            .collect();
        let input_mb = (size_of_val(&observations[..]) + size_of_val(&joints.0[..])) as f64 / 1e6;
        let before = memory_mb();
        let problem = LoopProblem::new(&model, &joints, &observations, Transform, 1.0).unwrap();
        let per_pose = |threads| {
            let options = Options { iterations_max: 1, threads, ..Options::default() };
            let (mut passes, mut shortest) = (0, f64::INFINITY);
            for _ in 0..3 {
                let taken = timed(|| passes = minimise(&problem, &start, &options).unwrap().1.evaluations);
                shortest = shortest.min(ms(taken));
            }
            1e3 * shortest / passes as f64 / poses as f64
        };
        let (one, all) = (per_pose(NonZeroUsize::new(1)), per_pose(None));
        let added = memory_mb().zip(before).map_or(f64::NAN, |((_, highest), (before, _))| highest - before);
        println!(
            "  {poses:>7} poses: {one:.3} us by pose on one thread, {all:.3} on all; input {input_mb:.0} MB, \
             solve adds {added:.0} MB"
        );
    }
}

fn whole_calibration() {
    println!("\nwhole default calibration of a two-minute run, after reading:");
    let (robot, bar) = (support::irb2400(), support::bar());
    let simulated = run(&Experiment::new(&robot, &bar)).unwrap();
    let config = IdentifyConfig::default();
    let runs = (0..5).map(|_| {
        timed(|| {
            let (cycles, encoders) = (&simulated.cycles, &simulated.encoders);
            calibrate_run(cycles, encoders, &simulated.robot_log, &robot, &bar, &config).unwrap()
        })
    });
    let (shortest, median) = shortest_and_median(runs.collect());
    println!("  {shortest:.0} ms (median {median:.0})");
}

fn main() {
    beside_another_solver();
    by_poses();
    whole_calibration();
}
