//! What a calibration is worth when the truth is known.

use identify::calibrate::ball_bar::BallBarCalibration;
use identify::calibrate::truth::position_errors_m;
use identify::simulate::Simulated;
use nalgebra::Vector3;
use shared::config::RobotConfig;

/// Mean distance between the end of the true robot and that of the identified one over postures within the limits \[m\].
pub fn position_error_m(run: &Simulated, found: &BallBarCalibration, robot: &RobotConfig) -> f64 {
    position_errors_m(&found.model, &run.truth, robot, [Vector3::zeros(); 2]).0
}
