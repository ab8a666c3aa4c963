//! Compares the deployments of a calibration, which a controller applies, with direct fits of the same parameters by
//! another program. The other program combines the kinematic chain of pybotics with SciPy's least squares.
//! `CAMPAIGNS=full` evaluates twenty arms.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "figures of a run")]

use std::collections::BTreeMap;
use std::io::Write;
use std::process::{Command, Stdio};

use identify::calibrate::rows::{Stages, is_surely_better};
use identify::calibrate::validation::deployment::Deployment;
use identify::kinematics::flange_chain;
use identify::logs::PoseRow;
use identify::model::Model;
use identify::statistics::rms;
use rand::SeedableRng;
use rand::rngs::StdRng;
use serde_json::json;
use shared::config::RobotConfig;

use crate::measured_pose_calibration::fixture;
use crate::rows_campaign::{Kind, Level, rows};
use crate::support::campaign::size;
use crate::support::rows::Alone;
use crate::support::{irb120, irb2400, nj220, ur10};

/// Root mean square distance \[m\] between measured and predicted positions of the probe.
fn apart_m(model: &Model, rows: &[PoseRow]) -> f64 {
    let geometry = model.geometry(&[]);
    let (place, probe) = (geometry.tracker.places[0].pose(), geometry.tracker.probes[0].pose());
    let one = |row: &PoseRow| {
        let held = geometry.robot.forward(&row.joints_rad) * probe;
        (held.translation.vector - place.transform_point(&row.position_m.into()).coords).norm()
    };
    rms(rows.iter().map(one))
}

/// Root mean square distance \[m\] that pybotics reaches on `others` for each deployment and for the nominal robot.
fn direct_m(robot: &RobotConfig, fitted: &[PoseRow], others: &[PoseRow]) -> BTreeMap<String, f64> {
    let python =
        std::env::var_os("BALLBAR_PYTHON").expect("BALLBAR_PYTHON: a Python with tests/requirements.txt");
    let links: Vec<[f64; 4]> = flange_chain(robot)
        .links
        .iter()
        .map(|link| [link.a_m, link.alpha_rad, link.d_m, link.theta_rad])
        .collect();
    let pairs = |rows: &[PoseRow]| -> Vec<_> {
        rows.iter().map(|row| json!([row.joints_rad, row.position_m.as_slice()])).collect()
    };
    let asked = json!({ "links": links, "fitted": pairs(fitted), "others": pairs(others) });
    let mut child = Command::new(python)
        .args(["-c", include_str!("deployments.py")])
        .env("OPENBLAS_NUM_THREADS", "1")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    child.stdin.take().unwrap().write_all(asked.to_string().as_bytes()).unwrap();
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success());
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Held-out errors of the deployments divided by those of a direct fit, first for offsets, then for links. Also checks that
/// a deployment that would be written is not worse than the nominal robot.
fn by_direct_fit(name: &str, robot: &RobotConfig, rows: &[PoseRow]) -> [f64; 2] {
    let (fitted, others) = rows.split_at(rows.len() * 3 / 4);
    let found = Alone::default().poses(fitted, robot).unwrap();
    let direct = direct_m(robot, fitted, others);
    let Stages { nominal, offsets, links, .. } = found.held_out();
    let um = |m: f64| (m * 1e6).round();
    [(Deployment::Offsets, "offsets", offsets), (Deployment::Dh, "dh", links)].map(|(wanted, word, own)| {
        let deployed = found.0.deployed(wanted, None).unwrap().unwrap();
        let (ours_m, direct_m, nominal_m) =
            (apart_m(deployed.model(), others), direct[word], direct["nominal"]);
        let written = is_surely_better(found.rows().independent_held_out(), [nominal.rms(), own.rms()]);
        println!(
            "{name}, {word}: {} um, direct {}, nominal {}{}",
            um(ours_m),
            um(direct_m),
            um(nominal_m),
            if written { "" } else { ", not written" }
        );
        assert!(!written || ours_m < nominal_m, "{name}, {word}: worse than nominal");
        ours_m / direct_m
    })
}

#[test]
#[ignore = "needs Python with pybotics: set BALLBAR_PYTHON"]
fn what_a_controller_takes_predicts_as_well_as_a_direct_fit_of_it() {
    let arms = size(4, 20);
    let robots = [irb2400(), ur10(), nj220(), irb120()];
    let of_arm = |seed: u64| {
        let robot = &robots[(seed % 4) as usize];
        let made = rows(Kind::Positions, robot, seed, &Level::random(&mut StdRng::seed_from_u64(700 + seed)));
        by_direct_fit(&format!("{} {seed}", robot.name), robot, &made.poses())
    };
    let mut ratios: Vec<[f64; 2]> = (1..=arms).map(of_arm).collect();
    // Consecutive rows of the grid are at adjacent positions, so every fourth row is held out instead of the last ones.
    let grid: Vec<PoseRow> =
        fixture("grid.csv").iter().map(|row| PoseRow { rotation: None, ..*row }).collect();
    let (others, mut grid): (Vec<_>, Vec<_>) =
        grid.into_iter().enumerate().partition(|(row, _)| row % 4 == 3);
    grid.extend(others);
    let grid: Vec<PoseRow> = grid.into_iter().map(|(_, row)| row).collect();
    ratios.push(by_direct_fit("measured UR10", &ur10(), &grid));
    for (at, word) in ["offsets", "dh"].into_iter().enumerate() {
        let of_word = || ratios.iter().map(move |ratio| ratio[at]);
        let mean = (of_word().map(f64::ln).sum::<f64>() / ratios.len() as f64).exp();
        let most = of_word().fold(0.0, f64::max);
        println!("{word}: {mean:.3} of a direct fit as a mean, {most:.3} at most");
        // The tolerance is needed for two reasons: each set has only fifty rows, and the direct fit
        // has another loss and other priors.
        assert!(mean < 1.01 && most < 1.05, "{word}: {mean} {most}");
    }
}
