//! Cost that compares the position of the robot's end and two angles of the cardan. It needs encoders 1, 2, 4 and 5.

use nalgebra::Vector5;

use super::position::{derivative, difference};
use crate::cost::residual::{ALL_BUT_ROD_JOINT, ROD_JOINT, encoders_suffice};
use crate::cost::{Movement, Residual, Scene};
use crate::kinematics::{BAR_JOINTS, Chain, ImpliedBar, LinkParameter, Turn};
use crate::model::{Observation, ParameterId};

/// The residual is `R_p - B_p` \[m\], `sin(b4^ - b4)` and `sin(b5^ - b5)` (thesis eq. 2.3). `b4^` and `b5^` are
/// the joint angles that the robot's pose implies, see [`ImpliedBar`]; `b4` and `b5` are the measured angles. As
/// in the thesis, metres and sines have equal weights.
#[derive(Debug, Clone, Copy, Default)]
pub struct PositionAngles;

/// Indices (from 0) of the joints whose angles are compared.
const COMPARED: [usize; 2] = [3, 4];

/// Bar joints that the robot's pose implies, and the compared joints' differences from the measured angles.
#[derive(Debug, Clone)]
pub struct ComparedAngles {
    implied: ImpliedBar,
    differences: [Turn; COMPARED.len()],
}

/// Angle of each bar joint \[rad\]; `None` for joints without encoder.
pub(in crate::cost) fn measured(observation: &Observation) -> [Option<f64>; BAR_JOINTS] {
    std::array::from_fn(|joint| observation.measured[joint].then_some(observation.bar_rad[joint]))
}

impl Residual for PositionAngles {
    type Local = ComparedAngles;

    const NAME: &'static str = "position_angles";
    const ROWS: usize = 5;
    const ENCODERS: &'static [usize] = ALL_BUT_ROD_JOINT;

    fn depends_on(id: ParameterId, _: &Chain) -> bool {
        // The residual does not contain joint 3. The offset of this joint changes only the implied angle 3.
        id != ParameterId::Bar { link: ROD_JOINT, parameter: LinkParameter::Theta }
            && id.affects(Self::OWNER)
            && encoders_suffice(id, Self::ENCODERS)
    }

    fn local(&self, scene: &Scene<'_>) -> Option<ComparedAngles> {
        let (chain, tracer) = (scene.bar_chain, scene.bar_tracer);
        let implied = ImpliedBar::new(chain, tracer, scene.robot.end(), &measured(scene.observation)).ok()?;
        let differences =
            COMPARED.map(|joint| Turn::from_angle(implied.joints_rad[joint] - scene.bar_rad[joint]));
        Some(ComparedAngles { implied, differences })
    }

    fn residual(&self, scene: &Scene<'_>, compared: &ComparedAngles, out: &mut [f64]) {
        let (position, angles) = out.split_at_mut(3);
        position.copy_from_slice(difference(scene).as_slice());
        for (out, difference) in angles.iter_mut().zip(compared.differences) {
            *out = difference.sin;
        }
    }

    fn derivative(&self, scene: &Scene<'_>, compared: &ComparedAngles, id: ParameterId, out: &mut [f64]) {
        let ComparedAngles { implied, differences } = compared;
        let (position, angles) = out.split_at_mut(3);
        position.copy_from_slice(derivative(scene, id).as_slice());
        // Derivative of the implied joints minus the measured joints. Most parameters change only the implied joints.
        let joints_derivative = match (scene.movement(id), id) {
            (Movement::Robot(twist), _) => implied.by_pose(&twist),
            // Encoder harmonics are subtracted from the measured joint; offsets are added to it.
            (_, ParameterId::EncoderWave { joint, order, phase }) => {
                let wave = phase.wave(order, scene.readings[joint]);
                Vector5::from_fn(|i, _| if i == joint { wave } else { 0.0 })
            }
            (Movement::Bar(_), ParameterId::EncoderOffset { joint, .. }) => {
                Vector5::from_fn(|i, _| if i == joint { -1.0 } else { 0.0 })
            }
            (Movement::Bar(_), _) => {
                let Some(twist) = scene.bar_twist(&implied.trace, id) else { return };
                implied.by_bar(id.bar_link(), &twist)
            }
            (Movement::None, _) => return,
        };
        for ((out, joint), difference) in angles.iter_mut().zip(COMPARED).zip(differences) {
            *out = joints_derivative[joint] * difference.cos;
        }
    }
}
