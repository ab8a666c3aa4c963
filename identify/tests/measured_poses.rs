//! Tables of poses that a tracker measured: mappings, reading, and files that must be refused.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::path::{Path, PathBuf};

use identify::inspect::{Mapping, propose};
use identify::logs::{LogError, MeasuredPoseMapping, MeasuredPoses};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use proptest::prelude::*;
use shared::config::{self, ConfigError};

use crate::support::ur10;

const HEADER: &str = "Timestamp;shoulder_pan_joint;shoulder_lift_joint;elbow_joint;wrist_1_joint;wrist_2_joint;\
                      wrist_3_joint;measurement_x;measurement_y;measurement_z;measurement_rx;measurement_ry;measurement_rz";

fn example_text() -> String {
    std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/measured_pose.toml"))
        .unwrap()
}

fn mapping(text: &str) -> Result<MeasuredPoseMapping, ConfigError> {
    config::parse(text, Path::new("mapping.toml"))
}

fn example() -> MeasuredPoseMapping {
    mapping(&example_text()).unwrap()
}

fn read(text: &str, mapping: &MeasuredPoseMapping) -> Result<MeasuredPoses, LogError> {
    MeasuredPoses::read(text.as_bytes(), Path::new("poses.csv"), mapping)
}

fn table(row: &str) -> String {
    format!("{HEADER}\n{}", format!("{row}\n").repeat(12))
}

/// Rotation matrix about x (0), y (1) or z (2), written out explicitly.
fn about(axis: usize, degrees: f64) -> Matrix3<f64> {
    let (s, c) = degrees.to_radians().sin_cos();
    match axis {
        0 => Matrix3::new(1.0, 0.0, 0.0, 0.0, c, -s, 0.0, s, c),
        1 => Matrix3::new(c, 0.0, s, 0.0, 1.0, 0.0, -s, 0.0, c),
        _ => Matrix3::new(c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0),
    }
}

#[test]
fn the_shipped_example_reads_millimetres_degrees_and_decimal_commas() {
    let rows =
        read(&table("1;0,5;-1,5;0;0;0;3,1;2361,9;-1368,5;119,4;-90,5;-60;10"), &example()).unwrap().rows;
    assert_eq!((rows.len(), rows[0].line), (12, 2));
    assert!((rows[3].position_m - Vector3::new(2.3619, -1.3685, 0.1194)).norm() < 1e-12);
    assert_eq!(rows[3].joints_rad, [0.5, -1.5, 0.0, 0.0, 0.0, 3.1]);
    let expected = about(0, -90.5) * about(1, -60.0) * about(2, 10.0);
    assert!((rows[3].rotation.unwrap().matrix() - expected).amax() < 1e-12);
}

#[test]
fn orders_of_turns_and_their_frames_follow_the_mapping() {
    let text = table("1;0;0;0;0;0;0;0;0;0;20;-30;50");
    for (order, axes) in [("zyx", [2, 1, 0]), ("zyz", [2, 1, 2]), ("xyz", [0, 1, 2])] {
        let [a, b, c] = [about(axes[0], 20.0), about(axes[1], -30.0), about(axes[2], 50.0)];
        for (frame, expected) in [("moving", a * b * c), ("fixed", c * b * a)] {
            let mapping = example_text()
                .replace("order = \"xyz\"", &format!("order = \"{order}\""))
                .replace("frame = \"moving\"", &format!("frame = \"{frame}\""));
            let rotation = read(&text, &self::mapping(&mapping).unwrap()).unwrap().rows[0].rotation.unwrap();
            assert!((rotation.matrix() - expected).amax() < 1e-12, "{order} {frame}");
        }
    }
}

/// The mapping of the example with another block for the orientation.
fn with_rotation(rotation: &str) -> MeasuredPoseMapping {
    let text = example_text();
    let (before, block) = text.split_once("[rotation]\n").unwrap();
    let (_, after) = block.split_once("\n\n").unwrap();
    mapping(&format!("{before}[rotation]\n{rotation}\n\n{after}")).unwrap()
}

