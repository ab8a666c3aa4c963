//! A device on the segment. It consists of a slave controller (`chip`) and the behaviour of the device behind that chip
//! ([`Device`]). Before each frame, the segment advances every node to the time at which the frame arrives there.

use super::chip::al::AlState;
use super::chip::coe::{self, MAILBOX_MAX, ObjectDictionary};
use super::chip::dc::LocalClock;
use super::chip::{ChipProfile, Esc, SyncEvent, SyncMode};
use super::source::EncoderSource;

/// Largest length of the outputs of any device \[bytes\].
const OUTPUTS_MAX: usize = 16;

/// Input and output of a device at a sync event, which starts a conversion.
pub struct SyncStep<'a> {
    /// State of the application layer: SAFE-OP or OP.
    pub state: AlState,
    pub event: SyncEvent,
    /// The outputs that arrived last.
    pub outputs: &'a [u8],
    /// The inputs, to be filled by the device.
    pub inputs: &'a mut [u8],
}

/// Behaviour of a device.
pub trait Device: Send {
    /// The chip of this device, with the settings that the device expects.
    fn chip(&self) -> ChipProfile;

    /// Handles a sync event in SAFE-OP or OP: uses the outputs, fills the inputs.
    fn step(&mut self, _step: SyncStep<'_>, _source: &mut dyn EncoderSource) {}

    /// Sets what starts the conversions of the device.
    fn synchronise(&mut self, _mode: SyncMode) {}

    /// Sets or removes a fault of the encoder's signal. Devices without encoder ignore it.
    fn set_signal_fault(&mut self, _fault: Option<SignalFault>) {}

    /// Powers the device off and on. Everything except the EEPROM is lost.
    fn power_cycle(&mut self) {}

    /// The object dictionary. `None` for a device without mailbox.
    fn objects(&mut self) -> Option<&mut dyn ObjectDictionary> {
        None
    }
}

/// Faults of an encoder's signal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SignalFault {
    /// The signal has no amplitude, because a cable is disconnected.
    Lost,
    /// The signal has a frequency that is too high for any terminal, for example because of disturbances.
    TooFast,
}

/// Faults of a device's mailbox.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MailboxFault {
    /// Every SDO is refused with this abort code.
    Abort(u32),
    /// Requests are accepted but never answered.
    Silent,
}

/// A chip with its device.
pub struct Node {
    /// The chip, which frames read and write.
    pub esc: Esc,
    /// The behaviour of the device, including faults of its encoder.
    pub device: Box<dyn Device>,
    /// The current fault of the mailbox.
    pub mailbox_fault: Option<MailboxFault>,
    /// Error code of an emergency message that is sent before the next answer. `None` if none is to be sent.
    pub emergency: Option<u16>,
    /// An answer that is delayed by an emergency message. It is sent when the master has read that message.
    held_answer: Option<([u8; MAILBOX_MAX], usize)>,
}

impl Node {
    /// Powers a device up. `clock` is its local clock, `dl_status` the state of its ports.
    pub fn new(device: Box<dyn Device>, clock: LocalClock, dl_status: u16) -> Self {
        let mut esc = Esc::new(device.chip(), clock);
        esc.set_dl_status(dl_status);
        Self { esc, device, mailbox_fault: None, emergency: None, held_answer: None }
    }

    /// Powers the device off and on.
    pub fn power_cycle(&mut self, now_ns: i64) {
        self.device.power_cycle();
        self.esc = Esc::new(self.device.chip(), self.esc.restarted_clock(now_ns));
        self.held_answer = None;
    }

    /// Advances chip and device to `now_ns`, when a frame arrives. `back_ns` is the time at which the frame returns from the
    /// devices after this one.
    pub fn advance(&mut self, now_ns: i64, back_ns: Option<i64>, source: &mut dyn EncoderSource) {
        self.esc.advance(now_ns, back_ns);
        self.device.synchronise(self.esc.sync_mode());
        if let Some(event) = self.esc.take_sync_event(now_ns) {
            self.step(event, source);
        }
        self.serve_mailbox(now_ns);
    }

    fn step(&mut self, event: SyncEvent, source: &mut dyn EncoderSource) {
        let state = self.esc.state();
        if state < AlState::SafeOp {
            return;
        }
        let mut outputs = [0; OUTPUTS_MAX];
        let len = self.esc.outputs().len().min(OUTPUTS_MAX);
        outputs[..len].copy_from_slice(&self.esc.outputs()[..len]);
        let inputs = self.esc.inputs_mut();
        self.device.step(SyncStep { state, event, outputs: &outputs[..len], inputs }, source);
    }

    fn serve_mailbox(&mut self, now_ns: i64) {
        let Some(objects) = self.device.objects() else { return };
        if !self.esc.is_answer_waiting()
            && let Some((mailbox, len)) = self.held_answer.take()
        {
            self.esc.put_answer(&mailbox[..len]);
        }
        let mut request = [0; MAILBOX_MAX];
        let Some(len) = self.esc.take_request(now_ns, &mut request) else { return };
        let mut mailbox = [0; MAILBOX_MAX];
        let answer = match self.mailbox_fault {
            Some(MailboxFault::Silent) => None,
            Some(MailboxFault::Abort(code)) => coe::abort_with(&request[..len], &mut mailbox, code),
            None => coe::answer(&request[..len], &mut mailbox, objects),
        };
        let Some(len) = answer else { return };
        if let Some(code) = self.emergency.take() {
            self.held_answer = Some((mailbox, len));
            let len = coe::emergency(&mut mailbox, code);
            self.esc.put_answer(&mailbox[..len]);
        } else {
            self.esc.put_answer(&mailbox[..len]);
        }
    }
}
