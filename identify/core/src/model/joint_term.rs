//! What a robot's joint angle is wrong by, as far as it repeats with the motion.

use std::cmp::Ordering;
use std::fmt;

use super::{TermGroup, Unit};

/// How often a wave comes back while a drive's output makes one turn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Period {
    /// Once: an eccentric output gear or joint encoder.
    Once,
    /// Twice: an elliptic or tilted one.
    Twice,
    /// Once for each lobe of a cycloid gear; only where the robot's file has the number.
    Cycloid,
    /// Once for each turn of the motor; only where the robot's file has the ratio.
    Motor,
    /// Once while the joint itself makes a turn, not the drive: a bearing or an encoder of the joint; only where these differ.
    JointOnce,
    /// Twice, the same.
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

/// What pulls a joint out of place by its weight.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Load {
    /// The upper arm: a weight on axis 3.
    Elbow,
    /// The forearm: a weight where the wrist's axes meet.
    Wrist,
    /// The tool: a weight at the end of the chain.
    Tool,
}

impl Load {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Elbow, Self::Wrist, Self::Tool];

    /// Axes (from 0) of a six-axis arm on which a load can be identified: those that it moves up and down in most postures. Axis 1 stands
    /// upright, axis 4 points along the forearm, axis 6 along the tool.
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

/// One term of the error of a robot axis. A constant offset is the link's `theta` and has no term.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum JointTerm {
    /// `sin(n g)` of the drive's output angle `g`: `rsin1`, `rsin2`, `rsinc`, `rsinm`; or of the joint's: `rsinj1`, `rsinj2`.
    Sine(Period),
    /// `cos(n g)`
    Cosine(Period),
    /// Half of the lost motion, by the direction in which the drive turns: `rbacklash`.
    Backlash,
    /// The drive turns by another ratio than its file says: `rratio`.
    Ratio,
    /// The log has the axis later than the others by so much \[s\], as servo lag or a filter make it: `rdelay`.
    Delay,
    /// The axis deflects under a weight: `relbow`, `rwrist`, `rtool`.
    Compliance(Load),
}

impl JointTerm {
    /// All of them.
    pub const ALL: [Self; 18] = [
        Self::Sine(Period::Once),
        Self::Cosine(Period::Once),
        Self::Sine(Period::Twice),
        Self::Cosine(Period::Twice),
        Self::Sine(Period::Cycloid),
        Self::Cosine(Period::Cycloid),
        Self::Sine(Period::Motor),
        Self::Cosine(Period::Motor),
        Self::Sine(Period::JointOnce),
        Self::Cosine(Period::JointOnce),
        Self::Sine(Period::JointTwice),
        Self::Cosine(Period::JointTwice),
        Self::Backlash,
        Self::Ratio,
        Self::Delay,
        Self::Compliance(Load::Elbow),
        Self::Compliance(Load::Wrist),
        Self::Compliance(Load::Tool),
    ];

    /// Whether it moves the joint and goes by its angle, not by the drive's.
    pub const fn is_of_joint(self) -> bool {
        matches!(self, Self::Sine(period) | Self::Cosine(period) if matches!(period, Period::JointOnce | Period::JointTwice))
    }

    /// The kind of error that it is a part of.
    pub const fn group(self) -> TermGroup {
        match self {
            Self::Sine(period) | Self::Cosine(period) => match period {
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
            Self::Sine(_) | Self::Cosine(_) | Self::Backlash => Unit::Radian,
        }
    }

    /// Place in [`Self::ALL`].
    pub(super) const fn index(self) -> usize {
        match self {
            Self::Sine(period) => 2 * period as usize,
            Self::Cosine(period) => 2 * period as usize + 1,
            Self::Backlash => 12,
            Self::Ratio => 13,
            Self::Delay => 14,
            Self::Compliance(load) => 15 + load as usize,
        }
    }
}

impl Ord for JointTerm {
    fn cmp(&self, other: &Self) -> Ordering {
        self.index().cmp(&other.index())
    }
}

impl PartialOrd for JointTerm {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl fmt::Display for JointTerm {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Sine(period) => write!(f, "sin{}", period.letters()),
            Self::Cosine(period) => write!(f, "cos{}", period.letters()),
            Self::Backlash => f.write_str("backlash"),
            Self::Ratio => f.write_str("ratio"),
            Self::Delay => f.write_str("delay"),
            Self::Compliance(load) => f.write_str(load.name()),
        }
    }
}
