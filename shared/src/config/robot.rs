//! `config/robots/*.toml`: the nominal geometry of a robot, and the conversion of its log to joint angles.

use serde::{Deserialize, Serialize};

use super::{Kind, Validate, Violation};

/// Smallest number of axes of a robot.
pub const AXES_MIN: usize = 2;
/// Largest number of axes: an arm with seven axes on a track or turntable.
pub const AXES_MAX: usize = 8;

/// How an axis moves.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JointKind {
    /// The axis rotates about z. The joint variable is added to `theta`.
    #[default]
    Revolute,
    /// The axis moves along z. The joint variable is added to `d`.
    Prismatic,
}

impl JointKind {
    fn is_revolute(&self) -> bool {
        *self == Self::Revolute
    }

    /// Symbol of the joint variable's SI unit.
    pub const fn si_symbol(self) -> &'static str {
        match self {
            Self::Revolute => "rad",
            Self::Prismatic => "m",
        }
    }

    /// Symbol of the unit in which the joint variable is displayed.
    pub const fn display_symbol(self) -> &'static str {
        match self {
            Self::Revolute => "deg",
            Self::Prismatic => "mm",
        }
    }

    /// Conversion factor from the SI unit to the displayed unit.
    pub fn display_factor(self) -> f64 {
        match self {
            Self::Revolute => 1f64.to_degrees(),
            Self::Prismatic => 1e3,
        }
    }
}

/// Convention of a Denavit-Hartenberg table: the order of the four transforms in a row.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Convention {
    /// `Rz(theta) Tz(d) Tx(a) Rx(alpha)`: the motion of the axis comes first, then the fixed transform to the next axis.
    #[default]
    Standard,
    /// `Rx(alpha) Tx(a) Rz(theta) Tz(d)` (Craig): the fixed transform from the previous axis comes first, then the motion.
    Modified,
}

/// A fixed transform, `T(xyz) Rz(yaw) Ry(pitch) Rx(roll)` as in URDF.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TransformConfig {
    /// Position \[m\].
    pub xyz_m: [f64; 3],
    /// Roll, pitch and yaw \[deg\].
    pub rpy_deg: [f64; 3],
}

impl TransformConfig {
    fn is_identity(&self) -> bool {
        *self == Self::default()
    }

    fn validate(&self, key: &str) -> Result<(), Violation> {
        let within = |numbers: [f64; 3], limit: f64| numbers.iter().all(|number| number.abs() <= limit);
        if within(self.xyz_m, LENGTH_M_MAX) && within(self.rpy_deg, ANGLE_DEG_MAX) {
            return Ok(());
        }
        let problem = format!("{:?} m, {:?} deg is beyond 10 m or 360 degrees", self.xyz_m, self.rpy_deg);
        Err(Violation::new(key, problem, "lengths are in metres, angles in degrees"))
    }
}

/// Largest length in a link or transform \[m\].
const LENGTH_M_MAX: f64 = 10.0;
/// Largest angle in a link or transform \[deg\].
const ANGLE_DEG_MAX: f64 = 360.0;

/// One link, a row of a Denavit-Hartenberg table ([`Convention`]).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LinkConfig {
    /// Whether the axis rotates or moves along a line.
    #[serde(default, skip_serializing_if = "JointKind::is_revolute")]
    pub joint: JointKind,
    /// Length along x \[m\].
    pub a_m: f64,
    /// Twist about x \[deg\].
    pub alpha_deg: f64,
    /// Offset along z \[m\].
    pub d_m: f64,
    /// Value of `theta` when the joint variable is zero \[deg\].
    pub theta_deg: f64,
    /// Hayati's rotation about y after `alpha` \[deg\]. Used if the axis is nearly parallel to the axis before.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub beta_deg: f64,
}

fn is_zero(number: &f64) -> bool {
    *number == 0.0
}

/// Unit of the angles in a robot's log.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AngleUnit {
    /// Radians, the SI unit.
    Rad,
    /// Degrees, 360 in a turn.
    Deg,
}

impl AngleUnit {
    /// Size of the unit in radians.
    pub fn to_rad(self) -> f64 {
        match self {
            Self::Rad => 1.0,
            Self::Deg => std::f64::consts::PI / 180.0,
        }
    }

