//! Homing: each encoder's reference mark, found while a person turns one joint at a time.
//!
//! An incremental encoder knows its angle only from its reference mark (C). The terminal latches its counter there.
//! Turning one joint at a time shows at once which terminal its encoder is wired to, and which way it counts. The mark is
//! taken in the direction in which the joint is asked to be turned: it is one signal period wide (0.1 degrees at 3600
//! lines), and its two flanks are not the same place.
//!
//! [`Sequence`] finds what is there, whatever the configuration says; [`verify`] compares the two.

mod file;
mod search;
mod sequence;
mod wiring;

pub use file::MarksFile;
pub use sequence::{Outcome, Sequence};
pub use wiring::{Miswired, verify};

use shared::config::bar_joint_name;

/// How long a joint may take \[s\].
pub const PATIENCE_S: f64 = 120.0;
/// How long an encoder may be without a signal \[s\].
const SIGNAL_LOST_MAX_S: f64 = 1.0;

/// Why a joint could not be homed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum HomingError {
    /// Several moved.
    #[error(
        "while joint {asked} was to be turned, the encoders of terminals {0} and {1} moved together; hold the other \
         joints and home again, turning joint {asked} alone", terminals[0], terminals[1]
    )]
    Together {
        /// Joint asked for.
        asked: u8,
        /// Terminals counted from 1 behind the coupler.
        terminals: [usize; 2],
    },
    /// The encoder that moved belongs to another joint.
    #[error(
        "while joint {asked} was to be turned, the encoder of terminal {terminal} moved, which is that of joint \
         {joint}; home again, and turn the joint that is asked for"
    )]
    Again {
        /// Joint asked for.
        asked: u8,
        /// Terminal, counted from 1 behind the coupler.
        terminal: usize,
        /// Joint that was found on it.
        joint: u8,
    },
    /// No mark within the time.
    #[error(
        "no reference mark within {PATIENCE_S} s of joint {joint}, which turned {turned_deg:.0} degrees; turn it a whole \
         revolution or over the place of its mark, and check the C wires of its terminal"
    )]
    NoMark {
        /// Joint.
        joint: u8,
        /// How far it was turned \[deg\].
        turned_deg: f64,
    },
    /// The latched count is none that the joint passed.
    #[error(
        "the terminal of joint {joint} latched count {latch}, which the joint never passed; check the C wires, then \
         home again"
    )]
    Implausible {
        /// Joint.
        joint: u8,
        /// What was latched.
        latch: u32,
    },
    /// The terminals or the bus give no counts.
    #[error(
        "no valid counts for {SIGNAL_LOST_MAX_S} s while joint {0} was to be turned; `ballbard check` says which \
         encoder or device it is"
    )]
    NoSignal(u8),
    /// Asked to stop.
    #[error("stopped before all joints were homed: {0}; nothing was written")]
    Stopped(String),
    /// The file of the marks cannot be written.
    #[error("the marks of all joints were found, but not kept: {0}; then home again")]
    NotKept(String),
    /// The order or a direction is not that of the configuration.
    #[error(transparent)]
    Miswired(#[from] Miswired),
}

/// A joint's encoder and its mark.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Found {
    /// Joint that was turned.
    pub joint: u8,
    /// The encoder that moved, in bus order from 0.
    pub encoder: usize,
    /// Counts rise with the direction in which the joint was turned.
    pub counts_rise: bool,
    /// Count at its reference mark.
    pub reference_counts: u32,
}

/// How far homing is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum HomingStep {
    /// Turn this joint, in its positive direction and alone, over its reference mark.
    Turn {
        /// Joint.
        joint: u8,
        /// Where the configuration has its encoder, in bus order from 0.
        encoder: usize,
    },
    /// Twice a second.
    Turning {
        /// Joint that is to be turned.
        joint: u8,
        /// How far the encoder that moves most has turned; positive where its counts rise \[rad\].
        turned_rad: f64,
    },
    /// A joint's mark was found.
    Found(Found),
}

impl HomingStep {
    /// An instruction for a person, or what was found; none for progress.
    pub fn line(self) -> Option<String> {
        match self {
            Self::Turn { joint, .. } => Some(format!(
                "joint {joint} ({}): turn it slowly in its positive direction, alone, by 5 degrees or more and over its \
                 reference mark",
                bar_joint_name(joint)
            )),
            Self::Turning { .. } => None,
            Self::Found(Found { joint, encoder, counts_rise, reference_counts }) => {
                let way = if counts_rise { "up" } else { "down" };
                let terminal = encoder + 1;
                Some(format!(
                    "joint {joint}: on terminal {terminal}, counts {way}, mark at count {reference_counts}"
                ))
            }
        }
    }
}
