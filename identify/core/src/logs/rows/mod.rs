//! Reads tables in which each row is one pose of the robot with one measurement: by a tracker (`measured_pose`), by a
//! wire or bar (`measured_length`), or by a tip that touches sockets or faces (`touch`). `pose_rows` contains what
//! these tables have in common.

pub(super) mod measured_length;
pub(super) mod measured_pose;
pub(super) mod pose_rows;
pub(super) mod touch;
