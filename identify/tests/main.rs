//! All tests of `identify` that need no more than its library and binary, in one program: one link, and long tests side by side.
//!
//! One file of them: `cargo test -p identify --test all preparation_crossing`.

mod support;

mod any_arm;
mod bar_force;
mod command_line;
mod compare;
mod configuration;
mod considered;
mod contact;
mod draw_wire;
mod efficiency;
mod examination;
mod healthy_runs;
mod identifiability;
mod independent;
mod inspection;
mod interpolation;
mod jacobians;
mod kinematics;
mod kinematics_hayati;
mod laboratory;
mod laboratory_campaign;
mod log_formats;
mod measured_jacobians;
mod measured_lengths;
mod measured_pose_calibration;
mod measured_poses;
mod mixed;
mod planning;
mod preparation;
mod preparation_crossing;
mod preparation_readings;
mod preparation_steps;
mod preparation_timeline;
mod preparation_wiring;
mod refusals;
mod refused_page;
mod report_page;
mod report_page_runs;
mod results;
mod results_robot;
mod robot_logs;
mod selection;
mod several_runs;
mod simulated_experiment;
mod simulation;
mod solver;
mod solver_threads;
mod spoiled_rows;
mod stamps;
mod studies;
mod unknown_tables;
mod verdict;
mod wrong_robot;
