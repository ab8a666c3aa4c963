//! [`CalibrationFile`], the content of `calibration.toml` and `calibration.json`: parameters with their uncertainty, figures
//! of the solve, verdict, and the inputs with their checksums. Terminal, page and all other files of a result are made from
//! it. Also `dh.csv`, the table of its links.

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
use super::validation::{HeldOutEntry, RowsEntry, ValidationEntry};
use crate::calibrate::Calibration;
use crate::calibrate::selection::terms::Candidate;
use crate::calibrate::validation::deployment::Deployment;
use crate::calibrate::validation::unseen::UnseenPart;
use crate::evaluate::{Budget, Limit, Validity, not_separated};
use crate::instrument::Run;
use crate::logs::LogError;
use crate::model::{Group, Model, Parameter, ParameterId, Role, TermGroup, Unit};
use crate::report::verdict::CalibrationVerdict;
use crate::solver::{Identifiability, Solution, Summary};

/// Version of the file's structure; it rises when a key changes its name or meaning.
pub const SCHEMA: u32 = 2;

/// Why a file of a result cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// The operating system refused.
    #[error("cannot write {}: {source}; check the directory and free space", path.display())]
    Io {
        /// The file or directory.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// A number does not fit TOML.
    #[error("the calibration cannot be written as TOML: {0}")]
    Toml(#[from] toml::ser::Error),
    /// A number does not fit JSON.
    #[error("the calibration cannot be written as JSON: {0}")]
    Json(#[from] serde_json::Error),
    /// The table of links cannot be written.
    #[error("the table of links cannot be written as CSV: {0}")]
    Csv(#[from] csv::Error),
    /// The offsets of the joints cannot be written in terms of the robot's log.
    #[error(transparent)]
    Conversion(#[from] LogError),
}

/// A file that the calibration was made from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct InputFile {
    /// Such as `recording` or `robot`.
    pub role: String,
    /// Path of the file.
    pub path: PathBuf,
    /// Its checksum, hexadecimal.
    pub sha256: String,
}

impl InputFile {
    /// Reads the checksum of a file, or of a configuration that was given by its name.
    pub fn of(role: &str, path: &Path) -> io::Result<Self> {
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
    /// Found from the samples.
    Identified,
    /// Found from the samples and a prior.
    IdentifiedWithPrior,
    /// Left at its value.
    Fixed,
}

/// One parameter, SI units.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ParameterEntry {
    /// Name, such as `ra1`.
    pub name: String,
    /// `m`, `rad`, `s` or `1`.
    pub unit: String,
    /// Data sheet or first guess.
    pub nominal: f64,
    /// Value at the solution.
    pub value: f64,
    /// Identified value minus nominal value.
    pub correction: f64,
    /// One standard deviation; absent for fixed parameters that are taken as exact.
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

    /// Those of a calibration: all of the first run, then those that no run before has, named as in `ox@2`.
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
                // An entry that was fixed in an earlier run is replaced by that of a run that identifies it.
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

    /// Its unit for display: angles of the robot's links are in degrees, as controllers have them.
    pub(in crate::report) fn read_in(&self) -> ReadIn {
        let unit = self.id().map_or(Unit::Ratio, ParameterId::unit);
        match (self.id(), unit) {
            (Some(ParameterId::Robot { .. }), Unit::Radian) => {
                ReadIn { factor: 1f64.to_degrees(), unit: "deg", decimals: 5 }
            }
            _ => ReadIn { factor: unit.display_factor(), unit: unit.display_symbol(), decimals: 4 },
        }
    }

    /// The parameter, without the number of the run; `None` for an unknown name.
    pub fn id(&self) -> Option<ParameterId> {
        self.name.split('@').next()?.parse().ok()
    }

    /// All parameters of a model at its solution, in the model's order, except terms of joints, forces and the bar's length
    /// that the calibration did not use. Harmonics of the bar's encoders always stay.
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
    /// Multiplies the SI value.
    pub factor: f64,
    /// Symbol of the unit, such as `deg`.
    pub unit: &'static str,
    /// Digits after the point.
    pub decimals: usize,
}

/// How the solve went.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct SolveEntry {
    /// Name of the cost function.
    pub cost: String,
    /// Why the solve ended.
    pub ended: String,
    /// Number of accepted steps.
    pub iterations: usize,
    /// Samples that were used.
    pub samples: usize,
    /// Free parameters, all of them identified.
    pub parameters: usize,
    /// Condition number of the column-scaled Jacobian.
    pub condition: f64,
    /// Root mean square of the residuals at the nominal start, in the cost's unit.
    pub residual_rms_start: f64,
    /// The same at the solution.
    pub residual_rms: f64,
}

impl SolveEntry {
    /// Of a solve that identified all of its free parameters.
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

/// Description of a measurement in its recording; empty fields are not in it.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct MeasurementEntry {
    /// When the recording began.
    pub started: String,
    /// Name of the operator.
    pub operator: String,
    /// Name or serial number of the robot.
    pub robot: String,
    /// Name or serial number of the bar.
    pub bar: String,
    /// What the robot carried beside the bar.
    pub payload: String,
    /// It was simulated: nothing was measured.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub simulated: bool,
}

impl MeasurementEntry {
    /// Of a table, which contains only whether it was simulated.
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
    /// [`SCHEMA`].
    pub schema: u32,
    /// When it was made.
    pub created: String,
    /// Program and version that made it.
    pub software: String,
    /// Name of the robot.
    pub robot: String,
    /// What it was measured with.
    pub instrument: String,
    /// Numbers of the robot's links of which the data determine no more than a combination, such as `rd2|rd3|rd4`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub not_separated: Vec<String>,
    /// Description of the measurement in each recording.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub measured: Vec<MeasurementEntry>,
    /// The verdict; files of earlier versions have none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub verdict: Option<CalibrationVerdict>,
    /// Limits of its accuracy, the most important first; the verdict names the first that is serious.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub limits: Vec<Limit>,
    /// What the scale of all lengths rests on.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scale: Option<String>,
    /// Figures of the solve.
    pub solve: SolveEntry,
    /// Clocks of instrument and robot, of each data set that has its own.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub clocks: Vec<ClockEntry>,
    /// The force on the bar in each run that has one.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub forces: Vec<ForceEntry>,
    /// Noise of the angles of each run with a ball-bar, where the cost weighs by it.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub noise: Vec<NoiseEntry>,
    /// Files it was made from.
    pub inputs: Vec<InputFile>,
    /// Kinds of terms that were tried on held-out segments of the runs.
    #[serde(default)]
    pub candidates: Vec<Candidate>,
    /// How well held-out segments of the runs were predicted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub held_out: Option<HeldOutEntry>,
    /// How well rows of trackers and wires were predicted that the fit did not see.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub rows: Vec<RowsEntry>,
    /// How well rows at each part of an instrument were predicted by all other data.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub unseen: Vec<UnseenPart>,
    /// How well rows of other files were predicted.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub validations: Vec<ValidationEntry>,
    /// Every parameter of the model; those of run 2 alone are called `ox@2`.
    pub parameters: Vec<ParameterEntry>,
    /// The robot if only part of the model is applied.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub deployments: Vec<DeploymentEntry>,
    /// Where in joint space it is supported.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub validity: Option<Validity>,
    /// Position errors of the geometry.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expected: Option<ExpectedEntry>,
    /// What makes positions uncertain.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub budget: Option<Budget>,
    /// Rank, observability and correlations of the parameters.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub knowledge: Option<Knowledge>,
    /// Covariance of the free parameters and of those that were fixed at uncertain values; in `calibration.json` alone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub covariance: Option<CovarianceEntry>,
}

impl CalibrationFile {
    /// The constant part: schema, time and program.
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

    /// One of the measurements was simulated.
    pub fn is_simulated(&self) -> bool {
        self.measured.iter().any(|one| one.simulated)
    }

    /// Adds what the data do not separate; `model` has the solution's first columns.
    #[must_use]
    pub fn with_separation(mut self, model: &Model, solution: &Solution) -> Self {
        let names = |group: Vec<ParameterId>| group.iter().map(ToString::to_string).collect::<Vec<_>>();
        let groups = not_separated(model, solution).into_iter();
        self.not_separated = groups.map(|group| names(group).join("|")).collect();
        self
    }

    /// Parameters for display, and the number of wave amplitudes that are left out: more than forty would fill a page.
    pub fn reported(&self) -> (Vec<&ParameterEntry>, usize) {
        const WAVES_MAX: usize = 40;
        let is_wave = |entry: &ParameterEntry| matches!(entry.id(), Some(ParameterId::JointWave { .. }));
        let waves = self.parameters.iter().filter(|entry| is_wave(entry)).count();
        let left_out = if waves > WAVES_MAX { waves } else { 0 };
        (self.parameters.iter().filter(|entry| left_out == 0 || !is_wave(entry)).collect(), left_out)
    }

    /// Writes `calibration.toml`, the same with the covariance as `calibration.json`, and, if links alone predict better than
    /// the nominal robot, `dh.csv` ([`CalibrationFile::dh_csv`]) into the directory, each whole or not at all. Removes a
    /// `report.html` that this program wrote earlier. Returns the path of `calibration.toml`.
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

    /// One row for each number of each link of [`Deployment::Dh`]:
    /// `chain,link,parameter,unit,nominal,identified,correction,sigma,deployment,held_out_mm`, SI units, links from 1 in the order of
    /// the chain. Parameters that were fixed and taken as exact have no sigma.
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
    /// Data sheet or first guess.
    pub nominal: f64,
    /// Value at the solution.
    pub identified: f64,
    /// Identified value minus nominal value.
    pub correction: f64,
    /// One standard deviation; absent for fixed parameters that are taken as exact.
    pub sigma: Option<f64>,
    /// What all rows together are for.
    pub deployment: Deployment,
    /// Root mean square of held-out positions with all rows applied and nothing else \[mm\].
    pub held_out_mm: Option<f64>,
}

/// The present time, for files.
pub(in crate::report) fn now() -> String {
    UtcNs::from_datetime(chrono::Utc::now()).to_string()
}

/// Name and version of this program.
pub(in crate::report) fn software() -> String {
    shared::version::software("identify")
}

/// Writes a file under another name and renames it, so that it is never incomplete under its own.
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
