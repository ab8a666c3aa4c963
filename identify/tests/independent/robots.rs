//! The simulated robots. Nominal links, limits and gears are those of data sheets. The format of a robot's log
//! is that of the robot's controller.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use nalgebra::{Matrix6, RowVector6};

use super::kinematics::{Arm, Dh};

/// Type of the gear between motor and joint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Gear {
    /// Cycloid gear: its error has one period per lobe and turn of the joint.
    Cycloid,
    /// Strain wave gear: its error has two periods per turn of the wave generator.
    StrainWave,
    /// Spur and bevel gears: their error has one period per turn of the motor.
    Wheels,
}

/// Names and format of the angles in a robot's log.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LogForm {
    /// Prefix of the column names, such as `motor` of `motor1_rad`.
    pub column: &'static str,
    pub unit: &'static str,
    pub unit_rad: f64,
    pub decimals: usize,
}

/// One robot with the values of its data sheet.
#[derive(Debug, Clone)]
pub struct Robot {
    pub name: &'static str,
    /// Links up to the flange, without plate and tool.
    pub nominal: Arm,
    pub limits_deg: [[f64; 2]; 6],
    pub gears: [Gear; 6],
    /// Number of motor turns per turn of the joint.
    pub gear_ratio: [f64; 6],
    pub log: LogForm,
    /// The matrix in `q = raw * joints_from_raw`, in which `q` and `raw` are row vectors \[rad\].
    pub joints_from_raw: Matrix6<f64>,
    /// Length of the rod of a bar that suits the robot \[m\]. `plate_m` is the length of the bar's offset plate.
    pub bar_length_m: f64,
    pub plate_m: f64,
    /// Parameters that the loop of robot and bar cannot determine for this arm (table 3.2 of TFRT-6017 and parallel axes).
    pub undetermined: &'static [&'static str],
    /// Name of the shipped file of the robot. `None` if the file must be written next to the logs.
    shipped: Option<&'static str>,
}

const RADIANS: LogForm = LogForm { column: "joint", unit: "rad", unit_rad: 1.0, decimals: 7 };
const DEGREES: LogForm =
    LogForm { column: "joint", unit: "deg", unit_rad: std::f64::consts::PI / 180.0, decimals: 4 };

impl Robot {
    /// All five robots of this file.
    pub fn all() -> Vec<Self> {
        vec![Self::irb2400(), Self::nj220(), Self::irb120(), Self::kr10(), Self::ur10()]
    }

    /// ABB IRB 2400/16. Its log has motor angles. Axes 1 to 3 have cycloid gears, the wrist has wheels.
    pub fn irb2400() -> Self {
        let mut raw = Matrix6::zeros();
        raw[(0, 0)] = -5.0 / 648.0;
        raw[(1, 1)] = 100.0 / 12999.0;
        raw[(1, 2)] = -100.0 / 12999.0;
        raw[(2, 2)] = -5.0 / 648.0;
        raw[(3, 3)] = -1.0 / 55.0;
        raw[(3, 4)] = -1.0 / 759.0;
        raw[(3, 5)] = -62.0 / 41745.0;
        raw[(4, 4)] = -5.0 / 276.0;
        raw[(4, 5)] = -5.0 / 552.0;
        raw[(5, 5)] = -1.0 / 44.0;
        Self {
            name: "irb2400",
            nominal: Arm {
                links: [
                    Dh::new(0.1, -90.0, 0.615, 0.0),
                    Dh::new(0.705, 0.0, 0.0, -90.0),
                    Dh::new(0.135, -90.0, 0.0, 0.0),
                    Dh::new(0.0, 90.0, 0.755, 180.0),
                    Dh::new(0.0, -90.0, 0.0, 0.0),
                    Dh::new(0.0, 0.0, 0.085, 0.0),
                ],
            },
            limits_deg: [
                [-180.0, 180.0],
                [-100.0, 110.0],
                [-170.0, 170.0],
                [-200.0, 200.0],
                [-120.0, 120.0],
                [-400.0, 400.0],
            ],
            gears: [Gear::Cycloid, Gear::Cycloid, Gear::Cycloid, Gear::Wheels, Gear::Wheels, Gear::Wheels],
            gear_ratio: [129.6, 129.99, 129.6, 55.0, 55.2, 44.0],
            log: LogForm { column: "motor", decimals: 6, ..RADIANS },
            joints_from_raw: raw,
            bar_length_m: 0.6,
            plate_m: 0.25,
            undetermined: &["rd1", "rd3", "rtheta1"],
            shipped: Some("irb2400_16.toml"),
        }
    }

