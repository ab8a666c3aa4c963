//! [`CalibrationFile`], the content of `calibration.toml` and `calibration.json`: parameters with their uncertainty,
//! statistics of the solve, verdict, and the input files with their checksums. Text for the terminal, the report page and all
//! other result files are made from it. This module also writes `dh.csv`, the table of the identified links.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use shared::config::{self, Source};
use shared::recording::schema::RunMetadata;
use shared::time::UtcNs;

use super::clocks::ClockEntry;
use super::corrections::csv;
use super::deployments::DeploymentEntry;
use super::earlier::remove_page;
use super::force::ForceEntry;
use super::knowledge::{CovarianceEntry, ExpectedEntry, Knowledge, NoiseEntry};
use super::validation::{HeldOutEntry, RowsEntry, UnseenEntry, ValidationEntry};
use crate::calibrate::Calibration;
use crate::calibrate::selection::terms::Candidate;
use crate::calibrate::validation::deployment::Deployment;
use crate::evaluate::{Budget, Limit, Validity, not_separated};
use crate::instrument::Run;
use crate::logs::LogError;
use crate::model::{Group, Model, Parameter, ParameterId, Role, TermGroup, Unit};
use crate::report::verdict::CalibrationVerdict;
use crate::solver::{Identifiability, Solution, Summary};

/// Version of the file's structure. It increases when the name or the meaning of a key changes.
pub const SCHEMA: u32 = 2;