    /// Suffix of the column headers in a log, such as `rad` in `joint1_rad`.
    pub const fn suffix(self) -> &'static str {
        match self {
            Self::Rad => "rad",
            Self::Deg => "deg",
        }
    }
}

/// Converts what the robot logs to the joint variables of the model:
/// `q = (raw * unit - raw_offset_rad) * raw_to_joint`, with row vectors.
///
/// This formula covers logs of motor angles, with gear ratios and wrist coupling, and logs of joint angles with other signs.
/// It also covers robots in which a parallel rod couples joints 2 and 3.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LogConversion {
    /// Prefix of the columns in the log. With `motor`, the columns `motor1_rad` to `motor6_rad` are read.
    pub column: String,
    /// Unit of the log's angles; columns of prismatic axes are in metres (`joint1_m`).
    pub unit: AngleUnit,
    /// Value of each column when the robot is at its mechanical zero \[rad, m\].
    pub raw_offset_rad: Vec<f64>,
    /// Square matrix with one row for each axis. Row i contains the contributions of column i of the log to all joints.
    pub raw_to_joint: Vec<Vec<f64>>,
}

impl LogConversion {
    /// The conversion of a log that already contains the joint variables of the model: offsets are zero,
    /// the matrix is the identity.
    pub fn direct(unit: AngleUnit, axes: usize) -> Self {
        let row = |i: usize| (0..axes).map(|j| f64::from(u8::from(i == j))).collect();
        let raw_to_joint = (0..axes).map(row).collect();
        Self { column: "joint".into(), unit, raw_offset_rad: vec![0.0; axes], raw_to_joint }
    }

    fn validate(&self, axes: usize) -> Result<(), Violation> {
        let square = self.raw_to_joint.len() == axes && self.raw_to_joint.iter().all(|row| row.len() == axes);
        if !square || self.raw_offset_rad.len() != axes {
            return Err(Violation::new(
                "log",
                format!("raw_offset_rad needs {axes} numbers, raw_to_joint {axes} rows of {axes} numbers"),
                "write one offset for each log column, and one row for each log column with a number for each joint",
            ));
        }
        if !self.raw_offset_rad.iter().chain(self.raw_to_joint.iter().flatten()).all(|x| x.is_finite()) {
            return Err(Violation::new("log", "a number is not finite", "write ordinary numbers"));
        }
        if determinant(&self.raw_to_joint) == 0.0 {
            return Err(Violation::new(
                "log.raw_to_joint",
                "the matrix is singular: the log does not determine all joints",
                "check its rows (log columns) and columns (joints)",
            ));
        }
        Ok(())
    }
}

/// What is known about a robot's gears. Every field may be absent.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DrivesConfig {
    /// Number of lobes of the cycloid gear of each axis. It is also the number of periods of the gear's error in one turn. 0
    /// if the axis has no such gear, or if the number is unknown.
    pub cycloid_lobes: Vec<f64>,
    /// Turns of the motor for one turn of each axis, 0 if unknown. Not needed if the log contains motor angles.
    pub motor_turns: Vec<f64>,
    /// Direction of gravity in the robot's base frame, of any length. If absent, the robot stands upright.
    pub gravity: Option<[f64; 3]>,
}

impl DrivesConfig {
    fn validate(&self, axes: usize) -> Result<(), Violation> {
        for (key, numbers) in [("cycloid_lobes", &self.cycloid_lobes), ("motor_turns", &self.motor_turns)] {
            if !numbers.is_empty() && numbers.len() != axes {
                return Err(Violation::new(
                    format!("drives.{key}"),
                    format!("{} numbers for {axes} axes", numbers.len()),
                    "give one for each axis, 0 where it is unknown",
                ));
            }
            for (axis, number) in numbers.iter().enumerate() {
                let key = format!("drives.{key}[{axis}]");
                Violation::unless_within(
                    key,
                    *number,
                    [0.0, 1e4],
                    "give the number in a turn, or 0 if it is unknown",
                )?;
            }
        }
        let usable = |direction: &[f64; 3]| {
            let squared: f64 = direction.iter().map(|part| part * part).sum();
            squared.is_finite() && squared > 0.0
        };
        match &self.gravity {
            Some(direction) if !usable(direction) => Err(Violation::new(
                "drives.gravity",
                "it has no direction",
                "give a vector in the robot's base, such as [0.0, 0.0, -1.0]",
            )),
            _ => Ok(()),
        }
    }
}

