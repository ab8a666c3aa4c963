//! What a robot engineer types into a controller or a program: corrections with unit, sign and place.

use serde::{Deserialize, Serialize};
use shared::config::{AngleUnit, RobotConfig};

use super::file::{CalibrationFile, ReadIn};
use crate::calibrate::validation::deployment::Deployment;
use crate::kinematics::{Joints, LinkParameter};
use crate::logs::{JointConversion, LogError};
use crate::model::ParameterId;

/// One row of `corrections.csv` or `offsets.csv`, or of their `_log.csv`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Correction {
    /// What is corrected: `joint 2`, `link 3 alpha`, `motor2_rad` of the log.
    pub what: String,
    /// `deg`, `rad` or `mm`.
    pub unit: String,
    /// The number to add, in digits that controllers take: 0.0001 mm, 0.00001 deg.
    pub add: f64,
    /// To what it is added.
    pub to: String,
    /// Standard deviation; absent where the value was fixed or follows from several.
    pub sigma: Option<f64>,
    /// What all rows together are for.
    pub deployment: Deployment,
    /// Root mean square of held-out positions with all rows applied and nothing else \[mm\].
    pub held_out_mm: Option<f64>,
}

/// The one rule for the sign of a joint's offset.
pub(in crate::report) const TO_JOINT: &str =
    "the joint angle of the model (log converted as the robot's file says, nominal theta)";
const TO_LOG: &str = "the logged value before it is converted, in the log's own unit and sign";
const TO_LINK: &str = "the nominal Denavit-Hartenberg number of the link";

/// Rounded to the digits that a controller takes.
fn rounded(value: f64, unit: &str) -> f64 {
    let per_unit = match unit {
        "mm" => 1e4,
        "deg" => 1e5,
        _ => 1e7,
    };
    // Zero has no sign.
    (value * per_unit).round() / per_unit + 0.0
}

/// Rows of one table, which are applied together.
struct Rows {
    deployment: Deployment,
    held_out_mm: Option<f64>,
    rows: Vec<Correction>,
}

impl Rows {
    fn of(file: &CalibrationFile, deployment: Deployment) -> Self {
        let held_out_mm = file.held_out_m(deployment).map(|[_, own_m]| rounded(own_m * 1e3, "mm"));
        Self { deployment, held_out_mm, rows: Vec::new() }
    }

    fn push(&mut self, what: String, unit: &str, add: f64, to: &str, sigma: Option<f64>) {
        self.rows.push(Correction {
            what,
            unit: unit.into(),
            add: rounded(add, unit),
            to: to.into(),
            sigma: sigma.map(|sigma| rounded(sigma, unit)),
            deployment: self.deployment,
            held_out_mm: self.held_out_mm,
        });
    }
}

/// What a deployment takes: offsets of the model's joints, then every other correction of a link that is not zero.
pub fn corrections(file: &CalibrationFile, deployment: Deployment) -> Vec<Correction> {
    let (mut joints, mut links) = (Rows::of(file, deployment), Rows::of(file, deployment));
    for entry in &file.deployed(deployment).parameters {
        let Ok(ParameterId::Robot { link, parameter }) = entry.name.parse() else { continue };
        let ReadIn { factor, unit, .. } = entry.read_in();
        let (add, sigma) = (entry.correction * factor, entry.sigma.map(|sigma| sigma * factor));
        if parameter == LinkParameter::Theta {
            joints.push(format!("joint {}", link + 1), unit, add, TO_JOINT, sigma);
        } else {
            links.push(format!("link {} {}", link + 1, parameter.name()), unit, add, TO_LINK, sigma);
        }
    }
    let links = links.rows.into_iter().filter(|row| row.add != 0.0);
    joints.rows.into_iter().chain(links).collect()
}

/// The joint offsets of a deployment for the log's own columns, which are a controller's joint values where the log has them: applied
/// instead of those of the model's joints.
///
/// # Errors
/// [`LogError::SingularConversion`].
pub fn log_corrections(
    file: &CalibrationFile,
    robot: &RobotConfig,
    deployment: Deployment,
) -> Result<Vec<Correction>, LogError> {
    let mut offsets = Joints::zeros(robot.axes());
    for entry in &file.deployed(deployment).parameters {
        if let Ok(ParameterId::Robot { link, parameter: LinkParameter::Theta }) = entry.name.parse()
            && let Some(offset) = offsets.get_mut(link)
        {
            *offset = entry.correction;
        }
    }
    let mut rows = Rows::of(file, deployment);
    for (what, unit, add) in of_the_log(robot, &offsets)? {
        rows.push(what, unit, add, TO_LOG, None);
    }
    Ok(rows.rows)
}

/// `q + offset = (raw + change - raw_offset) T`: what the joint offsets are in the log's own columns: name, unit,
/// number to add.
fn of_the_log(robot: &RobotConfig, offsets: &Joints) -> Result<Vec<(String, &'static str, f64)>, LogError> {
    let conversion = JointConversion::of(robot)?;
    let (with, without) = (conversion.to_raw(offsets), conversion.to_raw(&Joints::zeros(offsets.len())));
    let unit = match robot.log.unit {
        AngleUnit::Deg => "deg",
        AngleUnit::Rad => "rad",
    };
    let row = |joint: usize| {
        (format!("{}{}_{unit}", robot.log.column, joint + 1), unit, with[joint] - without[joint])
    };
    Ok((0..offsets.len()).map(row).collect())
}

/// The text of a table.
///
/// # Errors
/// [`csv::Error`], which writing to memory does not have.
pub fn csv(rows: &[impl Serialize]) -> Result<String, csv::Error> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    rows.iter().try_for_each(|row| writer.serialize(row))?;
    let bytes = writer.into_inner().map_err(|error| csv::Error::from(error.into_error()))?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}
