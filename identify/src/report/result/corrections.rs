//! What a robot engineer types into a controller or a program: corrections with unit, sign and place.

use serde::{Deserialize, Serialize};
use shared::config::{AngleUnit, RobotConfig};

use super::file::CalibrationFile;
use crate::calibrate::validation::deployment::Deployment;
use crate::kinematics::{Joints, LinkParameter};
use crate::logs::{JointConversion, LogError};
use crate::model::{ParameterId, Unit};

/// One row of `corrections.csv` or `offsets.csv`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Correction {
    /// What is corrected: `joint 2`, `motor2_rad`, `link 3 alpha`.
    pub what: String,
    /// `deg`, `rad` or `mm`.
    pub unit: String,
    /// The number to add.
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

const TO_JOINT: &str = "the joint angle of the model (log converted as the robot's file says, nominal theta)";
const TO_LOG: &str =
    "the logged value before it is converted; instead of the joint corrections, not on top of them";
const TO_LINK: &str = "the nominal Denavit-Hartenberg number of the link";

/// What a deployment takes: joint offsets for the model, the same for the log's own columns, and every other correction of a
/// link.
///
/// # Errors
/// [`LogError::SingularConversion`].
pub fn corrections(
    file: &CalibrationFile,
    robot: &RobotConfig,
    deployment: Deployment,
) -> Result<Vec<Correction>, LogError> {
    let held_out_mm = file.held_out_m(deployment).map(|[_, own_m]| own_m * 1e3);
    let correction = |what: String, unit: &str, add: f64, to: &str, sigma: Option<f64>| Correction {
        what,
        unit: unit.into(),
        add,
        to: to.into(),
        sigma,
        deployment,
        held_out_mm,
    };
    let mut offsets = Joints::zeros(robot.axes());
    let (mut joints, mut links) = (Vec::new(), Vec::new());
    for entry in &file.deployed(deployment).parameters {
        let Ok(ParameterId::Robot { link, parameter }) = entry.name.parse() else { continue };
        if parameter == LinkParameter::Theta {
            if let Some(offset) = offsets.get_mut(link) {
                *offset = entry.correction;
            }
            let (what, add) = (format!("joint {}", link + 1), entry.correction.to_degrees());
            joints.push(correction(what, "deg", add, TO_JOINT, entry.sigma.map(f64::to_degrees)));
        } else if entry.correction != 0.0 {
            let (unit, factor) = match (ParameterId::Robot { link, parameter }).unit() {
                Unit::Metre => ("mm", 1e3),
                _ => ("deg", 1f64.to_degrees()),
            };
            let what = format!("link {} {}", link + 1, parameter.name());
            let sigma = entry.sigma.map(|sigma| sigma * factor);
            links.push(correction(what, unit, entry.correction * factor, TO_LINK, sigma));
        }
    }
    let mut rows = joints;
    let of_log = of_the_log(robot, &offsets)?.into_iter();
    rows.extend(of_log.map(|(what, unit, add)| correction(what, unit, add, TO_LOG, None)));
    rows.extend(links);
    Ok(rows)
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

/// The rows as text.
///
/// # Errors
/// [`csv::Error`], which writing to memory does not have.
pub fn csv(rows: &[Correction]) -> Result<String, csv::Error> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    rows.iter().try_for_each(|row| writer.serialize(row))?;
    let bytes = writer.into_inner().map_err(|error| csv::Error::from(error.into_error()))?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}
