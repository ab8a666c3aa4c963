//! Groups of optional error terms of a robot or an instrument.

use serde::{Deserialize, Serialize};

/// Group of error terms that are included or omitted together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TermGroup {
    /// Errors of robot axes, once per turn of the drive.
    GearOnce,
    /// Errors of robot axes, twice per turn of the drive.
    GearTwice,
    /// Errors of robot axes, once per lobe of the cycloid gear.
    Cycloid,
    /// Errors of robot axes, once per motor turn.
    Motor,
    /// Errors of joints whose drives are coupled, once and twice per turn of the joint.
    Joint,
    /// Errors of robot axes at orders (waves per turn) that were found in the residuals.
    LineSpectrum,
    /// Errors of robot axes that change sign with the direction of motion.
    Backlash,
    /// Relative errors of gear ratios.
    Ratio,
    /// Delays of single axes in the log.
    Delay,
    /// Deflection of axes under weight.
    Compliance,
    /// Errors of bar encoders, once and twice per turn.
    EncoderHarmonics,
    /// Elongation of the bar as a function of its direction.
    BarLength,
}

impl TermGroup {
    /// The groups that belong to the robot.
    pub const OF_ROBOT: [Self; 10] = [
        Self::GearOnce,
        Self::GearTwice,
        Self::Cycloid,
        Self::Motor,
        Self::Joint,
        Self::LineSpectrum,
        Self::Backlash,
        Self::Ratio,
        Self::Delay,
        Self::Compliance,
    ];

    /// Name of the group in reports.
    pub const fn name(self) -> &'static str {
        match self {
            Self::GearOnce => "gear, once per turn",
            Self::GearTwice => "gear, twice per turn",
            Self::Cycloid => "gear, per cycloid lobe",
            Self::Motor => "gear, per motor turn",
            Self::Joint => "joint beside its drive, once and twice per turn",
            Self::LineSpectrum => "gear, at orders found in the residual",
            Self::Backlash => "backlash",
            Self::Ratio => "gear ratio",
            Self::Delay => "delay of single joints in the log",
            Self::Compliance => "compliance under gravity",
            Self::EncoderHarmonics => "bar encoders, once and twice per turn",
            Self::BarLength => "bar length by direction",
        }
    }

    /// Factors by which the prior standard deviations of the group may be multiplied. Manufacturing errors of a gear
    /// ratio are far below one percent. A wrong ratio in the configuration is a larger error. To find it, the prior
    /// must be made wide.
    pub const fn scales(self) -> &'static [f64] {
        match self {
            Self::Ratio => &[1.0, 10.0, 100.0],
            _ => &[1.0],
        }
    }
}
