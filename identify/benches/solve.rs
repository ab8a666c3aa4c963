//! One Levenberg-Marquardt iteration on the reference problem: 1500 poses x 12 residuals x 40 parameters, beside the
//! crate `levenberg-marquardt` on the same functions.
//!
//! An iteration is a pass over all samples (residual, Jacobian, normal equations) and the step. Figures are of whole
//! descents with a fixed number of iterations; the passes that each made are printed, divide by them.
#![allow(clippy::unwrap_used, reason = "a benchmark stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "the number of passes belongs to the figures")]
#![allow(missing_docs, reason = "criterion's macros write undocumented functions")]

#[path = "../tests/support/mod.rs"]
mod support;

use std::hint::black_box;
use std::time::Duration;

use criterion::{Criterion, criterion_group, criterion_main};
use identify::cost::{LoopProblem, Residual, Transform};
use identify::model::Selection;
use identify::solver::{Options, identifiability, minimise, stacked};
use levenberg_marquardt::LevenbergMarquardt;
use support::other_solver::Other;
use support::{Cell, noisy_poses};

const POSES: usize = 1500;

fn iterations(criterion: &mut Criterion) {
    let cell = Cell::irb2400();
    let (observations, motion) = noisy_poses(&cell, POSES, 1, 1e-3);
    let mut model = cell.model();
    model.select(Selection::Cell, Transform::sees).unwrap();
    let problem = LoopProblem::new(&model, &motion, &observations, Transform, 1.0).unwrap();
    let start = model.start();
    assert_eq!(start.len(), 40);

    let mut group = criterion.benchmark_group("1500 poses x 12 x 40");
    group.sample_size(20).measurement_time(Duration::from_secs(5));
    for limit in [1, 3] {
        let options = Options { iterations_max: limit, ..Options::default() };
        let (_, summary) = minimise(&problem, &start, &options).unwrap();
        println!("ours, at most {limit} iterations: {} passes", summary.evaluations);
        group.bench_function(format!("ours, {limit} iterations"), |b| {
            b.iter(|| minimise(black_box(&problem), &start, &options).unwrap());
        });
    }
    let full = Options::default();
    println!("ours, to the end: {} passes", minimise(&problem, &start, &full).unwrap().1.evaluations);
    group.bench_function("ours, to the end", |b| b.iter(|| minimise(&problem, &start, &full).unwrap()));
    group.bench_function("ours, rank and groups", |b| {
        b.iter(|| identifiability(&problem, &start, &full).unwrap());
    });
    group.bench_function("residual and Jacobian alone, stacked", |b| {
        b.iter(|| stacked(&problem, black_box(&start)).unwrap());
    });
    let (_, report) = LevenbergMarquardt::new().minimize(Other::new(&problem, &start));
    println!(
        "levenberg-marquardt, to the end: {} evaluations, {:?}",
        report.number_of_evaluations, report.termination
    );
    group.sample_size(10);
    group.bench_function("levenberg-marquardt, to the end", |b| {
        b.iter(|| LevenbergMarquardt::new().minimize(Other::new(&problem, &start)));
    });
    group.finish();
}

criterion_group!(benches, iterations);
criterion_main!(benches);
