//! Calibrates every robot on every family of paths with the command `identify`. Input: the files of a run.
//! Output: a calibration or a refusal.
//!
//! Command: `CAMPAIGNS=full cargo test -p identify --test all independent_campaign -- --ignored --nocapture`.
//! These environment variables change it:
//!
//! - `IDENTIFY_SEEDS=10`: number of runs of each kind; `IDENTIFY_FIRST_SEED=100`: first seed.
//! - `IDENTIFY_ROBOTS=irb2400,nj220`, `IDENTIFY_PATHS=bursts`: evaluate only these robots and paths.
//! - `IDENTIFY_STAMPS=jittered`: corrupts the stamps of the robot log in this way. `all` uses each way in turn. Each run is
//!   compared with the same run with perfect stamps.
//! - `IDENTIFY_KEEP=directory`: keeps the files.
#![allow(clippy::print_stdout, reason = "figures of a run")]

use std::process::{Command, Output};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::*;
use crate::support::campaign::step;

/// Result of one run.
pub(super) enum Outcome {
    Refused(String),
    Calibrated {
        identified: usize,
        error_mm_mrad: f64,
        /// Root mean square of the parameter errors, each divided by its standard uncertainty.
        error_sigmas: f64,
        /// True mean position error of the end over the range of the robot \[mm\]. `claimed_mm` is the stated error (k = 2).
        true_mm: f64,
        claimed_mm: f64,
        largest: String,
        /// Grade of the verdict and, if the verdict is not green, its reason.
        verdict: String,
    },
}

pub(super) fn chosen(variable: &str, name: &str) -> bool {
    let Ok(names) = std::env::var(variable) else { return true };
    names.to_lowercase().split(',').any(|one| name.to_lowercase().contains(one))
}

pub(super) fn number(variable: &str, otherwise: u64) -> u64 {
    std::env::var(variable).map_or(otherwise, |value| value.parse().unwrap())
}

/// Errors of stamps that controllers make.
const STAMPS: [Stamps; 11] = [
    Stamps::Rounded(1.0),
    Stamps::Jittered(2.0),
    Stamps::Rounded(4.0),
    Stamps::Duplicated(0.05),
    Stamps::Rounded(10.0),
    Stamps::Batched(5),
    Stamps::Rounded(15.6),
    Stamps::Missing(0.15, 2.0),
    Stamps::Jittered(0.5),
    Stamps::Late(0.02),
    Stamps::Jittered(1.0),
];

/// The stamps that `IDENTIFY_STAMPS` selects. If it selects several, seed and family determine which of them is used.
fn stamps(family: Family, seed: u64) -> Stamps {
    let kind = std::env::var("IDENTIFY_STAMPS").unwrap_or_default();
    let chosen = |stamps: &&Stamps| kind == "all" || format!("{stamps:?}").to_lowercase().starts_with(&kind);
    let chosen: Vec<&Stamps> = STAMPS.iter().filter(chosen).collect();
    let begin =
        if kind == "all" { 4 * Family::ALL.iter().position(|one| *one == family).unwrap() } else { 0 };
    if kind.is_empty() { Stamps::Perfect } else { *chosen[(begin + seed as usize) % chosen.len()] }
}

/// Settings of a run: a rate that logs of controllers have, the speed that the path needs, and the selected stamps.
pub(super) fn sizes(family: Family, seed: u64) -> Sizes {
    let rates_hz = match family {
        Family::Fast => &[250.0, 500.0, 1000.0][..],
        Family::Long => &[10.0, 20.0, 1000.0, 250.0][..],
        _ => &[100.0, 250.0, 50.0, 125.0, 1000.0][..],
    };
    Sizes {
        robot_log_hz: rates_hz[seed as usize % rates_hz.len()],
        bar_utc: seed % 2 == 1,
        stamps: stamps(family, seed),
        ..Sizes::default()
    }
}

/// Runs `identify calibrate` on the files of a run.
pub(super) fn calibrate(files: &Files, out: &Path) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_identify"));
    command
        .arg("calibrate")
        .arg("--recording")
        .arg(&files.recording)
        .arg("--robot-log")
        .arg(&files.robot_log);
    command.arg("--robot").arg(&files.robot).arg("--bar").arg(&files.bar).arg("--out").arg(out);
    command.output().unwrap()
}

fn calibrated(run: &Run, directory: &Path) -> Outcome {
    let (files, out) = (run.write(directory), directory.join("out"));
    let output = calibrate(&files, &out);
    Outcome::from_output(run, &output, &out)
}

