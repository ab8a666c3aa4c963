//! Some parameters are fixed at values that are wrong by their tolerance. The stated error over the workspace must
//! include the effect of these wrong values.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "figures of a run")]

use crate::support::campaign::{fewest, size};
use crate::support::rows::Alone;
use crate::support::truth::position_error_m;
use crate::support::{bar, irb2400, ur10};
use identify::calibrate::{Calibration, IdentifyConfig, JointTermsConfig, SelectionName, calibrate_run};
use identify::evaluate::{Budget, Evaluation, Expected, workspace_error};
use identify::instrument::CostName;
use identify::kinematics::{Pose, flange_chain};
use identify::logs::PoseRow;
use identify::simulate::{self, Effects, Experiment, Simulated, StaticErrors};
use nalgebra::{Rotation3, Vector3};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use rand_distr::StandardNormal;
use shared::config::{BallBarConfig, RobotConfig};

/// A configuration with these fixed parameters, and without joint terms to save time.
fn quick(fix: &[&str]) -> IdentifyConfig {
    IdentifyConfig {
        fix: fix.iter().map(|name| name.parse().unwrap()).collect(),
        bar_length_um: 0.0,
        joint_terms: JointTermsConfig { candidates: Vec::new(), ..JointTermsConfig::default() },
        ..IdentifyConfig::default()
    }
}

/// A run of a robot with errors of a millimetre or milliradian in every parameter, and of a bar with a tilted base.
fn simulated(seed: u64) -> Simulated {
    let (errors, effects) = (StaticErrors::Drawn { seed }, Effects::LABORATORY);
    simulate::run(&Experiment { seed, errors, effects, ..Experiment::new(&irb2400(), &bar()) }).unwrap()
}

fn calibrated(
    run: &Simulated,
    robot: &RobotConfig,
    bar: &BallBarConfig,
    config: &IdentifyConfig,
) -> Calibration {
    calibrate_run(&run.cycles, &run.encoders, &run.robot_log, robot, bar, config).unwrap()
}

/// True and stated mean position error \[m\]. The plate length has a random error, as large as its uncertainty.
fn with_the_bar(seed: u64, plate_u_um: f64, config: &IdentifyConfig) -> (f64, Expected) {
    let (run, robot, mut bar) = (simulated(seed), irb2400(), bar());
    let off: f64 = StdRng::seed_from_u64(seed).sample(StandardNormal);
    bar = BallBarConfig { plate_m: bar.plate_m + 1e-6 * plate_u_um * off, plate_u_um, ..bar };
    let found = calibrated(&run, &robot, &bar, config);
    let claimed = workspace_error(&found, &robot.joint_limits()).after;
    (position_error_m(&run, &found, &robot), claimed)
}

/// True and stated mean position error \[m\] of a UR10 that a tracker measures with 20 um noise. Two of its
/// lengths are fixed at nominal.
fn with_a_tracker(seed: u64) -> (f64, Expected) {
    let robot = ur10();
    let nominal = flange_chain(&robot);
    let mut random = StdRng::seed_from_u64(seed);
    let mut truth = nominal.clone();
    for link in truth.links.iter_mut().take(5) {
        for number in [&mut link.a_m, &mut link.alpha_rad] {
            *number += 1e-3 * random.sample::<f64, _>(StandardNormal);
        }
    }
    let place = Pose::translation(-3.0, 0.5, 1.3);
    let limits = robot.joint_limits();
    let mut pose = |reach: f64| -> [f64; 6] {
        std::array::from_fn(|joint| {
            let [low, high] = limits[joint];
            random.random_range(low.max(-reach)..high.min(reach))
        })
    };
    let measured: Vec<[f64; 6]> = (0..300).map(|_| pose(1.5)).collect();
    let postures: Vec<[f64; 6]> = (0..400).map(|_| pose(std::f64::consts::TAU)).collect();
    let rows = measured.into_iter().map(|joints_rad| {
        let mut white = || 2e-5 * random.sample::<f64, _>(StandardNormal);
        let mut seen = place.inverse() * truth.forward(&joints_rad);
        seen.translation.vector += Vector3::new(white(), white(), white());
        seen.rotation = Rotation3::new(Vector3::new(white(), white(), white())) * seen.rotation;
        let (position_m, rotation) = (seen.translation.vector, Some(seen.rotation));
        PoseRow { joints_rad: joints_rad.into(), position_m, rotation, ..PoseRow::default() }
    });
    let rows: Vec<PoseRow> = rows.collect();
    let fix = ["ra2", "ralpha3"].map(|name| name.parse().unwrap()).to_vec();
    let found = Alone::default().with_fixed(&fix).without_joint_errors().poses(&rows, &robot).unwrap();
    let identified = found.model().geometry(&[]).robot;
    let end = |chain: &identify::kinematics::Chain, q: &[f64; 6]| chain.forward(q).translation.vector;
    let errors_m = postures.iter().map(|q| (end(&identified, q) - end(&truth, q)).norm());
    let error_m = errors_m.sum::<f64>() / postures.len() as f64;
    (error_m, workspace_error(&found.0, &limits).after)
}

