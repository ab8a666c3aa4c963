//! Homing: finds the reference mark of each encoder while a person turns one joint at a time.
//!
//! An incremental encoder has a known angle only relative to its reference mark (C). When the mark passes, the terminal
//! latches its counter. Only one joint is turned at a time. Homing therefore also determines to which terminal the encoder
//! of this joint is connected, and whether counts rise or fall. The mark is one signal period wide (0.1 degrees at 3600
//! lines), so the latched count depends on the direction. Only a mark that was passed in the requested direction is used.
//!
//! [`Sequence`] determines the encoders and marks. [`verify`] compares them with the configuration.

mod file;
mod search;
mod sequence;
mod wiring;

pub use file::MarksFile;
pub use sequence::{HomingResult, Sequence};
pub use wiring::{Miswired, verify};

use shared::config::bar_joint_name;

/// Time limit for each joint \[s\].
pub const PATIENCE_S: f64 = 120.0;
/// Longest time without valid counts \[s\].
const SIGNAL_LOST_MAX_S: f64 = 1.0;

/// Why a joint could not be homed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum HomingError {
    /// Two joints moved at the same time.
    #[error(
        "while joint {asked} was to be turned, the encoders of terminals {0} and {1} moved together; hold the other \
         joints and home again, turning joint {asked} alone", terminals[0], terminals[1]
    )]
    Together {
        /// Joint that was to be turned.
        asked: u8,
        /// Numbers of the terminals whose encoders moved, counted from 1 after the coupler.
        terminals: [usize; 2],
    },
    /// The encoder that moved belongs to another joint, whose mark was already found.
    #[error(
        "while joint {asked} was to be turned, the encoder of terminal {terminal} moved, which is that of joint \
         {joint}; home again, and turn the requested joint"
    )]
    Again {
        /// Joint that was to be turned.
        asked: u8,
        /// Number of the terminal whose encoder moved, counted from 1 after the coupler.
        terminal: usize,
        /// Joint of that encoder.
        joint: u8,
    },
    /// No reference mark was found within the time limit.
    #[error(
        "joint {joint} turned by {turned_deg:.0} degrees in {PATIENCE_S} s without a reference mark; check the C wires of its \
         terminal, then home again and turn it over its mark, or by a whole turn"
    )]
    NoMark {
        /// Bar joint, 1 to 5.
        joint: u8,
        /// Angle by which the joint was turned \[deg\].
        turned_deg: f64,
    },
    /// The terminal latched a count that the joint has not passed.
    #[error(
        "the terminal of joint {joint} latched count {latch}, which the joint never passed; check the C wires, then \
         home again"
    )]
    Implausible {
        /// Bar joint, 1 to 5.
        joint: u8,
        /// Count that the terminal latched.
        latch: u32,
    },
    /// The bus failed, or no valid counts arrived for too long.
    #[error(
        "the bus failed, or sent no valid counts for {SIGNAL_LOST_MAX_S} s, while joint {0} was to be turned; \
         `ballbard check` names the encoder or device; then home again"
    )]
    NoSignal(u8),
    /// The homing was cancelled.
    #[error("stopped before all joints were homed: {0}; nothing was written")]
    Stopped(String),
    /// The file with the marks could not be written.
    #[error("the marks of all joints were found, but not saved: {0}; then home again")]
    NotKept(String),
    /// Order or direction of the encoders differ from the configuration.
    #[error(transparent)]
    Miswired(#[from] Miswired),
}

/// The mark that was found for a joint, with the encoder of this joint and the direction of its counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FoundMark {
    /// Joint that was turned.
    pub joint: u8,
    /// Number of the encoder that moved, in bus order from 0.
    pub encoder: usize,
    /// Whether counts increased when the joint was turned in the requested direction.
    pub counts_rise: bool,
    /// Count at the reference mark.
    pub reference_counts: u32,
}

/// A step of a homing, for display.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum HomingStep {
    /// This joint must now be turned in its positive direction over its reference mark. All other joints must rest.
    Turn {
        /// Bar joint, 1 to 5.
        joint: u8,
        /// Number of the configured encoder of the joint, in bus order from 0.
        encoder: usize,
    },
    /// Progress, twice per second.
    Turning {
        /// Joint that must be turned.
        joint: u8,
        /// Angle of the encoder that has turned farthest \[rad\]. Positive if its counts have increased.
        turned_rad: f64,
    },
    /// The mark of a joint was found.
    Found(FoundMark),
}

impl HomingStep {
    /// Text of an instruction or a result. `None` for progress.
    pub fn line(self) -> Option<String> {
        match self {
            Self::Turn { joint, .. } => Some(format!(
                "joint {joint} ({}): hold the other joints and turn it slowly in its positive direction, by 5 degrees or more, \
                 until its reference mark is found",
                bar_joint_name(joint)
            )),
            Self::Turning { .. } => None,
            Self::Found(FoundMark { joint, encoder, counts_rise, reference_counts }) => {
                let way = if counts_rise { "up" } else { "down" };
                let terminal = encoder + 1;
                Some(format!(
                    "joint {joint}: on terminal {terminal}, counts {way}, mark at count {reference_counts}"
                ))
            }
        }
    }
}
