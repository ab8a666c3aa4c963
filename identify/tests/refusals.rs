//! Data that must be refused. Each test checks words of the message.
#![allow(clippy::unwrap_used, reason = "tests")]

use crate::support::refused::Typed;
use crate::support::{bar, irb2400};
use identify::calibrate::{IdentifyConfig, calibrate_run};
use identify::instrument::CostName;
use identify::simulate::{self, Design, Effects, Experiment, Simulated};
use shared::config::BallBarConfig;

fn laboratory(change: impl Fn(&mut Experiment<'_>)) -> Simulated {
    let (robot, bar) = (irb2400(), bar());
    let effects = Effects {
        robot_noise_urad: 15.0,
        encoder_noise_urad: 5.0,
        gear_sine_urad: 30.0,
        encoder_eccentricity_urad: 40.0,
        base_tilt_urad: 5000.0,
        ..Effects::NONE
    };
    let design = Design { duration_s: 80.0, ..Design::for_robot(&robot) };
    let mut experiment = Experiment { effects, design, ..Experiment::new(&robot, &bar) };
    change(&mut experiment);
    simulate::run(&experiment).unwrap()
}

fn refusal(run: &Simulated, bar: &BallBarConfig, config: &IdentifyConfig) -> String {
    let found = calibrate_run(&run.cycles, &run.encoders, &run.robot_log, &irb2400(), bar, config);
    let told = found.map(drop).unwrap_err().to_string();
    println!("{told}\n");
    told
}

fn refused(run: &Simulated) -> String {
    refusal(run, &bar(), &IdentifyConfig::default())
}

/// Calibrates the same run from files on the command line. The command must refuse the run with the text `why`, and
/// must write only a page with this text.
fn leaves_a_page(run: &Simulated, bar: &BallBarConfig, why: &str, extra: &[&str]) {
    Typed::new(run, &irb2400(), bar).refused(&[why], extra);
}

/// The number before a unit in a message.
fn number_before(text: &str, unit: &str) -> f64 {
    let before = text.split(unit).next().unwrap();
    before.rsplit(' ').next().unwrap().parse().unwrap()
}

#[test]
fn a_slipped_encoder_is_named_with_time_and_size() {
    slips_are_named(&[(0, 4000, -0.6)]);
}

#[test]
#[ignore = "eleven runs: a quarter of a minute"]
fn slips_of_all_sizes_are_named_with_time_and_size() {
    // These slips are smaller than the effect of errors of nominal links. Only a fit of the links reveals them.
    let smallest = [(1, 3000, 0.5), (2, 6000, -0.6), (3, 1500, 0.5), (4, 4000, -0.6)];
    let small = [(0, 3000, 5.0), (3, 4000, -0.6), (4, 5000, 15.0), (2, 2000, 40.0)];
    // These slips are so large that the encoder agrees with no joint. Some are so late that
    // most of the run nevertheless agrees.
    let large = [(0, 4000, 90.0), (4, 5500, 1000.0), (3, 4100, -2500.0)];
    slips_are_named(&[&smallest[..], &small, &large].concat());
}

/// Checks that the slip of an encoder is reported, for each entry of `slips`: the joint of the bar from 0, the first cycle
/// after the slip, and the size of the slip \[mrad\].
fn slips_are_named(slips: &[(usize, usize, f64)]) {
    let clean = laboratory(|_| {});
    for &(place, at, mrad) in slips {
        let mut run = clean.clone();
        let counts = (mrad * 1e-3 / run.encoders[place].scale.rad_per_count()) as i32;
        for cycle in &mut run.cycles[at..] {
            let count = &mut cycle.encoders[place].count;
            *count = count.wrapping_add(counts as u32);
        }
        let told = refused(&run);
        if at == 4000 {
            leaves_a_page(&run, &bar(), "slips", &[]);
        }
        assert!(told.contains(&format!("encoder of joint {} slips", place + 1)), "{told}");
        assert!((number_before(&told, " s after") - at as f64 * 0.01).abs() < 0.1, "{told}");
        assert!((number_before(&told, " mrad") - mrad).abs() < 0.1 + 0.05 * mrad.abs(), "{told}");
    }
}

#[test]
fn a_clock_that_jumps_is_told_with_time_and_size() {
    jumps_are_told(&[(0.01, 0.25)]);
}

#[test]
#[ignore = "eleven runs: a quarter of a minute"]
fn jumps_of_all_sizes_are_told_with_time_and_size() {
    let in_the_middle = [0.01, -0.003, 0.05, 0.3, 4.0].map(|jump_s| (jump_s, 0.5));
    let elsewhere = [0.38, 0.62, 0.75].into_iter().flat_map(|part| [(0.01, part), (-0.04, part)]);
    jumps_are_told(&in_the_middle.into_iter().chain(elsewhere).collect::<Vec<_>>());
}

/// Checks that a jump of the robot's clock is reported, for each entry of `jumps`: its size \[s\], and the
/// fraction of the log that is before it.
fn jumps_are_told(jumps: &[(f64, f64)]) {
    let clean = laboratory(|_| {});
    for &(jump_s, part) in jumps {
        let mut run = clean.clone();
        let at = (run.robot_log.q_rad.t_s.len() as f64 * part) as usize;
        run.robot_log.q_rad.t_s[at..].iter_mut().for_each(|t_s| *t_s += jump_s);
        if jump_s < 0.0 {
            let last = run.robot_log.q_rad.t_s[at - 1];
            let surplus = run.robot_log.q_rad.t_s[at..].iter().position(|t_s| *t_s > last).unwrap();
            run.robot_log.q_rad.t_s.drain(at..at + surplus);
            run.robot_log.q_rad.rows.drain(at..at + surplus);
        }
        let told = refused(&run);
        // If only the stamps jump, during an even motion, the jump has no effect. A jump is harmful if rows are
        // missing although the stamps have no gap.
        if jump_s == -0.04 {
            leaves_a_page(&run, &bar(), "a clock jumps during the run", &[]);
        }
        assert!(told.contains("a clock jumps during the run"), "{told}");
        // If the program finds a jump only by comparing whole segments of the run, the time of
        // the jump is reported less precisely.
        let within_s = if jump_s < 0.1 { 3.0 } else { 15.0 };
        assert!((number_before(&told, " s after") - 80.0 * part).abs() < within_s, "{part}: {told}");
        assert!(
            (number_before(&told, " ms;") - 1e3 * jump_s).abs() < 0.2 * 1e3 * jump_s.abs(),
            "{part}, {jump_s}: {told}"
        );
    }
}

#[test]
fn a_motion_that_tells_too_little_is_refused() {
    // The rod only moves on a circle about the axis of the base.
    let circle = laboratory(|e| {
        e.design.bar_range_deg[1] = [50.0, 50.01];
        e.design.bar_range_deg[3] = [120.0, 120.01];
    });
    let told = refused(&circle);
    assert!(told.contains("span no sphere"), "{told}");
    leaves_a_page(&circle, &bar(), "span no sphere", &[]);
    // The rod moves, but the cardan hardly does.
    let stiff = laboratory(|e| {
        e.design.bar_range_deg[2] = [10.0, 10.5];
        e.design.bar_range_deg[3] = [120.0, 120.5];
        e.design.bar_range_deg[4] = [10.0, 10.5];
    });
    let told = refused(&stiff);
    assert!(told.contains("of the bar travels only 0."), "{told}");
    leaves_a_page(&stiff, &bar(), "of the bar travels only 0.", &[]);
}

#[test]
fn another_bar_and_another_plate_are_refused() {
    let run = laboratory(|_| {});
    let config = IdentifyConfig::default();
    let told = refusal(&run, &BallBarConfig { length_m: 0.7, ..bar() }, &config);
    assert!(told.contains("sphere of 59") && told.contains("700 mm"), "{told}");
    leaves_a_page(&run, &BallBarConfig { length_m: 0.7, ..bar() }, "700 mm", &[]);
    let told = refusal(&run, &BallBarConfig { plate_m: 0.30, tool_m: 0.05, ..bar() }, &config);
    assert!(told.contains("sphere") || told.contains("geometry"), "{told}");
}

#[test]
fn the_log_of_another_run_is_refused() {
    let mut run = laboratory(|_| {});
    run.robot_log = laboratory(|e| e.seed = 9).robot_log;
    let told = refused(&run);
    assert!(told.contains("different runs"), "{told}");
    leaves_a_page(&run, &bar(), "different runs", &[]);
}

#[test]
fn too_few_encoders_for_the_chosen_cost_are_told_with_the_missing_one() {
    let (robot, mut bar) = (irb2400(), bar());
    bar.encoders.remove(2);
    let run = simulate::run(&Experiment::new(&robot, &bar)).unwrap();
    let config = IdentifyConfig { cost: Some(CostName::Transform), ..IdentifyConfig::default() };
    let told = refusal(&run, &bar, &config);
    assert!(told.contains("needs the encoder of bar joint 3"), "{told}");
    leaves_a_page(&run, &bar, "needs the encoder of bar joint 3", &["--cost", "transform"]);
}
