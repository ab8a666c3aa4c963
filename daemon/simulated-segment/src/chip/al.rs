//! State machine of the application layer (AL) of a chip (ETG.1000.6 section 6.4.1). Its states are INIT, PRE-OP, SAFE-OP
//! and OP. The master requests a state. After about 2 ms, the chip enters or refuses this state. The decision depends on the
//! [`Readiness`] of the chip's units.

/// State of the application layer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum AlState {
    /// No communication on the application layer.
    Init = 1,
    /// The mailbox works, without process data.
    PreOp = 2,
    /// Inputs are valid. Outputs are ignored, the device is in its safe state.
    SafeOp = 4,
    /// Inputs and outputs are valid.
    Op = 8,
}

/// Why a transition was refused (ETG.1020 table "AL status codes").
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u16)]
pub enum AlStatusCode {
    /// The state machine has no transition from the current state to the requested one.
    InvalidRequestedStateChange = 0x0011,
    /// The requested state does not exist.
    UnknownRequestedState = 0x0012,
    /// The device has no bootstrap state.
    BootstrapNotSupported = 0x0013,
    /// Sync manager 0 or 1 has wrong settings.
    InvalidMailboxConfiguration = 0x0016,
    /// No outputs have arrived since PRE-OP.
    NoValidOutputs = 0x0019,
    /// Sync manager 2 has wrong settings.
    InvalidOutputConfiguration = 0x001d,
    /// Sync manager 3 has wrong settings.
    InvalidInputConfiguration = 0x001e,
    /// The device cannot use the settings of the sync signals.
    FatalSyncError = 0x002c,
    /// No sync signal arrived.
    NoSyncError = 0x002d,
    /// The distributed clock registers have wrong settings.
    InvalidDcSyncConfiguration = 0x0030,
}

/// State of the sync signals SYNC0 and SYNC1 of the distributed clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SyncReadiness {
    /// SYNC0 is not activated, so frames start the conversions of the device.
    Off,
    /// Activated with settings that the device cannot use.
    Invalid,
    /// The cycle of SYNC1 is zero, or is not shorter than the cycle of SYNC0.
    WrongSync1,
    /// Activated, but there has been no pulse yet.
    Waiting,
    /// Activated, and there has been at least one SYNC0 pulse.
    Running,
}

/// State of the units on which a transition depends.
#[derive(Debug, Clone, Copy)]
pub struct Readiness {
    /// Whether both mailbox sync managers have the expected settings.
    pub mailbox: bool,
    /// Whether the output sync manager has the expected settings.
    pub outputs: bool,
    /// Whether the input sync manager has the expected settings.
    pub inputs: bool,
    /// State of the sync signals.
    pub sync: SyncReadiness,
    /// Whether outputs have arrived since PRE-OP.
    pub outputs_received: bool,
}

const STATE_MASK: u8 = 0x0f;
const ERROR: u8 = 0x10;
const BOOTSTRAP: u8 = 3;
/// Approximate time that the firmware of a device needs for a transition.
const TRANSITION_NS: i64 = 2_000_000;
/// Time for which a device waits for outputs and sync pulses before it refuses OP.
const PATIENCE_NS: i64 = 2_000_000_000;

/// A transition that the master has requested.
#[derive(Clone, Copy)]
struct AlRequest {
    target: AlState,
    /// Time at which the transition is first decided.
    due_ns: i64,
    /// Time at which the transition is refused if its conditions are still not met.
    deadline_ns: i64,
}

enum AlDecision {
    Enter,
    /// The conditions are not met yet. If they are still not met at the deadline, the transition is refused with this code.
    Wait(AlStatusCode),
    Refuse(AlStatusCode),
}

/// State machine of one chip.
pub struct AlMachine {
    /// AL status of a chip without a processor, which is always the last status that the master requested (AL control).
    /// `None` for a chip with a processor.
    emulated: Option<u8>,
    state: AlState,
    /// AL status code. `None` if the error bit is not set.
    error: Option<u16>,
    pending: Option<AlRequest>,
}

impl AlMachine {
    /// A chip without a processor ("device emulation"). Its status is always the requested one.
    pub fn emulated() -> Self {
        Self { emulated: Some(AlState::Init as u8), ..Self::firmware() }
    }

    /// A chip with a processor, whose firmware checks requests.
    pub fn firmware() -> Self {
        Self { emulated: None, state: AlState::Init, error: None, pending: None }
    }

    pub fn state(&self) -> AlState {
        self.state
    }

