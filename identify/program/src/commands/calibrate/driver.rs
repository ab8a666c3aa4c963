//! Runs every calibration. It reads the files of an experiment, solves, validates on held-out data, writes the results with
//! their page, and prints the summary. If data are inconsistent or insufficient, it writes the page of a refusal instead.

use std::path::Path;

use anyhow::Context;
use shared::config::{self, RobotConfig, Source};
use shared::output::show;

use super::ResultArguments;
use super::bar::{self, RunFiles};
use super::experiment::ExperimentFile;
use super::refused::refused;
use super::result::{conclude, limited, write_files};
use super::rows::{self, Aligned, Beside, ValidationFile, WithLogs};
use crate::calibrate::validation::unseen::UnseenPart;
use crate::calibrate::{self, CalibrateError, Calibration, DataSets, RunInput};
use crate::commands::on_terminal::OnTerminal;
use crate::commands::{ensure_can_write, load_log_mapping};
use crate::evaluate::{Evidence, Limit, Validity, evidence, scale_sentence};
use crate::instrument::{Rows, Run};
use crate::kinematics::flange_chain;
use crate::logs::LogOptions;
use crate::report::page::Page;
use crate::report::result::clocks::ClockEntry;
use crate::report::result::file::{CalibrationFile, InputFile, MeasurementEntry, ParameterEntry, SolveEntry};
use crate::report::result::force::ForceEntry;
use crate::report::result::knowledge::NoiseEntry;
use crate::report::result::residuals::residuals_csv;
use crate::report::result::validation::{RowsEntry, ValidationEntry};
use crate::report::rows as rows_report;
use crate::report::summary::{summary, wrapped};
use crate::report::table;
use crate::simulate::{Comparison, Truth};
use crate::threads::both;

/// Reads the files of an experiment, calibrates, writes the results and prints the summary. If the `truth` of a simulated
/// experiment is given, the first data set is compared with it.
///
/// # Errors
/// Errors in the data or their files. If data are refused, a page is written before the error is returned.
pub(super) fn calibrate(
    mut experiment: ExperimentFile,
    result: &ResultArguments,
    truth: Option<&Path>,
) -> anyhow::Result<()> {
    // Read configurations and data.
    let directory = &result.out;
    let robot = &config::load::<RobotConfig>(&experiment.robot)?;
    ensure_can_write(directory)?;
    let on_terminal = OnTerminal::all_or_nothing();
    let truth = truth.map(load_truth).transpose()?;
    let logs = LogOptions {
        format: experiment.log_format,
        mapping: experiment.log_mapping.as_deref().map(|path| load_log_mapping(path, robot)).transpose()?,
    };
    let (rows, beside) = rows_of(&experiment, robot, &logs, directory)?;
    experiment.state(&rows);
    let experiment = &experiment;
    // `others` contains the files of `--validate` for each file of rows.
    let others = (experiment.bars.len() + 1..)
        .zip(experiment.rows())
        .map(|(number, (kind, file))| ValidationFile::read_all(kind, file, number, robot))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let (inputs, bars) = both(|| experiment.inputs(), || bar::runs(experiment, robot, &logs));
    let (mut bars, inputs) = (bars?, inputs?);
    experiment.ensure_distinct(&inputs)?;
    // Solve and validate, or write the page of a refusal.
    let validated = solved_and_validated(experiment, robot, &rows, &mut bars, &on_terminal);
    drop(on_terminal);
    let (calibration, evidence) =
        validated.map_err(|error| refused(directory, robot, experiment, &bars, error))?;

    // Collect the content of calibration.toml.
    let mut file = calibration_file(inputs, robot, &bars, &beside, &calibration, &evidence);
    file.noise = NoiseEntry::all(&calibration.runs, experiment.identify.noise);
    let validity = Validity::from_poses(calibration.poses(), &flange_chain(robot));
    let tables = Tables::of_rows(&calibration, &evidence.unseen, &rows, &beside, &others, robot, &validity)?;
    file.rows = tables.entries;
    file.validations = tables.validations;
    file.validity = Some(validity);
    let limits = [tables.limits, evidence.limits.clone()].concat();
    let required_m = experiment.identify.require_mm.map(|mm| mm * 1e-3);
    let mut file = file.with_verdict(&evidence.workspace, &limits, required_m);
    let bars_with_source = bars.iter().map(|run| (&run.bar, Source::find(run.bar_path)));
    // In `calibration.runs`, the files of rows come after the runs with a bar. Here, `others` contains the instruments other
    // than the bar, each with the path of its mapping.
    let runs_of_rows = &calibration.runs[calibration.runs.len() - rows.len()..];
    let mappings = experiment.rows().map(|(_, file)| file.mapping.as_path());
    let others = runs_of_rows.iter().zip(mappings);
    file.scale = Some(scale_sentence(bars_with_source, others, &evidence.workspace.budget));

    // Write the files, then the page.
    let line_numbers: Vec<&[u64]> = beside.iter().map(|beside| beside.lines.as_slice()).collect();
    let residuals = residuals_csv(&calibration, &line_numbers)?;
    let bar = bars.first().map(|run| &run.bar);
    // The tables of corrections refer to the joints of the first robot's log or, without one, of the first file of rows.
    let of_rows = || beside.iter().find(|rows| rows.aligned.is_some()).or(beside.first())?.logged.as_ref();
    let logged = bars.first().map_or_else(of_rows, |run| run.log.logged.as_ref());
    let written = write_files(&file, &residuals, robot, bar, experiment, logged, directory)?;
    let page = Page {
        file: &file,
        calibration: &calibration,
        evidence: &evidence,
        bar,
        rows: &tables.names,
        tables: &tables.text,
        sources: &bars.iter().flat_map(|run| run.sources(robot)).collect::<Vec<_>>(),
        configuration: &experiment.write(directory)?,
    };
    let page = page.write(directory).with_context(|| directory.display().to_string())?;
    // Print comparison, tables and summary.
    if let Some(truth) = &truth {
        show(wrapped(&(table::comparison(&Comparison::new(&calibration, truth)) + "\n")))?;
    }
    let runs = bars.iter().zip(calibration.bar_runs());
    let covered: String = runs.filter_map(|(run, (prepared, _))| run.covered(prepared)).collect();
    show(wrapped(&(covered + &tables.validation_lines)))?;
    let verbose = result.verbose.then(|| table::calibration(&file) + "\n" + &tables.text + &limited(&file));
    conclude(&file, verbose.as_deref(), &summary(&file, &evidence.workspace, &written, &page), &page)
}

