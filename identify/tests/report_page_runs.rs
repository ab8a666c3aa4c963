//! The page shows the inputs and the preparation of each run. A person signs this page.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::fmt::Write;
use std::path::Path;

use crate::report_page::page_text;
use crate::support::command::identify;
use crate::support::{bar, browser, irb2400, repository};
use identify::calibrate::{
    Calibration, IdentifyConfig, JointTermsConfig, RunInput, calibrate_run, calibrate_runs,
};
use identify::evaluate::{WorkspaceError, evidence};
use identify::prepare::{PrepareOptions, SampleStatus};
use identify::simulate::{self, BarLoad, Design, Effects, Experiment, Simulated};
use shared::recording::Recording;

const NOISE: Effects = Effects { robot_noise_urad: 15.0, encoder_noise_urad: 5.0, ..Effects::NONE };

fn simulated(seed: u64, load: BarLoad) -> Simulated {
    let (robot, bar) = (irb2400(), bar());
    let design = Design { duration_s: 40.0, ..Design::for_robot(&robot) };
    simulate::run(&Experiment { seed, design, effects: NOISE, load, ..Experiment::new(&robot, &bar) })
        .unwrap()
}

fn calibrated(runs: &[&Simulated], prepare: PrepareOptions) -> Calibration {
    let bar = bar();
    let config = IdentifyConfig {
        encoder_harmonics_urad: 0.0,
        joint_terms: JointTermsConfig { candidates: Vec::new(), ..JointTermsConfig::default() },
        prepare: PrepareOptions { points_max: 500, ..prepare },
        ..IdentifyConfig::default()
    };
    let inputs = runs.iter().map(|&run| RunInput {
        cycles: &run.cycles,
        encoders: &run.encoders,
        unwrapped: None,
        log: &run.robot_log,
        bar: &bar,
    });
    let inputs: Vec<RunInput<'_>> = inputs.collect();
    calibrate_runs(&inputs, &irb2400(), &config, None).unwrap()
}

fn shown(found: &Calibration) -> String {
    let robot = irb2400();
    page_text(found, &evidence(found, &robot.joint_limits()), &robot)
}

/// The page of a run, and the page of the same run with a counter that wraps and a moving average.
fn plain_and_averaged() -> [String; 2] {
    let run = simulated(1, BarLoad::default());
    let plain = shown(&calibrated(&[&run], PrepareOptions::default()));
    let mut wrapped = run.clone();
    let first = wrapped.cycles[0].encoders[0].count;
    for cycle in &mut wrapped.cycles {
        cycle.encoders[0].count = cycle.encoders[0].count.wrapping_sub(first);
    }
    let averaged = PrepareOptions { moving_average_ms: 100.0, ..PrepareOptions::default() };
    [plain, shown(&calibrated(&[&wrapped], averaged))]
}

fn pictures(text: &str) -> usize {
    text.matches("<svg").count()
}

#[test]
fn what_was_not_unwrapped_and_not_averaged_is_told_in_a_line_and_what_was_has_a_picture() {
    let [plain, text] = plain_and_averaged();
    assert!(plain.contains("nothing was to be unwrapped") && plain.contains("off (default)"));
    assert!(!plain.contains("b1 in the file"));
    for part in ["b1 in the file", "b1 continuous", "that can be unwrapped", "averaged over 100 ms"] {
        assert!(text.contains(part), "{part}");
    }
    assert!(text.contains("Reading minus average, RMS [µrad]"));
    // The counter adds two figures, the average adds four.
    assert_eq!(pictures(&text), pictures(&plain) + 6);
    assert!(!text.contains("nothing was to be unwrapped") && !text.contains("off (default)"));
}

#[test]
#[ignore = "needs chromium"]
fn a_browser_finds_every_picture_of_what_was_averaged_and_asks_nobody_else() {
    let [_, text] = plain_and_averaged();
    let shown = browser::shown(&text);
    assert_eq!(pictures(&shown.document), pictures(&text));
    assert_eq!(shown.foreign, Vec::<String>::new());
}

#[test]
fn each_run_with_a_force_shows_it_and_what_it_left_out() {
    let load = BarLoad { force_n: 150.0, compliance_um_per_n: 0.17, play_um: 0.0, noise_n: 1.0 };
    let (rigid, whole, mut holed) =
        (simulated(1, BarLoad::default()), simulated(2, load), simulated(3, load));
    let force = holed.robot_log.force.as_mut().unwrap();
    let keep = |t_s: &f64| !(15.0..20.0).contains(t_s);
    let values = &force.values;
    force.values = values.filter_map(0..values.len(), |row, force| keep(&values.t_s[row]).then_some(*force));
    let found = calibrated(&[&rigid, &whole, &holed], PrepareOptions::default());
    let left_out: Vec<Option<usize>> =
        found.bar_runs().map(|(run, _)| run.force.map(|_| run.counts.of(SampleStatus::NoForce))).collect();
    assert!(matches!(left_out[..], [None, Some(0), Some(left_out)] if left_out > 20), "{left_out:?}");
    let text = shown(&found);
    let sections: Vec<&str> =
        text.split("<h2>").filter(|one| one.starts_with("Deviation from the sphere")).collect();
    let has_force: Vec<bool> = sections.iter().map(|one| one.contains("Measured: ")).collect();
    assert_eq!(has_force, [false, true, true]);
    assert_eq!(text.matches("the force was not measured then").count(), 2);
    let row = format!("the force was not measured then</td><td>{}</td>", left_out[2].unwrap());
    assert!(text.contains(&row), "{row}");
}

