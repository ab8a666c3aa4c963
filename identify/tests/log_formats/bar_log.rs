//! Logs of the bar's encoders that other programs wrote, as tables of counters and as bags.
//! Irregularities are marked or refused.

use std::path::Path;

use identify::inspect;
use identify::logs::{BarLogMapping, LogError, OtherBarLog, UnwrappedPoint};
use identify::prepare::{BarReading, bar_angles};
use shared::config::{self, BallBarConfig};
use shared::recording::schema::flags;

use super::bags::{self, JointState};
use crate::support::bar;

const ROWS: usize = 200;

/// Angle of a joint (1 to 5) at a row \[rad\]. It increases by more than a turn.
fn angle_rad(row: usize, joint: usize) -> f64 {
    0.05 * row as f64 + 0.6 * (0.03 * row as f64 + joint as f64).sin()
}

/// Counts of the encoder of a joint, with an arbitrary origin.
fn counts(row: usize, joint: usize) -> i64 {
    let scale = bar().encoders[joint - 1].scale();
    scale.rad_to_counts(angle_rad(row, joint)) + 4_290_000_000 * joint as i64
}

/// A table of the four encoders of the thesis at 100 Hz. `cell` returns the text for a row and a joint.
pub fn table(cell: impl Fn(usize, usize) -> String) -> String {
    let mut text = "t_s,count1,count2,count4,count5\n".to_owned();
    for row in 0..ROWS {
        let cells = [1, 2, 4, 5].map(|joint| cell(row, joint)).join(",");
        text += &format!("{},{cells}\n", row as f64 * 0.01);
    }
    text
}

fn shown(row: usize, joint: usize) -> String {
    (counts(row, joint) as u32).to_string()
}

fn four() -> BallBarConfig {
    let mut bar = bar();
    bar.encoders.remove(2);
    bar
}

pub fn shipped() -> BarLogMapping {
    config::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/bar_log.toml")).unwrap()
}

fn mapping(text: &str) -> BarLogMapping {
    config::parse(text, Path::new("mapping.toml")).unwrap()
}

fn read(bytes: &[u8], mapping: Option<&BarLogMapping>) -> Result<OtherBarLog, LogError> {
    OtherBarLog::read(bytes, Path::new("bar.csv"), &four(), mapping)
}

fn message(bytes: &[u8], mapping: Option<&BarLogMapping>) -> String {
    read(bytes, mapping).map(drop).unwrap_err().to_string()
}

/// Checks that every joint follows the true motion, except for a constant offset.
fn assert_follows(log: &OtherBarLog, tolerance_rad: f64) {
    let angles = bar_angles(&log.cycles, &log.encoders).unwrap();
    let first = angles.readings[0];
    for encoder in &log.encoders {
        let joint = usize::from(encoder.joint);
        for BarReading { cycle, recorded_rad, .. } in angles.readings.iter().filter(|one| one.origin == 0) {
            let moved = recorded_rad[joint - 1] - first.recorded_rad[joint - 1];
            let truth = angle_rad(*cycle, joint) - angle_rad(first.cycle, joint);
            assert!((moved - truth).abs() < tolerance_rad, "row {cycle} joint {joint}: {moved} for {truth}");
        }
    }
}

/// Checks that every joint wrapped with this period \[rad\], and that a report can show its angles both
/// as recorded and as unwrapped.
fn assert_shown(log: &OtherBarLog, period_rad: f64) {
    assert_eq!(log.unwrapped.len(), log.encoders.len());
    for one in &log.unwrapped {
        assert!(
            (one.period_rad - period_rad).abs() < 1e-12 && one.wraps > 0 && one.step_part < 1.0,
            "{one:?}"
        );
        let step = |pair: &[UnwrappedPoint]| (pair[1].shown_rad - pair[0].shown_rad).abs();
        assert!(one.points.windows(2).any(|pair| step(pair) > 0.5 * period_rad), "{}", one.name);
        let range = one.points.iter().map(|point| point.shown_rad);
        let (low, high) = range.fold((f64::MAX, f64::MIN), |(low, high), rad| (low.min(rad), high.max(rad)));
        assert!(high - low <= period_rad, "{}", one.name);
    }
}

