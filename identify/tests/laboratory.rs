//! A simulated laboratory with errors that occur in real ones but are not modelled by the estimators: two clocks, base tilt,
//! eccentric encoders, gears and noise. The tests compare the errors of the robot's parameters for several estimation
//! methods. `CAMPAIGNS=full` evaluates all methods and more seeds.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "figures of a run")]

use crate::support::campaign::{is_full, size};
use crate::support::{bar, irb2400, nj220};
use identify::calibrate::validation::deployment::Deployment;
use identify::calibrate::validation::held_out::without_each_segment;
use identify::calibrate::{Calibration, IdentifyConfig, JointTermsConfig, SelectionName, calibrate_run};
use identify::evaluate::{evidence, held_out, nominals};
use identify::instrument::CostName;
use identify::model::ParameterId;
use identify::simulate::Comparison;
use identify::simulate::{self, Effects, Experiment, Simulated};
use shared::config::{BallBarConfig, RobotConfig};

fn calibrated(
    run: &Simulated,
    robot: &RobotConfig,
    bar: &BallBarConfig,
    config: &IdentifyConfig,
) -> Calibration {
    calibrate_run(&run.cycles, &run.encoders, &run.robot_log, robot, bar, config).unwrap()
}

/// Results of one estimation method over several seeds.
#[derive(Default)]
struct Score {
    /// Error of the robot's parameters \[mm|mrad\].
    errors: Vec<f64>,
    /// Errors of the parameters, each divided by its standard uncertainty.
    in_sigmas: Vec<f64>,
}

impl Score {
    fn add(&mut self, found: &Calibration, run: &Simulated) {
        let of_robot = Comparison::new(found, &run.truth).only(|id| matches!(id, ParameterId::Robot { .. }));
        self.errors.push(of_robot.euclidean_mm_mrad());
        self.in_sigmas.extend(of_robot.parameters.iter().map(|one| {
            let column = found.model().column_of(one.id).unwrap();
            (one.identified - one.truth) / found.solution().covariance.sigma(column).unwrap()
        }));
    }

    fn mean(&self) -> f64 {
        self.errors.iter().sum::<f64>() / self.errors.len() as f64
    }

    fn max(&self) -> f64 {
        self.errors.iter().copied().fold(0.0, f64::max)
    }

    /// Fraction of the true values that are within their 95 % intervals.
    fn coverage(&self) -> f64 {
        self.in_sigmas.iter().filter(|error| error.abs() < 1.96).count() as f64 / self.in_sigmas.len() as f64
    }
}

/// Configurations of the estimation methods, with a name for each. The first is the method of
/// the thesis, the last is the default.
fn ways() -> Vec<(&'static str, IdentifyConfig)> {
    let with = |cost, selection, encoder_harmonics_urad| IdentifyConfig {
        cost: Some(cost),
        selection,
        encoder_harmonics_urad,
        bar_length_um: 0.0,
        joint_terms: JointTermsConfig { candidates: Vec::new(), ..JointTermsConfig::default() },
        ..IdentifyConfig::default()
    };
    use CostName::{Length, Pose, Position, PositionAngles, Transform};
    use SelectionName::{AllIdentifiable, Cell, Thesis};
    let named = |selection| IdentifyConfig { selection, ..IdentifyConfig::default() };
    let all = vec![
        ("transform, thesis", with(Transform, Thesis, 0.0)),
        ("length", with(Length, Thesis, 0.0)),
        ("position", with(Position, Cell, 0.0)),
        ("position_angles", with(PositionAngles, Cell, 0.0)),
        ("transform, base tilt", with(Transform, Cell, 0.0)),
        ("transform, base tilt, harmonics", with(Transform, Cell, 30.0)),
        ("pose, all identifiable, joint terms", named(AllIdentifiable)),
        ("pose, base tilt", with(Pose, Cell, 0.0)),
        ("pose, base tilt, harmonics", with(Pose, Cell, 30.0)),
        ("pose, base tilt, harmonics, joint terms", IdentifyConfig::default()),
    ];
    if is_full() {
        return all;
    }
    let (first, last) = (all[..1].to_vec(), all[all.len() - 3..].to_vec());
    [first, last].concat()
}

fn seeds() -> u64 {
    size(3, 10)
}