    /// Comau NJ 220-2.7. Its log has the joint angles of the controller. All gears are cycloid gears.
    pub fn nj220() -> Self {
        let mut raw = Matrix6::zeros();
        raw[(0, 0)] = -1.0;
        raw[(1, 1)] = 1.0;
        raw[(1, 2)] = -1.0;
        raw[(2, 2)] = -1.0;
        raw[(3, 3)] = -1.0;
        raw[(4, 4)] = 1.0;
        raw[(5, 5)] = -1.0;
        Self {
            name: "nj220",
            nominal: Arm {
                links: [
                    Dh::new(0.4, -90.0, 0.83, 0.0),
                    Dh::new(1.175, 0.0, 0.0, -90.0),
                    Dh::new(0.25, -90.0, 0.0, 0.0),
                    Dh::new(0.0, -90.0, 1.125, 180.0),
                    Dh::new(0.0, 90.0, 0.0, 0.0),
                    Dh::new(0.0, 0.0, 0.23, 0.0),
                ],
            },
            limits_deg: [
                [-180.0, 180.0],
                [-95.0, 125.0],
                [-190.0, 190.0],
                [-280.0, 280.0],
                [-125.0, 125.0],
                [-400.0, 400.0],
            ],
            gears: [Gear::Cycloid; 6],
            gear_ratio: [190.0, 200.0, 190.0, 110.0, 105.0, 85.0],
            log: DEGREES,
            joints_from_raw: raw,
            bar_length_m: 1.0,
            plate_m: 0.25,
            undetermined: &["rd1", "rd3", "rtheta1"],
            shipped: Some("nj220_2_7.toml"),
        }
    }

    /// ABB IRB 120-3/0.6, a small arm with strain wave gears.
    pub fn irb120() -> Self {
        Self {
            name: "irb120",
            nominal: Arm {
                links: [
                    Dh::new(0.0, -90.0, 0.29, 0.0),
                    Dh::new(0.27, 0.0, 0.0, -90.0),
                    Dh::new(0.07, -90.0, 0.0, 0.0),
                    Dh::new(0.0, 90.0, 0.302, 0.0),
                    Dh::new(0.0, -90.0, 0.0, 0.0),
                    Dh::new(0.0, 0.0, 0.072, 180.0),
                ],
            },
            limits_deg: [
                [-165.0, 165.0],
                [-110.0, 110.0],
                [-110.0, 70.0],
                [-160.0, 160.0],
                [-120.0, 120.0],
                [-400.0, 400.0],
            ],
            gears: [Gear::StrainWave; 6],
            gear_ratio: [121.0, 121.0, 101.0, 50.0, 51.0, 50.0],
            log: DEGREES,
            joints_from_raw: Matrix6::identity(),
            bar_length_m: 0.4,
            plate_m: 0.12,
            undetermined: &["rd1", "rd3", "rtheta1"],
            shipped: None,
        }
    }