#[test]
fn the_counters_of_the_thesis_become_angles_by_the_bar_s_configuration() {
    for text in [table(shown), table(shown).replace(',', ";").replace('\n', "\r\n")] {
        let log = read(text.as_bytes(), None).unwrap();
        assert_eq!((log.cycles.len(), log.is_dated, log.clock.as_str()), (ROWS, false, "t_s"));
        assert_eq!(log.encoders.iter().map(|encoder| encoder.joint).collect::<Vec<_>>(), [1, 2, 4, 5]);
        assert_follows(&log, 1e-6);
        assert!(log.unknown.contains(&"which values are not valid") && log.quality.remarks.is_empty());
        let readings = bar_angles(&log.cycles, &log.encoders).unwrap().readings;
        assert!((readings.period_s() - 0.01).abs() < 1e-12);
    }
}

#[test]
fn counters_that_a_program_has_unwrapped_read_as_others_do() {
    let signed = table(|row, joint| (counts(row, joint) as u32 as i32).to_string());
    let unwrapped = table(|row, joint| counts(row, joint).to_string());
    let float = table(|row, joint| format!("{:e}", f64::from(counts(row, joint) as u32)));
    let expected = read(table(shown).as_bytes(), None).unwrap().cycles;
    for text in [signed, unwrapped, float] {
        let cycles = read(text.as_bytes(), None).unwrap().cycles;
        let steps = |cycles: &[shared::recording::schema::CycleRecord]| -> Vec<u32> {
            let pairs = cycles.windows(2);
            pairs.map(|pair| pair[1].encoders[3].count.wrapping_sub(pair[0].encoders[3].count)).collect()
        };
        assert_eq!(steps(&cycles), steps(&expected));
    }
}

#[test]
fn the_shipped_mapping_reads_lines_without_header_as_twincat_writes_dates() {
    let table = table(shown);
    let lines = table.lines().skip(1).map(|line| {
        let (t_s, cells) = line.split_once(',').unwrap();
        format!("2016-03-14-10:22:{:06.3};{}\n", t_s.parse::<f64>().unwrap() + 33.0, cells.replace(',', ";"))
    });
    let text: String = lines.collect();
    let log = read(text.as_bytes(), Some(&shipped())).unwrap();
    assert_follows(&log, 1e-6);
    assert_eq!((log.is_dated, log.clock.as_str()), (true, "measurement PC"));
    assert_eq!(log.cycles[0].sample_time.to_string(), "2016-03-14T10:22:33.000000000Z");
    assert_eq!(log.cycles[1].sample_time.ns_since(log.cycles[0].sample_time), 10_000_000);
}

#[test]
fn a_narrow_counter_is_refused_with_what_to_write_and_then_followed() {
    // The motion is slow enough that no wrap is missed. With 16 bits, a turn of the ERN 1080 has 225 wraps.
    let slow = |row: usize, joint: usize| (counts(row, joint) / 100).rem_euclid(65_536).to_string();
    let text = table(slow);
    let refused = message(text.as_bytes(), None);
    assert!(refused.contains("joint 1") && refused.contains("wraps_at = 65536"), "{refused}");
    let columns: String = [1, 2, 4, 5]
        .map(|joint| format!("[[encoders]]\njoint = {joint}\ncolumn = \"count{joint}\"\n"))
        .concat();
    let with_width = mapping(&format!("wraps_at = 65536\n[time]\ncolumn = \"t_s\"\n{columns}"));
    let log = read(text.as_bytes(), Some(&with_width)).unwrap();
    let angles = bar_angles(&log.cycles, &log.encoders).unwrap();
    let last = angles.readings.last().unwrap().recorded_rad[0] - angles.readings[0].recorded_rad[0];
    let truth = (angle_rad(ROWS - 1, 1) - angle_rad(0, 1)) / 100.0;
    assert!((last - truth).abs() < 1e-5, "{last} for {truth}");
    assert_shown(&log, 65_536.0 * log.encoders[0].scale.rad_per_count());
}