/// Robot makers for which the programs differ: in the robot's programming language, or in the definition of joint angles.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Maker {
    /// ABB: RAPID.
    Abb,
    /// FANUC: TP. The controller measures joint 3 from the horizontal, not from the upper arm.
    Fanuc,
    /// KUKA: KRL.
    Kuka,
    /// Universal Robots: URScript.
    UniversalRobots,
}

impl Maker {
    /// Determines the maker from a robot's name. The name is split into words at every character that is neither a letter
    /// nor a digit; upper and lower case do not matter. Examples: `ABB IRB 2400/16`, `kuka_kr6r700sixx`, `ur5e_robot`.
    pub fn in_name(name: &str) -> Option<Self> {
        let mut words = name.split(|letter: char| !letter.is_alphanumeric()).map(str::to_lowercase);
        words.find_map(|word| match word.as_str() {
            "abb" => Some(Self::Abb),
            "fanuc" => Some(Self::Fanuc),
            "kuka" | "kr" => Some(Self::Kuka),
            "universal" | "ur" => Some(Self::UniversalRobots),
            model => [
                ("irb", Self::Abb),
                ("crb", Self::Abb),
                ("lrmate", Self::Fanuc),
                ("crx", Self::Fanuc),
                ("kr", Self::Kuka),
                ("ur", Self::UniversalRobots),
            ]
            .into_iter()
            .find(|(series, _)| {
                model.strip_prefix(series).is_some_and(|rest| rest.starts_with(|c: char| c.is_ascii_digit()))
            })
            .map(|(_, maker)| maker),
        })
    }
}

/// A robot: a serial chain of two to eight axes, with the nominal values of its data sheet.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotConfig {
    /// Maker and model of the robot.
    pub name: String,
    /// Convention of the table in `links`.
    #[serde(default)]
    pub convention: Convention,
    /// Transform from the robot's base frame to the beginning of link 1.
    #[serde(default, skip_serializing_if = "TransformConfig::is_identity")]
    pub base: TransformConfig,
    /// Transform from the end of the last link to the flange.
    #[serde(default, skip_serializing_if = "TransformConfig::is_identity")]
    pub flange: TransformConfig,
    /// One link for each axis, from base to flange. The plate and tool of the ball-bar are added after the flange.
    pub links: Vec<LinkConfig>,
    /// Lower and upper limit of each revolute joint variable of the model \[deg\].
    #[serde(default)]
    pub joint_limits_deg: Vec<[f64; 2]>,
    /// Lower and upper limit of each prismatic joint variable of the model \[m\].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub joint_limits_m: Vec<[f64; 2]>,
    /// Conversion of the robot's log to joint variables.
    pub log: LogConversion,
    /// Gears of the robot and direction of gravity.
    #[serde(default)]
    pub drives: DrivesConfig,
}

impl RobotConfig {
    /// Number of axes, which equals the number of links.
    pub fn axes(&self) -> usize {
        self.links.len()
    }

    /// The maker according to the robot's name; `None` if the name contains none of the known makers.
    pub fn maker(&self) -> Option<Maker> {
        Maker::in_name(&self.name)
    }

    /// Whether the controller measures joint 3 from the horizontal. The value of joint 3 then stays constant when only joint
    /// 2 turns. FANUC controllers do this. So do some ABB arms, in which a parallel rod keeps the direction of the forearm.
    /// The robot's name decides.
    pub fn counts_joint_3_from_horizontal(&self) -> bool {
        const WITH_PARALLEL_ROD: [&str; 7] = ["1400", "1410", "2400", "4400", "6400", "6660", "8700"];
        match self.maker() {
            Some(Maker::Fanuc) => true,
            Some(Maker::Abb) => {
                let mut numbers = self.name.split(|letter: char| !letter.is_ascii_digit());
                numbers.any(|number| WITH_PARALLEL_ROD.contains(&number))
            }
            _ => false,
        }
    }

