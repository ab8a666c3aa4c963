//! Faults of a bus. Some faults concern frames, others concern devices. A random generator with a seed determines which
//! frames are hit. Faults can be switched while the segment runs.
//!
//! A [`FaultySegment`] wraps a [`SimulatedSegment`]. It simulates the faults of frames, and sets the faults of devices in
//! the segment. The only clock is the time that is passed with each frame, so everything also works in virtual time.

mod frame_damage;
mod replies;
mod text;

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

use rand::{Rng, SeedableRng, rngs::StdRng};

pub use text::{FAULT_INTERVAL, FAULTS, FaultSwitch, FaultWindow, InvalidFault};

use super::FRAME_BYTES_MAX;
use crate::SimulatedSegment;
use crate::node::{MailboxFault, SignalFault};
use replies::Replies;

/// A fault. A `position` is the position of a device on the bus: the coupler has position 0, the terminals follow. A `share`
/// is the probability that a frame is hit, from 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Fault {
    /// A frame is lost on its way to the devices or on its way back, at random.
    FrameLost {
        /// Probability for each frame, 0 to 1.
        share: f64,
    },
    /// A reply is delayed.
    FrameLate {
        /// Probability for each frame, 0 to 1.
        share: f64,
        /// Additional delay \[ns\].
        by_ns: i64,
    },
    /// A reply is sent twice.
    FrameDuplicated {
        /// Probability for each frame, 0 to 1.
        share: f64,
    },
    /// Bits of a frame are inverted. If the check sequence detects this on the way out, the devices drop the frame. If it
    /// detects this on the way back, the network card drops the frame. Otherwise headers or working counters are wrong, or
    /// the end is missing.
    FrameCorrupted {
        /// Probability for each frame, 0 to 1.
        share: f64,
    },
    /// A bad cable: the receiver of a device detects disturbances between frames and counts them as receive errors.
    NoisyCable {
        /// Position of the device that receives from the cable.
        position: usize,
        /// Probability for each frame that an error occurs in the pause before the frame, 0 to 1.
        share: f64,
    },
    /// Logical datagrams return with a working counter that is too low, and with wrong inputs.
    WorkingCounterShort {
        /// Probability for each frame, 0 to 1.
        share: f64,
        /// Amount by which the counter is too low. Missing inputs reduce it by 1, a missing terminal by 3.
        by: u16,
    },
    /// The devices from a position on have no power. When the fault ends, they are powered up,
    /// and their counters start anew.
    DevicesGone {
        /// First position without power.
        from: usize,
    },
    /// A terminal changes from OP to SAFE-OP. This happens once.
    FallToSafeOp {
        /// Position of the terminal.
        position: usize,
        /// AL status code (ETG.1020), such as 0x001A for a synchronisation error.
        code: u16,
    },
    /// The signal of a terminal's encoder is lost: the terminal reports an amplitude error.
    SignalLost {
        /// Position of the terminal.
        position: usize,
    },
    /// The signal of a terminal's encoder is faster than the terminal can follow: it reports a frequency error.
    SignalTooFast {
        /// Position of the terminal.
        position: usize,
    },
    /// A terminal refuses every SDO.
    MailboxAbort {
        /// Position of the terminal.
        position: usize,
        /// SDO abort code (ETG.1000.6).
        code: u32,
    },
    /// A terminal does not answer mailbox requests.
    MailboxSilent {
        /// Position of the terminal.
        position: usize,
    },
    /// A terminal sends an emergency message before its next answer. This happens once.
    MailboxEmergency {
        /// Position of the terminal.
        position: usize,
        /// Emergency error code (ETG.1000.6).
        code: u16,
    },
    /// The link is down: no frame can be sent, and no reply arrives.
    LinkDown,
    /// The reference clock jumps. This happens once.
    ClockStep {
        /// Step \[ns\].
        by_ns: i64,
    },
}

/// Error for a fault for which [`Fault::is_misplaced`] is true.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "the simulated bus has no device for a fault at this position; the coupler is 0, its terminals follow from 1, and the \
     coupler can only have the faults `gone` and `noise`"
)]
pub struct MisplacedFault;

impl Fault {
    /// Whether the fault is at a position where it has no effect: after the last terminal, or at the coupler if it is a
    /// fault of a terminal. `terminals` is the number of terminals.
    pub fn is_misplaced(self, terminals: usize) -> bool {
        let (first, position) = match self {
            Self::DevicesGone { from: position } | Self::NoisyCable { position, .. } => (0, position),
            Self::FallToSafeOp { position, .. }
            | Self::SignalLost { position }
            | Self::SignalTooFast { position }
            | Self::MailboxAbort { position, .. }
            | Self::MailboxSilent { position }
            | Self::MailboxEmergency { position, .. } => (1, position),
            _ => return false,
        };
        !(first..=terminals).contains(&position)
    }