/// Counts errors within their stated 95 % interval, and errors below the upper end of this interval.
fn count_within(name: &str, found: impl Iterator<Item = (f64, Expected)>) -> [usize; 2] {
    let mut held = [0; 2];
    for (error_m, Expected { interval_m: [low, high], mean_m, .. }) in found {
        let [error, mean, low, high] = [error_m, mean_m, low, high].map(|one| one * 1e3);
        println!("{name}: {error:.3} mm, claimed {mean:.3}, {low:.3} to {high:.3}");
        held[0] += usize::from((low..=high).contains(&error));
        held[1] += usize::from(error <= high);
    }
    held
}

/// Evaluates this number of experiments for each setting. The settings are fixed links, a fixed plate, a fixed base, the
/// cost `position`, and a tracker. Returns the counts of [`held`] for each setting.
fn campaign(seeds: u64) -> Vec<[usize; 2]> {
    let thesis = IdentifyConfig { selection: SelectionName::Thesis, ..quick(&[]) };
    let position = IdentifyConfig { cost: Some(CostName::Position), ..quick(&[]) };
    let bars = [
        ("links", 10.0, quick(&["ra1", "ra2", "rd2"])),
        ("plate", 100.0, quick(&["ra6"])),
        ("base", 10.0, thesis),
        ("position", 100.0, position),
    ];
    let of_bars = bars.iter().map(|(name, plate_u_um, config)| {
        let held = count_within(name, (1..=seeds).map(|seed| with_the_bar(seed, *plate_u_um, config)));
        println!("{name}: {held:?} of {seeds}");
        held
    });
    let of_bars: Vec<[usize; 2]> = of_bars.collect();
    let of_tracker = count_within("tracker", (1..=seeds).map(with_a_tracker));
    println!("tracker: {of_tracker:?} of {seeds}");
    of_bars.into_iter().chain([of_tracker]).collect()
}

/// If three 95 % intervals are correct, fewer than two of them contain the true value once in 140 cases.
#[test]
#[ignore = "several calibrations: a quarter of a minute"]
fn what_is_fixed_at_a_wrong_value_is_part_of_the_error_that_is_claimed() {
    for [within, _] in campaign(3) {
        assert!(within >= 2, "{within}");
    }
}

/// All experiments have the same base tilt.
#[test]
#[ignore = "200 calibrations: minutes"]
fn over_forty_experiments_what_is_fixed_at_wrong_values_leaves_claims_that_hold() {
    let seeds = size(8, 40);
    let least = [0.95, 0.975].map(|part| fewest(seeds, part) as usize);
    for [within, not_above] in campaign(seeds) {
        assert!(within >= least[0] && not_above >= least[1], "{within} {not_above} of {seeds}: {least:?}");
    }
}

