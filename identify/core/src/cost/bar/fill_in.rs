//! Computes the angles of bar joints that have no encoder.

use super::position_angles::measured;
use crate::kinematics::{BAR_JOINTS, ImpliedBar, Tracer};
use crate::model::{Geometry, MovingJoints, Observation, RobotMotion};

/// Sets the angle of each joint without encoder to the value that the robot's pose implies for this geometry.
///
/// Costs that need fewer encoders depend on these joints only through lever arms of a fraction of a millimetre, so the
/// geometry need not be exact. To remove the remaining error, fill in the angles again after a solve and solve once more.
/// Samples outside the robot's log are not changed.
pub fn fill_in(geometry: &Geometry, motion: &impl RobotMotion, observations: &mut [Observation]) {
    let bar = geometry.bar_chain();
    let (tracer, mut joints) = (Tracer::new(&bar), MovingJoints::default());
    for observation in observations.iter_mut().filter(|observation| observation.measured.contains(&false)) {
        if !geometry.joints_at(motion, observation.t_s, &mut joints) {
            continue;
        }
        let target = geometry.robot.forward(&joints.corrected.q);
        let Ok(implied) = ImpliedBar::new(&bar, &tracer, &target, &measured(observation)) else { continue };
        for joint in (0..BAR_JOINTS).filter(|&joint| !observation.measured[joint]) {
            observation.bar_rad[joint] = implied.joints_rad[joint];
        }
    }
}
