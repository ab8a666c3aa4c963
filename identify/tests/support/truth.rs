//! What a calibration is worth when the truth is known.

use identify::calibrate::ball_bar::BallBarCalibration;
use identify::kinematics::Chain;
use identify::model::ParameterId;
use identify::simulate::Simulated;
use shared::config::RobotConfig;

/// Mean distance between the end of the true robot and that of the identified one over postures within the limits \[m\].
pub fn position_error_m(run: &Simulated, found: &BallBarCalibration, robot: &RobotConfig) -> f64 {
    /// Steps along each joint, prime to each other so that every combination comes.
    const STEPS: [usize; 6] = [7, 11, 13, 17, 19, 23];
    const POSTURES: usize = 2000;
    let mut true_model = found.model.clone();
    for (name, value) in &run.truth.parameters {
        if let Ok(id @ ParameterId::Robot { .. }) = name.parse() {
            true_model.set_value(id, *value).unwrap();
        }
    }
    let [identified, truth] = [&found.model, &true_model].map(|model| model.geometry(&model.start()).robot);
    let end_m = |chain: &Chain, q: &[f64; 6]| chain.forward(q).translation.vector;
    let limits = robot.joint_limits();
    let distance = |posture: usize| {
        let q: [f64; 6] = std::array::from_fn(|joint| {
            let [low, high] = limits[joint];
            let part = (posture % STEPS[joint]) as f64 / (STEPS[joint] - 1) as f64;
            low + (high - low) * part
        });
        (end_m(&identified, &q) - end_m(&truth, &q)).norm()
    };
    (0..POSTURES).map(distance).sum::<f64>() / POSTURES as f64
}