/// Reads every file of rows. Returns the rows of each file, and in [`Beside`] the other content of the file.
fn rows_of(
    experiment: &ExperimentFile,
    robot: &RobotConfig,
    logs: &LogOptions,
    directory: &Path,
) -> anyhow::Result<(Vec<Rows>, Vec<Beside>)> {
    let context = WithLogs { robot, logs, options: &experiment.identify.prepare };
    let numbers = experiment.bars.len() + 1..;
    let read =
        experiment.rows().zip(numbers).map(|((kind, file), number)| rows::read(kind, file, number, &context));
    read.collect::<anyhow::Result<_>>().map_err(|error| match error.downcast() {
        Ok(error) => refused(directory, robot, experiment, &[], error),
        Err(error) => error,
    })
}

/// Solves all data sets together, and validates on held-out data. If a run is split at a change point, `bars` afterwards
/// contains the two parts instead of the run.
fn solved_and_validated(
    experiment: &ExperimentFile,
    robot: &RobotConfig,
    rows: &[Rows],
    bars: &mut Vec<RunFiles<'_>>,
    on_terminal: &OnTerminal,
) -> Result<(Calibration, Evidence), CalibrateError> {
    let calibration = bar::solved(experiment.split_at_changes, bars, |inputs| {
        experiment.identify.require_usual_selection()?;
        let bars = RunInput::prepare_all(inputs, robot, &experiment.identify.prepare)?;
        let data = DataSets { bars, rows: rows.to_vec() };
        calibrate::calibrate(&data, robot, &experiment.identify, Some(on_terminal))
    })?;
    let evidence = evidence(&calibration, &robot.joint_limits());
    let evidence = evidence.with_validation(&calibration, Some(on_terminal))?;
    Ok((calibration, evidence))
}

