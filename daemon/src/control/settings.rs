//! What a service is made of.

use shared::config::{BallBarConfig, DaemonConfig};

use super::live_tap::LiveTap;
use crate::homing::MarksFile;
use crate::run::{BusChoice, Opening, RunError};
use crate::segment::faults::FaultWindow;

/// What the service is made of.
#[derive(Debug, Clone)]
pub struct Settings {
    /// Which bus.
    pub bus: BusChoice,
    /// What goes wrong on the simulated bus, on purpose.
    pub faults: Vec<FaultWindow>,
    /// `daemon.toml`.
    pub daemon: DaemonConfig,
    /// `ball_bar.toml`.
    pub bar: BallBarConfig,
    /// `homing.toml`, which need not be there.
    pub marks: MarksFile,
    /// Who else is given a run while it goes on; nobody without.
    pub live_tap: Option<LiveTap>,
}

/// Begins to bring the bus into operation; repeated until it is.
pub(crate) type Connect = dyn Fn() -> Result<Opening, RunError> + Send + Sync;
