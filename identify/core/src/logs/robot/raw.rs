//! Collects the rows of a robot log in the order of the file ([`RawLog::push`]). When all rows were read, [`RawLog::finish`]
//! checks the log as a whole and returns a [`RobotLog`]. The readers of all formats use this module.
//!
//! [`RawLog::finish`] converts the values to the model's joints ([`Meaning`]), removes excursions and repeated rows, checks
//! the joint limits, estimates the times of the rows, and adds remarks on the quality of the log.

use std::path::{Path, PathBuf};

use shared::config::{AngleUnit, JointKind, RobotConfig};
use shared::output::named;

use super::logged_joints::LoggedJoints;
use super::mapping::RobotLogMapping;
use crate::kinematics::{Joints, wrapped};
use crate::logs::force::FORCE_MAX;
use crate::logs::rows::pose_rows::{JointUnit, joints_of_robot};
use crate::logs::time_series::excursions::{Excursions, Fastest, remark};
use crate::logs::time_series::frozen::repeated_rows;
use crate::logs::time_series::resolution::resolutions;
use crate::logs::time_series::sampling::Stamps;
use crate::logs::time_series::stream::{remark_equal, retain};
use crate::logs::{
    ForceClock, ForceKind, ForceLog, JointMistake, LogError, LogFormat, ROWS_MIN, RobotLog, Stream,
    ValueOrigin, since_first_s, travel,
};
use crate::statistics::{extremes, largest_size};
use crate::threads;

/// Distance by which joint values may exceed the nominal limits before a log is rejected \[deg\], because the zero positions
/// of real robots differ a little from the data sheet. For prismatic axes the value in radians counts as metres, 35 mm.
const LIMIT_SLACK_DEG: f64 = 2.0;
/// If no joint moves by more than this, a remark is added, because such a log does not determine any parameter \[deg\].
const MOTION_DEG_MIN: f64 = 5.0;
/// Upper bounds of a robot's motion. The wrists of small robots reach 1500 deg/s within 0.13 s.
const FASTEST: Fastest = Fastest { speed: 30.0, acceleration: 200.0 };
/// If the values have larger steps, a remark is added \[rad, m\]. The standard deviation of the rounding errors is then larger
/// than the noise that the estimator assumes: `noise.robot_urad` is 15, times `sqrt(12)`.
const RESOLUTION_MAX: f64 = 52e-6;

/// One row of a log, in the units of the file.
#[derive(Debug, Clone, Default)]
pub(in crate::logs) struct RawRobotRow {
    /// Line number in the file, or number of the message.
    pub place: u64,
    /// Stamp on the clock of the file \[ns\].
    pub stamp_ns: i64,
    /// Values of the joints; NaN for a missing value.
    pub joints: Joints,
    pub speeds: Option<Joints>,
    pub torques: Option<Joints>,
    /// Force on the bar \[N or N m\]. [`RawLog::force`] is its kind.
    pub force: Option<Joints>,
}

/// Rows in the order of the file; their stamps do not decrease. Each quantity has its own vector, because ten hours have ten
/// million rows and most logs contain neither speeds nor torques.
#[derive(Default)]
pub(in crate::logs) struct RawLog {
    path: PathBuf,
    /// Name of a row: `line`, `message` or `telegram`.
    what: &'static str,
    /// Line or number of each row in the file.
    places: Vec<u64>,
    stamps_ns: Vec<i64>,
    /// Joints of each row, in the units of the conversion. [`Self::finish`] replaces them by joint variables \[rad, m\].
    joints: Vec<Joints>,
    /// Speeds, torques and force of each row. Each of them is only used if all rows contain it.
    more: [Vec<Joints>; 3],
    /// Properties of the log other than its rows.
    pub log: RobotLog,
    /// Kind of the force on the bar, if the log contains it. If the kind is joint torques and the force has no
    /// columns, the torques of the rows are used.
    pub force: Option<ForceKind>,
}

/// The meaning of the joints in a file.
pub(in crate::logs) struct Meaning<'a> {
    robot: &'a RobotConfig,
    /// Whether a mapping names the joints.
    is_mapped: bool,
    /// Names, units and conversion of the joints in the file.
    pub logged: LoggedJoints,
}

