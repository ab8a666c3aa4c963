//! `identify calibrate contact`: a ball on the flange that is seated in sockets whose distances are known.

use std::path::{Path, PathBuf};

use clap::Args;
use shared::config::{self, RobotConfig};

use super::experiment::{Experiment, RowFile};
use super::{CommonArguments, RowArguments};
use crate::instrument::{ContactRow, SocketTable};
use crate::logs::{ContactMapping, Contacts, joints_of_robot};
use crate::solver::LossName;

/// What a calibration with a ball in sockets is told.
#[derive(Debug, Args)]
pub struct ContactArguments {
    /// Poses at which the ball is seated, and in which socket (.csv), rows in the order of the robot's motion
    #[arg(value_name = "FILE")]
    contacts: PathBuf,
    /// Where the sockets are on their plate, or their distances, such as config/sockets.toml
    #[arg(long, value_name = "FILE")]
    sockets: PathBuf,
    #[command(flatten)]
    rows: RowArguments,
    /// How much rows count that do not fit; default: huber
    #[arg(long)]
    loss: Option<LossName>,
    #[command(flatten)]
    common: CommonArguments,
}

/// A file of rows as it was read.
pub(super) struct Read {
    pub(super) rows: Vec<ContactRow>,
    /// Of each row in its file.
    pub(super) lines: Vec<u64>,
    pub(super) table: SocketTable,
}

/// The rows of a file, read as the file of its mapping says, with the table of their sockets.
pub(super) fn read(path: &Path, mapping: &Path, sockets: &Path, robot: &RobotConfig) -> anyhow::Result<Read> {
    let table: SocketTable = config::load(sockets)?;
    let of_file: ContactMapping = config::load(mapping)?;
    joints_of_robot(&of_file.joints, robot, mapping)?;
    let read = Contacts::load(path, &of_file, &table.names())?;
    let (rows, lines) = read.rows.iter().map(|row| (ContactRow::from(row), row.line)).unzip();
    Ok(Read { rows, lines, table })
}

/// Reads, calibrates, writes and prints.
pub(super) fn run(arguments: &ContactArguments) -> anyhow::Result<()> {
    let ContactArguments { contacts, sockets, rows, loss, common } = arguments;
    let (mut experiment, row_file) = Experiment::of_rows(common, rows, contacts);
    experiment.identify.loss = *loss;
    experiment.contacts.push(RowFile { sockets: Some(sockets.clone()), ..row_file });
    super::experiment::mixed(experiment, &common.out)
}
