//! The log: writes events of `tracing`, panics and the final error as lines to standard error. A thread
//! that logs never waits.
//!
//! The lines enter a bounded queue, and one thread writes them. If standard error is closed, full or not
//! read, lines are lost and counted, but no run is affected. This thread writes to a file descriptor of
//! its own. It does not use `std::io::stderr`, because all threads share the lock of that stream: a
//! blocked write would block every thread that prints.
//!
//! Two crates were not used. `tracing-appender` prints to standard error at the end of the program, which may block. It also
//! does not count lines that are lost in a write, and does not limit the lines of a call site. `tracing-journald` writes to a
//! socket that blocks when the journal blocks.

use std::backtrace::{Backtrace, BacktraceStatus};
use std::collections::HashMap;
use std::io::{self, ErrorKind, IsTerminal, Write};
use std::os::fd::{AsFd, OwnedFd};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, OnceLock};
use std::thread;
use std::time::{Duration, Instant};

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use shared::recording::{Disk, SystemDisk};
use tracing::callsite::Identifier;
use tracing::{Level, Metadata};
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::fmt;
use tracing_subscriber::fmt::MakeWriter;
use tracing_subscriber::prelude::*;

/// Capacity of the queue in lines. It holds the lines of a busy minute.
const LINES_MAX: usize = 4096;
/// How long the program waits for unwritten lines before it ends. If another program reads standard
/// error, the lines are written at once.
const FLUSH_TIMEOUT: Duration = Duration::from_millis(500);
/// Pause of a flush before it tries again to use the queue, if the queue is full.
const RETRY: Duration = Duration::from_millis(10);

/// Largest number of lines of one call site in a minute.
const ALIKE_MAX: u32 = 20;
const MINUTE: Duration = Duration::from_secs(60);

static LINES_LOST: OnceLock<Arc<AtomicU64>> = OnceLock::new();

/// Number of lines that standard error did not accept since the program began.
pub fn lines_lost() -> u64 {
    LINES_LOST.get().map_or(0, |lost| lost.load(Ordering::Relaxed))
}

#[derive(Debug)]
enum Entry {
    Line(Vec<u8>),
    /// Requests a message on this channel once all earlier lines have been written or lost.
    Flush(SyncSender<()>),
}

/// The log of the program. Dropping it waits a short time for the last lines.
pub struct Log {
    lines: Lines,
    is_journal: bool,
}

impl Log {
    /// Sends log lines and every panic to standard error.
    pub fn start() -> io::Result<Self> {
        let stderr = io::stderr().as_fd().try_clone_to_owned()?;
        let is_journal = leads_to_journal(&stderr);
        let log = Self { lines: Lines::start(Arc::new(SystemDisk), stderr)?, is_journal };
        let _ = LINES_LOST.set(Arc::clone(&log.lines.lost));
        let sink = Sink { lines: log.lines.clone(), is_journal, alike: Mutex::default() };
        let user_filter = std::env::var("RUST_LOG").ok().and_then(|text| text.parse::<Targets>().ok());
        let filter = user_filter.unwrap_or_else(|| Targets::new().with_default(LevelFilter::INFO));
        let colours = io::stderr().is_terminal();
        let layer = fmt::layer().with_target(false).with_ansi(colours).with_writer(sink);
        let layer = if is_journal { layer.without_time().with_level(false).boxed() } else { layer.boxed() };
        tracing_subscriber::registry().with(layer).with(filter).init();
        let panics = log.lines.clone();
        std::panic::set_hook(Box::new(move |panic| {
            let current = thread::current();
            let backtrace = Backtrace::capture();
            let backtrace = match backtrace.status() {
                BacktraceStatus::Captured => format!("\n{backtrace}"),
                _ => String::new(),
            };
            let text = format!("thread `{}` {panic}{backtrace}", current.name().unwrap_or("?"));
            panics.line(&with_priority(&text, is_journal.then_some(Level::ERROR)));
        }));
        Ok(log)
    }

