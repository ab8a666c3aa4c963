//! Finds the column of the time stamps, and its unit.

use super::Notes;
use super::columns::TableColumn;
use crate::logs::{TimeColumn, TimeUnit};
use crate::statistics::median;

/// Words in the name of a column with time stamps.
const TIMES: &str = "t time timestamp stamp zeit clock ipoc utc date datetime tick ticks";

/// Units that a header may state, from the largest to the smallest.
const UNITS: [TimeUnit; 4] = [TimeUnit::S, TimeUnit::Ms, TimeUnit::Us, TimeUnit::Ns];

/// Unit of the times according to the header.
fn stated_unit(column: &TableColumn) -> Option<TimeUnit> {
    UNITS.into_iter().find(|unit| column.unit == Some(unit.name()))
}

/// Whether a number is a date such as `20161122101500`: year, month, day, hours, minutes and seconds, written as one number.
fn is_date_in_digits(number: f64) -> bool {
    let part = |divisor: f64, most: f64| (number / divisor).floor() % most;
    let [year, month, day] = [part(1e10, 1e4), part(1e8, 100.0), part(1e6, 100.0)];
    let time = [part(1e4, 100.0), part(1e2, 100.0), part(1.0, 100.0)];
    number.fract() == 0.0
        && number < 1e14
        && (1980.0..2100.0).contains(&year)
        && (1.0..=12.0).contains(&month)
        && (1.0..=31.0).contains(&day)
        && time.iter().zip([24.0, 60.0, 61.0]).all(|(part, most)| *part < most)
}

/// The column of the time stamps with its unit; `None` if no column is suitable.
pub(super) fn time(columns: &[&TableColumn], notes: &mut Notes) -> Option<TimeColumn> {
    /// Windows FILETIME (number of 100 ns intervals since 1601) of the years 1980 to 2100.
    const FILETIME: std::ops::Range<f64> = 1.19e17..1.58e17;
    let dated = columns.iter().find(|column| column.is_date && column.has_word(TIMES));
    if let Some(column) = dated.or_else(|| columns.iter().find(|column| column.is_date)) {
        notes.reason(format!("`{}` has dates", column.name));
        return Some(TimeColumn::new(&column.name, TimeUnit::DateTime));
    }
    let rising: Vec<&&TableColumn> =
        columns.iter().filter(|column| column.is_number() && column.rises()).collect();
    let with_unit = rising.iter().find(|column| stated_unit(column).is_some());
    let with_name = rising.iter().find(|column| column.has_word(TIMES));
    let column = with_unit.or(with_name)?;
    let mut steps: Vec<f64> =
        column.numbers.windows(2).map(|pair| pair[1] - pair[0]).filter(|step| *step > 0.0).collect();
    let step = median(&mut steps)?;
    if column.numbers.iter().all(|number| is_date_in_digits(*number)) {
        notes.reason(format!("`{}` has dates (YYYYMMDDhhmmss), too coarse for times of rows", column.name));
        return None;
    }
    let stated = stated_unit(column);
    let (unit, why) = match stated {
        Some(unit) => (unit, "from the header".to_owned()),
        _ if FILETIME.contains(&column.numbers[0]) => (TimeUnit::Filetime, "by its size".into()),
        // Robots log at 1 Hz to 1 kHz, so stamps are 1 ms to 1 s apart. A step between about 1 and 1000 is therefore in
        // milliseconds, a step between about 1000 and a million in microseconds.
        _ if step < 0.9 => (TimeUnit::S, format!("stamps are {step:.4} apart")),
        _ if step < 900.0 => (TimeUnit::Ms, format!("stamps are {step:.1} apart")),
        _ if step < 9e5 => (TimeUnit::Us, format!("stamps are {step:.0} apart")),
        _ => (TimeUnit::Ns, format!("stamps are {step:.0} apart")),
    };
    notes.reason(format!("`{}` is the time in {}: {why}", column.name, unit.name()));
    // A slower log in the next larger unit can have the same steps.
    let larger = UNITS.windows(2).find(|pair| pair[1] == unit).map(|pair| pair[0]);
    if let Some(larger) = larger.filter(|_| stated.is_none()) {
        notes.doubt(format!(
            "`{}` has no unit: {} is taken, because robots log faster than 1 Hz; if it is in {}, correct `unit` of [time]",
            column.name,
            unit.name(),
            larger.name()
        ));
    }
    Some(TimeColumn::new(&column.name, unit))
}