impl Outcome {
    /// Compares a successful calibration with the true values of its run.
    pub(super) fn from_output(run: &Run, output: &Output, out: &Path) -> Self {
        if !output.status.success() {
            let directory = format!("{}/", out.parent().unwrap().display());
            let text = String::from_utf8_lossy(&output.stderr).replace(&directory, "");
            let why = text.lines().find(|line| line.starts_with("error:")).unwrap_or(&text);
            return Self::Refused(why.to_owned());
        }
        let text = std::fs::read_to_string(out.join("calibration.toml")).unwrap();
        let file: toml::Table = text.parse().unwrap();
        let entries = file["parameters"].as_array().unwrap();
        let correction =
            |entry: &toml::Value| Some((entry["name"].as_str()?.to_owned(), entry["correction"].as_float()?));
        let found: BTreeMap<String, f64> = entries.iter().filter_map(correction).collect();
        // Offsets along parallel axes cannot be separated, so the last of these axes has the sum of their offsets. The error
        // of the offset of the first axis alone is meaningless.
        let mut truth = run.truth.robot.clone();
        let last = run.robot.undetermined.iter().rfind(|name| name.starts_with("rd"));
        if let Some(last) = last.filter(|last| **last != "rd1") {
            truth.insert((*last).to_owned(), truth["rd2"]);
        }
        // For each parameter its name, error and standard uncertainty [mm, mrad].
        let errors: Vec<(&str, f64, f64)> = entries
            .iter()
            .filter(|entry| entry["status"].as_str() != Some("fixed"))
            .filter_map(|entry| {
                let name = entry["name"].as_str().unwrap();
                let error = entry["correction"].as_float().unwrap() - truth.get(name)?;
                Some((name, error * 1e3, entry["sigma"].as_float()? * 1e3))
            })
            .collect();
        let largest = errors.iter().max_by(|one, other| one.1.abs().total_cmp(&other.1.abs())).unwrap();
        let squares: f64 = errors.iter().map(|(_, error, sigma)| (error / sigma).powi(2)).sum();
        Self::Calibrated {
            identified: errors.len(),
            error_mm_mrad: errors.iter().map(|(_, error, _)| error.powi(2)).sum::<f64>().sqrt(),
            true_mm: run.position_error_mm(&found),
            claimed_mm: file["budget"]["expanded_m"].as_float().unwrap() * 1e3,
            error_sigmas: (squares / errors.len() as f64).sqrt(),
            largest: format!("{} {:+.3}", largest.0, largest.1),
            verdict: ["grade", "reason"]
                .map(|key| file["verdict"].get(key).map_or("", |text| text.as_str().unwrap()))
                .join(" "),
        }
    }
}

impl std::fmt::Display for Outcome {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Refused(why) => write!(f, "REFUSED {why}"),
            Self::Calibrated {
                identified,
                error_mm_mrad,
                error_sigmas,
                true_mm,
                claimed_mm,
                largest,
                verdict,
            } => {
                write!(
                    f,
                    "{error_mm_mrad:.3} mm|mrad over {identified}, {error_sigmas:.2} sigmas, largest {largest}; true {true_mm:.3} mm, \
                     claimed {claimed_mm:.3}: {verdict:.120}"
                )
            }
        }
    }
}

#[test]
#[ignore = "a few seconds for each of the 55 runs that one seed makes"]
fn independent_campaign() {
    let (first, seeds) = (number("IDENTIFY_FIRST_SEED", 1), number("IDENTIFY_SEEDS", 1));
    let mut jobs = Vec::new();
    for robot in Robot::all().into_iter().filter(|robot| chosen("IDENTIFY_ROBOTS", robot.name)) {
        for family in
            Family::ALL.into_iter().filter(|family| chosen("IDENTIFY_PATHS", &format!("{family:?}")))
        {
            jobs.extend((first..first + seeds).map(|seed| (robot.clone(), family, seed)));
        }
    }
    let jobs: Vec<_> = jobs.into_iter().step_by(step()).collect();
    let (next, refused) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let (errors, perfect_errors) = (Mutex::new(Vec::new()), Mutex::new(Vec::new()));
    let work = || {
        while let Some((robot, family, seed)) = jobs.get(next.fetch_add(1, Ordering::Relaxed)) {
            let sizes = sizes(*family, *seed);
            let run = Run::new(robot.clone(), *family, &sizes, *seed);
            let temporary = tempfile::tempdir().unwrap();
            let directory = std::env::var("IDENTIFY_KEEP").map_or_else(
                |_| temporary.path().to_owned(),
                |kept| Path::new(&kept).join(format!("{}-{family:?}-{seed}", robot.name)),
            );
            std::fs::create_dir_all(&directory).unwrap();
            let begun = std::time::Instant::now();
            let outcome = calibrated(&run, &directory);
            match &outcome {
                Outcome::Refused(_) => {
                    refused.fetch_add(1, Ordering::Relaxed);
                }
                Outcome::Calibrated { error_mm_mrad, .. } => errors.lock().unwrap().push(*error_mm_mrad),
            }
            let beside = (sizes.stamps != Stamps::Perfect).then(|| {
                let perfect = Sizes { stamps: Stamps::Perfect, ..sizes.clone() };
                let outcome = calibrated(&Run::new(robot.clone(), *family, &perfect, *seed), &directory);
                if let Outcome::Calibrated { error_mm_mrad, .. } = &outcome {
                    perfect_errors.lock().unwrap().push(*error_mm_mrad);
                }
                format!("; perfect stamps: {outcome}")
            });
            let beside = beside.unwrap_or_default();
            let kind = format!("{family:?}");
            let rate_hz = sizes.robot_log_hz;
            let taken_s = begun.elapsed().as_secs_f64();
            let stamps = format!("{:?}", sizes.stamps);
            println!(
                "{:8} {kind:15} {seed:4} {rate_hz:4} Hz {stamps:18} {taken_s:3.0} s  {outcome}, bound {:.3}{beside}",
                robot.name, run.bound_mm_mrad
            );
        }
    };
    std::thread::scope(|scope| (0..2).for_each(|_| drop(scope.spawn(work))));
    let refused = refused.into_inner();
    println!("{} runs: {refused} refused; Euclidean error of the robot's block [mm|mrad]:", jobs.len());
    for (which, errors) in [("", errors), (" with perfect stamps", perfect_errors)] {
        let mut errors = errors.into_inner().unwrap();
        errors.sort_by(f64::total_cmp);
        if let (Some(least), Some(most)) = (errors.first(), errors.last()) {
            let mean = errors.iter().sum::<f64>() / errors.len() as f64;
            let median = errors[errors.len() / 2];
            println!("least {least:.3}, median {median:.3}, mean {mean:.3}, largest {most:.3}{which}");
        }
    }
    assert_eq!(refused, 0, "sound runs are refused");
}
