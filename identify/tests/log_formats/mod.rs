//! Robot logs in common formats: mapped tables, RTDE, RSI. Rows that cannot be used are dropped with a remark. `bar_log`
//! tests the logs of the bar, and `any_bytes` tests damaged files.
#![allow(clippy::unwrap_used, reason = "tests")]

mod any_bytes;
mod bags;
mod bar_log;

use std::path::Path;

use crate::support::{bar, irb2400};
use identify::logs::{
    ForceLog, JointUnit, LogError, LogFormat, LogOptions, MeasuredLengths, OtherBarLog, RobotLog,
    RobotLogMapping, TimedPoses, Touches, ValueOrigin, read_with,
};
use shared::config::{self, AngleUnit, JointKind, RobotConfig};

/// A robot whose controller reports the joint angles of the model.
fn irb120() -> RobotConfig {
    config::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/robots/irb120_3.toml")).unwrap()
}

fn shipped_mapping() -> RobotLogMapping {
    config::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/robot_log.toml")).unwrap()
}

fn mapping(text: &str) -> RobotLogMapping {
    config::parse(text, Path::new("mapping.toml")).unwrap()
}

fn read_as(text: &str, mapping: Option<RobotLogMapping>) -> Result<RobotLog, LogError> {
    read_with(text.as_bytes(), Path::new("log.txt"), &irb120(), &LogOptions { format: None, mapping })
}

/// Angle of joint `joint` (from 0) at row `row` \[deg\].
fn angle_deg(row: usize, joint: usize) -> f64 {
    20.0 * (0.05 * row as f64 + joint as f64).sin()
}

fn rows(count: usize) -> impl Iterator<Item = (usize, [f64; 6])> {
    (0..count).map(|row| (row, std::array::from_fn(|joint| angle_deg(row, joint))))
}

fn assert_follows(log: &RobotLog, count: usize, expected_deg: impl Fn(usize, usize) -> f64) {
    assert_eq!(log.q_rad.len(), count);
    for (row, q_rad) in log.q_rad.iter().enumerate() {
        for (joint, q) in q_rad.iter().enumerate() {
            let expected = expected_deg(row, joint).to_radians();
            assert!((q - expected).abs() < 1e-9, "row {row} joint {joint}: {q} for {expected}");
        }
    }
}

fn cells(values: &[f64], separator: &str) -> String {
    values.iter().map(f64::to_string).collect::<Vec<_>>().join(separator)
}

/// A table in the format of the shipped mapping: a line before the header, units, semicolons, decimal
/// commas, byte order mark, CRLF.
fn german_table(count: usize) -> String {
    let mut text = "\u{feff}exported 2026-11-20\r\nTime;J1;J2;J3;J4;J5;J6;I1\r\n[ms];[deg];[deg];[deg];[deg];[deg];[deg];[A]\r\n".to_owned();
    for (row, deg) in rows(count) {
        text += &format!("{};{};0,5\r\n", row * 8, cells(&deg, ";").replace('.', ","));
    }
    text
}

#[test]
fn the_shipped_mapping_reads_decimal_commas_units_and_the_coupling_of_a_fanuc() {
    let log = read_as(&german_table(80), Some(shipped_mapping())).unwrap();
    assert_follows(&log, 80, |row, joint| match joint {
        2 => angle_deg(row, 2) + angle_deg(row, 1),
        _ => angle_deg(row, joint),
    });
    assert!((log.q_rad.period_s() - 0.008).abs() < 1e-12);
    assert_eq!((log.clock.as_str(), log.origin), ("controller", ValueOrigin::Measured));
}

#[test]
fn a_mapping_that_skips_more_lines_than_there_are_is_refused_at_once() {
    let text = german_table(80);
    for (skip_lines, unit_lines) in [(1 << 62, 1), (1, 1 << 62)] {
        let mut mapping = shipped_mapping();
        (mapping.csv.skip_lines, mapping.csv.unit_lines) = (skip_lines, unit_lines);
        assert!(read_as(&text, Some(mapping)).is_err(), "{skip_lines} {unit_lines}");
    }
}

