//! The parameters that the costs can identify in the reference set-up, and whether solves find their true values.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "figures of a run")]

use std::num::NonZeroUsize;

use crate::support::{Cell, spread_poses};
use identify::cost::{Length, LoopProblem, Position, PositionAngles, Residual, Transform};
use identify::kinematics::{Chain, Joints, robot_inverse};
use identify::model::{JointState, Model, Observation, ParameterId, RobotMotion, Role, Selection};
use identify::simulate::THESIS_ERRORS;
use identify::solver::{Identifiability, Options, Solution, identifiability, minimise, solve};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};

/// Frees the 47 parameters of the thesis. Hayati's parameters, rotations of the base and clocks are fixed.
fn thesis_47(model: &mut Model) {
    let ids = model.ids();
    for id in ids {
        let name = id.to_string();
        let outside = ["rbeta", "or", "bsin", "bcos", "bdsin", "bdcos", "clock"]
            .iter()
            .any(|no| name.starts_with(no))
            || matches!(id, ParameterId::Joint { .. } | ParameterId::BarCompliance | ParameterId::BarPlay);
        if !outside {
            model.set_role(id, Role::Free).unwrap();
        }
    }
}

fn examined<R: Residual>(residual: R, extra: &[&str]) -> Identifiability {
    let cell = Cell::irb2400();
    let (observations, joints) = spread_poses(&cell.robot, &cell.bar, 300, 7);
    let mut model = cell.model();
    thesis_47(&mut model);
    for name in extra {
        model.set_role(name.parse().unwrap(), Role::Free).unwrap();
    }
    let problem = LoopProblem::new(&model, &joints, &observations, residual, 1.0).unwrap();
    identifiability(&problem, &model.start(), &Options::default()).unwrap()
}

fn names(found: &Identifiability, columns: &[usize]) -> Vec<String> {
    columns.iter().map(|&column| found.names[column].clone()).collect()
}

fn group(found: &Identifiability, members: &[&str]) -> Option<usize> {
    found.groups.iter().find(|group| names(found, &group.columns) == members).map(|group| group.excess)
}

#[test]
fn length_identifies_23_of_47_and_sees_nothing_of_the_bar_but_its_length() {
    let found = examined(Length, &[]);
    assert_eq!((found.names.len(), found.rank), (47, 23));
    assert!(found.gap().unwrap() > 1e3);
    let zero = names(&found, &found.zero_columns);
    assert!(zero.contains(&"ralpha6".to_owned()) && !zero.contains(&"bd3".to_owned()));
    assert_eq!(zero.len(), 1 + 19);
    assert!(zero.iter().all(|name| name == "ralpha6" || name.starts_with('b')));
}

#[test]
fn position_identifies_31_of_47_and_33_with_the_rotations_of_the_base() {
    let found = examined(Position, &[]);
    assert_eq!((found.names.len(), found.rank), (47, 31));
    assert!(found.gap().unwrap() > 1e3);
    let zero = ["ralpha6", "balpha3", "btheta3", "balpha4", "btheta4", "balpha5", "btheta5"];
    assert_eq!(names(&found, &found.zero_columns), zero);
    assert_eq!(examined(Position, &["orx", "ory"]).rank, 33);
}

#[test]
fn position_angles_identify_38_of_47_and_see_nothing_of_the_third_zero() {
    let found = examined(PositionAngles, &[]);
    assert_eq!((found.names.len(), found.rank), (47, 38));
    assert!(found.gap().unwrap() > 1e3);
    assert_eq!(names(&found, &found.zero_columns), ["btheta3"]);
    let tilted = examined(PositionAngles, &["orx", "ory"]);
    assert_eq!(tilted.rank, 40);
}

#[test]
fn transform_identifies_39_of_47_and_names_who_depends_on_whom() {
    let found = examined(Transform, &[]);
    assert_eq!((found.names.len(), found.rank), (47, 39));
    assert!(found.gap().unwrap() > 1e3);
    assert!(found.zero_columns.is_empty());
    assert_eq!(group(&found, &["ralpha6", "balpha5"]), Some(1));
    assert_eq!(group(&found, &["rd1", "bd1", "oz"]), Some(2));
    assert_eq!(group(&found, &["rd2", "rd3"]), Some(1));
    assert_eq!(group(&found, &["rd6", "bd5"]), Some(1));
    assert_eq!(group(&found, &["ra6", "ba5"]), Some(1));
    assert_eq!(group(&found, &["rtheta1", "btheta1", "ox", "oy"]), Some(1));
    let scale = found.groups.last().unwrap();
    let scaled = names(&found, &scale.columns);
    for length in ["ra1", "ra2", "ra3", "rd4", "bd3"] {
        assert!(scaled.contains(&length.to_owned()), "{length} is not in the common scale {scaled:?}");
    }
    assert_eq!(found.groups.len(), 7);
}

