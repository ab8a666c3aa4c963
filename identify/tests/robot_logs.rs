//! Robot logs: conversion of angles, writing and reading again, and all refusals.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::f64::consts::{PI, TAU};
use std::path::Path;

use identify::inspect;
use identify::kinematics::Joints;

use crate::support::{irb2400 as irb, nj220 as nj};
use identify::logs::{
    JointConversion, LogError, LogOptions, RobotLog, RobotLogMapping, Stream, ValueOrigin, load_with, read,
    write,
};
use proptest::prelude::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};
use shared::config::{ConfigError, RobotConfig};

/// A log of 60 rows at intervals of 4 ms. Its stamps have more digits than an f64.
fn sample_log() -> RobotLog {
    let t_s: Vec<f64> = (0..60).map(|k| f64::from(k) * 0.004).collect();
    let q_rad =
        t_s.iter().map(|t| Joints::from_fn(6, |j| 0.5 * (t * (j as f64 + 2.0) + j as f64).sin())).collect();
    RobotLog {
        robot: Some("left arm".into()),
        clock: "controller".into(),
        origin: ValueOrigin::Measured,
        q_rad: Stream::new(1_795_000_000_123_456_789, t_s, q_rad).into(),
        ..RobotLog::default()
    }
}

fn text_of(log: &RobotLog, robot: &RobotConfig) -> String {
    let mut bytes = Vec::new();
    write(log, robot, &mut bytes).unwrap();
    String::from_utf8(bytes).unwrap()
}

fn parse(text: &str, robot: &RobotConfig) -> Result<RobotLog, LogError> {
    read(text.as_bytes(), Path::new("log.csv"), robot)
}

/// The sample log of the IRB 2400 as text, in which `edit` has changed row `row` (from 0). This row is in line `row + 5`.
fn edited(row: usize, edit: impl Fn(&mut Vec<String>)) -> String {
    let text = text_of(&sample_log(), &irb());
    let lines: Vec<String> = text
        .lines()
        .enumerate()
        .map(|(index, line)| {
            let mut cells: Vec<String> = line.split(',').map(str::to_owned).collect();
            if index == row + 4 {
                edit(&mut cells);
            }
            cells.join(",")
        })
        .collect();
    lines.join("\n")
}

fn message(result: Result<RobotLog, LogError>) -> String {
    result.unwrap_err().to_string()
}

#[test]
fn a_written_log_reads_back_the_same_for_both_robots() {
    for robot in [irb(), nj()] {
        let log = sample_log();
        let back = parse(&text_of(&log, &robot), &robot).unwrap();
        assert_eq!(back.q_rad.first_stamp_ns, log.q_rad.first_stamp_ns);
        assert_eq!((back.robot, back.clock, back.origin), (log.robot, log.clock, log.origin));
        assert_eq!(back.q_rad.t_s.len(), log.q_rad.t_s.len());
        for (a, b) in back.q_rad.t_s.iter().zip(&log.q_rad.t_s) {
            assert!((a - b).abs() < 1e-9);
        }
        for (a, b) in back.q_rad.iter().flatten().zip(log.q_rad.iter().flatten()) {
            assert!((a - b).abs() < 1e-9, "{a} {b}");
        }
        assert!((back.q_rad.period_s() - 0.004).abs() < 1e-9);
        assert!(back.quality.remarks.is_empty());
    }
}