#[test]
fn degrees_that_a_mapping_states_as_radians_are_recognised() {
    let mut in_rad = shipped_mapping();
    in_rad.joints.iter_mut().for_each(|joint| joint.unit = JointUnit::Rad);
    let mut text = german_table(0);
    for (row, deg) in rows(80) {
        text += &format!("{};{};0,5\r\n", row * 100, cells(&deg, ";").replace('.', ","));
    }
    let refusal = read_as(&text, Some(in_rad)).unwrap_err().to_string();
    assert!(refusal.contains("look like degrees: write unit = \"deg\" for the joints"), "{refusal}");
}

/// The robot of [`irb120`], except that its third axis is a slide.
fn with_slide() -> RobotConfig {
    let mut robot = irb120();
    robot.links[2].joint = JointKind::Prismatic;
    robot.joint_limits_deg.remove(2);
    robot.joint_limits_m = vec![[-1.0, 1.0]];
    robot.log.unit = AngleUnit::Deg;
    robot
}

#[test]
fn a_slide_in_telegrams_is_in_millimetres() {
    let joint = |unit: &str| format!("[[joints]]\ncolumn = \"A\"\nunit = \"{unit}\"\n");
    let mapped = mapping(&["deg", "deg", "mm", "deg", "deg", "deg"].map(joint).concat());
    for mapping in [None, Some(mapped)] {
        let options = LogOptions { format: None, mapping };
        let log =
            read_with(telegrams(60, 4).as_bytes(), Path::new("log.xml"), &with_slide(), &options).unwrap();
        let logged = log.logged.as_ref().unwrap();
        assert_eq!(logged.names, ["A1", "A2", "A3", "A4", "A5", "A6"]);
        let (deg, mm) = (JointUnit::Deg, JointUnit::Mm);
        assert_eq!(logged.units, [deg, deg, mm, deg, deg, deg]);
        for (row, q) in log.q_rad.iter().enumerate() {
            assert!((q[2] - angle_deg(row, 2) * 1e-3).abs() < 1e-9, "row {row}: {} m", q[2]);
            assert!((q[3] - angle_deg(row, 3).to_radians()).abs() < 1e-9, "row {row}: {} rad", q[3]);
        }
    }
}

#[test]
fn a_row_that_repeats_the_one_before_while_only_a_slide_moves_is_dropped() {
    let row = |row: usize| {
        // Row 30 repeats row 29, and the slide moves by 0.4 mm in the 4 ms between rows.
        let moved = if row == 30 { 29 } else { row };
        format!("{:.3},0,0,{:.4},0,0,0\n", 0.004 * row as f64, 4e-4 * moved as f64)
    };
    let header = "t_s,joint1_deg,joint2_deg,joint3_m,joint4_deg,joint5_deg,joint6_deg\n";
    let text = header.to_owned() + &(0..60).map(row).collect::<String>();
    let log =
        read_with(text.as_bytes(), Path::new("log.csv"), &with_slide(), &LogOptions::default()).unwrap();
    assert_eq!((log.q_rad.len(), log.quality.repeated_dropped), (59, 1));
}

#[test]
fn an_error_in_a_mapped_table_names_the_line_of_the_file_and_the_column() {
    let text = german_table(80).replace("\r\n80;", "\r\n80;x");
    let message = read_as(&text, Some(shipped_mapping())).unwrap_err().to_string();
    // Row 10 is line 14 of the file: the lines of title, header and units precede row 0, and lines count from 1.
    assert!(message.contains("log.txt line 14 column `J1`"), "{message}");
    let message =
        read_as(&german_table(80).replace("J4", "axis4"), Some(shipped_mapping())).unwrap_err().to_string();
    assert!(message.contains("`J4` is missing") && message.contains("axis4"), "{message}");
}

#[test]
fn a_column_that_a_mapping_gives_to_two_joints_is_refused() {
    let mut twice = shipped_mapping();
    twice.joints[4].column = "J4".into();
    let refusal = read_as(&german_table(80), Some(twice)).unwrap_err().to_string();
    assert!(refusal.contains("the mapping names `J4` twice"), "{refusal}");
}

