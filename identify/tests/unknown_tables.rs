//! If a table has no mapping, `inspect` proposes one. With the proposed mapping, the table must be read correctly.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::path::Path;

use identify::inspect::{Mapping, Proposal, propose};
use identify::kinematics::{Pose, flange_chain};
use identify::logs::{
    LengthUnit, LogOptions, MeasuredLengthMapping, MeasuredLengths, MeasuredPoseMapping, MeasuredPoses,
    RobotLogMapping, read_with,
};
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use shared::config;

use crate::support::irb2400;

/// Number of rows of every table.
const ROWS: usize = 80;

/// Joints at a row \[rad\]. The motion covers much of the workspace.
fn joints_rad(row: usize) -> [f64; 6] {
    let phase = row as f64 * 0.17;
    std::array::from_fn(|joint| {
        let middle = [0.1, 0.3, 0.2, -0.4, 0.9, 0.5][joint];
        middle + [0.9, 0.5, 0.4, 1.2, 0.6, 1.8][joint] * (phase * (1.0 + 0.37 * joint as f64)).sin()
    })
}

/// The pose `tracker_from_probe` that the tracker measures at a row.
fn observed_pose(row: usize) -> Pose {
    let tracker_from_base = Pose::from_parts(
        Translation3::new(3.1, -1.2, 0.4),
        UnitQuaternion::from_euler_angles(0.02, -0.03, 2.1).to_rotation_matrix(),
    );
    let flange_from_probe = Pose::from_parts(
        Translation3::new(0.05, 0.02, 0.11),
        UnitQuaternion::from_euler_angles(0.4, 0.2, -0.9).to_rotation_matrix(),
    );
    tracker_from_base * flange_chain(&irb2400()).forward(&joints_rad(row)) * flange_from_probe
}

/// Length of a wire between an anchor and the flange at a row \[m\].
fn length_m(row: usize) -> f64 {
    let flange = flange_chain(&irb2400()).forward(&joints_rad(row));
    (flange.translation.vector - Vector3::new(2.2, 0.4, 0.1)).norm()
}

/// Format of a table that another program writes.
struct Style {
    delimiter: &'static str,
    decimal_comma: bool,
    /// Text of the lines before the header.
    title: &'static str,
    /// True if a line of units follows the header.
    unit_line: bool,
    /// Name of a joint's column. `#` is replaced by the number of the joint, `@` by the letter that Yaskawa uses for it.
    joint: &'static str,
    /// Number of the first joint.
    first: usize,
    degrees: bool,
    /// A column with other data, which is between the columns of the time and of the joints.
    between: &'static str,
    time: &'static str,
    /// Number of time units in one second.
    ticks: f64,
    encode: fn(String) -> Vec<u8>,
}

const USUAL: Style = Style {
    delimiter: ",",
    decimal_comma: false,
    title: "",
    unit_line: false,
    joint: "q#_deg",
    first: 1,
    degrees: true,
    between: "",
    time: "t_s",
    ticks: 1.0,
    encode: String::into_bytes,
};

fn utf_16(text: String) -> Vec<u8> {
    format!("\u{feff}{text}").encode_utf16().flat_map(u16::to_le_bytes).collect()
}

fn latin_1(text: String) -> Vec<u8> {
    text.chars().map(|character| character as u32 as u8).collect()
}

/// Table formats of several programs.
const STYLES: &[Style] = &[
    USUAL,
    Style { joint: "axis_@", ..USUAL },
    Style { delimiter: ";", decimal_comma: true, joint: "J#", ..USUAL },
    Style { joint: "actual_q_#", first: 0, degrees: false, time: "timestamp", ..USUAL },
    Style {
        delimiter: "\t",
        title: "Measurement of cell 3\nOperator: K. M\u{fc}ller\n\n",
        joint: "Axis # [\u{b0}]",
        encode: latin_1,
        time: "Zeit [ms]",
        ticks: 1e3,
        ..USUAL
    },
    Style {
        delimiter: ";",
        decimal_comma: true,
        unit_line: true,
        joint: "A#",
        time: "Time",
        ticks: 1e3,
        encode: utf_16,
        ..USUAL
    },
    Style { joint: "rax_#", between: "speed", time: "clock", ticks: 1e6, ..USUAL },
    Style {
        joint: "joint_#_position",
        degrees: false,
        first: 1,
        between: "command",
        time: "stamp",
        ticks: 1e9,
        ..USUAL
    },
    Style {
        delimiter: ";",
        title: "# recorded by somebody\n",
        joint: "Achse #(deg)",
        between: "temperature",
        time: "Zeit(s)",
        ..USUAL
    },
    Style {
        joint: "robot1.axis_#.act",
        unit_line: true,
        between: "torque",
        time: "tick",
        ticks: 1e3,
        ..USUAL
    },
    Style {
        delimiter: "\t",
        decimal_comma: true,
        joint: "th# (rad)",
        degrees: false,
        time: "t (s)",
        ..USUAL
    },
];

