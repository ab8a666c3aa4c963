//! Events on the bus, which are reported in addition to the records. They are small and have a fixed size, because they pass
//! through a ring from the real-time thread. Their texts are built outside that thread.

use shared::recording::schema::{DeviceInfo, Event, EventKind, PortCounts, RunMetadata};
use shared::time::UtcNs;

use crate::bus::absent;
use crate::problem::{Fact, Problem, flag_names, numbers};

/// An event on the bus. It is `Copy`, because it passes through a ring from the real-time thread.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CycleEvent {
    /// Time of the event.
    pub time: UtcNs,
    /// Cycle in which it happened.
    pub cycle: u64,
    /// Kind of the event, with its values.
    pub what: Happening,
}

/// The kinds of events, with their values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Happening {
    /// A period of cycles without valid samples has ended.
    Gap {
        /// Number of the first of these cycles.
        first: u64,
        /// Number of these cycles.
        cycles: u64,
        /// Flags of the first of these cycles, see `schema::flags`. They show the cause of the gap. Flags that every record of
        /// the bus has are omitted here and in `flags`.
        cause: u32,
        /// Flags that at least one of these cycles has.
        flags: u32,
        /// Encoders that were invalid in at least one of these cycles, one bit each in bus order.
        invalid: u8,
    },
    /// The terminals from a position on do not answer. The terminals before it stay in use.
    Missing {
        /// First position on the bus that does not answer.
        position: u8,
    },
    /// The bus was given up: its cycle has stopped, and it will be brought up again. The value is the reason.
    Down(Down),
    /// An attempt to bring the bus up failed.
    StaysDown {
        /// Code of the problem.
        code: &'static str,
    },
    /// The bus is in operation again.
    Up {
        /// Number of attempts to bring it up.
        attempts: u32,
    },
    /// A terminal changed from OP to SAFE-OP. The daemon has requested OP again.
    FellToSafeOp {
        /// Position on the bus.
        position: u8,
        /// AL status code (ETG.1020).
        code: u16,
    },
    /// The reference clock stepped.
    ClockStep {
        /// Step of the clock \[ns\].
        by_ns: i64,
    },
    /// The counts may have a new origin from this cycle on.
    OriginChanged(Origin),
    /// A port has counted errors.
    LinkErrors {
        /// Error counts of the port since the run began.
        counts: PortCounts,
        /// Whether the event gets a text in recording and log. If not, only the counts are stored.
        is_news: bool,
    },
}

/// Why the bus was given up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Down {
    /// No reply arrived for so long that the clocks of the terminals are unreliable.
    Silent,
    /// A terminal has lost its address or its configuration, or does not answer.
    DeviceLost,
    /// Too many consecutive cycles were bad.
    Bad {
        /// Flags of the last of these cycles, see `schema::flags`.
        flags: u32,
    },
    /// The reference clock stepped.
    ClockStep,
}

/// Why the counts may have a new origin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// A device was without power.
    PoweredOff,
    /// The count changed by more than the joint can have turned.
    Jumped {
        /// Bar joint, 1 to 5.
        joint: u8,
    },
    /// The count is close to zero after the bus was brought up again, so the terminal may have restarted.
    NearZero {
        /// Bar joint, 1 to 5.
        joint: u8,
    },
}

impl CycleEvent {
    /// Whether the event gets a text in recording and log. If not, only its counts are stored.
    pub fn is_news(&self) -> bool {
        !matches!(self.what, Happening::LinkErrors { is_news: false, .. })
    }

    /// The error counts of a port, if the event contains such counts.
    pub fn port_counts(&self) -> Option<PortCounts> {
        let Happening::LinkErrors { counts, .. } = self.what else { return None };
        Some(counts)
    }

    /// Converts the event to the form in which the file stores it.
    pub fn to_event(&self, bus: &BusNames) -> Event {
        let kind = match self.what {
            Happening::Gap { .. } => EventKind::Gap,
            Happening::ClockStep { .. } => EventKind::Clock,
            _ => EventKind::Bus,
        };
        // The text is built from the code alone. The text of the original error would have to be
        // allocated in the real-time thread.
        if let Happening::StaysDown { code } = self.what {
            let text = "an attempt to bring the bus up failed; the log has the details".into();
            return Event { time: self.time, cycle: self.cycle, kind, text, code: code.into() };
        }
        let fact = self.what.fact(bus);
        let code = fact.code().to_owned();
        let text = match self.what {
            Happening::Gap { first, cycles, flags, invalid, .. } => {
                let joints = bus.joints_of(invalid);
                let some = format!(" of joint {}", numbers(&joints));
                let which = if joints.len() < bus.joints.len() { some.as_str() } else { "" };
                let reasons = flag_names(flags).join(", ");
                format!("{cycles} cycles from {first} on without valid samples{which}: {reasons}")
            }
            Happening::Down(_) => {
                format!("bus given up, to be brought up again: {}", Problem::from(fact).text)
            }
            Happening::FellToSafeOp { .. } => format!("{}; OP requested again", Problem::from(fact).text),
            _ => Problem::from(fact).text,
        };
        Event { time: self.time, cycle: self.cycle, kind, text, code }
    }
}

/// Names that the texts of events contain.
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
    /// The names in the metadata of a run.
    pub fn new(run: &RunMetadata) -> Self {
        let joints = run.encoders.iter().map(|encoder| encoder.joint).collect();
        Self { bus: run.bus.clone(), devices: run.devices.clone(), joints }
    }

    /// Joints of a set of encoders, which has one bit for each encoder in bus order.
    fn joints_of(&self, encoders: u8) -> Vec<u8> {
        let joints = self.joints.iter().enumerate().filter(|(index, _)| encoders >> index & 1 == 1);
        joints.map(|(_, joint)| *joint).collect()
    }
}

impl Happening {
    fn fact(self, names: &BusNames) -> Fact {
        let BusNames { bus, devices, .. } = names;
        match self {
            Self::Gap { cause, invalid, .. } => Fact::of_flags(cause, bus, names.joints_of(invalid), None),
            Self::Missing { position } => absent(bus, devices, position.into()),
            Self::Down(why) => why.fact(bus),
            // This arm is never reached, because `to_event` handles this event itself.
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
    /// The reason in the form in which it is reported.
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
