//! Several runs in one solve. All runs have the same robot, but each run has its own clock,
//! base position and encoder offsets.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use crate::support::{Cell, bar, irb2400};
use identify::calibrate::{
    Calibration, IdentifyConfig, JointTermsConfig, RunInput, SelectionName, calibrate_runs,
};
use identify::cost::SharedColumns;
use identify::instrument::CostName;
use identify::model::{ParameterId, Role};
use identify::report::result::file::ParameterEntry;
use identify::simulate::Comparison;
use identify::simulate::{self, Clocks, Design, Effects, Experiment, Simulated};
use shared::config::BallBarConfig;

const EFFECTS: Effects =
    Effects { robot_noise_urad: 15.0, encoder_noise_urad: 5.0, base_tilt_urad: 5000.0, ..Effects::NONE };

fn run(bar: &BallBarConfig, seed: u64, base_m: [f64; 3], clock_ns: i64) -> Simulated {
    let robot = irb2400();
    let design = Design { base_m, duration_s: 30.0, ..Design::for_robot(&robot) };
    let clocks = Clocks { robot_at_bar_start_ns: clock_ns, skew: 1e-5 * seed as f64, ..Clocks::default() };
    let experiment = Experiment { seed, design, clocks, effects: EFFECTS, ..Experiment::new(&robot, bar) };
    simulate::run(&experiment).unwrap()
}

fn input<'a>(run: &'a Simulated, bar: &'a BallBarConfig) -> RunInput<'a> {
    RunInput { cycles: &run.cycles, encoders: &run.encoders, unwrapped: None, log: &run.robot_log, bar }
}

/// A configuration without priors, so that only the data determine the result.
fn by_data(cost: CostName) -> IdentifyConfig {
    IdentifyConfig {
        cost: Some(cost),
        selection: SelectionName::AllIdentifiable,
        encoder_harmonics_urad: 0.0,
        joint_terms: JointTermsConfig { candidates: Vec::new(), ..JointTermsConfig::default() },
        ..IdentifyConfig::default()
    }
}

fn calibrated(runs: &[RunInput<'_>], cost: CostName) -> Calibration {
    calibrate_runs(runs, &irb2400(), &by_data(cost), None).unwrap()
}

fn is_robot(id: ParameterId) -> bool {
    matches!(id, ParameterId::Robot { .. })
}

fn robot_error(found: &Calibration, run: &Simulated) -> f64 {
    Comparison::new(found, &run.truth).only(is_robot).euclidean_mm_mrad()
}

/// Root mean square of the standard deviations of the robot's parameters \[mm|mrad\].
fn robot_sigma(found: &Calibration) -> f64 {
    let sigmas: Vec<f64> = (found.model().columns().enumerate())
        .filter(|(_, parameter)| is_robot(parameter.id))
        .map(|(column, _)| found.solution().covariance.sigma(column).unwrap() * 1e3)
        .collect();
    (sigmas.iter().map(|sigma| sigma * sigma).sum::<f64>() / sigmas.len() as f64).sqrt()
}

#[test]
fn two_short_runs_at_two_places_know_the_robot_better_than_either() {
    let bar = bar();
    let first = run(&bar, 1, [1.0, 0.05, 0.35], 3_712_345_678_901);
    let second = run(&bar, 2, [0.9, -0.25, 0.45], 86_400_000_000_000);
    let both = calibrated(&[input(&first, &bar), input(&second, &bar)], CostName::Pose);
    for alone in [&first, &second] {
        let found = calibrated(&[input(alone, &bar)], CostName::Pose);
        let (with, without) = (robot_error(&both, &first), robot_error(&found, alone));
        assert!(with < without, "{with} mm|mrad with both, {without} with one");
        let (with, without) = (robot_sigma(&both), robot_sigma(&found));
        assert!(with < 0.8 * without, "sigma {with} with both, {without} with one");
    }
    // Each run has its own base position and clock. Their values must equal those of a separate solve.
    let other = &both.runs[1];
    for (name, truth) in [("ox", "ox"), ("oy", "oy"), ("oz", "oz")] {
        let found = other.model.parameter(name.parse().unwrap()).unwrap().value;
        assert!((found - second.truth.parameters[truth]).abs() < 1e-4, "{name}");
    }
    let skew = other.model.parameter(ParameterId::ClockSkew).unwrap().value;
    assert!((skew - second.truth.clock.skew).abs() < 2e-6, "{skew}");
    let entries = ParameterEntry::of_calibration(&both);
    let entry = |name: &str| entries.iter().find(|entry| entry.name == name);
    assert!(entry("ox@2").is_some_and(|entry| entry.sigma.is_some_and(|sigma| sigma > 0.0)));
    assert!(entry("ra2@2").is_none() && entry("ra2").is_some());
}

#[test]
fn the_same_run_given_twice_gives_the_same_robot() {
    let bar = bar();
    let run = run(&bar, 3, [1.0, 0.05, 0.35], 3_712_345_678_901);
    for cost in [CostName::Transform, CostName::Length] {
        let once = calibrated(&[input(&run, &bar)], cost);
        let twice = calibrated(&[input(&run, &bar), input(&run, &bar)], cost);
        for (column, parameter) in once.model().columns().enumerate() {
            let again = twice.model().parameter(parameter.id).unwrap().value;
            let sigma = once.solution().covariance.sigma(column).unwrap();
            assert!((again - parameter.value).abs() < 1e-3 * sigma + 1e-12, "{cost:?} {}", parameter.id);
        }
        let (first, second) = (twice.model(), &twice.runs[1].model);
        let place: ParameterId = "ox".parse().unwrap();
        let apart = first.parameter(place).unwrap().value - second.parameter(place).unwrap().value;
        assert!(apart.abs() < 1e-9, "{apart}");
    }
}

#[test]
fn another_bar_has_a_length_of_its_own() {
    let bar = bar();
    let longer = BallBarConfig { length_m: bar.length_m + 0.05, ..bar.clone() };
    let first = run(&bar, 1, [1.0, 0.05, 0.35], 3_712_345_678_901);
    let second = run(&longer, 2, [1.0, 0.05, 0.35], 86_400_000_000_000);
    let both = calibrated(&[input(&first, &bar), input(&second, &longer)], CostName::Pose);
    let rod: ParameterId = "bd3".parse().unwrap();
    let lengths = [both.model(), &both.runs[1].model].map(|model| model.parameter(rod).unwrap().value);
    for (found, run) in lengths.iter().zip([&first, &second]) {
        assert!((found - run.truth.parameters["bd3"]).abs() < 1e-4, "{found}");
    }
}

#[test]
fn columns_are_shared_by_name_and_own_ones_carry_the_number_of_the_run() {
    let mut model = Cell::irb2400().model();
    for name in ["ra1", "ox", "clock_shift"] {
        model.set_role(name.parse().unwrap(), Role::Free).unwrap();
    }
    let columns = SharedColumns::new([&model, &model, &model], |id| id != "ra1".parse().unwrap());
    let names = ["ra1", "ox", "clock_shift", "ox@2", "clock_shift@2", "ox@3", "clock_shift@3"];
    assert_eq!(columns.all().iter().map(ToString::to_string).collect::<Vec<_>>(), names);
    assert_eq!(columns.of_run(2), [0, 5, 6]);
    let x = [10.0, 11.0, 12.0, 21.0, 22.0, 31.0, 32.0];
    let values: Vec<Vec<f64>> = (0..3).map(|run| columns.values(run, &x)).collect();
    assert_eq!(values[1], [10.0, 21.0, 22.0]);
    assert_eq!(columns.gather(&values), x);
}
