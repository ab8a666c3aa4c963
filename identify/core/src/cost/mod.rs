//! Costs. A cost computes residuals and Jacobian for the solver, from parameter values and samples.
//! [`crate::instrument`] selects the cost.
//!
//! A parameter moves the end of the robot's chain or of the bar's chain by a twist, which [`Scene`] computes for all costs.
//! A cost implements [`Residual`]: it computes the residual of a sample, and the derivatives of the residual from these
//! twists. [`LoopProblem`] applies a cost to the samples of a data set. [`CombinedDataSets`] combines data sets.
//!
//! Symbols are those of the thesis. `R` and `B` are the poses of the end according to robot and bar, and `R_p` and `B_p`
//! their positions. `o` is the base of the bar, `L` the length of the bar, and `b` its joints.

mod bar;
mod contact;
mod data_sets;
mod measured_length;
mod measured_pose;
mod problem;
mod residual;
mod scene;
mod touched_face;

pub use bar::angle_noise::{AngleNoise, FoundNoise};
pub use bar::closure::{Closure, loop_closures};
pub use bar::fill_in::fill_in;
pub use bar::length::Length;
pub use bar::pose::{PoseByNoise, WhitenedPose, WhitenedPoseOfFour};
pub use bar::position::Position;
pub use bar::position_angles::PositionAngles;
pub use bar::transform::Transform;
pub use contact::SeatedBall;
pub use data_sets::{CombinedDataSets, DataSet, SharedColumns};
pub use measured_length::MeasuredLength;
pub use measured_pose::{MeasuredPose, MeasuredPosition, PoseNoise, TrackedPose};
pub use problem::{CostError, LoopProblem};
pub use residual::{ROD_JOINT, Residual};
pub use scene::{Movement, Scene};
pub use touched_face::TouchedFace;
