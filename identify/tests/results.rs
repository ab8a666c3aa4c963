//! The files of a calibration can be read, and they describe the same robot.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test stops at the first surprise")]

use crate::support::{Cell, noisy_poses};
use identify::calibrate::validation::deployment::{Deployed, Deployment};
use identify::cost::{LoopProblem, Residual, Transform};
use identify::kinematics::{Chain, DhLink, Pose};
use identify::model::{Column, Model, Selection};
use identify::report::result::corrections::corrections;
use identify::report::result::deployments::DeploymentEntry;
use identify::report::result::file::{CalibrationFile, DhRow, ParameterEntry, SolveEntry};
use identify::report::table;
use identify::solver::{Options, Solution, solve};

fn solved() -> (Model, Solution) {
    let cell = Cell::irb2400();
    let (observations, joints) = noisy_poses(&cell, 200, 5, 1e-3);
    let mut model = cell.model();
    model.select(Selection::Thesis, Transform::identifies);
    let problem = LoopProblem::new(&model, &joints, &observations, Transform, 1.0).unwrap();
    let solution = solve(&problem, &model.start(), &Options::default()).unwrap();
    model.adopt(&solution.x);
    (model, solution)
}

fn file(model: &Model, solution: &Solution) -> CalibrationFile {
    let solve = SolveEntry::new("transform", &solution.summary, &solution.identifiability);
    let sigma = |id| model.column_of(id).and_then(|column| solution.covariance.sigma(column));
    let columns: Vec<Column> = model.columns().map(|one| Column { id: one.id, data_set: 0 }).collect();
    CalibrationFile::new("robot", "bar", solve, Vec::new(), ParameterEntry::all(model, sigma))
        .with_knowledge(solution, &columns)
}

/// The chain `name` (robot or bar) from a table of links. The root of the bar's chain contains the pose of the bar's base.
fn chain(rows: &[DhRow], name: &str, links: usize) -> Chain {
    let mut chain = Chain::new(Pose::identity(), vec![DhLink::default(); links]);
    for row in rows.iter().filter(|row| row.chain == name) {
        let link = &mut chain.links[row.link - 1];
        assert_eq!(row.unit, if row.parameter.len() == 1 { "m" } else { "rad" });
        assert!((row.nominal + row.correction - row.identified).abs() < 1e-15);
        *match row.parameter.as_str() {
            "a" => &mut link.a_m,
            "d" => &mut link.d_m,
            "alpha" => &mut link.alpha_rad,
            "theta" => &mut link.theta_rad,
            "beta" => &mut link.beta_rad,
            other => panic!("{other}"),
        } = row.identified;
    }
    chain
}

#[test]
fn the_table_of_links_and_both_files_give_the_poses_of_the_solution() {
    let (model, solution) = solved();
    let directory = tempfile::tempdir().unwrap();
    let mut written = file(&model, &solution);
    let links = Deployed { deployment: Deployment::Dh, model: model.clone(), solution };
    written.deployments = vec![DeploymentEntry::from(&links)];
    let path = written.write(directory.path()).unwrap();
    let from_toml: CalibrationFile = toml::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
    let json = std::fs::read_to_string(directory.path().join("calibration.json")).unwrap();
    let from_json: CalibrationFile = serde_json::from_str(&json).unwrap();
    assert_eq!(from_json, written);
    assert_eq!(from_toml, CalibrationFile { covariance: None, ..written.clone() });

    let mut reader = csv::Reader::from_path(directory.path().join("dh.csv")).unwrap();
    let rows: Vec<DhRow> = reader.deserialize().map(|row| row.unwrap()).collect();
    let geometry = model.geometry(&model.start());
    let mut bar = geometry.bar_chain();
    bar.root_from_base = Pose::identity();
    for k in 0..20 {
        let joints: [f64; 6] = std::array::from_fn(|i| (1.3 * f64::from(k) + i as f64).sin());
        for (name, expected) in [("robot", &geometry.robot), ("ball_bar", &bar)] {
            let read = chain(&rows, name, expected.links.len()).forward(&joints);
            let apart = (read.to_homogeneous() - expected.forward(&joints).to_homogeneous()).amax();
            assert!(apart < 1e-12, "{name}: {apart}");
        }
    }
}

/// Correction of the offset of a joint in the table \[deg\].
fn offset_deg(table: &str, joint: usize) -> f64 {
    let name = format!("rtheta{joint} ");
    let line = table.lines().find(|line| line.starts_with(&name)).unwrap();
    let words: Vec<&str> = line.split_whitespace().collect();
    assert_eq!(words[4], "deg", "{line}");
    words[2].parse().unwrap()
}

