//! Held-out validation as entries of `calibration.toml` and `calibration.json`, and its line for the terminal.

use std::collections::BTreeMap;
use std::fmt::Write;

use serde::{Deserialize, Serialize};

use super::deployments::DeploymentEntry;
use super::file::CalibrationFile;
use crate::calibrate::rows::{PoseFigures, Stages};
use crate::evaluate::{Evidence, HeldOut, PoseErrorRms};
use crate::instrument::HoldOut;

/// Robot against bar, root mean square.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PoseErrorEntry {
    /// Distance of the two ends; without encoders the distance from the bar's sphere \[m\].
    pub position_m: f64,
    /// Angle between them; absent where a joint of the bar has no encoder \[rad\].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rotation_rad: Option<f64>,
}

/// Segments of time that were predicted from fits to all others.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct HeldOutEntry {
    /// Number of segments.
    pub segments: usize,
    /// The nominal robot, the bar fitted to it.
    pub nominal: PoseErrorEntry,
    /// The calibrated robot as fitted without the segment.
    pub calibrated: PoseErrorEntry,
    /// The calibration, which has seen the segment.
    pub fitted: PoseErrorEntry,
}

/// Errors of a file of rows, fitted and held out, in stages of the model: instrument alone, the robot's links,
/// errors of its joints.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RowsEntry {
    /// Number of the data set, from 1.
    pub data_set: usize,
    /// What was held out together.
    pub hold_out: HoldOut,
    /// Seed that selected the rows.
    pub seed: u64,
    /// Names that the file gives to stations of the instrument and to targets on the flange, by the prefix of their parameters:
    /// `tracker` has `tracker_x` for the first name, `tracker2_x` for the second and so on.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub names: BTreeMap<String, Vec<String>>,
    /// Rows of the fit without the rejected ones.
    pub fitted: Stages,
    /// Held-out rows.
    pub held_out: Stages,
}

/// Rows of a file that took no part in the calibration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ValidationEntry {
    /// The file.
    pub name: String,
    /// Data set whose instrument measured it, from 1.
    pub data_set: usize,
    /// With the nominal robot, the instrument placed by other rows of the file.
    pub nominal: PoseFigures,
    /// With the calibrated robot.
    pub calibrated: PoseFigures,
    /// Rows where the calibration is not supported.
    pub unsupported: usize,
    /// Rows that are gross errors for both robots, which are not in the figures.
    pub left_out: usize,
}

impl CalibrationFile {
    /// Adds the held-out figures of the calibration and of each deployment.
    pub fn with_validation(mut self, evidence: &Evidence) -> Self {
        let entry = |rms: PoseErrorRms| PoseErrorEntry {
            position_m: rms.position_m,
            rotation_rad: evidence.rotations.then_some(rms.rotation_rad),
        };
        self.held_out =
            evidence.held_out.as_ref().filter(|held_out| !held_out.segments.is_empty()).map(|held_out| {
                let [nominal, calibrated, fitted] = held_out.rms().map(entry);
                HeldOutEntry { segments: held_out.segments.len(), nominal, calibrated, fitted }
            });
        // A deployment is compared on the same segments only.
        let comparable =
            |held_out: &HeldOut| Some(held_out.segments.len()) == self.held_out.map(|all| all.segments);
        let deployed = evidence.deployed.iter().map(|(deployed, held_out)| {
            let [_nominal, predicted, _fitted] = held_out.rms().map(entry);
            let held_out = comparable(held_out).then_some(predicted);
            let expected = evidence.workspace.deployed.get(&deployed.deployment);
            let expected_m = expected.map(|expected| [evidence.workspace.before.mean_m, expected.mean_m]);
            DeploymentEntry { held_out, expected_m, ..DeploymentEntry::from(deployed) }
        });
        self.deployments = deployed.collect();
        self
    }
}

/// Lines for a terminal.
pub(in crate::report) fn describe(file: &CalibrationFile) -> String {
    let mut text = String::new();
    // Writing to a string cannot fail.
    if let Some(HeldOutEntry { segments, nominal, calibrated, fitted }) = &file.held_out {
        let mm = |entry: &PoseErrorEntry| entry.position_m * 1e3;
        let _ = write!(
            text,
            "held out: {segments} segments predicted from the others, robot against bar {:.4} -> {:.4} mm RMS ({:.4} fitted)",
            mm(nominal),
            mm(calibrated),
            mm(fitted),
        );
        if let (Some(before), Some(after)) = (nominal.rotation_rad, calibrated.rotation_rad) {
            let _ = write!(text, ", {:.4} -> {:.4} mrad", before * 1e3, after * 1e3);
        }
        text.push('\n');
    }
    text
}