#[test]
fn both_rotations_of_the_base_are_identified_beside_everything_else() {
    let found = examined(Transform, &["orx", "ory"]);
    assert_eq!((found.names.len(), found.rank), (49, 41));
    let undetermined = names(&found, &found.undetermined());
    assert!(!undetermined.contains(&"orx".to_owned()) && !undetermined.contains(&"ory".to_owned()));
}

#[test]
fn surplus_parameters_are_an_error_with_their_names() {
    let error = examined(Transform, &[]).require_full().unwrap_err().to_string();
    assert!(error.contains("39 of 47") && error.contains("ralpha6|balpha5"), "{error}");
    assert!(error.contains("rd1|bd1|oz (fix 2)"), "{error}");
}

fn selection_is_identified<R: Residual + Copy>(residual: R, columns: [usize; 2]) {
    let cell = Cell::irb2400();
    let (observations, joints) = spread_poses(&cell.robot, &cell.bar, 300, 8);
    let mut model = cell.model();
    let problem_of = |model: &Model| {
        let problem = LoopProblem::new(model, &joints, &observations, residual, 1.0).unwrap();
        identifiability(&problem, &model.start(), &Options::default()).unwrap().require_full().unwrap();
    };
    for (selection, columns) in [Selection::Thesis, Selection::Cell].into_iter().zip(columns) {
        model.select(selection, R::identifies);
        assert_eq!(model.columns().len(), columns, "{} {selection:?}", R::NAME);
        problem_of(&model);
    }
}

#[test]
fn every_selection_is_identified_by_its_cost() {
    selection_is_identified(Transform, [38, 40]);
    selection_is_identified(PositionAngles, [37, 39]);
    selection_is_identified(Position, [31, 33]);
    selection_is_identified(Length, [23, 23]);
}

/// The true model and its chains of robot and bar: nominal with the static errors of the thesis and the
/// further errors `more` \[mm, mrad\].
fn true_chains(model: &Model, more: &[(&str, f64)]) -> (Model, Chain, Chain) {
    let mut truth = model.clone();
    for (name, error) in THESIS_ERRORS.iter().chain(more) {
        let id: ParameterId = name.parse().unwrap();
        let value = truth.parameter(id).unwrap().value;
        truth.set_value(id, value + error * 1e-3).unwrap();
    }
    let geometry = truth.geometry(&[]);
    (truth, geometry.robot.clone(), geometry.bar_chain())
}

/// Euclidean distance of a solution to the truth over the free parameters \[mm|mrad\].
fn distance(model: &Model, truth: &Model, x: &[f64]) -> f64 {
    let errors = model.columns().zip(x).map(|(p, x)| x - truth.parameter(p.id).unwrap().value);
    errors.map(|e| (1e3 * e).powi(2)).sum::<f64>().sqrt()
}

fn recovered<R: Residual>(cell: &Cell, residual: R) -> (f64, Solution) {
    let mut model = cell.model();
    model.select(Selection::Thesis, R::identifies);
    let (truth, robot, bar) = true_chains(&model, &[]);
    let (observations, joints) = spread_poses(&robot, &bar, 1500, 3);
    let problem = LoopProblem::new(&model, &joints, &observations, residual, 1.0).unwrap();
    let solution = solve(&problem, &model.start(), &Options::default()).unwrap().identified().unwrap();
    (distance(&model, &truth, &solution.x), solution)
}

#[test]
fn static_errors_of_the_thesis_are_recovered_from_1500_poses() {
    for (name, cell) in [("IRB 2400", Cell::irb2400()), ("NJ 220", Cell::nj220())] {
        for (cost, (error, solution)) in [
            ("transform", recovered(&cell, Transform)),
            ("position_angles", recovered(&cell, PositionAngles)),
            ("position", recovered(&cell, Position)),
            ("length", recovered(&cell, Length)),
        ] {
            let summary = solution.summary;
            println!(
                "{name} {cost}: {error:.1e} mm|mrad after {} iterations, {} passes ({}), weakest {:.1e}",
                summary.iterations,
                summary.evaluations,
                summary.termination,
                solution.identifiability.weakest(),
            );
            assert!(error < 1e-6, "{name} {cost}: {error:e} mm|mrad");
            assert!(summary.termination.converged() && summary.iterations <= 10);
        }
    }
}