/// The data that a table has in addition to the joints.
#[derive(Clone, Copy, PartialEq)]
enum Beside {
    Time,
    Tracker,
    Length,
}

impl Style {
    fn number(&self, number: f64) -> String {
        let text = format!("{number:.9}");
        if self.decimal_comma { text.replace('.', ",") } else { text }
    }

    fn joint_names(&self) -> Vec<String> {
        let numbered = (self.first..self.first + 6).zip("slurbt".chars());
        numbered
            .map(|(joint, letter)| {
                self.joint.replace('#', &joint.to_string()).replace('@', &letter.to_string())
            })
            .collect()
    }

    fn written(&self, beside: Beside) -> Vec<u8> {
        let mut names: Vec<String> = Vec::new();
        let mut units: Vec<&str> = Vec::new();
        if beside == Beside::Time {
            names.push(self.time.into());
            units.push(if self.ticks == 1e3 { "ms" } else { "s" });
        }
        if !self.between.is_empty() {
            names.extend(self.joint_names().iter().map(|name| format!("{}_{name}", self.between)));
            units.extend(["-"; 6]);
        }
        names.extend(self.joint_names());
        units.extend([if self.degrees { "deg" } else { "rad" }; 6]);
        match beside {
            Beside::Time => {}
            Beside::Tracker => {
                names.extend(
                    ["meas_x", "meas_y", "meas_z", "meas_rx", "meas_ry", "meas_rz"].map(str::to_owned),
                );
                units.extend(["mm", "mm", "mm", "deg", "deg", "deg"]);
            }
            Beside::Length => {
                names.push("cable length".into());
                units.push("mm");
            }
        }
        let mut text = format!("{}{}\n", self.title, names.join(self.delimiter));
        if self.unit_line {
            text += &format!("{}\n", units.join(self.delimiter));
        }
        for row in 0..ROWS {
            let mut cells: Vec<String> = Vec::new();
            if beside == Beside::Time {
                let ticks = 1000.0 + row as f64 * 0.012 * self.ticks;
                cells.push(if self.ticks >= 1e6 { format!("{ticks:.0}") } else { self.number(ticks) });
            }
            let joints = joints_rad(row).map(|q| if self.degrees { q.to_degrees() } else { q });
            if !self.between.is_empty() {
                cells.extend(joints.iter().map(|q| self.number(0.37 * q)));
            }
            cells.extend(joints.iter().map(|q| self.number(*q)));
            match beside {
                Beside::Time => {}
                Beside::Tracker => {
                    let pose = observed_pose(row);
                    cells.extend(pose.translation.vector.iter().map(|x| self.number(x * 1e3)));
                    let (about_x, about_y, about_z) = pose.rotation.euler_angles();
                    cells.extend([about_x, about_y, about_z].map(|angle| self.number(angle.to_degrees())));
                }
                Beside::Length => cells.push(self.number(length_m(row) * 1e3)),
            }
            text += &format!("{}\n", cells.join(self.delimiter));
        }
        (self.encode)(text)
    }
}

fn proposed(bytes: &[u8]) -> Proposal {
    propose(bytes, Path::new("table.txt"), &irb2400()).unwrap()
}

/// The proposed mapping as a user gets it: written to a file and read again.
fn from_file<T: serde::de::DeserializeOwned + config::Validate>(proposal: &Proposal) -> T {
    config::parse(&proposal.to_toml().unwrap(), Path::new("mapping.toml")).unwrap()
}

fn same(found: &[f64], expected: &[f64], style: usize) {
    assert_eq!(found.len(), expected.len(), "style {style}");
    for (found, expected) in found.iter().zip(expected) {
        assert!((found - expected).abs() < 1e-7, "style {style}: {found} {expected}");
    }
}

