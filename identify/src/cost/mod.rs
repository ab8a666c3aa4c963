//! Residuals of the closed chain, and the problem that the solver gets.
//!
//! A cost says what its residual is and how it changes when the robot's end or the bar's end moves by a twist; where
//! each parameter's twist comes from is said once, in [`Scene`]. A new cost is a new [`Residual`].

mod angle_noise;
mod closure;
mod contact;
mod data_sets;
mod fill_in;
mod length;
mod measured_length;
mod measured_pose;
mod measured_position;
mod pose;
mod position;
mod position_angles;
mod problem;
mod scene;
mod transform;

pub use angle_noise::{AngleNoise, FoundNoise};
pub use closure::{Closure, closures};
pub use contact::{SeatedBall, SeatedBalls};
pub use data_sets::{DataSet, DataSets, SharedColumns};
pub use fill_in::fill_in;
pub use length::Length;
pub use measured_length::MeasuredLength;
pub use measured_pose::{MeasuredPose, PoseNoise};
pub use measured_position::MeasuredPosition;
pub use pose::{PoseByNoise, WhitenedPose, WhitenedPoseOfFour};
pub use position::Position;
pub use position_angles::PositionAngles;
pub use problem::{CostError, LoopProblem};
pub(crate) use scene::TORSION;
pub use scene::{Movement, Residual, Scene};
pub use transform::Transform;
