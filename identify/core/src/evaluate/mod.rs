//! Evaluation of a calibration. Computes the numbers and curves of the report from a solution; solves do not use them. Most
//! results are in [`Evidence`].

mod accuracy;
mod evidence;
mod gaps;
mod held_out;
mod limits;
mod nominal;
mod scale;
mod separation;
mod shift;
mod sphere_deviation;

pub use accuracy::budget::{Budget, Contribution, Evaluation};
pub use accuracy::cube::CubeError;
pub use accuracy::validity::Validity;
pub use accuracy::workspace::random_postures;
pub use accuracy::workspace::{Expected, PlaceError, WorkspaceError, workspace_error};
pub use evidence::{Evidence, RunEvidence, evidence};
pub use gaps::{JointGap, joint_gaps};
pub use held_out::{HeldOut, HeldOutSegment, held_out, nominals};
pub use limits::{Limit, limits};
pub use nominal::uncalibrated;
pub use scale::scale_sentence;
pub use separation::not_separated;
pub use shift::{ShiftCurve, shift_curve};
pub use sphere_deviation::{Elongation, ModelDeviation, OffSphere, PositiveForce, SphereDeviation};