    /// Writes a line that no filter suppresses. It is used for the final error of a command.
    pub fn line(&self, text: &str) {
        self.lines.line(&with_priority(text, self.is_journal.then_some(Level::ERROR)));
    }
}

impl Drop for Log {
    fn drop(&mut self) {
        self.lines.flush();
    }
}

/// Whether the stream leads to the journal. systemd sets `JOURNAL_STREAM` to the device and the inode of
/// the stream to the journal.
fn leads_to_journal(stream: &OwnedFd) -> bool {
    let journal = std::env::var("JOURNAL_STREAM").unwrap_or_default();
    nix::sys::stat::fstat(stream).is_ok_and(|found| journal == format!("{}:{}", found.st_dev, found.st_ino))
}

/// Puts the priority of syslog(3) before each line, in the format of sd-daemon(3).
fn with_priority(text: &str, level: Option<Level>) -> String {
    let priority = match level {
        None => return text.into(),
        Some(Level::ERROR) => "<3>",
        Some(Level::WARN) => "<4>",
        Some(Level::INFO) => "<6>",
        Some(_) => "<7>",
    };
    let lines: Vec<_> = text.lines().map(|line| format!("{priority}{line}")).collect();
    lines.join("\n")
}

/// Passes events to the [`Lines`], unless the call site exceeds its limit.
struct Sink {
    lines: Lines,
    is_journal: bool,
    /// Counter of each call site.
    alike: Mutex<HashMap<Identifier, Alike>>,
}

/// Counter of the lines of one call site in the current minute.
struct Alike {
    since: Instant,
    lines: u32,
}

impl Alike {
    /// Counts a line. Returns the number of lines in this minute, including this line.
    fn count(&mut self, now: Instant) -> u32 {
        if now.duration_since(self.since) >= MINUTE {
            *self = Self { since: now, lines: 0 };
        }
        self.lines = self.lines.saturating_add(1);
        self.lines
    }
}

/// Writer that a [`Sink`] creates for one event.
struct LogEvent {
    lines: Lines,
    /// Severity of the event; `None` if the stream does not lead to the journal.
    priority: Option<Level>,
    /// Number of lines of the call site in this minute, including this line; 0 if they could not be counted.
    alike: u32,
}

impl<'a> MakeWriter<'a> for Sink {
    type Writer = LogEvent;

    fn make_writer(&'a self) -> LogEvent {
        LogEvent { lines: self.lines.clone(), priority: None, alike: 0 }
    }

    fn make_writer_for(&'a self, event: &Metadata<'_>) -> LogEvent {
        let now = Instant::now();
        // If the lock is taken, the line is not counted, because logging never waits.
        let alike = self.alike.try_lock().map_or(0, |mut alike| {
            alike.entry(event.callsite()).or_insert(Alike { since: now, lines: 0 }).count(now)
        });
        LogEvent { lines: self.lines.clone(), priority: self.is_journal.then_some(*event.level()), alike }
    }
}