#[test]
fn a_joint_has_one_offset_in_the_table_and_in_what_a_controller_takes() {
    let (model, solution) = solved();
    let mut written = file(&model, &solution);
    // If only links are fitted, the result differs from the links of the full model.
    let mut alone = model.clone();
    for joint in 2..6 {
        let id = format!("rtheta{joint}").parse().unwrap();
        alone.set_value(id, model.parameter(id).unwrap().value + 2e-4).unwrap();
    }
    let links = Deployed { deployment: Deployment::Dh, model: alone, solution };
    written.deployments = vec![DeploymentEntry::from(&links)];
    let (text, rows) =
        (table::calibration(&written), corrections(&written, &crate::support::irb2400(), Deployment::Dh));
    for joint in 2..6 {
        let row = rows.iter().find(|row| row.what == format!("joint {joint}")).unwrap();
        assert_eq!(row.add, offset_deg(&text, joint), "{joint}: {text}");
        assert!(row.add != 0.0 && row.to.starts_with("the joint angle of the model"));
    }
    assert_eq!(text.matches("added to the joint angle of the model").count(), 1, "{text}");
    // The table has neither alternatives nor parameters that no controller applies.
    assert!(rows.iter().all(|row| row.what.starts_with("joint ") || row.what.starts_with("link ")));
    let digits = |value: f64| format!("{value}").split_once('.').map_or(0, |(_, digits)| digits.len());
    assert!(rows.iter().all(|row| digits(row.add) <= 5), "{rows:?}");
    assert!(rows.iter().filter(|row| row.what.starts_with("link")).all(|row| row.add.abs() >= 1e-5));
}

#[test]
fn a_joint_offset_as_printed_added_to_the_joint_angle_gives_the_identified_robot() {
    let (model, solution) = solved();
    let text = table::calibration(&file(&model, &solution));
    let free = |joint: usize| text.lines().any(|line| line.starts_with(&format!("rtheta{joint} ")));
    let offset_deg = |joint: usize| if free(joint) { offset_deg(&text, joint) } else { 0.0 };
    let identified = model.geometry(&model.start()).robot;
    let mut zeros_nominal = identified.clone();
    let nominal = Cell::irb2400().robot;
    for (link, nominal) in zeros_nominal.links.iter_mut().zip(&nominal.links) {
        link.theta_rad = nominal.theta_rad;
    }
    let joints = [0.3, -0.4, 0.5, 0.6, -0.7, 0.8];
    let corrected: [f64; 6] = std::array::from_fn(|i| joints[i] + offset_deg(i + 1).to_radians());
    let apart =
        zeros_nominal.forward(&corrected).to_homogeneous() - identified.forward(&joints).to_homogeneous();
    assert!(apart.amax() < 1e-6, "{}", apart.amax());
    assert!((2..=6).any(|joint| offset_deg(joint).abs() > 1e-4));
}

#[test]
fn the_covariance_in_the_file_has_the_sigmas_on_its_diagonal_and_names_what_is_correlated() {
    let (model, solution) = solved();
    let written = file(&model, &solution);
    let (covariance, knowledge) = (written.covariance.clone().unwrap(), written.knowledge.clone().unwrap());
    let at = |name: &str| covariance.names.iter().position(|other| other == name).unwrap();
    for entry in written.parameters.iter().filter(|entry| entry.sigma.is_some()) {
        let k = at(&entry.name);
        let variance = covariance.between(k, k).unwrap();
        assert!((variance.sqrt() - entry.sigma.unwrap()).abs() < 1e-9 * variance.sqrt(), "{}", entry.name);
    }
    // The matrix is symmetric, so only its lower triangle is written.
    assert!(covariance.rows.iter().enumerate().all(|(k, row)| row.len() == k + 1));
    assert!(!knowledge.correlations.is_empty());
    for one in &knowledge.correlations {
        let (a, b) = (at(&one.first), at(&one.second));
        let entry = |a: usize, b: usize| covariance.between(a, b).unwrap();
        assert_eq!(entry(a, b), entry(b, a));
        let expected = entry(a, b) / (entry(a, a) * entry(b, b)).sqrt();
        assert!((one.correlation - expected).abs() < 1e-12 && one.correlation.abs() > 0.8);
    }
    let text = table::calibration(&written);
    assert!(text.contains("largest correlations: ") && text.contains("rank 38 of 38"), "{text}");
    assert!(knowledge.observability.o3 > 0.0 && knowledge.observability.o2 < 1.0);
}
