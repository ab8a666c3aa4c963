//! `identify calibrate bar`, which converts its options to an experiment. For all calibrations, the `driver`
//! uses this module to read the recordings of the ball-bar with the robot's logs ([`runs`]), and to split a run
//! at a change point ([`solved`]).

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::Args;
use shared::config::{self, BallBarConfig, RobotConfig};
use shared::recording::schema::CycleRecord;

use super::CommonArguments;
use super::driver::calibrate;
use super::experiment::{BarRunFiles, ExperimentFile};
use super::rows::warn_of;
use crate::calibrate::{CalibrateError, RunInput};
use crate::inspect::{self, curves};
use crate::instrument::CostName;
use crate::logs::{
    self, BarLog, BarLogMapping, ForceLog, ForceLogMapping, LogFormat, LogOptions, RobotLog, is_recording,
};
use crate::prepare::{EncoderMapChoice, Prepared, SampleStatus, bar_angles};
use crate::report::page::InspectedLog;
use crate::report::result::file::MeasurementEntry;
use crate::threads::both;

/// Options of a calibration with the ball-bar.
#[derive(Debug, Args)]
pub struct BarArguments {
    /// Recording of the ball-bar: .mcap, CSV with counters, or ROS 2 bag. Repeat the option to solve
    /// several runs of one robot together
    #[arg(long, help_heading = "Input", value_name = "FILE", required = true)]
    pub(super) recording: Vec<PathBuf>,
    /// Mapping file for recordings of other programs (names their columns or joints), such as config/bar_log.toml
    #[arg(long, help_heading = "Input", value_name = "FILE")]
    pub(super) recording_mapping: Option<PathBuf>,
    /// Log of the robot (CSV, ROS 2 bag, UR RTDE, ABB EGM, KUKA RSI); repeat the option to give one for
    /// each recording, in the same order
    #[arg(long, help_heading = "Input", value_name = "FILE", required = true)]
    pub(super) robot_log: Vec<PathBuf>,
    /// Format of the robot's logs; default: detected from their content
    #[arg(long, help_heading = "Input", value_name = "KIND")]
    pub(super) log_format: Option<LogFormat>,
    /// Mapping file for the robot's logs (names their columns or joints), such as config/robot_log.toml; default:
    /// `[log]` of the robot's configuration
    #[arg(long, help_heading = "Input", value_name = "FILE")]
    pub(super) log_mapping: Option<PathBuf>,
    /// File with the force on the bar (.csv with t_s and force_N), timed by the robot's clock or the bar's; one for each
    /// recording. A force in the robot's log is then ignored
    #[arg(long, help_heading = "Input", value_name = "FILE")]
    pub(super) force_log: Vec<PathBuf>,
    /// Mapping file for the force logs (names their columns), such as config/force_log.toml
    #[arg(long, help_heading = "Input", value_name = "FILE", requires = "force_log")]
    pub(super) force_mapping: Option<PathBuf>,
    /// Treat the bar as rigid, even if the robot's log contains the force on it
    #[arg(long, help_heading = "Estimation", conflicts_with = "force_log")]
    pub(super) ignore_force: bool,
    /// Configuration file of the bar: one for all recordings, or one for each. `ball_bar` is ball_bar.toml in config, else
    /// in /etc/ballbard, else the built-in one
    #[arg(long, help_heading = "Input", value_name = "FILE", default_value = "ball_bar")]
    pub(super) bar: Vec<PathBuf>,
    /// If an encoder slips, a clock jumps or the bar is moved at one instant, split the run there. Each part has its own
    /// clock parameters, bar base and encoder offsets
    #[arg(long, help_heading = "Estimation")]
    pub(super) split_at_changes: bool,
    #[command(flatten)]
    pub(super) common: CommonArguments,
    /// Cost function; default: the first one in this list whose encoders the bar has
    #[arg(long, help_heading = "Estimation")]
    pub(super) cost: Option<CostName>,
    /// Joint and direction of each encoder. `find` corrects the recorded ones if they do not fit, `recorded` refuses the run
    /// instead. A list such as 1,2,-3,5,4 has the joint of each recorded encoder, negative if it counts opposite to the
    /// recorded direction. Default: find
    #[arg(long, help_heading = "Estimation", value_name = "ENCODERS", allow_hyphen_values = true)]
    pub(super) encoders: Option<EncoderMapChoice>,
    /// File with the true parameters of a simulated experiment, to compare with the result; only
    /// the first recording is compared
    #[arg(long, help_heading = "Input", value_name = "FILE")]
    pub(super) truth: Option<PathBuf>,
}

