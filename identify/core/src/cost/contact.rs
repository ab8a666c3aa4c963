//! Cost for a ball on the flange that is seated in sockets. Each sample consists of the robot's joints and the
//! index of the socket.

use nalgebra::Vector3;

use super::{Movement, Residual, Scene};
use crate::logs::TipRow;
use crate::model::{Owner, ParameterId};

/// The residual is `R ball - socket` \[m\]: the position of the ball according to the robot's pose `R`, minus the position
/// of the socket, both in the robot's base. The problem divides the residual by the standard deviation of a coordinate.
#[derive(Debug, Clone, Copy)]
pub struct SeatedBall<'a> {
    /// Each sample with the index of its socket.
    pub rows: &'a [TipRow],
}

impl Residual for SeatedBall<'_> {
    /// Index of the socket, and the vector from the flange to the ball in the robot's base \[m\].
    type Local = (usize, Vector3<f64>);

    const NAME: &'static str = "contact";
    const ROWS: usize = 3;
    const OWNER: Owner = Owner::Contact;

    fn local(&self, scene: &Scene<'_>) -> Option<Self::Local> {
        let socket = self.rows.get(scene.sample)?.part;
        Some((socket, scene.robot.rotation() * scene.geometry.contact.ball_m))
    }

    fn residual(&self, scene: &Scene<'_>, (seated_in, flange_to_ball_m): &Self::Local, out: &mut [f64]) {
        let socket_m = scene.geometry.contact.sockets_m.get(*seated_in);
        let socket_m = socket_m.copied().unwrap_or_else(|| Vector3::repeat(f64::NAN));
        out.copy_from_slice((scene.robot.position_m() + flange_to_ball_m - socket_m).as_slice());
    }

    fn derivative(&self, scene: &Scene<'_>, local: &Self::Local, id: ParameterId, out: &mut [f64]) {
        let (seated_in, flange_to_ball_m) = local;
        let derivative = match (id, scene.movement(id)) {
            (_, Movement::Robot(twist)) => twist.carried(flange_to_ball_m).linear,
            (ParameterId::Ball { axis }, _) => scene.robot.rotation() * axis.unit(),
            (ParameterId::Socket { socket, axis }, _) if socket == *seated_in => -axis.unit(),
            _ => return,
        };
        out.copy_from_slice(derivative.as_slice());
    }
}