#[test]
fn an_orientation_reads_the_same_however_it_is_written() {
    let expected = about(2, 50.0) * about(1, -30.0) * about(0, 20.0);
    let rotation = Rotation3::from_matrix_unchecked(expected);
    let quaternion = UnitQuaternion::from_rotation_matrix(&rotation);
    let [x, y, z] = quaternion.imag().into();
    let vector_deg = rotation.scaled_axis().map(f64::to_degrees);
    for (block, numbers) in [
        (
            r#"as = "quaternion"
columns = ["a", "b", "c", "d"]"#,
            vec![x, y, z, quaternion.w],
        ),
        (
            r#"as = "quaternion"
columns = ["a", "b", "c", "d"]"#,
            vec![-x, -y, -z, -quaternion.w],
        ),
        (
            r#"as = "rotation_vector"
columns = ["a", "b", "c"]
unit = "deg""#,
            vec![vector_deg.x, vector_deg.y, vector_deg.z],
        ),
        (
            r#"as = "matrix"
columns = ["a", "b", "c", "d", "e", "f", "g", "h", "i"]"#,
            expected.transpose().iter().copied().collect(),
        ),
    ] {
        let names: String = "abcdefghi".chars().take(numbers.len()).map(|name| format!(";{name}")).collect();
        let header = HEADER.replace(";measurement_rx;measurement_ry;measurement_rz", &names);
        let cells: String = numbers.iter().map(|number| format!(";{number:.9}")).collect();
        let row = format!("1;0;0;0;0;0;0;1;2;3{}\n", cells.replace('.', ","));
        let read = |rows: String| self::read(&format!("{header}\n{rows}"), &with_rotation(block));
        let found = read(row.repeat(10)).unwrap().rows[0].rotation.unwrap();
        assert!((found.matrix() - expected).amax() < 1e-8, "{block}");
        if block.contains("deg") {
            continue;
        }
        // Exchange the signs of two columns. The matrix is then not a rotation, or the values are in another convention.
        let spoiled = format!("1;0;0;0;0;0;0;1;2;3{}\n", ";0,9".repeat(numbers.len()));
        let error = read(spoiled.repeat(10)).unwrap_err().to_string();
        assert!(error.contains("is not a rotation") && error.contains("order of the columns"), "{error}");
    }
}

/// The file names one axis of the probe in the opposite direction, so its matrices are mirrored.
#[test]
fn a_matrix_of_left_handed_axes_is_refused_as_no_rotation() {
    let mut mirrored = about(2, 50.0) * about(1, -30.0) * about(0, 20.0);
    mirrored.row_mut(2).neg_mut();
    let header = HEADER.replace(";measurement_rx;measurement_ry;measurement_rz", ";a;b;c;d;e;f;g;h;i");
    let cells: String = mirrored.transpose().iter().map(|number| format!(";{number:.9}")).collect();
    let row = format!("1;0;0;0;0;0;0;1;2;3{}\n", cells.replace('.', ","));
    let block = r#"as = "matrix"
columns = ["a", "b", "c", "d", "e", "f", "g", "h", "i"]"#;
    let refused = read(&format!("{header}\n{}", row.repeat(10)), &with_rotation(block));
    let error = refused.unwrap_err().to_string();
    assert!(error.contains("is not a rotation"), "{error}");
}

fn workbook(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/workbooks").join(name)
}

#[test]
fn a_workbook_is_read_as_a_table_with_its_own_row_numbers() {
    let rows = MeasuredPoses::load(&workbook("poses.xlsx"), &example()).unwrap().rows;
    assert_eq!((rows.len(), rows[0].line), (12, 4));
    assert_eq!(rows[3].joints_rad, [0.5, -1.5, 0.0, 0.0, 0.0, 3.103]);
    assert!((rows[3].position_m - Vector3::new(2.3619, -1.3685, 0.1194)).norm() < 1e-12);
}

#[test]
fn a_sheet_with_a_chart_and_quotes_in_cells_do_not_matter() {
    let alone = MeasuredPoses::load(&workbook("poses.xlsx"), &example()).unwrap();
    assert_eq!(MeasuredPoses::load(&workbook("poses_and_chart.xlsx"), &example()).unwrap(), alone);
}

