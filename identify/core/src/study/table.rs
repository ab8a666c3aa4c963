//! Writes the results of a study as tables, `points.csv` and `points.parquet`. Each row contains the errors of one estimator
//! in one experiment. Both files have the same columns: first integers, then texts, then floating-point numbers.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use parquet::data_type::{ByteArray, ByteArrayType, DoubleType, Int64Type};
use parquet::file::properties::WriterProperties;
use parquet::file::writer::SerializedFileWriter;
use parquet::schema::parser::parse_message_type;

use super::results::{PlacedRow, refused};
use super::{Definition, ResultRow, Results, ResultsError, Trial};

/// Number of text columns. The next constant, `NUMBERS`, is the number of floating-point columns.
const TEXTS: usize = 4;
const NUMBERS: usize = 5;

impl PlacedRow<'_> {
    const WHOLE: [&'static str; 2] = ["trial", "seed"];
    const TEXT: [&'static str; TEXTS] = ["figure", "series", "estimator", "failed"];
    const NUMBER: [&'static str; NUMBERS] =
        ["x", "euclidean_mm_mrad", "largest_mm_mrad", "position_mm", "position_p95_mm"];

    fn wholes(&self) -> [i64; 2] {
        [self.trial.number as i64, i64::from(self.trial.seed)]
    }

    fn texts(&self) -> [&str; TEXTS] {
        let Trial { figure, series, .. } = self.trial;
        [&figure.id, &series.name, self.estimator, self.row.failed.as_deref().unwrap_or_default()]
    }

    fn numbers(&self) -> [Option<f64>; NUMBERS] {
        let ResultRow { euclidean_mm_mrad, largest_mm_mrad, position_mm, position_p95_mm, .. } = self.row;
        [Some(self.trial.x), *euclidean_mm_mrad, *largest_mm_mrad, *position_mm, *position_p95_mm]
    }
}

/// Writes `points.csv`.
///
/// # Errors
/// [`ResultsError`].
pub fn write_csv(
    directory: &Path,
    definition: &Definition,
    results: &Results,
) -> Result<PathBuf, ResultsError> {
    let path = directory.join("points.csv");
    let mut writer = csv::Writer::from_path(&path)?;
    writer.write_record(PlacedRow::WHOLE.iter().chain(&PlacedRow::TEXT).chain(&PlacedRow::NUMBER))?;
    for placed in results.placed(definition) {
        let wholes = placed.wholes().into_iter().map(|whole| whole.to_string());
        let texts = placed.texts().into_iter().map(str::to_owned);
        let numbers =
            placed.numbers().into_iter().map(|number| number.map_or_else(String::new, |x| x.to_string()));
        writer.write_record(wholes.chain(texts).chain(numbers))?;
    }
    writer.flush().map_err(refused(&path))?;
    Ok(path)
}

/// Writes `points.parquet`, with the same columns as `points.csv`.
///
/// # Errors
/// [`ResultsError`].
pub fn write_parquet(
    directory: &Path,
    definition: &Definition,
    results: &Results,
) -> Result<PathBuf, ResultsError> {
    let path = directory.join("points.parquet");
    let rows: Vec<PlacedRow<'_>> = results.placed(definition).collect();
    let columns: String = (PlacedRow::WHOLE.iter().map(|name| format!("required int64 {name};")))
        .chain(PlacedRow::TEXT.iter().map(|name| format!("required binary {name} (UTF8);")))
        .chain(PlacedRow::NUMBER.iter().map(|name| format!("optional double {name};")))
        .collect();
    let schema = Arc::new(parse_message_type(&format!("message study {{ {columns} }}"))?);
    let file = File::create(&path).map_err(refused(&path))?;
    let mut writer = SerializedFileWriter::new(file, schema, Arc::new(WriterProperties::default()))?;
    let mut group = writer.next_row_group()?;
    let mut index = 0;
    while let Some(mut column) = group.next_column()? {
        if index < PlacedRow::WHOLE.len() {
            let values: Vec<i64> = rows.iter().map(|row| row.wholes()[index]).collect();
            column.typed::<Int64Type>().write_batch(&values, None, None)?;
        } else if index < PlacedRow::WHOLE.len() + TEXTS {
            let text = index - PlacedRow::WHOLE.len();
            let values: Vec<ByteArray> = rows.iter().map(|row| ByteArray::from(row.texts()[text])).collect();
            column.typed::<ByteArrayType>().write_batch(&values, None, None)?;
        } else {
            let number = index - PlacedRow::WHOLE.len() - TEXTS;
            let values: Vec<Option<f64>> = rows.iter().map(|row| row.numbers()[number]).collect();
            // The definition level of an optional value in Parquet is 1 if the value is present, else 0.
            let levels: Vec<i16> = values.iter().map(|value| i16::from(value.is_some())).collect();
            let values: Vec<f64> = values.into_iter().flatten().collect();
            column.typed::<DoubleType>().write_batch(&values, Some(&levels), None)?;
        }
        column.close()?;
        index += 1;
    }
    group.close()?;
    writer.close()?;
    Ok(path)
}
