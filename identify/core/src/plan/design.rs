//! Position of the bar in the robot cell, and limits of the motion.

use rand::Rng;
use serde::{Deserialize, Serialize};
use shared::config::{JointKind, RobotConfig};

use crate::kinematics::{Chain, DhLink, Joints, flange_chain};

/// Position of the bar, and ranges, speeds and margins of the motion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Design {
    /// Centre of the gimbal in the robot's base frame \[m\].
    pub base_m: [f64; 3],
    /// A posture of the robot near which the motion begins \[deg, mm\]. It selects the configuration of elbow and wrist. It
    /// is ignored if the robot has another number of axes.
    pub posture_deg: Joints,
    /// Range of each bar joint on the path \[deg\]. The signs of joints 2 and 4 select the configuration of the bar.
    pub bar_range_deg: [[f64; 2]; 5],
    /// Time from the first to the last bar sample \[s\].
    pub duration_s: f64,
    /// Highest speed of a bar joint \[rad/s\].
    pub bar_speed_rad_s: f64,
    /// Highest speed of a revolute joint of the robot \[rad/s\].
    pub robot_speed_rad_s: f64,
    /// Highest speed of a prismatic joint of the robot \[m/s\]. If absent, it is the number of `robot_speed_rad_s`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot_speed_m_s: Option<f64>,
    /// Duration of a standstill \[s\]. The bar stands still after every third move. The standstills at the beginning and at
    /// the end of the path are twice as long.
    pub standstill_s: f64,
    /// Least distance of the bar from its singular poses \[deg\].
    pub bar_margin_deg: f64,
    /// Least distance of robot joint 5 from the straight wrist \[deg\].
    pub wrist_margin_deg: f64,
    /// Least distance of the robot's joints from their limits \[deg\]. For prismatic axes this number is in millimetres.
    pub limit_margin_deg: f64,
    /// Smallest permitted singular value of the robot's Jacobian; metres and radians have equal weight. It excludes the
    /// stretched elbow and all other postures in which small errors of the geometry cause large joint motions.
    pub dexterity_min: f64,
}

impl Design {
    /// Design for an ABB IRB 2400/16 with a bar of 0.5 to 0.7 m.
    pub const IRB_2400: Self = Self {
        base_m: [1.0, 0.05, 0.35],
        posture_deg: Joints::from_array([0.0, 20.0, 10.0, 0.0, 60.0, 0.0]),
        bar_range_deg: [[-170.0, 170.0], [12.0, 85.0], [-170.0, 170.0], [75.0, 165.0], [-170.0, 170.0]],
        duration_s: 120.0,
        bar_speed_rad_s: 0.8,
        robot_speed_rad_s: 1.2,
        robot_speed_m_s: None,
        standstill_s: 1.0,
        bar_margin_deg: 10.0,
        wrist_margin_deg: 12.0,
        limit_margin_deg: 3.0,
        dexterity_min: 0.06,
    };

    /// Design for a Comau NJ 220-2.7 with a bar of 0.5 to 1.0 m.
    pub const NJ_220: Self = Self { base_m: [1.7, 0.05, 0.6], ..Self::IRB_2400 };

    /// Highest speed of each joint of an arm \[rad/s, m/s\].
    pub fn speeds_max(&self, robot: &Chain) -> impl Iterator<Item = f64> {
        robot.links.iter().map(|link| match link.joint {
            JointKind::Revolute => self.robot_speed_rad_s,
            JointKind::Prismatic => self.robot_speed_m_s.unwrap_or(self.robot_speed_rad_s),
        })
    }

    /// The robot's posture near which the motion begins \[rad, m\]. It is the design's posture, or a random posture within
    /// `limits` if the robot has another number of axes.
    pub fn posture_rad(&self, robot: &Chain, limits: &[[f64; 2]], random: &mut impl Rng) -> Joints {
        if self.posture_deg.len() == limits.len() {
            let numbers = self.posture_deg.iter().zip(&robot.links);
            return numbers.map(|(number, link)| si(*number, link)).collect();
        }
        Joints::random(limits, random)
    }

    /// Limits of an arm's joints, reduced by the design's margin \[rad, m\].
    pub fn limits_with_margin(&self, robot: &Chain, limits: &[[f64; 2]]) -> Vec<[f64; 2]> {
        let reduced = |([low, high], link): (&[f64; 2], &DhLink)| {
            let margin = si(self.limit_margin_deg, link);
            [low + margin, high - margin]
        };
        limits.iter().zip(&robot.links).map(reduced).collect()
    }

    /// Whether joint 5 of an arm with six axes is far enough from the straight wrist; true for other arms.
    pub fn wrist_is_bent(&self, joints_rad: &[f64]) -> bool {
        let margin = self.wrist_margin_deg.to_radians().sin();
        !matches!(joints_rad, [_, _, _, _, wrist, _] if wrist.sin().abs() < margin)
    }

    /// The default design for a robot. It depends on the length of the upper arm, which exceeds a metre in large robots.
    pub fn for_robot(robot: &RobotConfig) -> Self {
        // In the chain, `a` follows its axis in either convention.
        let upper_arm_m = flange_chain(robot).links.get(1).map_or(0.0, |link| link.a_m);
        if upper_arm_m > 1.0 { Self::NJ_220 } else { Self::IRB_2400 }
    }
}

/// Converts a joint value from degrees or millimetres to radians or metres.
fn si(number: f64, link: &DhLink) -> f64 {
    match link.joint {
        JointKind::Revolute => number.to_radians(),
        JointKind::Prismatic => number * 1e-3,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kinematics::Pose;

    #[test]
    fn the_margin_of_a_prismatic_axis_is_in_millimetres() {
        let kinds = [JointKind::Prismatic, JointKind::Revolute];
        let links = kinds.map(|joint| DhLink { joint, ..DhLink::default() }).to_vec();
        let design = Design { limit_margin_deg: 3.0, ..Design::IRB_2400 };
        let limits =
            design.limits_with_margin(&Chain::new(Pose::identity(), links), &[[0.0, 0.05], [-1.0, 1.0]]);
        let margin_rad = 3f64.to_radians();
        assert_eq!(limits, [[0.003, 0.05 - 0.003], [-1.0 + margin_rad, 1.0 - margin_rad]]);
    }
}
