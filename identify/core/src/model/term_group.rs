//! Kinds of errors that a robot or an instrument has or not.

use serde::{Deserialize, Serialize};

/// Kinds of errors that come together or not at all.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TermGroup {
    /// Robot axes once per turn.
    GearOnce,
    /// Robot axes twice per turn.
    GearTwice,
    /// Robot axes per lobe of their cycloid gears.
    Cycloid,
    /// Robot axes per turn of their motors.
    Motor,
    /// Joints that their drive does not turn alone, once and twice per turn of the joint.
    Joint,
    /// Robot axes by waves whose number per turn is found in what is left.
    LineSpectrum,
    /// Robot axes by the sign of their speed.
    Backlash,
    /// Gear ratios.
    Ratio,
    /// Axes that the log has later than others.
    Delay,
    /// Axes that deflect under weight.
    Compliance,
    /// Bar encoders once and twice per turn.
    EncoderHarmonics,
    /// The bar's length by its direction.
    BarLength,
}

impl TermGroup {
    /// Those of the robot.
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

    /// Name in reports.
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

    /// What its priors may be multiplied by. No gear is cut so that its ratio is off by a hundredth; what is configured wrong is, and
    /// is found only where it may be.
    pub const fn scales(self) -> &'static [f64] {
        match self {
            Self::Ratio => &[1.0, 10.0, 100.0],
            _ => &[1.0],
        }
    }
}
