//! Verdicts of many experiments with known truth. The stated error of the robot must be correct, and no robot with a green
//! verdict may be less accurate than stated. `CAMPAIGNS=full` evaluates all experiments.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "figures of a run")]

use std::collections::BTreeMap;

use identify::calibrate::{CalibrateError, Calibration, IdentifyConfig, calibrate_run};
use identify::evaluate::{Expected, WorkspaceError, evidence};
use identify::kinematics::Joints;
use identify::report::result::file::{CalibrationFile, ParameterEntry, SolveEntry};
use identify::report::verdict::{CalibrationVerdict, Grade};
use identify::simulate::position_errors_m;
use identify::simulate::{Design, Simulated};
use nalgebra::Vector3;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use shared::config::{BallBarConfig, RobotConfig};
use statrs::distribution::{Binomial, DiscreteCDF};

use crate::support::campaign::size;
use crate::support::laboratory::{self, Level};
use crate::support::{bar, irb2400, nj220};

/// Standard uncertainty of a plate length that was measured with a calliper \[um\].
const PLATE_U_UM: f64 = 50.0;

/// A run and the configured bar. The errors of the run are between noise alone and more than those of level `hard`. The
/// configured plate length has the error of a calliper.
fn experiment(robot: &RobotConfig, seed: u64) -> (Simulated, BallBarConfig) {
    let mut random = ChaCha8Rng::seed_from_u64(31_000 + seed);
    let mut up_to = |most: f64| random.random_range(0.0..most);
    let level = Level {
        robot_noise_urad: 2.0 + up_to(30.0),
        encoder_noise_urad: 1.0 + up_to(12.0),
        gear_sine_urad: up_to(90.0),
        cycloid_urad: up_to(50.0),
        backlash_urad: up_to(20.0),
        eccentricity_urad: up_to(90.0),
        second_harmonic_urad: up_to(40.0),
        bar_um: up_to(25.0),
        base_tilt_urad: up_to(10_000.0),
    };
    let mut design = Design::for_robot(robot);
    for base_m in &mut design.base_m {
        *base_m += up_to(0.1) - 0.05;
    }
    let run = laboratory::run(robot, &bar(), seed, &level, design);
    let off: f64 = random.sample(StandardNormal);
    let bar = BallBarConfig { plate_u_um: PLATE_U_UM, ..bar() };
    (run, BallBarConfig { plate_m: bar.plate_m + 1e-6 * PLATE_U_UM * off, ..bar })
}

/// Stated error over the workspace \[m\], verdict, and true errors including the errors of joints \[m\]. The true errors are
/// the mean and the 95 % quantile over the postures.
pub fn judged(
    run: &Simulated,
    found: &Calibration,
    robot: &RobotConfig,
) -> Result<(WorkspaceError, CalibrationVerdict, [f64; 2]), CalibrateError> {
    let limits = &robot.joint_limits();
    let evidence = evidence(found, limits).with_validation(found, None)?;
    let solution = found.solution();
    let solve = SolveEntry::new(found.cost_name(), &solution.summary, &solution.identifiability);
    let parameters = ParameterEntry::of_calibration(found);
    let file = CalibrationFile::new(&robot.name, "bar", solve, Vec::new(), parameters);
    let file = file.with_knowledge(solution, &found.solved.covariance_columns).with_validation(&evidence);
    let file = file.with_verdict(&evidence.workspace, &evidence.limits, None);
    let (mean_m, p95_m) = position_errors_m(found.model(), &run.truth, robot, [Vector3::zeros(); 2]);
    Ok((evidence.workspace, file.verdict.unwrap(), [mean_m, p95_m]))
}

