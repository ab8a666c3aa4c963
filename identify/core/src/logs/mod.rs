//! Reads logs of robots, bars and other instruments from files.
//!
//! A robot log of any format becomes a [`RobotLog`]: time stamps of the robot's own clock, and joint variables of the model
//! \[rad, m\]. [`JointConversion`] converts whatever is specific to the robot (motors or joints, units, signs, coupled axes);
//! later steps never see it. The log names its clock, but nothing relies on that: many controllers count from their own start,
//! so `prepare` finds the relation to the bar's clock from the motion.
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
pub use error::LogError;
pub use force::{ForceClock, ForceColumns, ForceFrame, ForceKind, ForceLog, ForceLogMapping, ForceUnit};
pub use robot::conversion::JointConversion;
pub use robot::format::LogFormat;
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

/// Marks simulated data: a table begins with `#` and this word, and the first event of an exported simulation begins with it.
pub(crate) const SIMULATED: &str = "SIMULATED";

/// Whether a table is marked as simulated.
///
/// # Errors
/// [`LogError::Unreadable`].
pub fn is_simulated(path: &Path) -> Result<bool, LogError> {
    let comment = format!("# {SIMULATED}");
    Ok(LogSource::open(path)?.beginning().starts_with(comment.as_bytes()))
}

/// Whether joint values are measured by the encoders or commanded by the controller.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ValueOrigin {
    /// Read from the robot's encoders.
    Measured,
    /// Output of the interpolator. It lacks the servo lag, so that results are worse; reports state this origin.
    Commanded,
    /// The file states neither.
    #[default]
    Unstated,
}

impl ValueOrigin {
    /// Its word in files.
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
    /// Rows with the stamp and the values of the row before; they are dropped.
    pub duplicates_dropped: usize,
    /// Rows with a new stamp, but the joints of the row before, in the middle of a motion; they are not used.
    pub repeated_dropped: usize,
    /// Rows that jump away and back faster than any robot moves, mostly zeros; they are not used.
    pub excursions_dropped: usize,
    /// Rows in which a joint is missing or not a number; they are not used.
    pub incomplete_dropped: usize,
    /// The regular clock behind the stamps; `None` if there is none.
    pub stamps: Option<Stamps>,
    /// Observations that are not errors, in sentences.
    pub remarks: Vec<String>,
}

impl LogQuality {
    /// Adds remarks on repeated and incomplete rows. They read "7 `noun`s repeat `values` before them ..; `done`" and "7 `noun`s
    /// `lack`; `done`".
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
    /// Name of the robot, if the file has it.
    pub robot: Option<String>,
    /// Name of the clock that made the stamps, as the file declares it (`unstated` otherwise).
    pub clock: String,
    /// Whether the joints were measured or commanded.
    pub origin: ValueOrigin,
    /// Joint variables of the model \[rad, m\]. Jitter has been removed from the stamps of the file.
    pub q_rad: Shared<Stream<Joints>>,
    /// Rates of the joint variables \[rad/s, m/s\], one row per stamp, if the log has them.
    pub speed_rad_s: Option<Vec<Joints>>,
    /// Torques or motor currents in the unit and on the axes of the file, if the log has them.
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

    /// The joints and their rates as functions of the time since the first row. The spline is shared, and its rows with this
    /// log: those of ten hours take a gigabyte.
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
