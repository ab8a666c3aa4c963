//! Fuzz target: reads forces on the bar in separate files from arbitrary bytes.

use std::path::Path;
use std::sync::LazyLock;

use identify::logs::{ForceLog, ForceLogMapping};
use shared::config::{self, RobotConfig};

use super::explained;

/// Two mappings. The first is for force components on the clock of the bar, in a table without header. The second is
/// for torques of six motors.
const MAPPINGS: [&str; 2] = [
    "clock = \"bar\"\n[csv]\nheader = false\n[time]\ncolumn = \"1\"\nunit = \"date_time\"\n\
     [force]\ncolumns = [\"2\", \"3\", \"4\"]\nunit = \"lbf\"\nframe = \"base\"\n",
    "[csv]\nskip_lines = 1\n[time]\ncolumn = \"t\"\nunit = \"filetime\"\n\
     [force]\ncolumns = [\"a\", \"b\", \"c\", \"d\", \"e\", \"f\"]\nunit = \"Nm\"\n",
];

struct ForceLogSetting {
    robot: RobotConfig,
    mappings: Vec<Option<ForceLogMapping>>,
}

static SETTING: LazyLock<ForceLogSetting> = LazyLock::new(|| {
    let directory = crate::config_directory();
    let load = |text: &str| config::parse(text, Path::new("mapping.toml")).expect("a mapping");
    let shipped = config::load(&directory.join("force_log.toml")).expect("a shipped file");
    ForceLogSetting {
        robot: config::load(&directory.join("robots/irb2400_16.toml")).expect("a shipped file"),
        mappings: [None, Some(shipped)].into_iter().chain(MAPPINGS.map(|text| Some(load(text)))).collect(),
    }
});

/// Reads a table with each mapping and without a mapping. If the table is accepted, its values must be finite and its times
/// in order. If the table is refused, the error must contain a reason.
pub fn any_table(bytes: &[u8]) {
    for mapping in &SETTING.mappings {
        match ForceLog::read(bytes, Path::new("force"), &SETTING.robot, mapping.as_ref()) {
            Ok(log) => check(&log),
            Err(error) => explained(&error),
        }
    }
}

/// Checks the properties that forces from any source must have.
pub fn check(log: &ForceLog) {
    let log = &log.values;
    assert!(log.t_s.len() == log.rows.len() && log.t_s.first() == Some(&0.0));
    assert!(log.t_s.is_sorted_by(|a, b| a <= b), "time runs backwards");
    assert!(log.iter().flatten().all(|value| value.is_finite()), "a force that is no number");
    let end_s = log.duration_s();
    for part in [0.0, 0.01, 0.5, 0.99, 1.0] {
        let between = log.at(part * end_s);
        assert!(between.iter().flatten().all(|value| value.is_finite()), "no number between two rows");
    }
    assert_eq!(log.at(-1.0), None);
    assert_eq!(log.at(2.0 * end_s + 1.0), None);
}

/// Seeds: tables with the standard columns, and one table for each mapping.
pub fn tables() -> Vec<Vec<u8>> {
    let rows = |header: &str, row: &dyn Fn(usize) -> String| {
        (header.to_owned() + &(0..52).map(row).collect::<String>()).into_bytes()
    };
    let motors: Vec<String> = (1..=6).map(|axis| format!("motor{axis}_Nm")).collect();
    vec![
        rows("# clock: bar\nt_s,force_N\n", &|k| format!("{},{}\n", 0.004 * k as f64, 3 * k)),
        rows("t_s;force_sign\n", &|k| format!("{k};{}\n", k as i64 % 3 - 1)),
        rows("# force_frame: base\nt_s\tforce_x_N\tforce_y_N\tforce_z_N\n", &|k| {
            format!("{k}e-3\t{k}\t-1.5\t2\n")
        }),
        rows(&format!("t_s,{}\n", motors.join(",")), &|k| format!("{k},1,2,3,4,5,-{k}\n")),
        rows("Time;Load\n[ms];[kN]\n", &|k| format!("{};0,0{k:02}\n", 8 * k)),
        rows("", &|k| format!("2026-11-22T10:15:{k:02}Z,1,{k},-3\n")),
        rows("motors\nt,a,b,c,d,e,f\n", &|k| format!("{},1,2,3,4,5,{k}\n", 134_082_000_000_000_000 + k)),
    ]
}
