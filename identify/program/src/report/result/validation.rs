//! Held-out validation, as files and the terminal have it.

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

/// Rows of a tracker or a wire, each a stage further: instrument alone, the robot's links, errors of its joints.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RowsEntry {
    /// Number of the data set, from 1.
    pub data_set: usize,
    /// What was held out together.
    pub hold_out: HoldOut,
    /// Seed that selected the rows.
    pub seed: u64,
    /// What the file calls places of the instrument and on the flange, after the parameters that are theirs: `tracker` has
    /// `tracker_x`, `tracker2_x` and so on.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub names: BTreeMap<String, Vec<String>>,
    /// Rows that the fit saw, but those that were rejected.
    pub fitted: Stages,
    /// Rows that it did not see.
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
    /// Rows that neither robot comes near, which are not in the figures.
    pub left_out: usize,
}

impl CalibrationFile {
    /// Adds what was validated.
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
            let [_, predicted, _] = held_out.rms().map(entry);
            let held_out = comparable(held_out).then_some(predicted);
            let with_it = evidence.workspace.deployed.get(&deployed.deployment);
            let expected_m = with_it.map(|with_it| [evidence.workspace.before.mean_m, with_it.mean_m]);
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