#[test]
#[ignore = "24 calibrations: half a minute"]
fn every_part_of_the_model_that_the_laboratory_has_brings_the_robot_nearer_to_the_truth() {
    for (robot, limit) in [(irb2400(), 0.12), (nj220(), 0.12)] {
        let bar = bar();
        let ways = ways();
        let mut scores: Vec<Score> = ways.iter().map(|_| Score::default()).collect();
        for seed in 1..=seeds() {
            let experiment =
                Experiment { seed, effects: Effects::LABORATORY, ..Experiment::new(&robot, &bar) };
            let run = simulate::run(&experiment).unwrap();
            for (score, (_, config)) in scores.iter_mut().zip(&ways) {
                score.add(&calibrated(&run, &robot, &bar, config), &run);
            }
        }
        for ((name, _), score) in ways.iter().zip(&scores) {
            println!(
                "{} {name}: {:.3} mm|mrad, at most {:.3}; {:.0} % within the 95 % interval",
                robot.name,
                score.mean(),
                score.max(),
                100.0 * score.coverage()
            );
        }
        let [thesis, .., without, harmonics, joints] = &scores[..] else { unreachable!() };
        assert!(without.mean() < 0.3 * thesis.mean(), "{}", robot.name);
        assert!(harmonics.mean() < without.mean(), "{}", robot.name);
        assert!(joints.mean() < limit && joints.max() < 0.25, "{}: {}", robot.name, joints.mean());
    }
}

#[test]
#[ignore = "several calibrations: a quarter of a minute"]
fn a_moving_average_over_both_logs_costs_no_accuracy() {
    let (robot, bar) = (irb2400(), bar());
    let mut averaged = IdentifyConfig::default();
    averaged.prepare.moving_average_ms = 100.0;
    let mut scores = [Score::default(), Score::default()];
    for seed in 1..=seeds() {
        let run = simulate::run(&Experiment {
            seed,
            effects: Effects::LABORATORY,
            ..Experiment::new(&robot, &bar)
        });
        let run = run.unwrap();
        for (score, config) in scores.iter_mut().zip([&IdentifyConfig::default(), &averaged]) {
            score.add(&calibrated(&run, &robot, &bar, config), &run);
        }
    }
    let [without, with] = scores.each_ref().map(Score::mean);
    println!("{:?} without, {:?} with an average over 100 ms", scores[0].errors, scores[1].errors);
    assert!(with < 1.3 * without, "{with} {without}");
    assert!(scores[1].max() < 0.05, "{}", scores[1].max());
}

#[test]
#[ignore = "takes more than four seconds"]
fn links_alone_are_a_fit_of_their_own_and_predict_better_than_the_links_of_a_calibration_with_gears() {
    let robots = [(irb2400(), 1), (nj220(), 2)];
    for (robot, seed) in robots {
        let effects = Effects { gear_sine_urad: 400.0, ..Effects::default() };
        let run = simulate::run(&Experiment { seed, effects, ..Experiment::new(&robot, &bar()) }).unwrap();
        let config = IdentifyConfig::default();
        let found = calibrated(&run, &robot, &bar(), &config);
        let limits = &robot.joint_limits();
        let evidence = evidence(&found, limits).with_validation(&found, None).unwrap();
        let [nominal, full, _] = evidence.held_out.as_ref().unwrap().rms().map(|rms| rms.position_m);
        let of = |wanted| {
            let one = evidence.deployed.iter().find(|(deployed, _)| deployed.deployment == wanted);
            one.unwrap().1.rms()[1].position_m
        };
        let [offsets, links] = [Deployment::Offsets, Deployment::Dh].map(of);
        let mut segments = without_each_segment(&found, None).unwrap();
        for model in segments.iter_mut().filter_map(|segment| segment.model.as_mut()) {
            let ids = model.ids();
            let of_joints =
                |id: &ParameterId| matches!(id, ParameterId::Joint { .. } | ParameterId::JointWave { .. });
            ids.into_iter().filter(of_joints).for_each(|id| model.set_value(id, 0.0).unwrap());
        }
        let truncated = held_out(&found, &segments, &nominals(&found, &segments)).rms()[1].position_m;
        println!(
            "{}: nominal {nominal:.2e}, offsets {offsets:.2e}, links {links:.2e}, of full {truncated:.2e}, full {full:.2e}",
            robot.name
        );
        assert!(full < 0.7 * links && links < truncated && links < 0.7 * nominal && links < offsets);
    }
}