/// Reasons why a result file cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// The operating system reported an error.
    #[error("cannot write {}: {source}; check the directory and free space", path.display())]
    Io {
        /// Path of the file or directory.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The calibration cannot be represented in TOML.
    #[error("the calibration cannot be written as TOML: {0}")]
    Toml(#[from] toml::ser::Error),
    /// The calibration cannot be represented in JSON.
    #[error("the calibration cannot be written as JSON: {0}")]
    Json(#[from] serde_json::Error),
    /// The table of links cannot be written.
    #[error("the table of links cannot be written as CSV: {0}")]
    Csv(#[from] csv::Error),
    /// The joint offsets cannot be converted to columns of the robot's log.
    #[error(transparent)]
    Conversion(#[from] LogError),
}

/// A file that the calibration was made from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct InputFile {
    /// Role of the file, such as `recording` or `robot`.
    pub role: String,
    /// Path of the file.
    pub path: PathBuf,
    /// SHA-256 checksum of the content, in hexadecimal digits.
    pub sha256: String,
}

impl InputFile {
    /// Computes the checksum of a file, or of a built-in configuration that was selected by its name.
    pub fn read(role: &str, path: &Path) -> io::Result<Self> {
        let mut hash = Sha256::new();
        match Source::find(path) {
            Source::File(file) => drop(io::copy(&mut File::open(file)?, &mut hash)?),
            Source::BuiltIn(_, text) => hash.update(text),
        }
        let sha256 = hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
        Ok(Self { role: role.to_owned(), path: path.to_owned(), sha256 })
    }
}

/// How a parameter was determined.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ParameterStatus {
    /// Estimated from the samples.
    Identified,
    /// Estimated from the samples and a prior.
    IdentifiedWithPrior,
    /// Not estimated; the value is unchanged.
    Fixed,
}

/// One parameter, SI units.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ParameterEntry {
    /// Name, such as `ra1`.
    pub name: String,
    /// `m`, `rad`, `s` or `1`.
    pub unit: String,
    /// Nominal value, from the data sheet or a first guess.
    pub nominal: f64,
    /// Value at the solution.
    pub value: f64,
    /// Identified value minus nominal value.
    pub correction: f64,
    /// One standard deviation. Absent if it is unknown, and for fixed parameters that are taken as exact.
    pub sigma: Option<f64>,
    /// Identified or fixed.
    pub status: ParameterStatus,
}

impl ParameterEntry {
    fn new(parameter: &Parameter, sigma: Option<f64>) -> Self {
        Self {
            name: parameter.id.to_string(),
            unit: parameter.id.unit().si_symbol().to_owned(),
            nominal: parameter.nominal,
            value: parameter.value,
            correction: parameter.value - parameter.nominal,
            sigma: match parameter.role {
                Role::Considered { sigma } => Some(sigma),
                _ => sigma,
            },
            status: match parameter.role {
                Role::Free => ParameterStatus::Identified,
                Role::Prior { .. } => ParameterStatus::IdentifiedWithPrior,
                Role::Fixed | Role::Considered { .. } => ParameterStatus::Fixed,
            },
        }
    }

    /// Entries of all parameters of a calibration. All parameters of the first run come first. For each further run, the
    /// parameters that no earlier run has are added under names such as `ox@2`.
    pub fn of_calibration(calibration: &Calibration) -> Vec<Self> {
        let (columns, covariance) = (&calibration.solved.columns, &calibration.solution().covariance);
        let mut entries: Vec<Self> = Vec::new();
        for (run, Run { model, .. }) in calibration.runs.iter().enumerate() {
            let columns_of = columns.of_run(run);
            let sigma = |id| covariance.sigma(*columns_of.get(model.column_of(id)?)?);
            if run == 0 {
                entries = Self::all(model, sigma);
                continue;
            }
            for (parameter, &column) in model.columns().zip(columns_of) {
                let Some(name) = columns.all().get(column).map(ToString::to_string) else { continue };
                // If an earlier run fixed the parameter and this run identifies it, the entry of this run
                // replaces the earlier entry.
                if entries.iter().all(|entry| entry.name != name || entry.status == ParameterStatus::Fixed) {
                    entries.retain(|entry| entry.name != name);
                    entries.push(Self { name, ..Self::new(parameter, covariance.sigma(column)) });
                }
            }
        }
        entries
    }

    /// The name of a fixed parameter, followed by its sigma if it has one.
    pub(in crate::report) fn held(&self) -> String {
        let unit = self.id().map_or(Unit::Ratio, ParameterId::unit);
        let within = self.sigma.map(|sigma| format!(" within {}", unit.display(sigma)));
        self.name.clone() + &within.unwrap_or_default()
    }

    /// Names of the fixed parameters: first the exact ones, then those with an uncertainty.
    pub(in crate::report) fn fixed<'e>(entries: impl IntoIterator<Item = &'e Self>) -> [Vec<String>; 2] {
        let mut names = [Vec::new(), Vec::new()];
        for entry in entries.into_iter().filter(|entry| entry.status == ParameterStatus::Fixed) {
            names[usize::from(entry.sigma.is_some())].push(entry.held());
        }
        names
    }

    /// Unit and digits for display. Angles of the robot's links are in degrees, as in controllers.
    pub(in crate::report) fn read_in(&self) -> ReadIn {
        let unit = self.id().map_or(Unit::Ratio, ParameterId::unit);
        match (self.id(), unit) {
            (Some(ParameterId::Robot { .. }), Unit::Radian) => {
                ReadIn { factor: 1f64.to_degrees(), unit: "deg", decimals: 5 }
            }
            _ => ReadIn { factor: unit.display_factor(), unit: unit.display_symbol(), decimals: 4 },
        }
    }

    /// Identifier of the parameter, without the number of the run. `None` if the name is unknown.
    pub fn id(&self) -> Option<ParameterId> {
        self.name.split('@').next()?.parse().ok()
    }

    /// Entries of the parameters of a model at its solution, in the model's order. Terms of joints, forces and the bar's
    /// length are left out if the calibration did not use them. Harmonics of the bar's encoders are always included.
    pub fn all(model: &Model, sigma: impl Fn(ParameterId) -> Option<f64>) -> Vec<Self> {
        let is_unused_term = |parameter: &&Parameter| {
            let group = parameter.id.group();
            matches!(group, Group::Term(_) | Group::Force)
                && group != Group::Term(TermGroup::EncoderHarmonics)
                && !parameter.role.is_estimated()
                && parameter.value == 0.0
        };
        let used = model.parameters().iter().filter(|parameter| !is_unused_term(parameter));
        used.map(|parameter| Self::new(parameter, sigma(parameter.id))).collect()
    }
}