/// Each call of `write` receives one complete event.
impl Write for LogEvent {
    fn write(&mut self, event: &[u8]) -> io::Result<usize> {
        if self.alike <= ALIKE_MAX {
            let mut text = String::from_utf8_lossy(event).trim_end().to_owned();
            if self.alike == ALIKE_MAX {
                text.push_str(" (more lines like this are omitted for a minute)");
            }
            self.lines.line(&with_priority(&text, self.priority));
        }
        Ok(event.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Queue of lines that are written to a stream. Sending a line never waits and never fails.
#[derive(Debug, Clone)]
pub struct Lines {
    entries: SyncSender<Entry>,
    lost: Arc<AtomicU64>,
}

impl Lines {
    /// Starts the thread that writes the lines.
    pub fn start(disk: Arc<dyn Disk>, stream: OwnedFd) -> io::Result<Self> {
        let (entries, queue) = sync_channel(LINES_MAX);
        let lost = Arc::<AtomicU64>::default();
        let drain = Drain { disk, stream, lost: Arc::clone(&lost) };
        thread::Builder::new().name("log".into()).spawn(move || drain.run(&queue))?;
        Ok(Self { entries, lost })
    }

    /// Sends a line. `text` has no line end.
    pub fn line(&self, text: &str) {
        let line = format!("{text}\n").into_bytes();
        if self.entries.try_send(Entry::Line(line)).is_err() {
            self.lost.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Number of lines that the stream did not accept.
    pub fn lost(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }

    /// Waits a short time until all lines have been written or lost. Returns false if that takes too long.
    pub fn flush(&self) -> bool {
        let until = Instant::now() + FLUSH_TIMEOUT;
        let (done, written) = sync_channel(1);
        let mut entry = Entry::Flush(done);
        while let Err(TrySendError::Full(unsent)) = self.entries.try_send(entry) {
            if Instant::now() >= until {
                return false;
            }
            entry = unsent;
            thread::sleep(RETRY);
        }
        // Lines that are not written within that time are lost when the program ends.
        written.recv_timeout(until.saturating_duration_since(Instant::now())).is_ok()
    }
}

/// The thread that writes the lines.
struct Drain {
    disk: Arc<dyn Disk>,
    stream: OwnedFd,
    lost: Arc<AtomicU64>,
}

impl Drain {
    fn run(&self, queue: &Receiver<Entry>) {
        let mut reported_lost = 0;
        // Whether the last line was only partly written, so that it has no line end.
        let mut is_torn = false;
        for entry in queue {
            match entry {
                Entry::Line(line) => {
                    let lost = self.lost.load(Ordering::Relaxed);
                    let end = if is_torn { "\n" } else { "" };
                    let loss = format!("{end}({} lines of the log are missing here)\n", lost - reported_lost);
                    if lost > reported_lost && self.write_all(loss.as_bytes()).is_ok() {
                        (reported_lost, is_torn) = (lost, false);
                    }
                    if let Err(written) = self.write_all(&line) {
                        is_torn |= written > 0;
                        self.lost.fetch_add(1, Ordering::Relaxed);
                    }
                }
                Entry::Flush(done) => {
                    // The receiver may have stopped waiting, so an error is ignored.
                    let _ = done.try_send(());
                }
            }
        }
    }

    /// Writes all bytes. If the stream returns an error, returns the number of bytes that were written before.
    fn write_all(&self, bytes: &[u8]) -> Result<(), usize> {
        let mut rest = bytes;
        while !rest.is_empty() {
            match self.disk.append(self.stream.as_fd(), rest) {
                Ok(written) => rest = &rest[written..],
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                // Wait if the stream is non-blocking. Another user of the terminal or pipe may have set that mode.
                Err(error) if error.kind() == ErrorKind::WouldBlock && self.wait() => {}
                Err(_) => return Err(bytes.len() - rest.len()),
            }
        }
        Ok(())
    }

    /// Waits until the stream accepts more bytes. Returns false if waiting is impossible.
    fn wait(&self) -> bool {
        let mut stream = [PollFd::new(self.stream.as_fd(), PollFlags::POLLOUT)];
        poll(&mut stream, PollTimeout::NONE).is_ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_line_has_its_priority_in_the_journal_and_none_elsewhere() {
        assert_eq!(with_priority("one\ntwo", Some(Level::WARN)), "<4>one\n<4>two");
        assert_eq!(with_priority("one\ntwo", None), "one\ntwo");
    }

    #[test]
    fn lines_of_one_call_site_are_counted_by_the_minute() {
        let begin = Instant::now();
        let mut alike = Alike { since: begin, lines: 0 };
        let counted: Vec<u32> = (0..25).map(|_| alike.count(begin)).collect();
        assert_eq!(counted.last(), Some(&25));
        assert_eq!(alike.count(begin + MINUTE), 1);
    }
}