impl<'a> Meaning<'a> {
    /// The conversion in a mapping that names joints.
    pub fn mapped(
        robot: &'a RobotConfig,
        mapping: &RobotLogMapping,
        names: Vec<String>,
        path: &Path,
    ) -> Result<Self, LogError> {
        joints_of_robot(&mapping.joints, robot, path)?;
        let logged = LoggedJoints { names, ..LoggedJoints::of_mapping(mapping)? };
        Ok(Self { robot, is_mapped: true, logged })
    }

    /// The conversion of the robot's own log, with angles in `unit`.
    pub fn own(robot: &'a RobotConfig, unit: AngleUnit, names: Vec<String>) -> Result<Self, LogError> {
        Ok(Self { robot, is_mapped: false, logged: LoggedJoints::own(robot, unit, names)? })
    }

    /// The conversion for a format with joints in degrees. If a mapping names joints, it is the conversion of the mapping,
    /// and prismatic joints have the unit of the mapping. Otherwise it is the conversion of the robot's configuration, and
    /// prismatic joints are in millimetres.
    pub fn of_degrees(
        robot: &'a RobotConfig,
        mapping: Option<&RobotLogMapping>,
        names: Vec<String>,
        format: LogFormat,
        path: &Path,
    ) -> Result<Self, LogError> {
        let mut meaning = match mapping.and_then(RobotLogMapping::with_joints) {
            Some(mapping) => Self::mapped(robot, mapping, names, path)?,
            None => Self::of_controller(robot, AngleUnit::Deg, names, format, path)?,
        };
        let LoggedJoints { units, factors, .. } = &mut meaning.logged;
        for (unit, factor) in units.iter_mut().zip(factors) {
            match unit.kind() {
                JointKind::Revolute if meaning.is_mapped => {
                    (*unit, *factor) = (JointUnit::Deg, JointUnit::Deg.to_si());
                }
                JointKind::Prismatic if !meaning.is_mapped => {
                    (*unit, *factor) = (JointUnit::Mm, JointUnit::Mm.to_si());
                }
                JointKind::Revolute | JointKind::Prismatic => {}
            }
        }
        Ok(meaning)
    }

    /// The conversion for a format with joints of the controller and angles in `unit`. The conversion is taken from the
    /// robot's configuration, which must convert joints and not motors.
    pub fn of_controller(
        robot: &'a RobotConfig,
        unit: AngleUnit,
        names: Vec<String>,
        format: LogFormat,
        path: &Path,
    ) -> Result<Self, LogError> {
        if robot.log.column != "joint" {
            let (format, robot) = (format.name(), &robot.name);
            let problem = format!(
                "it has joint angles ({format}), but the configuration of {robot} converts motor angles"
            );
            let remedy =
                "give the conversion of the joints in a mapping (--log-mapping), see config/robot_log.toml";
            return Err(LogError::content(path, problem, remedy));
        }
        Self::own(robot, unit, names)
    }

    /// Joints or speeds of a row of the file, in the units of `conversion`.
    fn scaled(&self, values: Joints) -> Joints {
        values.iter().zip(self.logged.factors).map(|(value, factor)| value * factor).collect()
    }
}

impl RawLog {
    /// A log without rows. `what` is the word for a row.
    pub fn new(path: &Path, what: &'static str) -> Self {
        let log = RobotLog { clock: "unstated".into(), ..RobotLog::default() };
        Self { path: path.to_owned(), what, log, ..Self::default() }
    }

    /// A log without rows, with measured joints on the given clock unless the mapping contains another origin or clock.
    pub fn measured(path: &Path, what: &'static str, mapping: Option<&RobotLogMapping>, clock: &str) -> Self {
        let stated = mapping.and_then(|mapping| mapping.clock.clone());
        let mut raw = Self::new(path, what);
        raw.log.clock = stated.unwrap_or_else(|| clock.into());
        raw.log.origin = mapping.and_then(|mapping| mapping.values).unwrap_or(ValueOrigin::Measured);
        raw
    }

    /// Adds a remark on the quality of the log.
    pub fn remark(&mut self, remark: impl Into<String>) {
        self.log.quality.remarks.push(remark.into());
    }

