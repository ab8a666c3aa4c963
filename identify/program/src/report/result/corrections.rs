//! `corrections.csv` and `offsets.csv`: the numbers that are added to parameters of the controller, with unit and sign, for one
//! deployment; and `corrections_log.csv` and `offsets_log.csv`, the joint offsets in units and signs of the robot's log.

use serde::{Deserialize, Serialize};
use shared::config::{JointKind, RobotConfig};

use super::file::{CalibrationFile, ReadIn};
use crate::calibrate::validation::deployment::Deployment;
use crate::kinematics::{Joints, LinkParameter};
use crate::logs::{JointColumn, JointConversion, LogError, RobotLogMapping, own_columns};
use crate::model::ParameterId;

/// One row of `corrections.csv` or `offsets.csv`, or of their `_log.csv`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Correction {
    /// What is corrected: `joint 2`, `link 3 alpha`, `motor2_rad` of the log.
    pub what: String,
    /// `deg`, `rad`, `mm` or, in a log, `m`.
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
const TO_PRISMATIC_JOINT: &str =
    "the joint variable of the model (log converted as the robot's file says, nominal d)";
const TO_LOG: &str = "the logged value before it is converted, in the log's own unit and sign";
const TO_LINK: &str = "the nominal Denavit-Hartenberg number of the link";

/// Rounded to the digits that a controller takes.
fn rounded(value: f64, unit: &str) -> f64 {
    let per_unit = match unit {
        "mm" => 1e4,
        "deg" => 1e5,
        _ => 1e7,
    };
    // Adding zero turns -0 into 0.
    (value * per_unit).round() / per_unit + 0.0
}

/// A function that makes the rows of one table: name, unit, number to add, what it is added to, sigma.
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

/// Corrections of a deployment: offsets of the model's joints, then every other correction of a link that is not zero.
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

/// The joint offsets of a deployment as changes of the columns of the robot's log. The mapping, or else the robot's file, has
/// names and conversion of the columns. A controller whose joint values are those of its log takes these changes in place of the
/// offsets of the model's joints. With the log's conversion `q = (raw - raw_offset) T`, the `change` of each column follows from
/// `q + offset = (raw + change - raw_offset) T`.
///
/// # Errors
/// [`LogError::SingularConversion`].
pub fn log_corrections(
    file: &CalibrationFile,
    robot: &RobotConfig,
    mapping: Option<&RobotLogMapping>,
    deployment: Deployment,
) -> Result<Vec<Correction>, LogError> {
    let zeros = Joints::zeros(robot.axes());
    let mut offsets = zeros;
    for entry in &file.deployed(deployment).parameters {
        if let Ok(ParameterId::Robot { link, parameter }) = entry.name.parse()
            && let Some(kind) = robot.joint_kinds().nth(link)
            && parameter == LinkParameter::offset_of(kind)
            && let Some(offset) = offsets.get_mut(link)
        {
            *offset = entry.correction;
        }
    }
    // Name and unit of each column, and that unit in the unit of `to_raw`: the log's own, with a mapping rad or m.
    let column_of_robot = |(column, kind): (String, JointKind)| match kind {
        JointKind::Revolute => (column, robot.log.unit.suffix(), 1.0),
        JointKind::Prismatic => (column, kind.si_symbol(), 1.0),
    };
    let (conversion, columns): (_, Vec<(String, &str, f64)>) =
        match mapping.and_then(RobotLogMapping::with_joints) {
            None => (
                JointConversion::of(robot)?,
                own_columns(robot).into_iter().zip(robot.joint_kinds()).map(column_of_robot).collect(),
            ),
            Some(mapping) => {
                let column =
                    |joint: &JointColumn| (joint.column.clone(), joint.unit.suffix(), joint.unit.to_si());
                (JointConversion::new(&mapping.conversion())?, mapping.joints.iter().map(column).collect())
            }
        };
    // The difference is the change, because the conversion is affine.
    let [with, without] = [offsets, zeros].map(|joints| conversion.to_raw(&joints));
    let row = row_of(file, deployment);
    let changes = columns.into_iter().zip(with.iter().zip(&without));
    Ok(changes
        .map(|((column, unit, to_si), (with, without))| {
            row(column, unit, (with - without) / to_si, TO_LOG, None)
        })
        .collect())
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
