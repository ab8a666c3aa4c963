//! Simulated experiments are consistent, within the ranges of robot and bar, and determine their parameters.
#![allow(clippy::unwrap_used, reason = "tests")]

use crate::support::{bar, irb2400, nj220, repository};
use identify::kinematics::{Configuration, ball_bar_chain, robot_chain, singularity_margin_rad};
use identify::logs;
use identify::model::{DriveTrain, JointState, Model, ParameterId};
use identify::robot::import;
use identify::simulate::{
    self, ClockTruth, Clocks, Design, Effects, Experiment, Simulated, StaticErrors, Truth, wire_rows,
};
use shared::config::RobotConfig;
use shared::encoder::Unwrapper;
use shared::recording::Recording;
use shared::time::UtcNs;

fn robots() -> [RobotConfig; 2] {
    [irb2400(), nj220()]
}

fn seconds_on_bar_clock(run: &Simulated, row: usize) -> f64 {
    let clock = &run.truth.clock;
    let since_ns = run.robot_log.q_rad.stamp_ns(row).unwrap() - clock.robot_at_bar_start_ns;
    since_ns as f64 * 1e-9 / (1.0 + clock.skew)
}

#[test]
fn robot_and_bar_end_in_the_same_pose_at_every_row_of_the_log() {
    for robot in robots() {
        for errors in [StaticErrors::Thesis, StaticErrors::Drawn { seed: 5 }] {
            let bar = bar();
            let run = simulate::run(&Experiment { errors, ..Experiment::new(&robot, &bar) }).unwrap();
            for (row, q) in run.robot_log.q_rad.iter().enumerate() {
                let by_robot = run.motion.robot.forward(q);
                let by_bar = run.motion.pose(seconds_on_bar_clock(&run, row));
                let apart_m = (by_robot.translation.vector - by_bar.translation.vector).norm();
                let turned = (by_robot.rotation.matrix() - by_bar.rotation.matrix()).amax();
                assert!(apart_m < 1e-12 && turned < 1e-12, "row {row}: {apart_m} m, {turned}");
            }
        }
    }
}

#[test]
fn the_true_reading_of_a_robot_clock_that_shows_utc_is_exact_to_the_nanosecond() {
    let start_ns = 1_780_000_000_000_000_001;
    let clock = ClockTruth {
        bar_start: UtcNs(start_ns),
        robot_at_bar_start_ns: start_ns + 2,
        shift_s: 2e-9,
        skew: 1e-6,
    };
    let robot_ns = clock.robot_ns(UtcNs(start_ns + 10_000_000_000));
    assert_eq!(robot_ns - start_ns, 10_000_010_002);
}

#[test]
fn the_motion_keeps_away_from_limits_and_singular_poses_and_is_smooth() {
    for robot in robots() {
        for seed in 1..4 {
            let bar = bar();
            let run = simulate::run(&Experiment { seed, ..Experiment::new(&robot, &bar) }).unwrap();
            let log = &run.robot_log;
            for (q, [low, high]) in log.q_rad.iter().flat_map(|q| q.iter().zip(robot.joint_limits())) {
                assert!((low..=high).contains(q));
            }
            assert!(log.q_rad.iter().all(|q| q[4].sin().abs() > 10_f64.to_radians().sin()));
            for window in log.q_rad.windows(4) {
                let &[first, second, third, fourth] = window else { unreachable!() };
                for (((a, b), c), d) in first.into_iter().zip(second).zip(third).zip(fourth) {
                    assert!((b - a).abs() < 0.004 * 1.3, "speed {}", (b - a) / 0.004);
                    let acceleration = (c - 2.0 * b + a) / 0.004_f64.powi(2);
                    let jerk = (d - 3.0 * c + 3.0 * b - a) / 0.004_f64.powi(3);
                    assert!(acceleration.abs() < 20.0 && jerk.abs() < 300.0, "{acceleration} {jerk}");
                }
            }
            for k in 0..=12_000 {
                let b = run.motion.path.at(f64::from(k) * 0.01);
                assert!(singularity_margin_rad(&ball_bar_chain(&bar).links, &b) > 9.99_f64.to_radians());
            }
        }
    }
}