#[test]
fn the_width_of_counters_does_not_apply_to_angles_beside_them() {
    let text = table(|row, joint| match joint {
        1 | 2 => counts(row, joint).rem_euclid(1 << 24).to_string(),
        _ => angle_rad(row, joint).to_degrees().to_string(),
    });
    let columns: String = [(1, "counts"), (2, "counts"), (4, "deg"), (5, "deg")]
        .map(|(joint, unit)| {
            format!("[[encoders]]\njoint = {joint}\ncolumn = \"count{joint}\"\nunit = \"{unit}\"\n")
        })
        .concat();
    let mixed = mapping(&format!("wraps_at = 16777216\n[time]\ncolumn = \"t_s\"\n{columns}"));
    assert_follows(&read(text.as_bytes(), Some(&mixed)).unwrap(), 1e-6);
}

#[test]
fn missing_frozen_and_repeated_rows_are_marked_and_told() {
    let text = table(|row, joint| match (row, joint) {
        (40, 2) => String::new(),
        (41, 5) => "NaN".into(),
        // The logger wrote two consecutive rows late.
        (81 | 82, _) => shown(80, joint),
        _ => shown(row, joint),
    });
    let line = text.lines().nth(121).unwrap().to_owned();
    let text = text.replace(&line, &format!("{line}\n{line}"));
    let log = read(text.as_bytes(), None).unwrap();
    let quality = &log.quality;
    assert_eq!((quality.incomplete_dropped, quality.repeated_dropped, quality.duplicates_dropped), (2, 2, 1));
    let invalid: Vec<usize> = (0..log.cycles.len()).filter(|row| !log.cycles[*row].is_valid()).collect();
    assert_eq!(invalid, [40, 41, 81, 82]);
    assert!(log.cycles[81].flags & flags::STALE_INPUT != 0);
    assert_follows(&log, 1e-6);
    let message = inspect::bar_log(&log).suspicious.join("\n");
    for part in ["2 lines lack a value", "2 lines repeat the counts", "1 lines repeat the one before"] {
        assert!(message.contains(part), "{message}");
    }
}

#[test]
fn counters_that_start_anew_are_marked_and_one_that_slips_is_not_excused() {
    let anew = |row: usize, joint: usize| {
        let since = if row < 100 { 0 } else { -counts(99, joint) + 5000 };
        ((counts(row, joint) + since) as u32).to_string()
    };
    let log = read(table(anew).as_bytes(), None).unwrap();
    let origins: Vec<usize> = log.cycles.chunk_by(|a, b| a.origin == b.origin).map(<[_]>::len).collect();
    assert_eq!(origins, [100, ROWS - 100]);
    assert!(log.quality.remarks[0].contains("line 102"), "{:?}", log.quality.remarks);
    // The counter restarts with a jump of three quarters of the largest possible step. The reader must neither assume that
    // the joint moved by this step nor that the counter wrapped.
    let far = |row: usize, joint: usize| {
        let since = if row < 100 { 0 } else { 1_610_000_000 };
        ((counts(row, joint) + since) as u32).to_string()
    };
    let log = read(table(far).as_bytes(), None).unwrap();
    assert!(log.cycles[100].origin != log.cycles[99].origin);
    let wraps = |joint: usize| {
        let turn = |row: usize| counts(row, joint).div_euclid(1 << 32);
        (1..100).filter(|row| turn(*row) != turn(row - 1)).count()
    };
    assert!(!log.unwrapped.is_empty());
    for one in &log.unwrapped {
        let joint: usize = one.name[1..].parse().unwrap();
        assert!(
            one.step_part < 0.01 && one.wraps == wraps(joint),
            "{}: {} {}",
            one.name,
            one.wraps,
            one.step_part
        );
    }
    // If the scale is grossly wrong, every row contains such a jump. The remark must nevertheless appear only once.
    let coarse = |row: usize, joint: usize| ((50 * counts(row, joint)) as u32).to_string();
    let log = read(table(coarse).as_bytes(), None).unwrap();
    let message: Vec<&String> =
        log.quality.remarks.iter().filter(|one| one.contains("jump at once")).collect();
    assert!(
        matches!(message[..], [one] if one.contains("more") && one.contains("interpolation_bits")),
        "{message:?}"
    );
    let slips = |row: usize, joint: usize| {
        let by = if row >= 100 && joint == 4 { 1_000_000 } else { 0 };
        ((counts(row, joint) + by) as u32).to_string()
    };
    let log = read(table(slips).as_bytes(), None).unwrap();
    assert!(log.cycles.iter().all(|cycle| cycle.flags == 0));
    assert!(inspect::bar_log(&log).suspicious.join("\n").contains("b4"), "a jump is suspicious");
}

