//! Writes measured lengths as a table.

use identify::kinematics::flange_chain;
use nalgebra::Vector3;
use shared::config::RobotConfig;

/// Anchor of the wire in the robot's base \[m\].
pub const ANCHOR_M: [f64; 3] = [0.3, -0.6, 0.1];

/// Lengths between the anchor and the flange of a nominal robot, as a table in the format of `config/measured_length.toml`.
/// The instrument shows lengths that are too long by `offset_mm`.
pub fn table(robot: &RobotConfig, rows: u32, offset_mm: f64) -> String {
    let chain = flange_chain(robot);
    let mut csv = String::from("x_mm,y_mm,z_mm,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,cable_mm\n");
    for row in 0..rows {
        let swing =
            |joint: usize| 50.0 * (0.37 * f64::from(row) * (1.0 + 0.31 * joint as f64) + joint as f64).sin();
        let q_deg: [f64; 6] = std::array::from_fn(swing);
        let position_m = chain.forward(&q_deg.map(f64::to_radians)).translation.vector;
        for cell in position_m.iter().map(|value| value * 1e3).chain(q_deg) {
            csv += &format!("{cell:.6},");
        }
        csv += &format!("{:.2}\n", (position_m - Vector3::from(ANCHOR_M)).norm() * 1e3 + offset_mm);
    }
    csv
}