/// Converts the options to an experiment.
fn experiment(arguments: &BarArguments) -> anyhow::Result<ExperimentFile> {
    let BarArguments { recording, robot_log, bar, force_log, .. } = arguments;
    let runs = recording.len();
    anyhow::ensure!(
        runs == robot_log.len(),
        "{runs} recordings and {} robot logs; give one --robot-log for each --recording, in the same order",
        robot_log.len()
    );
    anyhow::ensure!(
        bar.len() == 1 || bar.len() == runs,
        "{runs} recordings and {} bars; give one --bar for all, or one for each --recording",
        bar.len()
    );
    anyhow::ensure!(
        force_log.is_empty() || force_log.len() == runs,
        "{runs} recordings and {} force logs; give one --force-log for each --recording, in the same order, or none",
        force_log.len()
    );
    let mut bars = Vec::with_capacity(runs);
    for (run, ((recording, robot_log), bar)) in
        recording.iter().zip(robot_log).zip(bar.iter().cycle()).enumerate()
    {
        bars.push(BarRunFiles {
            recording: recording.clone(),
            robot_log: robot_log.clone(),
            bar: bar.clone(),
            force_log: force_log.get(run).cloned(),
        });
    }
    let mut common = arguments.common.experiment()?;
    common.identify.cost = arguments.cost.or(common.identify.cost);
    if let Some(encoders) = &arguments.encoders {
        common.identify.prepare.encoders.clone_from(encoders);
    }
    Ok(ExperimentFile {
        recording_mapping: arguments.recording_mapping.clone(),
        log_format: arguments.log_format,
        log_mapping: arguments.log_mapping.clone(),
        force_mapping: arguments.force_mapping.clone(),
        ignore_force: arguments.ignore_force,
        split_at_changes: arguments.split_at_changes,
        bars,
        ..common
    })
}

pub(super) fn run(arguments: &BarArguments) -> anyhow::Result<()> {
    calibrate(experiment(arguments)?, &arguments.common.result, arguments.truth.as_deref())
}

/// Content of the files of one run or, after a split at a change point, of one part of the run. Parts of a
/// run share the files.
#[derive(Clone)]
pub(super) struct RunFiles<'a> {
    pub(super) recording_path: &'a Path,
    pub(super) log_path: &'a Path,
    pub(super) recording: Arc<BarLog>,
    /// Range of the cycles of the recording that belong to this run or part.
    cycles: Range<usize>,
    pub(super) log: Arc<RobotLog>,
    pub(super) bar: BallBarConfig,
    /// Configuration file of the bar.
    pub(super) bar_path: &'a Path,
}

