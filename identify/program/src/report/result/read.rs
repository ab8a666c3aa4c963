//! Reads `calibration.json` or `calibration.toml` into a [`CalibrationFile`]. Files of schema 1 are converted to the current
//! schema. Files with numbers that are out of range are refused.

use std::path::{Path, PathBuf};

use serde_json::{Map, Value};

use super::file::{CalibrationFile, SCHEMA};

/// Largest absolute value of a parameter, and largest sigma, in SI units. Larger numbers occur in damaged files only, and
/// computations with them would overflow.
const NUMBER_MAX: f64 = 1e12;
/// Smallest sigma above zero. Smaller numbers occur in damaged files only, and computations with them would overflow.
const SIGMA_MIN: f64 = 1e-30;

/// Reason why a calibration file cannot be read.
#[derive(Debug, thiserror::Error)]
#[error("{}: {kind}", path.display())]
pub struct CalibrationReadError {
    path: PathBuf,
    kind: ReadProblem,
}

#[derive(Debug, thiserror::Error)]
enum ReadProblem {
    #[error("cannot be read: {0}; check the path and its permissions")]
    Io(#[from] std::io::Error),
    #[error("is not a calibration: {0}; give the file that `identify calibrate` wrote, or its directory")]
    Json(#[from] serde_json::Error),
    #[error("is not a calibration: {0}; give the file that `identify calibrate` wrote, or its directory")]
    Toml(#[from] toml::de::Error),
    #[error("has schema {found}, this program knows {SCHEMA}; use the program that wrote it")]
    Schema { found: u64 },
    #[error(
        "has {value:e} for parameter `{name}`, which is out of range; it was damaged or edited, calibrate again"
    )]
    Number { name: String, value: f64 },
}

impl CalibrationFile {
    /// Reads `calibration.json` or `calibration.toml`. If `path` is a directory, reads the `calibration.json` in it.
    ///
    /// # Errors
    /// [`CalibrationReadError`], which names the file.
    pub fn open(path: &Path) -> Result<Self, CalibrationReadError> {
        let path = if path.is_dir() { path.join("calibration.json") } else { path.to_owned() };
        let text = std::fs::read_to_string(&path)
            .map_err(|source| CalibrationReadError { path: path.clone(), kind: source.into() })?;
        Self::parse(&text, &path)
    }

    /// As [`Self::open`], for text in memory. The file name extension of `path` selects the format.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn parse(text: &str, path: &Path) -> Result<Self, CalibrationReadError> {
        Self::checked(text, path).map_err(|kind| CalibrationReadError { path: path.to_owned(), kind })
    }

    fn checked(text: &str, path: &Path) -> Result<Self, ReadProblem> {
        let is_toml = path.extension().is_some_and(|ending| ending == "toml");
        let values: Map<String, Value> =
            if is_toml { toml::from_str(text)? } else { serde_json::from_str(text)? };
        let file: Self = match values.get("schema").and_then(Value::as_u64) {
            Some(1) => serde_json::from_value(upgraded_from_schema_1(values))?,
            Some(found) if found != u64::from(SCHEMA) => return Err(ReadProblem::Schema { found }),
            // The text is parsed again, because TOML has infinite numbers and a JSON `Value` has not.
            _ if is_toml => toml::from_str(text)?,
            _ => serde_json::from_value(values.into())?,
        };
        for entry in &file.parameters {
            let is_valid_sigma = |sigma: f64| sigma == 0.0 || (SIGMA_MIN..=NUMBER_MAX).contains(&sigma);
            let numbers = [entry.nominal, entry.value, entry.correction];
            let invalid = numbers.into_iter().find(|number| !(-NUMBER_MAX..=NUMBER_MAX).contains(number));
            if let Some(value) = invalid.or_else(|| entry.sigma.filter(|sigma| !is_valid_sigma(*sigma))) {
                return Err(ReadProblem::Number { name: entry.name.clone(), value });
            }
        }
        Ok(file)
    }
}

/// Converts a file of schema 1 to [`SCHEMA`]. Schema 1 had the first clock and the first force under keys of their own. Its
/// earliest files had no data set numbers and no instrument names.
fn upgraded_from_schema_1(mut file: Map<String, Value>) -> Value {
    file.insert("schema".into(), SCHEMA.into());
    for (first, others, all) in [("clock", "other_clocks", "clocks"), ("force", "other_forces", "forces")] {
        let mut entries: Vec<Value> =
            file.remove(first).filter(|entry| !entry.is_null()).into_iter().collect();
        if let Some(Value::Array(others)) = file.remove(others) {
            entries.extend(others);
        }
        let number = if all == "clocks" { "data_set" } else { "run" };
        for entry in entries.iter_mut().filter_map(Value::as_object_mut) {
            entry.entry(number).or_insert(1.into());
            if all == "clocks" {
                entry.entry("instrument").or_insert("ball-bar".into());
            }
            if let Some(difference) = entry.remove("robot_minus_bar_ns") {
                entry.insert("robot_minus_instrument_ns".into(), difference);
            }
        }
        file.insert(all.into(), entries.into());
    }
    file.into()
}
