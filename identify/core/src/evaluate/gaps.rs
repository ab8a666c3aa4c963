//! Residuals by joint. The gap between robot and bar is expressed as the motion of a single robot joint: the motion that
//! reduces the gap most. With the position error `e` and its derivative `J` with respect to the joint, this motion is
//! `-J . e / |J|^2`. The report shows these motions in the figures by joint.

use crate::cost::Closure;

/// The gap at one sample, expressed as an error of one joint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JointGap {
    /// Reported joint variable \[rad, m\].
    pub q: f64,
    /// Reported rate \[rad/s, m/s\].
    pub qd: f64,
    /// Additional motion of the joint that brings the robot's end nearest to the bar's end \[rad, m\].
    pub motion: f64,
}

/// For each joint, the least-squares motion of this joint alone, one entry per sample. `axes` is the number of joints.
///
/// Uses positions only. If the lever arm between joint and end is below a tenth of a metre, the sample is omitted
/// for this joint. In the results, a gear error appears as a wave over the joint angle, and backlash as a
/// difference between the two directions of motion.
pub fn joint_gaps<'a>(
    axes: usize,
    closures: impl Iterator<Item = &'a Closure> + Clone,
) -> Vec<Vec<JointGap>> {
    /// Minimum lever arm between joint and end \[m/rad\]. A prismatic joint always has the lever arm 1 m/m.
    const LEVER_MIN: f64 = 0.1;
    let of_joint = |joint: usize| {
        let gap = |closure: &Closure| {
            let by_joint = closure.joint_twists[joint].linear;
            let lever = by_joint.norm();
            (lever > LEVER_MIN).then(|| JointGap {
                q: closure.joints.q[joint],
                qd: closure.joints.qd[joint],
                motion: -by_joint.dot(&closure.position_error_m) / (lever * lever),
            })
        };
        closures.clone().filter_map(gap).collect()
    };
    (0..axes).map(of_joint).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::kinematics::Twist;
    use crate::model::{BarForce, JointState};

    #[test]
    fn a_gap_along_a_prismatic_axis_is_a_motion_of_its_own_size() {
        let closure = Closure {
            t_s: 0.0,
            joints: JointState::at_rest([0.7]),
            position_error_m: Vector3::new(0.0, 4e-4, 1e-3),
            turned_rad: Vector3::zeros(),
            off_sphere_m: 0.0,
            by_force_m: 0.0,
            force: BarForce::default(),
            direction: Vector3::z(),
            margin_rad: 1.0,
            joint_twists: vec![Twist::translation(Vector3::z())],
        };
        let gaps = joint_gaps(1, std::iter::once(&closure));
        assert_eq!(gaps, [[JointGap { q: 0.7, qd: 0.0, motion: -1e-3 }]]);
    }
}