impl RunFiles<'_> {
    pub(super) fn input(&self) -> RunInput<'_> {
        RunInput {
            cycles: self.cycles(),
            encoders: self.recording.encoders(),
            unwrapped: self.recording.unwrapped(),
            log: &self.log,
            bar: &self.bar,
        }
    }

    pub(super) fn cycles(&self) -> &[CycleRecord] {
        self.recording.cycles().get(self.cycles.clone()).unwrap_or_default()
    }

    /// Splits the run at the time `at_s`, which counts from the first valid sample \[s\]. `None` if one of the two
    /// parts would be empty.
    fn cut(&self, at_s: f64) -> Option<[Self; 2]> {
        let angles = bar_angles(self.cycles(), self.recording.encoders()).ok()?;
        let first = angles.first_time();
        let is_before = |cycle: &&CycleRecord| cycle.sample_time.seconds_since(first) < at_s;
        let boundary = self.cycles.start + self.cycles().iter().take_while(is_before).count();
        let part = |cycles: Range<usize>| (!cycles.is_empty()).then(|| Self { cycles, ..self.clone() });
        Some([part(self.cycles.start..boundary)?, part(boundary..self.cycles.end)?])
    }

    /// A line about the part of the recording that the robot's log covers; `None` if it covers the whole recording.
    pub(super) fn covered(&self, prepared: &Prepared) -> Option<String> {
        let (recorded, outside) = (prepared.counts.recorded(), prepared.counts.of(SampleStatus::Outside));
        let overlap_s = prepared.alignment.overlap_s;
        let first = self.cycles().first().map_or(prepared.t_ref, |cycle| cycle.sample_time);
        // The reference time is the middle of the overlap.
        let from_s = (prepared.t_ref.seconds_since(first) - 0.5 * overlap_s).max(0.0);
        (outside > 0).then(|| {
            format!(
                "{} covers {from_s:.1} s to {:.1} s of the recording: {outside} of {recorded} cycles are outside it, or in its gaps, and not used\n",
                self.log_path.display(),
                from_s + overlap_s
            )
        })
    }

    /// Whether the recording's clock shows a date.
    pub(super) fn is_dated(&self) -> bool {
        !matches!(&*self.recording, BarLog::Other(other) if !other.is_dated)
    }

    /// Inspections of the recording and of the robot's log, without curves.
    pub(super) fn sources(&self, robot: &RobotConfig) -> [InspectedLog; 2] {
        let recording = || match &*self.recording {
            BarLog::Recording(recording) => inspect::recording(recording),
            BarLog::Other(other) => inspect::bar_log(other),
        };
        let (recording, robot_log) = both(recording, || inspect::robot_log(&self.log, robot));
        let source = |role, path: &Path, inspection| {
            let path = path.to_owned();
            InspectedLog { role, path, inspection, curves: Vec::new() }
        };
        [source("recording", self.recording_path, recording), source("robot log", self.log_path, robot_log)]
    }

    /// As [`Self::sources`], with curves of the joints over time.
    pub(super) fn sources_with_curves(&self, robot: &RobotConfig) -> [InspectedLog; 2] {
        let [recording, robot_log] = self.sources(robot);
        let of_bar = curves::of_bar(self.cycles(), self.recording.encoders());
        let of_robot = curves::of_robot(&self.log, robot);
        [InspectedLog { curves: of_bar, ..recording }, InspectedLog { curves: of_robot, ..robot_log }]
    }

    /// Description of the measurement from the recording. For a file of another program, the description contains only that
    /// the data were simulated. `None` if such a file contains measured data.
    pub(super) fn measured(&self) -> Option<MeasurementEntry> {
        match &*self.recording {
            BarLog::Recording(recording) => Some((&recording.run).into()),
            BarLog::Other(other) => MeasurementEntry::of_table(other.simulated),
        }
    }
}

/// Reads the files of all runs of an experiment.
pub(super) fn runs<'a>(
    experiment: &'a ExperimentFile,
    robot: &RobotConfig,
    logs: &LogOptions,
) -> anyhow::Result<Vec<RunFiles<'a>>> {
    let bar_mapping: Option<BarLogMapping> =
        experiment.recording_mapping.as_deref().map(config::load).transpose()?;
    let force_mapping: Option<ForceLogMapping> =
        experiment.force_mapping.as_deref().map(config::load).transpose()?;
    let read_run = |run: &'a BarRunFiles| {
        let force = run.force_log.as_deref().map(|path| ForceLog::load(path, robot, force_mapping.as_ref()));
        let force = force.transpose()?;
        let bar: BallBarConfig = config::load(&run.bar)?;
        let (recording, log) = both(
            || BarLog::load(&run.recording, &bar, bar_mapping.as_ref()),
            || load_log(&run.robot_log, robot, logs),
        );
        let (mut log, recording) = (log?, recording?);
        // In this thread, because the Python package collects only the warnings of the thread that runs the command.
        log_anomalies(&run.recording, &recording);
        log.force = if experiment.ignore_force { None } else { force.or(log.force) };
        Ok(RunFiles {
            cycles: 0..recording.cycles().len(),
            recording: Arc::new(recording),
            log: Arc::new(log),
            bar,
            bar_path: &run.bar,
            recording_path: &run.recording,
            log_path: &run.robot_log,
        })
    };
    let files: Vec<RunFiles<'_>> = experiment.bars.iter().map(read_run).collect::<anyhow::Result<_>>()?;
    let is_other = |run: &RunFiles<'_>| matches!(&*run.recording, BarLog::Other(_));
    anyhow::ensure!(
        bar_mapping.is_none() || files.iter().any(is_other),
        "--recording-mapping is for files of other programs, and each recording is one of ballbard; leave it out"
    );
    Ok(files)
}

/// Logs the anomalies of a file of another program, and the information that it does not contain.
fn log_anomalies(path: &Path, recording: &BarLog) {
    let BarLog::Other(other) = recording else { return };
    tracing::info!("{}: {}; it does not contain {}", path.display(), other.kind, other.unknown.join(", "));
    warn_of(path, &other.quality.remarks);
}

