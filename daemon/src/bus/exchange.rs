//! Sends and receives frames for the EtherCAT stack, with ethercrab's `PduTx` and `PduRx`. All steps run on the thread that
//! waits for the reply. It polls a future of the stack, sends the frames that the future produced, and passes the next reply
//! to the stack. It repeats these steps until the future is ready.
//!
//! The loops of ethercrab 0.7.1 are not used. They end permanently on a late or duplicated reply (issue 293), or stall
//! after a lost one. Here a bad reply is counted and the next one is read. If the interface goes down, sending this frame
//! fails, and the thread continues.

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
    /// Number of frames passed to the wire, including those that could not be sent.
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
    /// Time of the last frame that was passed to the wire, and its length in the next field \[bytes\].
    pub(super) sent_last: MonoNs,
    /// Length of that frame \[bytes\].
    pub(super) sent_bytes_last: usize,
    /// When the last reply was received.
    pub(super) received_last: MonoNs,
    interrupt: Arc<AtomicBool>,
}

impl Exchange {
    /// An exchange from both halves of one `PduStorage`, with their wire.
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

    /// Sets the flag that ends [`run`](Self::run).
    pub fn interrupt_by(&mut self, interrupt: Arc<AtomicBool>) {
        self.interrupt = interrupt;
    }

    /// Whether the flag is set that ends [`run`](Self::run).
    pub fn is_interrupted(&self) -> bool {
        self.interrupt.load(Ordering::Acquire)
    }

    /// Takes the halves out. After that, no frame is sent or received.
    pub fn release(&mut self) -> Option<(PduTx<'static>, PduRx<'static>)> {
        self.halves.take()
    }

    /// Runs a future of the EtherCAT stack until it is ready, and exchanges its frames. Returns an internal error if the
    /// flag of [`is_interrupted`](Self::is_interrupted) is set.
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

    /// Like [`run`](Self::run), but ends at `deadline` with `None`. A reply that arrives later is rejected. No frame is sent
    /// again, because a copy would arrive a cycle late and look like a new sample.
    pub fn run_until<F: Future>(&mut self, future: F, deadline: MonoNs) -> Option<F::Output> {
        let mut future = pin!(future);
        let before = self.counters;
        loop {
            // Frames are sent one after the other. While a frame waits for its reply, the stack can only
            // offer the same frame again.
            let is_answered =
                self.counters.handed_out() - before.handed_out() <= self.counters.received - before.received;
            let output = self.poll_and_exchange(future.as_mut(), Some(deadline), is_answered);
            if output.is_some() || self.clock.now() >= deadline {
                return output;
            }
        }
    }

    /// Polls the future once. If it is not ready, sends pending frames if `sends` is set, and waits for one
    /// reply or the next timer.
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
            // A frame that cannot be sent is treated as sent and lost. It ends with its time-out like any other lost frame.
            // Otherwise the stack would offer it again at once.
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
                // An interface that is down returns an error at once. Without this pause, the loop would run
                // without waiting until the time-out.
                self.counters.receive_errors += 1;
                self.clock.sleep_until(until);
            }
        }
    }
}
