//! A tracker measures several targets on the flange from several stations, or a wire has several anchors. All rows are
//! in one file and are solved together.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use std::fmt::Write;
use std::path::Path;
use std::process::Command;

use identify::inspect::{Mapping, propose};
use identify::kinematics::{Chain, Joints, Pose, flange_chain};
use identify::logs::{LengthUnit, MeasuredPoseMapping, MeasuredPoses, PoseRow};
use identify::model::SetUp;
use identify::report::result::file::CalibrationFile;
use nalgebra::{Rotation3, Vector3};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use rand_distr::StandardNormal;
use shared::config;

use crate::support::command::identify;
use crate::support::rows::Alone;
use crate::support::truth::apart_m;
use crate::support::{repository, ur10};

const STATIONS: [&str; 2] = ["north", "south"];
const TARGETS: [&str; 3] = ["A", "B", "C"];
const NOISE_M: f64 = 3e-5;

/// A robot, two poses of the tracker, and three positions of targets on the flange \[m\].
struct Cell {
    truth: Chain,
    places: [Pose; 2],
    probes_m: [Vector3<f64>; 3],
}

fn cell() -> Cell {
    let mut random = StdRng::seed_from_u64(11);
    let mut truth = flange_chain(&ur10());
    for link in truth.links.iter_mut().take(5) {
        link.a_m += random.random_range(-1e-3..1e-3);
        link.theta_rad += random.random_range(-4e-3..4e-3);
        link.alpha_rad += random.random_range(-2e-3..2e-3);
    }
    let place = |position_m: [f64; 3], rotation_rad: [f64; 3]| {
        Pose::from_parts(Vector3::from(position_m).into(), Rotation3::new(rotation_rad.into()))
    };
    Cell {
        truth,
        places: [place([-3.0, 0.5, 1.3], [0.4, 1.9, -2.1]), place([2.0, -2.5, 0.2], [-0.1, 0.3, 1.2])],
        probes_m: [[0.09, 0.0, 0.05], [-0.05, 0.08, 0.06], [-0.04, -0.09, 0.12]].map(Vector3::from),
    }
}

impl Cell {
    /// Rows of the tracker: all `targets` at each pose. After the first `first` poses, the tracker moves to its
    /// second station. At each pose, the joints of the robot have an error with standard deviation `off_rad`,
    /// which is the same for all targets.
    fn rows(&self, poses: usize, first: usize, targets: &[usize], off_rad: f64) -> Vec<PoseRow> {
        let [mut random, mut noise] = [23, 24].map(StdRng::seed_from_u64);
        let mut rows = Vec::new();
        for pose in 0..poses {
            let joints_rad = Joints::from_fn(6, |_| random.random_range(-1.5..1.5));
            let off =
                |q: f64| q + off_rad * StdRng::seed_from_u64(q.to_bits()).sample::<f64, _>(StandardNormal);
            let flange = self.truth.forward(&joints_rad.iter().map(|q| off(*q)).collect::<Joints>());
            let station = usize::from(pose >= first);
            for &target in targets {
                let held = flange.transform_point(&self.probes_m[target].into());
                let mut white = || NOISE_M * noise.sample::<f64, _>(StandardNormal);
                let noise = Vector3::new(white(), white(), white());
                let position_m = self.places[station].inverse_transform_point(&held).coords + noise;
                let set_up = SetUp { station, target };
                rows.push(PoseRow { joints_rad, position_m, set_up, ..PoseRow::default() });
            }
        }
        rows
    }
}

fn table(rows: &[PoseRow]) -> String {
    let mut text = "q1,q2,q3,q4,q5,q6,station,target,x,y,z\n".to_owned();
    for PoseRow { joints_rad, position_m, set_up, .. } in rows {
        let joints: Vec<String> = joints_rad.iter().map(|q| format!("{q:.9}")).collect();
        let (at, from, of) = (position_m * 1e3, STATIONS[set_up.station], TARGETS[set_up.target]);
        writeln!(text, "{},{from},{of},{:.5},{:.5},{:.5}", joints.join(","), at.x, at.y, at.z).unwrap();
    }
    text
}

fn mapping_text() -> String {
    let joint = |number: usize| format!("[[joints]]\ncolumn = \"q{number}\"\nunit = \"rad\"\n");
    let joints: String = (1..=6).map(joint).collect();
    let names = "station = \"station\"\ntarget = \"target\"\n";
    format!("{names}[position]\ncolumns = [\"x\", \"y\", \"z\"]\nunit = \"mm\"\n{joints}")
}

fn mapping() -> MeasuredPoseMapping {
    config::parse(&mapping_text(), Path::new("mapping.toml")).unwrap()
}

