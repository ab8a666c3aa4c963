//! Residuals by joint: the rotation of one robot joint that closes most of the gap between robot and bar, `-J . e / |J|^2` with
//! the position error `e` and its derivative `J` by the joint. For the figures by joint in the report.

use crate::cost::Closure;

/// The gap at one sample, expressed as an error of one joint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JointGap {
    /// Reported joint angle \[rad\].
    pub q_rad: f64,
    /// Reported joint speed \[rad/s\].
    pub qd_rad_s: f64,
    /// Additional rotation that brings the robot's end nearest to the bar's end \[rad\].
    pub turn_rad: f64,
}

/// The least-squares rotation of each robot joint alone, per joint and sample; `axes` is the number of joints.
///
/// Uses positions only. A sample is omitted for joints that hardly move the end (lever arm below a tenth of a metre).
/// A gear error appears as a wave over the joint angle, backlash as two branches by direction.
pub fn joint_gaps<'a>(
    axes: usize,
    closures: impl Iterator<Item = &'a Closure> + Clone,
) -> Vec<Vec<JointGap>> {
    /// Minimum lever arm \[m\].
    const LEVER_MIN_M: f64 = 0.1;
    let of_joint = |joint: usize| {
        let gap = |closure: &Closure| {
            let by_joint_m = closure.joint_twists[joint].linear;
            let lever_m = by_joint_m.norm();
            (lever_m > LEVER_MIN_M).then(|| JointGap {
                q_rad: closure.joints.q[joint],
                qd_rad_s: closure.joints.qd[joint],
                turn_rad: -by_joint_m.dot(&closure.position_error_m) / (lever_m * lever_m),
            })
        };
        closures.clone().filter_map(gap).collect()
    };
    (0..axes).map(of_joint).collect()
}
