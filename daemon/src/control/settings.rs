//! Everything that is configured when the service starts: bus, injected faults, configuration files, publication of messages.

use shared::config::{BallBarConfig, DaemonConfig};

use super::live_tap::LiveTap;
use crate::homing::MarksFile;
use crate::run::{BusChoice, Opening, RunError};
use crate::segment::faults::FaultWindow;

/// Configuration of the service.
#[derive(Debug, Clone)]
pub struct Settings {
    /// The bus to record from.
    pub bus: BusChoice,
    /// Faults to inject into the simulated bus.
    pub faults: Vec<FaultWindow>,
    /// `daemon.toml`.
    pub daemon: DaemonConfig,
    /// `ball_bar.toml`.
    pub bar: BallBarConfig,
    /// `homing.toml`, which may be missing.
    pub marks_file: MarksFile,
    /// Publishes a run while it is recorded.
    pub live_tap: Option<LiveTap>,
}

/// Starts to bring the bus into operation. The controller calls this function again until the bus operates.
pub(crate) type Connect = dyn Fn() -> Result<Opening, RunError> + Send + Sync;