    /// KUKA KR 10 R1100. Its axes are opposite to z of the links, and the joints are zero if the arm is stretched forward
    /// (A3 is 90 deg if the arm is bent).
    pub fn kr10() -> Self {
        let signs = RowVector6::new(-1.0, 1.0, 1.0, -1.0, 1.0, -1.0);
        Self {
            name: "kr10",
            nominal: Arm {
                links: [
                    Dh::new(0.025, -90.0, 0.4, 0.0),
                    Dh::new(0.56, 0.0, 0.0, 0.0),
                    Dh::new(0.035, -90.0, 0.0, -90.0),
                    Dh::new(0.0, 90.0, 0.515, 0.0),
                    Dh::new(0.0, -90.0, 0.0, 0.0),
                    Dh::new(0.0, 0.0, 0.08, 180.0),
                ],
            },
            limits_deg: [
                [-170.0, 170.0],
                [-190.0, 45.0],
                [-120.0, 156.0],
                [-185.0, 185.0],
                [-120.0, 120.0],
                [-350.0, 350.0],
            ],
            gears: [Gear::StrainWave; 6],
            gear_ratio: [121.0, 121.0, 101.0, 81.0, 81.0, 50.0],
            log: DEGREES,
            joints_from_raw: Matrix6::from_diagonal(&signs.transpose()),
            bar_length_m: 0.5,
            plate_m: 0.2,
            undetermined: &["rd1", "rd3", "rtheta1"],
            shipped: None,
        }
    }

    /// Universal Robots UR10, with three parallel axes and an offset wrist. Its log is in radians.
    pub fn ur10() -> Self {
        Self {
            name: "ur10",
            nominal: Arm {
                links: [
                    Dh::new(0.0, 90.0, 0.1273, 0.0),
                    Dh::new(-0.612, 0.0, 0.0, 0.0),
                    Dh::new(-0.5723, 0.0, 0.0, 0.0),
                    Dh::new(0.0, 90.0, 0.163941, 0.0),
                    Dh::new(0.0, -90.0, 0.1157, 0.0),
                    Dh::new(0.0, 0.0, 0.0922, 0.0),
                ],
            },
            limits_deg: [[-360.0, 360.0]; 6],
            gears: [Gear::StrainWave; 6],
            gear_ratio: [101.0; 6],
            log: LogForm { decimals: 6, ..RADIANS },
            joints_from_raw: Matrix6::identity(),
            bar_length_m: 0.6,
            plate_m: 0.2,
            undetermined: &["rd1", "rd3", "rd4", "rtheta1"],
            shipped: None,
        }
    }

    /// Limits of the joints of the model \[rad\].
    pub fn limits_rad(&self) -> [[f64; 2]; 6] {
        self.limits_deg.map(|limits| limits.map(f64::to_radians))
    }

    /// Path of the robot's file: the shipped file, or one in the same format that is written to `directory`.
    pub fn file(&self, directory: &Path) -> PathBuf {
        if let Some(shipped) = self.shipped {
            return Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/robots").join(shipped);
        }
        let path = directory.join(format!("{}.toml", self.name));
        std::fs::write(&path, self.toml()).unwrap();
        path
    }

    fn toml(&self) -> String {
        let mut text = format!("name = \"{}\"\njoint_limits_deg = {:?}\n", self.name, self.limits_deg);
        self.nominal.links.iter().for_each(|link| text += &link_toml(link));
        let rows = self.joints_from_raw.row_iter().map(|row| row.iter().copied().collect::<Vec<f64>>());
        let LogForm { column, unit, .. } = self.log;
        write!(
            text,
            "\n[log]\ncolumn = \"{column}\"\nunit = \"{unit}\"\nraw_offset_rad = {:?}\nraw_to_joint = {:?}\n",
            [0.0; 6],
            rows.collect::<Vec<_>>()
        )
        .unwrap();
        text
    }
}

/// A link in the format of robots' files.
pub fn link_toml(link: &Dh) -> String {
    format!(
        "\n[[links]]\na_m = {:?}\nalpha_deg = {:?}\nd_m = {:?}\ntheta_deg = {:?}\n",
        link.a_m,
        link.alpha_rad.to_degrees(),
        link.d_m,
        link.theta_rad.to_degrees()
    )
}
