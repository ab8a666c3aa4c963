//! Residuals of the closed chain, and the least-squares problem for the solver.
//!
//! A cost defines its residual and the residual's derivative by the twist of the robot's end or the bar's end. The twist per
//! parameter is defined in one place, [`Scene`]. A new cost is a new [`Residual`].

mod bar;
mod contact;
mod data_sets;
mod knowns;
mod measured_length;
mod measured_pose;
mod measured_position;
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
pub use data_sets::{DataSet, DataSets, SharedColumns};
pub use knowns::BesideKnowns;
pub use measured_length::MeasuredLength;
pub use measured_pose::{MeasuredPose, PoseNoise};
pub use measured_position::MeasuredPosition;
pub use problem::{CostError, LoopProblem};
pub use residual::{ROD_JOINT, Residual};
pub use scene::{Movement, Scene};
pub use touched_face::TouchedFace;