    /// Adds the next row of the file. A row that repeats the row before, or in which a joint is missing, is
    /// counted, but not added.
    pub fn push(&mut self, row: RawRobotRow, meaning: &Meaning<'_>) -> Result<(), LogError> {
        let joints = meaning.scaled(row.joints);
        if joints.iter().any(|joint| !joint.is_finite()) {
            self.log.quality.incomplete_dropped += 1;
            return Ok(());
        }
        if let (Some(&place), Some(&stamp_ns)) = (self.places.last(), self.stamps_ns.last()) {
            if row.stamp_ns == stamp_ns && self.joints.last() == Some(&joints) {
                self.log.quality.duplicates_dropped += 1;
                return Ok(());
            }
            if row.stamp_ns < stamp_ns {
                let stamps = [(place, stamp_ns), (row.place, row.stamp_ns)];
                return Err(LogError::time_not_increasing(&self.path, self.what, stamps[0], stamps[1]));
            }
        }
        self.places.push(row.place);
        self.stamps_ns.push(row.stamp_ns);
        self.joints.push(joints);
        let values = [row.speeds.map(|speeds| meaning.scaled(speeds)), row.torques, row.force];
        self.more.iter_mut().zip(values).for_each(|(rows, value)| rows.extend(value));
        Ok(())
    }

    /// Adds a remark if the mapping has a force, for a format from which no force is read.
    pub fn remark_unused_force(&mut self, mapping: Option<&RobotLogMapping>) {
        if mapping.is_some_and(|mapping| mapping.force.is_some()) {
            self.remark(format!(
                "the force on the bar is not used: {}s are not searched for one; give it in a table of its own with \
                 --force-log",
                self.what
            ));
        }
    }

    /// Checks and converts all rows, and estimates their times.
    pub fn finish(mut self, meaning: &Meaning<'_>) -> Result<RobotLog, LogError> {
        // Converts the joints, and removes rows that cannot be used.
        let rows = self.joints.len();
        self.more.iter_mut().filter(|values| values.len() < rows).for_each(Vec::clear);
        self.joints = threads::rows(rows, |row| meaning.logged.conversion.to_joint(&self.joints[row]));
        self.drop_excursions(meaning.robot)?;
        self.drop_repeated(meaning.robot);
        if self.joints.len() < ROWS_MIN {
            return Err(self.too_few(self.joints.len()));
        }
        self.check_limits(meaning)?;
        self.remark_resolution(meaning.robot);
        // The places are not needed any more. They take as much memory as the stamps.
        self.places = Vec::new();
        let joints = std::mem::take(&mut self.joints);
        // Estimates the times of the rows. If no regular clock is found, rows with equal stamps are removed.
        let (q_rad, stamps, is_kept) =
            Stream::from_stamps(std::mem::take(&mut self.stamps_ns), joints, |rows| rows.into());
        self.more.iter_mut().for_each(|values| retain(values, &is_kept));
        self.log.quality.remarks.extend(remark_equal(&is_kept, self.what));
        if q_rad.len() < ROWS_MIN {
            return Err(self.too_few(q_rad.len()));
        }
        self.log.quality.stamps = stamps;
        // Converts the other quantities.
        let [speeds, torque, force_columns] =
            std::mem::take(&mut self.more).map(|values| (!values.is_empty()).then_some(values));
        let speed_rad_s = speeds
            .map(|speeds| speeds.iter().map(|row| meaning.logged.conversion.to_joint_rate(row)).collect());
        let force = self.bar_force(force_columns, torque.as_deref(), meaning, &q_rad);
        self.remark_quality(&q_rad);
        let logged = Some(meaning.logged.clone());
        Ok(RobotLog { q_rad: q_rad.into(), speed_rad_s, torque, force, logged, ..self.log })
    }

    /// The force on the bar at the times of the joints. If the mapping has a force but some row lacks it, adds a
    /// remark and returns `None`.
    fn bar_force(
        &mut self,
        columns: Option<Vec<Joints>>,
        torque: Option<&[Joints]>,
        meaning: &Meaning<'_>,
        q_rad: &Stream<Joints>,
    ) -> Option<ForceLog> {
        let kind = self.force?;
        let values: Option<Vec<Joints>> = match kind {
            ForceKind::JointTorques => columns.as_deref().or(torque).and_then(|torques| {
                let within = torques.iter().flatten().all(|torque| torque.abs() <= FORCE_MAX);
                within.then(|| {
                    torques.iter().map(|row| meaning.logged.conversion.to_joint_torque(row)).collect()
                })
            }),
            _ => columns,
        };
        if values.is_none() {
            self.remark(format!(
                "the force on the bar is not used: in some {}s its value is missing or above 1e7 Nm; \
                 correct the mapping, or give the force in a table of its own with --force-log",
                self.what
            ));
        }
        let forces = Stream::new(q_rad.first_stamp_ns, q_rad.t_s.clone(), values?);
        Some(ForceLog::new(ForceClock::Robot, kind, forces))
    }

