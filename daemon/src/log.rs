//! The log: lines on standard error that nobody ever waits for.
//!
//! Whoever logs hands a line to a bounded queue; a thread of its own writes it. A standard error that is closed, full or
//! read by nobody costs lines, which are counted, and never a run. The thread has a descriptor of its own: the lock of
//! `std::io::stderr` would pass a blocked write on to everybody who prints. (`tracing-appender` does the same up to
//! the end of the program, where it prints.)

use std::backtrace::{Backtrace, BacktraceStatus};
use std::io::{self, ErrorKind, IsTerminal, Write};
use std::os::fd::{AsFd, OwnedFd};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, OnceLock};
use std::thread;
use std::time::{Duration, Instant};

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use shared::recording::{Disk, SystemDisk};
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::fmt;
use tracing_subscriber::prelude::*;

/// Lines that may wait to be written; a chatty minute.
const LINES_MAX: usize = 4096;
/// How long the end of the program waits for lines that are not written yet: a reader who is there takes them at once.
const FLUSH_TIMEOUT: Duration = Duration::from_millis(500);
/// How often whoever flushes tries again to get a place in a full queue.
const RETRY: Duration = Duration::from_millis(10);

static LINES_LOST: OnceLock<Arc<AtomicU64>> = OnceLock::new();

/// Lines that standard error did not take since the program began.
pub fn lines_lost() -> u64 {
    LINES_LOST.get().map_or(0, |lost| lost.load(Ordering::Relaxed))
}

#[derive(Debug)]
enum Entry {
    Line(Vec<u8>),
    /// Answered when every line before it was tried.
    Flush(SyncSender<()>),
}

/// The log of the program; dropping it waits a moment for the last lines.
pub struct Log {
    lines: Lines,
}

impl Log {
    /// Sends what is logged, and every panic, to standard error.
    pub fn start() -> io::Result<Self> {
        let stderr = io::stderr().as_fd().try_clone_to_owned()?;
        let log = Self { lines: Lines::start(Arc::new(SystemDisk), stderr)? };
        let _ = LINES_LOST.set(Arc::clone(&log.lines.lost));
        let lines = log.lines.clone();
        let wanted = std::env::var("RUST_LOG").ok().and_then(|text| text.parse::<Targets>().ok());
        let filter = wanted.unwrap_or_else(|| Targets::new().with_default(LevelFilter::INFO));
        let colours = io::stderr().is_terminal();
        let layer = fmt::layer().with_target(false).with_ansi(colours).with_writer(move || lines.clone());
        tracing_subscriber::registry().with(layer).with(filter).init();
        let panics = log.lines.clone();
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
        self.lines.line(text);
    }
}

impl Drop for Log {
    fn drop(&mut self) {
        self.lines.flush();
    }
}

/// Lines on their way to a stream. Whoever sends one never waits and never fails.
#[derive(Debug, Clone)]
pub struct Lines {
    entries: SyncSender<Entry>,
    lost: Arc<AtomicU64>,
}

impl Lines {
    /// Starts the thread that writes them.
    pub fn start(disk: Arc<dyn Disk>, stream: OwnedFd) -> io::Result<Self> {
        let (entries, queue) = sync_channel(LINES_MAX);
        let lost = Arc::<AtomicU64>::default();
        let drain = Drain { disk, stream, lost: Arc::clone(&lost) };
        thread::Builder::new().name("log".into()).spawn(move || drain.run(&queue))?;
        Ok(Self { entries, lost })
    }

    /// Sends one, without its end.
    pub fn line(&self, text: &str) {
        self.send(format!("{text}\n").into_bytes());
    }

    /// Those that the stream did not take.
    pub fn lost(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }

    /// Waits a moment until all are written.
    pub fn flush(&self) {
        let until = Instant::now() + FLUSH_TIMEOUT;
        let (done, written) = sync_channel(1);
        let mut entry = Entry::Flush(done);
        while let Err(TrySendError::Full(unsent)) = self.entries.try_send(entry) {
            if Instant::now() >= until {
                return;
            }
            entry = unsent;
            thread::sleep(RETRY);
        }
        // What is not written by then is lost with the program.
        let _ = written.recv_timeout(until.saturating_duration_since(Instant::now()));
    }

    fn send(&self, line: Vec<u8>) {
        if self.entries.try_send(Entry::Line(line)).is_err() {
            self.lost.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// Takes whole lines.
impl Write for Lines {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        self.send(line.to_vec());
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// What the thread of the log has.
struct Drain {
    disk: Arc<dyn Disk>,
    stream: OwnedFd,
    lost: Arc<AtomicU64>,
}

impl Drain {
    fn run(&self, queue: &Receiver<Entry>) {
        let mut told = 0;
        // A line that was cut short has no end yet.
        let mut is_torn = false;
        for entry in queue {
            match entry {
                Entry::Line(line) => {
                    let lost = self.lost.load(Ordering::Relaxed);
                    let end = if is_torn { "\n" } else { "" };
                    let gap = format!("{end}({} lines of the log are missing here)\n", lost - told);
                    if lost > told && self.write_all(gap.as_bytes()).is_ok() {
                        (told, is_torn) = (lost, false);
                    }
                    if let Err(written) = self.write_all(&line) {
                        is_torn |= written > 0;
                        self.lost.fetch_add(1, Ordering::Relaxed);
                    }
                }
                Entry::Flush(done) => {
                    // Whoever asked may have stopped waiting.
                    let _ = done.try_send(());
                }
            }
        }
    }

    /// Or how many bytes were written before the stream refused.
    fn write_all(&self, bytes: &[u8]) -> Result<(), usize> {
        let mut rest = bytes;
        while !rest.is_empty() {
            match self.disk.append(self.stream.as_fd(), rest) {
                Ok(written) => rest = &rest[written..],
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                // Somebody else who has this terminal or pipe may have made it non-blocking.
                Err(error) if error.kind() == ErrorKind::WouldBlock && self.wait() => {}
                Err(_) => return Err(bytes.len() - rest.len()),
            }
        }
        Ok(())
    }

    /// Until the stream takes more; false where it cannot be asked.
    fn wait(&self) -> bool {
        let mut stream = [PollFd::new(self.stream.as_fd(), PollFlags::POLLOUT)];
        poll(&mut stream, PollTimeout::NONE).is_ok()
    }
}
