//! Results of held-out validation as entries of `calibration.toml` and `calibration.json`, and a line about them for the
//! terminal. A part of the data is left out of a fit, and the fitted model then predicts this part.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::deployments::DeploymentEntry;
use super::file::CalibrationFile;
use crate::calibrate::rows::{INDEPENDENT_OF_GROUP, PoseFigures, Stages};
use crate::calibrate::validation::deployment::Deployment;
use crate::calibrate::validation::unseen::UnseenPart;
use crate::evaluate::{Evidence, HeldOut};
use crate::instrument::{HoldOut, PoseError};

/// RMS errors on time segments. Each segment was predicted by a fit that does not use it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct HeldOutEntry {
    /// Number of predicted segments.
    pub segments: usize,
    /// Error of the nominal robot. The bar was fitted to the nominal robot on the other samples of the run.
    pub nominal: PoseError,
    /// Error of the calibrated robot if the fit does not use the segment.
    pub calibrated: PoseError,
    /// Error of the calibration, whose fit uses the segment.
    pub fitted: PoseError,
}

/// Errors on a file of rows, fitted and held out, in successive stages of the model: instrument alone, joint offsets,
/// other link parameters, joint errors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RowsEntry {
    /// Number of the data set, from 1.
    pub data_set: usize,
    /// Rule that selected which rows are held out together.
    pub hold_out: HoldOut,
    /// Seed of the random selection of rows.
    pub seed: u64,
    /// Names, as in the file, of the instrument's stations and of the targets on the flange. The key is the prefix of
    /// the parameters of these stations or targets: `tracker` has `tracker_x` for the first name, `tracker2_x` for the
    /// second and so on.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub names: BTreeMap<String, Vec<String>>,
    /// Errors on the rows of the fit, without rejected rows.
    pub fitted: Stages,
    /// Errors on the held-out rows.
    pub held_out: Stages,
    /// Number of independent errors among the held-out rows. Files of earlier versions do not contain this number; all
    /// held-out rows of such a file count as independent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub independent: Option<usize>,
}

/// Errors on the rows at one part of an instrument, such as a socket. A fit to all other data predicts these rows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct UnseenEntry {
    /// Number of the data set, from 1.
    pub data_set: usize,
    /// Name of the part.
    pub name: String,
    /// Errors of the prediction from all other data.
    pub predicted: PoseFigures,
    /// Errors of the calibration, whose fit includes these rows.
    pub fitted: PoseFigures,
}

impl From<&UnseenPart> for UnseenEntry {
    fn from(part: &UnseenPart) -> Self {
        let UnseenPart { data_set, name, predicted, fitted } = part.clone();
        Self { data_set: data_set + 1, name, predicted, fitted }
    }
}

/// Errors on the rows of a file that the calibration did not use.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ValidationEntry {
    /// Name of the file.
    pub name: String,
    /// Number (from 1) of the data set whose instrument measured the file.
    pub data_set: usize,
    /// Errors of the nominal robot. For both robots, the instrument was located by other rows of the file.
    pub nominal: PoseFigures,
    /// Errors of the calibrated robot.
    pub calibrated: PoseFigures,
    /// Number of rows outside the joint ranges in which the calibration is supported.
    pub unsupported: usize,
    /// Number of rows that are gross errors for both robots. They are not in the statistics.
    pub left_out: usize,
}

/// Root mean square errors on one set of held-out data.
pub(in crate::report) struct HeldOutErrors {
    pub what: String,
    /// Number of independent errors in each root mean square.
    pub independent: usize,
    pub nominal: PoseError,
    /// Error with the deployment. `None` if the fit of the deployment did not converge or does not predict these data.
    pub calibrated: Option<PoseError>,
    /// Error of the calibrated robot on the data of the fit.
    pub fitted: PoseError,
}

impl CalibrationFile {
    /// Adds the errors on held-out data: of the calibration, of each part of an instrument, and of each deployment.
    pub fn with_validation(mut self, evidence: &Evidence) -> Self {
        self.held_out =
            evidence.held_out.as_ref().filter(|held_out| !held_out.segments.is_empty()).map(|held_out| {
                let [nominal, calibrated, fitted] = held_out.rms();
                HeldOutEntry { segments: held_out.segments.len(), nominal, calibrated, fitted }
            });
        self.unseen = evidence.unseen.iter().map(UnseenEntry::from).collect();
        // The error of a deployment is comparable only if the deployment predicted as many segments as the calibration did.
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

    /// Errors if this part of the model is applied: on the held-out segments of all runs with a bar, then on the held-out
    /// rows of each file. For the full model, errors at unseen parts of each file follow.
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

    /// Errors on the rows at the parts of a data set's instrument, such as sockets. Each part was predicted by the fit to
    /// all other data. `None` if no part was predicted.
    fn at_unseen_parts(&self, rows: &RowsEntry) -> Option<HeldOutErrors> {
        let parts = || self.unseen.iter().filter(|part| part.data_set == rows.data_set);
        let rms = |errors: fn(&UnseenEntry) -> &PoseFigures| {
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

/// Root mean square over several groups of errors. Each item contains the number of errors in a group and the root mean
/// square of these errors.
fn pooled_rms(groups: impl Iterator<Item = (usize, f64)>) -> f64 {
    let sums = groups.fold([0.0, 0.0], |[count, squares], (number, rms)| {
        [count + number as f64, squares + number as f64 * rms.powi(2)]
    });
    (sums[1] / sums[0]).sqrt()
}

impl HeldOutEntry {
    /// The entry as a line for the terminal.
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