    /// Removes single rows that have the same joints as the row before, but a new stamp, in the middle of a motion.
    fn drop_repeated(&mut self, robot: &RobotConfig) {
        let repeated = repeated_rows(self.joints.len(), robot.axes(), 1, step_of(&self.joints, robot));
        self.log.quality.repeated_dropped = repeated.len();
        self.remove(&repeated);
    }

    /// Removes rows that jump away and back. Otherwise they would be interpolated, and would change the motion with which
    /// the clocks are compared.
    fn drop_excursions(&mut self, robot: &RobotConfig) -> Result<(), LogError> {
        let (t_s, step) = (since_first_s(&self.stamps_ns), step_of(&self.joints, robot));
        let excursions = Excursions { t_s: &t_s, columns: robot.axes(), fastest: FASTEST, step }.find();
        let places: Vec<u64> = excursions.iter().map(|row| self.places[*row]).collect();
        let remark = remark(&places, self.joints.len(), (&self.path, self.what), "they are left out")?;
        self.log.quality.remarks.extend(remark);
        self.log.quality.excursions_dropped = excursions.len();
        self.remove(&excursions);
        Ok(())
    }

    /// Removes the rows with these indices.
    fn remove(&mut self, rows: &[usize]) {
        let mut is_kept = vec![true; self.joints.len()];
        rows.iter().for_each(|row| is_kept[*row] = false);
        retain(&mut self.places, &is_kept);
        retain(&mut self.stamps_ns, &is_kept);
        self.more.iter_mut().chain([&mut self.joints]).for_each(|values| retain(values, &is_kept));
    }

    fn too_few(&self, rows: usize) -> LogError {
        let incomplete = self.log.quality.incomplete_dropped;
        if incomplete > rows {
            let problem = format!("{incomplete} of {} {}s lack a joint", rows + incomplete, self.what);
            return LogError::content(&self.path, problem, "check that the log has all joints of this robot");
        }
        LogError::TooFewRows { path: self.path.clone(), rows, needed: ROWS_MIN }
    }

    /// Checks that all rows are within the joint limits of the robot.
    fn check_limits(&self, meaning: &Meaning<'_>) -> Result<(), LogError> {
        let limits = meaning.robot.joint_limits();
        let rows = self.joints.iter().zip(&self.places);
        let beyond = rows.filter_map(|(q, place)| Some((q, *place, beyond_limits(q, &limits)?)));
        let mut beyond = beyond.peekable();
        let Some((q, line, joint)) = beyond.peek().copied() else { return Ok(()) };
        let rows_beyond = beyond.count();
        let prismatic = meaning.robot.joint_kinds().nth(joint) == Some(JointKind::Prismatic);
        let (factor, unit) = if prismatic { (1.0, "m") } else { (1f64.to_degrees(), "deg") };
        let [low, high] = limits[joint].map(|limit| (limit * factor * 1e6).round() / 1e6);
        let problem = format!(
            "joint {} would be at {:.1} {unit}, outside {low} to {high} {unit} \
             ({rows_beyond} of {} rows beyond a limit)",
            joint + 1,
            q[joint] * factor,
            self.joints.len()
        );
        let place = format!("{} {line}", self.what);
        Err(LogError::bad_record(&self.path, place, problem, &self.likely_cause(meaning)))
    }

