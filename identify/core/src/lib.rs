//! The numerical part of the calibration of a robot, without reports. Inputs are the robot's log and the measurements of an
//! instrument: a ball-bar, a tracker, a draw-wire, or a probe that touches sockets and faces.
//!
//! A calibration uses these modules in order. [`logs`] reads the robot's log. [`prepare`] aligns the log with the recording
//! and selects samples. [`model`] and [`cost`] define parameters and residuals, and [`solver`] minimises them. [`calibrate`]
//! runs these steps, and [`evaluate`] assesses the result.
//!
//! The other modules support experiments. [`plan`] searches for paths and poses, [`simulate`] generates experiments
//! with known parameters, and [`study`] runs thousands of simulated experiments. [`robot`] imports a robot from a
//! URDF file and checks the robot's configuration.

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