#[test]
fn rows_that_jump_out_and_back_are_no_new_origins_but_marked_and_named() {
    let text = table(|row, joint| match (row, joint) {
        (40 | 41 | 90, _) => "0".into(),
        (120, 4) => ((counts(row, joint) + 1_000_000) as u32).to_string(),
        _ => shown(row, joint),
    });
    let log = read(text.as_bytes(), None).unwrap();
    let invalid: Vec<usize> = (0..log.cycles.len()).filter(|row| !log.cycles[*row].is_valid()).collect();
    assert_eq!((log.quality.excursions_dropped, invalid), (4, vec![40, 41, 90, 120]));
    assert!(log.cycles.iter().all(|cycle| cycle.origin == 0));
    assert_follows(&log, 1e-6);
    let message = inspect::bar_log(&log).suspicious.join("\n");
    assert!(message.contains("4 of 200 lines") && message.contains("line 42, 43, 92, 122"), "{message}");
    // This number of faulty rows is too large for faults of single rows.
    let many = table(|row, joint| if row % 7 == 3 { "0".into() } else { shown(row, joint) });
    let message = self::message(many.as_bytes(), None);
    assert!(
        message.contains("28 of 200 lines")
            && message.contains("line 5, 12")
            && message.contains("log again"),
        "{message}"
    );
}

#[test]
fn counters_that_start_anew_twice_within_a_few_rows_have_three_origins() {
    for rows in 1..=5 {
        let anew = |row: usize, joint: usize| {
            let since =
                [0, 700_000_000, -900_000_000][usize::from(row >= 100) + usize::from(row >= 100 + rows)];
            ((counts(row, joint) + since) as u32).to_string()
        };
        let log = read(table(anew).as_bytes(), None).unwrap();
        let origins: Vec<usize> = log.cycles.chunk_by(|a, b| a.origin == b.origin).map(<[_]>::len).collect();
        assert_eq!(origins, [100, rows, ROWS - 100 - rows]);
        assert_eq!(log.quality.excursions_dropped, 0);
    }
}

#[test]
fn what_cannot_be_meant_is_refused_with_place_and_remedy() {
    let good = table(shown);
    let line = |number: usize| good.lines().nth(number - 1).unwrap().to_owned();
    let swapped = good.replace(&line(60), "X").replace(&line(61), &line(60)).replace('X', &line(61));
    let no_column = good.replace("count4", "counter4");
    let fraction = good.replace(&line(60), &format!("{}.5", line(60)));
    let word = good.replace(&line(60), &format!("{}x", line(60)));
    let short = good[..good.len() - 30].to_owned();
    for (text, parts) in [
        (swapped, &["line 61", "time goes"][..]),
        (no_column, &["`count4` is missing", "counter4", "[[encoders]]", "--recording-mapping"]),
        (fraction, &["line 60", "`count5`", "not a whole number"]),
        (word, &["line 60", "`count5`"]),
        (short, &["line 201"]),
        (good.replace("t_s", "seconds"), &["`time_utc` is missing", "seconds"]),
        (good.lines().take(30).collect::<Vec<_>>().join("\n"), &["29 usable rows"]),
        ("<Rob/>".into(), &["neither a recording"]),
    ] {
        let message = message(text.as_bytes(), None);
        assert!(parts.iter().all(|part| message.contains(part)), "{message}");
    }
    // The bar does not have this encoder, so its counts cannot be converted to angles.
    let more = good.lines().enumerate();
    let more = more.map(|(row, line)| format!("{line},{}\n", if row == 0 { "count3" } else { "0" }));
    let message = message(more.collect::<String>().as_bytes(), None);
    assert!(message.contains("joint 3") && message.contains("interpolation_bits"), "{message}");
}

