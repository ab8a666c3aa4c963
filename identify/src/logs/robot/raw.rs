//! What a log says before it is the model's: rows as they come, then judged as a whole.

use std::path::{Path, PathBuf};

use shared::config::{AngleUnit, JointKind, LogConversion, RobotConfig};

use super::mapping::RobotLogMapping;
use crate::kinematics::Joints;
use crate::logs::force::FORCE_MAX;
use crate::logs::rows::pose_rows::joints_of_robot;
use crate::logs::time_series::sampling::Stamps;
use crate::logs::{
    ForceClock, ForceKind, ForceLog, JointConversion, LogError, LogFormat, LogQuality, Origin, ROWS_MIN,
    RobotLog, Stream, travel,
};
use crate::statistics::extremes;

/// Joint values may pass the nominal limits by this much before a log is refused \[deg\]: zero positions of real
/// robots differ a little from the data sheet. Prismatic axes by as much times one metre.
const LIMIT_SLACK_DEG: f64 = 2.0;
/// A log whose joints all move less than this \[deg\] cannot identify anything.
const MOTION_DEG_MIN: f64 = 5.0;
/// A row that repeats the joints before it is frozen if they moved further than this before and after \[rad\].
const FROZEN_STEP_RAD: f64 = 1e-4;

/// One row of a log in the file's own units.
#[derive(Debug, Clone, Default)]
pub(in crate::logs) struct RawRow {
    /// Line or number in the file.
    pub place: u64,
    pub stamp_ns: i64,
    /// NaN where the file has no value.
    pub joints: Joints,
    pub speeds: Option<Joints>,
    pub torques: Option<Joints>,
    /// Force on the bar, see [`RawLog::force`] \[N or N m\].
    pub force: Option<Joints>,
}

/// A row that is kept: ten hours have ten million of them, most logs neither speeds nor torques.
struct KeptRow {
    place: u64,
    stamp_ns: i64,
    joints: Joints,
    more: Option<Box<More>>,
}

/// What some logs have besides.
struct More {
    speeds: Option<Joints>,
    torques: Option<Joints>,
    force: Option<Joints>,
}

impl From<RawRow> for KeptRow {
    fn from(row: RawRow) -> Self {
        let RawRow { place, stamp_ns, joints, speeds, torques, force } = row;
        let some = speeds.is_some() || torques.is_some() || force.is_some();
        Self { place, stamp_ns, joints, more: some.then(|| Box::new(More { speeds, torques, force })) }
    }
}

/// Rows in the order of the file, stamps not decreasing.
pub(in crate::logs) struct RawLog {
    path: PathBuf,
    /// What rows are called: `line`, `message` or `telegram`.
    what: &'static str,
    rows: Vec<KeptRow>,
    quality: LogQuality,
    pub robot: Option<String>,
    pub clock: String,
    pub origin: Origin,
    pub remarks: Vec<String>,
    /// What the force of the rows is, where it has one; joint torques without are taken from the torques.
    pub force: Option<ForceKind>,
}

/// How the joints of a file become those of the model, and what they are called there.
pub(in crate::logs) struct Meaning<'a> {
    robot: &'a RobotConfig,
    unit: AngleUnit,
    conversion: JointConversion,
    names: Vec<String>,
}

impl<'a> Meaning<'a> {
    fn new(robot: &'a RobotConfig, log: &LogConversion, names: Vec<String>) -> Result<Self, LogError> {
        Ok(Self { robot, unit: log.unit, conversion: JointConversion::new(log)?, names })
    }

    /// What a mapping says of this robot.
    pub fn mapped(
        robot: &'a RobotConfig,
        mapping: &RobotLogMapping,
        names: Vec<String>,
        path: &Path,
    ) -> Result<Self, LogError> {
        joints_of_robot(&mapping.joints, robot, path)?;
        Self::new(robot, &mapping.conversion(), names)
    }

    /// The robot's own log.
    pub fn own(robot: &'a RobotConfig, names: Vec<String>) -> Result<Self, LogError> {
        Ok(Self { conversion: JointConversion::of(robot)?, ..Self::new(robot, &robot.log, names)? })
    }

    /// Joint angles of the controller, as the robot's configuration converts them, in the unit that the format has.
    pub fn of_controller(
        robot: &'a RobotConfig,
        unit: AngleUnit,
        names: Vec<String>,
        format: LogFormat,
        path: &Path,
    ) -> Result<Self, LogError> {
        if robot.log.column != "joint" {
            let robot = robot.name.clone();
            return Err(LogError::NeedsMapping { path: path.to_owned(), format: format.name(), robot });
        }
        Self::new(robot, &LogConversion { unit, ..robot.log.clone() }, names)
    }
}

impl RawLog {
    pub fn new(path: &Path, what: &'static str) -> Self {
        Self {
            path: path.to_owned(),
            what,
            rows: Vec::new(),
            quality: LogQuality::default(),
            robot: None,
            clock: "unstated".into(),
            origin: Origin::Unstated,
            remarks: Vec::new(),
            force: None,
        }
    }

