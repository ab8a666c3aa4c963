//! The force on the ball-bar over time, on the robot's clock or on the bar's: part of the robot's log or a file of its own.

mod columns;
mod file;

pub(super) use columns::ForceLayout;
pub use columns::{ForceColumns, ForceFrame, ForceUnit};
pub use file::ForceLogMapping;

use serde::{Deserialize, Serialize};

use crate::kinematics::Joints;
use crate::logs::Stream;

/// Column of a force along the bar \[N\].
pub(super) const ALONG_COLUMN: &str = "force_N";
/// Largest force \[N\] or torque \[N m\]; a larger number means a damaged file, and would overflow later.
pub(super) const FORCE_MAX: f64 = 1e7;

/// Which clock made a force's stamps.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ForceClock {
    /// That of the robot's log.
    #[default]
    Robot,
    /// The clock of the bar's recording: UTC for recordings of `ballbard`.
    Bar,
}

impl ForceClock {
    /// The word that files carry.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Robot => "robot",
            Self::Bar => "bar",
        }
    }
}

/// The measured quantity. No sign convention is required: the calibration finds which sign is tension.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ForceKind {
    /// Along the bar \[N\], as a load cell in it measures.
    Along,
    /// Only the side on which the bar is loaded: -1, 0 or 1.
    Sign,
    /// x, y, z in the flange's axes \[N\], as a sensor between flange and bar measures.
    InFlange,
    /// x, y, z in the axes of the robot's base \[N\].
    InBase,
    /// Torques of the robot's joints \[N m\], with whatever gravity and friction add to them.
    JointTorques,
}

impl ForceKind {
    /// Name of the kind in messages.
    pub const fn describe(self) -> &'static str {
        match self {
            Self::Along => "force along the bar",
            Self::Sign => "sign of the force along the bar",
            Self::InFlange => "force in the flange's axes",
            Self::InBase => "force in the axes of the robot's base",
            Self::JointTorques => "torques of the robot's joints",
        }
    }
}

/// A force over time.
#[derive(Debug, Clone, PartialEq)]
pub struct ForceLog {
    /// Which clock made the stamps.
    pub clock: ForceClock,
    /// Quantity of the values.
    pub kind: ForceKind,
    /// Rows of as many numbers as its kind has \[N or N m\].
    pub values: Stream<Joints>,
}

impl ForceLog {
    /// A force whose rows are interpolated over gaps of up to 0.1 s, twice as long as for joints, or 3.5 periods of a slower log.
    pub fn new(clock: ForceClock, kind: ForceKind, values: Stream<Joints>) -> Self {
        let gap_limit_s = (3.5 * values.period_s()).max(0.1);
        Self { clock, kind, values: values.with_gap_limit(gap_limit_s) }
    }
}
