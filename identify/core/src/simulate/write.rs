//! Writes a simulated experiment to files in the formats of a real experiment, and the true parameters to another file
//! in the same directory.

use std::path::{Path, PathBuf};

use shared::config::{self, BallBarConfig, RobotConfig};
use shared::recording::RecordingWriter;
use shared::recording::schema::{RunMetadata, SIMULATED_BUS};
use shared::version::software;

use super::Simulated;
use super::sample::CYCLE_NS;
use crate::logs::{self, LogError};

/// Paths of the files of a simulated experiment.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SimulationFiles {
    /// The bar's recording.
    pub recording: PathBuf,
    /// The robot's log.
    pub robot_log: PathBuf,
    /// File of the true parameters.
    pub truth: PathBuf,
}

/// Why the files cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum SimulationWriteError {
    /// The recording cannot be written.
    #[error(transparent)]
    Recording(#[from] shared::recording::WriteError),
    /// Robot log or truth cannot be written.
    #[error(transparent)]
    File(#[from] LogError),
    /// TOML cannot represent the truth.
    #[error("the true parameters cannot be written as TOML: {0}; use finite effects and clocks")]
    Truth(#[from] toml::ser::Error),
}

/// Writes `recording.mcap`, `robot_log.csv` and `truth.toml` to `directory`. Creates the directory if it does not exist.
///
/// # Errors
/// [`SimulationWriteError`], also if the recording exists: it is never overwritten.
pub fn write(
    directory: &Path,
    simulated: &Simulated,
    robot: &RobotConfig,
    bar: &BallBarConfig,
) -> Result<SimulationFiles, SimulationWriteError> {
    const RECORDING: &str = "recording";
    let files = SimulationFiles {
        recording: directory.join(format!("{RECORDING}.mcap")),
        robot_log: directory.join("robot_log.csv"),
        truth: directory.join("truth.toml"),
    };
    let truth = config::to_toml(&simulated.truth)?;
    let mut writer = RecordingWriter::create(directory, &metadata(RECORDING, simulated, robot, bar)?)?;
    for cycle in &simulated.cycles {
        writer.write_cycle(cycle)?;
    }
    let ended = simulated.cycles.last().map_or(simulated.truth.clock.bar_start, |cycle| cycle.sample_time);
    writer.finish("the simulated path is over", ended)?;

    let unwritable = |path: &Path| {
        let path = path.to_owned();
        move |source| LogError::Unwritable { path, source }
    };
    let sink = std::fs::File::create(&files.robot_log).map_err(unwritable(&files.robot_log))?;
    logs::write(&simulated.robot_log, robot, sink).map_err(unwritable(&files.robot_log))?;
    std::fs::write(&files.truth, truth).map_err(unwritable(&files.truth))?;
    Ok(files)
}

fn metadata(
    name: &str,
    simulated: &Simulated,
    robot: &RobotConfig,
    bar: &BallBarConfig,
) -> Result<RunMetadata, toml::ser::Error> {
    let started = simulated.truth.clock.bar_start;
    let monotonic_ns = simulated.cycles.first().map_or(0, |cycle| cycle.send_time.0);
    Ok(RunMetadata {
        name: name.to_owned(),
        operator: String::new(),
        robot: robot.name.clone(),
        bar: String::new(),
        payload: String::new(),
        note: format!("simulated from known parameters, seed {}", simulated.truth.seed),
        started,
        software: software("identify"),
        bus: SIMULATED_BUS.into(),
        replay_of: None,
        cycle_period_ns: CYCLE_NS as u64,
        distributed_clocks: true,
        utc_minus_monotonic_ns: started.0.saturating_sub(monotonic_ns),
        encoders: simulated.encoders.clone(),
        devices: Vec::new(),
        daemon_config: String::new(),
        ball_bar_config: config::to_toml(bar)?,
    })
}