/// If several columns are missing, the message names the one whose key is first in the type of the mapping.
#[test]
fn of_several_columns_that_are_missing_the_first_of_the_mapping_is_named() {
    let (text, path) = ("a,b\n1,2\n", Path::new("table.csv"));
    let table = text.as_bytes();
    let joints = |column: &str| format!("[[joints]]\ncolumn = \"{column}\"\nunit = \"deg\"\n").repeat(6);
    let time = |column: &str| format!("[time]\ncolumn = \"{column}\"\n");
    let robot_log = time("first") + &joints("later");
    let bar_log = time("first") + "[[encoders]]\njoint = 1\ncolumn = \"later\"\n";
    let force = time("first") + "[force]\ncolumns = [\"later\"]\nunit = \"N\"\n";
    let touches =
        "face = \"first\"\n[reading]\ncolumn = \"later\"\nunit = \"mm\"\n".to_owned() + &joints("later");
    let lengths =
        "anchor = \"later\"\n[length]\ncolumn = \"a\"\nunit = \"mm\"\n[uncertainty]\nlength_mm = \"later\"\n"
            .to_owned()
            + &joints("first");
    let poses = "[position]\ncolumns = [\"first\", \"first\", \"first\"]\nunit = \"mm\"\n".to_owned()
        + &time("later");
    let refusals = [
        read_as(text, Some(mapping(&robot_log))).map(drop),
        OtherBarLog::read(table, path, &bar(), Some(&config::parse(&bar_log, path).unwrap())).map(drop),
        ForceLog::read(table, path, &irb120(), Some(&config::parse(&force, path).unwrap())).map(drop),
        Touches::read(table, path, &config::parse(&touches, path).unwrap()).map(drop),
        MeasuredLengths::read(table, path, &config::parse(&lengths, path).unwrap()).map(drop),
        TimedPoses::read(table, path, &config::parse(&poses, path).unwrap()).map(drop),
    ];
    for refusal in refusals {
        let message = refusal.unwrap_err().to_string();
        assert!(message.contains("`first` is missing"), "{message}");
    }
}

#[test]
fn sign_offset_and_coupling_apply_in_that_order() {
    let joints: String =
        (1..=6).map(|joint| format!("[[joints]]\ncolumn = \"q{joint}\"\nunit = \"rad\"\n")).collect();
    let text = joints.replacen("unit = \"rad\"", "unit = \"deg\"\nsign = -1\noffset_deg = 5.0", 1)
        + "[time]\ncolumn = \"t\"\nunit = \"filetime\"\n[[coupling]]\njoint = 3\nfrom = 1\nfactor = 0.5\n";
    let mut table = "t q1 q2 q3 q4 q5 q6\n".to_owned();
    for (row, deg) in rows(60) {
        let mut values = deg.map(f64::to_radians);
        values[0] = deg[0];
        // 2026-11-21 as FILETIME, which has more digits than an f64.
        table += &format!("{} {}\n", 134_082_000_000_000_001_i64 + row as i64 * 40_000, cells(&values, " "));
    }
    let text = format!("[csv]\ndelimiter = \" \"\n{text}");
    let log = read_as(&table, Some(mapping(&text))).unwrap();
    assert_follows(&log, 60, |row, joint| {
        let first = 5.0 - angle_deg(row, 0);
        match joint {
            0 => first,
            2 => angle_deg(row, 2) + 0.5 * first,
            _ => angle_deg(row, joint),
        }
    });
    assert_eq!(log.q_rad.first_stamp_ns, (134_082_000_000_000_001 - 116_444_736_000_000_000) * 100);
}

#[test]
fn what_record_py_of_the_rtde_client_writes_is_recognised() {
    let header = |kind: &str| {
        let names =
            |quantity: &str| (0..6).map(|i| format!("{kind}_{quantity}_{i}")).collect::<Vec<_>>().join(" ");
        format!("timestamp {} {} output_int_register_0\n", names("q"), names("qd"))
    };
    let body: String = rows(60)
        .map(|(row, deg)| {
            let q = cells(&deg.map(f64::to_radians), " ");
            format!("{} {q} {} 7\n", row as f64 * 0.002 + 4711.5, cells(&[0.25; 6], " "))
        })
        .collect();
    let log = read_as(&(header("actual") + &body), None).unwrap();
    assert_follows(&log, 60, angle_deg);
    assert_eq!((log.origin, log.speed_rad_s.unwrap()[3]), (ValueOrigin::Measured, [0.25; 6].into()));
    // The library ur_rtde writes the same columns with commas.
    let with_commas = (header("actual") + &body).replace(' ', ",");
    assert_eq!(read_as(&with_commas, None).unwrap().q_rad, log.q_rad);
    let log = read_as(&(header("target") + &body), None).unwrap();
    assert!(
        log.origin == ValueOrigin::Commanded
            && log.quality.remarks.iter().any(|remark| remark.contains("commanded"))
    );
}

