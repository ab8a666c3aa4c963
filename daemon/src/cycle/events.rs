//! What the cycle has to say besides its records: small, fixed in size, put into words by whoever writes the file.

use shared::recording::schema::{Event, EventKind, PortCounts, flags};
use shared::time::UtcNs;

use super::links::PortErrors;

/// Something that happened on the bus. `Copy`: it crosses a ring from the real-time thread.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CycleEvent {
    /// When.
    pub time: UtcNs,
    /// During which cycle.
    pub cycle: u64,
    /// What.
    pub what: Happening,
}

/// What happened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Happening {
    /// Cycles without a valid sample ended.
    Gap {
        /// First of them.
        first: u64,
        /// How many.
        cycles: u64,
        /// Reasons, see [`flags`].
        flags: u32,
    },
    /// Terminals from a position on do not answer; those before stay in use.
    Missing {
        /// Position on the bus.
        position: u8,
    },
    /// The bus is given up and will be brought up again.
    Down(Down),
    /// The bus is in operation again.
    Up {
        /// Attempts that it took.
        attempts: u32,
    },
    /// A terminal left OP for SAFE-OP and was asked back.
    FellToSafeOp {
        /// Position on the bus.
        position: u8,
        /// AL status code (ETG.1020).
        code: u16,
    },
    /// The reference clock jumped.
    ClockStep {
        /// By this much.
        by_ns: i64,
    },
    /// Counts may have a new origin from this cycle on.
    OriginChanged(Origin),
    /// A port counted errors.
    LinkErrors {
        /// Position on the bus of its device.
        position: u8,
        /// Which of its ports.
        port: u8,
        /// Since the run began.
        errors: PortErrors,
        /// Worth words; otherwise only the figures go into the file.
        is_news: bool,
    },
}

/// Why the bus is given up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Down {
    /// No reply for so long that the terminals' clocks are no longer trusted.
    Silent,
    /// A terminal has lost its address or its configuration.
    DeviceLost,
    /// Cycle after cycle was bad.
    Bad {
        /// Reasons of the last one, see [`flags`].
        flags: u32,
    },
    /// The reference clock jumped.
    ClockStep,
}

/// How it is known that counts have a new origin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// A device was without power.
    PoweredOff,
    /// The joint cannot have turned that far.
    Jumped {
        /// Bar joint.
        joint: u8,
    },
    /// After the bus was brought up again the count is close to zero: the terminal may have started anew.
    NearZero {
        /// Bar joint.
        joint: u8,
    },
}

impl CycleEvent {
    /// Worth words; otherwise it only brings figures.
    pub fn is_news(&self) -> bool {
        !matches!(self.what, Happening::LinkErrors { is_news: false, .. })
    }

    /// What a port has counted.
    pub fn port_counts(&self) -> Option<PortCounts> {
        let Happening::LinkErrors { position, port, errors, .. } = self.what else { return None };
        let PortErrors { invalid_frames, receive_errors, lost_links } = errors;
        Some(PortCounts { position, port, invalid_frames, receive_errors, lost_links })
    }

    /// As the file tells it.
    pub fn to_event(&self) -> Event {
        let kind = match self.what {
            Happening::Gap { .. } => EventKind::Gap,
            Happening::ClockStep { .. } => EventKind::Clock,
            _ => EventKind::Bus,
        };
        Event { time: self.time, cycle: self.cycle, kind, text: self.what.text() }
    }
}

impl Happening {
    fn text(&self) -> String {
        match *self {
            Self::Gap { first, cycles, flags } => {
                format!("{cycles} cycles from {first} on without valid samples: {}", names(flags))
            }
            Self::Missing { position } => format!(
                "devices from position {position} on do not answer; the others stay in use until all are there"
            ),
            Self::Down(why) => format!("bus given up, to be brought up again: {}", why.text()),
            Self::Up { attempts: 1 } => "bus in operation again".into(),
            Self::Up { attempts } => format!("bus in operation again, after {attempts} attempts"),
            Self::FellToSafeOp { position, code } => format!(
                "device at position {position} fell to SAFE-OP, AL status code {code:#06x}; asked back to OP"
            ),
            Self::ClockStep { by_ns } => {
                format!("the reference clock jumped by {:.3} ms", by_ns as f64 * 1e-6)
            }
            Self::OriginChanged(how) => format!("counts may have a new origin: {}", how.text()),
            Self::LinkErrors { position, port, errors, .. } => {
                link_errors(position.into(), port.into(), errors)
            }
        }
    }
}

impl Down {
    fn text(self) -> String {
        match self {
            Self::Silent => "no reply for a second".into(),
            Self::DeviceLost => "a device has lost its address or configuration".into(),
            Self::Bad { flags } => format!("one bad cycle after the other ({})", names(flags)),
            Self::ClockStep => "the reference clock jumped".into(),
        }
    }
}

impl Origin {
    fn text(self) -> String {
        match self {
            Self::PoweredOff => "a device was without power".into(),
            Self::Jumped { joint } => format!("joint {joint} cannot have turned that far meanwhile"),
            Self::NearZero { joint } => {
                format!("joint {joint} counts from near zero after the bus came up again")
            }
        }
    }
}

/// Which cable or plug is bad, and how that is known.
pub fn link_errors(position: usize, port: usize, errors: PortErrors) -> String {
    let PortErrors { invalid_frames, receive_errors, lost_links } = errors;
    let cable = match (position, port) {
        (0, 0) => "between this PC and the coupler".to_owned(),
        (_, 0) => format!("between devices {} and {position}", position - 1),
        _ => format!("behind device {position}"),
    };
    format!(
        "bad cable or plug {cable}: port {port} of device {position} has counted {receive_errors} receive errors, \
         {invalid_frames} invalid frames and {lost_links} lost links"
    )
}

fn names(set: u32) -> String {
    let names: Vec<&str> =
        flags::NAMES.iter().filter(|(bit, _)| set & bit != 0).map(|(_, name)| *name).collect();
    names.join(", ")
}
