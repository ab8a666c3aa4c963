//! Reads logs of robots, bars and other instruments from files.
//!
//! A robot log of any format is read into a [`RobotLog`]: time stamps on the robot's own clock, and joint variables of the
//! model \[rad, m\]. Some properties of a log are specific to the robot: motor or joint angles, units, signs, coupled axes.
//! [`JointConversion`] converts them, so that later steps see only joint variables of the model. The log names its clock,
//! but no step relies on this name, because many controllers count time from their own start. `prepare` estimates the
//! relation between this clock and the bar's clock from the motion.
//!
//! A [`BarLog`] contains the readings of the bar's encoders during the same run, from a recording or from the file of
//! another program.
//!
//! The other inputs are tables in which each row is one pose of the robot: with a measured length (draw-wire, telescoping
//! bar: [`MeasuredLengths`]), with a measured position or pose (tracker: [`MeasuredPoses`]), or with a touched socket or
//! face ([`TipRow`]). [`TimedPoses`] is a tracker's log with time stamps instead of joints. It is used together with a
//! [`RobotLog`] of the same motion.

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
pub use error::LogError;
pub use force::{ForceClock, ForceColumns, ForceFrame, ForceKind, ForceLog, ForceLogMapping, ForceUnit};
pub use robot::conversion::JointConversion;
pub use robot::format::LogFormat;
pub use robot::logged_joints::LoggedJoints;
pub use robot::mapping::{Columns, Coupling, CsvLayout, RobotLogMapping};
pub use robot::mistake::JointMistake;
pub use robot::reader::{LogOptions, load, load_with, read, read_with};
pub use robot::table::own_columns;
pub use robot::writer::write;
pub use rows::measured_length::{
    LengthColumn, LengthRow, LengthUncertaintyColumn, MeasuredLengthMapping, MeasuredLengths,
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
pub use time_series::resolution::RESOLUTION_STEPS;
pub use time_series::sampling::{StampStep, Stamps};
pub use time_series::shared::Shared;
pub use time_series::spline::{CubicSpline, SplinePoint};
pub(crate) use time_series::stream::travel;
pub use time_series::stream::{Row, Stream};
pub use time_series::stream::{ranges, since_first_s, usual_and_longest_step_s};
pub use time_series::unwrapped::{Unwrapped, UnwrappedPoint};

use std::path::Path;
use std::sync::Arc;

use self::source::LogSource;
use serde::{Deserialize, Serialize};

use crate::kinematics::Joints;

/// Smallest number of rows of a log.
const ROWS_MIN: usize = 50;

/// Marks simulated data. A simulated table begins with `#` and this word. An exported simulation has this word at the
/// beginning of its first event.
pub(crate) const SIMULATED: &str = "SIMULATED";

/// Whether a table is marked as simulated.
///
/// # Errors
/// [`LogError::Unreadable`] if the file cannot be read.
pub fn is_simulated(path: &Path) -> Result<bool, LogError> {
    let comment = format!("# {SIMULATED}");
    Ok(LogSource::open(path)?.beginning().starts_with(comment.as_bytes()))
}

/// Whether joint values were measured by the encoders or commanded by the controller.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ValueOrigin {
    /// Read from the robot's encoders.
    Measured,
    /// Output of the controller's interpolator. Commanded values do not contain the servo lag, so results are less accurate.
    /// Reports therefore mention this origin.
    Commanded,
    /// The file does not contain this information.
    #[default]
    Unstated,
}

impl ValueOrigin {
    /// The word for this origin in files.
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
    /// Rows with the same stamp and the same values as the row before; they are dropped.
    pub duplicates_dropped: usize,
    /// Rows with a new stamp, but the same joints as the row before, in the middle of a motion; they are not used.
    pub repeated_dropped: usize,
    /// Rows that jump away and back faster than any robot moves, mostly zeros in place of missing values; they are not used.
    pub excursions_dropped: usize,
    /// Rows in which a joint is missing or not a number; they are not used.
    pub incomplete_dropped: usize,
    /// The regular clock by which the rows were sampled, as estimated from the stamps; `None` if no such clock was found.
    pub stamps: Option<Stamps>,
    /// Observations that the user should know, as sentences. None of them prevents the use of the log.
    pub remarks: Vec<String>,
}

impl LogQuality {
    /// Adds remarks on repeated and incomplete rows. They have the form "7 `noun`s repeat `values` before them in the middle
    /// of a motion; `done`" and "7 `noun`s `lack`; `done`".
    fn remark_counts(&mut self, noun: &str, values: &str, done: &str, lack: &str) {
        let repeat = format!("repeat {values} before them in the middle of a motion");
        for (count, what) in [(self.repeated_dropped, repeat.as_str()), (self.incomplete_dropped, lack)] {
            if count > 0 {
                self.remarks.push(format!("{count} {noun}s {what}; {done}"));
            }
        }
    }
}

/// A robot's joint log on its own clock.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RobotLog {
    /// Name of the robot, if the file contains it.
    pub robot: Option<String>,
    /// Name of the clock of the stamps, as the file declares it (`unstated` otherwise).
    pub clock: String,
    /// Whether the joints were measured or commanded.
    pub origin: ValueOrigin,
    /// Joint variables of the model \[rad, m\]. If a regular clock was found, the times are those of that clock, without the
    /// jitter of the stamps in the file.
    pub q_rad: Shared<Stream<Joints>>,
    /// Rates of the joint variables \[rad/s, m/s\], one row per stamp, if the log contains them.
    pub speed_rad_s: Option<Vec<Joints>>,
    /// Torques or motor currents in the unit and on the axes of the file, one row per stamp, if the log contains them.
    pub torque: Option<Vec<Joints>>,
    /// Force on the ball-bar, from this log or from a separate file.
    pub force: Option<ForceLog>,
    /// The joints as the file contains them; `None` if the log was not read from a file.
    pub logged: Option<LoggedJoints>,
    /// Quality of the log.
    pub quality: LogQuality,
}

impl RobotLog {
    /// Number of joints of each row.
    pub fn axes(&self) -> usize {
        self.q_rad.first().map_or(0, |q| q.len())
    }

    /// The joints and their rates as functions of the time since the first row. The rows of ten hours take a gigabyte, so
    /// the spline shares its rows with this log, and users of the spline share the spline.
    ///
    /// # Errors
    /// [`LogError::NoContinuousPart`] if the log has no segment with enough rows without a gap.
    pub fn spline(&self) -> Result<Arc<CubicSpline<Joints>>, LogError> {
        let gap_limit_s = self.q_rad.gap_limit_s;
        CubicSpline::through(self.q_rad.clone())
            .map(Arc::new)
            .ok_or(LogError::NoContinuousPart { needed: time_series::spline::KNOTS_MIN, gap_limit_s })
    }
}