/// Reads a robot's log and logs its anomalies.
pub(super) fn load_log(path: &Path, robot: &RobotConfig, options: &LogOptions) -> anyhow::Result<RobotLog> {
    anyhow::ensure!(
        !is_recording(path).unwrap_or(false),
        "{} is a recording of the ball-bar, not a robot's log; exchange the files of --recording and --robot-log",
        path.display()
    );
    let log = logs::load_with(path, robot, options)?;
    warn_of(path, &log.quality.remarks);
    Ok(log)
}

/// Solves the runs with `solve`. With `split_at_changes`, a run that is refused because of a change point at a known time is
/// replaced by its two parts, and all runs are solved again.
pub(super) fn solved<T>(
    split_at_changes: bool,
    runs: &mut Vec<RunFiles<'_>>,
    solve: impl Fn(&[RunInput<'_>]) -> Result<T, CalibrateError>,
) -> Result<T, CalibrateError> {
    /// Largest number of cuts of one run. A run with more change points is not usable.
    const CUTS_MAX: usize = 8;
    loop {
        let inputs: Vec<RunInput<'_>> = runs.iter().map(RunFiles::input).collect();
        let refused = match solve(&inputs) {
            Err(refused) if split_at_changes => refused,
            result => return result,
        };
        let CalibrateError::Prepare { run, error } = &refused else { return Err(refused) };
        let cut = |at_s| {
            let changed = runs.get(*run)?;
            // A run and its parts have the same recording, so the parts are found by their recording.
            let parts = runs.iter().filter(|part| Arc::ptr_eq(&part.recording, &changed.recording));
            if parts.count() > CUTS_MAX { None } else { Some((at_s, changed.cut(at_s)?)) }
        };
        let Some((at_s, parts)) = error.parts_at_s().and_then(cut) else { return Err(refused) };
        tracing::warn!(
            "{}: calibrated in two parts, cut {at_s:.2} s after the first sample: {error}",
            parts[0].recording_path.display()
        );
        runs.splice(run..=run, parts);
    }
}

#[cfg(test)]
mod tests {
    use shared::recording::schema::EncoderSample;
    use shared::time::UtcNs;

    use super::*;
    use crate::logs::OtherBarLog;
    use crate::prepare::PrepareError;

    const CYCLES: usize = 60;

    /// One cycle per second, of a bar at rest.
    fn run() -> RunFiles<'static> {
        let cycle = |second: i64| {
            let sample_time = UtcNs(second * 1_000_000_000);
            let mut cycle = CycleRecord { sample_time, encoder_count: 1, ..CycleRecord::default() };
            cycle.encoders[0] = EncoderSample { valid: true, ..EncoderSample::default() };
            cycle
        };
        let cycles = (0..CYCLES as i64).map(cycle).collect();
        let path = Path::new("ball_bar");
        RunFiles {
            recording_path: path,
            log_path: path,
            recording: Arc::new(BarLog::Other(Box::new(OtherBarLog { cycles, ..OtherBarLog::default() }))),
            cycles: 0..CYCLES,
            log: Arc::default(),
            bar: config::load(path).unwrap(),
            bar_path: path,
        }
    }

    fn clock_jump(run: usize, at_s: f64) -> CalibrateError {
        CalibrateError::Prepare { run, error: Box::new(PrepareError::ClockJump { at_s, by_ms: 20.0 }) }
    }

    /// Refuses each run that was not cut. Returns the number of parts.
    fn one_jump_each(inputs: &[RunInput<'_>]) -> Result<usize, CalibrateError> {
        let whole = inputs.iter().position(|input| input.cycles.len() == CYCLES);
        whole.map_or(Ok(inputs.len()), |run| Err(clock_jump(run, 30.0)))
    }

    fn always_a_jump(inputs: &[RunInput<'_>]) -> Result<usize, CalibrateError> {
        Err(clock_jump(inputs.len() - 1, 1.0))
    }

    #[test]
    fn each_run_may_be_cut_however_many_are_calibrated_together() {
        let mut runs: Vec<_> = (0..9).map(|_| run()).collect();
        assert_eq!(solved(true, &mut runs, one_jump_each).unwrap(), 18);
        assert!(solved(false, &mut vec![run()], one_jump_each).is_err());
    }

    #[test]
    fn a_run_that_changes_all_the_time_is_refused() {
        let mut runs = vec![run()];
        assert!(solved(true, &mut runs, always_a_jump).is_err());
        assert_eq!(runs.len(), 9);
    }
}
