//! Converts time stamps of files from any unit to integer nanoseconds. Stamps with a date count from 1970, other stamps from
//! the zero of the file's own clock.

use std::path::Path;

use chrono::{DateTime, NaiveDateTime};
use serde::{Deserialize, Serialize};
use shared::config::Violation;

use super::csv_text::{CsvColumn, CsvRow, CsvTable};
use crate::logs::LogError;

/// Unit of a time column.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TimeUnit {
    /// Seconds, usually with decimals.
    #[default]
    S,
    /// Milliseconds, usually from a controller.
    Ms,
    /// Microseconds, usually from a controller.
    Us,
    /// Nanoseconds, as in ROS.
    Ns,
    /// Cycles of a controller, each with the duration [`TimeColumn::period_ms`].
    Cycles,
    /// Windows FILETIME, the number of 100 ns intervals since 1601, as exported by TwinCAT.
    Filetime,
    /// Date and time of day as text, such as `2026-11-22T10:15:00.25Z` or `22.11.2026 10:15:00.25`. The zone is UTC if
    /// the text has none.
    DateTime,
}

impl TimeUnit {
    /// Name of the unit, as in mapping files.
    pub const fn name(self) -> &'static str {
        match self {
            Self::S => "s",
            Self::Ms => "ms",
            Self::Us => "us",
            Self::Ns => "ns",
            Self::Cycles => "cycles",
            Self::Filetime => "filetime",
            Self::DateTime => "date_time",
        }
    }

    /// Whether times in this unit have a date. Times without a date count from an unknown zero.
    pub const fn is_dated(self) -> bool {
        matches!(self, Self::DateTime | Self::Filetime)
    }
}

/// The column of the stamps.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TimeColumn {
    /// Name in the header of a table. Formats that are not tables do not use it.
    #[serde(default)]
    pub column: String,
    /// Unit of the values in the column. For RSI, the unit of `IPOC`.
    #[serde(default)]
    pub unit: TimeUnit,
    /// Duration of a cycle \[ms\]. Required with [`TimeUnit::Cycles`], not allowed with any other unit.
    pub period_ms: Option<f64>,
    /// If present, the column contains times modulo this number, in the unit of the column. Successive rows must then be
    /// less than half of this number apart.
    pub wraps_at: Option<u64>,
}

impl TimeColumn {
    /// A column with times in a unit.
    pub fn new(column: impl Into<String>, unit: TimeUnit) -> Self {
        Self { column: column.into(), unit, ..Self::default() }
    }

    /// The time column of a table's mapping.
    pub(in crate::logs) fn of_table<'a>(time: Option<&'a Self>, path: &Path) -> Result<&'a Self, LogError> {
        let problem = "the mapping does not name the column of the time stamps";
        let remedy = "write [time] column = \"...\" and its unit into the mapping file";
        time.filter(|time| !time.column.is_empty()).ok_or_else(|| LogError::content(path, problem, remedy))
    }

    /// Checks that a duration is given for cycles but for no other unit, and that times with a date do not wrap.
    pub(in crate::logs) fn check(&self) -> Result<(), Violation> {
        let (key, is_cycles) = ("time.period_ms", self.unit == TimeUnit::Cycles);
        let problem = "it is missing, and unit = \"cycles\" needs it";
        let remedy = "give the duration of a cycle, such as period_ms = 4";
        Violation::unless(!is_cycles || self.period_ms.is_some(), key, problem, remedy)?;
        let (problem, remedy) = ("the column does not count cycles", "remove it, or write unit = \"cycles\"");
        Violation::unless(is_cycles || self.period_ms.is_none(), key, problem, remedy)?;
        let remedy = "give the duration of a controller's cycle in milliseconds";
        let within = |period_ms| Violation::unless_within(key, period_ms, [1e-3, 1e6], remedy);
        self.period_ms.map_or(Ok(()), within)?;
        let (key, remedy) = ("time.wraps_at", "remove it, or give the number of values, such as 65536");
        let can_wrap = self.wraps_at.is_none() || !self.unit.is_dated();
        Violation::unless(can_wrap, key, "times with a date do not wrap", remedy)?;
        let has_values = self.wraps_at.is_none_or(|values| values >= 2);
        Violation::unless(has_values, key, "a counter has at least 2 values", remedy)
    }

    /// Length of one unit \[ns\]. Dates are converted to ns when they are read.
    fn unit_ns(&self) -> f64 {
        match self.unit {
            TimeUnit::S => 1e9,
            TimeUnit::Ms => 1e6,
            TimeUnit::Us => 1e3,
            TimeUnit::Ns | TimeUnit::DateTime => 1.0,
            TimeUnit::Filetime => 100.0,
            TimeUnit::Cycles => self.period_ms.unwrap_or(f64::NAN) * 1e6,
        }
    }
}

