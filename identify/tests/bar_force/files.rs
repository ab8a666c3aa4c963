//! Forces in robot logs and in separate files are read with the intended meaning, or refused with a remedy.

use identify::kinematics::Joints;
use std::path::Path;

use identify::logs::{
    ForceClock, ForceKind, ForceLog, ForceLogMapping, JointConversion, LogError, LogOptions, RobotLog,
    RobotLogMapping, Stream, read, read_with, write,
};
use proptest::prelude::*;
use shared::config;

use crate::support::{irb2400, nj220, repository};

fn joints(row: usize) -> [f64; 6] {
    std::array::from_fn(|joint| 0.5 * (0.02 * row as f64 * (joint as f64 + 2.0) + joint as f64).sin())
}

/// A robot log of 60 rows at intervals of 4 ms, with a force along the bar.
fn log() -> RobotLog {
    let t_s: Vec<f64> = (0..60).map(|row| f64::from(row) * 0.004).collect();
    let first_stamp_ns = 1_795_000_000_123_456_789;
    let values = (0..60).map(|row| [100.0 * (0.1 * f64::from(row)).sin()].into()).collect();
    let forces = Stream::new(first_stamp_ns, t_s.clone(), values);
    let force = ForceLog::new(ForceClock::Robot, ForceKind::Along, forces);
    let q_rad = (0..60).map(|row| joints(row).into()).collect();
    RobotLog {
        q_rad: Stream::new(first_stamp_ns, t_s, q_rad).into(),
        force: Some(force),
        clock: "controller".into(),
        ..RobotLog::default()
    }
}

fn text_of(log: &RobotLog) -> String {
    let mut bytes = Vec::new();
    write(log, &nj220(), &mut bytes).unwrap();
    String::from_utf8(bytes).unwrap()
}

fn parse(text: &str) -> Result<RobotLog, LogError> {
    read(text.as_bytes(), Path::new("log.csv"), &nj220())
}

fn parse_force(text: &str, mapping: Option<&ForceLogMapping>) -> Result<ForceLog, LogError> {
    ForceLog::read(text.as_bytes(), Path::new("force.csv"), &nj220(), mapping)
}

/// A table of 60 rows with a stamp every 4 ms. `cells` returns the cells after the stamp of a row.
fn table(header: &str, cells: impl Fn(usize) -> String) -> String {
    let rows = (0..60).map(|row| format!("{},{}\n", row as f64 * 0.004, cells(row)));
    format!("t_s,{header}\n{}", rows.collect::<String>())
}

#[test]
fn a_force_that_is_written_with_a_log_is_read_back() {
    let log = log();
    let text = text_of(&log);
    let (back, force) = (parse(&text).unwrap().force.unwrap(), log.force.unwrap());
    assert_eq!((back.kind, back.clock), (force.kind, force.clock));
    let (back, force) = (back.values, force.values);
    assert_eq!((back.first_stamp_ns, &back.rows), (force.first_stamp_ns, &force.rows));
    assert!(back.t_s.iter().zip(&force.t_s).all(|(a, b)| (a - b).abs() < 1e-9));
    let without = parse(&text.replace("force_N", "load")).unwrap();
    assert!(without.force.is_none());
}

#[test]
fn columns_say_what_they_hold_on_which_clock_and_in_which_axes() {
    let along =
        parse_force(&format!("# clock: bar\n{}", table("force_N", |row| format!("{row}.5"))), None).unwrap();
    assert_eq!((along.kind, along.clock), (ForceKind::Along, ForceClock::Bar));
    assert_eq!((along.values[7][0], along.values.at(7.5 * 0.004).unwrap()[0]), (7.5, 8.0));
    let sign =
        parse_force(&table("force_sign", |row| if row % 2 == 0 { "-1".into() } else { "1".into() }), None);
    assert_eq!(sign.unwrap().kind, ForceKind::Sign);
    let vector = table("force_x_N,force_y_N,force_z_N", |row| format!("{row},1,-2"));
    let flange = parse_force(&vector, None).unwrap();
    assert_eq!((flange.kind, flange.clock), (ForceKind::InFlange, ForceClock::Robot));
    assert_eq!(flange.values[3], [3.0, 1.0, -2.0]);
    let base = parse_force(&format!("# force_frame: base\n{vector}"), None).unwrap();
    assert_eq!(base.kind, ForceKind::InBase);
    let unknown = parse_force(&format!("# force_frame: world\n{vector}"), None).unwrap_err().to_string();
    assert!(unknown.contains("`world`") && unknown.contains("`# force_frame: base`"), "{unknown}");
}

/// Motors and joints do equal work, whatever gears, rods and signs are between them.
#[test]
fn torques_of_motors_do_the_work_of_those_of_the_joints() {
    for robot in [irb2400(), nj220()] {
        let column = &robot.log.column;
        let names: Vec<String> = (1..=6).map(|axis| format!("{column}{axis}_Nm")).collect();
        let torque = |axis: usize| 3.0 + axis as f64;
        let cells: Vec<String> = (0..6).map(|axis| torque(axis).to_string()).collect();
        let text = table(&names.join(","), |_| cells.join(","));
        let force = ForceLog::read(text.as_bytes(), Path::new("force.csv"), &robot, None).unwrap();
        assert_eq!(force.kind, ForceKind::JointTorques);
        let conversion = JointConversion::new(&robot.log).unwrap();
        for moved in 0..6 {
            let raw = |by: f64| Joints::from_fn(6, |axis| if axis == moved { by } else { 0.0 });
            let (from, to) = (conversion.to_joint(&raw(0.0)), conversion.to_joint(&raw(1.0)));
            let work: f64 = (0..6).map(|joint| force.values[0][joint] * (to[joint] - from[joint])).sum();
            let expected = torque(moved) * robot.log.unit.to_rad();
            assert!((work - expected).abs() < 1e-9, "{} axis {moved}: {work} for {expected}", robot.name);
        }
    }
}