#[test]
fn motors_of_the_irb_2400_turn_its_joints_as_the_transmission_says() {
    let conversion = JointConversion::new(&irb().log).unwrap();
    // Expected values follow from the gear ratios. Because of the parallel rod, a motor 2 at 12999/100 rad turns
    // joint 2 by 1 rad and joint 3 by -1 rad.
    let q = conversion.to_joint(&[0.0, 129.99, 0.0, 0.0, 0.0, 0.0]);
    let expected = [0.0, 1.0, -1.0, 0.0, 0.0, 0.0];
    assert!(q.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{q:?}");
    // Motor 4 at 55 rad turns joint 4 by -1 rad, joint 5 by -55/759 rad and joint 6 by -62 * 55/41745 rad.
    let q = conversion.to_joint(&[0.0, 0.0, 0.0, 55.0, 0.0, 0.0]);
    let expected = [0.0, 0.0, 0.0, -1.0, -0.072_463_768_115_942, -0.081_686_429_512_516];
    assert!(q.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{q:?}");
    // Motors 1, 3, 5 and 6 are at 1 rad.
    let q = conversion.to_joint(&[1.0, 0.0, 1.0, 0.0, 1.0, 1.0]);
    let expected = [-5.0 / 648.0, 0.0, -5.0 / 648.0, 0.0, -5.0 / 276.0, -5.0 / 552.0 - 1.0 / 44.0];
    assert!(q.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{q:?}");
}

#[test]
fn the_log_of_the_nj_220_has_other_signs_and_a_parallel_rod() {
    let conversion = JointConversion::new(&nj().log).unwrap();
    let q = conversion.to_joint(&[10.0, 20.0, -30.0, 40.0, 50.0, 60.0]);
    // For joint 3, the relation is q3 = -l3 - q2 = 30 - 20, with the logged angle l3.
    let expected = [-10.0_f64, 20.0, 10.0, -40.0, 50.0, -60.0];
    assert!(q.iter().zip(expected).all(|(a, b)| (a - b.to_radians()).abs() < 1e-12), "{q:?}");
}

#[test]
fn byte_order_mark_crlf_semicolons_and_comments_between_rows_are_taken() {
    let plain = text_of(&sample_log(), &irb());
    let expected = parse(&plain, &irb()).unwrap();
    let windows = format!("\u{feff}{}", plain.replace(',', ";").replace('\n', "\r\n"));
    assert_eq!(parse(&windows, &irb()).unwrap(), expected);
    let commented = plain.replacen("1795000000.127456789", "# paused\n\n1795000000.127456789", 1);
    assert_eq!(parse(&commented, &irb()).unwrap(), expected);
}

/// The first column has no name and no cells. The second one is named `#` and contains remarks.
#[test]
fn a_hash_after_a_blank_cell_begins_no_comment() {
    let mut text =
        String::from("\t#\tt_s\tjoint1_deg\tjoint2_deg\tjoint3_deg\tjoint4_deg\tjoint5_deg\tjoint6_deg\n");
    for row in 0..60 {
        let t_s = f64::from(row) * 0.004;
        text += &format!("\t# robot: none\t{t_s:.3}\t{:.6}\t1\t2\t3\t4\t5\n", 10.0 * t_s.sin());
    }
    let log = parse(&text, &nj()).unwrap();
    assert_eq!((log.q_rad.len(), log.robot), (60, None));
}

#[test]
fn a_repeated_row_is_dropped_and_counted() {
    let text = text_of(&sample_log(), &irb());
    let row = text.lines().nth(20).unwrap();
    let log = parse(&text.replace(row, &format!("{row}\n{row}\n{row}")), &irb()).unwrap();
    assert_eq!(log.quality.duplicates_dropped, 2);
    assert_eq!(log.q_rad.t_s.len(), 60);
}

#[test]
fn rows_that_jump_out_and_back_are_left_out_and_named_by_their_lines() {
    let expected = parse(&edited(0, |_| {}), &irb()).unwrap();
    let with_bad = |bad: &[usize], write: &dyn Fn(&mut [String])| {
        let text = edited(0, |_| {});
        let lines = text.lines().enumerate().map(|(index, line)| {
            let mut cells: Vec<String> = line.split(',').map(str::to_owned).collect();
            if bad.iter().any(|row| row + 4 == index) {
                write(&mut cells[1..]);
            }
            cells.join(",")
        });
        parse(&lines.collect::<Vec<_>>().join("\n"), &irb())
    };
    let zeros = |cells: &mut [String]| cells.fill("0".into());
    // Joint 1 of the IRB 2400 has a spike of 50 mrad.
    let spike = |cells: &mut [String]| cells[0] = (cells[0].parse::<f64>().unwrap() + 6.48).to_string();
    for (bad, write) in [(&[20, 30, 31, 40][..], &zeros as &dyn Fn(&mut [String])), (&[10, 12, 14], &spike)] {
        let log = with_bad(bad, write).unwrap();
        assert_eq!(log.quality.excursions_dropped, bad.len());
        let kept: Vec<usize> = (0..expected.q_rad.len()).filter(|row| !bad.contains(row)).collect();
        assert_eq!(log.q_rad.rows, kept.iter().map(|row| expected.q_rad[*row]).collect::<Vec<_>>());
        for (t_s, row) in log.q_rad.t_s.iter().zip(kept) {
            assert!((t_s - expected.q_rad.t_s[row]).abs() < 1e-9);
        }
        let lines: Vec<String> = bad.iter().map(|row| (row + 5).to_string()).collect();
        let refusal = inspect::robot_log(&log, &irb()).suspicious.join("\n");
        assert!(refusal.contains(&format!("{} of 60 lines", bad.len())), "{refusal}");
        assert!(refusal.contains(&lines.join(", ")) && !refusal.contains("no robot is so fast"), "{refusal}");
    }
    let many: Vec<usize> = (5..55).step_by(5).collect();
    let refusal = message(with_bad(&many, &zeros));
    assert!(
        refusal.contains("10 of 60 lines")
            && refusal.contains("line 10, 15")
            && refusal.contains("log again"),
        "{refusal}"
    );
}

/// Joint angles at a time \[rad\]. Joints move evenly, reverse with at least 130 rad/s², and rest for a second every 20 s.
fn hard(t_s: f64) -> Joints {
    let along = t_s - (TAU * t_s / 20.0).sin() * 20.0 / TAU;
    Joints::from_fn(6, |joint| 0.3 * (0.995 * (along * (2.0 + 0.25 * joint as f64)).sin()).asin())
}

#[test]
#[ignore = "takes more than four seconds"]
fn no_healthy_log_loses_a_row() {
    let mut random = ChaCha8Rng::seed_from_u64(7);
    let stepped = |q: &Joints, by: f64| q.map(|q| (q / by).round() * by);
    for rate_hz in [5.0, 10.0, 20.0, 50.0, 100.0, 250.0, 500.0, 1000.0] {
        let even_s: Vec<f64> = (0..(60.0 * rate_hz) as usize).map(|row| row as f64 / rate_hz).collect();
        let smooth: Vec<Joints> = even_s
            .iter()
            .map(|t_s| Joints::from_fn(6, |j| 0.4 * (t_s * (0.5 + 0.13 * j as f64)).sin()))
            .collect();
        let hard: Vec<Joints> = even_s.iter().map(|t_s| hard(*t_s)).collect();
        let mut noisy = |sigma: f64| -> Vec<Joints> {
            let normal = Normal::new(0.0, sigma).unwrap();
            smooth.iter().map(|q| Joints::from_fn(6, |j| q[j] + normal.sample(&mut random))).collect()
        };
        let (fine, rough) = (noisy(20e-6), noisy(1e-3));
        let coarse = |deg: f64| smooth.iter().map(|q| stepped(q, deg.to_radians())).collect::<Vec<_>>();
        // When a joint reverses, the play is taken up immediately.
        let play: Vec<Joints> = smooth
            .windows(2)
            .map(|pair| Joints::from_fn(6, |j| pair[1][j] + 0.6e-3 * (pair[1][j] - pair[0][j]).signum()))
            .collect();
        let held: Vec<Joints> = (0..smooth.len()).map(|row| smooth[row - row % 5]).collect();
        let late = |row: usize| ((row * row % 17) as f64 / 17.0).powi(3) * 0.02;
        let jittered: Vec<f64> = even_s
            .iter()
            .enumerate()
            .scan(0.0, |last, (row, t_s)| {
                *last = f64::max(*last + 1e-6, t_s + late(row));
                Some(*last)
            })
            .collect();
        let bunched: Vec<f64> =
            (0..even_s.len()).map(|row| even_s[row - row % 10] + 1e-6 * (row % 10) as f64).collect();
        for (what, t_s, rows) in [
            ("hard", &even_s, &hard),
            ("hard, stamps jitter", &jittered, &hard),
            ("hard, stamps in bunches", &bunched, &hard),
            ("noise of an encoder", &even_s, &fine),
            ("noise of a millirad", &even_s, &rough),
            ("noise, stamps jitter", &jittered, &fine),
            ("steps of 0.01 deg", &even_s, &coarse(0.01)),
            ("steps of 0.1 deg", &even_s, &coarse(0.1)),
            ("play", &even_s, &play),
            ("held", &even_s, &held),
        ] {
            let q_rad = Stream::new(0, t_s.clone(), rows.clone()).into();
            let text = text_of(&RobotLog { q_rad, ..RobotLog::default() }, &nj());
            let log = parse(&text, &nj()).unwrap();
            let remarks = log.quality.remarks.join("; ");
            let dropped = (log.quality.excursions_dropped, log.quality.repeated_dropped);
            assert_eq!(dropped, (0, 0), "{what} at {rate_hz} Hz: {remarks}");
        }
    }
}

/// A motion at 250 Hz with 15 urad of noise, and its joint angles rounded to multiples of `step_deg`.
fn rounded(step_deg: f64) -> RobotLog {
    let mut random = ChaCha8Rng::seed_from_u64(7);
    let (normal, step_rad) = (Normal::new(0.0, 15e-6_f64).unwrap(), step_deg.to_radians());
    let t_s: Vec<f64> = (0..5000).map(|row| 0.004 * f64::from(row)).collect();
    let at = |t_s: &f64| {
        let exact_rad = |joint: usize| 0.4 * (t_s * (0.3 + 0.2 * joint as f64)).sin();
        Joints::from_fn(6, |joint| {
            let noise_rad: f64 = normal.sample(&mut random);
            ((exact_rad(joint) + noise_rad) / step_rad).round() * step_rad
        })
    };
    let q_rad = t_s.iter().map(at).collect();
    RobotLog { q_rad: Stream::new(0, t_s, q_rad).into(), ..RobotLog::default() }
}

/// The log as it is read from its file, and what `inspect` reports.
fn inspected(log: &RobotLog) -> (RobotLog, Vec<String>) {
    let read = parse(&text_of(log, &nj()), &nj()).unwrap();
    let told = inspect::robot_log(&read, &nj()).suspicious;
    (read, told)
}

#[test]
fn a_log_of_coarse_resolution_keeps_all_rows_and_its_step_is_reported() {
    for (step_deg, told) in [
        (0.1, "up to 0.1 deg in joint 1, 2, 3, 4, 5, 6: rounding adds an error of 0.50 mm"),
        (0.01, "up to 0.01 deg in joint 1, 2, 3, 4, 5, 6: rounding adds an error of 0.05 mm"),
    ] {
        let (read, remarks) = inspected(&rounded(step_deg));
        assert_eq!(read.q_rad.len(), 5000, "{remarks:?}");
        assert!(matches!(&remarks[..], [one] if one.contains(told)), "{remarks:?}");
    }
}

#[test]
fn a_log_of_fine_resolution_gets_no_remark_on_its_step() {
    for step_deg in [0.001, 1e-9] {
        let (read, remarks) = inspected(&rounded(step_deg));
        assert_eq!((read.q_rad.len(), remarks), (5000, Vec::new()), "{step_deg} deg");
    }
}

#[test]
fn rows_that_the_logger_repeats_are_found_in_a_log_of_coarse_resolution() {
    let mut log = rounded(0.01);
    for row in [1000, 2000, 3000] {
        log.q_rad[row] = log.q_rad[row - 1];
    }
    // For a tenth of a second, the logger received no new values.
    let held = log.q_rad[4000];
    log.q_rad[4000..4025].fill(held);
    let (read, remarks) = inspected(&log);
    assert_eq!((read.q_rad.len(), read.quality.repeated_dropped), (4997, 3), "{remarks:?}");
    assert!(remarks.iter().any(|one| one.starts_with("24 rows repeat")), "{remarks:?}");
}

#[test]
fn an_angle_that_begins_anew_after_a_turn_is_no_jump() {
    let mut log = sample_log();
    for (row, q) in log.q_rad.iter_mut().enumerate() {
        q[5] = if row % 3 == 0 { -PI + 1e-4 } else { PI - 1e-4 };
    }
    let read = parse(&text_of(&log, &nj()), &nj()).unwrap();
    assert_eq!((read.quality.excursions_dropped, read.q_rad.len()), (0, 60));
}

#[test]
fn a_missing_column_is_named_with_those_found() {
    let text = text_of(&sample_log(), &irb()).replace("motor4_rad", "axis4");
    let message = message(parse(&text, &irb()));
    assert!(message.contains("`motor4_rad` is missing"), "{message}");
    assert!(message.contains("axis4") && message.contains("motor1_rad"), "{message}");
    let text = text_of(&sample_log(), &irb()).replace("t_s", "time");
    assert!(matches!(parse(&text, &irb()), Err(LogError::MissingColumn { column, .. }) if column == "t_s"));
}

#[test]
fn a_header_in_the_other_unit_is_refused_with_both_units() {
    let text = text_of(&sample_log(), &irb()).replace("_rad", "_deg");
    let message = message(parse(&text, &irb()));
    assert!(message.contains("is in deg") && message.contains("but in rad by log.unit"), "{message}");
    let text = text_of(&sample_log(), &nj()).replace("_deg", "_rad");
    assert!(matches!(
        parse(&text, &nj()),
        Err(LogError::UnitMismatch { in_header: "rad", in_config: "deg", .. })
    ));
}

#[test]
fn nan_empty_and_other_text_are_refused_with_line_and_column() {
    for (value, problem) in
        [("NaN", "not a finite number"), ("inf", "not a finite number"), ("", "empty"), ("x", "not a number")]
    {
        for ending in ["\n", "\r\n"] {
            let text = edited(7, |cells| cells[3] = value.into()).replace('\n', ending);
            let message = message(parse(&text, &irb()));
            assert!(message.contains("log.csv line 12 column `motor3_rad`"), "{message}");
            assert!(message.contains(problem), "{message}");
        }
    }
    let text = text_of(&sample_log(), &irb()).replace(',', ";").replace("0.", "0,");
    assert!(message(parse(&text, &irb())).contains("decimal comma"));
}

#[test]
fn the_line_is_right_after_comments_and_blank_lines() {
    let text = edited(7, |cells| cells[3] = "x".into()).replacen(
        "1795000000.127456789",
        "# a\n\n# b\n1795000000.127456789",
        1,
    );
    assert!(message(parse(&text, &irb())).contains("line 15 "));
}

#[test]
fn a_line_of_blanks_is_no_row() {
    let plain = text_of(&sample_log(), &irb());
    let expected = parse(&plain, &irb()).unwrap();
    let spaced = |text: &str| {
        let row = "1795000000.127456789";
        format!("  \r\n{} \t\n\n", text.replacen(row, &format!("   \n\t\n{row}"), 1))
    };
    assert_eq!(parse(&spaced(&plain), &irb()).unwrap(), expected);
    // In a table with tabs, these cells are empty.
    assert_eq!(parse(&spaced(&plain.replace(',', "\t")), &irb()).unwrap(), expected);
    let bad = spaced(&edited(7, |cells| cells[3] = "x".into()));
    assert!(message(parse(&bad, &irb())).contains("line 15 "), "{}", message(parse(&bad, &irb())));
}

#[test]
fn a_short_row_is_refused_with_its_line() {
    let text = edited(9, |cells| {
        cells.pop();
    });
    let message = message(parse(&text, &irb()));
    assert!(message.contains("line 14") && message.contains("6 cells where the header has 7"), "{message}");
}

#[test]
fn a_clock_that_runs_backwards_is_refused_with_both_rows() {
    let text = edited(10, |cells| cells[0] = "1795000000.000000000".into());
    let refusal = message(parse(&text, &irb()));
    assert!(refusal.contains("line 15") && refusal.contains("line 14"), "{refusal}");
    assert!(
        refusal.contains("1795000000.159456789") && refusal.contains("1795000000.000000000"),
        "{refusal}"
    );
    let text = edited(10, |cells| cells[0] = "1795000000.159456788".into());
    assert!(matches!(
        parse(&text, &irb()),
        Err(LogError::TimeNotIncreasing { line: 15, before_line: 14, .. })
    ));
}

#[test]
fn a_log_of_few_rows_or_none_is_refused() {
    let text = text_of(&sample_log(), &irb());
    let short: String = text.lines().take(30).map(|line| format!("{line}\n")).collect();
    assert!(matches!(parse(&short, &irb()), Err(LogError::TooFewRows { rows: 26, .. })));
    assert!(matches!(parse("", &irb()), Err(LogError::NoHeader { .. })));
    assert!(matches!(parse("# robot: x\n", &irb()), Err(LogError::NoHeader { .. })));
}

#[test]
fn degrees_under_a_header_of_radians_are_recognised() {
    let mut robot = irb();
    robot.log = nj().log;
    robot.log.unit = shared::config::AngleUnit::Rad;
    let mut in_degrees = robot.clone();
    in_degrees.log.unit = shared::config::AngleUnit::Deg;
    let text = text_of(&sample_log(), &in_degrees).replace("_deg", "_rad");
    let refusal = message(parse(&text, &robot));
    assert!(refusal.contains("look like degrees") && refusal.contains("outside"), "{refusal}");
}

#[test]
fn exchanged_columns_are_suspected_where_they_explain_the_limits() {
    let mut log = sample_log();
    for q in log.q_rad.iter_mut() {
        *q = [2.5 + 0.1 * q[0], 0.5, 0.3, 0.2, 0.1, -3.0].into();
    }
    let text = text_of(&log, &nj());
    let text = text
        .replace("joint1_deg", "first")
        .replace("joint2_deg", "joint1_deg")
        .replace("first", "joint2_deg");
    let refusal = message(parse(&text, &nj()));
    assert!(refusal.contains("columns are exchanged: `joint1_deg` and `joint2_deg`"), "{refusal}");
}

#[test]
fn a_log_reads_the_same_in_every_encoding() {
    let text = text_of(&sample_log(), &irb());
    let expected = parse(&text, &irb()).unwrap();
    let text = format!("# micro \u{b5}, degree \u{b0}\n{text}");
    let latin_1: Vec<u8> = text.chars().map(|character| character as u32 as u8).collect();
    let utf_16 =
        |bytes: fn(u16) -> [u8; 2]| format!("\u{feff}{text}").encode_utf16().flat_map(bytes).collect();
    let in_utf_8 = format!("\u{feff}{text}").into_bytes();
    for bytes in [latin_1, utf_16(u16::to_le_bytes), utf_16(u16::to_be_bytes), in_utf_8] {
        let read = read(&bytes, Path::new("log.csv"), &irb()).unwrap();
        assert_eq!(read.q_rad, expected.q_rad);
    }
}

#[test]
fn a_workbook_with_dates_and_units_is_a_log() {
    let joints: String =
        (1..=6).map(|joint| format!("[[joints]]\ncolumn = \"A{joint}\"\nunit = \"deg\"\n")).collect();
    let text = format!("[csv]\nunit_lines = 1\n[time]\ncolumn = \"Zeit\"\nunit = \"date_time\"\n{joints}");
    let mapping: RobotLogMapping = shared::config::parse(&text, Path::new("mapping.toml")).unwrap();
    let options = LogOptions { mapping: Some(mapping), ..LogOptions::default() };
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/workbooks/robot_log.xlsx");
    let log = load_with(&path, &irb(), &options).unwrap();
    assert_eq!(log.q_rad.t_s.len(), 200);
    assert!(log.q_rad.t_s.windows(2).all(|pair| (pair[1] - pair[0] - 0.02).abs() < 1e-3));
    assert!((log.q_rad[100][2] - 7.0_f64.to_radians()).abs() < 1e-9, "{}", log.q_rad[100][2].to_degrees());
}

fn mapping_of_cycles(time: &str) -> Result<RobotLogMapping, ConfigError> {
    let joints: String =
        (1..=6).map(|joint| format!("[[joints]]\ncolumn = \"A{joint}\"\nunit = \"deg\"\n")).collect();
    shared::config::parse(&format!("[time]\ncolumn = \"cycle\"\n{time}\n{joints}"), Path::new("mapping.toml"))
}

/// A table of 200 rows whose time is a 16-bit counter of 4 ms cycles. The counter wraps after 262 s, from
/// line 29 to line 30.
fn table_of_cycles() -> String {
    let row = |row: u32| format!("{},{},0,0,0,0,0\n", (65_400 + 5 * row) % 65_536, 0.5 * f64::from(row));
    "cycle,A1,A2,A3,A4,A5,A6\n".to_owned() + &(0..200).map(row).collect::<String>()
}

fn read_cycles(table: &str, time: &str) -> Result<RobotLog, LogError> {
    let options = LogOptions { mapping: Some(mapping_of_cycles(time).unwrap()), ..LogOptions::default() };
    identify::logs::read_with(table.as_bytes(), Path::new("log.csv"), &irb(), &options)
}

#[test]
fn cycles_of_a_controller_are_times_also_where_their_counter_begins_anew() {
    let table = table_of_cycles();
    let log = read_cycles(&table, "unit = \"cycles\"\nperiod_ms = 4\nwraps_at = 65536").unwrap();
    assert_eq!((log.q_rad.len(), log.q_rad.first_stamp_ns), (200, 65_400 * 4_000_000));
    assert!(log.q_rad.t_s.iter().enumerate().all(|(row, t_s)| (t_s - 0.02 * row as f64).abs() < 1e-9));
    let refusal = message(read_cycles(&table, "unit = \"cycles\"\nperiod_ms = 4"));
    assert!(refusal.contains("line 30"), "{refusal}");
    for (time, key) in [
        ("unit = \"cycles\"", "period_ms"),
        ("unit = \"ms\"\nperiod_ms = 4", "period_ms"),
        ("unit = \"cycles\"\nperiod_ms = nan", "period_ms"),
        ("unit = \"date_time\"\nwraps_at = 65536", "wraps_at"),
        ("unit = \"ms\"\nwraps_at = 0", "wraps_at"),
    ] {
        let refusal = mapping_of_cycles(time).unwrap_err().to_string();
        assert!(refusal.contains(key), "{refusal}");
    }
}

#[test]
fn dates_with_the_day_first_are_read_if_their_order_is_certain() {
    let table = |date: &str| {
        let row = |row: u32| {
            let (s, ms) = (row / 50, 20 * (row % 50));
            format!("{date} 10:15:{s:02}.{ms:03},{},0,0,0,0,0\n", 0.5 * f64::from(row))
        };
        "cycle,A1,A2,A3,A4,A5,A6\n".to_owned() + &(0..200).map(row).collect::<String>()
    };
    let read = |date: &str| read_cycles(&table(date), "unit = \"date_time\"");
    assert_eq!(read("05.11.2026").unwrap().q_rad, read("2026-11-05").unwrap().q_rad);
    for date in ["05/11/2026", "05.11.26"] {
        let refusal = message(read(date));
        assert!(refusal.contains("line 2") && refusal.contains("is not a date"), "{refusal}");
    }
}

/// The last row before the wrap is exchanged with the first row after it. If this counted as another wrap, the rest of the
/// log would be 262 s late.
#[test]
fn a_step_back_over_the_wrap_of_a_counter_is_not_another_wrap() {
    let table = table_of_cycles();
    let mut lines: Vec<&str> = table.lines().collect();
    lines.swap(28, 29);
    let read = read_cycles(&lines.join("\n"), "unit = \"cycles\"\nperiod_ms = 4\nwraps_at = 65536");
    assert!(matches!(read, Err(LogError::TimeNotIncreasing { line: 30, before_line: 29, .. })), "{read:?}");
}

#[test]
fn what_is_no_text_is_refused() {
    for bytes in [&b"t_s\0"[..], &[0xff, 0xfe, 0x00, 0xd8, 0x00, 0x00], b"PK\x03\x04 no workbook"] {
        let error = read(bytes, Path::new("log.csv"), &irb()).unwrap_err();
        assert!(matches!(error, LogError::NotText { .. } | LogError::UnknownFormat { .. }), "{error}");
    }
}

/// The log is longer than one decoded block. It has comments and blank lines between the rows.
#[test]
fn a_long_log_is_read_as_a_short_one_is() {
    const ROWS: usize = 20_000;
    let mut text = String::from("t_s,joint1_deg,joint2_deg,joint3_deg,joint4_deg,joint5_deg,joint6_deg\n");
    for row in 0..ROWS {
        let t_s = row as f64 * 0.004;
        let angle = |joint: f64| 10.0 * (0.3 * joint * t_s).sin();
        let [a, b, c] = [1.0, 2.0, 3.0].map(angle);
        text += &format!("{t_s:.3},{a:.12},{b:.12},{c:.12},0,0,0\n");
        if row % 1000 == 999 {
            text += "# after: 1000 rows, accurate to 5 \u{b5}m\n\n";
        }
    }
    text += "# robot: at the end";
    let log = parse(&text, &nj()).unwrap();
    assert_eq!((log.q_rad.len(), log.robot.as_deref()), (ROWS, Some("at the end")));
    let utf16: Vec<u8> =
        "\u{feff}".encode_utf16().chain(text.encode_utf16()).flat_map(u16::to_le_bytes).collect();
    let latin: Vec<u8> = text.chars().map(|character| character as u8).collect();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("log.csv");
    for bytes in [text.as_bytes(), &utf16, &latin] {
        assert!(read(bytes, Path::new("log.csv"), &nj()).unwrap() == log);
        std::fs::write(&path, bytes).unwrap();
        assert!(load_with(&path, &nj(), &LogOptions::default()).unwrap() == log);
    }
    let line = 2 + 15_000 + 2 * 15;
    let bad = text.replace("\n60.000,", "\n60.000,-");
    let refusal = message(parse(&bad, &nj()));
    assert!(refusal.contains(&format!("line {line} column `joint1_deg`: `--")), "{refusal}");
    let refusal = message(parse(&text.replace("\n60.000,", "\n60.000\0"), &nj()));
    assert!(refusal.contains(&format!("character '\\0' in line {line}")), "{refusal}");
    let cut = &text[..text.rfind("79.992").unwrap() + 30];
    let refusal = message(parse(cut, &nj()));
    assert!(refusal.contains(&format!("line {}: ", 2 + 19_998 + 2 * 19)), "{refusal}");
}

#[test]
fn a_log_without_motion_gets_a_remark() {
    let mut log = sample_log();
    log.q_rad.iter_mut().flatten().for_each(|q| *q *= 0.01);
    let back = parse(&text_of(&log, &nj()), &nj()).unwrap();
    assert_eq!(back.quality.remarks.len(), 1);
}

proptest! {
    #[test]
    fn no_text_makes_the_reader_panic(text in "\\PC*") {
        let _ = parse(&text, &irb());
    }

    #[test]
    fn no_table_makes_the_reader_panic(rows in prop::collection::vec(prop::collection::vec("[-0-9.,;eNa\"# ]{0,12}", 7), 0..60)) {
        let body: Vec<String> = rows.iter().map(|row| row.join(",")).collect();
        let text = format!("t_s,joint1_deg,joint2_deg,joint3_deg,joint4_deg,joint5_deg,joint6_deg\n{}", body.join("\n"));
        let _ = parse(&text, &nj());
    }

    #[test]
    fn any_log_within_the_limits_survives_the_file(
        first_stamp_ns in -4_000_000_000_000_000_000i64..4_000_000_000_000_000_000,
        steps_ns in prop::collection::vec(1i64..5_000_000_000, 60..80),
        seed in prop::array::uniform6(-1.0f64..1.0),
    ) {
        let mut at_ns = 0i64;
        let t_s: Vec<f64> = std::iter::once(0.0)
            .chain(steps_ns.iter().map(|step| { at_ns += step; at_ns as f64 * 1e-9 }))
            .collect();
        let q_rad = t_s.iter().map(|t| Joints::from_fn(6, |j| seed[j] * (t + j as f64).cos())).collect();
        let log = RobotLog { q_rad: Stream::new(first_stamp_ns, t_s, q_rad).into(), clock: "c".into(), ..RobotLog::default() };
        for robot in [irb(), nj()] {
            let back = parse(&text_of(&log, &robot), &robot).unwrap();
            prop_assert_eq!(back.q_rad.first_stamp_ns, first_stamp_ns);
            for (a, b) in back.q_rad.iter().flatten().zip(log.q_rad.iter().flatten()) {
                prop_assert!((a - b).abs() < 1e-9);
            }
            for (a, b) in back.q_rad.t_s.iter().zip(&log.q_rad.t_s) {
                prop_assert!((a - b).abs() < 1e-9);
            }
        }
    }
}
