//! Events on the bus besides the records: small, of fixed size, described outside the real-time thread.

use shared::recording::schema::{DeviceInfo, Event, EventKind, PortCounts, RunMetadata};
use shared::time::UtcNs;

use crate::bus::absent;
use crate::problem::{Fact, Problem, flag_names};

/// An event on the bus. `Copy`: it crosses a ring from the real-time thread.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CycleEvent {
    /// Time of the event.
    pub time: UtcNs,
    /// Cycle in which it happened.
    pub cycle: u64,
    /// Kind of the event, with its values.
    pub what: Happening,
}

/// Kinds of events with their values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Happening {
    /// Cycles without a valid sample ended.
    Gap {
        /// Number of the first.
        first: u64,
        /// Number of these cycles.
        cycles: u64,
        /// Reasons of the first, see `schema::flags`.
        cause: u32,
        /// Flags of all of them.
        flags: u32,
        /// Encoders that were invalid in the first, as bits in bus order.
        invalid: u8,
    },
    /// Terminals from a position on do not answer; those before it stay in use.
    Missing {
        /// Position on the bus.
        position: u8,
    },
    /// The bus is given up and will be brought up again.
    Down(Down),
    /// An attempt to bring the bus up failed.
    StaysDown {
        /// Code of its problem.
        code: &'static str,
    },
    /// The bus is in operation again.
    Up {
        /// Number of attempts that this took.
        attempts: u32,
    },
    /// A terminal went from OP to SAFE-OP; OP has been requested.
    FellToSafeOp {
        /// Position on the bus.
        position: u8,
        /// AL status code (ETG.1020).
        code: u16,
    },
    /// The reference clock jumped.
    ClockStep {
        /// Step of the clock \[ns\].
        by_ns: i64,
    },
    /// Counts may have a new origin from this cycle on.
    OriginChanged(Origin),
    /// A port counted errors.
    LinkErrors {
        /// Counts since the run began.
        counts: PortCounts,
        /// Reported as text; otherwise only the counts are stored.
        is_news: bool,
    },
}

/// Why the bus is given up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Down {
    /// No reply for so long that the terminals' clocks are unreliable.
    Silent,
    /// A terminal has lost its address or its configuration.
    DeviceLost,
    /// Several cycles in a row were bad.
    Bad {
        /// Flags of the last one, see `schema::flags`.
        flags: u32,
    },
    /// The reference clock jumped.
    ClockStep,
}

/// Evidence of a new origin of the counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// A device was without power.
    PoweredOff,
    /// The joint cannot have turned that far.
    Jumped {
        /// Bar joint, 1 to 5.
        joint: u8,
    },
    /// After the bus was brought up again the count is close to zero: the terminal may have restarted.
    NearZero {
        /// Bar joint, 1 to 5.
        joint: u8,
    },
}

impl CycleEvent {
    /// Whether it is reported as text; otherwise only its counts are stored.
    pub fn is_news(&self) -> bool {
        !matches!(self.what, Happening::LinkErrors { is_news: false, .. })
    }

    /// The counts of a port.
    pub fn port_counts(&self) -> Option<PortCounts> {
        let Happening::LinkErrors { counts, .. } = self.what else { return None };
        Some(counts)
    }

    /// The event as it is stored in the file.
    pub fn to_event(&self, bus: &BusNames) -> Event {
        let kind = match self.what {
            Happening::Gap { .. } => EventKind::Gap,
            Happening::ClockStep { .. } => EventKind::Clock,
            _ => EventKind::Bus,
        };
        // Its own text would have to be allocated in the real-time thread.
        if let Happening::StaysDown { code } = self.what {
            let text = "an attempt to bring the bus up failed; the log has the details".into();
            return Event { time: self.time, cycle: self.cycle, kind, text, code: code.into() };
        }
        let fact = self.what.fact(bus);
        let code = fact.code().to_owned();
        let text = match self.what {
            Happening::Gap { first, cycles, flags, .. } => format!(
                "{cycles} cycles from {first} on without valid samples: {}",
                flag_names(flags).join(", ")
            ),
            Happening::Down(_) => {
                format!("bus given up, to be brought up again: {}", Problem::from(fact).text)
            }
            Happening::FellToSafeOp { .. } => format!("{}; OP requested again", Problem::from(fact).text),
            _ => Problem::from(fact).text,
        };
        Event { time: self.time, cycle: self.cycle, kind, text, code }
    }
}

/// Names for the texts of events.
#[derive(Debug, Clone, Default)]
pub struct BusNames {
    /// Network interface, or `simulated`.
    pub bus: String,
    /// Devices in operation, in bus order.
    pub devices: Vec<DeviceInfo>,
    /// Joint of each encoder, in bus order.
    pub joints: Vec<u8>,
}

impl BusNames {
    /// From the metadata of a run.
    pub fn new(run: &RunMetadata) -> Self {
        let joints = run.encoders.iter().map(|encoder| encoder.joint).collect();
        Self { bus: run.bus.clone(), devices: run.devices.clone(), joints }
    }
}

impl Happening {
    fn fact(self, BusNames { bus, devices, joints }: &BusNames) -> Fact {
        match self {
            Self::Gap { cause, invalid, .. } => {
                let joints = joints.iter().enumerate().filter(|(index, _)| invalid >> index & 1 == 1);
                Fact::of_flags(cause, bus, joints.map(|(_, joint)| *joint).collect(), None)
            }
            Self::Missing { position } => absent(bus, devices, position.into()),
            Self::Down(why) => why.fact(bus),
            // Not used: `to_event` needs no fact for it.
            Self::StaysDown { .. } => Fact::BusStarting {},
            Self::Up { attempts } => Fact::BusRestored { attempts },
            Self::FellToSafeOp { position, code } => {
                Fact::BusNotOperational { position: Some(position.into()), al_status_code: Some(code) }
            }
            Self::ClockStep { by_ns } => Fact::BusClockJumped { by_ns: Some(by_ns) },
            Self::OriginChanged(how) => how.fact(),
            Self::LinkErrors { counts, .. } => counts.into(),
        }
    }
}

impl Down {
    /// The reason as it is reported.
    pub fn fact(self, bus: &str) -> Fact {
        match self {
            Self::Silent => Fact::BusNoAnswer { bus: bus.to_owned() },
            Self::DeviceLost => Fact::BusDeviceRestarted {},
            Self::Bad { flags } => Fact::of_flags(flags, bus, Vec::new(), None),
            Self::ClockStep => Fact::BusClockJumped { by_ns: None },
        }
    }
}

impl Origin {
    fn fact(self) -> Fact {
        let (joint, because) = match self {
            Self::PoweredOff => (None, "a device was without power".into()),
            Self::Jumped { joint } => (Some(joint), format!("joint {joint} cannot have turned that far")),
            Self::NearZero { joint } => {
                (Some(joint), format!("joint {joint} counts from near zero after the bus came up again"))
            }
        };
        Fact::CountsRestarted { joint, because }
    }
}