#[test]
fn all_joints_are_excited_and_the_robot_stands_still_several_times() {
    for robot in robots() {
        let bar = bar();
        let run = simulate::run(&Experiment::new(&robot, &bar)).unwrap();
        let span = |values: &mut dyn Iterator<Item = f64>| {
            let (low, high) = values.fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(v), h.max(v)));
            high - low
        };
        let bars: Vec<[f64; 5]> = (0..=1200).map(|k| run.motion.path.at(f64::from(k) * 0.1)).collect();
        let bar_spans: [f64; 5] = std::array::from_fn(|j| span(&mut bars.iter().map(|b| b[j])).to_degrees());
        let robot_spans: [f64; 6] =
            std::array::from_fn(|j| span(&mut run.robot_log.q_rad.iter().map(|q| q[j])).to_degrees());
        println!(
            "{}: bar {bar_spans:.0?} robot {robot_spans:.0?} deg, {} moves",
            robot.name,
            run.motion.path.moves.len()
        );
        assert!(bar_spans.iter().all(|&s| s > 50.0));
        assert!(robot_spans.iter().all(|&s| s > 25.0));
        let mut still_s = 0.0;
        let mut stops = 0;
        for pair in run.robot_log.q_rad.windows(2) {
            let moved = pair[0].iter().zip(pair[1]).any(|(a, b)| (a - b).abs() > 1e-9);
            still_s = if moved { 0.0 } else { still_s + 0.004 };
            if (0.9..0.904).contains(&still_s) {
                stops += 1;
            }
        }
        assert!(stops >= 4, "{stops} stops");
    }
}

#[test]
fn counts_are_the_joints_within_half_a_count_of_the_true_zero() {
    let robot = &robots()[0];
    let mut bar = bar();
    bar.encoders[2].direction = shared::encoder::Direction::Negative;
    bar.encoders.remove(0);
    let run = simulate::run(&Experiment::new(robot, &bar)).unwrap();
    assert_eq!(run.cycles.len(), 12_001);
    for (index, (encoder, truth)) in run.encoders.iter().zip(&run.truth.encoders).enumerate() {
        assert_eq!(encoder.joint, truth.joint);
        let mut unwrapper = Unwrapper::default();
        for (k, cycle) in run.cycles.iter().enumerate() {
            let counts = unwrapper.next(cycle.encoders()[index].count);
            let joint = run.motion.path.at(k as f64 * 0.01)[usize::from(encoder.joint) - 1];
            let error = encoder.scale.counts_to_rad(counts) + truth.offset_rad - joint;
            let error = error - std::f64::consts::TAU * (error / std::f64::consts::TAU).round();
            assert!(error.abs() < 0.51 * encoder.scale.rad_per_count() + 1e-9, "{error}");
        }
    }
}

#[test]
fn cycles_are_whole_valid_and_10_ms_apart() {
    let (robot, bar) = (&robots()[0], bar());
    let run = simulate::run(&Experiment::new(robot, &bar)).unwrap();
    for (k, cycle) in run.cycles.iter().enumerate() {
        assert_eq!(cycle.cycle, k as u64);
        assert_eq!(cycle.sample_time.ns_since(run.truth.clock.bar_start), k as i64 * 10_000_000);
        assert!(cycle.is_valid() && cycle.flags == 0 && cycle.working_counter == 15);
        assert!(cycle.dc_time.0 > 0 && cycle.receive_time > cycle.send_time);
    }
}

