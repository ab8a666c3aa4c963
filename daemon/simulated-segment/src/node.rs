//! A device on the segment: a slave controller (`chip`) and the behaviour of the device behind it ([`Device`]). Before each frame
//! the segment advances every node to the time at which the frame arrives there.

use super::chip::al::AlState;
use super::chip::coe::{self, MAILBOX_MAX, ObjectDictionary};
use super::chip::dc::LocalClock;
use super::chip::{ChipProfile, Esc, SyncEvent, SyncMode};
use super::source::EncoderSource;

/// Longest outputs of any device.
const OUTPUTS_MAX: usize = 16;

/// A sync event for the device.
pub struct SyncStep<'a> {
    /// State of the application layer: SAFE-OP or OP.
    pub state: AlState,
    pub event: SyncEvent,
    /// Outputs as they last arrived.
    pub outputs: &'a [u8],
    /// Inputs to be filled.
    pub inputs: &'a mut [u8],
}

/// Behaviour of a device.
pub trait Device: Send {
    /// The chip that the device is built on.
    fn chip(&self) -> ChipProfile;

    /// A sync event in SAFE-OP or OP: read outputs, fill inputs.
    fn step(&mut self, _step: SyncStep<'_>, _source: &mut dyn EncoderSource) {}

    /// Sets the synchronisation of the device.
    fn synchronise(&mut self, _mode: SyncMode) {}

    /// Sets or removes a fault of the encoder's signal; ignored by devices without encoder.
    fn set_signal_fault(&mut self, _fault: Option<SignalFault>) {}

    /// Powers the device off and on: everything outside its EEPROM is lost.
    fn power_cycle(&mut self) {}

    /// The object dictionary of a device with a mailbox.
    fn objects(&mut self) -> Option<&mut dyn ObjectDictionary> {
        None
    }
}

/// Faults of an encoder's signal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SignalFault {
    /// No amplitude: a cable is disconnected.
    Lost,
    /// A frequency that no terminal can follow, for example from disturbances.
    TooFast,
}

/// Faults of a device's mailbox.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MailboxFault {
    /// Every SDO is refused with this abort code.
    Abort(u32),
    /// Requests are accepted and never answered.
    Silent,
    /// An emergency with this error code precedes the next answer, once.
    Emergency(u16),
}

/// A chip with its device.
pub struct Node {
    /// The chip, on the side of the wire.
    pub esc: Esc,
    /// The device, which also has the faults of its encoder.
    pub device: Box<dyn Device>,
    /// A fault of the mailbox.
    pub mailbox_fault: Option<MailboxFault>,
    /// An answer that waits until the master has fetched the previous one.
    held_answer: Option<([u8; MAILBOX_MAX], usize)>,
}

impl Node {
    /// Powers a device up.
    pub fn new(device: Box<dyn Device>, clock: LocalClock, dl_status: u16) -> Self {
        let mut esc = Esc::new(device.chip(), clock);
        esc.set_dl_status(dl_status);
        Self { esc, device, mailbox_fault: None, held_answer: None }
    }

    /// Powers the device off and on.
    pub fn power_cycle(&mut self, now_ns: i64) {
        self.device.power_cycle();
        self.esc = Esc::new(self.device.chip(), self.esc.restarted_clock(now_ns));
        self.held_answer = None;
    }

    /// Advances chip and device to the arrival of a frame, which returns from the devices behind at `back_ns`.
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
            None | Some(MailboxFault::Emergency(_)) => coe::answer(&request[..len], &mut mailbox, objects),
        };
        let Some(len) = answer else { return };
        if let Some(MailboxFault::Emergency(code)) = self.mailbox_fault {
            self.mailbox_fault = None;
            self.held_answer = Some((mailbox, len));
            let len = coe::emergency(&mut mailbox, code);
            self.esc.put_answer(&mailbox[..len]);
        } else {
            self.esc.put_answer(&mailbox[..len]);
        }
    }
}