/// Converts the stamps of a file in the order of its rows.
pub(in crate::logs) struct StampReader {
    unit: TimeUnit,
    unit_ns: f64,
    wraps_at_ns: Option<i64>,
    /// Time of the row before, as in the file, without the wraps.
    before_ns: Option<i64>,
    /// Sum of the wraps up to the row before.
    wrapped_ns: i64,
}

impl StampReader {
    /// A reader for the column `time`, which must have been checked.
    pub(in crate::logs) fn new(time: &TimeColumn) -> Self {
        let unit_ns = time.unit_ns();
        let wraps_at_ns = time.wraps_at.map(|wraps_at| (wraps_at as f64 * unit_ns).round() as i64);
        Self { unit: time.unit, unit_ns, wraps_at_ns, before_ns: None, wrapped_ns: 0 }
    }

    /// Converts the time of the next row, a number of units, to its stamp \[ns\]. `None` if the stamp is more than
    /// 292 years from zero.
    pub(in crate::logs) fn of_units(&mut self, units: i64) -> Option<i64> {
        let shown_ns = self.units_to_ns(units)?;
        self.unwrapped(shown_ns)
    }

    /// Converts units to ns. The result is exact, except for cycles, whose duration need not be a whole number of ns.
    fn units_to_ns(&self, units: i64) -> Option<i64> {
        match self.unit {
            TimeUnit::Cycles => within_range(units as f64 * self.unit_ns),
            _ => units.checked_mul(self.unit_ns as i64),
        }
    }

    /// Adds the wraps so far to the time `shown_ns` of the next row in the file. A step back by more than half of
    /// `wraps_at` means that the counter wrapped. A step forward by more than half means that jitter set the time back a
    /// little, to before the last wrap.
    fn unwrapped(&mut self, shown_ns: i64) -> Option<i64> {
        let before_ns = self.before_ns.replace(shown_ns);
        if let Some((before_ns, wraps_at_ns)) = before_ns.zip(self.wraps_at_ns) {
            let step_ns = shown_ns.checked_sub(before_ns)?;
            if step_ns.unsigned_abs() > wraps_at_ns.unsigned_abs() / 2 {
                self.wrapped_ns = self.wrapped_ns.checked_sub(step_ns.signum() * wraps_at_ns)?;
            }
        }
        shown_ns.checked_add(self.wrapped_ns)
    }
}

fn within_range(ns: f64) -> Option<i64> {
    (ns.abs() < i64::MAX as f64).then_some(ns.round() as i64)
}

/// A column of a table with time stamps.
pub(in crate::logs) struct StampColumn {
    /// The column in the table.
    pub column: CsvColumn,
    stamps: StampReader,
}

impl StampColumn {
    /// Finds the column that `time` describes.
    pub fn find(table: &CsvTable<'_>, time: &TimeColumn, remedy: &str) -> Result<Self, LogError> {
        Ok(Self { column: table.column(&time.column, remedy)?, stamps: StampReader::new(time) })
    }