    /// The signal fault that this fault causes at the terminal at `position`. `None` if it causes none there.
    fn signal_at(self, position: usize) -> Option<SignalFault> {
        match self {
            Self::SignalLost { position: at } if at == position => Some(SignalFault::Lost),
            Self::SignalTooFast { position: at } if at == position => Some(SignalFault::TooFast),
            _ => None,
        }
    }

    /// The mailbox fault that this fault causes at the terminal at `position`. `None` if it causes none there, or
    /// if it happens only once.
    fn mailbox_at(self, position: usize) -> Option<MailboxFault> {
        match self {
            Self::MailboxAbort { position: at, code } if at == position => Some(MailboxFault::Abort(code)),
            Self::MailboxSilent { position: at } if at == position => Some(MailboxFault::Silent),
            _ => None,
        }
    }
}

/// Largest number of switches that wait for the next frame. Further switches are dropped.
const SWITCHES_MAX: usize = 1024;

/// Begins and ends faults of a running segment, from any thread.
#[derive(Debug, Clone)]
pub struct FaultHandle(SyncSender<FaultSwitch>);

impl FaultHandle {
    /// Begins a fault when the next frame is sent.
    pub fn begin(&self, fault: Fault) {
        let _ = self.0.try_send(FaultSwitch { fault, on: true });
    }

    /// Ends a fault when the next frame is sent. Has no effect on faults that happen once.
    pub fn end(&self, fault: Fault) {
        let _ = self.0.try_send(FaultSwitch { fault, on: false });
    }
}

/// A simulated segment with faults.
pub struct FaultySegment {
    segment: SimulatedSegment,
    random: StdRng,
    switches: Receiver<FaultSwitch>,
    /// Scheduled switches, with their time since the first frame. They are sorted by descending time, so the next
    /// switch is the last element.
    schedule: Vec<(i64, FaultSwitch)>,
    first_frame_ns: Option<i64>,
    active: Vec<Fault>,
    /// Reply of the segment, before it is damaged.
    scratch: Box<[u8; FRAME_BYTES_MAX]>,
    replies: Replies,
}

/// Faults that hit one frame, chosen at random.
#[derive(Default)]
struct Drawn {
    lost: bool,
    corrupted: bool,
    duplicated: bool,
    /// Additional delay of the reply \[ns\].
    late_ns: i64,
    /// Amount by which the working counter is reduced.
    short_by: u16,
}

impl FaultySegment {
    /// Wraps a segment, without faults at first, and returns the handle that switches faults. The seed
    /// determines which frames are hit.
    pub fn new(segment: SimulatedSegment, seed: u64) -> (Self, FaultHandle) {
        let (sender, switches) = sync_channel(SWITCHES_MAX);
        let faulty = Self {
            segment,
            random: StdRng::seed_from_u64(seed),
            switches,
            schedule: Vec::new(),
            first_frame_ns: None,
            active: Vec::new(),
            scratch: Box::new([0; FRAME_BYTES_MAX]),
            replies: Replies::new(),
        };
        (faulty, FaultHandle(sender))
    }

    /// Schedules faults. Times are counted from the first frame.
    pub fn schedule(&mut self, windows: &[FaultWindow]) {
        for window in windows {
            self.schedule.push((window.from_ns, FaultSwitch { fault: window.fault, on: true }));
            if let Some(until_ns) = window.until_ns {
                self.schedule.push((until_ns, FaultSwitch { fault: window.fault, on: false }));
            }
        }
        self.schedule.sort_by_key(|&(at_ns, _)| std::cmp::Reverse(at_ns));
    }

    /// Whether the cable is plugged in, after all switches that are due at `now_ns`. Without a link no frame can be sent.
    pub fn has_link(&mut self, now_ns: i64) -> bool {
        self.switch(now_ns);
        !self.active.contains(&Fault::LinkDown)
    }

    /// Time from sending the first bit of a frame until its last bit is received \[ns\].
    pub fn round_trip_ns(&self, frame_len: usize) -> i64 {
        self.segment.round_trip_ns(frame_len)
    }