#[test]
fn impossible_mappings_are_refused_by_key() {
    let encoders = "[[encoders]]\njoint = 1\ncolumn = \"a\"\n";
    for (text, key) in [
        (format!("{encoders}{encoders}"), "encoders[1].joint"),
        (encoders.to_owned() + &encoders.replace('1', "2"), "encoders[1].column"),
        (encoders.replace('1', "6"), "encoders[0].joint"),
        ("encoders = []".into(), "encoders"),
        (format!("wraps_at = 2\n{encoders}"), "wraps_at"),
        (format!("[csv]\ndelimiter = \"#\"\n{encoders}"), "csv.delimiter"),
    ] {
        let message = config::parse::<BarLogMapping>(&text, Path::new("m.toml")).unwrap_err().to_string();
        assert!(message.contains(&format!("`{key}`")), "{message}");
    }
}

/// Joint states of joints 1, 2, 4 and 5 in another order, among other joints. Each angle is within half a turn.
pub fn joint_states(prefix: &str) -> Vec<JointState> {
    let wrapped = |angle: f64| angle - (angle / std::f64::consts::TAU).round() * std::f64::consts::TAU;
    let state = |row: usize| JointState {
        topic: "/bar/joint_states",
        stamp_ns: 1_795_000_000_000_000_000 + row as i64 * 10_000_000,
        names: ["bar_joint_5", "gripper", "bar_joint_1", "bar_joint_4", "bar_joint_2"]
            .map(|name| format!("{prefix}{name}"))
            .to_vec(),
        position: [5, 3, 1, 4, 2].map(|joint| wrapped(angle_rad(row, joint))).to_vec(),
    };
    (0..ROWS).map(state).collect()
}

#[test]
fn encoders_among_the_joints_of_a_bag_are_found_by_name_and_followed_over_full_turns() {
    let mut messages = joint_states("lab_");
    // Other nodes publish on the same topic, and one message lacks a value.
    messages.insert(
        50,
        JointState {
            topic: "/bar/joint_states",
            stamp_ns: 1,
            names: vec!["gripper".into()],
            position: vec![0.0],
        },
    );
    messages[120].position[0] = f64::NAN;
    for bytes in [bags::mcap(&messages), bags::db3(&messages[..50])] {
        let whole = bytes.starts_with(b"\x89MCAP");
        let log = OtherBarLog::read(&bytes, Path::new("bag"), &four(), None).unwrap();
        assert_eq!(log.cycles.len(), if whole { ROWS } else { 50 });
        assert_eq!(log.quality.incomplete_dropped, usize::from(whole));
        assert_eq!((log.is_dated, log.clock.as_str()), (true, "header.stamp"));
        assert_follows(&log, 1e-8);
        if whole {
            assert_shown(&log, std::f64::consts::TAU);
        }
    }
    let named = [(1, "gripper"), (2, "gripper2")];
    let named = named.map(|(joint, name)| format!("[[encoders]]\njoint = {joint}\ncolumn = \"{name}\"\n"));
    for (text, parts) in [
        (None, &["bar_joint_1 to bar_joint_5", "gripper"][..]),
        (Some(named.concat().replace("gripper", "axis")), &["gripper", "--recording-mapping"]),
        (Some(format!("topic = \"/x\"\n{}", named[0])), &["on topic /x"]),
    ] {
        let mapping = text.map(|text| mapping(&text));
        let message = OtherBarLog::read(&bags::mcap(&messages), Path::new("bag"), &bar(), mapping.as_ref());
        let message = message.map(drop).unwrap_err().to_string();
        assert!(parts.iter().all(|part| message.contains(part)), "{message}");
    }
}