/// How a number is displayed.
pub(in crate::report) struct ReadIn {
    /// Factor by which the SI value is multiplied.
    pub factor: f64,
    /// Symbol of the unit, such as `deg`.
    pub unit: &'static str,
    /// Digits after the point.
    pub decimals: usize,
}

/// Statistics of the solve.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct SolveEntry {
    /// Name of the cost function.
    pub cost: String,
    /// Why the solve ended.
    pub ended: String,
    /// Number of accepted steps.
    pub iterations: usize,
    /// Number of samples used.
    pub samples: usize,
    /// Number of free parameters. All of them were identified.
    pub parameters: usize,
    /// Condition number of the column-scaled Jacobian.
    pub condition: f64,
    /// Root mean square of the residuals at the nominal start, in the cost's unit.
    pub residual_rms_start: f64,
    /// Root mean square of the residuals at the solution, in the cost's unit.
    pub residual_rms: f64,
}

impl SolveEntry {
    /// Statistics of a solve that identified all of its free parameters.
    pub fn new(cost: &str, summary: &Summary, identifiability: &Identifiability) -> Self {
        Self {
            cost: cost.to_owned(),
            ended: summary.termination.to_string(),
            iterations: summary.iterations,
            samples: summary.samples_used,
            parameters: identifiability.names.len(),
            condition: identifiability.weakest().recip(),
            residual_rms_start: summary.residual_rms_start,
            residual_rms: summary.residual_rms,
        }
    }
}

/// Description of a measurement, from its recording. A field is empty if the recording does not contain it.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct MeasurementEntry {
    /// Time at which the recording began.
    pub started: String,
    /// Name of the operator.
    pub operator: String,
    /// Name or serial number of the robot.
    pub robot: String,
    /// Name or serial number of the bar.
    pub bar: String,
    /// Load on the robot in addition to the bar.
    pub payload: String,
    /// True if the data were simulated, not measured.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub simulated: bool,
}

impl MeasurementEntry {
    /// Entry for a table, which contains only that the data were simulated. `None` for measured data.
    pub fn of_table(simulated: bool) -> Option<Self> {
        simulated.then(|| Self { simulated, ..Self::default() })
    }
}

impl From<&RunMetadata> for MeasurementEntry {
    fn from(run: &RunMetadata) -> Self {
        Self {
            started: run.started.to_string(),
            operator: run.operator.clone(),
            robot: run.robot.clone(),
            bar: run.bar.clone(),
            payload: run.payload.clone(),
            simulated: run.is_simulated(),
        }
    }
}

