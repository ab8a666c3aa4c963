//! Deployments, for controllers that cannot apply the full model. A deployment applies part of the model, and has its
//! own fit of the links and its own errors on held-out data. [`CalibrationFile::serves`] decides whether the files of
//! a deployment are written.

use serde::{Deserialize, Serialize};

use super::file::{CalibrationFile, ParameterEntry};
use super::validation::HeldOutErrors;
use crate::calibrate::rows::is_surely_better;
use crate::calibrate::validation::deployment::{Deployed, Deployment};
use crate::evaluate::{Expected, WorkspaceError};
use crate::instrument::PoseError;
use crate::model::ParameterId;

/// Results if only part of the model is applied.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DeploymentEntry {
    /// Part of the model that is applied.
    pub deployment: Deployment,
    /// Link parameters of robot and ball-bar, from a fit that estimates no other parameters of the robot.
    pub links: Vec<ParameterEntry>,
    /// Prediction error on held-out segments with this deployment. Errors on held-out rows are in the
    /// `rows` of the calibration.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub held_out: Option<PoseError>,
    /// Mean of the expected position error over the workspace \[m\]: for the nominal robot, and for the
    /// robot with this deployment.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expected_m: Option<[f64; 2]>,
}

impl From<&Deployed> for DeploymentEntry {
    fn from(Deployed { deployment, model, solution }: &Deployed) -> Self {
        let all = ParameterEntry::all(model, |id| solution.covariance.sigma(model.column_of(id)?));
        let is_link = |entry: &ParameterEntry| {
            matches!(entry.id(), Some(ParameterId::Robot { .. } | ParameterId::Bar { .. }))
        };
        let links = all.into_iter().filter(is_link).collect();
        Self { deployment: *deployment, links, held_out: None, expected_m: None }
    }
}

/// Files that are written for a deployment, in addition to the full calibration.
pub const fn files(deployment: Deployment) -> &'static [&'static str] {
    match deployment {
        Deployment::Offsets => &["offsets.csv", "offsets_log.csv"],
        Deployment::Dh => &["dh.csv", "corrections.csv", "corrections_log.csv", "robot.urdf"],
        Deployment::Full => &[],
    }
}

/// Name of a deployment, for display.
pub(in crate::report) const fn what(deployment: Deployment) -> &'static str {
    match deployment {
        Deployment::Offsets => "joint offsets alone",
        Deployment::Dh => "links alone",
        Deployment::Full => "all terms",
    }
}

impl CalibrationFile {
    /// Returns the calibration with the link parameters from the fit of a deployment. If the deployment has no fit of its
    /// own, the calibration is returned unchanged.
    #[must_use]
    pub fn deployed(&self, deployment: Deployment) -> Self {
        let mut file = self.clone();
        for link in self.entry(deployment).map_or(&[][..], |entry| &entry.links) {
            file.parameters
                .iter_mut()
                .filter(|parameter| parameter.name == link.name)
                .for_each(|parameter| *parameter = link.clone());
        }
        file
    }

    /// Returns the calibration with the links of `corrections.csv` if this file is written, otherwise unchanged. Page,
    /// terminal and files are made from this result, so that a joint has the same offset in all of them.
    pub(in crate::report) fn applied(&self) -> Self {
        if self.serves(Deployment::Dh) { self.deployed(Deployment::Dh) } else { self.clone() }
    }

    pub(super) fn entry(&self, deployment: Deployment) -> Option<&DeploymentEntry> {
        self.deployments.iter().find(|entry| entry.deployment == deployment)
    }

    /// Whether the files of a deployment are written. The deployment must have a fit of its own and must be expected to
    /// reduce the mean error over the workspace. If data were held out, the deployment must also predict these data
    /// significantly better than the nominal robot does.
    pub fn serves(&self, deployment: Deployment) -> bool {
        self.serves_held_out(deployment) && !self.is_worse_elsewhere(deployment)
    }

    /// Whether the expected mean error over the workspace is not smaller than that of the nominal robot.
    fn is_worse_elsewhere(&self, deployment: Deployment) -> bool {
        let expected = self.entry(deployment).and_then(|entry| entry.expected_m);
        expected.is_some_and(|[nominal_m, deployed_m]| deployed_m >= nominal_m)
    }

    /// Checks the conditions of [`Self::serves`], except the condition on the expected error over the workspace.
    fn serves_held_out(&self, deployment: Deployment) -> bool {
        let is_better = |errors: &HeldOutErrors| {
            let both = errors.calibrated.map(|calibrated| [errors.nominal, calibrated]);
            both.is_some_and(|both| is_surely_better(errors.independent, both))
        };
        self.may_be_applied()
            && self.entry(deployment).is_some()
            && self.held_out_with(deployment).iter().all(is_better)
    }

    /// RMS position errors of the nominal robot and of a deployment on held-out data \[m\]. They are computed from the
    /// held-out segments of all runs with a bar. Without such segments, they are computed from the first file of rows for
    /// which both errors are known.
    pub fn held_out_m(&self, deployment: Deployment) -> Option<[f64; 2]> {
        let both =
            |errors: &HeldOutErrors| Some([errors.nominal, errors.calibrated?].map(|one| one.position_m));
        self.held_out_with(deployment).iter().find_map(both)
    }

    /// Expected error over the workspace for each deployment that is written. The deployment that applies the largest part
    /// of the model comes first.
    pub(in crate::report) fn deployments_expected<'w>(
        &'w self,
        workspace: &'w WorkspaceError,
    ) -> impl Iterator<Item = (Deployment, &'w Expected)> {
        let all = workspace.deployed.iter().rev().map(|(deployment, expected)| (*deployment, expected));
        all.filter(|(deployment, _)| self.serves(*deployment))
    }

    /// Returns sentences about the deployments that apply only part of the model: the error on held-out data and, if the
    /// files of the deployment are not written, the reason.
    pub(in crate::report) fn deployments_reported(&self) -> Vec<String> {
        let sentence = |deployment: Deployment| {
            let what = what(deployment);
            if self.entry(deployment).is_none() {
                return Some(format!("no fit of {what} converges: they are not written"));
            }
            let Some([_, rms_m]) = self.held_out_m(deployment) else {
                return (!self.serves(deployment))
                    .then(|| format!("{what} could not be tried on them: they are not written"));
            };
            let files = if !self.serves_held_out(deployment) {
                ", not surely better than nominal: not written"
            } else if self.is_worse_elsewhere(deployment) {
                ", but expected to be worse than nominal elsewhere in the workspace: not written"
            } else {
                ""
            };
            Some(format!("{:.3} mm with {what}{files}", rms_m * 1e3))
        };
        Deployment::PARTIAL.into_iter().filter_map(sentence).collect()
    }
}