    /// Takes the next row; one that repeats the row before it, or lacks a joint, is only counted.
    pub fn push(&mut self, row: RawRow) -> Result<(), LogError> {
        if row.joints.iter().any(|joint| !joint.is_finite()) {
            self.quality.incomplete_dropped += 1;
            return Ok(());
        }
        if let Some(before) = self.rows.last() {
            if row.stamp_ns == before.stamp_ns && row.joints == before.joints {
                self.quality.duplicates_dropped += 1;
                return Ok(());
            }
            if row.stamp_ns < before.stamp_ns {
                let stamps = [(before.place, before.stamp_ns), (row.place, row.stamp_ns)];
                return Err(LogError::time_not_increasing(&self.path, self.what, stamps[0], stamps[1]));
            }
        }
        self.rows.push(row.into());
        Ok(())
    }

    /// In a format where no force is looked for: says so where the mapping asks for one.
    pub fn tell_without_force(&mut self, mapping: Option<&RobotLogMapping>) {
        if mapping.is_some_and(|mapping| mapping.force.is_some()) {
            self.remarks.push(format!(
                "the force on the bar is not used: {}s are not searched for one; give it in a table of its own with \
                 --force-log",
                self.what
            ));
        }
    }

    /// Judges the whole and converts it.
    pub fn finish(mut self, meaning: &Meaning<'_>) -> Result<RobotLog, LogError> {
        self.drop_frozen(meaning.unit);
        if self.rows.len() < ROWS_MIN {
            return Err(self.too_few(self.rows.len()));
        }
        let joints: Vec<Joints> =
            self.rows.iter().map(|row| meaning.conversion.to_joint(&row.joints)).collect();
        self.check_limits(&joints, meaning)?;
        let stamps_ns = self.rows.iter().map(|row| row.stamp_ns).collect();
        let (rows, before) = (std::mem::take(&mut self.rows), joints.len());
        let (rows, stamps) = Stream::sampled(stamps_ns, rows, &joints);
        self.tell_equal(before - rows.len());
        if rows.len() < ROWS_MIN {
            return Err(self.too_few(rows.len()));
        }
        self.quality.stamps = stamps;
        let q_rad = rows.map(|row| meaning.conversion.to_joint(&row.joints));
        let all = |of: fn(&More) -> Option<Joints>| {
            rows.iter().map(|row| of(row.more.as_ref()?)).collect::<Option<Vec<_>>>()
        };
        let speed_rad_s = all(|more| more.speeds)
            .map(|speeds| speeds.iter().map(|row| meaning.conversion.to_joint_rate(row)).collect());
        let torque = all(|more| more.torques);
        let on_joints = |rows: &Vec<Joints>| -> Vec<Joints> {
            rows.iter().map(|row| meaning.conversion.to_joint_torque(row)).collect()
        };
        let of_bar = self.force.and_then(|kind| {
            let given = all(|more| more.force);
            let values = match kind {
                ForceKind::JointTorques => {
                    let torques = given.or_else(|| torque.clone())?;
                    let within = torques.iter().flatten().all(|torque| torque.abs() <= FORCE_MAX);
                    on_joints(within.then_some(&torques)?)
                }
                _ => given?,
            };
            let forces = Stream::new(q_rad.first_stamp_ns, q_rad.t_s.clone(), values);
            Some(ForceLog::new(ForceClock::Robot, kind, forces))
        });
        if self.force.is_some() && of_bar.is_none() {
            self.remarks.push(format!(
                "the force on the bar is not used: some {}s have none where the mapping says, or one of more than 1e7 Nm; \
                 correct the mapping, or give the force in a table of its own with --force-log",
                self.what
            ));
        }
        let quality = self.judge(&q_rad);
        Ok(RobotLog {
            robot: self.robot,
            clock: self.clock,
            origin: self.origin,
            q_rad,
            speed_rad_s,
            torque,
            force: of_bar,
            quality,
        })
    }