#[test]
fn logs_of_other_programs_are_read_through_the_mapping_proposed_for_them() {
    for (number, style) in STYLES.iter().enumerate() {
        let bytes = style.written(Beside::Time);
        let mapping: RobotLogMapping = from_file(&proposed(&bytes));
        let options = LogOptions { mapping: Some(mapping), ..LogOptions::default() };
        let log = read_with(&bytes, Path::new("table.txt"), &irb2400(), &options).unwrap();
        assert_eq!(log.q_rad.t_s.len(), ROWS);
        for row in 0..ROWS {
            same(&log.q_rad[row], &joints_rad(row), number);
        }
        assert!((log.q_rad.t_s[10] - 0.12).abs() < 1e-6, "style {number}: {}", log.q_rad.t_s[10]);
    }
}

#[test]
fn tables_of_a_tracker_are_read_through_the_mapping_proposed_for_them() {
    for (number, style) in STYLES.iter().enumerate() {
        let bytes = style.written(Beside::Tracker);
        let proposal = proposed(&bytes);
        let mapping: MeasuredPoseMapping = from_file(&proposal);
        let poses = MeasuredPoses::read(&bytes, Path::new("table.txt"), &mapping).unwrap().rows;
        assert_eq!(poses.len(), ROWS);
        for (row, pose) in poses.iter().enumerate() {
            same(&pose.joints_rad, &joints_rad(row), number);
            same(pose.position_m.as_slice(), observed_pose(row).translation.vector.as_slice(), number);
            same(
                pose.rotation.unwrap().matrix().as_slice(),
                observed_pose(row).rotation.matrix().as_slice(),
                number,
            );
        }
        assert!(proposal.notes.doubts.is_empty(), "style {number}: {:?}", proposal.notes.doubts);
    }
}

#[test]
fn tables_of_lengths_are_read_through_the_mapping_proposed_for_them() {
    for (number, style) in STYLES.iter().enumerate() {
        let bytes = style.written(Beside::Length);
        let mapping: MeasuredLengthMapping = from_file(&proposed(&bytes));
        let lengths = MeasuredLengths::read(&bytes, Path::new("table.txt"), &mapping).unwrap().rows;
        assert_eq!(lengths.len(), ROWS);
        for (row, length) in lengths.iter().enumerate() {
            same(&length.joints_rad, &joints_rad(row), number);
            same(&[length.length_m], &[length_m(row)], number);
        }
    }
}

#[test]
fn positions_beside_a_length_are_proposed_if_they_are_those_of_the_flange() {
    let table = |tool_mm: f64| {
        let mut text = "x_mm,y_mm,z_mm,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,cable_mm\n".to_owned();
        for row in 0..ROWS {
            let flange = flange_chain(&irb2400()).forward(&joints_rad(row));
            let at_mm = flange.translation.vector * 1e3 + flange.rotation * Vector3::new(0.0, 0.0, tool_mm);
            let q_deg = joints_rad(row).map(f64::to_degrees);
            let cells: Vec<String> =
                at_mm.iter().chain(&q_deg).map(|number| format!("{number:.6},")).collect();
            text += &format!("{}{:.6}\n", cells.concat(), length_m(row) * 1e3);
        }
        text
    };
    let mapping: MeasuredLengthMapping = from_file(&proposed(table(0.0).as_bytes()));
    let flange = mapping.flange.unwrap();
    assert_eq!((flange.columns.join(" "), flange.unit), ("x_mm y_mm z_mm".to_owned(), LengthUnit::Mm));
    let proposal = proposed(table(100.0).as_bytes());
    assert!(from_file::<MeasuredLengthMapping>(&proposal).flange.is_none());
    let doubts = proposal.notes.doubts.join("; ");
    assert!(doubts.contains("`x_mm`, `y_mm`, `z_mm` are left out: 80 of 80 flange positions"), "{doubts}");
}

#[test]
fn columns_that_are_exchanged_or_reversed_or_in_another_unit_are_named_by_trying_them() {
    let text = String::from_utf8(USUAL.written(Beside::Tracker)).unwrap();
    let exchanged = text.replacen("q2_deg,q3_deg", "q3_deg,q2_deg", 1);
    let reversed: String = text
        .lines()
        .enumerate()
        .map(|(line, text)| {
            let cells = text.split(',').enumerate().map(|(column, cell)| match (line, column) {
                (0, _) => cell.to_owned(),
                (_, 3) => (-cell.parse::<f64>().unwrap()).to_string(),
                _ => cell.to_owned(),
            });
            cells.collect::<Vec<_>>().join(",") + "\n"
        })
        .collect();
    for (text, finding) in
        [(exchanged, "joints 2 and 3 are exchanged"), (reversed, "joint 4 counts the other way")]
    {
        let proposal = proposed(text.as_bytes());
        assert!(
            proposal.notes.doubts.iter().any(|doubt| doubt.starts_with(finding)),
            "{:?}",
            proposal.notes.doubts
        );
        let Mapping::MeasuredPoses(mapping) = &proposal.mapping else { panic!("{:?}", proposal.mapping) };
        let rows = MeasuredPoses::read(text.as_bytes(), Path::new("table.txt"), mapping).unwrap().rows;
        same(&rows[7].joints_rad, &joints_rad(7), 0);
    }
    let of_other = propose(text.as_bytes(), Path::new("table.txt"), &crate::support::ur10()).unwrap();
    let doubts = of_other.notes.doubts.join("; ");
    assert!(doubts.contains("mm from the positions: check the zeros"), "{doubts}");
    let radians = Style { degrees: false, ..USUAL }.written(Beside::Tracker);
    let doubts = proposed(&radians).notes.doubts;
    assert!(
        doubts
            .iter()
            .any(|doubt| doubt.contains("the header states deg") && doubt.contains("rad is written")),
        "{doubts:?}"
    );
}

