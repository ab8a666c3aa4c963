//! Reads the encoders of the bar from a text table. Its columns have the names that `ballbard export --csv` writes,
//! or a mapping names them.

use std::path::Path;

use shared::config::BallBarConfig;
use shared::recording::schema::{MAX_ENCODERS, flags};

use super::mapping::{BarLogMapping, EncoderColumn, EncoderUnit};
use super::samples::{BarLogKind, EncoderReader, RawBarLog, RawBarRow};
use super::{LogError, OtherBarLog};
use crate::kinematics::BAR_JOINTS;
use crate::logs::source::LogSource;
use crate::logs::tables::csv_text::{CsvColumn, CsvRow, CsvTable};
use crate::logs::tables::stamp::{StampColumn, TimeColumn, TimeUnit};
use crate::logs::tables::text::Text;
use crate::logs::{CsvLayout, SIMULATED};

/// Names of the time column that are known without a mapping, each with its unit.
const TIMES: [(&str, TimeUnit); 2] = [("time_utc", TimeUnit::DateTime), ("t_s", TimeUnit::S)];
/// Names of an encoder's column that are known without a mapping: the text before and after the number of the
/// joint, and the unit.
const VALUES: [(&str, &str, EncoderUnit); 3] = [
    ("count", "", EncoderUnit::Counts),
    ("angle", "_rad", EncoderUnit::Rad),
    ("angle", "_deg", EncoderUnit::Deg),
];
/// What the user can do if a column is missing in a table without a mapping.
const REMEDY: &str = "Name the columns as `ballbard export --csv` does (`time_utc` or `t_s`, `count1` to `count5`), or \
                      assign them in a mapping (--recording-mapping).";

/// The columns of one encoder.
struct Encoder {
    value: CsvColumn,
    valid: Option<CsvColumn>,
    reading: EncoderReader,
}

/// The columns of a table that are read.
struct BarTableLayout {
    time: StampColumn,
    encoders: Vec<Encoder>,
    /// Column with the flags of the cycle, as written by `ballbard export`.
    flags: Option<CsvColumn>,
    /// Column with events, as written by `ballbard export`.
    events: Option<CsvColumn>,
}

/// Reads the encoders of the bar from a table.
pub(super) fn read(
    source: LogSource<'_>,
    bar: &BallBarConfig,
    mapping: Option<&BarLogMapping>,
) -> Result<OtherBarLog, LogError> {
    let path = source.path;
    let mut table = CsvTable::open(source, mapping.map_or(&CsvLayout::default(), |mapping| &mapping.csv))?;
    let mut layout = match mapping {
        Some(mapping) => {
            let time = TimeColumn::of_table(mapping.time.as_ref(), path)?;
            let remedy = "Correct the name in the mapping file.";
            BarTableLayout::find(&table, path, bar, time, &mapping.encoders, mapping.wraps_at, remedy)?
        }
        None => usual_layout(&table, path, bar)?,
    };
    let kind = BarLogKind {
        name: if layout.flags.is_some() { "table of `ballbard export`" } else { "table" },
        row: "line",
        has_validity: layout.encoders.iter().all(|encoder| encoder.valid.is_some()),
        has_origins: layout.flags.is_some(),
        is_dated: layout.time.is_dated(),
    };
    let readings = layout.encoders.iter().map(|encoder| encoder.reading).collect();
    let mut raw = RawBarLog::new(path, kind, readings);
    let mut simulated = false;
    while let Some(row) = table.next_row()? {
        raw.push(layout.read(&row)?)?;
        let event = layout.events.as_ref().map(|events| row.text(events));
        simulated |= event.is_some_and(|event| event.starts_with(SIMULATED));
    }
    let declared = table.comment("clock").map(str::to_owned);
    let clock = mapping.and_then(|mapping| mapping.clock.clone()).or(declared);
    let log = raw.finish(clock.unwrap_or_else(|| layout.time.column.name.clone()))?;
    Ok(OtherBarLog { simulated, ..log })
}

impl OtherBarLog {
    /// Whether a text has columns with the usual names of the bar's encoders, so that it is not a robot's log.
    pub fn is_usual_table(bytes: &[u8]) -> bool {
        let text = Text::new(LogSource::in_memory(bytes, Path::new("")), None);
        let Ok(mut text) = text else { return false };
        let header = text.header_line().unwrap_or_default();
        let mut cells = header.split([',', ';', '\t']).map(|cell| cell.trim().trim_matches('"'));
        cells.any(|cell| (1..=BAR_JOINTS).flat_map(usual_names).any(|(name, _)| name == cell))
    }
}

/// The usual names of the column of a joint's encoder, each with its unit. If a table has both counts and angles of a joint,
/// the counts are read, because they are first in this list.
fn usual_names(joint: usize) -> [(String, EncoderUnit); 3] {
    VALUES.map(|(before, after, unit)| (format!("{before}{joint}{after}"), unit))
}

