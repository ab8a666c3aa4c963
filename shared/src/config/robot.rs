//! `config/robots/*.toml`: a robot's nominal geometry and how its log becomes joint angles.

use serde::{Deserialize, Serialize};

use super::{Validate, Violation};

/// Joints of every robot that this project calibrates.
pub const ROBOT_JOINTS: usize = 6;

/// One link in the standard Denavit-Hartenberg convention, `Rz(theta) Tz(d) Tx(a) Rx(alpha)`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LinkConfig {
    /// Length along x \[m\].
    pub a_m: f64,
    /// Twist about x \[deg\].
    pub alpha_deg: f64,
    /// Offset along z \[m\].
    pub d_m: f64,
    /// Joint angle at which the model's joint variable is zero \[deg\].
    pub theta_deg: f64,
}

/// Unit of the angles in a robot's log.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AngleUnit {
    /// Radians.
    Rad,
    /// Degrees.
    Deg,
}

impl AngleUnit {
    /// Radians in one unit.
    pub fn to_rad(self) -> f64 {
        match self {
            Self::Rad => 1.0,
            Self::Deg => std::f64::consts::PI / 180.0,
        }
    }

    /// The name that column headers carry.
    pub const fn suffix(self) -> &'static str {
        match self {
            Self::Rad => "rad",
            Self::Deg => "deg",
        }
    }
}

/// From what the robot logs to the joint variables of the model:
/// `q = (raw * unit - raw_offset_rad) * raw_to_joint`, row vector times matrix.
///
/// It covers motor logs (gear ratios and wrist coupling) as well as joint logs with other signs and a
/// parallel rod between joints 2 and 3.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LogConversion {
    /// Prefix of the six columns in the log, so that `motor` reads `motor1_rad` to `motor6_rad`.
    pub column: String,
    /// Unit of the log.
    pub unit: AngleUnit,
    /// Value of each column where the robot is at its mechanical zero \[rad\].
    pub raw_offset_rad: [f64; ROBOT_JOINTS],
    /// 6 x 6; row i is what column i of the log contributes to each joint.
    pub raw_to_joint: [[f64; ROBOT_JOINTS]; ROBOT_JOINTS],
}

/// What is known of a robot's gears. Everything may be absent.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DrivesConfig {
    /// Lobes of the cycloid gear of each axis: ripples of its error in one turn; 0 where it has none or they are unknown.
    pub cycloid_lobes: [f64; ROBOT_JOINTS],
    /// Turns of the motor for one turn of each axis; 0 where unknown. A motor log says it by itself.
    pub motor_turns: [f64; ROBOT_JOINTS],
    /// Direction of gravity in the robot's base, of any length; absent: a robot that stands upright.
    pub gravity: Option<[f64; 3]>,
}

impl DrivesConfig {
    fn validate(&self) -> Result<(), Violation> {
        for (key, numbers) in [("cycloid_lobes", &self.cycloid_lobes), ("motor_turns", &self.motor_turns)] {
            for (axis, number) in numbers.iter().enumerate() {
                if !(0.0..=1e4).contains(number) {
                    return Err(Violation::new(
                        format!("drives.{key}[{axis}]"),
                        format!("{number} is no number of waves in a turn"),
                        "give a positive number, or 0 where it is unknown",
                    ));
                }
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

/// A robot: six links, nominal values from its data sheet.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotConfig {
    /// Maker and model.
    pub name: String,
    /// Links 1 to 6. Link 6 ends at the flange; plate and tool of the ball-bar are added to it.
    pub links: Vec<LinkConfig>,
    /// Lower and upper limit of each joint variable of the model \[deg\].
    pub joint_limits_deg: [[f64; 2]; ROBOT_JOINTS],
    /// How the log becomes joint variables.
    pub log: LogConversion,
    /// Its gears.
    #[serde(default)]
    pub drives: DrivesConfig,
}

impl Validate for RobotConfig {
    fn validate(&self) -> Result<(), Violation> {
        if self.links.len() != ROBOT_JOINTS {
            return Err(Violation::new(
                "links",
                format!("{} links are given", self.links.len()),
                "give the six links of the robot, base to flange",
            ));
        }
        validate_links("links", &self.links)?;
        for (joint, [low, high]) in self.joint_limits_deg.iter().enumerate() {
            if !(low.is_finite() && high.is_finite() && low < high) {
                return Err(Violation::new(
                    format!("joint_limits_deg[{joint}]"),
                    format!("[{low}, {high}] is not a range"),
                    "write [lower, upper] in degrees",
                ));
            }
        }
        self.drives.validate()?;
        let numbers = self.log.raw_offset_rad.iter().chain(self.log.raw_to_joint.iter().flatten());
        if !numbers.copied().all(f64::is_finite) {
            return Err(Violation::new("log", "a number is not finite", "write ordinary numbers"));
        }
        if determinant(&self.log.raw_to_joint) == 0.0 {
            return Err(Violation::new(
                "log.raw_to_joint",
                "the matrix is singular: some joint does not follow from the log",
                "check rows (log columns) and columns (joints)",
            ));
        }
        Ok(())
    }
}

/// Every number of every link is finite and every length is one of a robot, not of a field.
pub(super) fn validate_links(key: &str, links: &[LinkConfig]) -> Result<(), Violation> {
    const LENGTH_M_MAX: f64 = 10.0;
    const ANGLE_DEG_MAX: f64 = 360.0;
    for (index, link) in links.iter().enumerate() {
        let lengths = [("a_m", link.a_m), ("d_m", link.d_m)];
        let angles = [("alpha_deg", link.alpha_deg), ("theta_deg", link.theta_deg)];
        let checks = lengths
            .map(|(name, value)| (name, value, LENGTH_M_MAX, "lengths are in metres"))
            .into_iter()
            .chain(angles.map(|(name, value)| (name, value, ANGLE_DEG_MAX, "angles are in degrees")));
        for (name, value, limit, remedy) in checks {
            // A range that contains the value: NaN fails too.
            if !(-limit..=limit).contains(&value) {
                return Err(Violation::new(
                    format!("{key}[{index}].{name}"),
                    format!("{value} is out of range (at most {limit})"),
                    remedy,
                ));
            }
        }
    }
    Ok(())
}

/// Determinant by elimination with row pivoting; small and only asked whether it is zero.
fn determinant(matrix: &[[f64; ROBOT_JOINTS]; ROBOT_JOINTS]) -> f64 {
    let mut m = *matrix;
    let mut determinant = 1.0;
    for column in 0..ROBOT_JOINTS {
        let pivot = (column..ROBOT_JOINTS)
            .max_by(|&a, &b| m[a][column].abs().total_cmp(&m[b][column].abs()))
            .unwrap_or(column);
        if m[pivot][column] == 0.0 {
            return 0.0;
        }
        m.swap(column, pivot);
        determinant *= m[column][column];
        let pivot_row = m[column];
        for row in m.iter_mut().skip(column + 1) {
            let factor = row[column] / pivot_row[column];
            for (value, pivot_value) in row.iter_mut().zip(pivot_row) {
                *value -= factor * pivot_value;
            }
        }
    }
    determinant
}