#[test]
fn equal_experiments_are_equal_and_seeds_change_path_and_offsets() {
    let (robot, bar) = (&robots()[0], bar());
    let effects = Effects { robot_noise_urad: 5.0, encoder_noise_urad: 5.0, ..Effects::default() };
    let experiment = Experiment { effects, ..Experiment::new(robot, &bar) };
    let (a, b) = (simulate::run(&experiment).unwrap(), simulate::run(&experiment).unwrap());
    assert_eq!((&a.cycles, &a.robot_log, &a.truth), (&b.cycles, &b.robot_log, &b.truth));
    let c = simulate::run(&Experiment { seed: 2, ..experiment }).unwrap();
    assert_ne!(a.motion.path, c.motion.path);
    assert_ne!(a.truth.encoders, c.truth.encoders);
    assert_eq!(a.truth.parameters, c.truth.parameters);
}

#[test]
fn effects_have_the_size_that_was_asked_for() {
    let (robot, bar) = (&robots()[0], bar());
    let clean = simulate::run(&Experiment::new(robot, &bar)).unwrap();
    let noisy = |effects| simulate::run(&Experiment { effects, ..Experiment::new(robot, &bar) }).unwrap();
    let differences = |run: &Simulated| -> Vec<f64> {
        run.robot_log
            .q_rad
            .iter()
            .flatten()
            .zip(clean.robot_log.q_rad.iter().flatten())
            .map(|(a, b)| a - b)
            .collect()
    };
    let noise = differences(&noisy(Effects { robot_noise_urad: 100.0, ..Effects::default() }));
    let sigma = (noise.iter().map(|d| d * d).sum::<f64>() / noise.len() as f64).sqrt();
    assert!((sigma - 1e-4).abs() < 1e-6, "{sigma}");
    let sine = differences(&noisy(Effects { gear_sine_urad: 50.0, ..Effects::default() }));
    // The gear of the first axis is not coupled to other axes.
    let largest = sine.iter().step_by(6).fold(0.0_f64, |most, d| most.max(d.abs()));
    assert!((largest - 5e-5).abs() < 1e-6, "{largest}");
    let tilted = noisy(Effects { base_tilt_urad: 5000.0, ..Effects::default() });
    let up = tilted.motion.bar.root_from_base.rotation * nalgebra::Vector3::z();
    assert!((up.x.hypot(up.y) - 5e-3 * 1.0_f64.hypot(0.6)).abs() < 1e-6);
    let refused = simulate::run(&Experiment {
        effects: Effects { robot_noise_urad: f64::NAN, ..Effects::default() },
        ..Experiment::new(robot, &bar)
    });
    assert!(refused.unwrap_err().to_string().contains("robot_noise_urad"));
}

#[test]
fn a_bar_out_of_reach_is_refused_with_what_to_change() {
    let (robot, bar) = (&robots()[0], bar());
    let design = Design { base_m: [4.0, 0.0, 0.0], ..Design::IRB_2400 };
    let error =
        simulate::run(&Experiment { design, ..Experiment::new(robot, &bar) }).unwrap_err().to_string();
    assert!(error.contains("reach") && error.contains("--base"), "{error}");
}

#[test]
fn the_truth_of_a_wire_contains_the_gears_of_the_robot() {
    let (robot, bar) = (&robots()[0], bar());
    let effects = Effects { gear_sine_urad: 100.0, ..Effects::default() };
    let experiment = Experiment { effects, ..Experiment::new(robot, &bar) };
    let gears = |mut truth: Truth| {
        truth.parameters.retain(|name, _| name.starts_with("rsin") || name.starts_with("rcos"));
        truth.parameters
    };
    let of_wire = gears(wire_rows(&experiment, 20, 0.0).unwrap().1);
    assert_eq!(of_wire.len(), 12);
    assert_eq!(of_wire, gears(simulate::run(&experiment).unwrap().truth));
}