    /// Values of the registers AL status (0x0130) and AL status code (0x0134).
    pub fn registers(&self) -> (u8, u16) {
        match (self.emulated, self.error) {
            (Some(mirrored), _) => (mirrored, 0),
            (None, Some(code)) => (self.state as u8 | ERROR, code),
            (None, None) => (self.state as u8, 0),
        }
    }

    /// Handles a write of a master to AL control (0x0120).
    pub fn request(&mut self, control: u8, now_ns: i64) {
        if let Some(mirrored) = &mut self.emulated {
            *mirrored = control & (STATE_MASK | ERROR);
            return;
        }
        if self.error.is_some() && control & ERROR == 0 {
            return; // an error must be acknowledged first
        }
        self.error = None;
        self.pending = None;
        match target(control & STATE_MASK) {
            Ok(target) => {
                let due_ns = now_ns.saturating_add(TRANSITION_NS);
                let deadline_ns = due_ns.saturating_add(PATIENCE_NS);
                self.pending = Some(AlRequest { target, due_ns, deadline_ns });
            }
            Err(code) => self.error = Some(code as u16),
        }
    }

    /// Changes the state from OP to SAFE-OP with this AL status code. Has no effect in other states, or on
    /// a chip without a processor.
    pub fn fall_to_safe_op(&mut self, code: u16) {
        if self.emulated.is_none() && self.state == AlState::Op {
            (self.state, self.error, self.pending) = (AlState::SafeOp, Some(code), None);
        }
    }

    /// Whether a requested transition is waiting to be decided at `now_ns`.
    pub fn is_due(&self, now_ns: i64) -> bool {
        self.pending.is_some_and(|pending| pending.due_ns <= now_ns)
    }

    /// Decides on the requested transition. Must be called when [`is_due`](Self::is_due) is true.
    pub fn decide(&mut self, now_ns: i64, readiness: &Readiness) {
        let Some(pending) = self.pending else { return };
        match decision(self.state, pending.target, readiness) {
            AlDecision::Wait(_) if now_ns < pending.deadline_ns => return,
            AlDecision::Enter => self.state = pending.target,
            AlDecision::Wait(code) | AlDecision::Refuse(code) => self.error = Some(code as u16),
        }
        self.pending = None;
    }
}

fn target(requested: u8) -> Result<AlState, AlStatusCode> {
    match requested {
        1 => Ok(AlState::Init),
        2 => Ok(AlState::PreOp),
        4 => Ok(AlState::SafeOp),
        8 => Ok(AlState::Op),
        BOOTSTRAP => Err(AlStatusCode::BootstrapNotSupported),
        _ => Err(AlStatusCode::UnknownRequestedState),
    }
}

fn decision(from: AlState, to: AlState, readiness: &Readiness) -> AlDecision {
    let mailbox = [(readiness.mailbox, AlStatusCode::InvalidMailboxConfiguration)];
    match (from, to) {
        _ if to <= from => AlDecision::Enter,
        (AlState::Init, AlState::PreOp) => require(&mailbox),
        (AlState::PreOp, AlState::SafeOp) => require(&[
            mailbox[0],
            (readiness.outputs, AlStatusCode::InvalidOutputConfiguration),
            (readiness.inputs, AlStatusCode::InvalidInputConfiguration),
            (readiness.sync != SyncReadiness::Invalid, AlStatusCode::InvalidDcSyncConfiguration),
        ]),
        (AlState::SafeOp, AlState::Op) => decision_on_op(readiness),
        _ => AlDecision::Refuse(AlStatusCode::InvalidRequestedStateChange),
    }
}

/// Enters the state if all conditions are met. Otherwise refuses it with the code of the first condition that is not met.
fn require(conditions: &[(bool, AlStatusCode)]) -> AlDecision {
    let failed = conditions.iter().find(|(holds, _)| !holds);
    failed.map_or(AlDecision::Enter, |(_, code)| AlDecision::Refuse(*code))
}

fn decision_on_op(readiness: &Readiness) -> AlDecision {
    match readiness.sync {
        SyncReadiness::Invalid => AlDecision::Refuse(AlStatusCode::InvalidDcSyncConfiguration),
        SyncReadiness::WrongSync1 => AlDecision::Refuse(AlStatusCode::FatalSyncError),
        SyncReadiness::Waiting => AlDecision::Wait(AlStatusCode::NoSyncError),
        SyncReadiness::Off | SyncReadiness::Running if !readiness.outputs_received => {
            AlDecision::Wait(AlStatusCode::NoValidOutputs)
        }
        SyncReadiness::Off | SyncReadiness::Running => AlDecision::Enter,
    }
}
