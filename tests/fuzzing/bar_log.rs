//! Fuzz target: reads logs of the bar's encoders that other programs wrote, tables or bags, from arbitrary bytes.

use std::path::Path;
use std::sync::LazyLock;

use identify::inspect;
use identify::logs::{BarLogMapping, OtherBarLog};
use identify::prepare::bar_angles;
use shared::config::{self, BallBarConfig};

use super::{explained, joint_states};

struct BarLogSetting {
    bars: [BallBarConfig; 2],
    mapping: BarLogMapping,
}

static SETTING: LazyLock<BarLogSetting> = LazyLock::new(|| {
    let mut four = crate::ball_bar();
    four.encoders.remove(2);
    let mapping = config::load(&crate::config_directory().join("bar_log.toml")).expect("a shipped file");
    BarLogSetting { bars: [crate::ball_bar(), four], mapping }
});

/// Reads a table or a bag, with and without a mapping. If the file is accepted, its cycles must be numbered and its angles
/// finite. If the file is refused, the error must contain a reason.
pub fn any_file(bytes: &[u8]) {
    let BarLogSetting { bars, mapping } = &*SETTING;
    for (bar, mapping) in bars.iter().flat_map(|bar| [(bar, None), (bar, Some(mapping))]) {
        match OtherBarLog::read(bytes, Path::new("log"), bar, mapping) {
            Ok(log) => {
                assert!((0..).zip(&log.cycles).all(|(number, cycle)| cycle.cycle == number));
                assert!(log.cycles.iter().all(|cycle| cycle.encoders().len() == log.encoders.len()));
                for one in &log.unwrapped {
                    assert!(one.step_part.is_finite() && one.period_rad > 0.0 && one.wraps > 0);
                    let shown = one.points.iter().flat_map(|at| [at.t_s, at.shown_rad, at.continuous_rad]);
                    assert!(shown.into_iter().all(f64::is_finite), "a reading that is no number");
                }
                match bar_angles(&log.cycles, &log.encoders) {
                    Ok(angles) => {
                        let mut all = angles.readings.iter().flat_map(|one| one.recorded_rad);
                        assert!(all.all(|angle| angle.is_finite()));
                    }
                    Err(error) => explained(&error),
                }
                drop(inspect::bar_log(&log));
            }
            Err(error) => explained(&error),
        }
    }
}

/// Seeds: tables. There is an output of `ballbard export`, a table with the columns of the thesis, a table with angles, and
/// a table without header that fits the shipped mapping.
pub fn tables() -> Vec<Vec<u8>> {
    let rows = |header: &str, row: &dyn Fn(usize) -> String| {
        (header.to_owned() + &(0..52).map(row).collect::<String>()).into_bytes()
    };
    vec![
        rows(
            "time_utc,count1,count2,count3,count4,count5,valid1,valid2,valid3,valid4,valid5,cycle,flags\n",
            &|k| {
                let flags = if k == 20 { "no_reply origin_changed" } else { "" };
                format!("2026-11-22T10:15:00.{k:02}Z,{k},{k},,9,4294967290,1,1,{},1,1,{k},{flags}\n", k % 2)
            },
        ),
        rows("# clock: x\nt_s;count1;count2;count4;count5\n", &|k| format!("{k};{};2;-3;4e3\n", 1000 * k)),
        rows("t_s\tangle1_rad\tangle2_deg\tcount4\tcount5\n", &|k| {
            format!("{k}\t{}\t-7.5\t5\t6\n", 0.1 * k as f64)
        }),
        rows("", &|k| format!("2016-03-14-10:22:33.{k:02};{};2;3;{}\n", 77 * k, 100 * k)),
    ]
}

/// Seeds: bags with joint states of another program, and with those of our own recordings.
pub fn bags() -> Vec<Vec<u8>> {
    let five = ["bar_joint_5", "bar_joint_1", "bar_joint_2", "bar_joint_3", "bar_joint_4"];
    let mut bags = vec![joint_states::bag(&five), joint_states::bag(&five[..4])];
    bags.extend(super::recording::whole_and_cut());
    bags
}
