//! The force on the ball-bar over time, on the robot's clock or on the bar's: part of the robot's log or a file of its own.

mod columns;
mod file;

pub(super) use columns::ForceLayout;
pub use columns::{ForceColumns, ForceFrame, ForceUnit};
pub use file::ForceLogMapping;

use serde::{Deserialize, Serialize};

use crate::kinematics::Joints;

/// Column of a force along the bar \[N\].
pub(super) const ALONG_COLUMN: &str = "force_N";
/// No robot meets a force \[N\] or gives a torque \[N m\] beyond this; more means a damaged file, and would overflow later.
pub(super) const FORCE_MAX: f64 = 1e7;

/// Which clock made a force's stamps.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ForceClock {
    /// That of the robot's log.
    #[default]
    Robot,
    /// That of the bar's recording: UTC, where it is one of ours.
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

/// What was measured. No sign convention is expected: which sign is tension is found by the calibration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ForceKind {
    /// Along the bar \[N\], as a load cell in it says.
    Along,
    /// Only on which side the bar is loaded: -1, 0 or 1.
    Sign,
    /// x, y, z in the flange's axes \[N\], as a sensor between flange and bar says.
    InFlange,
    /// x, y, z in the axes of the robot's base \[N\].
    InBase,
    /// Torques of the robot's joints \[N m\], with whatever gravity and friction add to them.
    JointTorques,
}

impl ForceKind {
    /// In words.
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
    /// What the numbers are.
    pub kind: ForceKind,
    /// First stamp \[ns on that clock\].
    pub first_stamp_ns: i64,
    /// Stamps relative to the first \[s\], strictly increasing, the first is 0.
    pub t_s: Vec<f64>,
    /// One row per stamp, as many numbers as its kind has \[N or N m\].
    pub values: Vec<Joints>,
}

impl ForceLog {
    /// Longest distance of two stamps that is bridged \[s\]: 0.1 s, or 3.5 periods of a slower log.
    pub fn gap_limit_s(&self) -> f64 {
        let mut steps_s: Vec<f64> = self.t_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
        steps_s.sort_by(f64::total_cmp);
        steps_s.get(steps_s.len() / 2).map_or(0.1, |period_s| (3.5 * period_s).max(0.1))
    }

    /// The numbers at a time after the first stamp, on a straight line between two rows: forces jump where friction changes
    /// sides, and a smooth curve would swing there. None beyond the ends and in holes longer than `gap_limit_s`.
    pub fn at(&self, since_first_s: f64, gap_limit_s: f64) -> Option<Joints> {
        let after = self.t_s.partition_point(|stamp| *stamp < since_first_s).max(1);
        let (from_s, to_s) = (*self.t_s.get(after - 1)?, *self.t_s.get(after)?);
        let (from, to) = (self.values.get(after - 1)?, self.values.get(after)?);
        if since_first_s < from_s || to_s - from_s > gap_limit_s {
            return None;
        }
        let part = (since_first_s - from_s) / (to_s - from_s);
        Some(from.iter().zip(to).map(|(from, to)| from + part * (to - from)).collect())
    }
}
