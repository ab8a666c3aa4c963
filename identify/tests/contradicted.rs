//! Stated lengths that contradict each other, and a scale that contradicts the lengths of the robot. The stated uncertainty
//! must include the true error. Without a contradiction nothing is added.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "figures of a run")]

use identify::calibrate::{Calibration, IdentifyConfig, JointTermsConfig, calibrate_run};
use identify::evaluate::workspace_error;
use identify::model::ParameterId;
use identify::simulate::{Design, Simulated, position_errors_m};
use nalgebra::Vector3;
use shared::config::{BallBarConfig, RobotConfig};

use crate::support::campaign::size;
use crate::support::laboratory::{self, Level};
use crate::support::{bar, irb2400, nj220};

fn run(robot: &RobotConfig, seed: u64) -> Simulated {
    laboratory::run(robot, &bar(), seed, &Level::USUAL, Design::for_robot(robot))
}

/// The shipped bar, whose stated plate length has the error `plate_off_mm` \[mm\]. If `rod_off_mm` is given, the rod length
/// is also stated, with this error \[mm\].
fn bar_with_errors(run: &Simulated, plate_off_mm: f64, rod_off_mm: Option<f64>) -> BallBarConfig {
    let mut bar = bar();
    bar.plate_m += 1e-3 * plate_off_mm;
    if let Some(off_mm) = rod_off_mm {
        bar.length_m = run.truth.parameters["bd3"] + 1e-3 * off_mm;
        bar.length_u_um = Some(20.0);
    }
    bar
}

/// A calibration, with its stated uncertainty (k = 2) and its true mean position error \[m\].
fn calibrated(
    run: &Simulated,
    robot: &RobotConfig,
    bar: &BallBarConfig,
    config: &IdentifyConfig,
) -> (Calibration, [f64; 2]) {
    let found = calibrate_run(&run.cycles, &run.encoders, &run.robot_log, robot, bar, config).unwrap();
    let workspace = workspace_error(&found, &robot.joint_limits());
    let (true_m, _) = position_errors_m(found.model(), &run.truth, robot, [Vector3::zeros(); 2]);
    (found, [workspace.budget.expanded_m, true_m])
}

/// Names of the stated values that the data contradict, in alphabetical order.
fn contradicted(found: &Calibration) -> Vec<String> {
    let names = found.contradicted.priors.iter().map(|prior| prior.to_string());
    let mut names: Vec<String> =
        names.map(|name| name.split(' ').next().unwrap_or_default().to_owned()).collect();
    names.extend(found.contradicted.scale.as_ref().map(|_| "scale".to_owned()));
    names.sort();
    names
}

/// A configuration without joint terms, to save time.
fn quick() -> IdentifyConfig {
    let joint_terms = JointTermsConfig { candidates: Vec::new(), ..JointTermsConfig::default() };
    IdentifyConfig { bar_length_um: 0.0, joint_terms, ..IdentifyConfig::default() }
}

#[test]
fn a_plate_and_a_rod_that_contradict_each_other_widen_the_uncertainty() {
    let robot = irb2400();
    let run = run(&robot, 1);
    let (found, [claimed_m, true_m]) =
        calibrated(&run, &robot, &bar_with_errors(&run, 0.5, Some(0.0)), &quick());
    println!("stated {:.3} mm, true {:.3} mm", claimed_m * 1e3, true_m * 1e3);
    assert_eq!(contradicted(&found), ["bd3", "ra6"]);
    assert!(true_m > 0.3e-3 && true_m < claimed_m && claimed_m < 6.0 * true_m, "{true_m} {claimed_m}");
    // The uncertainty of the plate that follows from the samples alone is smaller than the
    // one that includes the contradiction.
    let plate = found.model().column_of(ParameterId::plate(6)).unwrap();
    let covariance = &found.solution().covariance;
    assert!(covariance.sigma_before_contradictions(plate) < covariance.sigma(plate));
}

#[test]
#[ignore = "calibrations of two robots: a minute"]
fn wrong_lengths_and_scales_are_within_the_uncertainty_if_data_contradict_them() {
    const PLATE_AND_ROD: &[&str] = &["bd3", "ra6"];
    let cases = [
        (0.1, Some(0.0), PLATE_AND_ROD),
        (0.3, Some(0.0), PLATE_AND_ROD),
        (0.5, Some(0.0), PLATE_AND_ROD),
        (0.0, Some(0.3), PLATE_AND_ROD),
        (2.0, None, &["scale"]),
    ];
    for robot in [irb2400(), nj220()] {
        for seed in 1..=size(1, 5) {
            let run = run(&robot, seed);
            for (plate_off_mm, rod_off_mm, expected) in cases {
                let bar = bar_with_errors(&run, plate_off_mm, rod_off_mm);
                let (found, [claimed_m, true_m]) = calibrated(&run, &robot, &bar, &IdentifyConfig::default());
                println!(
                    "{} {seed}: plate {plate_off_mm:+} mm, rod {rod_off_mm:?} mm: stated {:.3} mm, true {:.3} mm",
                    robot.name,
                    claimed_m * 1e3,
                    true_m * 1e3
                );
                let all = contradicted(&found);
                assert!(expected.iter().all(|name| all.contains(&(*name).to_owned())), "{all:?}");
                assert!(true_m < claimed_m && claimed_m < 20.0 * true_m, "{true_m} {claimed_m}");
            }
        }
    }
}

#[test]
#[ignore = "20 calibrations: a minute"]
fn nothing_is_contradicted_in_good_runs() {
    for robot in [irb2400(), nj220()] {
        for seed in 1..=10 {
            let run = run(&robot, seed);
            let bar = bar_with_errors(&run, 0.0, (seed % 2 == 0).then_some(0.0));
            let (found, _) = calibrated(&run, &robot, &bar, &IdentifyConfig::default());
            assert!(contradicted(&found).is_empty(), "{} {seed}: {:?}", robot.name, found.contradicted);
        }
    }
}
