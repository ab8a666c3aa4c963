//! The laboratory of the acceptance test, with unknown offsets and clocks and all sources of errors. It evaluates two
//! robots with ten seeds each.
//!
//! The whole campaign: `cargo test --release -p identify --test all laboratory_campaign -- --ignored
//! --nocapture`. `IDENTIFY_KINDS=four,hard` selects kinds of runs by words of their names. `IDENTIFY_SEEDS=40`
//! sets the number of runs of each kind.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "figures of a run")]

use crate::support::campaign::size;
use crate::support::laboratory::{self, Level};
use crate::support::{bar, irb2400, nj220};
use identify::calibrate::{IdentifyConfig, SelectionName, calibrate_run};
use identify::evaluate::workspace_error;
use identify::instrument::CostName;
use identify::model::ParameterId;
use identify::prepare::LocalShift;
use identify::simulate::{Comparison, Design, Simulated, position_errors_m};
use nalgebra::Vector3;
use shared::config::{BallBarConfig, RobotConfig};
use shared::encoder::Direction;

/// Errors of one calibration.
#[derive(Debug, Clone, Copy)]
struct Outcome {
    robot_mm_mrad: f64,
    shift_ms: f64,
    skew_ppm: f64,
    /// Standard deviation of the clock difference between alignments of disjoint segments of about 20 s \[ms\].
    repeats_ms: f64,
    /// Mean position error over the workspace, including the errors of joints \[mm\].
    position_mm: f64,
    /// 95 % interval of the position error as the report states it \[mm\].
    expected_mm: [f64; 2],
}

impl Outcome {
    fn is_as_expected(&self) -> bool {
        (self.expected_mm[0]..=self.expected_mm[1]).contains(&self.position_mm)
    }
}

fn calibrated(run: &Simulated, robot: &RobotConfig, bar: &BallBarConfig, config: &IdentifyConfig) -> Outcome {
    let found = calibrate_run(&run.cycles, &run.encoders, &run.robot_log, robot, bar, config).unwrap();
    let comparison = Comparison::new(&found, &run.truth);
    let of_robot = comparison.only(|id| matches!(id, ParameterId::Robot { .. }));
    let of_part =
        |part: &[LocalShift]| part.iter().map(|one| one.shift_s * 1e3).sum::<f64>() / part.len() as f64;
    let shifts: Vec<f64> = found.prepared().unwrap().local_shifts.chunks_exact(4).map(of_part).collect();
    let mean = shifts.iter().sum::<f64>() / shifts.len() as f64;
    let variance = shifts.iter().map(|shift| (shift - mean).powi(2)).sum::<f64>() / (shifts.len() - 1) as f64;
    let expected = workspace_error(&found, &robot.joint_limits()).after;
    Outcome {
        position_mm: position_errors_m(found.model(), &run.truth, robot, [Vector3::zeros(); 2]).0 * 1e3,
        expected_mm: expected.interval_m.map(|limit_m| limit_m * 1e3),
        robot_mm_mrad: of_robot.euclidean_mm_mrad(),
        shift_ms: comparison.clock_shift_error_s * 1e3,
        skew_ppm: comparison.clock_skew_error * 1e6,
        repeats_ms: variance.sqrt(),
    }
}

/// Prints mean and largest error of the robot \[mm|mrad\], and returns both.
fn summary(name: &str, outcomes: &[Outcome]) -> (f64, f64) {
    let largest = |of: &dyn Fn(&Outcome) -> f64| outcomes.iter().map(of).fold(0.0, f64::max);
    let mean = outcomes.iter().map(|one| one.robot_mm_mrad).sum::<f64>() / outcomes.len() as f64;
    let most = largest(&|one| one.robot_mm_mrad);
    println!(
        "{name}: robot {mean:.3} mean, {most:.3} largest mm|mrad; shift {:.4} ms, skew {:.2} ppm, parts of 20 s {:.4} ms",
        largest(&|one| one.shift_ms.abs()),
        largest(&|one| one.skew_ppm.abs()),
        largest(&|one| one.repeats_ms),
    );
    let position_mm = outcomes.iter().map(|one| one.position_mm).sum::<f64>() / outcomes.len() as f64;
    let as_expected = outcomes.iter().filter(|one| one.is_as_expected()).count();
    println!(
        "    position {position_mm:.4} mm; within the report's interval {as_expected} of {}",
        outcomes.len()
    );
    let errors: Vec<String> = outcomes.iter().map(|one| format!("{:.3}", one.robot_mm_mrad)).collect();
    println!("    one by one: {}", errors.join(" "));
    assert!(outcomes.iter().all(|one| one.shift_ms.abs() < 0.1 && one.skew_ppm.abs() < 2.0), "{name}");
    (mean, most)
}

/// A function that simulates a run from a seed.
type Make = fn(&RobotConfig, &BallBarConfig, u64) -> Simulated;