/// Evaluates this number of experiments with two robots.
#[test]
#[ignore = "a dozen calibrations with everything that is said of them: most of a minute"]
fn nothing_is_green_that_is_wrong_and_no_good_run_is_refused() {
    let cases = size(40, 200);
    let mut verdicts = BTreeMap::<String, u32>::new();
    let (mut within, mut below) = (0, 0);
    for seed in 1..=cases {
        let robot = if seed % 2 == 0 { irb2400() } else { nj220() };
        let (run, bar) = experiment(&robot, seed);
        let config = IdentifyConfig::default();
        let found = calibrate_run(&run.cycles, &run.encoders, &run.robot_log, &robot, &bar, &config);
        let judged = found.and_then(|found| judged(&run, &found, &robot));
        let (WorkspaceError { after, budget, .. }, verdict, [true_m, true_p95_m]) = match judged {
            Ok(judged) => judged,
            Err(error) => {
                println!("{seed} {}: refused, {error}", robot.name);
                *verdicts.entry("refused".into()).or_default() += 1;
                continue;
            }
        };
        let Expected { p95_upper_m, interval_m: [low_m, high_m], .. } = after;
        let expanded_m = budget.expanded_m;
        println!(
            "{seed} {}: {:?}, claimed {:.4} mm (k = 2; mean {:.4} to {:.4}), true {:.4}, 95 % of it below {:.4}, claimed {:.4} {}",
            robot.name,
            verdict.grade,
            expanded_m * 1e3,
            low_m * 1e3,
            high_m * 1e3,
            true_m * 1e3,
            true_p95_m * 1e3,
            p95_upper_m * 1e3,
            verdict.reason.unwrap_or_default()
        );
        within += u64::from((low_m..=high_m).contains(&true_m));
        below += u64::from(true_p95_m <= p95_upper_m);
        let truth = match true_m / expanded_m {
            times if times <= 1.0 => "within",
            times if times <= 2.0 => "up to twice",
            _ => "beyond twice",
        };
        *verdicts.entry(format!("{:?}, true error {truth} the claim", verdict.grade)).or_default() += 1;
    }
    println!("{verdicts:#?}\nin the 95 % interval {within}, below the 97.5 % limit {below}, of {cases}");
    assert!(!verdicts.contains_key("refused"), "good runs are refused");
    assert!(!verdicts.contains_key("Green, true error beyond twice the claim"), "green and wrong");
    // By chance, a smaller number occurs once in a hundred cases.
    let least = |part| Binomial::new(part, cases).unwrap().inverse_cdf(0.01);
    assert!(within >= least(0.95) && below >= least(0.975), "{within}, {below} of {cases}");
}

/// A function that corrupts a run, or changes the configuration of bar or robot so that it is wrong.
type Spoil = fn(&mut Simulated, &mut BallBarConfig, &RobotConfig);

fn spoils() -> Vec<(&'static str, Spoil)> {
    vec![
        ("plate 1 mm too long", |_, bar, _| bar.plate_m += 1e-3),
        ("plate 1.5 mm too long", |_, bar, _| bar.plate_m += 1.5e-3),
        ("rod 20 mm too long", |_, bar, _| bar.length_m += 0.02),
        ("ratio of drive 3 off by 0.1 %", |run, _, robot| {
            laboratory::of_drive(run, robot, 2, |g, row| 1.001 * g[row])
        }),
        ("ratio of drive 2 off by 1 %", |run, _, robot| {
            laboratory::of_drive(run, robot, 1, |g, row| 1.01 * g[row])
        }),
        ("joint 2 counts the other way", |run, _, _| scale(run, 1, -1.0)),
        ("a mirrored arm", |run, _, _| [0, 3, 5].into_iter().for_each(|joint| scale(run, joint, -1.0))),
        ("joint 4 in degrees", |run, _, _| scale(run, 3, 1f64.to_degrees())),
        ("joint 4 frozen", |run, _, _| {
            let at = run.robot_log.q_rad[0][3];
            rows(run, |q, _| q[3] = at);
        }),
        ("drive 5 late by 8 ms", |run, _, robot| {
            laboratory::of_drive(run, robot, 4, |g, row| g[row.saturating_sub(2)])
        }),
        ("drive 3 late by 4 ms", |run, _, robot| {
            laboratory::of_drive(run, robot, 2, |g, row| g[row.saturating_sub(1)])
        }),
        ("joints 4 and 5 exchanged", |run, _, _| rows(run, |q, _| (q[3], q[4]) = (q[4], q[3]))),
        ("joints 4 and 6 exchanged", |run, _, _| rows(run, |q, _| (q[3], q[5]) = (q[5], q[3]))),
        ("joint 3 steps by 1 mrad", |run, _, _| step(run, 2, 1e-3)),
        ("joint 1 steps by 0.2 mrad", |run, _, _| step(run, 0, 0.2e-3)),
        ("joint 6 drifts by 1 mrad", |run, _, _| rows(run, |q, part| q[5] += 1e-3 * part)),
        ("encoder 3 slips by 1 mrad", |run, _, _| slip(run, 2, 1e-3)),
        ("encoder 5 slips by 0.1 mrad", |run, _, _| slip(run, 4, 0.1e-3)),
        ("encoders 1 and 2 exchanged", |run, _, _| laboratory::exchange(run, &[1, 0, 2, 3, 4])),
        ("the foot moves by 1 mm", |run, _, robot| {
            let mut design = Design::for_robot(robot);
            design.base_m[0] += 1e-3;
            let moved = laboratory::run(robot, &bar(), 1, &Level::USUAL, design);
            rows_of(run, &moved, |part| part > 0.5);
        }),
        ("second half of another run", |run, _, robot| {
            let other = laboratory::run(robot, &bar(), 2, &Level::HARD, Design::for_robot(robot));
            rows_of(run, &other, |part| part > 0.5);
        }),
        ("the robot's log smoothed over 50 ms", |run, _, _| smoothed(run, 6)),
        ("the robot's clock steps by 50 ms", |run, _, _| {
            let half = run.robot_log.q_rad.t_s.len() / 2;
            run.robot_log.q_rad.t_s[half..].iter_mut().for_each(|t_s| *t_s += 0.05);
        }),
        ("the robot's clock is 0.1 % fast", |run, _, _| {
            run.robot_log.q_rad.t_s.iter_mut().for_each(|t_s| *t_s *= 1.001);
        }),
    ]
}

