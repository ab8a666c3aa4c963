//! Calibration from rows of one instrument alone, each a pose at which the robot stood still and what was measured there: by a
//! tracker ([`tracker`]) or by a draw-wire or telescoping bar ([`wire`]).
//!
//! Unknown are the place of the instrument and what of it is on the flange, the robot's links, with priors from tolerances, and
//! the errors of its joints, each kind only if fitting rows left out are predicted better with it. Held-out rows take no part
//! in any of this, and the figures on them are what counts; the result is a last fit to all rows.

mod drift;
mod error;
mod faulty_runs;
mod figures;
mod implausible;
mod terms;
pub mod tracker;
pub mod wire;

use super::change::Changed;
use super::deployment::Deployed;
use super::links::{TOLERANCE, free_links, link_ids};
use super::split::HoldOut;
use super::terms::{Candidate, Kind};
use crate::instrument::{RejectedRow, without};
use crate::kinematics::Chain;
use crate::model::{Model, ModelError, ParameterId};
use crate::solver::{LossName, Solution};

pub use drift::Drift;
pub use error::RowError;
pub use faulty_runs::{FaultyRun, RunCause};
pub use figures::{PoseFigures, RowErrors, Sizes, Stages, is_surely_better};
pub(super) use implausible::of_mix;
pub use implausible::{Likely, Mistake, Step, likely, misfit};
pub(super) use terms::kinds;

/// Highest order of the joints' waves that is tried as a rule: there is no finer tooth near the output of a strain wave gear.
pub const WAVES_PER_TURN_MAX: u8 = 64;

/// How the calibration is done.
#[derive(Debug, Clone, PartialEq)]
pub struct RowOptions {
    /// What is held out together, from the figures and from each fold of the choice of joint errors.
    pub hold_out: HoldOut,
    /// Part of the rows that the fit never sees.
    pub held_out: f64,
    /// Decides which.
    pub seed: u64,
    /// How much rows count that do not fit.
    pub loss: LossName,
    /// Prior of the links' lengths around nominal, one standard deviation \[m\].
    pub link_sigma_m: f64,
    /// Prior of the links' angles around nominal, one standard deviation \[rad\].
    pub link_sigma_rad: f64,
    /// Highest order of the joints' waves that is tried.
    pub waves_per_turn_max: u8,
    /// Joint errors may be taken.
    pub joint_errors: bool,
    /// Parameters that stay where they start: links at nominal, the instrument at the flange's origin, no joint error.
    pub fix: Vec<ParameterId>,
}

impl RowOptions {
    /// As is usual with a tracker.
    pub fn tracker() -> Self {
        Self {
            hold_out: HoldOut::Regions,
            held_out: 0.2,
            seed: 1,
            loss: LossName::Huber,
            link_sigma_m: 1e-2,
            link_sigma_rad: 2e-2,
            waves_per_turn_max: WAVES_PER_TURN_MAX,
            joint_errors: true,
            fix: Vec::new(),
        }
    }

    /// As is usual with a wire, whose lengths have heavy tails.
    pub fn wire() -> Self {
        let (hold_out, loss) = (HoldOut::Rows, LossName::Cauchy);
        Self { hold_out, seed: 1042, loss, link_sigma_rad: 1e-2, ..Self::tracker() }
    }

    fn check(&self) -> Result<(), RowError> {
        for (option, value) in [("link_sigma_m", self.link_sigma_m), ("link_sigma_rad", self.link_sigma_rad)]
        {
            if !(value.is_finite() && value > 0.0) {
                return Err(RowError::BadOption { option, value, remedy: "give a number above zero" });
            }
        }
        if !(0.0..0.9).contains(&self.held_out) {
            let (option, value) = ("held_out", self.held_out);
            return Err(RowError::BadOption { option, value, remedy: "give a part from 0 to below 0.9" });
        }
        Ok(())
    }

    /// What joint errors of the model are tried, with waves up to an order.
    ///
    /// # Errors
    /// [`ModelError::NotInModel`] where something is fixed that is not among them.
    fn kinds(&self, model: &Model, waves_last: u8) -> Result<Vec<Kind>, ModelError> {
        let with_waves = model.clone().with_joint_waves(ParameterId::joint_waves(waves_last));
        let known = |id: &ParameterId| with_waves.parameter(*id).is_some();
        if let Some(&id) = self.fix.iter().find(|id| !known(id)) {
            return Err(ModelError::NotInModel { id });
        }
        let kinds = self.joint_errors.then(|| kinds(waves_last, |id| known(id) && !self.fix.contains(id)));
        Ok(kinds.unwrap_or_default())
    }

    fn free_links(&self, model: &mut Model, robot: &Chain) -> Result<(), ModelError> {
        let sigmas = [self.link_sigma_m, self.link_sigma_rad];
        free_links(model, &link_ids(robot), &self.fix, sigmas, TOLERANCE)
    }
}

/// A robot calibrated from rows.
#[derive(Debug, Clone)]
pub struct RowCalibration {
    /// Name of the cost: lengths, positions or whole poses.
    pub cost: &'static str,
    /// Each row, rejected or not.
    pub errors: RowErrors,
    /// Rows that did not take part, and why.
    pub rejected: Vec<RejectedRow>,
    /// Faulty runs of rows, with what would explain them.
    pub runs: Vec<FaultyRun>,
    /// Drift of the instrument's zero, where left-out rows asked for it; it is part of the last stage of all figures.
    pub drift: Option<Drift>,
    /// Kinds of joint errors, taken or not.
    pub terms: Vec<Candidate>,
    /// Standard deviation of a length or a coordinate, from the spread of the residuals \[m\].
    pub sigma_m: f64,
    /// The solve of all rows.
    pub solution: Solution,
    /// The calibrated model, of all rows.
    pub model: Model,
    /// What did not stay while it was measured.
    pub changed: Vec<Changed>,
    /// The best geometry for who applies less than that, of all rows.
    pub deployed: Vec<Deployed>,
}

impl RowCalibration {
    /// Rows that the fit saw, without rejected ones.
    pub fn fitted(&self) -> Stages {
        self.errors.of(&without(&self.errors.fitted, &self.rejected))
    }

    /// Held-out rows, without those whose own data contradict each other and those in faulty runs.
    pub fn held_out(&self) -> Stages {
        self.errors.of(&without(&self.errors.held_out, &self.rejected))
    }

    /// All held-out rows.
    pub fn held_out_with_rejected(&self) -> Stages {
        self.errors.of(&self.errors.held_out)
    }

    /// Standard deviation of a parameter, SI; none where it was fixed.
    pub fn sigma(&self, id: ParameterId) -> Option<f64> {
        self.solution.covariance.sigma(self.model.column_of(id)?)
    }
}
