//! Geometry of the robot and of the ball-bar: forward kinematics, derivatives by every parameter, and inverses.
//!
//! Both are chains of standard Denavit-Hartenberg links that end in the same frame: the robot's last link carries tool
//! and offset plate, the bar's link 5 ends where the plate ends. A robot has two to eight axes, revolute or prismatic. Each link
//! may have Hayati's extra rotation about y for nearly parallel axes (Hayati and Mirmirani 1985).

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
pub use inverse::{InverseError, nearest_turn, rotation_vector, wrapped};
pub use joints::{AXES_MAX, Joints};
pub use mirror::mirroring_joints;
pub use robot_inverse::{robot_inverse, robot_inverse_all, robot_inverse_centred};
pub use trace::{LinkParameter, Trace, Tracer, Turn, Twist};
