//! Gear errors that no model contains.

use identify::kinematics::Joints;
use identify::model::DriveTrain;
use rand::Rng;
use rand::rngs::StdRng;

/// Gear errors of one robot, which are added to its reported joints. They are functions of the output angles of the gears.
/// Their orders are not contained in any model.
pub struct Gears {
    drives: DriveTrain,
    teeth: [f64; 6],
    phases: [[f64; 2]; 6],
}

impl Gears {
    pub fn new(drives: DriveTrain, random: &mut StdRng) -> Self {
        let teeth = std::array::from_fn(|_| f64::from(random.random_range(11..60_u8)));
        let phases = std::array::from_fn(|_| std::array::from_fn(|_| random.random_range(-3.0..3.0)));
        Self { drives, teeth, phases }
    }

    pub fn error_rad(&self, joints_rad: &Joints) -> [f64; 6] {
        let mut error_rad = [0.0; 6];
        for (drive, (teeth, [twice, often])) in self.teeth.iter().zip(self.phases).enumerate() {
            let angle = self.drives.of_drive(drive, joints_rad);
            let own = 30e-6 * (2.0 * angle + twice).sin() + 20e-6 * (teeth * angle + often).sin();
            for (error, part) in error_rad.iter_mut().zip(&self.drives.joint_from_drive[drive]) {
                *error += part * own;
            }
        }
        error_rad
    }
}