fn usual(robot: &RobotConfig, bar: &BallBarConfig, seed: u64) -> Simulated {
    laboratory::run(robot, bar, seed, &Level::USUAL, Design::for_robot(robot))
}

fn hard(robot: &RobotConfig, bar: &BallBarConfig, seed: u64) -> Simulated {
    laboratory::run(robot, bar, seed, &Level::HARD, Design::for_robot(robot))
}

fn shuffled_and_reversed(robot: &RobotConfig, bar: &BallBarConfig, seed: u64) -> Simulated {
    let mut run = usual(robot, bar, seed);
    for place in [0, 2, 3] {
        run.encoders[place].scale.direction = Direction::Negative;
    }
    laboratory::exchange(&mut run, &[4, 2, 0, 3, 1]);
    run
}

fn crossing(robot: &RobotConfig, bar: &BallBarConfig, seed: u64) -> Simulated {
    let mut design = Design { bar_margin_deg: 0.0, ..Design::for_robot(robot) };
    design.bar_range_deg[1] = [-60.0, 85.0];
    laboratory::run(robot, bar, seed, &Level::USUAL, design)
}

/// A run in which a motion of 60 s occurs twice within the recording and the log.
fn repeated(robot: &RobotConfig, bar: &BallBarConfig, seed: u64) -> Simulated {
    let design = Design { duration_s: 60.0, ..Design::for_robot(robot) };
    let mut run = laboratory::without_noise(robot, bar, seed, &Level::USUAL, design);
    laboratory::repeat(&mut run, 70.0);
    laboratory::add_noise(&mut run, seed, &Level::USUAL);
    run
}

fn four() -> BallBarConfig {
    let mut bar = bar();
    bar.encoders.remove(2);
    bar
}

fn outcomes(
    robot: &RobotConfig,
    bar: &BallBarConfig,
    make: Make,
    seeds: std::ops::RangeInclusive<u64>,
) -> Vec<Outcome> {
    let config = IdentifyConfig::default();
    seeds.map(|seed| calibrated(&make(robot, bar, seed), robot, bar, &config)).collect()
}

#[test]
#[ignore = "a dozen calibrations: half a minute"]
fn a_few_runs_of_each_kind_calibrate_without_a_hand() {
    let (robot, bar) = (irb2400(), bar());
    let kinds: [(&str, Make, f64); 4] = [
        ("usual", usual, 0.12),
        ("shuffled and reversed", shuffled_and_reversed, 0.12),
        ("through a singular pose", crossing, 0.12),
        ("repeated motion", repeated, 0.12),
    ];
    for (name, make, limit) in kinds {
        let (_, most) = summary(name, &outcomes(&robot, &bar, make, 1..=1));
        assert!(most < limit, "{name}: {most}");
    }
    let (_, most) = summary("NJ 220, hard", &outcomes(&nj220(), &bar, hard, 1..=1));
    assert!(most < 0.25, "{most}");
}

#[test]
#[ignore = "130 calibrations: minutes"]
fn ten_runs_of_each_kind_with_both_robots() {
    let five = bar();
    let kinds: [(&str, &BallBarConfig, Make); 6] = [
        ("usual", &five, usual),
        ("four encoders", &four(), usual),
        ("shuffled and reversed", &five, shuffled_and_reversed),
        ("through a singular pose", &five, crossing),
        ("repeated motion", &five, repeated),
        ("hard", &five, hard),
    ];
    let seeds = size(2, 10);
    let mut missed = Vec::new();
    for robot in [irb2400(), nj220()] {
        for (name, bar, make) in kinds {
            let outcomes = outcomes(&robot, bar, make, 1..=seeds);
            let (mean, most) = summary(&format!("{}, {name}", robot.name), &outcomes);
            let (mean_max, most_max) = if name == "hard" { (0.25, f64::INFINITY) } else { (0.12, 0.25) };
            if mean > mean_max || most > most_max {
                missed.push(format!("{}, {name}: {mean:.3} mean, {most:.3} largest", robot.name));
            }
            if name == "usual" {
                assert!(outcomes.iter().all(|one| one.repeats_ms < 0.1), "{}", robot.name);
                as_the_thesis(&robot, bar, seeds);
            }
        }
    }
    assert!(missed.is_empty(), "{missed:#?}");
}

/// Evaluates the cost and the parameters of the thesis on the files of the default runs. Alignment and sample selection are
/// those of the default. Any difference in the results is therefore the effect of cost and parameters.
fn as_the_thesis(robot: &RobotConfig, bar: &BallBarConfig, seeds: u64) {
    let config = IdentifyConfig {
        cost: Some(CostName::Transform),
        selection: SelectionName::Thesis,
        ..IdentifyConfig::default()
    };
    let errors =
        (1..=seeds).map(|seed| calibrated(&usual(robot, bar, seed), robot, bar, &config).robot_mm_mrad);
    println!(
        "    the thesis' cost and parameters on the same files: {:.3} mean",
        errors.sum::<f64>() / seeds as f64
    );
}
