//! Computes all results that the report of a calibration shows, and collects them in [`Evidence`]. A gap is the
//! distance between the robot's end and the bar's end. Without the first two encoders the bar's end is unknown. A gap is
//! then the distance of the robot's end from the sphere of the bar.

use super::accuracy::workspace::Workspace;
use super::limits::gap_m;
use super::{
    HeldOut, JointGap, Limit, ShiftCurve, SphereDeviation, WorkspaceError, held_out, joint_gaps, limits,
    nominals, shift_curve, uncalibrated,
};
use crate::calibrate::validation::deployment::{Deployed, Deployment};
use crate::calibrate::validation::held_out::without_each_segment;
use crate::calibrate::validation::unseen::{UnseenPart, unseen_parts};
use crate::calibrate::{CalibrateError, Calibration};
use crate::cost::{Closure, loop_closures};
use crate::model::{Geometry, Model};
use crate::prepare::Prepared;
use crate::solver::Watch;
use crate::statistics::Sizes;
use crate::threads::{both, each};

/// Results of one run of a calibration.
#[derive(Debug, Clone)]
pub struct RunEvidence {
    /// Closure of each sample with the nominal robot, and with the bar fitted to this robot.
    pub before: Vec<Closure>,
    /// Closure of each sample at the solution.
    pub after: Vec<Closure>,
    /// Gap as a function of the time shift, over a wide range.
    pub shift_wide: ShiftCurve,
    /// Gap as a function of the time shift, near the minimum.
    pub shift_near: ShiftCurve,
}

impl RunEvidence {
    /// Computes the results of a run. `model` contains the solution.
    pub fn new(prepared: &Prepared, model: &Model) -> Self {
        /// Half widths of the two curves \[s\]. The wide curve corresponds to figure 5.5 of the thesis.
        const WIDE_S: f64 = 0.2;
        const NEAR_S: f64 = 0.005;
        const STEPS: usize = 20;
        let (motion, observations) = (&prepared.motion, &prepared.observations);
        let solved = model.geometry(&model.start());
        let curve = |reach_s| shift_curve(&solved, motion, observations, reach_s, STEPS);
        let closures = |geometry: &Geometry| loop_closures(geometry, motion, observations);
        let ([shift_wide, shift_near], [before, after]) = both(
            || [WIDE_S, NEAR_S].map(curve),
            || [closures(&uncalibrated(model, motion, observations)), closures(&solved)],
        );
        Self { before, after, shift_wide, shift_near }
    }
}

/// Results of a calibration.
#[derive(Debug, Clone)]
pub struct Evidence {
    /// [`Calibration::measures_end`]
    pub by_encoders: bool,
    /// Whether the bar's rotation is measured, which needs all five encoders.
    pub rotations: bool,
    /// Results of each run, in order.
    pub runs: Vec<RunEvidence>,
    /// Gap with the nominal robot, statistics over all runs \[m\].
    pub gap_before_m: Sizes,
    /// Gap at the solution, statistics over all runs \[m\].
    pub gap_after_m: Sizes,
    /// Residuals of all runs at the solution, each expressed as the error of a single joint. One list for each joint.
    pub joints: Vec<Vec<JointGap>>,
    /// Deviation of the robot's end from the bar's sphere, per run.
    pub spheres: Vec<SphereDeviation>,
    /// Expected position error over the workspace.
    pub workspace: WorkspaceError,
    /// Data from which `workspace` was computed. Kept to compute the errors of the deployments later.
    uncertain: Workspace,
    /// Rows that were measured at each part of an instrument, such as a socket, compared with the prediction of a fit
    /// to all other data.
    pub unseen: Vec<UnseenPart>,
    /// Limitations of the result.
    pub limits: Vec<Limit>,
    /// Prediction of held-out segments; `None` if not requested.
    pub held_out: Option<HeldOut>,
    /// The best fit of each partial deployment, and the errors of its predictions for held-out segments. Empty if not
    /// requested. Deployments whose fit does not converge are omitted.
    pub deployed: Vec<(Deployed, HeldOut)>,
}

/// Computes the results of a calibration. `joint_limits` are the limits of the joints of the model.
pub fn evidence(calibration: &Calibration, joint_limits: &[[f64; 2]]) -> Evidence {
    let runs: Vec<RunEvidence> =
        calibration.bar_runs().map(|(prepared, model)| RunEvidence::new(prepared, model)).collect();
    let measured = calibration.measured();
    let by_encoders = calibration.measures_end();
    let of_all_runs = |closures: fn(&RunEvidence) -> &Vec<Closure>| runs.iter().flat_map(closures);
    let uncertain = Workspace::new(calibration, joint_limits);
    let workspace = uncertain.error(calibration, joint_limits);
    Evidence {
        by_encoders,
        rotations: measured == [true; 5],
        gap_before_m: gap_m(of_all_runs(|run| &run.before), by_encoders),
        gap_after_m: gap_m(of_all_runs(|run| &run.after), by_encoders),
        joints: joint_gaps(calibration.model().axes(), of_all_runs(|run| &run.after)),
        limits: limits(calibration, &workspace),
        unseen: unseen_parts(calibration),
        spheres: SphereDeviation::all(calibration, &runs),
        runs,
        workspace,
        uncertain,
        held_out: None,
        deployed: Vec::new(),
    }
}

impl Evidence {
    /// Adds two results: the predictions of held-out ball-bar segments by the calibration and by its deployments, and the
    /// expected error of each deployment over the workspace. Each deployment is solved again.
    ///
    /// # Errors
    /// [`CalibrateError`] if a solve fails or `watch` cancels it.
    pub fn with_validation(
        mut self,
        calibration: &Calibration,
        watch: Option<&dyn Watch>,
    ) -> Result<Self, CalibrateError> {
        if let Some(watch) = watch {
            watch.begins("held-out segments");
        }
        let segments = without_each_segment(calibration, watch)?;
        let nominals = nominals(calibration, &segments);
        let deploy = |deployment| {
            let fit = calibration.deployed(deployment, watch)?;
            let with_prediction = |fit: Calibration| {
                let held_out = held_out(&fit, &without_each_segment(&fit, watch)?, &nominals);
                Ok::<_, CalibrateError>((Deployed::new(deployment, fit), held_out))
            };
            fit.map(with_prediction).transpose()
        };
        let deployed = each(Deployment::PARTIAL.len(), |number| deploy(Deployment::PARTIAL[number]));
        self.deployed = deployed.into_iter().filter_map(Result::transpose).collect::<Result<_, _>>()?;
        self.held_out = Some(held_out(calibration, &segments, &nominals));
        self.workspace.deployed = self.uncertain.deployed(self.deployed.iter().map(|(deployed, _)| deployed));
        Ok(self)
    }
}