    /// The remedy for joints beyond their limits: the common mistake whose correction moves every row within the
    /// limits, if there is one.
    fn likely_cause(&self, meaning: &Meaning<'_>) -> String {
        let (limits, conversion) = (meaning.robot.joint_limits(), &meaning.logged.conversion);
        let rows: Vec<Joints> = self.joints.iter().map(|q| conversion.to_raw(q)).collect();
        let fits = |to_joint: &dyn Fn(&Joints) -> Joints| {
            rows.iter().all(|row| beyond_limits(&to_joint(row), &limits).is_none())
        };
        // If the joints hardly move, the rows are within the limits in any unit. The unit is therefore only
        // suspected if a joint moves.
        let in_deg = |row: &Joints| conversion.to_joint_with_unit(row, AngleUnit::Deg);
        let moves = |joint: usize| {
            let angles = rows.iter().map(|row| in_deg(row)[joint]);
            let [low_rad, high_rad] = extremes(angles);
            high_rad - low_rad > MOTION_DEG_MIN.to_radians()
        };
        let is_in_deg = meaning.logged.units.contains(&JointUnit::Deg);
        if !is_in_deg && fits(&in_deg) && (0..conversion.axes()).any(moves) {
            let correction = if meaning.is_mapped {
                "write unit = \"deg\" for the joints of the mapping"
            } else {
                "export radians, or name the columns `_deg` and set log.unit = \"deg\" in the robot's configuration"
            };
            return format!(
                "read as degrees, every row is within the limits, so the columns look like degrees: {correction}"
            );
        }
        let exchanged = |mistake: JointMistake| match mistake {
            JointMistake::Exchanged(i, j)
                if fits(&|row| conversion.to_joint(&mistake.undone(row, meaning.robot.joint_kinds()))) =>
            {
                Some(format!("`{}` and `{}`", meaning.logged.names[i], meaning.logged.names[j]))
            }
            _ => None,
        };
        let exchanged: Vec<String> =
            JointMistake::all(conversion.axes()).into_iter().filter_map(exchanged).collect();
        if !exchanged.is_empty() {
            return format!(
                "every row is within the limits if columns are exchanged: {}; check their order in the export",
                exchanged.join(", or ")
            );
        }
        "check that the log belongs to this robot, its unit, the order of its columns, and log.raw_offset_rad and \
         joint_limits_deg of the robot's configuration"
            .into()
    }

    /// Adds a remark if the values have coarse steps, with the standard deviation of the rounding errors as the cost.
    fn remark_resolution(&mut self, robot: &RobotConfig) {
        let steps = resolutions(self.joints.len(), robot.axes(), step_of(&self.joints, robot));
        for (kind, place, fine) in [
            (JointKind::Revolute, " at a distance of 1 m from the axis", "0.001 deg"),
            (JointKind::Prismatic, "", "0.01 mm"),
        ] {
            let (joints, steps): (Vec<usize>, Vec<f64>) = (1..)
                .zip(robot.joint_kinds())
                .zip(&steps)
                .filter(|((_, other), step)| *other == kind && **step > RESOLUTION_MAX)
                .map(|((joint, _), step)| (joint, *step))
                .unzip();
            if joints.is_empty() {
                continue;
            }
            let largest = largest_size(&steps);
            self.remark(format!(
                "the log has steps of up to {} {} in joint {}: rounding adds an error of {:.2} mm (RMS){place}; log more \
                 digits, {fine} or finer",
                (largest * kind.display_factor() * 1e3).round() / 1e3,
                kind.display_symbol(),
                named(&joints, joints.len()),
                largest / 12_f64.sqrt() * 1e3,
            ));
        }
    }

    /// Adds the remarks on the log as a whole.
    fn remark_quality(&mut self, q_rad: &[Joints]) {
        let RobotLog { quality, origin, .. } = &mut self.log;
        quality.remarks.extend(quality.stamps.iter().flat_map(Stamps::remarks).collect::<Vec<_>>());
        if travel(q_rad).to_degrees() < MOTION_DEG_MIN {
            quality.remarks.push(format!(
                "no joint moves by {MOTION_DEG_MIN} deg in the whole log; check that columns named as degrees are not \
                 radians, and that the log contains the run"
            ));
        }
        quality.remark_counts(self.what, "the joints", "they are left out", "lack a joint");
        if *origin == ValueOrigin::Commanded {
            quality
                .remarks
                .push("the values are commanded, not measured: they do not contain the servo lag".into());
        }
    }
}

/// Change of a joint from one row to another \[rad, m\], as a function of both rows and the joint.
fn step_of(joints: &[Joints], robot: &RobotConfig) -> impl Fn(usize, usize, usize) -> f64 {
    let kinds: Vec<JointKind> = robot.joint_kinds().collect();
    move |from: usize, to: usize, joint: usize| {
        let change = joints[to][joint] - joints[from][joint];
        // Angles may wrap after a turn.
        if kinds[joint] == JointKind::Prismatic { change } else { wrapped(change) }
    }
}

/// Index of the first joint that is beyond its limits by more than the tolerance.
fn beyond_limits(q_rad: &Joints, limits: &[[f64; 2]]) -> Option<usize> {
    let slack = LIMIT_SLACK_DEG.to_radians();
    q_rad.iter().zip(limits).position(|(q, [low, high])| !(low - slack..=high + slack).contains(q))
}