#[test]
fn a_calibration_of_the_bar_alone_expects_of_the_robot_what_it_was_before() {
    let (run, robot) = (simulated(1, BarLoad::default()), irb2400());
    let links = (1..=6).flat_map(|link| ["ra", "rd", "ralpha", "rtheta"].map(|name| format!("{name}{link}")));
    let config = IdentifyConfig {
        fix: links.chain(["rbeta2".to_owned()]).map(|name| name.parse().unwrap()).collect(),
        joint_terms: JointTermsConfig { candidates: Vec::new(), ..JointTermsConfig::default() },
        prepare: PrepareOptions { points_max: 300, ..PrepareOptions::default() },
        ..IdentifyConfig::default()
    };
    let found = calibrate_run(&run.cycles, &run.encoders, &run.robot_log, &robot, &bar(), &config);
    let found = found.unwrap();
    let limits = &robot.joint_limits();
    let evidence = evidence(&found, limits).with_validation(&found, None).unwrap();
    let WorkspaceError { before, after, .. } = evidence.workspace;
    // Each mean error is of the order of millimetres, because every link may be wrong by its
    // tolerance. The two differ only by rounding.
    let apart_m = (before.mean_m - after.mean_m).abs().max((before.p95_m - after.p95_m).abs());
    assert!(apart_m < 1e-12 && after.mean_m > 1e-3, "{before:?} {after:?}");
    assert!(page_text(&found, &evidence, &robot).contains("Calibrated. "));
}

/// A table of 24-bit counters in the format of a PLC, made from a recording.
fn table(recording: &Path) -> String {
    let recording = Recording::open(recording).unwrap();
    let mut text = "t_s,count1,count2,count3,count4,count5\n".to_owned();
    for cycle in &recording.cycles {
        let t_s = cycle.sample_time.seconds_since(recording.cycles[0].sample_time);
        let counts: Vec<String> =
            cycle.encoders().iter().map(|encoder| (encoder.count & 0xff_ffff).to_string()).collect();
        writeln!(text, "{t_s:.6},{}", counts.join(",")).unwrap();
    }
    text
}

fn typed(arguments: &[&str], out: &Path) {
    let bar = repository("config/ball_bar.toml");
    let arguments = [arguments, &["--bar", bar.to_str().unwrap()]].concat();
    let output = identify(&arguments, "irb2400_16.toml", out);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn what_a_recording_of_another_program_leaves_unsaid_stands_in_the_page() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name).display().to_string();
    typed(&["simulate", "--exact", "--duration", "40s"], directory.path());
    std::fs::write(at("plc.csv"), table(&directory.path().join("recording.mcap"))).unwrap();
    let columns: String =
        (1..=5).map(|joint| format!("[[encoders]]\njoint = {joint}\ncolumn = \"count{joint}\"\n")).collect();
    let mapping = format!("wraps_at = 16777216\n[time]\ncolumn = \"t_s\"\nunit = \"s\"\n{columns}");
    std::fs::write(at("plc.toml"), mapping).unwrap();
    let (recording, mapping, log, out) = (at("plc.csv"), at("plc.toml"), at("robot_log.csv"), at("out"));
    typed(
        &["calibrate", "--recording", &recording, "--recording-mapping", &mapping, "--robot-log", &log],
        Path::new(&out),
    );
    let text = std::fs::read_to_string(Path::new(&out).join("report.html")).unwrap();
    let inputs = text.split("<h2>").find(|section| section.starts_with("Content of the logs")).unwrap();
    assert!(inputs.contains("recording: ") && inputs.contains("robot log: "));
    for unsaid in [
        "how certain its times are",
        "the times of a second clock",
        "which values are not valid",
        "where counters restarted",
        "the date of its stamps",
    ] {
        assert!(inputs.contains(unsaid), "{unsaid}");
    }
    assert_eq!(inputs.matches("not in the file").count(), 5);
    // The figure shows the 24 bits that counters have in the file, not the 32 bits of the records.
    let turns = 16_777_216.0 / 14_745_600.0;
    assert!(turns < 1.5 && text.contains("b1 in the file") && !text.contains("counter [turns]"));
    assert!(text.len() < 3_000_000, "{} bytes", text.len());
}