/// The content of `calibration.toml` and `calibration.json`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct CalibrationFile {
    /// Version of the structure, see [`SCHEMA`].
    pub schema: u32,
    /// Time at which the calibration was made, UTC.
    pub created: String,
    /// Name and version of the program that made the calibration.
    pub software: String,
    /// Name of the robot.
    pub robot: String,
    /// Name of the instruments that measured the robot.
    pub instrument: String,
    /// Link parameters of the robot that the data do not separate. An entry such as `rd2|rd3|rd4` lists parameters of which
    /// only a combination is determined. A single name is a parameter that is not determined at all.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub not_separated: Vec<String>,
    /// Descriptions of the measurements, from their recordings.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub measured: Vec<MeasurementEntry>,
    /// The verdict. Files of earlier versions have none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub verdict: Option<CalibrationVerdict>,
    /// Limits of the accuracy, the most important first. The verdict may name the first serious limit as its reason.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub limits: Vec<Limit>,
    /// Sentence that states which measured length determines the scale of all lengths.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scale: Option<String>,
    /// Statistics of the solve.
    pub solve: SolveEntry,
    /// Clock difference between instrument and robot, for each data set whose instrument has a clock of its own.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub clocks: Vec<ClockEntry>,
    /// The force on the bar in each run whose force was measured.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub forces: Vec<ForceEntry>,
    /// Noise of the angles in each run with a ball-bar, if the cost weights residuals by this noise.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub noise: Vec<NoiseEntry>,
    /// Files from which the calibration was made.
    pub inputs: Vec<InputFile>,
    /// Groups of terms that were tried on held-out segments of the runs.
    #[serde(default)]
    pub candidates: Vec<Candidate>,
    /// Prediction errors on held-out segments of the runs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub held_out: Option<HeldOutEntry>,
    /// Prediction errors on held-out rows of trackers and wires, which the fit did not use.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub rows: Vec<RowsEntry>,
    /// Prediction errors on the rows at each part of an instrument, such as a socket. Each part was predicted by a fit
    /// to all other data.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub unseen: Vec<UnseenEntry>,
    /// Prediction errors on rows of other files.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub validations: Vec<ValidationEntry>,
    /// Every parameter of the model. A parameter that belongs to run 2 only has a name such as `ox@2`.
    pub parameters: Vec<ParameterEntry>,
    /// Results if only part of the model is applied.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub deployments: Vec<DeploymentEntry>,
    /// Joint ranges in which the calibration is supported.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub validity: Option<Validity>,
    /// Expected position errors over the workspace.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expected: Option<ExpectedEntry>,
    /// Contributions to the uncertainty of positions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub budget: Option<Budget>,
    /// Rank, observability and correlations of the parameters.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub knowledge: Option<Knowledge>,
    /// Covariance of the free parameters and of those that were fixed at uncertain values.
    /// Only `calibration.json` contains it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub covariance: Option<CovarianceEntry>,
}

impl CalibrationFile {
    /// Creates the content from these values, with current schema, time and program version. All other fields are empty.
    pub fn new(
        robot: &str,
        instrument: &str,
        solve: SolveEntry,
        inputs: Vec<InputFile>,
        parameters: Vec<ParameterEntry>,
    ) -> Self {
        Self {
            schema: SCHEMA,
            created: now(),
            software: software(),
            robot: robot.to_owned(),
            instrument: instrument.to_owned(),
            solve,
            inputs,
            parameters,
            ..Self::default()
        }
    }

    /// True if at least one of the measurements was simulated.
    pub fn is_simulated(&self) -> bool {
        self.measured.iter().any(|one| one.simulated)
    }

    /// Adds the link parameters that the data do not separate. `model` is the model of the solution's first columns.
    #[must_use]
    pub fn with_separation(mut self, model: &Model, solution: &Solution) -> Self {
        let names = |group: Vec<ParameterId>| group.iter().map(ToString::to_string).collect::<Vec<_>>();
        let groups = not_separated(model, solution).into_iter();
        self.not_separated = groups.map(|group| names(group).join("|")).collect();
        self
    }

    /// Parameters for display, and the number of wave amplitudes that are left out. If there are more than forty amplitudes,
    /// all of them are left out, because they would fill a page.
    pub fn reported(&self) -> (Vec<&ParameterEntry>, usize) {
        const WAVES_MAX: usize = 40;
        let is_wave = |entry: &ParameterEntry| matches!(entry.id(), Some(ParameterId::JointWave { .. }));
        let waves = self.parameters.iter().filter(|entry| is_wave(entry)).count();
        let left_out = if waves > WAVES_MAX { waves } else { 0 };
        (self.parameters.iter().filter(|entry| left_out == 0 || !is_wave(entry)).collect(), left_out)
    }

