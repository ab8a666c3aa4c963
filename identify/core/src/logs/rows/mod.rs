//! Rows that a tracker, a wire or a ball in sockets gave, a pose of the robot each.

pub(super) mod contact;
pub(super) mod measured_length;
pub(super) mod measured_pose;
pub(super) mod pose_rows;