fn telegrams(count: usize, tick: usize) -> String {
    rows(count)
        .map(|(row, deg)| {
            let axes = |deg: &[f64]| {
                deg.iter().enumerate().map(|(i, value)| format!(" A{}=\"{value}\"", i + 1)).collect::<String>()
            };
            format!(
                "<Rob TYPE=\"KUKA\"><RIst X=\"1\" Y=\"2\" Z=\"3\"/><AIPos{}/><ASPos{}/><Delay D=\"0\"/><IPOC>{}</IPOC></Rob>\n",
                axes(&deg),
                axes(&deg.map(|value| value + 1.0)),
                4_208_163_634_usize + row * tick
            )
        })
        .collect()
}

#[test]
fn telegrams_of_rsi_give_measured_joints_or_commanded_ones_where_a_mapping_asks() {
    for text in [telegrams(60, 12), format!("<?xml version=\"1.0\"?><Log>\n{}</Log>\n", telegrams(60, 12))] {
        let log = read_as(&text, None).unwrap();
        assert_follows(&log, 60, angle_deg);
        assert!((log.q_rad.period_s() - 0.012).abs() < 1e-12 && log.origin == ValueOrigin::Measured);
    }
    let joints: String =
        (1..=6).map(|joint| format!("[[joints]]\ncolumn = \"A{joint}\"\nunit = \"deg\"\n")).collect();
    let log =
        read_as(&telegrams(60, 4), Some(mapping(&format!("values = \"commanded\"\n{joints}")))).unwrap();
    assert_follows(&log, 60, |row, joint| angle_deg(row, joint) + 1.0);
    assert!(log.quality.remarks.iter().all(|remark| !remark.contains("force")));
    // Forces in telegrams are not supported.
    let force = mapping(&format!("force = {{ unit = \"Nm\" }}\n{joints}"));
    let log = read_as(&telegrams(60, 4), Some(force)).unwrap();
    let message = log.quality.remarks.iter().find(|remark| remark.contains("force on the bar is not used"));
    assert!(log.force.is_none() && message.unwrap().contains("--force-log"), "{message:?}");
}

#[test]
fn a_counter_of_telegrams_is_not_taken_for_a_date() {
    let joints: String =
        (1..=6).map(|joint| format!("[[joints]]\ncolumn = \"A{joint}\"\nunit = \"deg\"\n")).collect();
    for unit in ["date_time", "filetime"] {
        let dated = mapping(&format!("{joints}[time]\ncolumn = \"IPOC\"\nunit = \"{unit}\"\n"));
        let message = read_as(&telegrams(60, 4), Some(dated)).unwrap_err().to_string();
        assert!(message.contains("IPOC is a counter") && message.contains("period_ms"), "{message}");
    }
}

#[test]
fn a_counter_of_telegrams_is_not_taken_for_milliseconds() {
    let message = read_as(&telegrams(60, 1), None).unwrap_err().to_string();
    assert!(message.contains("IPOC") && message.contains("[time]"), "{message}");
}

#[test]
fn a_log_of_telegrams_that_breaks_off_is_refused_with_the_telegram() {
    let text = telegrams(60, 4);
    let read = read_as(&text[..text.len() - 200], None).map(|log| log.q_rad.len());
    // A file that ends within an attribute is refused. If the file ends between two elements, the last
    // element is incomplete and is dropped.
    match read {
        Ok(count) => assert_eq!(count, 59),
        Err(error) => assert!(error.to_string().contains("telegram 60"), "{error}"),
    }
    let message = read_as(&text.replacen("<IPOC>", "<IPOC>x", 1), None).unwrap_err().to_string();
    assert!(message.contains("telegram 1") && message.contains("IPOC"), "{message}");
}

