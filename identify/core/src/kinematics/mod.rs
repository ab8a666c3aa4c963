//! Geometry of the robot and of the ball-bar: forward kinematics, derivatives with respect to every
//! parameter, and inverse kinematics.
//!
//! Robot and ball-bar are chains of standard Denavit-Hartenberg links. Both chains end in the same frame, at the end of
//! the offset plate: the robot's last link includes tool and plate, and link 5 of the bar ends there as well. A robot
//! has two to eight axes, revolute or prismatic. A link may have Hayati's extra rotation about y, which describes
//! nearly parallel axes (Hayati and Mirmirani 1985).

mod ball_bar_inverse;
mod chain;
mod configured;
mod from_axes;
mod implied_bar;
mod inverse;
mod joints;
mod mirror;
mod robot_inverse;
mod trace;

pub use ball_bar_inverse::{
    BAR_JOINTS, Configuration, Side, ball_bar_inverse, ball_bar_inverse_refined, first_ball_bar_inverse,
    singularity_margin_rad,
};
pub use chain::{Chain, DhLink, LENGTH_M_MAX, Pose, roll_pitch_yaw};
pub use configured::{ball_bar_chain, flange_chain, robot_chain};
pub use from_axes::AxisLine;
pub use implied_bar::{ImpliedBar, ROD_LINK};
pub(crate) use inverse::nearest_rotation;
pub use inverse::{InverseError, nearest_turn, rotation_vector, wrapped};
pub use joints::{AXES_MAX, Joints};
pub use mirror::mirroring_joints;
pub use robot_inverse::{robot_inverse, robot_inverse_all, robot_inverse_centred};
pub use trace::{LinkParameter, Trace, Tracer, Turn, Twist};
