//! Writes the two files of a run: the log of the robot's controller, and the counters of the bar.

use std::f64::consts::TAU;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use chrono::{DateTime, SecondsFormat};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

use super::robots::Robot;

/// Counts per turn of a bar joint: 3600 lines, each interpolated 4096 times.
pub const COUNTS_PER_TURN: f64 = 14_745_600.0;

/// Errors of the stamps of a robot's log.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Stamps {
    /// Each row has its sampling time.
    Perfect,
    /// Stamps are read from a clock with this period \[ms\].
    Rounded(f64),
    /// Rows are stamped on arrival. The delay of the arrival has this standard deviation \[ms\]. Stamps never decrease.
    Jittered(f64),
    /// This fraction of the rows occurs twice.
    Duplicated(f64),
    /// This number of rows arrives at once. They are stamped when they are read, 20 us after each other.
    Batched(usize),
    /// This fraction of the rows is stamped 10 ms late.
    Late(f64),
    /// This fraction of the rows is missing. The stamps of the other rows have this standard deviation \[ms\].
    Missing(f64, f64),
}

/// A row of the robot's log: time on the robot's clock \[s\] and raw angles \[rad\].
pub type Row = (f64, [f64; 6]);

impl Stamps {
    /// Applies the errors to the stamps. Returns the rows in the order of the file.
    pub fn applied(self, rows: &[Row], random: &mut ChaCha8Rng) -> Vec<Row> {
        match self {
            Self::Perfect => rows.to_vec(),
            Self::Rounded(step_ms) => {
                let step_s = step_ms * 1e-3;
                rows.iter().map(|(time_s, values)| ((time_s / step_s).round() * step_s, *values)).collect()
            }
            Self::Jittered(sigma_ms) => {
                let late_s = Normal::new(0.0, sigma_ms * 1e-3).unwrap();
                later(rows, || late_s.sample(random))
            }
            Self::Late(share) => later(rows, || if random.random_bool(share) { 0.01 } else { 0.0 }),
            Self::Missing(share, sigma_ms) => {
                let kept: Vec<Row> = rows.iter().filter(|_| !random.random_bool(share)).copied().collect();
                Self::Jittered(sigma_ms).applied(&kept, random)
            }
            Self::Duplicated(share) => {
                let mut twice = |row| if random.random_bool(share) { vec![row; 2] } else { vec![row] };
                rows.iter().flat_map(|row| twice(*row)).collect()
            }
            Self::Batched(size) => rows
                .chunks(size)
                .flat_map(|batch| {
                    let arrived_s = batch[batch.len() - 1].0;
                    let taken = |(index, row): (usize, &Row)| (arrived_s + index as f64 * 20e-6, row.1);
                    batch.iter().enumerate().map(taken).collect::<Vec<_>>()
                })
                .collect(),
        }
    }
}

/// Delays the stamp of each row by the next value of `by_s` \[s\]. Stamps never decrease.
fn later(rows: &[Row], mut by_s: impl FnMut() -> f64) -> Vec<Row> {
    let mut last_s = f64::MIN;
    let mut stamp = |time_s: f64| {
        last_s = (time_s + by_s()).max(last_s + 1e-6);
        last_s
    };
    rows.iter().map(|(time_s, values)| (stamp(*time_s), *values)).collect()
}

/// Writes the robot's log in the format of this robot, and returns its path.
pub fn write_robot(robot: &Robot, rows: &[Row], directory: &Path) -> PathBuf {
    let form = robot.log;
    let mut text = String::from("t_s");
    (1..=6).for_each(|joint| write!(text, ",{}{joint}_{}", form.column, form.unit).unwrap());
    text.push('\n');
    for (time_s, angles_rad) in rows {
        write!(text, "{time_s:.6}").unwrap();
        for angle_rad in angles_rad {
            write!(text, ",{:.*}", form.decimals, angle_rad / form.unit_rad).unwrap();
        }
        text.push('\n');
    }
    let path = directory.join("robot_log.csv");
    std::fs::write(&path, text).unwrap();
    path
}

/// Format of the time on the bar's clock.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum BarTime {
    /// Column `t_s`: seconds, with this value at the first cycle.
    Seconds(f64),
    /// Column `time_utc`: this number of seconds since 1970 at the first cycle.
    Utc(i64),
}

/// Writes the counters, one row for each cycle. A cycle consists of its time after the first cycle \[s\] and its counts.
pub fn write_bar(begin: BarTime, cycles: &[(f64, [u32; 5])], directory: &Path) -> PathBuf {
    let name = if matches!(begin, BarTime::Utc(_)) { "time_utc" } else { "t_s" };
    let mut text = format!("{name},count1,count2,count3,count4,count5\n");
    for (since_s, counts) in cycles {
        match begin {
            BarTime::Seconds(begin_s) => write!(text, "{:.6}", begin_s + since_s).unwrap(),
            BarTime::Utc(begin_s) => {
                let time_ns = begin_s * 1_000_000_000 + (since_s * 1e9).round() as i64;
                let time = DateTime::from_timestamp_nanos(time_ns);
                text += &time.to_rfc3339_opts(SecondsFormat::Micros, true);
            }
        }
        counts.iter().for_each(|count| write!(text, ",{count}").unwrap());
        text.push('\n');
    }
    let path = directory.join("bar.csv");
    std::fs::write(&path, text).unwrap();
    path
}

/// Reading of a 32-bit counter at this angle. The counter is zero at the count `origin`.
pub fn counter(angle_rad: f64, origin: i64) -> u32 {
    ((angle_rad / TAU * COUNTS_PER_TURN).round() as i64 - origin).rem_euclid(1 << 32) as u32
}
