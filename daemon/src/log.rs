//! The log: lines on standard error that nobody ever waits for.
//!
//! Whoever logs hands a line to a bounded queue; a thread of its own writes it. A standard error that is closed, full or
//! read by nobody costs lines, which are counted, and never a run. The thread writes to the descriptor itself: the lock
//! of `std::io::stderr` would pass a blocked write on to everybody who prints. (`tracing-appender` does the same up to
//! the end of the program, where it prints.)

use std::backtrace::{Backtrace, BacktraceStatus};
use std::io::{self, IsTerminal, Write};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread;
use std::time::{Duration, Instant};

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::fmt;
use tracing_subscriber::prelude::*;

/// Lines that may wait to be written; a chatty minute.
const LINES_MAX: usize = 4096;
/// How long the end of the program waits for lines that are not written yet: a reader who is there takes them at once.
const FLUSH_TIMEOUT: Duration = Duration::from_millis(500);
/// How often whoever flushes tries again to get a place in a full queue.
const RETRY: Duration = Duration::from_millis(10);

static LINES_LOST: AtomicU64 = AtomicU64::new(0);

/// Lines that standard error did not take since the program began.
pub fn lines_lost() -> u64 {
    LINES_LOST.load(Ordering::Relaxed)
}

enum Entry {
    Line(Vec<u8>),
    /// Answered when every line before it was tried.
    Flush(SyncSender<()>),
}

/// The log of the program; dropping it waits a moment for the last lines.
pub struct Log {
    writer: LogWriter,
}

impl Log {
    /// Sends what is logged, and every panic, to standard error.
    pub fn start() -> io::Result<Self> {
        let (entries, queue) = sync_channel(LINES_MAX);
        thread::Builder::new().name("log".into()).spawn(move || write_lines(&queue))?;
        let log = Self { writer: LogWriter(entries) };
        let writer = log.writer.clone();
        let wanted = std::env::var("RUST_LOG").ok().and_then(|text| text.parse::<Targets>().ok());
        let filter = wanted.unwrap_or_else(|| Targets::new().with_default(LevelFilter::INFO));
        let colours = io::stderr().is_terminal();
        let lines = fmt::layer().with_target(false).with_ansi(colours).with_writer(move || writer.clone());
        tracing_subscriber::registry().with(lines).with(filter).init();
        let panics = log.writer.clone();
        std::panic::set_hook(Box::new(move |panic| {
            let current = thread::current();
            let backtrace = Backtrace::capture();
            let backtrace = match backtrace.status() {
                BacktraceStatus::Captured => format!("\n{backtrace}"),
                _ => String::new(),
            };
            panics.line(&format!("thread `{}` {panic}{backtrace}", current.name().unwrap_or("?")));
        }));
        Ok(log)
    }

    /// Writes a line whatever is filtered: the last word of a command.
    pub fn line(&self, text: &str) {
        self.writer.line(text);
    }
}

impl Drop for Log {
    fn drop(&mut self) {
        let until = Instant::now() + FLUSH_TIMEOUT;
        let (done, written) = sync_channel(1);
        let mut entry = Entry::Flush(done);
        while let Err(TrySendError::Full(unsent)) = self.writer.0.try_send(entry) {
            if Instant::now() >= until {
                return;
            }
            entry = unsent;
            thread::sleep(RETRY);
        }
        // What is not written by then is lost with the program.
        let _ = written.recv_timeout(until.saturating_duration_since(Instant::now()));
    }
}

/// Takes whole lines; never blocks and never fails.
#[derive(Clone)]
struct LogWriter(SyncSender<Entry>);

impl LogWriter {
    fn line(&self, text: &str) {
        self.send(format!("{text}\n").into_bytes());
    }

    fn send(&self, line: Vec<u8>) {
        if self.0.try_send(Entry::Line(line)).is_err() {
            LINES_LOST.fetch_add(1, Ordering::Relaxed);
        }
    }
}

impl Write for LogWriter {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        self.send(line.to_vec());
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// The thread of the log.
fn write_lines(queue: &Receiver<Entry>) {
    let mut told = 0;
    for entry in queue {
        match entry {
            Entry::Line(line) => {
                let lost = lines_lost();
                let gap = format!("({} lines of the log are missing here)\n", lost - told);
                if lost > told && write_all(gap.as_bytes()).is_ok() {
                    told = lost;
                }
                if write_all(&line).is_err() {
                    LINES_LOST.fetch_add(1, Ordering::Relaxed);
                }
            }
            Entry::Flush(done) => {
                // Whoever asked may have stopped waiting.
                let _ = done.try_send(());
            }
        }
    }
}

fn write_all(mut bytes: &[u8]) -> nix::Result<()> {
    let stderr = io::stderr();
    while !bytes.is_empty() {
        match nix::unistd::write(&stderr, bytes) {
            Ok(written) => bytes = &bytes[written..],
            Err(Errno::EINTR) => {}
            // Somebody else who has this terminal or pipe may have made it non-blocking.
            Err(Errno::EAGAIN) => {
                poll(
                    &mut [PollFd::new(std::os::fd::AsFd::as_fd(&stderr), PollFlags::POLLOUT)],
                    PollTimeout::NONE,
                )?;
            }
            Err(error) => return Err(error),
        }
    }
    Ok(())
}