/// Solves `seeds` problems. Each starts with errors of up to 20 mm|mrad in every free parameter. Returns the
/// number of solves that end at the truth.
fn recovered_from_afar<R: Residual>(cell: &Cell, residual: R, seeds: u64) -> usize {
    let mut model = cell.model();
    model.select(Selection::Thesis, R::identifies);
    let (truth, robot, bar) = true_chains(&model, &[]);
    let (observations, joints) = spread_poses(&robot, &bar, 1500, 3);
    let problem = LoopProblem::new(&model, &joints, &observations, residual, 1.0).unwrap();
    let options = Options { threads: NonZeroUsize::new(1), ..Options::default() };
    let found = |seed: &u64| {
        let mut random = StdRng::seed_from_u64(*seed);
        let start: Vec<f64> = model
            .columns()
            .map(|p| truth.parameter(p.id).unwrap().value + random.random_range(-0.02..0.02))
            .collect();
        let (x, _) = minimise(&problem, &start, &options).unwrap();
        distance(&model, &truth, &x) < 1e-4
    };
    std::thread::scope(|scope| {
        let found = &found;
        let half = |part: u64| move || (part..seeds).step_by(2).filter(|seed| found(seed)).count();
        let (one, other) = (scope.spawn(half(0)), scope.spawn(half(1)));
        one.join().unwrap() + other.join().unwrap()
    })
}

#[test]
#[ignore = "dozens of solves: a quarter of a minute"]
fn starts_20_mm_and_mrad_away_lead_to_the_truth_with_every_cost() {
    for cell in [Cell::irb2400(), Cell::nj220()] {
        let found = [
            recovered_from_afar(&cell, Transform, 100),
            recovered_from_afar(&cell, PositionAngles, 100),
            recovered_from_afar(&cell, Position, 100),
            recovered_from_afar(&cell, Length, 100),
        ];
        println!("of 100: {found:?}");
        assert_eq!(found, [100; 4]);
    }
}

/// The joints of a robot that follows the bar along a smooth path. Its clock is ahead by `shift_s` and fast by `skew`.
struct Following<'a> {
    robot: &'a Chain,
    bar: &'a Chain,
    shift_s: f64,
    skew: f64,
}

fn bar_path(t_s: f64) -> [f64; 5] {
    let s = |rate: f64, phase: f64| (rate * t_s + phase).sin();
    [
        2.6 + 0.7 * s(0.31, 0.0),
        1.0 + 0.5 * s(0.43, 1.0),
        0.9 * s(0.37, 2.0),
        1.3 + 0.5 * s(0.53, 0.5),
        0.9 * s(0.29, 3.0),
    ]
}

impl Following<'_> {
    fn joints(&self, tau_s: f64) -> Option<Joints> {
        let t_s = (tau_s - self.shift_s) / (1.0 + self.skew);
        let home = [0.0, 0.2, 0.2, 0.0, 0.8, 0.0];
        robot_inverse(self.robot, &self.bar.forward(&bar_path(t_s)), &home).ok()
    }
}

impl RobotMotion for Following<'_> {
    fn at(&self, tau_s: f64) -> Option<JointState> {
        let h = 1e-4;
        let (q, before, after) = (self.joints(tau_s)?, self.joints(tau_s - h)?, self.joints(tau_s + h)?);
        let qd = Joints::from_fn(6, |i| (after[i] - before[i]) / (2.0 * h));
        let qdd = Joints::from_fn(6, |i| (after[i] - 2.0 * q[i] + before[i]) / (h * h));
        Some(JointState { q, qd, qdd })
    }
}

#[test]
fn clock_shift_skew_and_a_tilted_base_are_found_with_everything_else() {
    let cell = Cell::irb2400();
    let mut model = cell.model();
    model.select(Selection::CellWithClocks, Transform::depends_on);
    let (truth, robot, bar) = true_chains(&model, &[("orx", 5.0), ("ory", -4.0)]);
    let motion = Following { robot: &robot, bar: &bar, shift_s: 0.02, skew: 25e-6 };
    let observations: Vec<Observation> = (0..600)
        .map(|k| 0.2 * f64::from(k) - 60.0)
        .filter(|&t| motion.at(t + 0.02).is_some())
        .map(|t| Observation::bar(t, bar_path(t)))
        .collect();
    println!("{} of 600 poses are in reach", observations.len());
    let problem = LoopProblem::new(&model, &motion, &observations, Transform, 1.0).unwrap();
    let solution = solve(&problem, &model.start(), &Options::default()).unwrap();
    println!("{:?}\nrank {}", solution.summary, solution.identifiability.rank);
    let solution = solution.identified().unwrap();
    let geometry = model.geometry(&solution.x);
    assert!((geometry.clock.shift_s - 0.02).abs() < 1e-9, "{}", geometry.clock.shift_s);
    assert!((geometry.clock.skew - 25e-6).abs() < 1e-10, "{}", geometry.clock.skew);
    let mut without_clock = truth.clone();
    without_clock.set_value(ParameterId::ClockShift, 0.02).unwrap();
    without_clock.set_value(ParameterId::ClockSkew, 25e-6).unwrap();
    let error = distance(&model, &without_clock, &solution.x);
    assert!(error < 1e-4, "{error:e}");
}