#[test]
fn the_shipped_mapping_reads_a_load_cell_in_kilonewtons() {
    let mapping: ForceLogMapping = config::load(&repository("config/force_log.toml")).unwrap();
    let rows: String = (0..60).map(|row| format!("{};0,0{row:02}\n", row * 8)).collect();
    let force = parse_force(&format!("Time;Load\n[ms];[kN]\n{rows}"), Some(&mapping)).unwrap();
    assert_eq!((force.kind, force.clock), (ForceKind::Along, ForceClock::Bar));
    assert!((force.values[25][0] - 25.0).abs() < 1e-9 && (force.values.t_s[25] - 0.2).abs() < 1e-12);
}

#[test]
fn a_mapping_of_a_robot_log_names_the_force_or_takes_the_torques() {
    let joints_of = |n: usize| format!("[[joints]]\ncolumn = \"joint{n}_deg\"\nunit = \"deg\"\n");
    let joints: String = (1..=6).map(joints_of).collect();
    let mapped = |rest: &str| {
        let mapping: RobotLogMapping =
            config::parse(&format!("{rest}\n[time]\ncolumn = \"t_s\"\n{joints}"), Path::new("mapping.toml"))
                .unwrap();
        let options = LogOptions { mapping: Some(mapping), ..LogOptions::default() };
        let text = text_of(&log()).replace("force_N", "Load");
        read_with(text.as_bytes(), Path::new("log.csv"), &nj220(), &options)
    };
    let force = mapped("force = { columns = [\"Load\"], unit = \"lbf\" }").unwrap().force.unwrap();
    let expected = log().force.unwrap().values[10][0] * 4.448_221_615_260_5;
    assert!((force.values[10][0] - expected).abs() < 1e-9);
    let columns = |count: u8| (1..=count).map(|n| format!("\"joint{n}_deg\"")).collect::<Vec<_>>().join(", ");
    let six = columns(6);
    let torques = mapped(&format!("torques = [{six}]\nforce = {{ unit = \"Nm\" }}")).unwrap();
    assert_eq!(torques.force.unwrap().kind, ForceKind::JointTorques);
    assert!(mapped(&format!("torques = [{six}]")).unwrap().force.is_none());
    let none = mapped("force = { unit = \"Nm\" }").unwrap();
    assert!(none.force.is_none() && none.quality.remarks.iter().any(|remark| remark.contains("not used")));
    let told = mapped("force = { columns = [\"Force\"], unit = \"N\" }").unwrap_err().to_string();
    assert!(told.contains("`Force` is missing") && told.contains("[force]"), "{told}");
    let five = columns(5);
    let told = mapped(&format!("force = {{ columns = [{five}], unit = \"Nm\" }}")).unwrap_err().to_string();
    assert!(told.contains("5 torques under [force]") && told.contains("has 6 axes"), "{told}");
    let all = mapped(&format!("force = {{ columns = [{six}], unit = \"Nm\" }}")).unwrap();
    assert_eq!(all.force.unwrap().kind, ForceKind::JointTorques);
}

#[test]
fn what_is_no_force_is_refused_with_what_to_do() {
    let refused = |text: &str| parse_force(text, None).unwrap_err().to_string();
    let other_unit = refused(&table("force_kN", |row| row.to_string()));
    assert!(other_unit.contains("force_kN") && other_unit.contains("--force-mapping"), "{other_unit}");
    let part = refused(&table("force_x_N,force_y_N", |_| "1,2".into()));
    assert!(part.contains("`force_z_N` is missing"), "{part}");
    let clock = refused(&format!("# clock: wall\n{}", table("force_N", |row| row.to_string())));
    assert!(clock.contains("`wall`") && clock.contains("# clock: bar"), "{clock}");
    let no_sign = refused(&table("force_sign", |row| row.to_string()));
    assert!(no_sign.contains("line 4 column `force_sign`") && no_sign.contains("invalid sign"), "{no_sign}");
    let gap = refused(&table("force_N", |row| if row == 9 { "NaN".into() } else { "1".into() }));
    assert!(gap.contains("line 11 column `force_N`"), "{gap}");
    let huge = refused(&table("force_N", |row| if row == 9 { "-1e300".into() } else { "1".into() }));
    assert!(huge.contains("line 11 column `force_N`") && huge.contains("check the unit"), "{huge}");
    let back = refused(&table("force_N", |row| row.to_string()).replace("\n0.04,", "\n0.01,"));
    assert!(back.contains("line 12") && back.contains("line 11"), "{back}");
    let short = table("force_N", |row| row.to_string())
        .lines()
        .take(20)
        .map(|line| format!("{line}\n"))
        .collect::<String>();
    assert!(matches!(parse_force(&short, None), Err(LogError::TooFewRows { rows: 19, .. })));
    for broken in
        ["columns = [\"a\"]\nunit = \"Nm\"", "columns = [\"a\", \"b\"]\nunit = \"N\"", "unit = \"Nm\""]
    {
        let text = format!("[time]\ncolumn = \"t\"\n[force]\n{broken}\n");
        let told = config::parse::<ForceLogMapping>(&text, Path::new("m.toml")).unwrap_err().to_string();
        assert!(told.contains("force"), "{told}");
    }
}

proptest! {
    #[test]
    fn no_text_makes_the_reader_panic(text in "(t_s,force_N\n)?\\PC*") {
        let _ = parse_force(&text, None);
    }
}
