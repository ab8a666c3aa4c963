//! A run in which something changes at one instant. It is calibrated from the data on both sides of the change.
#![allow(clippy::unwrap_used, reason = "tests")]

use crate::support::refused::Typed;
use crate::support::{bar, irb2400};
use identify::simulate::{self, Effects, Experiment, Simulated};
use shared::recording::schema::CycleRecord;

/// Error of the robot's parameters \[mm|mrad\], as the command prints it if the truth is given.
fn robot_error(run: &Simulated, extra: &[&str]) -> f64 {
    let typed = Typed::new(run, &irb2400(), &bar());
    let out = tempfile::tempdir().unwrap();
    let truth = typed.inputs.path().join("truth.toml");
    let output = typed.calibrate(&[&["--truth", truth.to_str().unwrap()], extra].concat(), out.path());
    let told = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{told}\n{}", String::from_utf8_lossy(&output.stderr));
    // The experiment file repeats the options of the command.
    let repeated = std::fs::read_to_string(out.path().join("experiment.toml")).unwrap();
    assert_eq!(repeated.contains("split_at_changes = true"), !extra.is_empty());
    let (_, after) = told.split_once("robot alone (").unwrap();
    after.split_once(": ").unwrap().1.split_whitespace().next().unwrap().parse().unwrap()
}

/// First cycle after the change.
const AT: usize = 6000;

#[test]
#[ignore = "seven calibrations: half a minute"]
fn both_sides_of_a_slip_and_of_a_jump_calibrate_better_than_either() {
    let robot = irb2400();
    let bar = bar();
    let experiment = Experiment { effects: Effects::LABORATORY, ..Experiment::new(&robot, &bar) };
    let sound = simulate::run(&experiment).unwrap();
    let (mut slipped, mut jumped) = (sound.clone(), sound.clone());
    let counts = (2e-3 / sound.encoders[3].scale.rad_per_count()) as u32;
    for cycle in &mut slipped.cycles[AT..] {
        cycle.encoders[3].count = cycle.encoders[3].count.wrapping_add(counts);
    }
    for cycle in &mut jumped.cycles[AT..] {
        cycle.sample_time = cycle.sample_time.plus_ns(20_000_000);
    }
    Typed::new(&slipped, &robot, &bar).refused(&["encoder of joint 4 slips"], &[]);
    // The cycles of a side are numbered from zero, as in a separate recording.
    let numbered = |(cycle, record): (u64, &CycleRecord)| CycleRecord { cycle, ..*record };
    let of_side = |cycles: &[CycleRecord]| {
        let cycles = (0..).zip(cycles).map(numbered).collect();
        robot_error(&Simulated { cycles, ..sound.clone() }, &[])
    };
    let of_sides = [of_side(&sound.cycles[..AT]), of_side(&sound.cycles[AT..])];
    for run in [&slipped, &jumped] {
        let found = robot_error(run, &["--split-at-changes"]);
        assert!(of_sides.iter().all(|of_side| found < *of_side), "{found} {of_sides:?}");
    }
}

#[test]
#[ignore = "takes ten seconds"]
fn the_page_names_the_recording_of_each_part() {
    let (robot, bar) = (irb2400(), bar());
    let experiment = Experiment { effects: Effects::LABORATORY, ..Experiment::new(&robot, &bar) };
    let mut jumped = simulate::run(&experiment).unwrap();
    for cycle in &mut jumped.cycles[AT..] {
        cycle.sample_time = cycle.sample_time.plus_ns(20_000_000);
    }
    // A second run of the same robot.
    let second = Experiment { seed: 2, robot_seed: Some(experiment.seed), ..experiment };
    let second = simulate::run(&second).unwrap();
    let [first, second] = [&jumped, &second].map(|run| Typed::new(run, &robot, &bar));
    // The first four arguments name the recording and the robot's log.
    let files = second.arguments[..4].iter().map(|argument| argument.to_str().unwrap());
    let extra: Vec<&str> = files.chain(["--split-at-changes"]).collect();
    let out = tempfile::tempdir().unwrap();
    let output = first.calibrate(&extra, out.path());
    let page = std::fs::read_to_string(out.path().join("report.html")).unwrap();
    for (part, run) in [(1, &first), (2, &first), (3, &second)] {
        let name = format!("Run {part} of 3: {}", run.arguments[1].display());
        assert!(page.contains(&name), "{name}: {}", String::from_utf8_lossy(&output.stderr));
    }
}