#[test]
fn frozen_telegrams_and_those_that_lack_an_axis_are_left_out_and_told() {
    let mut lines: Vec<String> = telegrams(80, 4).lines().map(str::to_owned).collect();
    let axes_of = |line: &str| line[line.find("<AIPos").unwrap()..line.find("<ASPos").unwrap()].to_owned();
    let (before, frozen) = (axes_of(&lines[20]), axes_of(&lines[21]));
    lines[21] = lines[21].replace(&frozen, &before);
    lines[40] = lines[40].replacen("A3=", "B3=", 1);
    let log = read_as(&lines.join("\n"), None).unwrap();
    assert_eq!((log.quality.repeated_dropped, log.quality.incomplete_dropped, log.q_rad.len()), (1, 1, 78));
    let remarks = log.quality.remarks.join("\n");
    assert!(
        remarks.contains("1 telegrams repeat") && remarks.contains("1 telegrams lack a joint"),
        "{remarks}"
    );
}

#[test]
fn a_robot_that_stands_still_is_not_frozen() {
    let standing: String = telegrams(1, 4).repeat(60);
    let mut ipoc = 0;
    let text: String = standing
        .lines()
        .map(|line| {
            ipoc += 4;
            line.replace("4208163634", &ipoc.to_string()) + "\n"
        })
        .collect();
    let log = read_as(&text, None).unwrap();
    assert_eq!((log.quality.repeated_dropped, log.q_rad.len()), (0, 60));
}

#[test]
fn joints_for_a_robot_whose_configuration_describes_motors_need_a_mapping() {
    let options = LogOptions::default();
    let message = read_with(telegrams(60, 4).as_bytes(), Path::new("log.xml"), &irb2400(), &options)
        .unwrap_err()
        .to_string();
    assert!(message.contains("motor angles") && message.contains("--log-mapping"), "{message}");
}

#[test]
fn formats_are_told_by_content_and_refused_where_there_is_none() {
    let detect = |bytes: &[u8], name: &str| LogFormat::detect(bytes, Path::new(name));
    assert_eq!(detect(b"\x89MCAP0\r\n...", "bag").unwrap(), LogFormat::Ros2Mcap);
    assert_eq!(detect(b"SQLite format 3\0", "bag_0.db3").unwrap(), LogFormat::Ros2Db3);
    assert_eq!(detect(b"\n  <Rob>", "x.log").unwrap(), LogFormat::Rsi);
    assert_eq!(detect(b"timestamp actual_q_0 actual_q_1\n", "x.csv").unwrap(), LogFormat::UrRtde);
    let latin_1 = b"# Zelle M\xfcller\ntimestamp note_\xb5 actual_q_0 actual_q_1\n";
    assert_eq!(detect(latin_1, "x.csv").unwrap(), LogFormat::UrRtde);
    assert_eq!(detect(b"# robot: x\nt_s,joint1_deg\n", "x.csv").unwrap(), LogFormat::Csv);
    assert_eq!(detect(b"\x2d\x0a\x07", "capture.EGM").unwrap(), LogFormat::Egm);
    let message = detect(b"\x7fELF\x02\x01\x01\0", "x.bin").unwrap_err().to_string();
    assert!(message.contains("--log-format"), "{message}");
}

#[test]
fn impossible_mappings_are_refused_by_key() {
    let joints: String =
        (1..=6).map(|joint| format!("[[joints]]\ncolumn = \"q{joint}\"\nunit = \"rad\"\n")).collect();
    for (text, key) in [
        ("[csv]\ndelimiter = \",\"\ndecimal_comma = true\n", "csv.delimiter"),
        ("[[coupling]]\njoint = 3\nfrom = 3\nfactor = 1.0\n", "coupling[0]"),
        ("[[coupling]]\njoint = 7\nfrom = 2\nfactor = 1.0\n", "coupling[0]"),
        (
            "[[coupling]]\njoint = 3\nfrom = 2\nfactor = 1.0\n[[coupling]]\njoint = 2\nfrom = 3\nfactor = 1.0\n",
            "coupling",
        ),
    ] {
        let message =
            config::parse::<RobotLogMapping>(&format!("{text}{joints}"), Path::new("m.toml")).unwrap_err();
        assert!(message.to_string().contains(&format!("`{key}`")), "{message}");
    }
}
