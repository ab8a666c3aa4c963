//! `identify calibrate --experiment FILE`: any mix of instruments on one robot. Such a file is written beside every result, so
//! that one command repeats it.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use serde::{Deserialize, Serialize};
use shared::config::{self, Validate, Violation};

use super::bar::{self, BarArguments};
use super::result::Told;
use super::{CommonArguments, RowArguments, contact, inputs, refused, tracker, wire};
use crate::calibrate::ball_bar::RunInput;
use crate::calibrate::measured_pose::RowErrors;
use crate::calibrate::mix::{self, DataSets};
use crate::calibrate::refusal::Refuses;
use crate::calibrate::{HoldOut, IdentifyConfig};
use crate::commands::ensure_six_revolute_axes;
use crate::commands::on_terminal::OnTerminal;
use crate::evaluate::RunEvidence;
use crate::instrument::{BallBar, Instrument, LengthRow, PoseRow, Run};
use crate::logs::LogFormat;
use crate::report::file::{CalibrationFile, ParameterEntry, SolveEntry};
use crate::report::page::Measured;
use crate::report::rows as of_rows;
use crate::report::table;
use crate::report::validation::RowsEntry;

/// Name of the file beside a result.
const NAME: &str = "experiment.toml";

/// What a calibration from a mix is told.
#[derive(Debug, Args)]
pub struct ExperimentArguments {
    /// Everything that was measured on one robot and how it is calibrated, such as config/experiment.toml
    #[arg(long, value_name = "FILE", required = true)]
    experiment: PathBuf,
    /// Directory for calibration.toml
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// A run with the ball-bar.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BarRun {
    /// Recording.
    pub recording: PathBuf,
    /// The robot's own log.
    pub robot_log: PathBuf,
    /// The bar's configuration.
    pub bar: PathBuf,
    /// Force on the bar.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub force_log: Option<PathBuf>,
}

/// A file of rows, each a pose of the robot and what was measured there.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RowFile {
    /// The rows.
    pub file: PathBuf,
    /// Which of its columns is what.
    pub mapping: PathBuf,
    /// Of a ball in sockets, which needs it: the table of these.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sockets: Option<PathBuf>,
    /// Which rows are held out together; absent: regions of poses, rows of lengths and contacts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hold_out: Option<HoldOut>,
    /// Decides which; absent: the instrument's usual one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seed: Option<u64>,
    /// Of a tracker alone: highest number of waves per turn that the errors of joints may have.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub joint_waves: Option<u8>,
    /// Of a tracker alone: other files that judge the robot.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub validate: Vec<PathBuf>,
}

/// Everything that was measured on one robot, and how it is calibrated. Paths count from the file's directory.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Experiment {
    /// The robot's configuration.
    pub robot: PathBuf,
    /// Which column or joint of recordings of other programs is what.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub recording_mapping: Option<PathBuf>,
    /// Kind of the robot's logs; absent: told by their content.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub log_format: Option<LogFormat>,
    /// Which column or joint of the robot's logs is what.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub log_mapping: Option<PathBuf>,
    /// Which column of the force logs is what.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub force_mapping: Option<PathBuf>,
    /// Take the bar as rigid although the robot's log has a force.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub ignore_force: bool,
    /// Runs with the ball-bar.
    #[serde(default, rename = "bar", skip_serializing_if = "Vec::is_empty")]
    pub bars: Vec<BarRun>,
    /// Files of trackers.
    #[serde(default, rename = "tracker", skip_serializing_if = "Vec::is_empty")]
    pub trackers: Vec<RowFile>,
    /// Files of draw-wires or telescoping bars.
    #[serde(default, rename = "wire", skip_serializing_if = "Vec::is_empty")]
    pub wires: Vec<RowFile>,
    /// Files of a ball in sockets.
    #[serde(default, rename = "contact", skip_serializing_if = "Vec::is_empty")]
    pub contacts: Vec<RowFile>,
    /// How to calibrate: the keys of identify.toml.
    #[serde(default)]
    pub identify: IdentifyConfig,
}

