//! Computes the joint variables of a bar with arbitrary errors at a given pose (`b^` in the thesis), and their derivatives.
//! Users are the cost `position_angles`, joints without an encoder, and the alignment of the logs.
//!
//! A pose has six degrees of freedom, but the bar has only five. The end of the bar therefore agrees with the pose except
//! for the distance along the rod. These conditions are five smooth equations `f(joints, bar, pose) = 0`, which can be
//! fulfilled exactly for every set of parameters:
//! - Three equations state that the rotation vector from the bar's end to the pose is zero.
//! - Two equations state that the vector from the bar's end to the pose has no component perpendicular to the rod.
//!
//! Newton's method solves the equations, starting at the closed form of the nominal bar. The implicit function theorem gives
//! the derivatives: `d joints = -(df/d joints)^-1 df`.

use nalgebra::{Matrix5, Vector3, Vector5};

use super::ball_bar_inverse::ball_bar_inverse;
use super::inverse::{pose_error, wrapped};
use super::{BAR_JOINTS, Chain, InverseError, LinkParameter, Pose, Trace, Tracer, Twist};

/// Index of the link (from 0) whose `d` is the length of the bar. The rod is along z of the previous frame.
pub const ROD_LINK: usize = 2;
/// The iteration ends after a step below this size. Convergence is quadratic, so a further step would
/// only contain rounding errors.
const STEP_RAD_LAST: f64 = 1e-9;
const ITERATIONS_MAX: usize = 20;
/// Sums of squared differences \[rad^2\] count as equal if they differ by less than this. If several configurations fit the
/// measured joints equally well, the first of them is selected, so that rounding errors do not determine the choice.
const TIE: f64 = 1e-6;

/// Joint variables of the bar at a pose, and their derivatives.
#[derive(Debug, Clone)]
pub struct ImpliedBar {
    /// Joint variables \[rad\], each within half a turn of zero before refinement.
    pub joints_rad: [f64; BAR_JOINTS],
    /// Forward pass of the bar at these joint variables.
    pub trace: Trace,
    /// Derivative of the joint variables with respect to the five equations.
    by_equations: Matrix5<f64>,
    rod: Rod,
}

/// Direction of the rod, two directions perpendicular to it, and the distance from the bar's end to the pose along the rod
/// \[m\]. The distance is positive if the pose is beyond the bar's end.
#[derive(Debug, Clone, Copy)]
struct Rod {
    along: Vector3<f64>,
    across: [Vector3<f64>; 2],
    beyond_m: f64,
}

impl Rod {
    fn new(trace: &Trace, target: &Pose) -> Self {
        let along = trace.twist(ROD_LINK, LinkParameter::D).map_or_else(Vector3::z, |twist| twist.linear);
        let first = along.cross(&Vector3::ith(along.iamin(), 1.0)).normalize();
        let beyond_m = along.dot(&(target.translation.vector - trace.position_m()));
        Self { along, across: [first, along.cross(&first)], beyond_m }
    }

    /// Change of the five equations if the bar's end moves by `twist`. If `rotates_rod` is set, the rod rotates with the
    /// end, so the directions perpendicular to the rod change as well.
    fn equations(&self, twist: &Twist, rotates_rod: bool) -> Vector5<f64> {
        let turned =
            if rotates_rod { twist.angular.cross(&self.along) * self.beyond_m } else { Vector3::zeros() };
        let linear = twist.linear + turned;
        let w = twist.angular;
        Vector5::new(w.x, w.y, w.z, self.across[0].dot(&linear), self.across[1].dot(&linear))
    }
}

impl ImpliedBar {
    /// Solves for `target`. Of the four configurations, the one nearest to `near` \[rad\] is used; joints without a value in
    /// `near` are ignored in this comparison. `tracer` is `chain` prepared for forward passes.
    ///
    /// # Errors
    /// [`InverseError::NotConverged`] at a singular pose; other errors if the chain is not a ball-bar.
    pub fn new(
        chain: &Chain,
        tracer: &Tracer,
        target: &Pose,
        near: &[Option<f64>; BAR_JOINTS],
    ) -> Result<Self, InverseError> {
        let mut joints_rad = nearest_closed_form(chain, target, near)?;
        let mut trace = Trace::default();
        let (mut iterations, mut step_rad) = (0, f64::INFINITY);
        while iterations < ITERATIONS_MAX {
            tracer.trace(&joints_rad, &mut trace);
            let rod = Rod::new(&trace, target);
            let Some(by_equations) = equations_by_joints(&trace, &rod).try_inverse() else { break };
            iterations += 1;
            let error = pose_error(target, trace.end());
            let linear = Vector3::new(error[0], error[1], error[2]);
            let angular = Vector3::new(error[3], error[4], error[5]);
            let step = by_equations * rod.equations(&Twist { angular, linear }, false);
            step_rad = step.amax();
            if !step_rad.is_finite() {
                break;
            }
            for (joint, step) in joints_rad.iter_mut().zip(step.iter()) {
                *joint += step;
            }
            // The trace was computed before this step. The difference is negligible, because the step is below a nanoradian.
            if step_rad < STEP_RAD_LAST {
                return Ok(Self { joints_rad, trace, by_equations, rod });
            }
        }
        Err(InverseError::NotConverged { iterations, step_rad })
    }

    /// Derivative of the joint variables with respect to a motion `twist` of the pose.
    pub fn by_pose(&self, twist: &Twist) -> Vector5<f64> {
        self.by_equations * self.rod.equations(twist, false)
    }

    /// Derivative of the joint variables with respect to a parameter of the bar. The parameter belongs to the link `link`,
    /// or to the base if `link` is `None`. If the joints were fixed, the parameter would move the bar's end by `twist`.
    pub fn by_bar(&self, link: Option<usize>, twist: &Twist) -> Vector5<f64> {
        -(self.by_equations * self.rod.equations(twist, rotates_rod(link)))
    }
}

/// Whether a parameter of this link rotates the rod: true for the base and the links before the rod.
fn rotates_rod(link: Option<usize>) -> bool {
    link.is_none_or(|link| link < ROD_LINK)
}

/// Derivatives of the five equations with respect to the joint variables, one column for each joint.
fn equations_by_joints(trace: &Trace, rod: &Rod) -> Matrix5<f64> {
    let mut matrix = Matrix5::zeros();
    for (joint, twist) in trace.joint_twists().enumerate().take(BAR_JOINTS) {
        matrix.set_column(joint, &rod.equations(&twist, rotates_rod(Some(joint))));
    }
    matrix
}

/// Solution of the closed form. Of the four configurations, returns the one nearest to the measured joints.
fn nearest_closed_form(
    chain: &Chain,
    target: &Pose,
    near: &[Option<f64>; BAR_JOINTS],
) -> Result<[f64; BAR_JOINTS], InverseError> {
    let (mut best, mut least) = ([0.0; BAR_JOINTS], f64::INFINITY);
    for (_, joints) in ball_bar_inverse(chain, target)? {
        let differences = joints.iter().zip(near).filter_map(|(joint, near)| near.map(|near| joint - near));
        let squares: f64 = differences.map(|difference| wrapped(difference).powi(2)).sum();
        if squares < least - TIE {
            (best, least) = (joints, squares);
        }
    }
    Ok(best)
}
