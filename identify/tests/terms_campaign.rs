//! Selection of terms. The error of a single drive must be found, and terms that do not exist must not be
//! accepted. `CAMPAIGNS=full` evaluates more runs.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "figures of a run")]

use std::f64::consts::TAU;

use identify::calibrate::{Calibration, IdentifyConfig, calibrate_run};
use identify::model::{ParameterId, TermGroup};
use identify::simulate::{Design, position_errors_m};
use nalgebra::Vector3;
use shared::config::RobotConfig;
use statrs::distribution::{Binomial, DiscreteCDF};

use crate::rows_campaign::{self, Kind, USUAL, rows};
use crate::support::campaign::size;
use crate::support::laboratory::{self, Level};
use crate::support::rows::Alone;
use crate::support::truth::apart_m;
use crate::support::{bar, irb120, irb2400, nj220};

/// Errors of the laboratory without those of gears.
const NO_GEARS: Level = Level { gear_sine_urad: 0.0, cycloid_urad: 0.0, ..Level::USUAL };
/// Amplitude of the error of one drive, which has one period per turn \[rad\].
const WAVE_RAD: f64 = 60e-6;

/// Result of one calibration.
struct Outcome {
    /// Names of the robot's terms that were accepted.
    accepted: Vec<String>,
    /// Number of groups of terms that were tried.
    tried: usize,
    /// Axes (from 0) for which a term was accepted.
    axes: Vec<usize>,
    /// Mean position error over the workspace \[mm\].
    position_mm: f64,
}

impl Outcome {
    fn new(found: &Calibration, position_m: f64) -> Self {
        let of_robot = found.solved.candidates.iter().filter(|one| one.group != TermGroup::BarLength);
        let accepted = of_robot.clone().filter(|one| one.accepted).map(|one| one.name().to_owned());
        let terms = found.model().columns().filter(|one| matches!(one.id, ParameterId::Joint { .. }));
        Self {
            accepted: accepted.collect(),
            tried: of_robot.count(),
            axes: terms.filter_map(|one| one.id.axis()).collect(),
            position_mm: 1e3 * position_m,
        }
    }
}

/// A function that calibrates a robot from simulated data with this seed. If a drive is given, this drive has
/// an error with one period per turn.
type Run = fn(&RobotConfig, u64, Option<usize>) -> Outcome;

/// Phase of the error of the drive \[rad\]. It is different for each seed.
fn phase(seed: u64) -> f64 {
    TAU * (0.618 * seed as f64).fract()
}

/// Calibrates from a run with a ball-bar. `drive` has an error with one period per turn.
fn with_bar(robot: &RobotConfig, seed: u64, drive: Option<usize>) -> Outcome {
    let mut run = laboratory::without_noise(robot, &bar(), seed, &NO_GEARS, Design::for_robot(robot));
    if let Some(drive) = drive {
        let wave = |drive: &[f64], row: usize| drive[row] + WAVE_RAD * (drive[row] + phase(seed)).sin();
        laboratory::of_drive(&mut run, robot, drive, wave);
        let shown = [("sin", phase(seed).cos()), ("cos", phase(seed).sin())];
        let terms = shown.map(|(name, part)| (format!("r{name}1_{}", drive + 1), -WAVE_RAD * part));
        run.truth.parameters.extend(terms);
    }
    laboratory::add_noise(&mut run, seed, &NO_GEARS);
    let config = IdentifyConfig::default();
    let found = calibrate_run(&run.cycles, &run.encoders, &run.robot_log, robot, &bar(), &config).unwrap();
    let position_m = position_errors_m(found.model(), &run.truth, robot, [Vector3::zeros(); 2]).0;
    Outcome::new(&found, position_m)
}

/// Calibrates from poses of a tracker. `drive` has an error with one period per turn.
fn with_tracker(robot: &RobotConfig, seed: u64, drive: Option<usize>) -> Outcome {
    let level = rows_campaign::Level { gears: 0.0, sag: 0.0, ..USUAL };
    let rows = rows(Kind::Tracker, robot, seed, &level);
    let mut poses = rows.poses();
    if let Some(drive) = drive {
        for q in poses.iter_mut().map(|row| &mut row.joints_rad) {
            q[drive] += WAVE_RAD * (q[drive] + phase(seed)).sin();
        }
    }
    let found = Alone::quick().poses(&poses, robot).unwrap();
    let links = found.model().geometry(&found.model().start()).robot;
    Outcome::new(&found.0, apart_m(robot, &links, &rows.truth))
}

/// Maximum number of events, if each of `of` events has at most this probability. In one campaign
/// of a thousand, more occur by chance.
fn most(probability: f64, of: usize) -> u64 {
    Binomial::new(probability, of as u64).unwrap().inverse_cdf(0.999)
}

#[test]
#[ignore = "calibrations: minutes"]
fn the_wave_of_a_single_drive_is_found_and_no_term_that_does_not_exist() {
    let seeds = size(6, 30);
    let (mut tried, mut wrong, mut runs, mut missed) = (0, 0, 0, 0);
    let kinds: [(&str, RobotConfig, Run); 3] = [
        ("ball-bar", irb2400(), with_bar),
        ("ball-bar", nj220(), with_bar),
        ("tracker", irb120(), with_tracker),
    ];
    for (name, robot, run) in kinds {
        let mean_mm = |of: &[Outcome]| of.iter().map(|one| one.position_mm).sum::<f64>() / of.len() as f64;
        let none: Vec<Outcome> = (1..=seeds).map(|seed| run(&robot, seed, None)).collect();
        let accepted: Vec<&String> = none.iter().flat_map(|one| &one.accepted).collect();
        println!("{name}, {}, no terms: {:.4} mm; accepted {accepted:?}", robot.name, mean_mm(&none));
        tried += none.iter().map(|one| one.tried).sum::<usize>();
        wrong += accepted.len();
        let drive = |seed: u64| (seed % 6) as usize;
        let one: Vec<Outcome> = (1..=seeds).map(|seed| run(&robot, seed, Some(drive(seed)))).collect();
        let not_found = (1..).map(drive).zip(&one).filter(|(drive, one)| !one.axes.contains(drive));
        let not_found: Vec<usize> = not_found.map(|(drive, _)| drive + 1).collect();
        println!("{name}, {}, one drive: {:.4} mm; missed {not_found:?}", robot.name, mean_mm(&one));
        runs += one.len();
        missed += not_found.len();
    }
    println!("accepted by chance {wrong} of {tried}, missed {missed} of {runs}");
    assert!(wrong as u64 <= most(0.05, tried) && missed as u64 <= most(0.1, runs));
}