impl Validate for Experiment {
    fn validate(&self) -> Result<(), Violation> {
        if self.data_sets() == 0 {
            let what = "nothing was measured";
            return Err(Violation::new(
                "bar",
                what,
                "write a [[bar]], [[tracker]], [[wire]] or [[contact]] block for each file",
            ));
        }
        let forces = self.bars.iter().filter(|run| run.force_log.is_some()).count();
        if forces != 0 && forces != self.bars.len() {
            return Err(Violation::new(
                "bar",
                "some runs have a force log",
                "give one for each run, or for none",
            ));
        }
        let of_tracker_alone = self.data_sets() > 1 || self.trackers.is_empty();
        for (key, rows) in [("tracker", &self.trackers), ("wire", &self.wires), ("contact", &self.contacts)] {
            for (index, row) in rows.iter().enumerate() {
                if row.sockets.is_some() != (key == "contact") {
                    return Err(Violation::new(
                        format!("{key}[{index}].sockets"),
                        "a table of sockets goes with each [[contact]] block and with no other",
                        "write sockets = \"sockets.toml\" there, and there alone",
                    ));
                }
                if of_tracker_alone && (row.joint_waves.is_some() || !row.validate.is_empty()) {
                    return Err(Violation::new(
                        format!("{key}[{index}]"),
                        "joint_waves and validate are for a tracker alone",
                        "leave them out",
                    ));
                }
            }
        }
        // What rows alone are told; a mix refuses what it cannot follow by itself.
        let IdentifyConfig { fix, require_mm, .. } = self.identify.clone();
        let taken = IdentifyConfig { fix, require_mm, ..IdentifyConfig::default() };
        let taken = match (&self.trackers[..], &self.wires[..], &self.contacts[..]) {
            ([_], [], []) => {
                Some((IdentifyConfig { loss: self.identify.loss, ..taken }, "fix, loss and require_mm"))
            }
            ([], [_], []) => Some((taken, "fix and require_mm")),
            _ => None,
        };
        if let Some((_, keys)) = taken.filter(|(taken, _)| self.bars.is_empty() && *taken != self.identify) {
            return Err(Violation::new(
                "identify",
                "one file of rows alone does not take all of these keys",
                format!("leave all out but {keys}"),
            ));
        }
        self.identify.validate()
    }
}

impl Experiment {
    fn new(robot: &Path, identify: IdentifyConfig) -> Self {
        Self {
            robot: robot.to_owned(),
            recording_mapping: None,
            log_format: None,
            log_mapping: None,
            force_mapping: None,
            ignore_force: false,
            bars: Vec::new(),
            trackers: Vec::new(),
            wires: Vec::new(),
            contacts: Vec::new(),
            identify,
        }
    }

    fn data_sets(&self) -> usize {
        self.bars.len() + self.trackers.len() + self.wires.len() + self.contacts.len()
    }

    /// That of a calibration from runs with the ball-bar.
    pub(super) fn of_bars(arguments: &BarArguments, config: &IdentifyConfig) -> Self {
        let mut forces = arguments.force_log.iter().cloned();
        let run = |((recording, robot_log), bar): ((&PathBuf, &PathBuf), &PathBuf)| BarRun {
            recording: recording.clone(),
            robot_log: robot_log.clone(),
            bar: bar.clone(),
            force_log: forces.next(),
        };
        let bars = arguments.recording.iter().zip(&arguments.robot_log).zip(arguments.bar.iter().cycle());
        Self {
            recording_mapping: arguments.recording_mapping.clone(),
            log_format: arguments.log_format,
            log_mapping: arguments.log_mapping.clone(),
            force_mapping: arguments.force_mapping.clone(),
            ignore_force: arguments.ignore_force,
            bars: bars.map(run).collect(),
            ..Self::new(&arguments.common.robot, config.clone())
        }
    }

    /// That of a calibration from rows alone, without its rows.
    pub(super) fn of_rows(common: &CommonArguments, rows: &RowArguments, file: &Path) -> (Self, RowFile) {
        let fix = rows.fix.iter().map(ToString::to_string).collect();
        let row_file = RowFile {
            file: file.to_owned(),
            mapping: rows.mapping.clone(),
            sockets: None,
            hold_out: rows.hold_out,
            seed: Some(rows.seed),
            joint_waves: None,
            validate: Vec::new(),
        };
        let identify = IdentifyConfig { fix, require_mm: common.require, ..IdentifyConfig::default() };
        (Self::new(&common.robot, identify), row_file)
    }

    /// All of its paths.
    fn paths(&mut self) -> Vec<&mut PathBuf> {
        let mut paths = vec![&mut self.robot];
        let mappings = [&mut self.recording_mapping, &mut self.log_mapping, &mut self.force_mapping];
        paths.extend(mappings.into_iter().flatten());
        for run in &mut self.bars {
            paths.extend([&mut run.recording, &mut run.robot_log, &mut run.bar]);
            paths.extend(&mut run.force_log);
        }
        for rows in self.trackers.iter_mut().chain(&mut self.wires).chain(&mut self.contacts) {
            paths.extend([&mut rows.file, &mut rows.mapping]);
            paths.extend(&mut rows.sockets);
            paths.extend(&mut rows.validate);
        }
        paths
    }

