//! Makes the readings of both logs continuous and, optionally, averages them. Also finds standstills in them.

pub(super) mod averaged;
pub(super) mod bar_angles;
pub(super) mod both_logs;
pub(super) mod standstill;
pub(super) mod unwrap;