#[test]
fn a_rod_that_is_known_gives_the_scale_where_the_plate_does_not() {
    let (run, robot, bar) = (simulated(1), irb2400(), bar());
    let length_m = run.truth.parameters["bd3"];
    let plate = BallBarConfig { length_m, plate_m: bar.plate_m + 1e-3, plate_u_um: 1000.0, ..bar };
    let rod = BallBarConfig { length_u_um: Some(20.0), ..plate.clone() };
    let [by_plate, by_rod] = [&plate, &rod].map(|bar| {
        let found = calibrated(&run, &robot, bar, &quick(&[]));
        let claimed = workspace_error(&found, &robot.joint_limits()).after;
        (position_error_m(&run, &found, &robot) * 1e3, claimed.interval_m[1] * 1e3)
    });
    println!("error and claim [mm]: {by_plate:?} by the plate, {by_rod:?} by the rod");
    // The nominal lengths of the links are correct within a millimetre, so they also determine the scale to some extent.
    assert!(by_plate.0 > 1.0 && by_plate.1 > by_plate.0, "{by_plate:?}");
    assert!(by_rod.0 < 0.1 && by_rod.1 < 0.3, "{by_rod:?}");
}

/// RMS distance \[m\] between the ends of two calibrated robots over random postures within the joint limits.
fn apart_m(one: &Calibration, other: &Calibration, robot: &RobotConfig) -> f64 {
    const POSTURES: usize = 400;
    let mut random = StdRng::seed_from_u64(3);
    let [one, other] = [one, other].map(|found| found.model().geometry(&[]).robot);
    let squares = (0..POSTURES).map(|_| {
        let q: Vec<f64> =
            robot.joint_limits().iter().map(|[low, high]| random.random_range(*low..*high)).collect();
        (one.forward(&q).translation.vector - other.forward(&q).translation.vector).norm_squared()
    });
    (squares.sum::<f64>() / POSTURES as f64).sqrt()
}

#[test]
fn each_contribution_of_the_budget_is_what_its_source_does_to_the_robot() {
    let (run, robot, bar) = (simulated(2), irb2400(), bar());
    let (bar, config) = (BallBarConfig { plate_u_um: 100.0, ..bar }, quick(&["ralpha3"]));
    let found = calibrated(&run, &robot, &bar, &config);
    let claimed = workspace_error(&found, &robot.joint_limits());
    let Budget { contributions, u_m, expanded_m, .. } = &claimed.budget;
    let of = |start: &str| {
        let found = contributions.iter().find(|one| one.source.starts_with(start));
        found.unwrap_or_else(|| panic!("{start} is not in {contributions:?}"))
    };
    let (noise, plate, link) =
        (of("errors of the samples"), of("length of the offset plate (ra6)"), of("ralpha3"));
    assert_eq!(noise.evaluation, Evaluation::Statistical);
    assert_eq!([plate.evaluation, link.evaluation], [Evaluation::Stated; 2]);
    assert!(
        plate.source.contains("0.1 mm") && link.source.contains("fixed with an uncertainty of 1 mrad"),
        "{contributions:?}"
    );
    // Repeats the calibration with a stated value that is wrong by its stated uncertainty.
    let mut other = robot.clone();
    other.links[2].alpha_deg += 1e-3_f64.to_degrees();
    let longer = BallBarConfig { plate_m: bar.plate_m + 1e-4, ..bar.clone() };
    let moved = [
        (plate, calibrated(&run, &robot, &longer, &config)),
        (link, calibrated(&run, &other, &bar, &config)),
    ];
    for (contribution, moved) in moved {
        let apart_m = apart_m(&found, &moved, &robot);
        println!(
            "{}: {:.4} mm, by another value {:.4} mm",
            contribution.source,
            contribution.u_m * 1e3,
            apart_m * 1e3
        );
        assert!((apart_m / contribution.u_m - 1.0).abs() < 0.1, "{} {apart_m}", contribution.source);
    }
    let sum: f64 = contributions.iter().map(|one| one.u_m.powi(2)).sum();
    assert!((sum.sqrt() - u_m).abs() < 1e-9 && (expanded_m - 2.0 * u_m).abs() < 1e-12);
    // The error is a norm. The mean of a norm is below its root mean square.
    let mean_m = claimed.after.mean_m;
    assert!(mean_m < *u_m && mean_m > 0.7 * u_m, "{mean_m} {u_m}");
}