    /// Writes three files into the directory. `calibration.toml` contains everything except the covariance.
    /// `calibration.json` also contains the covariance. `dh.csv` ([`CalibrationFile::dh_csv`]) is written only if links alone
    /// predict better than the nominal robot. Each file is written completely or not at all. A `report.html` that this
    /// program wrote earlier is removed. Returns the path of `calibration.toml`.
    ///
    /// # Errors
    /// [`FileError`].
    pub fn write(&self, directory: &Path) -> Result<PathBuf, FileError> {
        let text = config::to_toml(&Self { covariance: None, ..self.clone() })?;
        let json = serde_json::to_string(self)?;
        let table = self.dh_csv()?;
        remove_page(directory)?;
        replace(directory, "calibration.json", &json)?;
        if self.serves(Deployment::Dh) {
            replace(directory, "dh.csv", &table)?;
        }
        replace(directory, "calibration.toml", &text)
    }

    /// Text of `dh.csv`, with one row for each parameter of each link of [`Deployment::Dh`]. The columns are
    /// `chain,link,parameter,unit,nominal,identified,correction,sigma,deployment,held_out_mm`. Numbers are in SI units, except
    /// `held_out_mm`. Links are numbered from 1 in the order of the chain. Fixed parameters that are taken as exact have
    /// an empty sigma.
    ///
    /// # Errors
    /// [`FileError::Csv`].
    pub fn dh_csv(&self) -> Result<String, FileError> {
        let mut rows = Vec::new();
        let deployment = Deployment::Dh;
        let held_out_mm = self.held_out_m(deployment).map(|[_nominal_m, links_m]| links_m * 1e3);
        for entry in &self.deployed(deployment).parameters {
            let (chain, link, parameter) = match entry.name.parse::<ParameterId>() {
                Ok(ParameterId::Robot { link, parameter }) => ("robot", link, parameter),
                Ok(ParameterId::Bar { link, parameter }) => ("ball_bar", link, parameter),
                _ => continue,
            };
            rows.push(DhRow {
                chain: chain.into(),
                link: link + 1,
                parameter: parameter.name().into(),
                unit: entry.unit.clone(),
                nominal: entry.nominal,
                identified: entry.value,
                correction: entry.correction,
                sigma: entry.sigma,
                deployment,
                held_out_mm,
            });
        }
        Ok(csv(&rows)?)
    }
}

/// One row of `dh.csv`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DhRow {
    /// `robot` or `ball_bar`.
    pub chain: String,
    /// Number of the link, from 1.
    pub link: usize,
    /// `a`, `d`, `alpha`, `theta` or `beta`.
    pub parameter: String,
    /// `m` or `rad`.
    pub unit: String,
    /// Nominal value, from the data sheet or a first guess.
    pub nominal: f64,
    /// Value at the solution.
    pub identified: f64,
    /// Identified value minus nominal value.
    pub correction: f64,
    /// One standard deviation. Absent if it is unknown, and for fixed parameters that are taken as exact.
    pub sigma: Option<f64>,
    /// Deployment of the table. All rows of the table are intended to be applied together.
    pub deployment: Deployment,
    /// RMS error of held-out positions if all rows of the table and no other corrections are applied \[mm\].
    pub held_out_mm: Option<f64>,
}

/// Current time in UTC, as text.
pub(in crate::report) fn now() -> String {
    UtcNs::from_datetime(chrono::Utc::now()).to_string()
}

/// Name and version of this program.
pub(in crate::report) fn software() -> String {
    shared::version::software("identify")
}

/// Writes a file under a temporary name and then renames it, so that a file under its final name is never incomplete.
pub(crate) fn replace(directory: &Path, name: &str, text: &str) -> Result<PathBuf, FileError> {
    let path = directory.join(name);
    let part = directory.join(format!("{name}.part"));
    let write = || {
        std::fs::create_dir_all(directory)?;
        std::fs::write(&part, text)?;
        std::fs::rename(&part, &path)
    };
    write().map_err(|source| FileError::Io { path: path.clone(), source })?;
    Ok(path)
}
