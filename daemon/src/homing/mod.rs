//! Homing: finds each encoder's reference mark while a person turns one joint at a time.
//!
//! The angle of an incremental encoder is known only from its reference mark (C), where the terminal latches its counter.
//! Turning one joint at a time also shows which terminal its encoder is connected to, and its direction. The mark is taken in
//! the direction in which the joint is to be turned: it is one signal period wide (0.1 degrees at 3600 lines), so its two
//! flanks differ.
//!
//! [`Sequence`] determines the actual encoders and marks; [`verify`] compares them with the configuration.

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
/// Time limit without valid counts \[s\].
const SIGNAL_LOST_MAX_S: f64 = 1.0;

/// Why a joint could not be homed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum HomingError {
    /// Several joints moved at once.
    #[error(
        "while joint {asked} was to be turned, the encoders of terminals {0} and {1} moved together; hold the other \
         joints and home again, turning joint {asked} alone", terminals[0], terminals[1]
    )]
    Together {
        /// Joint to be turned.
        asked: u8,
        /// Terminals counted from 1 behind the coupler.
        terminals: [usize; 2],
    },
    /// The encoder that moved belongs to a joint that is finished.
    #[error(
        "while joint {asked} was to be turned, the encoder of terminal {terminal} moved, which is that of joint \
         {joint}; home again, and turn the requested joint"
    )]
    Again {
        /// Joint to be turned.
        asked: u8,
        /// Terminal, counted from 1 behind the coupler.
        terminal: usize,
        /// Joint that the terminal belongs to.
        joint: u8,
    },
    /// No mark within the time limit.
    #[error(
        "joint {joint} turned by {turned_deg:.0} degrees in {PATIENCE_S} s without a reference mark; check the C wires of its \
         terminal, then home again and turn it over its mark, or by a whole turn"
    )]
    NoMark {
        /// Bar joint, 1 to 5.
        joint: u8,
        /// Angle by which it was turned \[deg\].
        turned_deg: f64,
    },
    /// The joint has not passed the latched count.
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
    /// The terminals or the bus give no counts.
    #[error(
        "no valid counts for {SIGNAL_LOST_MAX_S} s while joint {0} was to be turned; `ballbard check` names the \
         encoder or device"
    )]
    NoSignal(u8),
    /// The homing was cancelled.
    #[error("stopped before all joints were homed: {0}; nothing was written")]
    Stopped(String),
    /// The file of the marks cannot be written.
    #[error("the marks of all joints were found, but not saved: {0}; then home again")]
    NotKept(String),
    /// Order or direction differ from the configuration.
    #[error(transparent)]
    Miswired(#[from] Miswired),
}

/// The encoder of a joint, and its mark.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FoundMark {
    /// Joint that was turned.
    pub joint: u8,
    /// The encoder that moved, in bus order from 0.
    pub encoder: usize,
    /// Counts increase in the direction in which the joint was turned.
    pub counts_rise: bool,
    /// Count at its reference mark.
    pub reference_counts: u32,
}

/// Progress of a homing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum HomingStep {
    /// Turn this joint, in its positive direction and alone, over its reference mark.
    Turn {
        /// Bar joint, 1 to 5.
        joint: u8,
        /// Configured encoder of the joint, in bus order from 0.
        encoder: usize,
    },
    /// Progress, twice a second.
    Turning {
        /// Joint to be turned.
        joint: u8,
        /// Largest angle of any encoder; positive if its counts increase \[rad\].
        turned_rad: f64,
    },
    /// The mark of a joint was found.
    Found(FoundMark),
}

impl HomingStep {
    /// An instruction or a result as text; `None` for progress.
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
