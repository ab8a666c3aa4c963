//! The [`ExperimentFile`] contains paths and settings of one calibration, with any mix of instruments on one robot. All
//! subcommands of `identify calibrate` create an experiment from their options, and `--experiment FILE` reads an experiment
//! from a file. The experiment is written beside every result, so that one command repeats the calibration.

use std::path::{Component, Path, PathBuf};

use anyhow::Context;
use clap::Args;
use serde::{Deserialize, Serialize};
use shared::config::{self, Source, Validate, Violation};

use super::ResultArguments;
use super::driver::calibrate;
use super::rows::{RowFile, RowInstrument};
use crate::calibrate::IdentifyConfig;
use crate::instrument::Rows;
use crate::logs::LogFormat;
use crate::report::result::file::InputFile;

/// Name of the file beside a result.
const NAME: &str = "experiment.toml";

/// Options of a calibration from an experiment's file.
#[derive(Debug, Args)]
pub struct ExperimentArguments {
    /// File that lists all measurements of one robot and the settings of the calibration, such as config/experiment.toml
    #[arg(long, help_heading = "Input", value_name = "FILE", required = true)]
    experiment: PathBuf,
    #[command(flatten)]
    result: ResultArguments,
}

/// Files of a run with the ball-bar.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BarRunFiles {
    /// Recording of the bar.
    pub recording: PathBuf,
    /// The robot's own log.
    pub robot_log: PathBuf,
    /// The bar's configuration.
    pub bar: PathBuf,
    /// Force on the bar.
    pub force_log: Option<PathBuf>,
}

/// Everything that was measured on one robot, and how it is calibrated. Paths are relative to the directory of the file.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExperimentFile {
    /// The robot's configuration.
    pub robot: PathBuf,
    /// Mapping of the columns or joints of recordings by other programs.
    pub recording_mapping: Option<PathBuf>,
    /// Kind of the robot's logs. If absent, it is recognised by the content of the logs.
    pub log_format: Option<LogFormat>,
    /// Mapping of the columns or joints of the robot's logs.
    pub log_mapping: Option<PathBuf>,
    /// Mapping of the columns of the force logs.
    pub force_mapping: Option<PathBuf>,
    /// Treat the bar as rigid although the robot's log has a force.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub ignore_force: bool,
    /// If an encoder slips, a clock jumps or the bar is moved at one time, calibrate the run in two parts.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub split_at_changes: bool,
    /// Runs with the ball-bar.
    #[serde(default, rename = "bar", skip_serializing_if = "Vec::is_empty")]
    pub bars: Vec<BarRunFiles>,
    /// Files of laser trackers.
    #[serde(default, rename = "tracker", skip_serializing_if = "Vec::is_empty")]
    pub trackers: Vec<RowFile>,
    /// Files of draw-wires or telescoping bars.
    #[serde(default, rename = "wire", skip_serializing_if = "Vec::is_empty")]
    pub wires: Vec<RowFile>,
    /// Files of a ball in sockets.
    #[serde(default, rename = "contact", skip_serializing_if = "Vec::is_empty")]
    pub contacts: Vec<RowFile>,
    /// Files of touch probes or dial gauges.
    #[serde(default, rename = "touch", skip_serializing_if = "Vec::is_empty")]
    pub touches: Vec<RowFile>,
    /// Settings of the calibration: the keys of `identify.toml`.
    #[serde(default)]
    pub identify: IdentifyConfig,
    /// Path of the file from which the experiment was read.
    #[serde(skip)]
    pub(super) read_from: Option<PathBuf>,
}

