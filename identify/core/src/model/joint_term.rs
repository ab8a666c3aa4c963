//! Error terms of a robot axis, in addition to the parameters of its link.

use std::fmt;

use super::{Phase, TermGroup, Unit};

/// Number of waves per turn of a drive's output.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Period {
    /// Once per turn, as from an eccentric output gear or joint encoder.
    Once,
    /// Twice per turn, as from an elliptic or tilted gear or encoder.
    Twice,
    /// Once per lobe of a cycloid gear. Only available if the robot's file contains the number of lobes.
    Cycloid,
    /// Once per motor turn. Only available if the gear ratio is known.
    Motor,
    /// Once per turn of the joint rather than of the drive, as from a bearing or encoder of the joint. Only available
    /// if drives are coupled.
    JointOnce,
    /// Twice per turn of the joint. See [`Self::JointOnce`] for causes and condition.
    JointTwice,
}

impl Period {
    const fn letters(self) -> &'static str {
        match self {
            Self::Once => "1",
            Self::Twice => "2",
            Self::Cycloid => "c",
            Self::Motor => "m",
            Self::JointOnce => "j1",
            Self::JointTwice => "j2",
        }
    }
}

/// The mass whose weight deflects a joint.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Load {
    /// The upper arm, modelled as a weight on axis 3.
    Elbow,
    /// The forearm, modelled as a weight at the point where the wrist's axes meet.
    Wrist,
    /// The tool, modelled as a weight at the end of the chain.
    Tool,
}

impl Load {
    /// All loads, from elbow to tool.
    pub const ALL: [Self; 3] = [Self::Elbow, Self::Wrist, Self::Tool];

    /// Whether the compliance of an axis (from 0) of a six-axis arm can be identified under this load. The axis must raise
    /// and lower the load in most postures. The first axis does not, because it is vertical. The fourth and sixth axes do
    /// not, because they point along the forearm and along the tool.
    pub const fn acts_on(self, axis: usize) -> bool {
        matches!((self, axis), (Self::Elbow, 1) | (Self::Wrist, 1 | 2) | (Self::Tool, 1 | 2 | 4))
    }

    const fn name(self) -> &'static str {
        match self {
            Self::Elbow => "elbow",
            Self::Wrist => "wrist",
            Self::Tool => "tool",
        }
    }
}

/// One error term of a robot axis; the variants are in the order of reports. A constant offset is not among the terms,
/// because the link parameter `theta` represents it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum JointTerm {
    /// `sin(n g)` or `cos(n g)` of the drive's output angle `g`: `rsin1`, `rcos1`, `rsin2`, `rsinc`, `rsinm`. For waves of
    /// the joint, the sine or cosine of multiples of the joint angle: `rsinj1`, `rsinj2`.
    Wave(Period, Phase),
    /// Half of the lost motion, with the sign of the drive's speed: `rbacklash`.
    Backlash,
    /// Relative error of the gear ratio in the robot's file: `rratio`.
    Ratio,
    /// Delay of this axis in the log relative to the other axes \[s\], caused by servo lag or a filter: `rdelay`.
    Delay,
    /// Deflection of the axis under a weight: `relbow`, `rwrist`, `rtool`.
    Compliance(Load),
}

impl JointTerm {
    /// All terms, in the order of reports.
    pub const ALL: [Self; 18] = [
        Self::Wave(Period::Once, Phase::Sine),
        Self::Wave(Period::Once, Phase::Cosine),
        Self::Wave(Period::Twice, Phase::Sine),
        Self::Wave(Period::Twice, Phase::Cosine),
        Self::Wave(Period::Cycloid, Phase::Sine),
        Self::Wave(Period::Cycloid, Phase::Cosine),
        Self::Wave(Period::Motor, Phase::Sine),
        Self::Wave(Period::Motor, Phase::Cosine),
        Self::Wave(Period::JointOnce, Phase::Sine),
        Self::Wave(Period::JointOnce, Phase::Cosine),
        Self::Wave(Period::JointTwice, Phase::Sine),
        Self::Wave(Period::JointTwice, Phase::Cosine),
        Self::Backlash,
        Self::Ratio,
        Self::Delay,
        Self::Compliance(Load::Elbow),
        Self::Compliance(Load::Wrist),
        Self::Compliance(Load::Tool),
    ];

    /// Whether the term is a function of the joint angle and moves only this joint. Other terms are functions
    /// of the drive angle.
    pub const fn is_of_joint(self) -> bool {
        matches!(self, Self::Wave(Period::JointOnce | Period::JointTwice, _))
    }

    /// The group to which the term belongs.
    pub const fn group(self) -> TermGroup {
        match self {
            Self::Wave(period, _) => match period {
                Period::Once => TermGroup::GearOnce,
                Period::Twice => TermGroup::GearTwice,
                Period::Cycloid => TermGroup::Cycloid,
                Period::Motor => TermGroup::Motor,
                Period::JointOnce | Period::JointTwice => TermGroup::Joint,
            },
            Self::Backlash => TermGroup::Backlash,
            Self::Ratio => TermGroup::Ratio,
            Self::Delay => TermGroup::Delay,
            Self::Compliance(_) => TermGroup::Compliance,
        }
    }

    pub(super) const fn unit(self) -> Unit {
        match self {
            Self::Ratio => Unit::Ratio,
            Self::Delay => Unit::Second,
            Self::Compliance(_) => Unit::RadianPerMetre,
            Self::Wave(..) | Self::Backlash => Unit::Radian,
        }
    }
}

impl fmt::Display for JointTerm {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Wave(period, phase) => write!(f, "{phase}{}", period.letters()),
            Self::Backlash => f.write_str("backlash"),
            Self::Ratio => f.write_str("ratio"),
            Self::Delay => f.write_str("delay"),
            Self::Compliance(load) => f.write_str(load.name()),
        }
    }
}