#[test]
fn three_targets_from_two_stations_place_all_of_them_and_tell_the_robot_better_than_one() {
    let cell = cell();
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let calibrated = |rows: &[PoseRow]| {
        std::fs::write(path("rows.csv"), table(rows)).unwrap();
        std::fs::write(path("mapping.toml"), mapping_text()).unwrap();
        let out = folder.path().join("out");
        let arguments =
            ["calibrate", "tracker", &path("rows.csv"), "--mapping", &path("mapping.toml"), "--verbose"];
        let output = identify(&arguments, "ur10.toml", &out);
        let said = String::from_utf8(output.stdout).unwrap();
        assert!(output.status.success(), "{said}{}", String::from_utf8(output.stderr).unwrap());
        (CalibrationFile::open(&out).unwrap(), said)
    };
    // Five poses alone determine the second station. They are sufficient, because the
    // targets are known from the first station.
    let (file, said) = calibrated(&cell.rows(80, 75, &[0, 1, 2], 0.0));
    for names in ["tracker_* north, tracker2_* south", "probe_* A, probe2_* B, probe3_* C"] {
        assert!(said.contains(names), "{said}");
    }
    let value = |name: String| file.parameters.iter().find(|one| one.name == name).unwrap().value;
    let vector = |prefix: &str| Vector3::from(["x", "y", "z"].map(|axis| value(format!("{prefix}{axis}"))));
    let place = |tracker: &str| {
        let turn = Rotation3::new(vector(&format!("{tracker}_r")));
        Pose::from_parts(vector(&format!("{tracker}_")).into(), turn)
    };
    // Compare quantities that do not depend on the frames of the robot's base and flange.
    let second_from_first = place("tracker2").inverse() * place("tracker");
    let truly = cell.places[1].inverse() * cell.places[0];
    let off_m = (second_from_first.translation.vector - truly.translation.vector).norm();
    assert!(off_m < 25.0 * NOISE_M, "{off_m}");
    let probes_m = ["probe_", "probe2_", "probe3_"].map(vector);
    for [one, other] in [[0, 1], [0, 2], [1, 2]] {
        let found_m = (probes_m[one] - probes_m[other]).norm();
        let truly_m = (cell.probes_m[one] - cell.probes_m[other]).norm();
        assert!((found_m - truly_m).abs() < NOISE_M, "{one} and {other}: {found_m} {truly_m}");
    }
    let error_m = |file: &CalibrationFile| apart_m(&ur10(), &file.robot_chain(&ur10(), None), &cell.truth);
    let (of_three_m, of_one_m) = (error_m(&file), error_m(&calibrated(&cell.rows(80, 80, &[0], 0.0)).0));
    assert!(of_three_m < of_one_m && of_three_m < NOISE_M, "{of_three_m} {of_one_m}");
}

#[test]
fn targets_of_one_pose_have_its_error_in_common_and_claim_no_more_than_it_tells() {
    let sigma = |targets: &[usize]| {
        let rows = cell().rows(120, 120, targets, 3e-4);
        let found = Alone::quick().without_joint_errors().poses(&rows, &ur10()).unwrap();
        found.sigma("ra2".parse().unwrap()).unwrap()
    };
    // Three targets at the same position contain the same information as one.
    let (once, thrice) = (sigma(&[0]), sigma(&[0, 0, 0]));
    assert!((0.9..1.1).contains(&(thrice / once)), "{thrice} {once}");
}

