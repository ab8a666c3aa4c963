//! One sample with everything that residuals are made of.

use nalgebra::Vector3;

use crate::kinematics::{BAR_JOINTS, Chain, LinkParameter, ROD_LINK, Trace, Tracer, Turn, Twist};
use crate::model::{Axis, Geometry, MovingJoints, Observation, ParameterId};

/// What a parameter moves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Movement {
    /// The robot's end.
    Robot(Twist),
    /// The bar's end, as far as the bar's joints and links determine.
    Bar(Twist),
    /// Neither: the parameter stands in the residual itself.
    None,
}

/// Both chains at one sample.
#[derive(Debug)]
pub struct Scene<'a> {
    /// Parameters.
    pub geometry: &'a Geometry,
    /// Number of the sample.
    pub sample: usize,
    /// What was measured.
    pub observation: &'a Observation,
    /// Sines and cosines of the bar's readings.
    pub readings: &'a [Turn; BAR_JOINTS],
    /// Bar joints without the encoders' harmonics, in the first origin's zeros \[rad\]; offsets not yet added.
    pub bar_rad: [f64; BAR_JOINTS],
    /// The bar on its base, as long as force and direction make it, and the same made ready for forward passes.
    pub bar_chain: (&'a Chain, &'a Tracer),
    /// Of the robot.
    pub joints: &'a MovingJoints,
    /// The robot at this instant, its joints without their errors.
    pub robot: &'a Trace,
    /// The bar as its encoders claim; without meaning where the cost needs no encoders.
    pub bar: &'a Trace,
    /// Motion of the robot's end per second of its clock.
    pub robot_rate: Twist,
    /// Where the base's second rotation has its axis.
    pub(super) base_y: Vector3<f64>,
}

impl Scene<'_> {
    /// What moves, and how, when a parameter moves at unit speed.
    #[inline(always)]
    pub fn movement(&self, id: ParameterId) -> Movement {
        match id {
            ParameterId::Robot { .. } | ParameterId::Joint { .. } | ParameterId::JointWave { .. } => {
                self.geometry.end_twist(self.joints, self.robot, id).map_or(Movement::None, Movement::Robot)
            }
            ParameterId::Bar { .. }
            | ParameterId::Base { .. }
            | ParameterId::BaseRotation { .. }
            | ParameterId::BarCompliance
            | ParameterId::BarPlay
            | ParameterId::BarWave { .. } => {
                self.bar_twist(self.bar, id).map_or(Movement::None, Movement::Bar)
            }
            ParameterId::EncoderWave { joint, order, phase } => {
                match (self.bar.twist(joint, LinkParameter::Theta), self.readings.get(joint)) {
                    (Some(twist), Some(&reading)) => Movement::Bar(twist.scaled(-phase.wave(order, reading))),
                    _ => Movement::None,
                }
            }
            ParameterId::EncoderOffset { origin, joint } => {
                let twist = self.bar.twist(joint, LinkParameter::Theta);
                twist.filter(|_| origin == self.observation.origin).map_or(Movement::None, Movement::Bar)
            }
            ParameterId::ClockShift => Movement::Robot(self.robot_rate),
            ParameterId::ClockSkew => {
                let t_s = self.observation.t_s;
                Movement::Robot(self.robot_rate.scaled(t_s))
            }
            // Those of other instruments.
            _ => Movement::None,
        }
    }

    /// How the end of the bar moves with a number of its links or of its base, where its joints stand as in `bar`.
    #[inline(always)]
    pub fn bar_twist(&self, bar: &Trace, id: ParameterId) -> Option<Twist> {
        match id {
            ParameterId::Bar { link, parameter } => bar.twist(link, parameter),
            ParameterId::Base { axis } => Some(Twist::translation(unit(axis))),
            ParameterId::BaseRotation { axis } => Some(self.base_rotation(axis, bar.position_m())),
            ParameterId::BarCompliance | ParameterId::BarPlay | ParameterId::BarWave { .. } => {
                bar.twist(ROD_LINK, LinkParameter::D).map(|twist| twist.scaled(self.elongation(id)))
            }
            _ => None,
        }
    }

    /// How much longer the bar becomes with a parameter: its rod itself, what a force does to it, or its bearings.
    #[inline]
    pub fn elongation(&self, id: ParameterId) -> f64 {
        match id {
            ParameterId::BarCompliance => self.observation.force.along_n,
            ParameterId::BarPlay => self.observation.force.side,
            ParameterId::BarWave { joint, order, phase } => {
                self.readings.get(joint).map_or(0.0, |reading| phase.wave(order, *reading))
            }
            id => f64::from(u8::from(id == ParameterId::ROD)),
        }
    }

    /// Length of the bar under this sample's force and in its direction \[m\].
    #[inline]
    pub fn rod_m(&self) -> f64 {
        self.bar_chain.0.links.get(ROD_LINK).map_or(0.0, |rod| rod.d_m)
    }

    /// `T(o) Rx(rx) Ry(ry)`: the second axis is carried along by the first.
    fn base_rotation(&self, axis: Axis, end_m: Vector3<f64>) -> Twist {
        let axis = match axis {
            Axis::X => Vector3::x(),
            Axis::Y => self.base_y,
            Axis::Z => Vector3::zeros(),
        };
        Twist::rotation(axis, self.geometry.base.origin_m, end_m)
    }
}