/// The layout of a table without a mapping, whose columns have the usual names. The encoders are in the order of the columns.
fn usual_layout(table: &CsvTable<'_>, path: &Path, bar: &BallBarConfig) -> Result<BarTableLayout, LogError> {
    let (time, unit) =
        TIMES.into_iter().find(|(name, _)| table.has(name)).unwrap_or(("time_utc", TimeUnit::DateTime));
    let mut columns = Vec::new();
    for joint in 1..=BAR_JOINTS {
        let names = usual_names(joint);
        let configured = bar.encoders.iter().any(|encoder| usize::from(encoder.joint) == joint);
        let Some((name, unit)) = names.iter().find(|(name, _)| table.has(name)) else {
            if configured {
                let remedy = format!(
                    "The bar's configuration has an encoder on joint {joint}; take its [[encoders]] block out if it \
                     was not mounted. {REMEDY}"
                );
                // The column does not exist, so this returns the error that names it.
                table.column(&names[0].0, &remedy)?;
            }
            continue;
        };
        let valid = Some(format!("valid{joint}")).filter(|name| table.has(name));
        columns.push(EncoderColumn { joint: joint as u8, column: name.clone(), unit: Some(*unit), valid });
    }
    let wraps_at = BarLogMapping::wraps_at_of(None);
    let time = TimeColumn::new(time, unit);
    let mut layout = BarTableLayout::find(table, path, bar, &time, &columns, wraps_at, REMEDY)?;
    layout.encoders.sort_by_key(|encoder| encoder.value.index);
    let if_there = |name: &str| table.has(name).then(|| table.column(name, REMEDY)).transpose();
    (layout.flags, layout.events) = (if_there("flags")?, if_there("event")?);
    Ok(layout)
}

impl BarTableLayout {
    /// Finds the columns of the stamps and of the encoders.
    fn find(
        table: &CsvTable<'_>,
        path: &Path,
        bar: &BallBarConfig,
        time: &TimeColumn,
        columns: &[EncoderColumn],
        wraps_at: u64,
        remedy: &str,
    ) -> Result<Self, LogError> {
        let encoder = |EncoderColumn { joint, column, unit, valid }: &EncoderColumn| {
            let unit = unit.unwrap_or(EncoderUnit::Counts);
            Ok(Encoder {
                value: table.column(column, remedy)?,
                valid: table.if_named(valid.as_ref(), remedy)?,
                reading: EncoderReader::new(*joint, unit, wraps_at, bar, (path, column))?,
            })
        };
        let time = StampColumn::find(table, time, remedy)?;
        let encoders = columns.iter().map(encoder).collect::<Result<_, LogError>>()?;
        Ok(Self { time, encoders, flags: None, events: None })
    }

    /// Reads the columns of the next row.
    fn read(&mut self, row: &CsvRow<'_>) -> Result<RawBarRow, LogError> {
        let mut read = RawBarRow {
            place: row.line,
            stamp_ns: self.time.next_ns(row)?,
            valid: [true; MAX_ENCODERS],
            ..RawBarRow::default()
        };
        let slots = read.counts.iter_mut().zip(&mut read.valid);
        for (encoder, (count, valid)) in self.encoders.iter().zip(slots) {
            *count = encoder.count(row)?;
            if let Some(column) = &encoder.valid {
                *valid = is_true(row, column)?;
            }
        }
        if let Some(column) = &self.flags {
            read.flags = flags_of(row, column)?;
        }
        Ok(read)
    }
}

impl Encoder {
    /// The value of the encoder in this row as a count; `None` for an empty cell and for NaN.
    fn count(&self, row: &CsvRow<'_>) -> Result<Option<i64>, LogError> {
        let text = row.text(&self.value);
        if text.is_empty() || text.eq_ignore_ascii_case("nan") {
            return Ok(None);
        }
        if self.reading.is_counts() {
            return self.whole_number(row, text).map(Some);
        }
        let value = row.number(&self.value)?;
        let count = self.reading.count_of_angle(value).ok_or_else(|| {
            let problem = format!("{value} is not an angle of a bar");
            row.bad(&self.value, problem, "check the unit of the column")
        })?;
        Ok(Some(count))
    }

    /// Reads a whole number, which may be written with an exponent or a decimal point.
    fn whole_number(&self, row: &CsvRow<'_>, text: &str) -> Result<i64, LogError> {
        if let Ok(count) = text.parse::<i64>() {
            return Ok(count);
        }
        // Spreadsheets write whole numbers as `1.5E+09`, PLCs as `1500000000.0`.
        let value = row.number(&self.value)?;
        let exact = value.fract() == 0.0 && value.abs() < (1_i64 << f64::MANTISSA_DIGITS) as f64;
        exact.then_some(value as i64).ok_or_else(|| {
            let problem = format!("`{text}` is not a whole number of counts");
            row.bad(&self.value, problem, "if the column has angles, give their unit in a mapping file")
        })
    }
}

fn is_true(row: &CsvRow<'_>, column: &CsvColumn) -> Result<bool, LogError> {
    match row.text(column).to_lowercase().as_str() {
        "1" | "true" => Ok(true),
        "0" | "false" | "" => Ok(false),
        other => {
            let problem = format!("`{other}` is neither true nor false");
            Err(row.bad(column, problem, "write 1 or 0, true or false"))
        }
    }
}

/// The bits of the flags in a cell. The cell contains their names separated by blanks, as written by `ballbard export`.
fn flags_of(row: &CsvRow<'_>, column: &CsvColumn) -> Result<u32, LogError> {
    let mut bits = 0;
    for word in row.text(column).split_whitespace() {
        let known = flags::NAMES.iter().find(|(_, name)| *name == word);
        bits |= known.map(|(bit, _)| *bit).ok_or_else(|| {
            let problem = format!("`{word}` is not a flag of a recording");
            row.bad(column, problem, "rename the column if it is not that of `ballbard export`")
        })?;
    }
    Ok(bits)
}