#[test]
fn of_a_workbook_with_several_sheets_the_one_that_the_mapping_names_is_read() {
    let error = MeasuredPoses::load(&workbook("two_sheets.xlsx"), &example()).unwrap_err().to_string();
    assert!(
        error.contains("several sheets: first, second") && error.contains("`sheet` under [csv]"),
        "{error}"
    );
    let of_sheet = |sheet: &str, file: &str| {
        let mut mapping = example();
        mapping.csv.sheet = Some(sheet.to_owned());
        MeasuredPoses::load(&workbook(file), &mapping)
    };
    let alone = MeasuredPoses::load(&workbook("poses.xlsx"), &example()).unwrap();
    assert_eq!(of_sheet("Messung", "poses_and_notes.xlsx").unwrap(), alone);
    let absent = of_sheet("pose", "poses_and_notes.xlsx").unwrap_err().to_string();
    assert!(absent.contains("`pose`; it has Messprotokoll, Messung"), "{absent}");
    let mut mapping = example();
    mapping.csv.sheet = Some("poses".to_owned());
    let text = read(&table("1;0;0;0;0;0;0;0;0;0;0;0;0"), &mapping).unwrap_err().to_string();
    assert!(text.contains("not a workbook"), "{text}");
}

#[test]
fn the_sheet_with_the_table_is_found_in_a_workbook_that_nobody_has_described() {
    let bytes = std::fs::read(workbook("poses_and_notes.xlsx")).unwrap();
    let proposal = propose(&bytes, Path::new("poses.xlsx"), &ur10()).unwrap();
    let Mapping::MeasuredPoses(mapping) = proposal.mapping else { panic!("{:?}", proposal.mapping) };
    assert_eq!(mapping.csv.sheet.as_deref(), Some("Messung"));
    assert!(
        proposal.notes.doubts.iter().all(|doubt| !doubt.contains("sheets")),
        "{:?}",
        proposal.notes.doubts
    );
}

#[test]
fn a_damaged_workbook_is_an_error_or_the_same_numbers() {
    let whole = std::fs::read(workbook("poses.xlsx")).unwrap();
    let expected = MeasuredPoses::read(&whole, Path::new("poses.xlsx"), &example()).unwrap();
    for at in 0..whole.len() {
        let mut damaged = whole.clone();
        damaged[at] ^= 1 << (at % 8);
        if let Ok(read) = MeasuredPoses::read(&damaged, Path::new("poses.xlsx"), &example()) {
            assert_eq!(read, expected, "byte {at}");
        }
        if at % 16 == 0 {
            assert!(
                MeasuredPoses::read(&whole[..at], Path::new("poses.xlsx"), &example()).is_err(),
                "{at} bytes"
            );
        }
    }
}

#[test]
fn positions_alone_are_read_where_the_mapping_has_no_orientation() {
    let mut mapping = example();
    mapping.rotation = None;
    let header = HEADER.replace(";measurement_rx;measurement_ry;measurement_rz", "");
    let text = format!("{header}\n{}", "1;0;0;0;0;0;0;1;2;3\n".repeat(10));
    assert_eq!(read(&text, &mapping).unwrap().rows[9].rotation, None);
}

#[test]
fn bad_cells_are_refused_with_line_and_column() {
    let good = table("1;0;0;0;0;0;0;1;2;3;4;5;6");
    for (row, column, problem) in [
        ("1;0;0;0;0;0;0;1;2;x;4;5;6", "measurement_z", "not a number"),
        ("1;0;0;0;0;0;0;1;2;;4;5;6", "measurement_z", "empty"),
        ("1;0;0;0;0;0;0;1;2e9;3;4;5;6", "measurement_y", "more than anything"),
        ("1;0;0;0;0;0;0;1;2;3;4;5000;6", "measurement_ry", "more than anything"),
        ("1;0;90;0;0;0;0;1;2;3;4;5;6", "shoulder_lift_joint", "two turns; the column looks like degrees"),
    ] {
        let error = read(&format!("{good}{row}\n"), &example()).unwrap_err().to_string();
        assert!(error.contains(&format!("line 14 column `{column}`")), "{error}");
        assert!(error.contains(problem), "{error}");
    }
    let error = read(&good.replace("measurement_rz", "yaw"), &example()).unwrap_err().to_string();
    assert!(error.contains("`measurement_rz` is missing") && error.contains("yaw"), "{error}");
    assert!(matches!(read(HEADER, &example()), Err(LogError::TooFewRows { rows: 0, .. })));
}

#[test]
fn a_number_that_no_quaternion_has_is_refused_without_a_unit() {
    let block = "as = \"quaternion\"\ncolumns = [\"a\", \"b\", \"c\", \"d\"]";
    let header = HEADER.replace(";measurement_rx;measurement_ry;measurement_rz", ";a;b;c;d");
    let text = format!("{header}\n{}", "1;0;0;0;0;0;0;1;2;3;0;0;90;1\n".repeat(10));
    let error = read(&text, &with_rotation(block)).unwrap_err().to_string();
    assert!(error.contains("column `c`") && error.contains("90.000 is too large"), "{error}");
    assert!(!error.contains("rad") && !error.contains("unit"), "{error}");
}