/// Changes the joints of each row. `change` also receives the fraction of the run that is before the row.
fn rows(run: &mut Simulated, change: impl Fn(&mut Joints, f64)) {
    let count = run.robot_log.q_rad.len() as f64;
    for (row, q) in run.robot_log.q_rad.iter_mut().enumerate() {
        change(q, row as f64 / count);
    }
}

fn scale(run: &mut Simulated, joint: usize, by: f64) {
    rows(run, |q, _| q[joint] *= by);
}

fn step(run: &mut Simulated, joint: usize, by_rad: f64) {
    rows(run, |q, part| q[joint] += if part > 0.4 { by_rad } else { 0.0 });
}

fn smoothed(run: &mut Simulated, reach: usize) {
    let before = run.robot_log.q_rad.clone();
    for (row, q) in run.robot_log.q_rad.iter_mut().enumerate() {
        let near = &before[row.saturating_sub(reach)..(row + reach + 1).min(before.len())];
        for joint in 0..6 {
            q[joint] = near.iter().map(|one| one[joint]).sum::<f64>() / near.len() as f64;
        }
    }
}

fn slip(run: &mut Simulated, place: usize, by_rad: f64) {
    let counts = (by_rad / run.encoders[place].scale.rad_per_count()) as i32;
    let half = run.cycles.len() / 2;
    for cycle in &mut run.cycles[half..] {
        let sample = &mut cycle.encoders[place];
        sample.count = sample.count.wrapping_add_signed(counts);
    }
}

fn rows_of(run: &mut Simulated, other: &Simulated, taken: impl Fn(f64) -> bool) {
    let count = run.robot_log.q_rad.len();
    for (row, (q, from)) in run.robot_log.q_rad.iter_mut().zip(other.robot_log.q_rad.iter()).enumerate() {
        if taken(row as f64 / count as f64) {
            *q = *from;
        }
    }
}

#[test]
#[ignore = "two dozen runs of each robot, most of which end early: a minute"]
fn what_is_spoiled_is_refused_or_flagged_or_does_no_harm() {
    let mut wrong = Vec::new();
    for robot in [irb2400(), nj220()] {
        let clean = laboratory::run(&robot, &bar(), 1, &Level::USUAL, Design::for_robot(&robot));
        for (name, spoil) in spoils() {
            let (mut run, mut bar) = (clean.clone(), bar());
            spoil(&mut run, &mut bar, &robot);
            let config = IdentifyConfig::default();
            let found = calibrate_run(&run.cycles, &run.encoders, &run.robot_log, &robot, &bar, &config);
            let told = match found.and_then(|found| judged(&run, &found, &robot)) {
                Err(error) => format!("refused: {error}"),
                Ok((workspace, verdict, [true_m, _])) => {
                    let (claimed_m, grade) = (workspace.budget.expanded_m, verdict.grade);
                    if grade == Grade::Green && true_m > 2.0 * claimed_m {
                        wrong.push(format!("{}: {name}", robot.name));
                    }
                    format!(
                        "{grade:?}, claimed {:.3} mm, true {:.3}: {}",
                        claimed_m * 1e3,
                        true_m * 1e3,
                        verdict.reason.unwrap_or_default()
                    )
                }
            };
            println!("{}, {name}: {told}\n", robot.name);
        }
    }
    assert!(wrong.is_empty(), "green and wrong: {wrong:?}");
}