impl Validate for ExperimentFile {
    fn validate(&self) -> Result<(), Violation> {
        let remedy = "write a [[bar]], [[tracker]], [[wire]], [[contact]] or [[touch]] block for each file";
        Violation::unless(self.bars.len() + self.rows().count() > 0, "bar", "nothing was measured", remedy)?;
        let forces = self.bars.iter().filter(|run| run.force_log.is_some()).count();
        let all_or_none = forces == 0 || forces == self.bars.len();
        let remedy = "give one for each run, or for none";
        Violation::unless(all_or_none, "bar", "some runs have a force log", remedy)?;
        let (has_bar, has_force) = (!self.bars.is_empty(), forces > 0);
        let has_log = has_bar || self.trackers.iter().any(|rows| rows.robot_log.is_some());
        for (key, is_given, has_file, what) in [
            ("recording_mapping", self.recording_mapping.is_some(), has_bar, "recording"),
            ("log_mapping", self.log_mapping.is_some(), has_log, "robot's log"),
            ("log_format", self.log_format.is_some(), has_log, "robot's log"),
            ("force_mapping", self.force_mapping.is_some(), has_force, "force log"),
            ("ignore_force", self.ignore_force, has_bar, "run with the ball-bar"),
            ("split_at_changes", self.split_at_changes, has_bar, "run with the ball-bar"),
        ] {
            let problem = format!("the experiment has no {what}, which this key needs");
            Violation::unless(!is_given || has_file, key, problem, "leave it out")?;
        }
        for (kind, files) in self.kinds() {
            for (index, file) in files.iter().enumerate() {
                check_row_file(kind, index, file)?;
            }
        }
        self.identify.validate()
    }
}

/// Checks that a block of the experiment file names only files that suit its instrument: table of sockets, table of faces,
/// and log of the robot. Also checks that a mapping for validation files is given only with such files.
fn check_row_file(kind: RowInstrument, index: usize, file: &RowFile) -> Result<(), Violation> {
    let key = kind.key();
    for (is_right, name, problem, remedy) in [
        (
            file.sockets.is_some() == (kind == RowInstrument::Contact),
            "sockets",
            "a table of sockets goes with each [[contact]] block and with no other",
            "write sockets = \"sockets.toml\" there, and there alone",
        ),
        (
            file.faces.is_none() || kind == RowInstrument::Touch,
            "faces",
            "a table of faces goes with a [[touch]] block",
            "leave it out",
        ),
        (
            file.robot_log.is_none() || kind == RowInstrument::Tracker,
            "robot_log",
            "it goes with a [[tracker]] block whose rows have times",
            "leave it out",
        ),
        (
            file.validate_mapping.is_none() || !file.validate.is_empty(),
            "validate_mapping",
            "`validate` names no file for this mapping",
            "name the files in validate, or leave it out",
        ),
    ] {
        Violation::unless(is_right, format!("{key}[{index}].{name}"), problem, remedy)?;
    }
    Ok(())
}

impl ExperimentFile {
    fn kinds(&self) -> [(RowInstrument, &[RowFile]); 4] {
        [
            (RowInstrument::Tracker, &self.trackers),
            (RowInstrument::Wire, &self.wires),
            (RowInstrument::Contact, &self.contacts),
            (RowInstrument::Touch, &self.touches),
        ]
    }

    /// All files of rows, in the order of their data sets.
    pub(super) fn rows(&self) -> impl Iterator<Item = (RowInstrument, &RowFile)> {
        self.kinds().into_iter().flat_map(|(kind, files)| files.iter().map(move |file| (kind, file)))
    }

    /// Stores in the experiment by which rule and seed the rows of each file were held out. Without these settings, a later
    /// version could hold out other rows by its own defaults.
    pub(super) fn state(&mut self, rows: &[Rows]) {
        let Self { trackers, wires, contacts, touches, .. } = self;
        let files = trackers.iter_mut().chain(wires).chain(contacts).chain(touches);
        for (file, rows) in files.zip(rows) {
            (file.hold_out, file.seed) = (Some(rows.hold_out()), Some(rows.seed()));
        }
    }

    /// Every file of the calibration with its checksum. Files of rows come first.
    pub(super) fn inputs(&self) -> anyhow::Result<Vec<InputFile>> {
        let input = |(role, path): (&str, &mut PathBuf)| {
            InputFile::read(role, path).with_context(|| format!("cannot read {}", path.display()))
        };
        self.clone().files_mut().into_iter().map(input).collect()
    }