    /// Writes it beside a result, so that it can be repeated from anywhere; its text.
    pub(super) fn write(mut self, directory: &Path) -> anyhow::Result<String> {
        for path in self.paths() {
            *path = std::path::absolute(&*path).with_context(|| path.display().to_string())?;
        }
        let (to, text) = (directory.join(NAME), toml::to_string(&self)?);
        std::fs::write(&to, &text).with_context(|| to.display().to_string())?;
        Ok(text)
    }

    fn load(path: &Path) -> anyhow::Result<Self> {
        let mut experiment: Self = config::load(path)?;
        let directory = path.parent().unwrap_or(Path::new(""));
        for path in experiment.paths() {
            *path = directory.join(&*path);
        }
        Ok(experiment)
    }

    fn bar_arguments(&self, out: &Path) -> BarArguments {
        let of = |path: fn(&BarRun) -> &PathBuf| self.bars.iter().map(|run| path(run).clone()).collect();
        BarArguments {
            recording: of(|run| &run.recording),
            robot_log: of(|run| &run.robot_log),
            bar: of(|run| &run.bar),
            force_log: self.bars.iter().filter_map(|run| run.force_log.clone()).collect(),
            recording_mapping: self.recording_mapping.clone(),
            log_format: self.log_format,
            log_mapping: self.log_mapping.clone(),
            force_mapping: self.force_mapping.clone(),
            ignore_force: self.ignore_force,
            common: self.common(out),
            config: None,
            cost: None,
            loss: None,
            ransac: false,
            selection: None,
            free: Vec::new(),
            fix: Vec::new(),
            encoders: None,
            truth: None,
        }
    }

    fn common(&self, out: &Path) -> CommonArguments {
        let require = self.identify.require_mm;
        CommonArguments { robot: self.robot.clone(), out: out.to_owned(), require }
    }

    fn row_arguments(&self, rows: &RowFile) -> anyhow::Result<RowArguments> {
        let fix = self.identify.fix.iter().map(|name| name.parse());
        Ok(RowArguments {
            mapping: rows.mapping.clone(),
            hold_out: rows.hold_out,
            seed: rows.seed.unwrap_or_else(super::usual_seed),
            fix: fix.collect::<Result<_, _>>()?,
        })
    }
}

/// Reads, calibrates, writes and prints.
pub(super) fn run(arguments: &ExperimentArguments) -> anyhow::Result<()> {
    let experiment = Experiment::load(&arguments.experiment)?;
    let out = &arguments.out;
    let Experiment { bars, trackers, wires, contacts, identify, .. } = &experiment;
    match (&bars[..], &trackers[..], &wires[..], &contacts[..]) {
        (_, [], [], []) => bar::calibrate(&experiment.bar_arguments(out), identify),
        ([], [rows], [], []) => {
            let common = experiment.common(out);
            tracker::run(&tracker::TrackerArguments::of(
                rows,
                experiment.row_arguments(rows)?,
                identify,
                common,
            ))
        }
        ([], [], [rows], []) => {
            let common = experiment.common(out);
            wire::run(&wire::WireArguments::of(rows, experiment.row_arguments(rows)?, common))
        }
        _ => mixed(experiment, out),
    }
}

