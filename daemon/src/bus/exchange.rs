//! Sends and receives the frames of the EtherCAT stack, with ethercrab's `PduTx` and `PduRx`. The thread that waits for a
//! reply does all steps itself:
//! 1. poll a future of the stack
//! 2. send the frames that the future has produced
//! 3. pass the next reply to the stack
//!
//! The steps are repeated until the future is ready.
//!
//! The loops in ethercrab 0.7.1 are not used. A late or duplicated reply ends them permanently (issue 293), and a lost reply
//! can block them. Here, a bad reply is counted, and the next reply is read. If the interface goes down, sending the current
//! frame fails, and the thread continues.

use std::future::Future;
use std::pin::{Pin, pin};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll, Waker};

use ethercrab::error::Error as EtherCatError;
use ethercrab::{PduRx, PduTx, ReceiveAction};
use shared::time::MonoNs;

use super::timers;
use crate::clock::Clock;
use crate::segment::{FRAME_BYTES_MAX, FrameWire};

/// Time after which the future is polled again if it has no pending timer \[ns\].
const POLL_PERIOD_NS: i64 = 1_000_000;

/// Counters of the wire since the start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct WireCounters {
    /// Frames sent without an error.
    pub sent: u64,
    /// Frames that could not be sent.
    pub send_errors: u64,
    /// Replies that belonged to a waiting frame.
    pub received: u64,
    /// Replies that were late, duplicated or damaged.
    pub rejected: u64,
    /// Errors of the interface while receiving.
    pub receive_errors: u64,
}

impl WireCounters {
    /// Number of frames passed to the interface, including those that could not be sent.
    const fn handed_out(&self) -> u64 {
        self.sent + self.send_errors
    }
}

/// Runs futures of the EtherCAT stack, and exchanges their frames over a wire.
pub struct Exchange {
    /// `None` after [`Self::release`].
    halves: Option<(PduTx<'static>, PduRx<'static>)>,
    wire: Box<dyn FrameWire>,
    clock: Clock,
    buffer: Box<[u8; FRAME_BYTES_MAX]>,
    /// Counters of the wire so far.
    pub(super) counters: WireCounters,
    /// Time at which the last frame was passed to the wire.
    pub(super) sent_last: MonoNs,
    /// Length of that frame \[bytes\].
    pub(super) sent_bytes_last: usize,
    /// When the last reply was received.
    pub(super) received_last: MonoNs,
    interrupt: Arc<AtomicBool>,
}

impl Exchange {
    /// An exchange that uses both halves of one `PduStorage`, and sends over `wire`.
    pub fn new(tx: PduTx<'static>, rx: PduRx<'static>, wire: Box<dyn FrameWire>, clock: Clock) -> Self {
        let now = clock.now();
        Self {
            halves: Some((tx, rx)),
            wire,
            clock,
            buffer: Box::new([0; FRAME_BYTES_MAX]),
            counters: WireCounters::default(),
            sent_last: now,
            sent_bytes_last: 0,
            received_last: now,
            interrupt: Arc::default(),
        }
    }

    /// Sets the flag that ends [`run`](Self::run) when another thread sets it to true.
    pub fn interrupt_by(&mut self, interrupt: Arc<AtomicBool>) {
        self.interrupt = interrupt;
    }

    /// Whether this flag is set, so that [`run`](Self::run) ends.
    pub fn is_interrupted(&self) -> bool {
        self.interrupt.load(Ordering::Acquire)
    }

    /// Takes the two halves of the storage out of the exchange. Afterwards no frame can be sent or received.
    pub fn release(&mut self) -> Option<(PduTx<'static>, PduRx<'static>)> {
        self.halves.take()
    }

    /// Runs a future of the EtherCAT stack until it is ready, and exchanges its frames. Ends with an internal
    /// error if [`is_interrupted`](Self::is_interrupted) becomes true.
    pub fn run<T>(
        &mut self,
        future: impl Future<Output = Result<T, EtherCatError>>,
    ) -> Result<T, EtherCatError> {
        let mut future = pin!(future);
        while !self.is_interrupted() {
            if let Some(output) = self.poll_and_exchange(future.as_mut(), None, true) {
                return output;
            }
        }
        Err(EtherCatError::Internal)
    }

    /// Like [`run`](Self::run), but returns `None` if the future is not ready at `deadline`. A reply that arrives
    /// later is rejected. No frame is sent a second time, because the copy would arrive one cycle late and would
    /// look like a new sample.
    pub fn run_until<F: Future>(&mut self, future: F, deadline: MonoNs) -> Option<F::Output> {
        let mut future = pin!(future);
        let before = self.counters;
        loop {
            // Frames are sent one after the other. As long as a frame waits for its reply, any frame that the stack offers
            // is a repetition of that frame, and is not sent.
            let is_answered =
                self.counters.handed_out() - before.handed_out() <= self.counters.received - before.received;
            let output = self.poll_and_exchange(future.as_mut(), Some(deadline), is_answered);
            if output.is_some() || self.clock.now() >= deadline {
                return output;
            }
        }
    }

    /// Polls the future once. If the future is not ready, waits for one reply or for the next timer. If `sends` is set,
    /// pending frames are sent before this wait.
    fn poll_and_exchange<F: Future>(
        &mut self,
        future: Pin<&mut F>,
        deadline: Option<MonoNs>,
        sends: bool,
    ) -> Option<F::Output> {
        timers::use_clock(&self.clock);
        timers::take_earliest_wake();
        if let Poll::Ready(output) = future.poll(&mut Context::from_waker(Waker::noop())) {
            return Some(output);
        }
        let idle_until = self.clock.now().plus_ns(POLL_PERIOD_NS);
        let waits = [timers::take_earliest_wake(), deadline];
        let until = waits.into_iter().flatten().fold(idle_until, MonoNs::min);
        if sends {
            self.send_pending();
        }
        self.receive_one(until);
        None
    }

    fn send_pending(&mut self) {
        let Self { halves, wire, clock, counters, sent_last, sent_bytes_last, .. } = self;
        let Some((tx, _)) = halves else { return };
        while let Some(frame) = tx.next_sendable_frame() {
            *sent_last = clock.now();
            // If a frame cannot be sent, the stack still receives success. The frame then ends with its time-out, like any
            // lost frame. If the stack received the error, it would offer the frame again at once.
            let _never_an_error = frame.send_blocking(|bytes| {
                *sent_bytes_last = bytes.len();
                match wire.send(bytes) {
                    Ok(()) => counters.sent += 1,
                    Err(_) => counters.send_errors += 1,
                }
                Ok(bytes.len())
            });
        }
    }

    fn receive_one(&mut self, until: MonoNs) {
        match self.wire.receive(&mut self.buffer, until) {
            Ok(Some(length)) => {
                match self.halves.as_mut().map(|(_, rx)| rx.receive_frame(&self.buffer[..length])) {
                    Some(Ok(ReceiveAction::Processed)) => {
                        self.received_last = self.clock.now();
                        self.counters.received += 1;
                    }
                    None | Some(Ok(ReceiveAction::Ignored)) => {}
                    Some(Err(_)) => self.counters.rejected += 1,
                }
            }
            Ok(None) => {}
            Err(_) => {
                // An interface that is down returns an error at once. Without this sleep, the loop would use
                // the processor until the time-out.
                self.counters.receive_errors += 1;
                self.clock.sleep_until(until);
            }
        }
    }
}
