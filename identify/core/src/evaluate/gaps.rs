//! Residuals by joint: which turn of one robot joint would close most of the gap between robot and bar.

use crate::cost::Closure;

/// One sample seen from one joint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JointGap {
    /// The joint as the robot reports it \[rad\].
    pub q_rad: f64,
    /// Its speed \[rad/s\].
    pub qd_rad_s: f64,
    /// By how much it would have to turn on to bring the robot's end nearest to the bar's \[rad\].
    pub turn_rad: f64,
}

/// Per robot joint (of so many) and sample: the least-squares turn of this joint alone.
///
/// Position only; joints that hardly move the end at a sample (lever arm below a tenth of a metre) have no say there.
/// An error of the joint's gear shows as a wave over its angle, backlash as two branches by direction.
pub fn joint_gaps<'a>(
    axes: usize,
    closures: impl Iterator<Item = &'a Closure> + Clone,
) -> Vec<Vec<JointGap>> {
    /// \[m\]
    const LEVER_MIN_M: f64 = 0.1;
    let of_joint = |joint: usize| {
        let seen = |closure: &Closure| {
            let arm = closure.joint_twists[joint].linear;
            let lever_m = arm.norm();
            (lever_m > LEVER_MIN_M).then(|| JointGap {
                q_rad: closure.joints.q[joint],
                qd_rad_s: closure.joints.qd[joint],
                turn_rad: -arm.dot(&closure.position_error_m) / (lever_m * lever_m),
            })
        };
        closures.clone().filter_map(seen).collect()
    };
    (0..axes).map(of_joint).collect()
}