/// A table at 1 Hz with stamps in seconds has the same stamps as a table at 1 kHz with stamps in
/// milliseconds, so the unit can only be guessed.
#[test]
fn a_unit_of_the_time_that_is_not_in_the_header_is_named_as_a_guess() {
    let doubts = |time: &'static str, ticks: f64| {
        let log = Style { time, ticks, ..USUAL }.written(Beside::Time);
        proposed(&log).notes.doubts
    };
    let guess = doubts("time", 1e3);
    assert!(
        matches!(&guess[..], [one] if one.contains("ms is taken") && one.contains("if it is in s")),
        "{guess:?}"
    );
    // Stamps in seconds that differ by less than one second cannot be in another unit.
    for (time, ticks) in [("time", 1.0), ("time [ms]", 1e3), ("time [us]", 1e6)] {
        assert!(doubts(time, ticks).is_empty(), "{time}");
    }
}

#[test]
fn a_date_written_as_one_number_is_no_time_in_milliseconds() {
    let mut csv = String::from("Timestamp;q1;q2;q3;q4;q5;q6;tracker_x;tracker_y;tracker_z\n");
    for row in 0..60 {
        let q: Vec<String> = joints_rad(row).iter().map(|q| format!("{q:.6}")).collect();
        let at = observed_pose(row).translation.vector * 1e3;
        csv += &format!("202007141639{row:02};{};{:.4};{:.4};{:.4}\n", q.join(";"), at.x, at.y, at.z);
    }
    let text = proposed(csv.as_bytes()).to_toml().unwrap();
    assert!(text.contains("`Timestamp` has dates (YYYYMMDDhhmmss)"), "{text}");
    assert!(!text.contains("time in ms"), "{text}");
}

#[test]
fn dates_with_the_day_first_are_proposed_as_times() {
    let mut csv = String::from("Zeit;q1;q2;q3;q4;q5;q6\n");
    for row in 0..60 {
        let q: Vec<String> = joints_rad(row).iter().map(|q| format!("{q:.6}")).collect();
        csv += &format!("22.11.2026 10:15:{row:02};{}\n", q.join(";"));
    }
    let text = proposed(csv.as_bytes()).to_toml().unwrap();
    assert!(text.contains("`Zeit` has dates") && text.contains("unit = \"date_time\""), "{text}");
}

#[test]
fn what_is_no_table_of_joints_is_refused_with_what_was_found() {
    let message =
        |text: &str| propose(text.as_bytes(), Path::new("table.txt"), &irb2400()).unwrap_err().to_string();
    assert!(message("a letter\nto somebody\n").contains("no rows of numbers"), "{}", message(""));
    let weather = format!("day,rain,sun,wind,snow,fog,ice\n{}", "1,900000,3,4,5,6,7\n".repeat(20));
    assert!(message(&weather).contains("day, rain, sun"), "{}", message(&weather));
    let joints_only = format!("q1,q2,q3,q4,q5,q6\n{}", "1,2,3,4,5,6\n2,3,4,5,6,7\n".repeat(20));
    assert!(
        message(&joints_only).contains("neither time stamps nor a measured position"),
        "{}",
        message(&joints_only)
    );
}

proptest::proptest! {
    #[test]
    fn no_bytes_are_a_panic(bytes in proptest::collection::vec(proptest::num::u8::ANY, 0..300), row in "[0-9,;. \\t]{10,40}") {
        let _ = propose(&bytes, Path::new("table.txt"), &irb2400());
        let _ = propose(format!("{row}\n").repeat(20).as_bytes(), Path::new("table.txt"), &irb2400());
    }
}
