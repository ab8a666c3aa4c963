//! Fuzz target: reads tables of single poses from arbitrary bytes. Each row contains a measured length, a measured position
//! or pose, the socket of a ball, or the face that a tip touches.

use std::path::Path;
use std::sync::LazyLock;

use identify::logs::{
    ContactMapping, LengthUnit, MeasuredLengthMapping, MeasuredLengths, MeasuredPoseMapping, MeasuredPoses,
    ReadingColumn, TouchMapping, Touches,
};
use shared::config;

use super::explained;

struct PoseTableSetting {
    lengths: MeasuredLengthMapping,
    poses: MeasuredPoseMapping,
    contacts: ContactMapping,
    touches: TouchMapping,
}

static SETTING: LazyLock<PoseTableSetting> = LazyLock::new(|| {
    let directory = crate::config_directory();
    PoseTableSetting {
        lengths: config::load(&directory.join("measured_length.toml")).expect("a shipped file"),
        poses: config::load(&directory.join("measured_pose.toml")).expect("a shipped file"),
        contacts: config::load(&directory.join("contact.toml")).expect("a shipped file"),
        touches: TouchMapping {
            reading: Some(ReadingColumn { column: "reading_mm".into(), unit: LengthUnit::Mm }),
            ..config::load(&directory.join("touch.toml")).expect("a shipped file")
        },
    }
});

/// Reads a table with each shipped mapping. If the table is accepted, its numbers must be finite. If the table is refused,
/// the error must contain a reason.
pub fn any_table(bytes: &[u8]) {
    match MeasuredLengths::read(bytes, Path::new("lengths"), &SETTING.lengths) {
        Ok(lengths) => {
            let finite = |row: &identify::logs::LengthRow| {
                row.joints_rad.iter().chain([&row.length_m]).all(|value| value.is_finite())
            };
            assert!(lengths.rows.iter().all(finite));
        }
        Err(error) => explained(&error),
    }
    match MeasuredPoses::read(bytes, Path::new("poses"), &SETTING.poses) {
        Ok(poses) => {
            let finite = |row: &identify::logs::PoseRow| {
                let turns = row.rotation.iter().flat_map(|rotation| rotation.matrix().iter().copied());
                row.joints_rad.iter().chain(&row.position_m).copied().chain(turns).all(f64::is_finite)
            };
            assert!(poses.rows.iter().all(finite));
        }
        Err(error) => explained(&error),
    }
    match SETTING.contacts.read(bytes, Path::new("contacts"), &["A", "B"]) {
        Ok(rows) => {
            let usable =
                |row: &identify::logs::TipRow| row.part < 2 && row.joints_rad.iter().all(|q| q.is_finite());
            assert!(rows.iter().all(usable));
        }
        Err(error) => explained(&error),
    }
    match Touches::read(bytes, Path::new("touches"), &SETTING.touches) {
        Ok(touches) => {
            let usable = |row: &identify::logs::TipRow| {
                row.part < touches.faces.len()
                    && row.joints_rad.iter().chain([&row.reading_m]).all(|q| q.is_finite())
            };
            assert!(touches.rows.iter().all(usable));
        }
        Err(error) => explained(&error),
    }
}

/// Seeds: one table for each shipped mapping.
pub fn tables() -> Vec<Vec<u8>> {
    let lengths = "x_mm,y_mm,z_mm,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,cable_mm\n";
    let joints =
        "shoulder_pan_joint;shoulder_lift_joint;elbow_joint;wrist_1_joint;wrist_2_joint;wrist_3_joint";
    let measured = ["x", "y", "z", "rx", "ry", "rz"].map(|axis| format!("measurement_{axis}")).join(";");
    vec![
        (lengths.to_owned() + &"1,2,3,-74.5,33.9,-30.8,-15.1,80.5,-59.7,509.19\n".repeat(11)).into_bytes(),
        (format!("{joints};{measured}\n")
            + &"0,5;-1,5;0;0;0;3,1;2361,9;-1368,5;119,4;-90,5;-60;10\n".repeat(11))
            .into_bytes(),
        ("q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,socket\n".to_owned()
            + &"-74.5,33.9,-30.8,-15.1,80.5,-59.7,A\n".repeat(11))
            .into_bytes(),
        ("q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,reading_mm,face\n".to_owned()
            + &"-74.5,33.9,-30.8,-15.1,80.5,-59.7,0.125,top\n".repeat(11))
            .into_bytes(),
    ]
}
