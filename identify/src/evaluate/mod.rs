//! What a calibration shows when one looks at it: figures for the report, computed from a solve and never fed back.

mod budget;
mod calibrated_robot;
mod consistency;
mod costs;
mod cube;
mod evidence;
mod figures;
mod gaps;
mod held_out;
mod limits;
mod nominal;
mod shift;
mod sphere_deviation;
mod validity;
mod workspace;

pub use budget::{Budget, Contribution, Evaluation};
pub use calibrated_robot::{CalibratedRobot, CalibratedRobotError};
pub use consistency::{Compared, Consistency, ConsistencyError};
pub use costs::{CostComparison, CostEntry, CostFigures, compare_costs};
pub use cube::CubeError;
pub use evidence::{Evidence, RunEvidence, evidence};
pub use figures::{Quantiles, rms};
pub use gaps::{JointGap, joint_gaps};
pub use held_out::{Apart, ApartRms, HeldOut, HeldOutSegment, held_out, nominals};
pub use limits::{Limit, ScaleFrom, limits, of_changes, of_lengths};
pub use nominal::uncalibrated;
pub use shift::{ShiftCurve, shift_curve};
pub use sphere_deviation::{Deviation, Elongation, OffSphere, PositiveForce, SphereDeviation};
pub use validity::Validity;
pub use workspace::{Expected, PlaceError, WorkspaceError, workspace_error};
