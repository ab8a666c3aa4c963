//! Interface of a cost function: the residual of a sample, its derivatives, and the encoders that it requires.

use super::scene::Scene;
use crate::kinematics::{Chain, ROD_LINK};
use crate::model::{Owner, ParameterId};

/// Whether a cost that uses these encoders can depend on the parameter. Some parameters belong to one encoder: its
/// harmonics, its offsets, and waves as a function of its reading. For such a parameter, the cost must use this
/// encoder. For all other parameters the result is true.
pub(super) fn encoders_suffice(id: ParameterId, encoders: &[usize]) -> bool {
    match id {
        ParameterId::EncoderWave { joint, .. }
        | ParameterId::EncoderOffset { joint, .. }
        | ParameterId::BarWave { joint, .. } => encoders.contains(&joint),
        _ => true,
    }
}

/// A cost function: a residual vector for each sample, and its derivatives with respect to the parameters.
pub trait Residual: Sync {
    /// Intermediate results of a sample, computed once for its residual and all derivatives.
    type Local;
    /// Name in reports and on the command line.
    const NAME: &'static str;
    /// Number of residual entries per sample.
    const ROWS: usize;
    /// Indices (from 0) of the bar joints whose encoders the cost requires.
    const ENCODERS: &'static [usize] = &[];
    /// Owner of the parameters of the instrument.
    const OWNER: Owner = Owner::BallBar;

    /// Whether the parameter changes the residual for this robot. Parameters that do not change the residual need not be free.
    /// By default, the parameters of robot, clocks and instrument do, except those of encoders that the cost does not use.
    fn depends_on(id: ParameterId, _robot: &Chain) -> bool {
        id.affects(Self::OWNER) && encoders_suffice(id, Self::ENCODERS)
    }

    /// Whether the residual can distinguish the effect of the parameter from that of the other parameters. Named
    /// selections of parameters free only such parameters.
    fn identifies(id: ParameterId, robot: &Chain) -> bool {
        Self::depends_on(id, robot)
    }

    /// Computes the intermediate results of a sample. `None` if the residual has no value at this sample.
    fn local(&self, scene: &Scene<'_>) -> Option<Self::Local>;

    /// Writes the residual, `ROWS` entries.
    fn residual(&self, scene: &Scene<'_>, local: &Self::Local, out: &mut [f64]);

    /// Writes the derivative by one parameter, `ROWS` entries that are zero on entry.
    fn derivative(&self, scene: &Scene<'_>, local: &Self::Local, id: ParameterId, out: &mut [f64]);
}

/// Index (from 0) of the joint whose axis is the rod. Without the encoder of this joint, only the rotation about
/// the rod is unknown.
pub const ROD_JOINT: usize = ROD_LINK;
/// Indices of the bar encoders, without that of [`ROD_JOINT`].
pub(super) const ALL_BUT_ROD_JOINT: &[usize] = &[0, 1, 3, 4];

/// Indices of all five bar encoders.
pub(super) const ALL_ENCODERS: &[usize] = &[0, 1, 2, 3, 4];
