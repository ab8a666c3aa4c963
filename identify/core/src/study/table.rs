//! Every experiment as a row of `points.csv` and `points.parquet`.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use parquet::data_type::{ByteArray, ByteArrayType, DoubleType, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::SerializedFileWriter;
use parquet::schema::parser::parse_message_type;

use super::{Definition, Results, Row, trials};

/// Why a table cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum TableError {
    /// The system refused.
    #[error("cannot write {}: {source}; check the directory and free space", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// As CSV.
    #[error("the table cannot be written as CSV: {0}")]
    Csv(#[from] csv::Error),
    /// As Parquet.
    #[error("the table cannot be written as Parquet: {0}")]
    Parquet(#[from] ParquetError),
}

/// One estimate with where it belongs.
struct Line<'a> {
    trial: usize,
    figure: &'a str,
    series: &'a str,
    x: f64,
    seed: u32,
    estimator: &'a str,
    row: &'a Row,
}

const TEXTS: usize = 4;
const NUMBERS: usize = 5;

impl<'a> Line<'a> {
    const WHOLE: [&'static str; 2] = ["trial", "seed"];
    const TEXT: [&'static str; TEXTS] = ["figure", "series", "estimator", "failed"];
    const NUMBER: [&'static str; NUMBERS] =
        ["x", "euclidean_mm_mrad", "largest_mm_mrad", "position_mm", "position_p95_mm"];

    fn all(definition: &'a Definition, results: &'a Results) -> Vec<Self> {
        let study = &definition.study;
        let mut lines = Vec::new();
        for trial in trials(definition) {
            let Some(rows) = results.done().get(&trial.number) else { continue };
            for (estimator, row) in study.estimators_of(trial.figure, trial.series).iter().zip(&rows.rows) {
                lines.push(Self {
                    trial: trial.number,
                    figure: &trial.figure.id,
                    series: &trial.series.name,
                    x: trial.x,
                    seed: trial.seed,
                    estimator,
                    row,
                });
            }
        }
        lines
    }

    fn wholes(&self) -> [i64; 2] {
        [self.trial as i64, i64::from(self.seed)]
    }

    fn texts(&self) -> [&str; TEXTS] {
        [self.figure, self.series, self.estimator, self.row.failed.as_deref().unwrap_or_default()]
    }

    fn numbers(&self) -> [Option<f64>; NUMBERS] {
        let Row { euclidean_mm_mrad, largest_mm_mrad, position_mm, position_p95_mm, .. } = self.row;
        [Some(self.x), *euclidean_mm_mrad, *largest_mm_mrad, *position_mm, *position_p95_mm]
    }
}

/// Writes `points.csv`.
///
/// # Errors
/// [`TableError`].
pub fn write_csv(
    directory: &Path,
    definition: &Definition,
    results: &Results,
) -> Result<PathBuf, TableError> {
    let path = directory.join("points.csv");
    let mut writer = csv::Writer::from_path(&path)?;
    writer.write_record(Line::WHOLE.iter().chain(&Line::TEXT).chain(&Line::NUMBER))?;
    for line in Line::all(definition, results) {
        let wholes = line.wholes().into_iter().map(|whole| whole.to_string());
        let texts = line.texts().into_iter().map(str::to_owned);
        let numbers =
            line.numbers().into_iter().map(|number| number.map_or_else(String::new, |x| x.to_string()));
        writer.write_record(wholes.chain(texts).chain(numbers))?;
    }
    writer.flush().map_err(|source| TableError::Io { path: path.clone(), source })?;
    Ok(path)
}

/// Writes `points.parquet`, the same columns.
///
/// # Errors
/// [`TableError`].
pub fn write_parquet(
    directory: &Path,
    definition: &Definition,
    results: &Results,
) -> Result<PathBuf, TableError> {
    let path = directory.join("points.parquet");
    let lines = Line::all(definition, results);
    let column = |kind: &str, name: &&str| format!("{kind} {name};");
    let columns: String = (Line::WHOLE.iter().map(|name| column("required int64", name)))
        .chain(Line::TEXT.iter().map(|name| column("required binary", name).replace(';', " (UTF8);")))
        .chain(Line::NUMBER.iter().map(|name| column("optional double", name)))
        .collect();
    let schema = Arc::new(parse_message_type(&format!("message study {{ {columns} }}"))?);
    let file = File::create(&path).map_err(|source| TableError::Io { path: path.clone(), source })?;
    let mut writer = SerializedFileWriter::new(file, schema, Arc::new(WriterProperties::default()))?;
    let mut group = writer.next_row_group()?;
    let mut at = 0;
    while let Some(mut column) = group.next_column()? {
        if at < Line::WHOLE.len() {
            let values: Vec<i64> = lines.iter().map(|line| line.wholes()[at]).collect();
            column.typed::<Int64Type>().write_batch(&values, None, None)?;
        } else if at < Line::WHOLE.len() + TEXTS {
            let text = at - Line::WHOLE.len();
            let values: Vec<ByteArray> =
                lines.iter().map(|line| ByteArray::from(line.texts()[text])).collect();
            column.typed::<ByteArrayType>().write_batch(&values, None, None)?;
        } else {
            let number = at - Line::WHOLE.len() - TEXTS;
            let values: Vec<Option<f64>> = lines.iter().map(|line| line.numbers()[number]).collect();
            let there: Vec<i16> = values.iter().map(|value| i16::from(value.is_some())).collect();
            let values: Vec<f64> = values.into_iter().flatten().collect();
            column.typed::<DoubleType>().write_batch(&values, Some(&there), None)?;
        }
        column.close()?;
        at += 1;
    }
    group.close()?;
    writer.close()?;
    Ok(path)
}
