//! Reads, writes and merges the file `trials.jsonl`. Its first line is the study's definition. Each further line contains
//! the results of one experiment ([`TrialRows`]), in any order.
//!
//! While a study runs, lines are only appended, so a process that is killed loses at most the line that it is
//! writing. At the end the lines are sorted by number. The final file therefore does not depend on which
//! machines computed the experiments.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{self, BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use parquet::errors::ParquetError;
use serde::{Deserialize, Serialize};

use super::{Definition, Measure, Trial, trials};

/// Name of the file in a study's directory.
const NAME: &str = "trials.jsonl";

/// Why results cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum ResultsError {
    /// Error of the operating system.
    #[error("cannot use {}: {source}; check the directory and free space", path.display())]
    Io {
        /// Path of the file.
        path: PathBuf,
        /// Text of the system's error.
        source: io::Error,
    },
    /// A line of the file is not valid.
    #[error("{}, line {line}: {reason}; move the file away, or give another --out", path.display())]
    Malformed {
        /// Path of the file.
        path: PathBuf,
        /// Number of the line, from 1.
        line: usize,
        /// Why it cannot be read.
        reason: String,
    },
    /// The file contains the results of another study, or of another version of the program.
    #[error("{} has the results of another study or version of this program; give another --out", path.display())]
    OtherStudy {
        /// Path of the file.
        path: PathBuf,
    },
    /// Experiments of some shards are missing.
    #[error(
        "{missing} of {wanted} experiments are missing, the first is number {first}; merge all shards, and let each end first"
    )]
    Missing {
        /// Number of missing experiments.
        missing: usize,
        /// Number of all experiments.
        wanted: usize,
        /// Number of the first missing experiment.
        first: usize,
    },
    /// No directories were given to merge.
    #[error("no shard was given; name the directories of all")]
    NoShard,
    /// A result cannot be written as JSON.
    #[error("a result cannot be written as JSON: {0}")]
    Json(#[from] serde_json::Error),
    /// A table cannot be written as CSV.
    #[error("the table cannot be written as CSV: {0}; check the directory of --out and free space")]
    Csv(#[from] csv::Error),
    /// A table cannot be written as Parquet.
    #[error("the table cannot be written as Parquet: {0}; check the directory of --out and free space")]
    Parquet(#[from] ParquetError),
}

/// Converts an error of the operating system for the file `path`.
pub(super) fn refused(path: &Path) -> impl Fn(io::Error) -> ResultsError + Copy {
    move |source| ResultsError::Io { path: path.to_owned(), source }
}

/// Errors of one estimator in one experiment. An error is `None` if it was not computed.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ResultRow {
    /// Euclidean norm of the errors of the thesis' parameters \[mm|mrad\].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub euclidean_mm_mrad: Option<f64>,
    /// Largest error of the thesis' parameters \[mm|mrad\].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub largest_mm_mrad: Option<f64>,
    /// Mean position error of the robot's end over all postures \[mm\].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub position_mm: Option<f64>,
    /// 95 % quantile of the position error over all postures \[mm\].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub position_p95_mm: Option<f64>,
    /// Error of each parameter \[mm|mrad\]; empty if the figure shows only curves.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub errors: BTreeMap<String, f64>,
    /// Why the estimate is missing; `None` if the estimator succeeded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub failed: Option<String>,
}

impl ResultRow {
    /// A row without an estimate, with this reason.
    pub fn failed(reason: String) -> Self {
        Self { failed: Some(reason), ..Self::default() }
    }

    /// The error in terms of `measure`.
    pub const fn error(&self, measure: Measure) -> Option<f64> {
        match measure {
            Measure::Euclidean => self.euclidean_mm_mrad,
            Measure::Largest => self.largest_mm_mrad,
            Measure::Position => self.position_mm,
        }
    }
}

/// Results of all estimators in one experiment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrialRows {
    /// The experiment's number.
    pub trial: usize,
    /// One row for each estimator, in the order of the figure's or series' list.
    pub rows: Vec<ResultRow>,
}

/// One of `count` shards of a study. The shards divide the experiments: shard `number` (from 1)
/// contains every `count`-th experiment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shard {
    number: usize,
    count: usize,
}

impl Shard {
    /// All experiments in one shard.
    pub const WHOLE: Self = Self { number: 1, count: 1 };

    /// Whether the shard contains an experiment.
    pub const fn has(self, trial: usize) -> bool {
        trial % self.count == self.number - 1
    }
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parsed = text
            .split_once('/')
            .and_then(|(number, count)| Some((number.parse().ok()?, count.parse().ok()?)));
        match parsed {
            Some((number, count)) if number >= 1 && number <= count => Ok(Self { number, count }),
            _ => Err(format!(
                "`{text}` is not a shard; give K/N for part K of N parts, K from 1 to N, such as 3/16"
            )),
        }
    }
}

/// The file `trials.jsonl`, open for appending.
#[derive(Debug)]
pub struct Results {
    path: PathBuf,
    file: File,
    /// First line of the file.
    header: String,
    /// Results of finished experiments, by number of the experiment.
    done: BTreeMap<usize, TrialRows>,
}

