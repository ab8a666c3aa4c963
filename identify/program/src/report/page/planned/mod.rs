//! Pages of planned paths and planned poses. Each page contains a three-dimensional animation of the arm.

pub(in crate::report::page) mod path;
pub(in crate::report::page) mod path_view;
pub(in crate::report::page) mod poses;
