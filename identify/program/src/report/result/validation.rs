//! Held-out validation as entries of `calibration.toml` and `calibration.json`, and its line for the terminal.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::deployments::DeploymentEntry;
use super::file::CalibrationFile;
use crate::calibrate::rows::{INDEPENDENT_OF_GROUP, PoseFigures, Stages};
use crate::calibrate::validation::deployment::Deployment;
use crate::calibrate::validation::unseen::UnseenPart;
use crate::evaluate::{Evidence, HeldOut};
use crate::instrument::{HoldOut, PoseError};

/// Segments of time that were predicted from fits to all others.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct HeldOutEntry {
    /// Number of segments.
    pub segments: usize,
    /// The nominal robot, the bar fitted to it.
    pub nominal: PoseError,
    /// The calibrated robot as fitted without the segment.
    pub calibrated: PoseError,
    /// The calibration, which has seen the segment.
    pub fitted: PoseError,
}

/// Errors of a file of rows, fitted and held out, in stages of the model: instrument alone, joint offsets, the other numbers of
/// links, errors of joints.
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
    /// Number of independent errors among the held-out rows. Files of earlier versions lack it: all their rows are counted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub independent: Option<usize>,
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

/// Root mean square errors on held-out data of one kind.
pub(in crate::report) struct HeldOutErrors {
    pub what: String,
    /// Number of independent errors in each root mean square.
    pub independent: usize,
    pub nominal: PoseError,
    /// `None` if the deployment's fit did not converge or does not predict these data.
    pub calibrated: Option<PoseError>,
    /// Of the calibrated robot on the data of the fit.
    pub fitted: PoseError,
}

impl CalibrationFile {
    /// Adds the held-out figures of the calibration, of each part of an instrument and of each deployment.
    pub fn with_validation(mut self, evidence: &Evidence) -> Self {
        self.held_out =
            evidence.held_out.as_ref().filter(|held_out| !held_out.segments.is_empty()).map(|held_out| {
                let [nominal, calibrated, fitted] = held_out.rms();
                HeldOutEntry { segments: held_out.segments.len(), nominal, calibrated, fitted }
            });
        self.unseen.clone_from(&evidence.unseen);
        // A deployment is compared on the same segments only.
        let comparable =
            |held_out: &HeldOut| Some(held_out.segments.len()) == self.held_out.map(|all| all.segments);
        let deployed = evidence.deployed.iter().map(|(deployed, held_out)| {
            let [_nominal, predicted, _fitted] = held_out.rms();
            let held_out = comparable(held_out).then_some(predicted);
            let expected = evidence.workspace.deployed.get(&deployed.deployment);
            let expected_m = expected.map(|expected| [evidence.workspace.before.mean_m, expected.mean_m]);
            DeploymentEntry { held_out, expected_m, ..DeploymentEntry::from(deployed) }
        });
        self.deployments = deployed.collect();
        self
    }

    /// Errors on the segments of all runs with a bar, then on the rows of each file, if this part of the model is applied.
    pub(in crate::report) fn held_out_with(&self, deployment: Deployment) -> Vec<HeldOutErrors> {
        let segments = self.held_out.map(|all| HeldOutErrors {
            what: "held-out segments".to_owned(),
            independent: INDEPENDENT_OF_GROUP * all.segments,
            nominal: all.nominal,
            calibrated: match deployment {
                Deployment::Full => Some(all.calibrated),
                _ => self.entry(deployment).and_then(|entry| entry.held_out),
            },
            fitted: all.fitted,
        });
        let rows = self.rows.iter().filter(|rows| rows.held_out.nominal.rows > 0).map(|rows| {
            let Stages { nominal, offsets, links, joints } = &rows.held_out;
            let calibrated = match deployment {
                Deployment::Offsets => offsets,
                Deployment::Dh => links,
                Deployment::Full => joints,
            };
            HeldOutErrors {
                what: format!("held-out rows of data set {}", rows.data_set),
                independent: rows.independent.unwrap_or(calibrated.rows),
                nominal: nominal.rms(),
                calibrated: (calibrated.rows > 0).then(|| calibrated.rms()),
                fitted: rows.fitted.joints.rms(),
            }
        });
        let unseen = self.rows.iter().filter(|_| deployment == Deployment::Full);
        let unseen = unseen.filter_map(|rows| self.at_unseen_parts(rows));
        segments.into_iter().chain(rows).chain(unseen).collect()
    }

    /// Errors of the rows of a data set at its parts, each predicted by the fit to all other data.
    fn at_unseen_parts(&self, rows: &RowsEntry) -> Option<HeldOutErrors> {
        let parts = || self.unseen.iter().filter(|part| part.data_set == rows.data_set);
        let rms = |errors: fn(&UnseenPart) -> &PoseFigures| {
            let position_m =
                pooled_rms(parts().map(errors).map(|figures| (figures.rows, figures.position_m.rms)));
            PoseError { position_m, rotation_rad: None }
        };
        let independent = INDEPENDENT_OF_GROUP * parts().count();
        (independent > 0).then(|| HeldOutErrors {
            what: format!("rows at unseen parts of data set {}", rows.data_set),
            independent,
            nominal: rows.held_out.nominal.rms(),
            calibrated: Some(rms(|part| &part.predicted)),
            fitted: rms(|part| &part.fitted),
        })
    }
}

/// Root mean square of groups with these numbers of errors and root mean squares.
fn pooled_rms(groups: impl Iterator<Item = (usize, f64)>) -> f64 {
    let sums = groups.fold([0.0, 0.0], |[count, squares], (number, rms)| {
        [count + number as f64, squares + number as f64 * rms.powi(2)]
    });
    (sums[1] / sums[0]).sqrt()
}

impl HeldOutEntry {
    /// The line for the terminal.
    pub(in crate::report) fn line(&self) -> String {
        let Self { segments, nominal, calibrated, fitted } = self;
        let [before, after, fit] = [nominal, calibrated, fitted].map(|error| error.position_m * 1e3);
        let rotations = nominal.rotation_rad.zip(calibrated.rotation_rad);
        let rotations = rotations.map(|(a, b)| format!(", {:.4} -> {:.4} mrad", a * 1e3, b * 1e3));
        format!(
            "held out: {segments} segments predicted from the others, robot against bar {before:.4} -> {after:.4} mm RMS \
             ({fit:.4} fitted){}\n",
            rotations.unwrap_or_default()
        )
    }
}