impl Results {
    /// Opens or creates the file in a directory, and reads its results. Removes an incomplete last line.
    ///
    /// # Errors
    /// [`ResultsError`].
    pub fn open(directory: &Path, definition: &Definition) -> Result<Self, ResultsError> {
        let path = directory.join(NAME);
        let io_error = refused(&path);
        let header = serde_json::to_string(definition)?;
        std::fs::create_dir_all(directory).map_err(io_error)?;
        let mut file =
            OpenOptions::new().read(true).append(true).create(true).open(&path).map_err(io_error)?;
        let WholeLines { bytes, contents } = read(&path, &file)?;
        // The comparison is before the truncation, because another process may be adding a line to the other study.
        if contents.as_ref().is_some_and(|(in_file, _)| in_file != definition) {
            return Err(ResultsError::OtherStudy { path });
        }
        file.set_len(bytes).map_err(io_error)?;
        let done = match contents {
            None => {
                file.write_all(format!("{header}\n").as_bytes()).map_err(io_error)?;
                BTreeMap::new()
            }
            Some((_, done)) => done,
        };
        Ok(Self { path, file, header, done })
    }

    /// Results of finished experiments, by number of the experiment.
    pub const fn done(&self) -> &BTreeMap<usize, TrialRows> {
        &self.done
    }

    /// Appends the results of an experiment.
    ///
    /// # Errors
    /// [`ResultsError`].
    pub fn add(&mut self, rows: TrialRows) -> Result<(), ResultsError> {
        let line = format!("{}\n", serde_json::to_string(&rows)?);
        self.file.write_all(line.as_bytes()).map_err(refused(&self.path))?;
        self.done.insert(rows.trial, rows);
        Ok(())
    }

    /// Sorts the lines by number and replaces the file atomically.
    ///
    /// # Errors
    /// [`ResultsError`].
    pub fn put_in_order(&self) -> Result<(), ResultsError> {
        let mut text = format!("{}\n", self.header);
        for rows in self.done.values() {
            text.push_str(&serde_json::to_string(rows)?);
            text.push('\n');
        }
        let part = self.path.with_extension("part");
        std::fs::write(&part, text)
            .and_then(|()| std::fs::rename(&part, &self.path))
            .map_err(refused(&self.path))
    }

    /// Checks that the results of all experiments with numbers below `wanted` are present.
    ///
    /// # Errors
    /// [`ResultsError::Missing`].
    pub fn require(&self, wanted: usize) -> Result<(), ResultsError> {
        let mut missing = (0..wanted).filter(|trial| !self.done.contains_key(trial));
        match missing.next() {
            Some(first) => Err(ResultsError::Missing { missing: 1 + missing.count(), wanted, first }),
            None => Ok(()),
        }
    }
}

/// A row together with the experiment and the estimator to which it belongs.
pub(super) struct PlacedRow<'a> {
    pub(super) trial: Trial<'a>,
    pub(super) estimator: &'a str,
    pub(super) row: &'a ResultRow,
}

impl Results {
    /// All rows, in the order of the study's experiments and estimators.
    pub(super) fn placed<'a>(&'a self, definition: &'a Definition) -> impl Iterator<Item = PlacedRow<'a>> {
        let done = trials(definition).filter_map(|trial| Some((trial, self.done.get(&trial.number)?)));
        done.flat_map(|(trial, results)| {
            let names = definition.study.estimators_of(trial.figure, trial.series);
            names.iter().zip(&results.rows).map(move |(estimator, row)| PlacedRow { trial, estimator, row })
        })
    }
}

/// Merges the results in the directories `shards` with those in `out`. All results must belong to one study. Returns the
/// study's definition and all results. To write the merged results, call [`Results::put_in_order`].
///
/// # Errors
/// [`ResultsError`], for example if the directories have results of different studies.
pub fn merge(shards: &[PathBuf], out: &Path) -> Result<(Definition, Results), ResultsError> {
    let mut all: Option<(Definition, BTreeMap<usize, TrialRows>)> = None;
    for shard in shards {
        let path = shard.join(NAME);
        let file = File::open(&path).map_err(refused(&path))?;
        let Some((definition, done)) = read(&path, &file)?.contents else {
            return Err(ResultsError::Malformed { path, line: 1, reason: "it has no study".into() });
        };
        match &mut all {
            None => all = Some((definition, done)),
            Some((first, _)) if *first != definition => return Err(ResultsError::OtherStudy { path }),
            Some((_, rows)) => rows.extend(done),
        }
    }
    let (definition, done) = all.ok_or(ResultsError::NoShard)?;
    let mut results = Results::open(out, &definition)?;
    results.done.extend(done);
    Ok((definition, results))
}

/// Contents of a file, without an incomplete last line.
struct WholeLines {
    /// Length of the complete lines \[bytes\].
    bytes: u64,
    /// The study and its results by number of the experiment; `None` if the file has no complete line.
    contents: Option<(Definition, BTreeMap<usize, TrialRows>)>,
}

fn read(path: &Path, file: &File) -> Result<WholeLines, ResultsError> {
    let malformed = |line: usize, reason: &serde_json::Error| ResultsError::Malformed {
        path: path.to_owned(),
        line,
        reason: reason.to_string(),
    };
    let (mut lines, mut text) = (BufReader::new(file), Vec::new());
    let mut whole = WholeLines { bytes: 0, contents: None };
    let mut number = 0;
    loop {
        text.clear();
        let line_bytes = lines.read_until(b'\n', &mut text).map_err(refused(path))?;
        if text.last() != Some(&b'\n') {
            return Ok(whole);
        }
        number += 1;
        whole.bytes += line_bytes as u64;
        match &mut whole.contents {
            None => {
                let definition = serde_json::from_slice(&text).map_err(|error| malformed(number, &error))?;
                whole.contents = Some((definition, BTreeMap::new()));
            }
            Some((_, done)) => {
                let rows: TrialRows =
                    serde_json::from_slice(&text).map_err(|error| malformed(number, &error))?;
                done.insert(rows.trial, rows);
            }
        }
    }
}