    /// Whether each axis rotates or moves along a line, from base to flange.
    pub fn joint_kinds(&self) -> impl Iterator<Item = JointKind> + Clone + '_ {
        self.links.iter().map(|link| link.joint)
    }

    /// Lower and upper limit of each joint variable \[rad, m\], base to flange.
    pub fn joint_limits(&self) -> Vec<[f64; 2]> {
        let (mut turns, mut slides) = (self.joint_limits_deg.iter(), self.joint_limits_m.iter());
        let limits = self.joint_kinds().map_while(|kind| match kind {
            JointKind::Revolute => turns.next().map(|limits| limits.map(f64::to_radians)),
            JointKind::Prismatic => slides.next().copied(),
        });
        limits.collect()
    }
}

impl Validate for RobotConfig {
    const KIND: Option<Kind> = Some(Kind::Robot);

    fn validate(&self) -> Result<(), Violation> {
        let axes = self.axes();
        if !(AXES_MIN..=AXES_MAX).contains(&axes) {
            return Err(Violation::new(
                "links",
                format!("{axes} links are given"),
                format!("give the {AXES_MIN} to {AXES_MAX} links of the robot, base to flange"),
            ));
        }
        validate_links("links", &self.links)?;
        self.base.validate("base")?;
        self.flange.validate("flange")?;
        for (key, kind, limits) in [
            ("joint_limits_deg", JointKind::Revolute, &self.joint_limits_deg),
            ("joint_limits_m", JointKind::Prismatic, &self.joint_limits_m),
        ] {
            let needed = self.joint_kinds().filter(|other| *other == kind).count();
            if limits.len() != needed {
                return Err(Violation::new(
                    key,
                    format!("{} ranges for {needed} {kind:?} axes", limits.len()).to_lowercase(),
                    "write one [lower, upper] for each",
                ));
            }
            for (joint, [low, high]) in limits.iter().enumerate() {
                if !(low.is_finite() && high.is_finite() && low < high) {
                    return Err(Violation::new(
                        format!("{key}[{joint}]"),
                        format!("[{low}, {high}] is not a range"),
                        "write [lower, upper], angles in degrees, lengths in metres",
                    ));
                }
            }
        }
        self.drives.validate(axes)?;
        self.log.validate(axes)
    }
}

/// Checks that every number of every link is finite, and that every length and angle is plausible for a robot.
pub(super) fn validate_links(key: &str, links: &[LinkConfig]) -> Result<(), Violation> {
    for (index, link) in links.iter().enumerate() {
        let lengths = [("a_m", link.a_m), ("d_m", link.d_m)];
        let angles =
            [("alpha_deg", link.alpha_deg), ("theta_deg", link.theta_deg), ("beta_deg", link.beta_deg)];
        let checks = lengths
            .map(|(name, value)| (name, value, LENGTH_M_MAX, "lengths are in metres"))
            .into_iter()
            .chain(angles.map(|(name, value)| (name, value, ANGLE_DEG_MAX, "angles are in degrees")));
        for (name, value, limit, remedy) in checks {
            Violation::unless_within(format!("{key}[{index}].{name}"), value, [-limit, limit], remedy)?;
        }
    }
    Ok(())
}

/// Determinant by elimination with row pivoting. The result is used only to detect singular matrices.
fn determinant(matrix: &[Vec<f64>]) -> f64 {
    let mut m = matrix.to_vec();
    let mut determinant = 1.0;
    for column in 0..m.len() {
        let pivot = (column..m.len())
            .max_by(|&a, &b| m[a][column].abs().total_cmp(&m[b][column].abs()))
            .unwrap_or(column);
        if m[pivot][column] == 0.0 {
            return 0.0;
        }
        m.swap(column, pivot);
        determinant *= m[column][column];
        let (above, below) = m.split_at_mut(column + 1);
        let pivot_row = &above[column];
        for row in below {
            let factor = row[column] / pivot_row[column];
            for (value, pivot_value) in row.iter_mut().zip(pivot_row) {
                *value -= factor * pivot_value;
            }
        }
    }
    determinant
}