/// Unit vector along an axis.
pub(super) fn unit(axis: Axis) -> Vector3<f64> {
    Vector3::ith(axis.index(), 1.0)
}

/// Waves and zeros of an encoder, and what follows its reading, are seen by costs that need the encoder; anything else
/// is not in question.
pub(super) fn encoders_suffice(id: ParameterId, encoders: &[usize]) -> bool {
    match id {
        ParameterId::EncoderWave { joint, .. }
        | ParameterId::EncoderOffset { joint, .. }
        | ParameterId::BarWave { joint, .. } => encoders.contains(&joint),
        _ => true,
    }
}

/// One cost function: a residual vector per sample and its derivative by each parameter.
pub trait Residual: Sync {
    /// What a sample computes once for its residual and all derivatives.
    type Local;
    /// Name in reports and on the command line.
    const NAME: &'static str;
    /// Entries of the residual.
    const ROWS: usize;
    /// Encoders that must be there, joints from 0.
    const ENCODERS: &'static [usize];
    /// A measured length must be there.
    const NEEDS_LENGTH: bool = false;

    /// The parameter changes the residual; others need not be free.
    fn depends_on(id: ParameterId) -> bool;

    /// Named selections free the parameter with this cost: it depends on it and separates it from the others of the selection.
    fn identifies(id: ParameterId) -> bool {
        Self::depends_on(id)
    }

    /// What this sample computes once; none where the residual has no value here.
    fn local(&self, scene: &Scene<'_>) -> Option<Self::Local>;

    /// The residual, `ROWS` entries.
    fn residual(&self, scene: &Scene<'_>, local: &Self::Local, out: &mut [f64]);

    /// Its derivative by one parameter, `ROWS` entries that come as zeros.
    fn derivative(&self, scene: &Scene<'_>, local: &Self::Local, id: ParameterId, out: &mut [f64]);
}

impl<R: Residual> Residual for &R {
    type Local = R::Local;

    const NAME: &'static str = R::NAME;
    const ROWS: usize = R::ROWS;
    const ENCODERS: &'static [usize] = R::ENCODERS;
    const NEEDS_LENGTH: bool = R::NEEDS_LENGTH;

    fn depends_on(id: ParameterId) -> bool {
        R::depends_on(id)
    }

    fn identifies(id: ParameterId) -> bool {
        R::identifies(id)
    }

    fn local(&self, scene: &Scene<'_>) -> Option<R::Local> {
        R::local(self, scene)
    }

    #[inline]
    fn residual(&self, scene: &Scene<'_>, local: &R::Local, out: &mut [f64]) {
        R::residual(self, scene, local, out);
    }

    #[inline]
    fn derivative(&self, scene: &Scene<'_>, local: &R::Local, id: ParameterId, out: &mut [f64]) {
        R::derivative(self, scene, local, id, out);
    }
}

/// The joint about the rod, from 0. Where its encoder is missing only the turn about the rod is unknown.
pub(crate) const TORSION: usize = ROD_LINK;
/// Encoders of the bar without it.
pub(super) const ALL_BUT_TORSION: &[usize] = &[0, 1, 3, 4];

/// All five encoders.
pub(super) const ALL_ENCODERS: &[usize] = &{
    let mut all = [0; BAR_JOINTS];
    let mut i = 0;
    while i < BAR_JOINTS {
        all[i] = i;
        i += 1;
    }
    all
};