#[test]
fn other_configurations_of_the_bar_can_be_simulated() {
    let (robot, bar) = (&robots()[0], bar());
    for wanted in Configuration::ALL {
        let run =
            simulate::run(&Experiment { design: design_in(wanted), ..Experiment::new(robot, &bar) }).unwrap();
        assert_eq!(
            Configuration::from_joints(&ball_bar_chain(&bar).links, &run.motion.path.at(50.0)),
            wanted
        );
    }
}

/// The default design with the bar in another of its four configurations.
fn design_in(configuration: Configuration) -> Design {
    use identify::kinematics::Side;
    let mut design = Design { duration_s: 60.0, ..Design::IRB_2400 };
    let negative = |[low, high]: [f64; 2]| [-high, -low];
    if configuration.gimbal == Side::Negative {
        design.bar_range_deg[1] = negative(design.bar_range_deg[1]);
    }
    if configuration.cardan == Side::Negative {
        design.bar_range_deg[3] = negative(design.bar_range_deg[3]);
    }
    design
}

#[test]
fn the_files_read_back_as_what_was_simulated() {
    let directory = tempfile::tempdir().unwrap();
    for (index, robot) in robots().into_iter().enumerate() {
        let bar = bar();
        let design = Design { duration_s: 30.0, ..Design::for_robot(&robot) };
        let clocks = Clocks { robot_at_bar_start_ns: 12_345_678_901, ..Clocks::default() };
        let run = simulate::run(&Experiment { design, clocks, ..Experiment::new(&robot, &bar) }).unwrap();
        let files = simulate::write(&directory.path().join(index.to_string()), &run, &robot, &bar).unwrap();
        let recording = Recording::open(&files.recording).unwrap();
        assert_eq!(recording.cycles, run.cycles);
        assert_eq!(recording.run.encoders, run.encoders);
        let log = logs::load(&files.robot_log, &robot).unwrap();
        assert_eq!(log.q_rad.first_stamp_ns, run.robot_log.q_rad.first_stamp_ns);
        assert_eq!((log.q_rad.t_s.len(), &log.clock), (run.robot_log.q_rad.t_s.len(), &run.robot_log.clock));
        for (a, b) in log.q_rad.iter().flatten().zip(run.robot_log.q_rad.iter().flatten()) {
            assert!((a - b).abs() < 1e-9);
        }
        let truth: Truth = toml::from_str(&std::fs::read_to_string(&files.truth).unwrap()).unwrap();
        assert_eq!(truth, run.truth);
        assert_eq!(truth.bar_chain(&ball_bar_chain(&bar)), run.motion.bar);
        assert_eq!(truth.robot_chain(&robot_chain(&robot, &bar)), run.motion.robot);
    }
}

#[test]
fn drawn_errors_touch_the_38_free_parameters_and_no_other() {
    let (robot, bar) = (&robots()[0], bar());
    let errors = StaticErrors::Drawn { seed: 9 };
    let run = simulate::run(&Experiment { errors, ..Experiment::new(robot, &bar) }).unwrap();
    let changed: Vec<String> =
        simulate::parameter_names(6).into_iter().filter(|name| run.truth.error(name) != 0.0).collect();
    assert_eq!(changed.len(), 38);
    for fixed in ["ra6", "ba5", "rd1", "bd1", "rd3", "rtheta1", "bd5", "balpha2", "balpha5", "orx", "ory"] {
        assert!(!changed.iter().any(|name| name == fixed));
    }
}

