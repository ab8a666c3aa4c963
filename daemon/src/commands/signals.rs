//! The signals that end a program: Ctrl-C, SIGTERM, and SIGHUP, which is sent when the terminal is closed.

use anyhow::Context;
use futures_util::future::OptionFuture;
use tokio::signal::unix::{Signal, SignalKind, signal};

use crate::tuning::Machine;

pub(super) struct Signals {
    interrupt: Signal,
    terminate: Signal,
    /// `None` if `nohup` has disabled this signal.
    hangup: Option<Signal>,
}

impl Signals {
    pub fn new() -> anyhow::Result<Self> {
        let listen = |kind| signal(kind).context("cannot listen for signals");
        let is_ignored = is_ignored(SignalKind::hangup());
        Ok(Self {
            interrupt: listen(SignalKind::interrupt())?,
            terminate: listen(SignalKind::terminate())?,
            hangup: if is_ignored { None } else { Some(listen(SignalKind::hangup())?) },
        })
    }

    /// Waits for the next signal and returns its name.
    pub async fn next(&mut self) -> &'static str {
        let hangup = OptionFuture::from(self.hangup.as_mut().map(Signal::recv));
        tokio::select! {
            _ = self.interrupt.recv() => "Ctrl-C",
            _ = self.terminate.recv() => "SIGTERM",
            Some(_) = hangup => "SIGHUP, a closed terminal",
        }
    }
}

/// Whether the signal was ignored when the program started.
fn is_ignored(kind: SignalKind) -> bool {
    Machine::of_process().status_bits("SigIgn") >> (kind.as_raw_value() - 1) & 1 == 1
}