/// The same of any mix, or of instruments that have no way of their own.
pub(super) fn mixed(experiment: Experiment, out: &Path) -> anyhow::Result<()> {
    let (bar_arguments, config) = (experiment.bar_arguments(out), &experiment.identify);
    let robot = &experiment.common(out).robot()?;
    let bars = if experiment.bars.is_empty() {
        Vec::new()
    } else {
        ensure_six_revolute_axes(robot)?;
        bar::runs(&bar_arguments, robot)?
    };
    let read = |rows: &RowFile| tracker::rows(&rows.file, &rows.mapping, robot);
    let trackers: Vec<Vec<PoseRow>> = experiment.trackers.iter().map(read).collect::<anyhow::Result<_>>()?;
    let read = |rows: &RowFile| wire::rows(&rows.file, &rows.mapping, robot).map(|(rows, _)| rows);
    let wires: Vec<Vec<LengthRow>> = experiment.wires.iter().map(read).collect::<anyhow::Result<_>>()?;
    let read = |of: &RowFile| {
        let sockets = of.sockets.as_deref().context("a table of sockets is missing")?;
        contact::read(&of.file, &of.mapping, sockets, robot)
    };
    let contacts: Vec<contact::Read> = experiment.contacts.iter().map(read).collect::<anyhow::Result<_>>()?;
    let of_contacts = experiment.contacts.iter().zip(&contacts);
    let data = DataSets {
        contacts: of_contacts.map(|(of, read)| (of.data(&read.rows), &read.table)).collect(),
        bars: bars.iter().map(bar::RunFiles::input).collect::<Vec<RunInput<'_>>>(),
        trackers: experiment.trackers.iter().zip(&trackers).map(|(of, rows)| of.data(rows)).collect(),
        wires: experiment.wires.iter().zip(&wires).map(|(of, rows)| of.data(rows)).collect(),
    };
    let on_terminal = OnTerminal::new();
    let found = mix::calibrate(&data, robot, config, Some(&on_terminal)).and_then(|found| {
        match mix::held_out(&data, robot, config, Some(&on_terminal)) {
            // The rest is too little for a solve: the calibration stands, without these figures.
            Err(error) if error.refusal().is_some() => {
                tracing::warn!("no rows are predicted by a solve without them: {error}");
                let none = vec![RowErrors::default(); found.runs.len()];
                Ok((found, none))
            }
            errors => Ok((found, errors?)),
        }
    });
    on_terminal.finish();
    let mut files: Vec<(&str, &Path)> = Vec::new();
    for (role, rows) in [
        ("measured poses", &experiment.trackers),
        ("measured lengths", &experiment.wires),
        ("seated balls", &experiment.contacts),
    ] {
        for of in rows {
            files.extend([(role, of.file.as_path()), ("mapping", &of.mapping)]);
            files.extend(of.sockets.as_deref().map(|sockets| ("sockets", sockets)));
        }
    }
    files.extend(bar::input_files(&bar_arguments, &bars));
    let (found, errors) =
        found.map_err(|error| refused::of_rows(&experiment.common(out), robot, &files, config, error))?;
    let solution = &found.solved.solution;
    let mut file = CalibrationFile::new(
        &robot.name,
        &instruments(&found.runs),
        SolveEntry::new("each instrument's own", &solution.summary, &solution.identifiability),
        None,
        inputs(&files)?,
        ParameterEntry::of_all(
            found.runs.iter().map(|run| &run.model),
            &found.solved.columns,
            &solution.covariance,
        ),
    )
    .with_knowledge(solution);
    file.candidates.clone_from(&found.solved.candidates);
    let row_files = [
        (&experiment.trackers, HoldOut::Regions),
        (&experiment.wires, HoldOut::Blocks),
        (&experiment.contacts, HoldOut::Rows),
    ];
    let row_files = row_files.into_iter().flat_map(|(files, usual)| files.iter().map(move |of| (of, usual)));
    let entry = |(number, (of, usual)): (usize, (&RowFile, HoldOut))| {
        let number = bars.len() + number;
        let errors = errors.get(number).filter(|errors| !errors.held_out.is_empty())?;
        Some(RowsEntry {
            data_set: number + 1,
            hold_out: of.hold_out.unwrap_or(usual),
            seed: of.seed.unwrap_or(mix::SEED),
            fitted: errors.of(&errors.fitted),
            held_out: errors.of(&errors.held_out),
        })
    };
    file.rows = row_files.enumerate().filter_map(entry).collect();
    let name = |number: usize, run: &Run| format!("{} (data set {})", run.instrument.name(), number + 1);
    let data_sets = found.runs.iter().zip(&errors).enumerate().map(|(number, (run, errors))| {
        let of_bar = |bar: &BallBar| Measured::Bar {
            evidence: Box::new(RunEvidence::new(&bar.prepared, &run.model)),
            by_encoders: bar.measured.contains(&true),
        };
        (name(number, run), run.instrument.bar().map_or(Measured::Rows(errors), of_bar))
    });
    let mut tables = table::data_sets(&found);
    let mut limits = Vec::new();
    let of_contacts = found.runs.iter().enumerate().filter_map(|(number, run)| match &run.instrument {
        Instrument::Contact(contact) => Some((name(number, run), contact, &run.model)),
        _ => None,
    });
    for ((name, contact, model), read) in of_contacts.zip(&contacts) {
        tables += &format!("\n{name}\n{}", of_rows::contacts(contact, model, &read.lines));
        limits.extend(of_rows::contradicted(contact, model));
    }
    let first = found.runs.first().context("there is no data set")?;
    let told = Told {
        robot,
        bar: bars.first().map(|run| &run.bar),
        file,
        model: &first.model,
        solution,
        limits,
        data_sets: data_sets.collect(),
        tables,
        experiment,
    };
    told.write(out)
}

/// For a person: each instrument with how many data sets it has.
fn instruments(runs: &[Run]) -> String {
    let names: Vec<&str> = runs.iter().map(|run| run.instrument.name()).collect();
    let told = names.chunk_by(|one, other| one == other).map(|same| match same {
        [name] => (*name).to_owned(),
        several => format!("{} times {}", several.len(), several[0]),
    });
    told.collect::<Vec<_>>().join(", ")
}

impl RowFile {
    fn data<'a, R>(&self, rows: &'a [R]) -> mix::Rows<'a, R> {
        mix::Rows { rows, hold_out: self.hold_out, seed: self.seed }
    }
}
