//! Cost that uses the bar as a distance. It needs no encoders.

use nalgebra::Vector3;

use crate::cost::{Movement, Residual, Scene};
use crate::kinematics::Chain;
use crate::model::{Group, Owner, ParameterId};

/// The residual is `|R_p - o|^2 - L^2` \[m^2\] (thesis eq. 2.1), because the robot's end lies on the sphere of the bar. `L`
/// is `bd3` plus the elongation by force and direction.
#[derive(Debug, Clone, Copy, Default)]
pub struct Length;

impl Residual for Length {
    /// Vector from the bar's base to the robot's end \[m\].
    type Local = Vector3<f64>;

    const NAME: &'static str = "length";
    const ROWS: usize = 1;
    const ENCODERS: &'static [usize] = &[];

    fn depends_on(id: ParameterId, robot: &Chain) -> bool {
        match id {
            ParameterId::Robot { link, parameter } => !robot.only_turns_end(link, parameter),
            ParameterId::Base { .. } | ParameterId::BarWave { .. } | ParameterId::ROD => true,
            id => matches!(id.owner(), Owner::Robot | Owner::Clocks) || id.group() == Group::Force,
        }
    }

    fn identifies(id: ParameterId, robot: &Chain) -> bool {
        // The robot moves along the sphere, so the time of a sample affects the residual only through noise. Waves need the
        // direction of the bar, which is unknown without encoders.
        let is_clock = id.group() == Group::Clock;
        let needs_direction = matches!(id, ParameterId::BarWave { .. });
        let needs_rotation =
            matches!(id, ParameterId::Robot { link, parameter } if robot.is_last_rotation(link, parameter));
        !is_clock && !needs_direction && !needs_rotation && Self::depends_on(id, robot)
    }

    fn local(&self, scene: &Scene<'_>) -> Option<Vector3<f64>> {
        Some(scene.robot.position_m() - scene.geometry.base.origin_m)
    }

    fn residual(&self, scene: &Scene<'_>, base_to_end_m: &Vector3<f64>, out: &mut [f64]) {
        out[0] = base_to_end_m.norm_squared() - scene.rod_m().powi(2);
    }

    fn derivative(&self, scene: &Scene<'_>, base_to_end_m: &Vector3<f64>, id: ParameterId, out: &mut [f64]) {
        out[0] = match (id, scene.movement(id)) {
            (_, Movement::Robot(twist)) => 2.0 * base_to_end_m.dot(&twist.linear),
            (ParameterId::Base { axis }, _) => -2.0 * base_to_end_m[axis.index()],
            (id, _) => -2.0 * scene.rod_m() * scene.elongation(id),
        };
    }
}
