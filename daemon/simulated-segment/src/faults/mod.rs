//! Faults of a bus: of frames and of devices, each random with a seed and switched while the segment runs.
//!
//! A [`FaultySegment`] is between a wire and a [`SimulatedSegment`]. Faults of frames are simulated here; faults of devices
//! are set in the segment. Times are those of the frames, so everything works on a virtual clock.

mod frame_damage;
mod replies;
mod text;

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

use rand::{Rng, SeedableRng, rngs::StdRng};

pub use text::{FaultSwitch, FaultWindow, InvalidFault};

use super::FRAME_BYTES_MAX;
use crate::SimulatedSegment;
use crate::node::{MailboxFault, SignalFault};
use replies::Replies;

/// A fault. Positions are those on the bus: the coupler is 0, terminals follow. Shares are probabilities per frame, 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Fault {
    /// A frame is lost on its way to the devices or on its way back, at random.
    FrameLost {
        /// Probability for each frame, 0 to 1.
        share: f64,
    },
    /// A reply is late.
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
    /// Bits are inverted. If the check sequence detects that, the frame is dropped (on the way there by the devices, on
    /// the way back by the network card); otherwise headers or working counters are wrong, or the end is missing.
    FrameCorrupted {
        /// Probability for each frame, 0 to 1.
        share: f64,
    },
    /// A bad cable: the receiver of a device detects and counts disturbances between frames.
    NoisyCable {
        /// The device behind the cable.
        position: usize,
        /// Share of pauses between two frames.
        share: f64,
    },
    /// Logical datagrams return with a working counter that is too low, and with wrong inputs.
    WorkingCounterShort {
        /// Probability for each frame, 0 to 1.
        share: f64,
        /// Difference of the counter: 1 for missing inputs, 3 for a whole terminal.
        by: u16,
    },
    /// Devices from a position on have no power. Afterwards they are powered up again with reset counters.
    DevicesGone {
        /// First position without power.
        from: usize,
    },
    /// A terminal leaves OP for SAFE-OP, once.
    FallToSafeOp {
        /// Position of the terminal.
        position: usize,
        /// AL status code (ETG.1020), such as 0x001A for a synchronisation error.
        code: u16,
    },
    /// The signal of a terminal's encoder is lost: amplitude error.
    SignalLost {
        /// Position of the terminal.
        position: usize,
    },
    /// The signal of a terminal's encoder is faster than it can follow: frequency error.
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
    /// A terminal sends an emergency before its next answer, once.
    MailboxEmergency {
        /// Position of the terminal.
        position: usize,
        /// Emergency error code (ETG.1000.6).
        code: u16,
    },
    /// No link: nothing can be sent and nothing arrives.
    LinkDown,
    /// The reference clock jumps, once.
    ClockStep {
        /// Step \[ns\].
        by_ns: i64,
    },
}

/// A fault for which [`Fault::is_behind`] holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "a fault is at a position behind the last device of the simulated bus; the coupler is 0, its terminals follow from 1"
)]
pub struct FaultBehind;

impl Fault {
    /// Whether it is behind the last of these terminals, where it has no effect.
    pub fn is_behind(self, terminals: usize) -> bool {
        let position = match self {
            Self::DevicesGone { from } => from,
            Self::NoisyCable { position, .. }
            | Self::FallToSafeOp { position, .. }
            | Self::SignalLost { position }
            | Self::SignalTooFast { position }
            | Self::MailboxAbort { position, .. }
            | Self::MailboxSilent { position }
            | Self::MailboxEmergency { position, .. } => position,
            _ => return false,
        };
        position > terminals
    }

    /// The fault of the encoder signal of the terminal at `position`, if it is one.
    fn signal_at(self, position: usize) -> Option<SignalFault> {
        match self {
            Self::SignalLost { position: at } if at == position => Some(SignalFault::Lost),
            Self::SignalTooFast { position: at } if at == position => Some(SignalFault::TooFast),
            _ => None,
        }
    }

    /// The lasting fault of the mailbox of the terminal at `position`, if it is one.
    fn mailbox_at(self, position: usize) -> Option<MailboxFault> {
        match self {
            Self::MailboxAbort { position: at, code } if at == position => Some(MailboxFault::Abort(code)),
            Self::MailboxSilent { position: at } if at == position => Some(MailboxFault::Silent),
            _ => None,
        }
    }
}

