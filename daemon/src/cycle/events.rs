//! What happens on the bus besides the records: small, fixed in size, described outside the real-time thread.

use shared::recording::schema::{DeviceInfo, Event, EventKind, PortCounts, RunMetadata};
use shared::time::UtcNs;

use crate::bus::absent;
use crate::problem::{Fact, Problem, flag_names};

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
        /// Reasons of the first, see `schema::flags`.
        cause: u32,
        /// Reasons of all these cycles.
        flags: u32,
        /// Bit of each encoder, in bus order, that was not valid in the first.
        invalid: u8,
    },
    /// Terminals from a position on do not answer; those before stay in use.
    Missing {
        /// Position on the bus.
        position: u8,
    },
    /// The bus is given up and will be brought up again.
    Down(Down),
    /// An attempt to bring the bus up failed.
    StaysDown {
        /// Code of the problem that it met.
        code: &'static str,
    },
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
        /// Since the run began.
        counts: PortCounts,
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
        /// Reasons of the last one, see `schema::flags`.
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
        let Happening::LinkErrors { counts, .. } = self.what else { return None };
        Some(counts)
    }

    /// As it is in the file.
    pub fn to_event(&self, bus: &BusNames) -> Event {
        let kind = match self.what {
            Happening::Gap { .. } => EventKind::Gap,
            Happening::ClockStep { .. } => EventKind::Clock,
            _ => EventKind::Bus,
        };
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
            Happening::FellToSafeOp { .. } => format!("{}; asked back to OP", Problem::from(fact).text),
            _ => Problem::from(fact).text,
        };
        Event { time: self.time, cycle: self.cycle, kind, text, code }
    }
}

/// Names that events need.
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
    /// Of the bus of this run.
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
    /// As it is reported.
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
