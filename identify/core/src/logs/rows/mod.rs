//! Rows of a tracker, a wire, a ball in sockets or a tip on faces, a pose of the robot each.

pub(super) mod measured_length;
pub(super) mod measured_pose;
pub(super) mod pose_rows;
pub(super) mod touch;