/// The content of `calibration.toml` for any instruments, without the statistics of files of rows.
fn calibration_file(
    inputs: Vec<InputFile>,
    robot: &RobotConfig,
    bars: &[RunFiles<'_>],
    beside: &[Beside],
    calibration: &Calibration,
    evidence: &Evidence,
) -> CalibrationFile {
    let solution = calibration.solution();
    let runs = bars.iter().zip(calibration.bar_runs()).enumerate();
    let bar_clocks = runs.filter_map(|(run, (files, (prepared, _)))| {
        ClockEntry::solved(calibration, run, (prepared.t_ref, files.is_dated()), &prepared.alignment)
    });
    // Data sets of rows are numbered after the runs with a bar.
    let tracker_clocks = (bars.len()..).zip(beside);
    let tracker_clocks =
        tracker_clocks.filter_map(|(number, beside)| beside.aligned.as_ref()?.clock(number, calibration));
    let mut file = CalibrationFile::new(
        &robot.name,
        &instruments(bars, &calibration.runs),
        SolveEntry::new(calibration.cost_name(), &solution.summary, &solution.identifiability),
        inputs,
        ParameterEntry::of_calibration(calibration),
    )
    .with_knowledge(solution, &calibration.solved.covariance_columns)
    .with_separation(calibration.model(), solution)
    .with_validation(evidence);
    file.clocks = bar_clocks.chain(tracker_clocks).collect();
    file.forces = evidence.spheres.iter().filter_map(ForceEntry::from_deviation).collect();
    let tables = beside.iter().filter_map(|beside| MeasurementEntry::of_table(beside.simulated));
    file.measured = bars.iter().filter_map(RunFiles::measured).chain(tables).collect();
    file.candidates.clone_from(&calibration.solved.candidates);
    file
}

/// Name of the instruments: the name of the bar if no other instrument was used, otherwise each instrument with its
/// number of data sets.
fn instruments(bars: &[RunFiles<'_>], runs: &[Run]) -> String {
    if let (Some(first), true) = (bars.first(), bars.len() == runs.len()) {
        return first.bar.name.clone();
    }
    let names: Vec<&str> = runs.iter().map(|run| run.instrument.name()).collect();
    let counted = names.chunk_by(|name, next| name == next).map(|same| match same {
        [name] => (*name).to_owned(),
        _ => format!("{} times {}", same.len(), same[0]),
    });
    counted.collect::<Vec<_>>().join(", ")
}

/// Results of all data sets: text for terminal and page, and entries for files.
#[derive(Default)]
struct Tables {
    /// Text for the page, and for the terminal with `--verbose`.
    text: String,
    /// Lines for the terminal about files of `--validate`.
    validation_lines: String,
    entries: Vec<RowsEntry>,
    validations: Vec<ValidationEntry>,
    limits: Vec<Limit>,
    /// Name of each file of rows.
    names: Vec<String>,
}

impl Tables {
    fn of_rows(
        calibration: &Calibration,
        unseen: &[UnseenPart],
        rows: &[Rows],
        beside: &[Beside],
        others: &[Vec<ValidationFile<'_>>],
        robot: &RobotConfig,
        validity: &Validity,
    ) -> anyhow::Result<Self> {
        let mut tables = Self { text: table::data_sets(calibration), ..Self::default() };
        let bars = calibration.runs.len() - rows.len();
        let sets = calibration.rows.iter().zip(rows).zip(beside.iter().zip(others));
        for (number, ((set, rows), (beside, others))) in (bars..).zip(sets) {
            let run = &calibration.runs[number];
            let Run { instrument, model } = run;
            let name = match calibration.runs.len() {
                1 => instrument.name().to_owned(),
                _ => format!("{} (data set {})", instrument.name(), number + 1),
            };
            let validate =
                |file: &ValidationFile<'_>| file.validate(rows.seed(), number + 1, robot, validity, model);
            let validations = others.iter().map(validate).collect::<anyhow::Result<Vec<_>>>()?;
            tables.validation_lines.extend(validations.iter().map(rows_report::Validation::line));
            tables.validations.extend(validations.iter().map(|validation| validation.entry.clone()));
            let unseen: Vec<&UnseenPart> = unseen.iter().filter(|part| part.data_set == number).collect();
            let table = rows_report::table(set, run, &beside.lines, &validations, &unseen);
            tables.text += &format!("\n{name}\n{table}{}", beside.set_ups());
            tables.text.extend(beside.aligned.as_ref().map(Aligned::line));
            tables.limits.extend(rows_report::left_out(set, run, [&name, &robot.name], &beside.lines));
            tables.entries.extend((!set.held_out_rows.is_empty()).then(|| RowsEntry {
                data_set: number + 1,
                hold_out: rows.hold_out(),
                seed: rows.seed(),
                names: beside.names.clone(),
                fitted: set.fitted(),
                held_out: set.held_out_with_rejected(),
                independent: Some(set.independent_held_out()),
            }));
            tables.names.push(name);
        }
        if !rows.is_empty() {
            tables.text += &rows_report::waves(calibration.model());
        }
        Ok(tables)
    }
}

fn load_truth(path: &Path) -> anyhow::Result<Truth> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    toml::from_str(&text)
        .with_context(|| format!("{} is not a truth.toml of `identify simulate`", path.display()))
}
