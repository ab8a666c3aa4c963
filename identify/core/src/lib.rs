//! Calibration of a robot from what a ball-bar, a tracker, a wire or sockets say beside the robot's own log: the numbers, without
//! what people see of them.
//!
//! The way of the data: [`logs`] and the recording -> [`prepare`] -> [`model`] and [`cost`] -> [`solver`] ->
//! [`calibrate`] ties them together -> [`evaluate`] looks at the result; [`plan`] finds paths worth driving,
//! [`simulate`] makes experiments with known truth, [`study`] makes them by the thousand, [`robot`] takes a robot from a URDF and
//! checks it.

pub mod calibrate;
pub mod cost;
pub mod evaluate;
pub mod instrument;
pub mod kinematics;
pub mod logs;
pub mod model;
pub mod plan;
pub mod prepare;
pub mod robot;
pub mod simulate;
pub mod solver;
pub mod statistics;
pub mod study;
pub mod threads;