    /// Passes a frame through the segment. The frame enters the coupler at `now_ns`. Its replies leave the coupler at the
    /// same time or later, or get lost. `back_ns` is the delay of a reply from the coupler to the receiver.
    pub fn exchange(&mut self, now_ns: i64, back_ns: i64, frame: &[u8]) {
        if !self.has_link(now_ns) {
            return;
        }
        let drawn = self.draw();
        // Faults on the way to the devices: no device processes the frame.
        let hit_before_devices = self.random.random_bool(0.5);
        if drawn.lost && hit_before_devices {
            return;
        }
        if drawn.corrupted && hit_before_devices {
            // The coupler counts the frame as invalid. The devices after it ignore the frame.
            self.segment.change(0, |node| node.esc.count_invalid_frame());
            return;
        }
        // Faults on the way back: the devices have processed the frame.
        let Some(length) = self.segment.exchange(now_ns, frame, &mut self.scratch[..]) else { return };
        if drawn.lost {
            return;
        }
        let reply = &mut self.scratch[..length];
        if drawn.short_by > 0 {
            frame_damage::shorten_working_counters(reply, drawn.short_by);
        }
        let length = if drawn.corrupted {
            match frame_damage::corrupt(reply, &mut self.random) {
                Some(length) => length,
                None => return,
            }
        } else {
            length
        };
        let due_ns = now_ns.saturating_add(back_ns).saturating_add(drawn.late_ns);
        let copies = if drawn.duplicated { 2 } else { 1 };
        for _ in 0..copies {
            self.replies.push(due_ns, &self.scratch[..length]);
        }
    }

    /// Time of arrival of the next reply \[ns\].
    pub fn next_reply_ns(&self) -> Option<i64> {
        self.replies.next_due_ns()
    }

    /// Takes the next reply if it has arrived by `now_ns`. Returns its length.
    pub fn take_reply(&mut self, now_ns: i64, buffer: &mut [u8; FRAME_BYTES_MAX]) -> Option<usize> {
        self.replies.take(now_ns, buffer)
    }

    /// Chooses at random which active faults hit a frame.
    fn draw(&mut self) -> Drawn {
        let Self { active, random, segment, .. } = self;
        let mut drawn = Drawn::default();
        if active.is_empty() {
            return drawn;
        }
        let mut hit = |share: f64| random.random_bool(share.clamp(0.0, 1.0));
        for fault in active.iter() {
            match *fault {
                Fault::FrameLost { share } => drawn.lost |= hit(share),
                Fault::FrameLate { share, by_ns } if hit(share) => drawn.late_ns = by_ns.max(0),
                Fault::FrameDuplicated { share } => drawn.duplicated |= hit(share),
                Fault::FrameCorrupted { share } => drawn.corrupted |= hit(share),
                Fault::WorkingCounterShort { share, by } if hit(share) => drawn.short_by = by,
                Fault::NoisyCable { position, share } if hit(share) => {
                    segment.change(position, |node| node.esc.count_receive_error());
                }
                _ => {}
            }
        }
        drawn
    }

    /// Applies all scheduled switches that are due at `now_ns`. Then applies the switches that a handle has sent.
    fn switch(&mut self, now_ns: i64) {
        self.segment.power_up(now_ns);
        let since_ns = now_ns - *self.first_frame_ns.get_or_insert(now_ns);
        while let Some(&(at_ns, switch)) = self.schedule.last() {
            if at_ns > since_ns {
                break;
            }
            self.schedule.pop();
            self.apply(switch, now_ns);
        }
        while let Ok(switch) = self.switches.try_recv() {
            self.apply(switch, now_ns);
        }
    }

    /// Begins or ends a fault. The state of a device is computed from all active faults. The end of one fault therefore does
    /// not end another fault of the same device.
    fn apply(&mut self, FaultSwitch { fault, on }: FaultSwitch, now_ns: i64) {
        self.active.retain(|other| *other != fault);
        if on {
            self.active.push(fault);
        }
        let Self { segment, active, .. } = self;
        match (fault, on) {
            (Fault::DevicesGone { from }, true) => segment.cut_from(from),
            (Fault::DevicesGone { .. }, false) => {
                segment.restore(now_ns);
                for other in active {
                    if let Fault::DevicesGone { from } = *other {
                        segment.cut_from(from);
                    }
                }
            }
            (Fault::FallToSafeOp { position, code }, true) => {
                segment.change(position, |node| node.esc.fall_to_safe_op(code));
            }
            (Fault::ClockStep { by_ns }, true) => segment.step_reference_clock(now_ns, by_ns),
            (Fault::SignalLost { position } | Fault::SignalTooFast { position }, _) => {
                let last = active.iter().rev().find_map(|other| other.signal_at(position));
                segment.change(position, |node| node.device.set_signal_fault(last));
            }
            (Fault::MailboxAbort { position, .. } | Fault::MailboxSilent { position }, _) => {
                let last = active.iter().rev().find_map(|other| other.mailbox_at(position));
                segment.change(position, |node| node.mailbox_fault = last);
            }
            (Fault::MailboxEmergency { position, code }, true) => {
                segment.change(position, |node| node.emergency = Some(code));
            }
            _ => {}
        }
    }
}
