//! Reads logs of robots, bars and other instruments from files.
//!
//! A robot log ends up as one table, [`RobotLog`]: time stamps of the robot's own clock and joint variables of the model
//! \[rad, m\]. Everything robot-specific (motors or joints, units, signs, coupled axes) is converted here by [`JointConversion`];
//! later steps never see it. The clock is named but not relied on: logs of many controllers count from their own start, so the
//! relation to the bar's clock is found from the motion (`prepare`).
//!
//! [`BarLog`] is the other side of a run: the bar's encoders in a recording or in the file of another program.
//!
//! The other kinds of input are single poses of the robot with a measured length (draw-wire, telescoping bar:
//! [`MeasuredLengths`]), with a measured position or pose (tracker: [`MeasuredPoses`]), or with a touched socket or face
//! ([`TipRow`]). [`TimedPoses`] is a tracker's log with times instead of joints, beside a [`RobotLog`].

mod bar_log;
mod error;
mod force;
mod robot;
mod rows;
mod source;
mod tables;
mod time_series;

pub use bar_log::{
    BarLog, BarLogError, BarLogMapping, EncoderColumn, EncoderUnit, OtherBarLog, is_recording,
};
pub use error::{Cell, LogError};
pub use force::{ForceClock, ForceColumns, ForceFrame, ForceKind, ForceLog, ForceLogMapping, ForceUnit};
pub use robot::conversion::JointConversion;
pub use robot::format::LogFormat;
pub use robot::mapping::{Columns, Coupling, CsvLayout, RobotLogMapping};
pub use robot::mistake::JointMistake;
pub use robot::reader::{LogOptions, load, load_with, read, read_with};
pub use robot::table::own_columns;
pub use robot::writer::write;
pub use rows::measured_length::{
    FlangeColumns, LengthColumn, LengthRow, LengthUncertaintyColumn, MeasuredLengthMapping, MeasuredLengths,
};
pub(crate) use rows::measured_pose::SPEED_M_S_MAX;
pub use rows::measured_pose::{
    EulerFrame, MeasuredPoseMapping, MeasuredPoses, PoseRow, PoseUncertainty, PositionColumns,
    RotationColumns, RotationForm, TimedPoses, UncertaintyColumns,
};
pub use rows::pose_rows::{
    JointColumn, JointTableMapping, JointUnit, LengthUnit, drop_copies, joint_columns, joints_of_robot,
};
pub use rows::touch::{ContactMapping, ReadingColumn, TipRow, TouchMapping, Touches};
pub use tables::stamp::{TimeColumn, TimeUnit};
pub use tables::text::{Cells, RowsAsText, is_comment};
pub use time_series::sampling::{StampStep, Stamps};
pub use time_series::shared::Shared;
pub use time_series::spline::{CubicSpline, SplinePoint};
pub(crate) use time_series::stream::travel;
pub use time_series::stream::{Row, Stream};
pub use time_series::stream::{ranges, since_first_s, usual_and_longest_step_s};
pub use time_series::unwrapped::{Unwrapped, UnwrappedPoint};

use std::path::Path;
use std::sync::Arc;

use self::source::Source;
use serde::{Deserialize, Serialize};

use crate::kinematics::Joints;

/// Smallest number of rows of a log.
const ROWS_MIN: usize = 50;

/// With this word a simulated table begins after `#`, and the first event of an exported simulation.
pub(crate) const SIMULATED: &str = "SIMULATED";

/// Whether a table is marked as simulated.
///
/// # Errors
/// [`LogError::Unreadable`].
pub fn is_simulated(path: &Path) -> Result<bool, LogError> {
    let comment = format!("# {SIMULATED}");
    Ok(Source::open(path)?.beginning().starts_with(comment.as_bytes()))
}

/// Whether joint values are measured by the encoders or commanded by the controller.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Origin {
    /// Read from the robot's encoders.
    Measured,
    /// Interpolator output, without servo lag, so that results are worse. Reports state it.
    Commanded,
    /// The file states neither.
    #[default]
    Unstated,
}

impl Origin {
    /// The word that files carry.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Measured => "measured",
            Self::Commanded => "commanded",
            Self::Unstated => "unstated",
        }
    }
}

/// Quality of a log, for reports.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LogQuality {
    /// Rows that repeat the row before, stamp and values; they are dropped.
    pub duplicates_dropped: usize,
    /// Rows that repeat the joints before them under a new stamp in the middle of a motion; they are not used.
    pub repeated_dropped: usize,
    /// Rows that jump away and back faster than anything moves, mostly zeros; they are not used.
    pub excursions_dropped: usize,
    /// Rows in which a joint is missing or not a number; they are not used.
    pub incomplete_dropped: usize,
    /// The regular clock behind the stamps; `None` if there is none.
    pub stamps: Option<Stamps>,
    /// Observations that are not errors, in sentences.
    pub remarks: Vec<String>,
}

impl LogQuality {
    /// Adds remarks on repeated and incomplete rows: what rows are called, which values they repeat, what was `done` with them,
    /// and what incomplete ones `lack`.
    fn remark_counts(&mut self, row: &str, values: &str, done: &str, lack: &str) {
        let repeat = format!("repeat {values} before them in the middle of a motion");
        for (count, what) in [(self.repeated_dropped, repeat.as_str()), (self.incomplete_dropped, lack)] {
            if count > 0 {
                self.remarks.push(format!("{count} {row}s {what}; {done}"));
            }
        }
    }
}

/// A robot's joint log on its own clock.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RobotLog {
    /// Robot named in the file, where it is.
    pub robot: Option<String>,
    /// Name of the clock that made the stamps, as the file declares it (`unstated` otherwise).
    pub clock: String,
    /// Measured or commanded values.
    pub origin: Origin,
    /// Joint variables of the model \[rad, m\], at the times of the file without the jitter of the stamps.
    pub q_rad: Shared<Stream<Joints>>,
    /// Rates of the joint variables, one row per stamp \[rad/s, m/s\]; `None` if the log has none.
    pub speed_rad_s: Option<Vec<Joints>>,
    /// Torques or motor currents where the log has them, in the unit and on the axes of the file.
    pub torque: Option<Vec<Joints>>,
    /// Force on the ball-bar, from this log or from a file of its own.
    pub force: Option<ForceLog>,
    /// Quality of the log.
    pub quality: LogQuality,
}

impl RobotLog {
    /// Number of joints of each row.
    pub fn axes(&self) -> usize {
        self.q_rad.first().map_or(0, |q| q.len())
    }

    /// The joints and their rates at any time after the first row. Clones share their rows: a log of ten hours takes a
    /// gigabyte.
    ///
    /// # Errors
    /// [`LogError::NoContinuousPart`] if no part can be interpolated.
    pub fn spline(&self) -> Result<Arc<CubicSpline<Joints>>, LogError> {
        let gap_limit_s = self.q_rad.gap_limit_s;
        CubicSpline::through(self.q_rad.clone())
            .map(Arc::new)
            .ok_or(LogError::NoContinuousPart { needed: time_series::spline::KNOTS_MIN, gap_limit_s })
    }
}
