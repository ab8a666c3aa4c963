//! Calibration of a robot from its log and the measurements of a ball-bar, a tracker, a draw-wire, or sockets and faces: the
//! numerical part, without reports.
//!
//! Flow of the data: [`logs`] and the recording -> [`prepare`] -> [`model`] and [`cost`] -> [`solver`] -> [`calibrate`], which
//! connects them -> [`evaluate`], which assesses the result. [`plan`] searches paths and poses, [`simulate`] generates
//! experiments with known truth, [`study`] runs thousands of them, and [`robot`] imports a robot from a URDF and checks it.

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
