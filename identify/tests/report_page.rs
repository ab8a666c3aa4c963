//! The page of a calibration: what it says is true, and a browser shows it without asking anybody else.
#![allow(clippy::unwrap_used, reason = "tests")]
#![allow(clippy::print_stdout, reason = "a test that is skipped says so")]

mod support;

use std::path::{Path, PathBuf};
use std::process::Command;

use identify::calibrate::ball_bar::{self, BallBarCalibration};
use identify::calibrate::{CostName, IdentifyConfig};
use identify::report::file::{CalibrationFile, ParameterEntry, SolveEntry};
use identify::report::page::Page;
use identify::simulate::{self, Effects, Experiment, Simulated, StaticErrors};
use identify::study::{evidence, workspace_error};
use serde_json::Value;
use shared::config::RobotConfig;
use support::truth::position_error_m;
use support::{bar, irb2400};

const NOISE: Effects =
    Effects { robot_noise_urad: 15.0, encoder_noise_urad: 5.0, base_tilt_urad: 5000.0, ..Effects::NONE };

fn calibrated(robot: &RobotConfig, seed: u64, cost: Option<CostName>) -> (Simulated, BallBarCalibration) {
    let bar = bar();
    let errors = StaticErrors::Drawn { seed };
    let run =
        simulate::run(&Experiment { seed, errors, effects: NOISE, ..Experiment::new(robot, &bar) }).unwrap();
    let config = IdentifyConfig { encoder_harmonics_urad: 0.0, cost, ..IdentifyConfig::default() };
    let found =
        ball_bar::calibrate(&run.cycles, &run.encoders, &run.robot_log, robot, &bar, &config).unwrap();
    (run, found)
}

fn page_text(calibration: &BallBarCalibration, robot: &RobotConfig) -> String {
    let solution = &calibration.solution;
    let file = CalibrationFile::new(
        &robot.name,
        "bar",
        SolveEntry::new(calibration.cost.name(), &solution.summary, &solution.identifiability),
        None,
        Vec::new(),
        ParameterEntry::all(&calibration.model, |id| {
            calibration.model.column_of(id).and_then(|column| solution.covariance.sigma(column))
        }),
    );
    let evidence = evidence(calibration, &robot.joint_limits_deg);
    let page = Page { file: &file, calibration, evidence: &evidence, configuration: "cost = \"pose\"" };
    page.render().unwrap().into_string()
}

#[test]
fn the_error_that_the_page_expects_is_the_error_that_the_robot_has() {
    let robot = irb2400();
    let mut inside = 0;
    const SEEDS: u64 = 8;
    for seed in 1..=SEEDS {
        let (run, found) = calibrated(&robot, seed, None);
        let expected =
            workspace_error(&found.model, &found.solution.covariance, &robot.joint_limits_deg).after;
        let truth_m = position_error_m(&run, &found, &robot);
        println!(
            "seed {seed}: true {:.4} mm, expected {:.4} ({:.4} to {:.4})",
            truth_m * 1e3,
            expected.mean_m * 1e3,
            expected.interval_m[0] * 1e3,
            expected.interval_m[1] * 1e3
        );
        let [low, high] = expected.interval_m;
        inside += usize::from((low..=high).contains(&truth_m));
    }
    // With intervals of 95 % two of eight outside come once in twenty times, three once in two hundred.
    assert!(inside >= 6, "{inside} of {SEEDS} inside");
}

#[test]
fn markup_in_a_name_is_shown_and_not_obeyed() {
    let robot = RobotConfig { name: "<script>alert('x')</script>".into(), ..irb2400() };
    let (_, found) = calibrated(&robot, 1, None);
    let text = page_text(&found, &robot);
    assert!(!text.contains("<script"));
    assert!(text.contains("&lt;script&gt;"));
}

#[test]
fn a_calibration_without_encoders_has_a_page_too() {
    let robot = irb2400();
    let (_, found) = calibrated(&robot, 1, Some(CostName::Length));
    assert!(page_text(&found, &robot).contains("Calibrated"));
}

#[test]
fn a_browser_shows_the_page_and_asks_nobody_else() {
    let Some(browser) = browser() else { return };
    let robot = irb2400();
    let (_, found) = calibrated(&robot, 1, None);
    let directory = tempfile::tempdir().unwrap();
    let page = directory.path().join("report.html");
    std::fs::write(&page, page_text(&found, &robot)).unwrap();
    let requests = directory.path().join("requests.json");
    let output = Command::new(browser)
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"])
        .args([
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--dump-dom",
        ])
        .arg(format!("--user-data-dir={}", directory.path().join("profile").display()))
        .arg(format!("--log-net-log={}", requests.display()))
        .arg(format!("file://{}", page.display()))
        .output()
        .unwrap();
    let shown = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(shown.contains("Calibrated."), "{}", String::from_utf8_lossy(&output.stderr));
    // Ten figures and the correlations; what a parser of HTML made of them, not what we wrote.
    assert!(shown.matches("<svg").count() >= 15, "{}", shown.matches("<svg").count());
    assert_eq!(foreign(&requests), Vec::<String>::new());
}

/// Addresses on the web that a browser's log of requests names, without those that it visits by itself at any start.
fn foreign(log: &Path) -> Vec<String> {
    let log: Value = serde_json::from_slice(&std::fs::read(log).unwrap()).unwrap();
    let address = |event: &Value| event["params"]["url"].as_str().map(str::to_owned);
    let of_browser = |url: &str| ["google", "gstatic", "chrome"].iter().any(|name| url.contains(name));
    let events = log["events"].as_array().unwrap().iter().filter_map(address);
    events.filter(|url| url.starts_with("http") && !of_browser(url)).collect()
}

/// Chromium, where there is one; in CI there must be.
fn browser() -> Option<PathBuf> {
    let found = ["chromium", "chromium-browser", "google-chrome"].iter().find_map(|name| {
        let paths = std::env::var_os("PATH")?;
        std::env::split_paths(&paths).map(|path| path.join(name)).find(|path| path.is_file())
    });
    if found.is_none() {
        assert!(std::env::var_os("CI").is_none(), "CI has no chromium");
        println!("skipped: no chromium on this machine");
    }
    found
}