#[test]
fn a_mapping_that_cannot_work_is_refused_by_key() {
    for (from, to, key) in [
        ("delimiter = \";\"", "delimiter = \",\"", "delimiter"),
        ("order = \"xyz\"", "order = \"xxz\"", "rotation.order"),
        ("order = \"xyz\"", "order = \"xy\"", "rotation.order"),
        ("order = \"xyz\"", "order = \"rpy\"", "rotation.order"),
        ("frame = \"moving\"", "frame = \"turning\"", "frame"),
        ("frame = \"moving\"", "", "rotation.frame"),
        ("as = \"euler\"", "as = \"rotation_vector\"", "rotation.order"),
        ("as = \"euler\"", "as = \"matrix\"", "rotation.columns"),
        (
            "column = \"elbow_joint\"\nunit = \"rad\"",
            "column = \"elbow_joint\"\nunit = \"rad\"\nsign = 0",
            "joints[2].sign",
        ),
    ] {
        let error = mapping(&example_text().replace(from, to)).unwrap_err().to_string();
        assert!(error.contains(key), "{error}");
    }
}

proptest! {
    #[test]
    fn no_text_makes_the_reader_panic(text in "\\PC*") {
        let _ = read(&text, &example());
        let _ = read(&format!("{HEADER}\n{text}"), &example());
    }

    #[test]
    fn no_order_of_turns_makes_the_mapping_panic(order in "\\PC*") {
        let mut mapping = example();
        mapping.rotation.as_mut().unwrap().order = Some(order);
        let _ = read(&table("1;0;0;0;0;0;0;1;2;3;4;5;6"), &mapping);
    }

    #[test]
    fn rows_come_back_as_written(values in prop::collection::vec((-6.0f64..6.0, -5000.0f64..5000.0, -180.0f64..180.0), 10..30)) {
        let line = |(q, p, r): &(f64, f64, f64)| format!("1;{q};0;0;0;0;{q};{p};0;{p};{r};{r};0\n").replace('.', ",");
        let rows: String = values.iter().map(line).collect();
        let read = read(&format!("{HEADER}\n{rows}"), &example()).unwrap().rows;
        prop_assert_eq!(read.len(), values.len());
        for (row, (q, p, r)) in read.iter().zip(values) {
            prop_assert_eq!(row.joints_rad[5], q);
            prop_assert!((row.position_m.z - p * 1e-3).abs() < 1e-12);
            prop_assert!((row.rotation.unwrap().matrix() - about(0, r) * about(1, r)).amax() < 1e-12);
        }
    }
}

#[test]
fn stated_uncertainties_are_read_in_the_unit_that_their_key_names() {
    let stated = "[uncertainty]\nposition_mm = \"position_u\"\nrotation_mrad = \"rotation_u\"\n\n[position]";
    let mapping = self::mapping(&example_text().replace("[position]", stated)).unwrap();
    let rows = |bad: &str| {
        let row = |number: usize| {
            let u = if number == 3 { bad } else { "0,02" };
            format!("7;0,1;0,2;0,3;0,4;0,5;0,6;100;200;300;1;2;3;{u};0,5\n")
        };
        format!("{};position_u;rotation_u\n", HEADER.trim_end()) + &(0..12).map(row).collect::<String>()
    };
    let read = read(&rows("0,3"), &mapping).unwrap();
    let of = |row: usize| read.rows[row].uncertainty;
    assert_eq!((of(0).position_m, of(3).position_m), (Some(0.02 * 1e-3), Some(0.3 * 1e-3)));
    assert_eq!(of(0).rotation_rad, Some(0.5 * 1e-3));
    for bad in ["0", "-0,1", "250"] {
        let error = self::read(&rows(bad), &mapping).unwrap_err().to_string();
        assert!(error.contains("line 5") && error.contains("position_u"), "{error}");
    }
    for (block, said) in [("", "no column is named"), ("position = \"u\"\n", "position")] {
        let text = example_text().replace("[position]", &format!("[uncertainty]\n{block}\n[position]"));
        assert!(self::mapping(&text).unwrap_err().to_string().contains(said));
    }
}
