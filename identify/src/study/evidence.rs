//! Everything that a report draws, from one calibration.

use super::limits::gap_m;
use super::{
    JointGap, Limit, Quantiles, ShiftCurve, WorkspaceError, joint_gaps, limits, shift_curve, uncalibrated,
    workspace_error,
};
use crate::calibrate::ball_bar::BallBarCalibration;
use crate::cost::{Closure, closures};
use crate::kinematics::ROBOT_JOINTS;

/// What one calibration shows.
#[derive(Debug, Clone)]
pub struct Evidence {
    /// Position gaps need encoders; without any only the distance from the sphere means something.
    pub by_encoders: bool,
    /// Each sample with the nominal robot, the bar fitted to it.
    pub before: Vec<Closure>,
    /// Each sample at the solution.
    pub after: Vec<Closure>,
    /// Gap with the nominal robot \[m\].
    pub gap_before_m: Quantiles,
    /// Gap at the solution \[m\].
    pub gap_after_m: Quantiles,
    /// The samples at the solution, from each joint.
    pub joints: [Vec<JointGap>; ROBOT_JOINTS],
    /// Gap against time shift, wide.
    pub shift_wide: ShiftCurve,
    /// The same about the minimum.
    pub shift_near: ShiftCurve,
    /// Expected error over the workspace.
    pub workspace: WorkspaceError,
    /// Names of the free parameters, and their correlations row by row.
    pub correlations: (Vec<String>, Vec<Vec<f64>>),
    /// What limits the result.
    pub limits: Vec<Limit>,
}

/// Looks at a calibration.
pub fn evidence(calibration: &BallBarCalibration, joint_limits_deg: &[[f64; 2]; ROBOT_JOINTS]) -> Evidence {
    /// Reach of the two curves \[s\]: that of the thesis' figure 5.5, and the neighbourhood of the minimum.
    const WIDE_S: f64 = 0.2;
    const NEAR_S: f64 = 0.005;
    const STEPS: usize = 40;
    let BallBarCalibration { prepared, model, solution, .. } = calibration;
    let (motion, observations) = (&prepared.motion, &prepared.observations);
    let solved = model.geometry(&model.start());
    let before = closures(&uncalibrated(model, motion, observations), motion, observations);
    let after = closures(&solved, motion, observations);
    let by_encoders = prepared.measured.contains(&true);
    let workspace = workspace_error(model, &solution.covariance, joint_limits_deg);
    let curve = |reach_s| shift_curve(&solved, motion, observations, reach_s, STEPS);
    Evidence {
        by_encoders,
        gap_before_m: gap_m(&before, by_encoders),
        gap_after_m: gap_m(&after, by_encoders),
        joints: joint_gaps(&after),
        shift_wide: curve(WIDE_S),
        shift_near: curve(NEAR_S),
        correlations: correlations(calibration),
        limits: limits(calibration, &after, &workspace),
        before,
        after,
        workspace,
    }
}

fn correlations(calibration: &BallBarCalibration) -> (Vec<String>, Vec<Vec<f64>>) {
    let covariance = &calibration.solution.covariance;
    let names: Vec<String> = calibration.model.columns().map(|parameter| parameter.id.to_string()).collect();
    let row = |a: usize| (0..names.len()).map(|b| covariance.correlation(a, b).unwrap_or(0.0)).collect();
    let rows = (0..names.len()).map(row).collect();
    (names, rows)
}
