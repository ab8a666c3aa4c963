//! The force on the ball-bar over time, on the robot's clock or on the bar's clock. The values are in columns of the robot's
//! log or in a separate file. `columns` finds and reads the columns, `file` reads a separate file.

mod columns;
mod file;

pub(super) use columns::ForceLayout;
pub use columns::{ForceColumns, ForceFrame, ForceUnit};
pub use file::ForceLogMapping;

use serde::{Deserialize, Serialize};

use crate::kinematics::Joints;
use crate::logs::Stream;

/// Name of the column with the force along the bar \[N\].
pub(super) const ALONG_COLUMN: &str = "force_N";
/// Largest valid force \[N\] or torque \[N m\]. A larger number means that the file is damaged, and would cause an overflow.
pub(super) const FORCE_MAX: f64 = 1e7;

/// Clock of the stamps of a force.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ForceClock {
    /// The clock of the robot's log.
    #[default]
    Robot,
    /// The clock of the bar's recording: UTC for recordings of `ballbard`.
    Bar,
}

impl ForceClock {
    /// The word for this clock in files.
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
    /// Force along the bar \[N\], as measured by a load cell in the bar.
    Along,
    /// Only the sign of the force along the bar: -1, 0 or 1.
    Sign,
    /// Force x, y, z in the flange's axes \[N\], as measured by a sensor between flange and bar.
    InFlange,
    /// Force x, y, z in the axes of the robot's base \[N\].
    InBase,
    /// Torques of the robot's joints \[N m\]. They include the effects of gravity and friction.
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
    /// Clock of the stamps.
    pub clock: ForceClock,
    /// Quantity of the values.
    pub kind: ForceKind,
    /// Values \[N or N m\]. The number of values per row depends on `kind`.
    pub values: Stream<Joints>,
}

impl ForceLog {
    /// Creates a force. It is interpolated over gaps of up to 0.1 s, or up to 3.5 periods if these are longer. 0.1 s is
    /// twice the limit for joints.
    pub fn new(clock: ForceClock, kind: ForceKind, values: Stream<Joints>) -> Self {
        let gap_limit_s = (3.5 * values.period_s()).max(0.1);
        Self { clock, kind, values: values.with_gap_limit(gap_limit_s) }
    }
}