#[test]
fn a_wire_of_several_anchors_and_attachments_is_one_instrument_and_what_is_known_of_it_is_taken_off() {
    let cell = cell();
    let anchors_m = [[1.2, -1.0, 0.1], [-0.9, 1.1, 0.3], [0.2, -1.4, 1.6]].map(Vector3::from);
    let mut random = StdRng::seed_from_u64(31);
    let mut text = "q1,q2,q3,q4,q5,q6,anchor,attachment,length\n".to_owned();
    for row in 0..400 {
        let joints_rad = Joints::from_fn(6, |_| random.random_range(-1.5..1.5));
        let (anchor, attachment) = (row / 40 % 3, row / 20 % 2);
        let held = cell.truth.forward(&joints_rad).transform_point(&cell.probes_m[attachment].into());
        let noise_m = NOISE_M * random.sample::<f64, _>(StandardNormal);
        let length_mm = ((held.coords - anchors_m[anchor]).norm() + 0.0125 + noise_m) * 1e3;
        let joints: Vec<String> = joints_rad.iter().map(|q| format!("{q:.9}")).collect();
        writeln!(text, "{},N{anchor},P{attachment},{length_mm:.5}", joints.join(",")).unwrap();
    }
    let proposal = propose(text.as_bytes(), Path::new("rows.csv"), &ur10()).unwrap();
    let Mapping::MeasuredLengths(mut mapping) = proposal.mapping else { panic!("{:?}", proposal.mapping) };
    mapping.length.unit = LengthUnit::Mm;
    mapping.length.offset_mm = 12.5;
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    std::fs::write(path("rows.csv"), text).unwrap();
    std::fs::write(path("mapping.toml"), toml::to_string(&mapping).unwrap()).unwrap();
    let calibrated = |fix: &[&str]| {
        let out = folder.path().join("out");
        let wanted =
            ["calibrate", "wire", &path("rows.csv"), "--mapping", &path("mapping.toml"), "--verbose"];
        let output = identify(&[&wanted[..], fix].concat(), "ur10.toml", &out);
        let said = String::from_utf8(output.stdout).unwrap();
        assert!(output.status.success(), "{said}{}", String::from_utf8(output.stderr).unwrap());
        assert!(said.contains("anchor_* N0, anchor2_* N1, anchor3_* N2"), "{said}");
        CalibrationFile::open(&out).unwrap()
    };
    let number = |file: &CalibrationFile, name: &str| {
        let found = file.parameters.iter().find(|one| one.name == name).unwrap();
        (found.value, found.sigma.unwrap_or_default())
    };
    let (free, fixed) = (calibrated(&[]), calibrated(&["--fix", "length_offset"]));
    // The lengths have no offset, so the free estimate must be zero within its uncertainty.
    let (left_m, sigma_m) = number(&free, "length_offset");
    assert!(left_m.abs() < 4.0 * sigma_m && sigma_m < 2e-4, "{left_m} {sigma_m}");
    assert_eq!(number(&fixed, "length_offset"), (0.0, 0.0));
    for file in [&free, &fixed] {
        let anchor_m = |prefix: &str| {
            Vector3::from(["x", "y", "z"].map(|axis| number(file, &format!("{prefix}_{axis}")).0))
        };
        let found_m = [anchor_m("anchor"), anchor_m("anchor2"), anchor_m("anchor3")];
        for [one, other] in [[0, 1], [0, 2], [1, 2]] {
            let off_m = (found_m[one] - found_m[other]).norm() - (anchors_m[one] - anchors_m[other]).norm();
            assert!(off_m.abs() < 5e-4, "{one} and {other}: {off_m}");
        }
        let error_m = apart_m(&ur10(), &file.robot_chain(&ur10(), None), &cell.truth);
        assert!(error_m < 4.0 * NOISE_M, "{error_m}");
    }
}

#[test]
fn names_are_read_in_their_order_and_what_is_missing_is_said() {
    let rows = cell().rows(40, 20, &[2, 0], 0.0);
    let text = table(&rows);
    let read = |text: &str| MeasuredPoses::read(text.as_bytes(), Path::new("rows.csv"), &mapping());
    let found = read(&text).unwrap();
    assert_eq!(
        (found.stations, found.targets),
        (vec!["north".into(), "south".into()], vec!["C".into(), "A".into()])
    );
    assert_eq!(found.rows[41].set_up, SetUp { station: 1, target: 1 });
    let proposal = propose(text.as_bytes(), Path::new("rows.csv"), &ur10()).unwrap();
    let Mapping::MeasuredPoses(proposed) = proposal.mapping else { panic!("{:?}", proposal.mapping) };
    assert_eq!([proposed.station, proposed.target], [Some("station".into()), Some("target".into())]);
    let unnamed = read(&text.replacen(",north,C,", ",north,,", 1)).unwrap_err().to_string();
    assert!(unnamed.contains("no name is given") && unnamed.contains("line 2"), "{unnamed}");
    let few: Vec<PoseRow> = rows[..44].to_vec();
    let few = Alone::quick().poses(&few, &ur10()).err().unwrap().to_string();
    assert!(few.contains("station 2 has 4 rows"), "{few}");
}

#[test]
fn a_refusal_names_the_file_whose_rows_are_too_few() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let (first, second) = (cell().rows(80, 40, &[0, 1, 2], 0.0), cell().rows(40, 20, &[2, 0], 0.0));
    let robot = repository("config/robots/ur10.toml");
    let block = |file: &str| format!("[[tracker]]\nfile = \"{file}\"\nmapping = \"mapping.toml\"\n");
    let blocks = block("first.csv") + &block("second.csv");
    for (name, text) in [
        ("first.csv", table(&first)),
        // Two of these poses are measured from the second station, with two targets each.
        ("second.csv", table(&second[..44])),
        ("mapping.toml", mapping_text()),
        ("experiment.toml", format!("robot = \"{}\"\n{blocks}", robot.display())),
    ] {
        std::fs::write(path(name), text).unwrap();
    }
    let mut command = Command::new(env!("CARGO_BIN_EXE_identify"));
    command.args(["calibrate", "--experiment"]).arg(path("experiment.toml")).arg("--out").arg(path("out"));
    let said = String::from_utf8(command.env("RUST_LOG", "off").output().unwrap().stderr).unwrap();
    assert!(said.contains("second.csv: data set 2: station 2 has 4 rows"), "{said}");
    assert!(!said.contains("first.csv"), "{said}");
}
