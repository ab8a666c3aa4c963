//! What of a calibration is for which controller: geometry, held-out figures, files.

use serde::{Deserialize, Serialize};

use super::file::{CalibrationFile, ParameterEntry};
use crate::calibrate::deployment::{Deployed, Deployment};
use crate::calibrate::rows::{PoseFigures, Stages};
use crate::model::ParameterId;

/// The robot for who applies only part of the model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DeploymentEntry {
    /// What is applied.
    pub deployment: Deployment,
    /// The numbers of the robot's links, by a fit of nothing else.
    pub links: Vec<ParameterEntry>,
}

impl From<&Deployed> for DeploymentEntry {
    fn from(Deployed { deployment, model, solution }: &Deployed) -> Self {
        let all = ParameterEntry::all(model, |id| solution.covariance.sigma(model.column_of(id)?));
        let is_link = |entry: &ParameterEntry| matches!(entry.id(), Some(ParameterId::Robot { .. }));
        Self { deployment: *deployment, links: all.into_iter().filter(is_link).collect() }
    }
}

const fn stage(stages: &Stages, deployment: Deployment) -> &PoseFigures {
    match deployment {
        Deployment::Offsets => &stages.offsets,
        Deployment::Dh => &stages.links,
        Deployment::Full => &stages.joints,
    }
}

impl CalibrationFile {
    /// The same with the geometry of a deployment, where that has a fit of its own.
    #[must_use]
    pub fn deployed(&self, deployment: Deployment) -> Self {
        let mut file = self.clone();
        let entry = self.deployments.iter().find(|entry| entry.deployment == deployment);
        for own in entry.map_or(&[][..], |entry| &entry.links) {
            file.parameters
                .iter_mut()
                .filter(|other| other.name == own.name)
                .for_each(|other| *other = own.clone());
        }
        file
    }

    /// Held-out rows are predicted better than with the nominal robot by what a deployment takes, and surely so; true where none
    /// were held out.
    pub fn serves(&self, deployment: Deployment) -> bool {
        let held_out = || self.rows.iter().map(|rows| &rows.held_out).filter(|of| of.nominal.rows > 0);
        // Part of the full model is no fit of that part.
        let has_own =
            self.rows.is_empty() || self.deployments.iter().any(|entry| entry.deployment == deployment);
        self.may_be_applied()
            && has_own
            && held_out().all(|of| stage(of, deployment).are_surely_better_than(&of.nominal))
    }

    /// Root mean squares of the positions of data that no fit has seen, of the first data set that has some: with the nominal
    /// robot, and with what a deployment takes \[m\].
    pub fn held_out_m(&self, deployment: Deployment) -> Option<[f64; 2]> {
        let of_full = self.held_out.as_ref().filter(|_| deployment == Deployment::Full);
        let segments = of_full.map(|one| [one.nominal.position_m, one.calibrated.position_m]);
        let rows = || {
            let held_out = &self.rows.first()?.held_out;
            let own = stage(held_out, deployment);
            (own.rows > 0).then_some([held_out.nominal.position_m.rms, own.position_m.rms])
        };
        segments.or_else(rows)
    }

    /// What each deployment that leaves something out is worth on held-out data; nothing where there is none.
    pub(super) fn deployments_told(&self) -> Vec<String> {
        let told = |deployment: Deployment| {
            let what = match deployment {
                Deployment::Offsets => "joint offsets alone",
                Deployment::Dh => "links alone",
                Deployment::Full => "all terms",
            };
            if self.deployments.iter().all(|entry| entry.deployment != deployment) {
                // Of rows each was tried.
                return (!self.rows.is_empty())
                    .then(|| format!("no fit of {what} converges: they are not written"));
            }
            let [_, rms_m] = self.held_out_m(deployment)?;
            let files =
                if self.serves(deployment) { "" } else { ", not surely better than nominal: not written" };
            Some(format!("{:.3} mm with {what}{files}", rms_m * 1e3))
        };
        Deployment::PARTIAL.into_iter().filter_map(told).collect()
    }
}
