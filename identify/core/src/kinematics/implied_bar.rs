//! Joints of a bar with arbitrary errors at a given pose (`b^` in the thesis), and their derivatives; for the cost
//! `position_angles`, joints without encoder, and the alignment of the logs.
//!
//! A pose has six degrees of freedom, the bar five. The rotation and both positions across the rod are met; the distance along
//! the rod remains. These are five smooth equations `f(joints, bar, pose) = 0`, exact for every set of parameters: the rotation
//! vector from the bar's end to the pose, and the components across the rod of their distance. They are solved by Newton's
//! method; the implicit function theorem gives `d joints = -(df/d joints)^-1 df`.

use nalgebra::{Matrix5, Vector3, Vector5};

use super::ball_bar_inverse::ball_bar_inverse;
use super::inverse::{pose_error, wrapped};
use super::{BAR_JOINTS, Chain, InverseError, LinkParameter, Pose, Trace, Tracer, Twist};

/// Link of the bar, from 0, with the bar's length as `d`: the rod is along z of the previous frame.
pub const ROD_LINK: usize = 2;
/// After a step this short the next one is a rounding error: convergence is quadratic.
const STEP_RAD_LAST: f64 = 1e-9;
const ITERATIONS_MAX: usize = 20;
/// Sums of squared differences \[rad^2\] closer than this are equal: of configurations that fit the measured joints equally well
/// the first one is selected, independent of rounding errors.
const TIE: f64 = 1e-6;

/// Joints of the bar at a pose, and their derivatives.
#[derive(Debug, Clone)]
pub struct ImpliedBar {
    /// Joint variables \[rad\], each within half a turn of zero before refinement.
    pub joints_rad: [f64; BAR_JOINTS],
    /// The bar at these joints.
    pub trace: Trace,
    /// Derivative of the joints by the five equations.
    by_equations: Matrix5<f64>,
    rod: Rod,
}

/// Direction of the rod, two directions across it, and distance of the pose beyond the bar's end \[m\].
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

    /// Change of the five equations if the bar's end moves by `twist`, and, if `rotates_rod`, the rod rotates with it: the
    /// directions across the rod then change as well.
    fn equations(&self, twist: &Twist, rotates_rod: bool) -> Vector5<f64> {
        let turned =
            if rotates_rod { twist.angular.cross(&self.along) * self.beyond_m } else { Vector3::zeros() };
        let linear = twist.linear + turned;
        let w = twist.angular;
        Vector5::new(w.x, w.y, w.z, self.across[0].dot(&linear), self.across[1].dot(&linear))
    }
}

impl ImpliedBar {
    /// Solves for `target` in the configuration nearest to `near` \[rad\]; joints without a value in `near` are not compared.
    ///
    /// `tracer` is `chain` prepared for forward passes.
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
            // The trace is that before this step, which is negligible at a nanometre.
            if step_rad < STEP_RAD_LAST {
                return Ok(Self { joints_rad, trace, by_equations, rod });
            }
        }
        Err(InverseError::NotConverged { iterations, step_rad })
    }

    /// Derivative of the joints by a motion of the pose.
    pub fn by_pose(&self, twist: &Twist) -> Vector5<f64> {
        self.by_equations * self.rod.equations(twist, false)
    }

    /// Derivative of the joints by a parameter of link `link` that moves the bar's end by `twist` at fixed joints; `None` is
    /// the base.
    pub fn by_bar(&self, link: Option<usize>, twist: &Twist) -> Vector5<f64> {
        -(self.by_equations * self.rod.equations(twist, rotates_rod(link)))
    }
}

/// Parameters before the rod rotate it.
fn rotates_rod(link: Option<usize>) -> bool {
    link.is_none_or(|link| link < ROD_LINK)
}

/// Derivatives of the five equations by the joints, one column each.
fn equations_by_joints(trace: &Trace, rod: &Rod) -> Matrix5<f64> {
    let mut matrix = Matrix5::zeros();
    for (joint, twist) in trace.joint_twists().enumerate().take(BAR_JOINTS) {
        matrix.set_column(joint, &rod.equations(&twist, rotates_rod(Some(joint))));
    }
    matrix
}

/// Closed form of the nominal structure, in the configuration nearest to the measured joints.
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