    /// Every file with its role and a mutable reference to its path. The checksums, and the paths in the experiment file
    /// beside a result, are both made from this list, so that no file is missing in either of them.
    fn files_mut(&mut self) -> Vec<(&'static str, &mut PathBuf)> {
        let Self { robot, recording_mapping, log_mapping, force_mapping, bars, .. } = self;
        let Self { trackers, wires, contacts, touches, .. } = self;
        let mut files: Vec<(&str, &mut PathBuf)> = Vec::new();
        let kinds = [
            (RowInstrument::Tracker, trackers),
            (RowInstrument::Wire, wires),
            (RowInstrument::Contact, contacts),
            (RowInstrument::Touch, touches),
        ];
        for (kind, all) in kinds {
            for rows in all {
                files.extend([(kind.role(), &mut rows.file), ("mapping", &mut rows.mapping)]);
                let others = [
                    ("robot log", &mut rows.robot_log),
                    ("sockets", &mut rows.sockets),
                    ("faces", &mut rows.faces),
                    ("validation mapping", &mut rows.validate_mapping),
                ];
                files.extend(others.into_iter().filter_map(|(role, path)| Some((role, path.as_mut()?))));
                files.extend(rows.validate.iter_mut().map(|path| ("validation", path)));
            }
        }
        files.push(("robot", robot));
        for run in bars {
            files.extend([
                ("recording", &mut run.recording),
                ("robot log", &mut run.robot_log),
                ("bar", &mut run.bar),
            ]);
            files.extend(run.force_log.as_mut().map(|path| ("force log", path)));
        }
        let mappings = [
            ("recording mapping", recording_mapping),
            ("robot log mapping", log_mapping),
            ("force log mapping", force_mapping),
        ];
        files.extend(mappings.into_iter().filter_map(|(role, path)| Some((role, path.as_mut()?))));
        files
    }

    /// Refuses a data set that is given twice, because its measurements would count twice, and confidence intervals would be
    /// too narrow. Also refuses a file of `--validate` that contains the same rows as a file of the fit. `inputs` are the
    /// files of the experiment with their checksums.
    pub(super) fn ensure_distinct(&self, inputs: &[InputFile]) -> anyhow::Result<()> {
        let bars = self.bars.iter().map(|run| [&run.recording, &run.robot_log]);
        let rows = self.rows().map(|(_, rows)| [&rows.file, &rows.mapping]);
        let sets: Vec<[&PathBuf; 2]> = bars.chain(rows).collect();
        let checksum =
            |path: &PathBuf| inputs.iter().find(|input| input.path == *path).map(|input| &input.sha256);
        // `None` for a data set if one of its two files has no checksum.
        let checksums: Vec<Option<Vec<_>>> =
            sets.iter().map(|set| set.map(checksum).into_iter().collect()).collect();
        for (number, pair) in checksums.iter().enumerate() {
            let is_same = |other: &Option<Vec<_>>| pair.is_some() && other == pair;
            if let Some(first) = checksums[..number].iter().position(is_same) {
                anyhow::bail!(
                    "data sets {} and {} are the same measurements ({} and {}); leave one of them out",
                    first + 1,
                    number + 1,
                    sets[first][0].display(),
                    sets[number][0].display()
                );
            }
        }
        for (_, RowFile { file, validate, .. }) in self.rows() {
            let is_fitted = |path: &&PathBuf| checksum(path).is_some() && checksum(path) == checksum(file);
            if let Some(path) = validate.iter().find(is_fitted) {
                anyhow::bail!(
                    "{} of --validate contains the rows of {}, which are fitted; give a file with other rows",
                    path.display(),
                    file.display()
                );
            }
        }
        Ok(())
    }

