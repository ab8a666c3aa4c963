//! `config/ball_bar.toml`: the bar's geometry and the encoders on its joints.

use serde::{Deserialize, Serialize};

use super::robot::validate_links;
use super::{JointKind, Kind, LinkConfig, Validate, Violation};
use crate::encoder::{Direction, EncoderScale, INTERPOLATION_BITS};
use crate::recording::schema::MAX_ENCODERS;

/// Number of joints of the bar: three in the gimbal at the base, two in the cardan at the flange.
pub const BAR_JOINTS: usize = 5;

/// Description of a joint of the bar for messages. Joints are numbered from 1.
pub const fn bar_joint_name(joint: u8) -> &'static str {
    match joint {
        1 => "gimbal, about the axis of its base",
        2 => "gimbal, tilting the rod",
        3 => "gimbal, the rod about itself",
        4 => "cardan, tilting",
        5 => "cardan, about the axis of the flange side",
        _ => "no joint of the bar",
    }
}

/// One encoder. Encoders are listed in the order of their terminals on the bus.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EncoderConfig {
    /// Bar joint that the encoder measures, 1 to 5.
    pub joint: u8,
    /// Signal periods per revolution.
    pub lines: u32,
    /// Interpolation in the terminal, bits per signal period.
    pub interpolation_bits: u8,
    /// Whether counts rise or fall when the joint turns in its positive direction.
    pub direction: Direction,
    /// Approximate joint angle at the reference mark, from an earlier calibration \[deg\]. After homing, the operator can be
    /// shown how close the bar is to a singular pose. The value does not change any recorded angle.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mark_deg: Option<f64>,
}

impl EncoderConfig {
    /// A Heidenhain ERN 1080 on an EL5021, with the values of `config/ball_bar.toml`.
    pub fn ern_1080(joint: u8) -> Self {
        let EncoderScale { lines, interpolation_bits, direction, .. } = EncoderScale::default();
        Self { joint, lines, interpolation_bits, direction, mark_deg: None }
    }

    /// The conversion from counts to an angle. Offset and reference mark are 0 at first;
    /// calibration and homing determine them.
    pub fn scale(&self) -> EncoderScale {
        EncoderScale {
            lines: self.lines,
            interpolation_bits: self.interpolation_bits,
            direction: self.direction,
            ..EncoderScale::default()
        }
    }
}

/// The double ball-bar.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BallBarConfig {
    /// Name of the bar and its rod.
    pub name: String,
    /// Distance from the centre of the gimbal to the centre of the cardan \[m\]. It is the parameter `d` of link 3.
    pub length_m: f64,
    /// Standard uncertainty of `length_m` \[um\]. If absent, the length is estimated from the run alone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub length_u_um: Option<f64>,
    /// Distance from the last axis of the robot to axis 5 of the bar, along the offset plate \[m\]. It is added to the
    /// parameter `a` of the robot's last link, and determines the scale of the result.
    pub plate_m: f64,
    /// Standard uncertainty of `plate_m` \[um\]. With 0, the plate is taken as exact.
    #[serde(default = "plate_u_um")]
    pub plate_u_um: f64,
    /// Distance from the face of the robot's flange to the centre of the cardan, along the last axis \[m\]. It includes the
    /// tool changer, adapters, part of the plate and the cardan. It is added to the parameter `d` of the robot's last link.
    pub tool_m: f64,
    /// Links 1 to 5. The length of the bar is not among their values; `length_m` contains it.
    pub links: Vec<LinkConfig>,
    /// Encoders in bus order: the first is on the first EL5021 after the coupler.
    pub encoders: Vec<EncoderConfig>,
}

const fn plate_u_um() -> f64 {
    BallBarConfig::PLATE_U_UM
}

impl BallBarConfig {
    /// Standard uncertainty of `plate_m` if the file contains none \[um\]. It is the uncertainty of a calliper.
    pub const PLATE_U_UM: f64 = 50.0;

    fn validate_encoder(&self, index: usize, encoder: &EncoderConfig) -> Result<(), Violation> {
        let key = |name: &str| format!("encoders[{index}].{name}");
        if !(1..=BAR_JOINTS as u8).contains(&encoder.joint) {
            return Err(Violation::new(
                key("joint"),
                format!("the bar has no joint {}", encoder.joint),
                "use 1 to 3 for the gimbal, 4 and 5 for the cardan",
            ));
        }
        if self.encoders[..index].iter().any(|other| other.joint == encoder.joint) {
            return Err(Violation::new(
                key("joint"),
                format!("joint {} has two encoders", encoder.joint),
                "list each joint once, in bus order",
            ));
        }
        if encoder.lines == 0 || encoder.lines > 1_000_000 {
            return Err(Violation::new(
                key("lines"),
                format!("{} lines per revolution", encoder.lines),
                "take it from the encoder's label (ERN 1080: 3600)",
            ));
        }
        let remedy = "give the joint's angle at the reference mark in degrees, or leave it out";
        Violation::unless_within(
            key("mark_deg"),
            encoder.mark_deg.unwrap_or_default(),
            [-360.0, 360.0],
            remedy,
        )?;
        if !INTERPOLATION_BITS.contains(&encoder.interpolation_bits) {
            return Err(Violation::new(
                key("interpolation_bits"),
                format!("{} bits per signal period", encoder.interpolation_bits),
                "an EL5021 interpolates 8 to 13 bits (12 is usual)",
            ));
        }
        Ok(())
    }
}

impl Validate for BallBarConfig {
    const KIND: Option<Kind> = Some(Kind::BallBar);

    fn validate(&self) -> Result<(), Violation> {
        Violation::unless_within("length_m", self.length_m, [0.05, 5.0], "lengths are in metres")?;
        Violation::unless_within("plate_m", self.plate_m, [0.0, 2.0], "lengths are in metres")?;
        Violation::unless_within("tool_m", self.tool_m, [0.0, 2.0], "lengths are in metres")?;
        let remedy = "give the standard uncertainty of plate_m in micrometres; 0 takes the plate as exact";
        Violation::unless_within("plate_u_um", self.plate_u_um, [0.0, 10_000.0], remedy)?;
        if let Some(length_u_um) =
            self.length_u_um.filter(|length_u_um| !(*length_u_um > 0.0 && *length_u_um <= 10_000.0))
        {
            return Err(Violation::new(
                "length_u_um",
                format!("{length_u_um} is not above 0 and up to 10000"),
                "give the standard uncertainty of length_m in micrometres, or leave it out: the length is then found from the run",
            ));
        }
        if self.links.len() != BAR_JOINTS {
            return Err(Violation::new(
                "links",
                format!("{} links are given", self.links.len()),
                "give the five links of the bar, base to flange",
            ));
        }
        validate_links("links", &self.links)?;
        if let Some(link) = self.links.iter().position(|link| link.joint == JointKind::Prismatic) {
            let (key, problem) = (format!("links[{link}].joint"), "the bar's joints are revolute");
            return Err(Violation::new(
                key,
                problem,
                "leave `joint` out; a telescoping bar is a measured length",
            ));
        }
        if self.encoders.is_empty() || self.encoders.len() > MAX_ENCODERS {
            return Err(Violation::new(
                "encoders",
                format!("{} encoders are given", self.encoders.len()),
                "list one [[encoders]] block for each EL5021, one to five",
            ));
        }
        self.encoders
            .iter()
            .enumerate()
            .try_for_each(|(index, encoder)| self.validate_encoder(index, encoder))
    }
}
