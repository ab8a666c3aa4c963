//! The noise of the angles is estimated from the data. The configured noise is only the start value of this estimate.
//! Another start value must lead to the same robot. `CAMPAIGNS=full` evaluates more runs.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "figures of a run")]

use crate::support::campaign::size;
use crate::support::truth::position_error_m;
use crate::support::{bar, irb2400, nj220};
use identify::calibrate::{Calibration, IdentifyConfig, JointTermsConfig, calibrate_run};
use identify::cost::AngleNoise;
use identify::instrument::{Noise, NoiseConfig};
use identify::simulate::{self, Effects, Experiment, Simulated};
use shared::config::RobotConfig;

fn simulated(robot: &RobotConfig, effects: Effects, seed: u64) -> Simulated {
    simulate::run(&Experiment { effects, seed, ..Experiment::new(robot, &bar()) }).unwrap()
}

const fn noise(encoder_noise_urad: f64, robot_noise_urad: f64) -> Effects {
    Effects { encoder_noise_urad, robot_noise_urad, ..Effects::NONE }
}

fn calibrated(run: &Simulated, robot: &RobotConfig, config: &IdentifyConfig) -> Calibration {
    calibrate_run(&run.cycles, &run.encoders, &run.robot_log, robot, &bar(), config).unwrap()
}

fn config_with_noise(encoder_urad: f64, robot_urad: f64) -> IdentifyConfig {
    IdentifyConfig { noise: NoiseConfig { encoder_urad, robot_urad }, ..IdentifyConfig::default() }
}

/// The configuration without error terms.
fn without_terms(config: IdentifyConfig) -> IdentifyConfig {
    IdentifyConfig {
        encoder_harmonics_urad: 0.0,
        bar_length_um: 0.0,
        joint_terms: JointTermsConfig { candidates: Vec::new(), ..JointTermsConfig::default() },
        ..config
    }
}

#[test]
#[ignore = "sixteen calibrations: a minute"]
fn whatever_noise_is_configured_the_robot_is_as_accurate_as_with_the_true_noise() {
    let seeds = size(1, 3);
    for robot in [irb2400(), nj220()] {
        for [encoder_urad, robot_urad] in [[20.0, 15.0], [200.0, 15.0], [0.0, 200.0], [100.0, 20.0]] {
            let true_noise = config_with_noise(f64::max(encoder_urad, 0.5), f64::max(robot_urad, 0.5));
            let [usual_um, least_um] = [IdentifyConfig::default(), true_noise].map(|config| {
                let error_um = |seed| {
                    let run = simulated(&robot, noise(encoder_urad, robot_urad), seed);
                    1e6 * position_error_m(&run, &calibrated(&run, &robot, &config), &robot)
                };
                (1..=seeds).map(error_um).sum::<f64>() / seeds as f64
            });
            println!(
                "{} {encoder_urad}/{robot_urad} urad: default {usual_um:.1} um, true noise configured {least_um:.1}",
                robot.name
            );
            assert!(usual_um < 1.1 * least_um + 1.0, "{usual_um} {least_um}");
        }
    }
}

/// The configured noise differs from that of the run. The robot must be the same, and the estimated noise must be reported.
#[test]
fn the_noise_of_a_run_is_found_whatever_is_configured() {
    let robot = irb2400();
    let run = simulated(&robot, noise(100.0, 20.0), 1);
    let [usual, true_noise] = [config_with_noise(5.0, 15.0), config_with_noise(100.0, 20.0)]
        .map(|config| calibrated(&run, &robot, &without_terms(config)));
    let bar = &usual.runs[0].instrument;
    let Noise::Angles(AngleNoise { encoder_rad, robot_rad }) = bar.noise() else { panic!() };
    let [encoder_urad, robot_urad] = [encoder_rad, robot_rad].map(|rad| rad * 1e6);
    assert!((encoder_urad - 100.0).abs() < 5.0, "{encoder_urad}");
    // Interpolation of the robot's log averages adjacent rows and thereby reduces their noise.
    assert!((8.0..22.0).contains(&robot_urad), "{robot_urad}");
    let [autocorrelation, sigma] = bar.autocorrelation().unwrap();
    assert!(autocorrelation.abs() < 4.0 * sigma, "{autocorrelation} {sigma}");
    let [error_m, least_m] = [&usual, &true_noise].map(|one| position_error_m(&run, one, &robot));
    assert!(error_m < 1.1 * least_m + 1e-6, "{error_m} {least_m}");
}
