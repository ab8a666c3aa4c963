//! Time stamps of text tables, in whatever unit, to integer ns.

use chrono::{DateTime, NaiveDateTime};

use super::csv_text::{Column, Row, Table};
use crate::logs::LogError;
use crate::logs::robot::mapping::TimeUnit;

/// 1970 in FILETIME, 100 ns since 1601.
const FILETIME_1970: i64 = 116_444_736_000_000_000;
/// Ways to write date and time of day beside RFC 3339: with a blank, and as TwinCAT does.
const DATES: [&str; 3] = ["%Y-%m-%dT%H:%M:%S%.f", "%Y-%m-%d %H:%M:%S%.f", "%Y-%m-%d-%H:%M:%S%.f"];

/// The stamp of a row to integer ns. Decimal digits are taken as they are: a UTC stamp in seconds has more of them than an
/// `f64` can hold.
pub(in crate::logs) fn stamp_ns(
    table: &Table<'_>,
    row: &Row,
    column: &Column,
    unit: TimeUnit,
) -> Result<i64, LogError> {
    if unit == TimeUnit::DateTime {
        return date_ns(table, row, column);
    }
    let number = table.number(row, column)?;
    let text = table.text(row, column).replace(',', ".");
    let zero = if unit == TimeUnit::Filetime { FILETIME_1970 } else { 0 };
    let exact = match unit {
        TimeUnit::S => decimal_to_ns(&text),
        unit => text.parse::<i64>().ok().and_then(|ticks| ticks.checked_sub(zero)?.checked_mul(unit.ns())),
    };
    let rounded = || {
        let ns = ((number - zero as f64) * unit.ns() as f64).round();
        (ns.abs() < i64::MAX as f64).then_some(ns as i64)
    };
    exact.or_else(rounded).ok_or_else(|| {
        table.bad(
            row,
            column,
            format!("{number} is more than 292 years"),
            "give the time in seconds, from any zero within 292 years",
        )
    })
}

fn date_ns(table: &Table<'_>, row: &Row, column: &Column) -> Result<i64, LogError> {
    let text = table.text(row, column);
    let plain = text.strip_prefix("DT#").unwrap_or(text).replace(',', ".");
    let with_zone = DateTime::parse_from_rfc3339(&plain).map(|date| date.to_utc());
    let date = with_zone.ok().or_else(|| {
        let dates = DATES.iter().map(|format| NaiveDateTime::parse_from_str(&plain, format));
        dates.flatten().next().map(|date| date.and_utc())
    });
    date.and_then(|date| date.timestamp_nanos_opt()).ok_or_else(|| {
        table.bad(
            row,
            column,
            format!("`{text}` is no date and time of the years 1678 to 2262"),
            "write it as 2026-11-22T10:15:00.25Z, or say with a mapping what it is",
        )
    })
}

/// `[-]digits[.digits]` in seconds to ns, exactly up to ns and rounded below; none for other notations.
fn decimal_to_ns(text: &str) -> Option<i64> {
    let (negative, digits) = match text.strip_prefix('-') {
        Some(rest) => (true, rest),
        None => (false, text.strip_prefix('+').unwrap_or(text)),
    };
    let (whole, fraction) = digits.split_once('.').unwrap_or((digits, ""));
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