    /// Whether the times in this column have a date.
    pub(in crate::logs) fn is_dated(&self) -> bool {
        self.stamps.unit.is_dated()
    }

    /// The stamp of the next row, in integer ns. Decimal digits are converted without an `f64`, because a UTC stamp in
    /// seconds can have more digits than an `f64`.
    pub(in crate::logs) fn next_ns(&mut self, row: &CsvRow<'_>) -> Result<i64, LogError> {
        let Self { column, stamps } = self;
        if stamps.unit == TimeUnit::DateTime {
            return date_ns(row, column);
        }
        let number = row.number(column)?;
        let text = row.text(column);
        let zero = if stamps.unit == TimeUnit::Filetime { FILETIME_1970 } else { 0 };
        let exact = match stamps.unit {
            TimeUnit::S => decimal_to_ns(text),
            _ => text.parse::<i64>().ok().and_then(|units| stamps.units_to_ns(units.checked_sub(zero)?)),
        };
        let shown_ns = exact.or_else(|| within_range((number - zero as f64) * stamps.unit_ns));
        shown_ns.and_then(|shown_ns| stamps.unwrapped(shown_ns)).ok_or_else(|| {
            row.bad(
                column,
                format!("{number} is more than 292 years"),
                "give the time in seconds, from any zero within 292 years",
            )
        })
    }
}

/// The beginning of 1970 as a FILETIME, in 100 ns since 1601.
const FILETIME_1970: i64 = 116_444_736_000_000_000;
/// Formats of date and time of day without a zone: with `T`, with a blank, as in TwinCAT, and with the day first. In dates
/// with points the day is always first. Dates with slashes are refused, because their order differs between countries.
const DATES: [&str; 4] =
    ["%Y-%m-%dT%H:%M:%S%.f", "%Y-%m-%d %H:%M:%S%.f", "%Y-%m-%d-%H:%M:%S%.f", "%d.%m.%Y %H:%M:%S%.f"];

fn date_ns(row: &CsvRow<'_>, column: &CsvColumn) -> Result<i64, LogError> {
    let text = row.text(column);
    let plain = text.strip_prefix("DT#").unwrap_or(text).replace(',', ".");
    let with_zone = DateTime::parse_from_rfc3339(&plain).map(|date| date.to_utc());
    let date = with_zone.ok().or_else(|| {
        let dates = DATES.iter().map(|format| NaiveDateTime::parse_from_str(&plain, format));
        dates.flatten().next().map(|date| date.and_utc())
    });
    date.and_then(|date| date.timestamp_nanos_opt()).ok_or_else(|| {
        row.bad(
            column,
            format!("`{text}` is not a date and time of the years 1678 to 2262"),
            "write it as 2026-11-22T10:15:00.25Z, or name its unit in a mapping",
        )
    })
}

/// Converts seconds as `[-]digits[.digits]`, with decimal point or comma, to ns. Digits beyond nanoseconds are
/// rounded. `None` for other notations.
fn decimal_to_ns(text: &str) -> Option<i64> {
    let (negative, digits) = match text.strip_prefix('-') {
        Some(rest) => (true, rest),
        None => (false, text.strip_prefix('+').unwrap_or(text)),
    };
    let (whole, fraction) = digits.split_once(['.', ',']).unwrap_or((digits, ""));
    if !whole.bytes().chain(fraction.bytes()).all(|byte| byte.is_ascii_digit()) {
        return None;
    }
    let whole: i64 = if whole.is_empty() { 0 } else { whole.parse().ok()? };
    let digit = |index: usize| fraction.as_bytes().get(index).map_or(0, |byte| i64::from(byte - b'0'));
    let rounding = i64::from(digit(9) >= 5);
    let fraction_ns = (0..9).fold(0, |ns, index| ns * 10 + digit(index)) + rounding;
    let ns = whole.checked_mul(1_000_000_000)?.checked_add(fraction_ns)?;
    Some(if negative { -ns } else { ns })
}