/// A model with the true gear terms corrects the reported joints to those of a robot without gear errors.
#[test]
fn gear_errors_of_the_truth_correct_the_log() {
    for robot in robots() {
        let bar = bar();
        let simulated =
            |effects| simulate::run(&Experiment { effects, ..Experiment::new(&robot, &bar) }).unwrap();
        let clean = simulated(Effects::NONE);
        let with_gears = simulated(Effects { gear_sine_urad: 50.0, cycloid_urad: 20.0, ..Effects::NONE });
        let arm = robot_chain(&robot, &bar);
        let terms: Vec<(ParameterId, f64)> = with_gears
            .truth
            .parameters
            .iter()
            .filter(|(name, _)| name.starts_with("rsin") || name.starts_with("rcos"))
            .map(|(name, value)| (name.parse().unwrap(), *value))
            .collect();
        assert!(terms.len() >= 12 && clean.truth.parameters.keys().all(|name| !name.starts_with("rsin")));
        let model =
            Model::ball_bar(&arm, &ball_bar_chain(&bar)).with_drives(DriveTrain::from_robot(&robot, &arm));
        let mut model = model.with(terms.iter().map(|(id, _)| *id));
        for (id, value) in terms {
            model.set_value(id, value).unwrap();
        }
        let geometry = model.geometry(&[]);
        let mut largest_rad = 0.0_f64;
        for (read, true_rad) in
            with_gears.robot_log.q_rad.iter().zip(clean.robot_log.q_rad.iter()).step_by(50)
        {
            let corrected = geometry.corrected(&JointState::at_rest(*read));
            for ((corrected, read), is) in corrected.q.iter().zip(read.iter()).zip(true_rad.iter()) {
                assert!((corrected - is).abs() < 2e-7, "{corrected} {is}");
                largest_rad = largest_rad.max((read - is).abs());
            }
        }
        assert!(largest_rad > 4e-5, "{largest_rad}");
    }
}

#[test]
fn runs_of_one_robot_have_its_errors_and_paths_of_their_own() {
    let (robot, bar) = (&robots()[0], bar());
    let effects = Effects { gear_sine_urad: 50.0, ..Effects::LABORATORY };
    let run = |robot_seed: Option<u64>, seed: u64| {
        let errors = StaticErrors::Drawn { seed: robot_seed.unwrap_or(seed) };
        simulate::run(&Experiment { effects, errors, robot_seed, seed, ..Experiment::new(robot, &bar) })
            .unwrap()
    };
    let [one, other, alone] = [run(Some(7), 1), run(Some(7), 2), run(None, 1)];
    assert_eq!(one.truth.parameters, other.truth.parameters);
    assert_ne!(one.motion.path, other.motion.path);
    assert_ne!(one.truth.encoders, other.truth.encoders);
    assert_eq!(one.motion.path, alone.motion.path);
    assert_ne!(one.truth.parameters, alone.truth.parameters);
    assert_eq!(run(Some(1), 1).robot_log, alone.robot_log);
}

/// The first 300 moves that are tried with this seed are not feasible.
#[test]
#[ignore = "takes more than four seconds"]
fn a_start_without_a_feasible_move_is_replaced() {
    let urdf = std::fs::read_to_string(repository("identify/tests/data/seven_axes.urdf")).unwrap();
    let seven = import(&urdf, Some("base"), Some("flange")).unwrap().config;
    let bar = bar();
    let mut experiment = Experiment::new(&seven, &bar);
    (experiment.errors, experiment.seed) = (StaticErrors::Drawn { seed: 3 }, 3);
    experiment.design.duration_s = 60.0;
    experiment.drive().unwrap();
}

#[test]
fn an_arm_that_cannot_follow_the_bar_gets_the_hint_at_sockets_and_seven_axes_other_errors() {
    let urdf = std::fs::read_to_string(repository("identify/tests/data/seven_axes.urdf")).unwrap();
    let seven = import(&urdf, Some("base"), Some("flange")).unwrap().config;
    let refused =
        |robot: &RobotConfig| simulate::run(&Experiment::new(robot, &bar())).unwrap_err().to_string();
    assert!(refused(&seven).contains("--errors drawn"), "{}", refused(&seven));
    let mut five = robots()[0].clone();
    five.links.truncate(5);
    let told = refused(&five);
    assert!(told.contains("has 5 axes") && told.contains("`identify simulate contact`"), "{told}");
}