    /// Writes the experiment beside a result and returns its text. Paths are relative to the directory, so that the folder
    /// with the data and the result can be moved or copied.
    pub(super) fn write(&self, directory: &Path) -> anyhow::Result<String> {
        let mut moved = self.clone();
        // After a red verdict, no other file was written, so the directory may not exist.
        std::fs::create_dir_all(directory).with_context(|| directory.display().to_string())?;
        // Symbolic links are resolved, because `..` refers to the parent of the real directory.
        let canonical_directory =
            directory.canonicalize().with_context(|| directory.display().to_string())?;
        for (_, path) in moved.files_mut() {
            let file = match Source::find(path) {
                // The file is built into the program and has no path.
                Source::BuiltIn(..) => continue,
                Source::File(file) => file,
            };
            // The path of a missing file is written, too.
            let found = file.canonicalize().or_else(|_| std::path::absolute(&file));
            let found = found.with_context(|| path.display().to_string())?;
            *path = relative(&found, &canonical_directory).unwrap_or(found);
        }
        let (to, text) = (directory.join(NAME), config::to_toml(&moved)?);
        std::fs::write(&to, &text).with_context(|| to.display().to_string())?;
        Ok(text)
    }

    /// Moves the experiment file of an earlier calibration from `directory` to `place`, where the results of that
    /// calibration are now. The paths in the file are adapted to the new directory. If the present experiment was read from
    /// this file, the file remains in `directory`.
    pub(super) fn set_aside(&self, directory: &Path, place: &Path) -> anyhow::Result<()> {
        let file = directory.join(NAME);
        let present = self.read_from.as_ref();
        let is_present = present.is_some_and(|path| path.canonicalize().ok() == file.canonicalize().ok());
        if is_present || !file.exists() {
            return Ok(());
        }
        match Self::load(&file) {
            Ok(experiment) => experiment.write(place).map(drop)?,
            // If the file cannot be read, because an older program wrote it or it was edited, it is copied unchanged.
            Err(_) => {
                std::fs::copy(&file, place.join(NAME))
                    .map(drop)
                    .with_context(|| file.display().to_string())?;
            }
        }
        std::fs::remove_file(&file).with_context(|| file.display().to_string())
    }

    fn load(path: &Path) -> anyhow::Result<Self> {
        let mut experiment: Self = config::load(path)?;
        let directory = path.parent().unwrap_or(Path::new(""));
        for (_, path) in experiment.files_mut() {
            *path = Source::beside(directory, path);
        }
        experiment.read_from = Some(path.to_owned());
        Ok(experiment)
    }
}

/// Relative path from a directory to a file. In both paths, symbolic links have been resolved. `None` if the file is
/// unrelated to the directory: their common folder is too far above the directory, or it is a shared folder such as `/tmp`.
fn relative(file: &Path, directory: &Path) -> Option<PathBuf> {
    /// Largest number of steps upwards, sufficient from `project/results/monday/earlier` to `project/data`.
    const UP_MAX: usize = 3;
    /// Smallest number of common folders. `/tmp` is one folder.
    const COMMON_FOLDERS_MIN: usize = 2;
    let both = file.components().zip(directory.components());
    let common = both.take_while(|(of_file, of_directory)| of_file == of_directory).count();
    let common_parts = file.components().take(common);
    let folders = common_parts.filter(|part| matches!(part, Component::Normal(_))).count();
    let up = directory.components().skip(common).map(|_| Component::ParentDir);
    (folders >= COMMON_FOLDERS_MIN && up.clone().count() <= UP_MAX)
        .then(|| up.chain(file.components().skip(common)).collect())
}

pub(super) fn run(arguments: &ExperimentArguments) -> anyhow::Result<()> {
    let mut experiment = ExperimentFile::load(&arguments.experiment)?;
    experiment.identify.require_mm = arguments.result.require.or(experiment.identify.require_mm);
    calibrate(experiment, &arguments.result, None)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_of_validate_and_their_mapping_are_among_the_inputs() {
        let rows = RowFile {
            validate: vec!["other.csv".into(), "third.csv".into()],
            validate_mapping: Some("other.toml".into()),
            ..RowFile::default()
        };
        let mut experiment = ExperimentFile { trackers: vec![rows], ..ExperimentFile::default() };
        let files = experiment.files_mut();
        for (role, path) in
            [("validation", "other.csv"), ("validation", "third.csv"), ("validation mapping", "other.toml")]
        {
            let is_listed =
                files.iter().any(|(other, file)| *other == role && file.as_path() == Path::new(path));
            assert!(is_listed, "{path} is not among {files:?}");
        }
    }
}
