//! Every robot, every kind of path, calibrated as a user would: files in, result or refusal out.
//!
//! `cargo test -p identify --test all independent_campaign -- --ignored --nocapture`; `IDENTIFY_SEEDS=10` runs so many of
//! each, `IDENTIFY_FIRST_SEED=100` begins with another, `IDENTIFY_ROBOTS=irb2400,nj220` and `IDENTIFY_PATHS=bursts` choose,
//! `IDENTIFY_STAMPS=jittered` spoils the stamps of the robot's log, `IDENTIFY_KEEP=directory` keeps the files.
#![allow(clippy::print_stdout, reason = "figures of a run")]

use std::process::{Command, Output};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::*;

/// What became of one run.
enum Outcome {
    Refused(String),
    Calibrated { identified: usize, error_mm_mrad: f64, largest: String },
}

pub(super) fn chosen(variable: &str, name: &str) -> bool {
    let Ok(names) = std::env::var(variable) else { return true };
    names.to_lowercase().split(',').any(|one| name.to_lowercase().contains(one))
}

pub(super) fn number(variable: &str, otherwise: u64) -> u64 {
    std::env::var(variable).map_or(otherwise, |value| value.parse().unwrap())
}

/// Sizes of a run: rates of all kinds of controllers, as fast as the path needs; stamps as the environment says.
pub(super) fn sizes(family: Family, seed: u64) -> Sizes {
    let rates_hz =
        if family == Family::Fast { &[250.0, 500.0, 1000.0][..] } else { &[100.0, 250.0, 50.0, 125.0][..] };
    let stamps = match std::env::var("IDENTIFY_STAMPS").as_deref() {
        Ok("rounded") => Stamps::Rounded([1.0, 4.0, 10.0, 15.6][seed as usize % 4]),
        Ok("jittered") => Stamps::Jittered([0.5, 1.0, 2.0][seed as usize % 3]),
        Ok("duplicated") => Stamps::Duplicated(0.05),
        Ok("batched") => Stamps::Batched(5),
        _ => Stamps::Perfect,
    };
    Sizes {
        robot_log_hz: rates_hz[seed as usize % rates_hz.len()],
        bar_utc: seed % 2 == 1,
        stamps,
        ..Sizes::default()
    }
}

/// `identify calibrate` on files of a run. Where the arm has parallel axes whose offsets only their sum determines, the user
/// fixes one more, as the program asks for.
pub(super) fn calibrate(run: &Run, files: &Files, out: &Path) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_identify"));
    command
        .arg("calibrate")
        .arg("--recording")
        .arg(&files.recording)
        .arg("--robot-log")
        .arg(&files.robot_log);
    command.arg("--robot").arg(&files.robot).arg("--bar").arg(&files.bar).arg("--out").arg(out);
    for name in run.robot.undetermined.iter().filter(|name| !["rd1", "rd3", "rtheta1"].contains(name)) {
        command.args(["--fix", name]);
    }
    command.output().unwrap()
}

fn calibrated(run: &Run, directory: &Path) -> Outcome {
    let (files, out) = (run.write(directory), directory.join("out"));
    let output = calibrate(run, &files, &out);
    if !output.status.success() {
        let text = String::from_utf8_lossy(&output.stderr).replace(&format!("{}/", directory.display()), "");
        let why = text.lines().find(|line| line.starts_with("error:")).unwrap_or(&text);
        return Outcome::Refused(why.to_owned());
    }
    let text = std::fs::read_to_string(out.join("calibration.toml")).unwrap();
    let file: toml::Table = text.parse().unwrap();
    let errors: Vec<(String, f64)> = file["parameters"]
        .as_array()
        .unwrap()
        .iter()
        .filter(|entry| entry["status"].as_str() != Some("fixed"))
        .filter_map(|entry| {
            let name = entry["name"].as_str().unwrap();
            let truth = run.truth.robot.get(name)?;
            Some((name.to_owned(), (entry["correction"].as_float().unwrap() - truth) * 1e3))
        })
        .collect();
    let largest = errors.iter().max_by(|one, other| one.1.abs().total_cmp(&other.1.abs())).unwrap();
    Outcome::Calibrated {
        identified: errors.len(),
        error_mm_mrad: errors.iter().map(|(_, error)| error.powi(2)).sum::<f64>().sqrt(),
        largest: format!("{} {:+.3}", largest.0, largest.1),
    }
}

#[test]
#[ignore = "half a minute for each of the 55 runs that one seed makes"]
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
    let (next, refused, errors) = (AtomicUsize::new(0), AtomicUsize::new(0), Mutex::new(Vec::new()));
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
            let what = match outcome {
                Outcome::Refused(why) => {
                    refused.fetch_add(1, Ordering::Relaxed);
                    format!("REFUSED {why}")
                }
                Outcome::Calibrated { identified, error_mm_mrad, largest } => {
                    errors.lock().unwrap().push(error_mm_mrad);
                    format!(
                        "{error_mm_mrad:.3} mm|mrad over {identified}, bound {:.3}, largest {largest}",
                        run.bound_mm_mrad
                    )
                }
            };
            let kind = format!("{family:?}");
            let rate_hz = sizes.robot_log_hz;
            let taken_s = begun.elapsed().as_secs_f64();
            println!("{:8} {kind:15} {seed:4} {rate_hz:4} Hz {taken_s:5.0} s  {what}", robot.name);
        }
    };
    std::thread::scope(|scope| (0..2).for_each(|_| drop(scope.spawn(work))));
    let mut errors = errors.into_inner().unwrap();
    errors.sort_by(f64::total_cmp);
    println!(
        "{} runs: {} refused; Euclidean error of the robot's block [mm|mrad]:",
        jobs.len(),
        refused.into_inner()
    );
    if let (Some(least), Some(most)) = (errors.first(), errors.last()) {
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        println!(
            "least {least:.3}, median {:.3}, mean {mean:.3}, largest {most:.3}",
            errors[errors.len() / 2]
        );
    }
}
