//! Cost that uses the bar to measure the position of the robot's end. It needs encoders 1 and 2.

use nalgebra::Vector3;

use crate::cost::residual::encoders_suffice;
use crate::cost::{Movement, Residual, Scene};
use crate::kinematics::{Chain, LinkParameter};
use crate::model::ParameterId;

/// The residual is `R_p - B_p` \[m\] (thesis eq. 2.2).
///
/// `B_p` depends on joints 3 to 5 only through lever arms that are nominally zero (`ba3 ba4 ba5 bd4 bd5`). If these joints
/// have no encoder, their angles must be filled in, see [`super::fill_in`].
#[derive(Debug, Clone, Copy, Default)]
pub struct Position;

/// Position of the robot's end minus that of the bar's end \[m\].
pub(in crate::cost) fn difference(scene: &Scene<'_>) -> Vector3<f64> {
    scene.robot.position_m() - scene.bar.position_m()
}

/// Derivative of [`difference`] with respect to a parameter.
#[inline]
pub(in crate::cost) fn derivative(scene: &Scene<'_>, id: ParameterId) -> Vector3<f64> {
    match scene.movement(id) {
        Movement::Robot(twist) => twist.linear,
        Movement::Bar(twist) => -twist.linear,
        Movement::None => Vector3::zeros(),
    }
}

impl Residual for Position {
    type Local = ();

    const NAME: &'static str = "position";
    const ROWS: usize = 3;
    const ENCODERS: &'static [usize] = &[0, 1];

    fn depends_on(id: ParameterId, robot: &Chain) -> bool {
        match id {
            ParameterId::Robot { link, parameter } => !robot.only_turns_end(link, parameter),
            // If the lever arms are zero, the angles of cardan and rod rotate the bar's end about its own origin.
            ParameterId::Bar { link: 2..=4, parameter } => {
                matches!(parameter, LinkParameter::A | LinkParameter::D)
            }
            id => id.affects(Self::OWNER) && encoders_suffice(id, Self::ENCODERS),
        }
    }

    fn identifies(id: ParameterId, robot: &Chain) -> bool {
        let is_separable = match id {
            ParameterId::Robot { link, parameter } => !robot.is_last_rotation(link, parameter),
            // `ba2` moves the rod's end sideways, as `btheta2` does. Only the cardan's angles, which this cost
            // does not use, distinguish these two parameters.
            ParameterId::Bar { link: 1, parameter: LinkParameter::A } => false,
            _ => true,
        };
        is_separable && Self::depends_on(id, robot)
    }

    fn local(&self, _: &Scene<'_>) -> Option<()> {
        Some(())
    }

    fn residual(&self, scene: &Scene<'_>, (): &(), out: &mut [f64]) {
        out.copy_from_slice(difference(scene).as_slice());
    }

    fn derivative(&self, scene: &Scene<'_>, (): &(), id: ParameterId, out: &mut [f64]) {
        out.copy_from_slice(derivative(scene, id).as_slice());
    }
}
