//! Tables of corrections for controllers. `corrections.csv` and `offsets.csv` list the numbers to add to parameters of the
//! controller, with unit and sign. Each of the two files belongs to one deployment. `corrections_log.csv` and
//! `offsets_log.csv` list the joint offsets of the same deployments in units and signs of the robot's log.

use serde::{Deserialize, Serialize};
use shared::config::{JointKind, RobotConfig};

use super::file::{CalibrationFile, ReadIn};
use crate::calibrate::validation::deployment::Deployment;
use crate::kinematics::{Joints, LinkParameter};
use crate::logs::{LogError, LoggedJoints};
use crate::model::ParameterId;

/// One row of `corrections.csv`, `offsets.csv`, `corrections_log.csv` or `offsets_log.csv`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Correction {
    /// Name of the corrected quantity, such as `joint 2`, `link 3 alpha`, or column `motor2_rad` of the log.
    pub what: String,
    /// Unit of the number: `deg`, `rad`, `mm` or, in a log, `m`.
    pub unit: String,
    /// Number to add, rounded to the digits that controllers accept: 0.0001 mm, 0.00001 deg.
    pub add: f64,
    /// Quantity to which the number is added.
    pub to: String,
    /// Standard deviation. Absent if the value was fixed or results from several parameters.
    pub sigma: Option<f64>,
    /// Deployment of the table. All rows of the table are intended to be applied together.
    pub deployment: Deployment,
    /// RMS error of held-out positions if all rows of the table and no other corrections are applied \[mm\].
    pub held_out_mm: Option<f64>,
}

/// Definition of the sign of a joint's offset, used in all outputs.
pub(in crate::report) const TO_JOINT: &str =
    "the joint angle of the model (converted by the robot's file or the mapping, nominal theta)";
const TO_PRISMATIC_JOINT: &str =
    "the joint variable of the model (converted by the robot's file or the mapping, nominal d)";
const TO_LOG: &str = "the logged value before it is converted, in the log's own unit and sign";
const TO_LINK: &str = "the nominal Denavit-Hartenberg number of the link";

/// Rounds a value to the digits that a controller accepts.
fn rounded(value: f64, unit: &str) -> f64 {
    let per_unit = match unit {
        "mm" => 1e4,
        "deg" => 1e5,
        _ => 1e7,
    };
    // Adding zero turns -0 into 0.
    (value * per_unit).round() / per_unit + 0.0
}

/// Returns a function that makes a row of one table. The arguments of this function are name, unit, number to add, quantity
/// to which the number is added, and sigma.
fn row_of(
    file: &CalibrationFile,
    deployment: Deployment,
) -> impl Fn(String, &str, f64, &str, Option<f64>) -> Correction {
    let held_out_mm =
        file.held_out_m(deployment).map(|[_nominal_m, deployed_m]| rounded(deployed_m * 1e3, "mm"));
    move |what, unit, add, to, sigma| Correction {
        what,
        unit: unit.into(),
        add: rounded(add, unit),
        to: to.into(),
        sigma: sigma.map(|sigma| rounded(sigma, unit)),
        deployment,
        held_out_mm,
    }
}

/// Lists the corrections of a deployment: first the offset of every joint of the model, even if it is zero, then the other
/// corrections of links, except corrections of zero.
pub fn corrections(file: &CalibrationFile, robot: &RobotConfig, deployment: Deployment) -> Vec<Correction> {
    let row = row_of(file, deployment);
    let kinds: Vec<JointKind> = robot.joint_kinds().collect();
    let (mut joints, mut links) = (Vec::new(), Vec::new());
    for entry in &file.deployed(deployment).parameters {
        let Ok(ParameterId::Robot { link, parameter }) = entry.name.parse() else { continue };
        let ReadIn { factor, unit, .. } = entry.read_in();
        let (add, sigma) = (entry.correction * factor, entry.sigma.map(|sigma| sigma * factor));
        let kind = kinds.get(link).copied().unwrap_or_default();
        if parameter == LinkParameter::offset_of(kind) {
            let to = match kind {
                JointKind::Revolute => TO_JOINT,
                JointKind::Prismatic => TO_PRISMATIC_JOINT,
            };
            joints.push(row(format!("joint {}", link + 1), unit, add, to, sigma));
        } else {
            links.push(row(format!("link {} {}", link + 1, parameter.name()), unit, add, TO_LINK, sigma));
        }
    }
    links.retain(|row| row.add != 0.0);
    joints.append(&mut links);
    joints
}

/// Lists the joint offsets of a deployment as changes of the columns of the robot's log. If the joint values
/// of a controller are those of its log, the controller needs these changes instead of the offsets of the
/// model's joints. Without `logged`, the columns are those of the robot's own log.
///
/// # Errors
/// [`LogError::SingularConversion`].
pub fn log_corrections(
    file: &CalibrationFile,
    robot: &RobotConfig,
    logged: Option<&LoggedJoints>,
    deployment: Deployment,
) -> Result<Vec<Correction>, LogError> {
    let logged = logged.cloned().map_or_else(|| LoggedJoints::of_robot(robot), Ok)?;
    let mut offsets = Joints::zeros(robot.axes());
    let mut sigmas = vec![None; robot.axes()];
    for entry in &file.deployed(deployment).parameters {
        if let Ok(ParameterId::Robot { link, parameter }) = entry.name.parse()
            && let Some(kind) = robot.joint_kinds().nth(link)
            && parameter == LinkParameter::offset_of(kind)
        {
            (offsets[link], sigmas[link]) = (entry.correction, entry.sigma);
        }
    }
    let row = row_of(file, deployment);
    let columns = logged.names.iter().zip(&logged.units);
    let changes = logged.changes(&offsets).into_iter().zip(logged.sigmas(&sigmas));
    Ok(columns
        .zip(changes)
        .map(|((column, unit), (change, sigma))| row(column.clone(), unit.suffix(), change, TO_LOG, sigma))
        .collect())
}

/// The table as CSV text.
///
/// # Errors
/// [`csv::Error`], which does not occur when writing to memory.
pub fn csv(rows: &[impl Serialize]) -> Result<String, csv::Error> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    rows.iter().try_for_each(|row| writer.serialize(row))?;
    let bytes = writer.into_inner().map_err(|error| csv::Error::from(error.into_error()))?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}