/// Queue of switches for the next frame. Without frames further ones are dropped.
const SWITCHES_MAX: usize = 1024;

/// Switches faults of a running segment, from any thread.
#[derive(Debug, Clone)]
pub struct FaultHandle(SyncSender<FaultSwitch>);

impl FaultHandle {
    /// Begins a fault with the next frame.
    pub fn begin(&self, fault: Fault) {
        let _ = self.0.try_send(FaultSwitch { fault, on: true });
    }

    /// Ends a fault with the next frame. Has no effect on faults that happen once.
    pub fn end(&self, fault: Fault) {
        let _ = self.0.try_send(FaultSwitch { fault, on: false });
    }
}

/// A simulated segment with faults.
pub struct FaultySegment {
    segment: SimulatedSegment,
    random: StdRng,
    switches: Receiver<FaultSwitch>,
    /// Scheduled switches, by time since the first frame; the next one last.
    schedule: Vec<(i64, FaultSwitch)>,
    first_frame_ns: Option<i64>,
    active: Vec<Fault>,
    /// Reply of the segment, before its damage.
    scratch: Box<[u8; FRAME_BYTES_MAX]>,
    replies: Replies,
}

/// Faults drawn for one frame.
#[derive(Default)]
struct Drawn {
    lost: bool,
    corrupted: bool,
    duplicated: bool,
    /// Additional delay of the reply.
    late_ns: i64,
    /// Missing part of the working counter.
    short_by: u16,
}

impl FaultySegment {
    /// A segment without faults, and the handle that switches them. The seed decides which frames are hit.
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

    /// Schedules faults by the time since the first frame.
    pub fn schedule(&mut self, windows: &[FaultWindow]) {
        for window in windows {
            self.schedule.push((window.from_ns, FaultSwitch { fault: window.fault, on: true }));
            if let Some(until_ns) = window.until_ns {
                self.schedule.push((until_ns, FaultSwitch { fault: window.fault, on: false }));
            }
        }
        self.schedule.sort_by_key(|&(at_ns, _)| std::cmp::Reverse(at_ns));
    }

    /// Whether the cable is plugged in, after the switches due at `now_ns`: without it nothing can be sent.
    pub fn has_link(&mut self, now_ns: i64) -> bool {
        self.switch(now_ns);
        !self.active.contains(&Fault::LinkDown)
    }

    /// From sending a frame's first bit until receiving its last.
    pub fn round_trip_ns(&self, frame_len: usize) -> i64 {
        self.segment.round_trip_ns(frame_len)
    }

    /// A frame enters the coupler at `now_ns`; its replies leave it then, later, or not at all. `back_ns` is the delay of a
    /// reply from the coupler to the receiver.
    pub fn exchange(&mut self, now_ns: i64, back_ns: i64, frame: &[u8]) {
        if !self.has_link(now_ns) {
            return;
        }
        let drawn = self.draw();
        let hit_before_devices = self.random.random_bool(0.5);
        if drawn.lost && hit_before_devices {
            return;
        }
        if drawn.corrupted && hit_before_devices {
            // The coupler counts it and forwards it marked as invalid.
            self.segment.change(0, |node| node.esc.count_invalid_frame());
            return;
        }
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

    /// When the next reply arrives.
    pub fn next_reply_ns(&self) -> Option<i64> {
        self.replies.next_due_ns()
    }

    /// Takes the next reply if it has arrived at `now_ns`; returns its length.
    pub fn take_reply(&mut self, now_ns: i64, buffer: &mut [u8; FRAME_BYTES_MAX]) -> Option<usize> {
        self.replies.take(now_ns, buffer)
    }

    /// Draws the faults of a frame.
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

    /// Begins and ends the faults that are scheduled until `now_ns`, and those that a handle has switched.
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

    /// Begins or ends a fault. What a device shows follows from all active faults: the end of one does not end another.
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
                segment.change(position, |node| node.mailbox_fault = Some(MailboxFault::Emergency(code)));
            }
            _ => {}
        }
    }
}