    /// Interfaces that are read faster than they are filled give the same joints again under a new stamp.
    fn drop_frozen(&mut self, unit: AngleUnit) {
        let step_rad = |a: &KeptRow, b: &KeptRow| {
            a.joints.iter().zip(&b.joints).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max) * unit.to_rad()
        };
        let frozen: Vec<bool> = (0..self.rows.len())
            .map(|index| match (index.checked_sub(2), self.rows.get(index + 1)) {
                (Some(first), Some(next)) => {
                    let (first, before, this) = (&self.rows[first], &self.rows[index - 1], &self.rows[index]);
                    this.joints == before.joints
                        && step_rad(first, before) > FROZEN_STEP_RAD
                        && step_rad(this, next) > FROZEN_STEP_RAD
                }
                _ => false,
            })
            .collect();
        self.quality.frozen_dropped = frozen.iter().filter(|&&frozen| frozen).count();
        let mut frozen = frozen.into_iter();
        self.rows.retain(|_| !frozen.next().unwrap_or(false));
    }

    /// Of rows with one stamp only the first has a time, where no clock says more.
    fn tell_equal(&mut self, dropped: usize) {
        if dropped > 0 {
            self.remarks.push(format!(
                "{dropped} {}s have the stamp of the one before, and no regular clock is behind the stamps; they are left out",
                self.what
            ));
        }
    }

    fn too_few(&self, rows: usize) -> LogError {
        let (path, incomplete) = (self.path.clone(), self.quality.incomplete_dropped);
        if incomplete > rows {
            return LogError::Content {
                path,
                problem: format!("{incomplete} of {} {}s lack a joint", rows + incomplete, self.what),
                remedy: "check that the log has all joints of this robot".into(),
            };
        }
        LogError::TooFewRows { path, rows, needed: ROWS_MIN }
    }

    fn check_limits(&self, q_rad: &[Joints], meaning: &Meaning<'_>) -> Result<(), LogError> {
        let limits = meaning.robot.joint_limits();
        let rows_beyond = q_rad.iter().filter(|q| beyond_limits(q, &limits).is_some()).count();
        let first = q_rad
            .iter()
            .zip(&self.rows)
            .find_map(|(q, row)| beyond_limits(q, &limits).map(|joint| (q, row.place, joint)));
        let Some((q, line, joint)) = first else { return Ok(()) };
        let prismatic = meaning.robot.joint_kinds().nth(joint) == Some(JointKind::Prismatic);
        let (factor, unit) = if prismatic { (1.0, "m") } else { (1f64.to_degrees(), "deg") };
        let [low, high] = limits[joint].map(|limit| (limit * factor * 1e6).round() / 1e6);
        Err(LogError::BeyondLimits {
            path: self.path.clone(),
            what: self.what,
            line,
            joint: joint + 1,
            value: format!("{:.1} {unit}, outside {low} to {high} {unit}", q[joint] * factor),
            rows_beyond,
            rows: q_rad.len(),
            remedy: self.likely_cause(meaning),
        })
    }

    /// Tries the usual mistakes on the whole log and names the one that would bring every row within the limits.
    fn likely_cause(&self, meaning: &Meaning<'_>) -> String {
        let limits = meaning.robot.joint_limits();
        let fits = |to_joint: &dyn Fn(&Joints) -> Joints| {
            self.rows.iter().all(|row| beyond_limits(&to_joint(&row.joints), &limits).is_none())
        };
        let conversion = &meaning.conversion;
        // Angles that are read as a sixtieth of themselves are within any limits, where they hardly move.
        let in_deg = |row: &Joints| conversion.to_joint_with_unit(row, AngleUnit::Deg);
        let moves = |joint: usize| {
            let angles = self.rows.iter().map(|row| in_deg(&row.joints)[joint]);
            let [low_rad, high_rad] = extremes(angles);
            high_rad - low_rad > MOTION_DEG_MIN.to_radians()
        };
        if meaning.unit == AngleUnit::Rad && fits(&in_deg) && (0..conversion.axes()).any(moves) {
            return "read as degrees every row fits: the columns look like degrees under a `_rad` header; export \
                    radians, or name the columns `_deg` and set log.unit = \"deg\" in the robot's configuration"
                .into();
        }
        let axes = conversion.axes();
        for (i, j) in (0..axes).flat_map(|i| (i + 1..axes).map(move |j| (i, j))) {
            let swapped = |row: &Joints| {
                let mut row = *row;
                row.swap(i, j);
                conversion.to_joint(&row)
            };
            if fits(&swapped) {
                return format!(
                    "with columns `{}` and `{}` exchanged every row fits: check their order in the export",
                    meaning.names[i], meaning.names[j]
                );
            }
        }
        "check that the log belongs to this robot, its unit, the order of its columns, and log.raw_offset_rad and \
         joint_limits_deg of the robot's configuration"
            .into()
    }

    fn judge(&mut self, q_rad: &[Joints]) -> LogQuality {
        let mut quality = std::mem::take(&mut self.quality);
        quality.remarks.append(&mut self.remarks);
        quality.remarks.extend(quality.stamps.iter().flat_map(Stamps::remarks).collect::<Vec<_>>());
        if travel(q_rad).to_degrees() < MOTION_DEG_MIN {
            quality.remarks.push(format!(
                "no joint moves by {MOTION_DEG_MIN} deg in the whole log: radians in columns named as degrees, or the \
                 wrong part of a log?"
            ));
        }
        for (count, what) in [
            (
                quality.frozen_dropped,
                "repeat the joints before them in the middle of a motion; they are left out",
            ),
            (quality.incomplete_dropped, "lack a joint; they are left out"),
        ] {
            if count > 0 {
                quality.remarks.push(format!("{count} {}s {what}", self.what));
            }
        }
        if self.origin == Origin::Commanded {
            quality.remarks.push("the values are commanded, not measured: servo lag is not in them".into());
        }
        quality
    }
}

/// The first joint beyond its limits.
fn beyond_limits(q_rad: &Joints, limits: &[[f64; 2]]) -> Option<usize> {
    let slack = LIMIT_SLACK_DEG.to_radians();
    q_rad.iter().zip(limits).position(|(q, [low, high])| !(low - slack..=high + slack).contains(q))
}
