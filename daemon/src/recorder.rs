//! From the ring to the file: a thread that may wait for the disk, so that the cycle never does.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::Receiver;
use std::thread;
use std::time::{Duration, Instant};

use rtrb::{Consumer, Producer, PushError, RingBuffer};
use shared::recording::schema::{CycleRecord, Event, EventKind, RunMetadata};
use shared::recording::{RecordingWriter, RunFile, TimingSummary, WriteError};
use shared::time::UtcNs;

use crate::clock::Clock;
use crate::cycle::{CycleEvent, CycleTiming, TimingSink, TimingSource, timing_ring};
use crate::run::{DiskFloor, Progress, Stop, Synced};

/// Events that may wait for the recorder; cycles carry their reasons themselves, so that one too many is no harm.
const EVENTS_MAX: usize = 1024;
/// How often the ring is emptied.
const DRAIN_PERIOD: Duration = Duration::from_millis(20);
/// How well the loop kept its time is put into the file at least this often, for a run that is killed.
const TIMING_PERIOD: Duration = Duration::from_secs(60);
/// UTC that moved by more than this against the monotonic clock was stepped \[ns\].
const CLOCK_STEP_NS: i64 = 100_000;

/// The cycle's end of the ring.
pub struct CycleSink {
    ring: Producer<CycleRecord>,
    events: Producer<CycleEvent>,
    timing: TimingSink,
    due: Arc<AtomicU64>,
    /// On virtual time the cycle waits for the recorder; on real time it never waits and the loss is recorded.
    waits: bool,
}

/// The recorder's end of the ring.
pub struct CycleSource {
    ring: Consumer<CycleRecord>,
    events: Consumer<CycleEvent>,
    timing: TimingSource,
    due: Arc<AtomicU64>,
}

/// What a finished run holds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RunSummary {
    /// The finished file.
    pub path: PathBuf,
    /// Cycles in it.
    pub cycles: u64,
    /// Cycles in which every encoder is valid.
    pub cycles_valid: u64,
    /// Cycles that were lost between bus and file; each is in the file as lost.
    pub cycles_lost: u64,
    /// Why the run ended.
    pub cause: String,
    /// How well the loop kept its time; none on virtual time.
    pub timing: Option<TimingSummary>,
}

/// A ring of `capacity` cycles between the real-time thread and the recorder.
pub fn ring(capacity: usize, clock: &Clock) -> (CycleSink, CycleSource) {
    let (producer, consumer) = RingBuffer::new(capacity);
    let (events_in, events_out) = RingBuffer::new(EVENTS_MAX);
    let (timing_in, timing_out) = timing_ring(capacity);
    let (due, waits) = (Arc::new(AtomicU64::new(0)), !clock.is_real());
    let sink =
        CycleSink { ring: producer, events: events_in, timing: timing_in, due: Arc::clone(&due), waits };
    (sink, CycleSource { ring: consumer, events: events_out, timing: timing_out, due })
}

impl CycleSink {
    /// Hands over one cycle. Wait-free on real time; a full ring costs the record but not its number.
    pub fn push(&mut self, record: &CycleRecord) {
        self.due.store(record.cycle + 1, Ordering::Release);
        while let Err(PushError::Full(_)) = self.ring.push(*record) {
            if !self.waits || self.ring.is_abandoned() {
                return;
            }
            thread::yield_now();
        }
    }

    /// Hands over what happened on the bus. Wait-free; with a thousand waiting it is dropped.
    pub fn push_event(&mut self, event: CycleEvent) {
        let _ = self.events.push(event);
    }

    /// Hands over how late the cycle was and how long it took; virtual time knows neither. Wait-free.
    pub fn push_timing(&mut self, timing: CycleTiming) {
        if !self.waits {
            self.timing.push(timing);
        }
    }

    /// The recorder has given up; going on makes no sense.
    pub fn is_abandoned(&self) -> bool {
        self.ring.is_abandoned()
    }
}

/// What ties a recorder to the rest while it runs.
pub struct RunLink {
    /// Ends the run when the disk gets full.
    pub stop: Stop,
    /// Markers that people set.
    pub marks: Receiver<String>,
    /// Told after each synchronisation.
    pub progress: Arc<Progress>,
    /// Space that must stay free.
    pub floor: DiskFloor,
    /// The file that is being written.
    pub file: PathBuf,
}

/// Writes what comes out of the ring until its other end is dropped, then finishes the file.
pub struct Recorder {
    source: CycleSource,
    writer: RecordingWriter<RunFile>,
    clock: Clock,
    sync_period: Duration,
    sync_cycles: u64,
    /// That of the run's sample times \[ns\].
    utc_minus_monotonic_ns: i64,
    /// That of the host when it was looked at last \[ns\].
    host_offset_ns: i64,
    cycle_period_ns: i64,
    lost: u64,
    /// Cycles written when the file was last told how well the loop kept its time.
    timed_cycles: u64,
    link: RunLink,
    /// The last cycle written; its number is that of the one that should come next, less one.
    last: Option<CycleRecord>,
}

impl Recorder {
    /// A recorder of the run that `writer` began with `run`; a kill costs the last `sync_period` at most.
    pub fn new(
        source: CycleSource,
        writer: RecordingWriter<RunFile>,
        clock: Clock,
        sync_period: Duration,
        run: &RunMetadata,
        link: RunLink,
    ) -> Self {
        // The other half is for a disk or a processor that is late: the period is a promise.
        let sync_period = sync_period / 2;
        Self {
            source,
            writer,
            host_offset_ns: clock.utc_minus_monotonic_ns(),
            clock,
            sync_period,
            // On virtual time a second of cycles passes in no time at all.
            sync_cycles: (sync_period.as_nanos() as u64 / run.cycle_period_ns.max(1)).max(1),
            utc_minus_monotonic_ns: run.utc_minus_monotonic_ns,
            cycle_period_ns: run.cycle_period_ns as i64,
            lost: 0,
            timed_cycles: 0,
            link,
            last: None,
        }
    }

    /// Runs until the ring's other end is dropped; `cause` is asked for then.
    pub fn run(mut self, cause: impl FnOnce() -> String) -> Result<RunSummary, WriteError> {
        let mut synced_at = Instant::now();
        let mut synced_cycles = 0;
        loop {
            // Asked before emptying: what was pushed before the other end was dropped is still taken.
            let last_round = self.source.ring.is_abandoned();
            while let Ok(record) = self.source.ring.pop() {
                self.take(&record)?;
                if self.writer.cycles() >= synced_cycles + self.sync_cycles {
                    self.sync(&mut synced_at, &mut synced_cycles)?;
                }
            }
            while let Ok(event) = self.source.events.pop() {
                self.writer.write_event(&event.to_event())?;
            }
            self.source.timing.drain();
            self.take_marks()?;
            if last_round {
                break;
            }
            if synced_at.elapsed() >= self.sync_period {
                self.sync(&mut synced_at, &mut synced_cycles)?;
            }
            thread::sleep(DRAIN_PERIOD);
        }
        self.finish(cause())
    }

    fn take(&mut self, record: &CycleRecord) -> Result<(), WriteError> {
        self.fill_lost(record.cycle)?;
        self.writer.write_cycle(record)?;
        self.last = Some(*record);
        Ok(())
    }

    /// Cycles before `until` that the full ring could not take are in the file by number and reason.
    fn fill_lost(&mut self, until: u64) -> Result<(), WriteError> {
        let Some(last) = self.last else { return Ok(()) };
        let first = last.cycle + 1;
        if until <= first {
            return Ok(());
        }
        let lost_at = |cycle: u64| {
            let since_ns = (cycle - last.cycle) as i64 * self.cycle_period_ns;
            CycleRecord::lost(cycle, last.sample_time.plus_ns(since_ns), &last)
        };
        for cycle in first..until {
            self.writer.write_cycle(&lost_at(cycle))?;
        }
        let missing = until - first;
        let text = format!("{missing} cycles lost: the disk did not keep up and the ring was full");
        let time = lost_at(first).sample_time;
        self.lost += missing;
        self.last = Some(lost_at(until - 1));
        self.writer.write_event(&Event { time, cycle: first, kind: EventKind::Gap, text })
    }

    fn sync(&mut self, synced_at: &mut Instant, synced_cycles: &mut u64) -> Result<(), WriteError> {
        // What comes while the disk works waits for the next time, so that the period counts from here.
        *synced_at = Instant::now();
        self.note_clock_step()?;
        self.write_timing_if_due()?;
        self.writer.sync()?;
        *synced_cycles = self.writer.cycles();
        self.link.progress.set(Synced {
            cycles: self.writer.cycles(),
            cycles_valid: self.writer.cycles_valid(),
            cycles_lost: self.lost,
            bytes: std::fs::metadata(&self.link.file).map_or(0, |file| file.len()),
            at: self.clock.now(),
        });
        self.link.progress.set_timing(self.source.timing.summary());
        if let Some(problem) = self.link.floor.problem() {
            self.link.stop.stop(&problem);
        }
        Ok(())
    }

    /// Often at first, so that a short run has it too: whenever it has become twice as long, later in each period.
    fn write_timing_if_due(&mut self) -> Result<(), WriteError> {
        let period_cycles = TIMING_PERIOD.as_nanos() as u64 / self.cycle_period_ns.max(1) as u64;
        let cycles = self.writer.cycles();
        if cycles - self.timed_cycles < self.timed_cycles.min(period_cycles) {
            return Ok(());
        }
        self.timed_cycles = cycles;
        self.write_timing().map(drop)
    }

    fn write_timing(&mut self) -> Result<Option<TimingSummary>, WriteError> {
        self.source.timing.drain();
        let timing = self.source.timing.summary();
        timing.iter().try_for_each(|timing| self.writer.write_timing(timing))?;
        Ok(timing)
    }

    fn take_marks(&mut self) -> Result<(), WriteError> {
        while let Ok(text) = self.link.marks.try_recv() {
            let time = UtcNs(self.clock.now().0 + self.utc_minus_monotonic_ns);
            let cycle = self.last.map_or(0, |last| last.cycle);
            self.writer.write_event(&Event { time, cycle, kind: EventKind::Marker, text })?;
        }
        Ok(())
    }

    /// Sample times keep to the offset of the run's beginning; when the host's UTC leaves it, the file says so.
    fn note_clock_step(&mut self) -> Result<(), WriteError> {
        let offset_ns = self.clock.utc_minus_monotonic_ns();
        let moved_ns = offset_ns - self.host_offset_ns;
        if moved_ns.abs() <= CLOCK_STEP_NS {
            return Ok(());
        }
        self.host_offset_ns = offset_ns;
        let text = format!(
            "host UTC moved by {:.3} ms; sample times keep to the run's first offset",
            moved_ns as f64 * 1e-6
        );
        let (cycle, time) = self.last.map_or((0, UtcNs(0)), |last| (last.cycle, last.sample_time));
        self.writer.write_event(&Event { time, cycle, kind: EventKind::Clock, text })
    }

    fn finish(mut self, cause: String) -> Result<RunSummary, WriteError> {
        let due = self.source.due.load(Ordering::Acquire);
        self.fill_lost(due)?;
        let (cycles, cycles_valid, cycles_lost) =
            (self.writer.cycles(), self.writer.cycles_valid(), self.lost);
        self.note_clock_step()?;
        let timing = self.write_timing()?;
        let ended = self.clock.now().plus_ns(self.utc_minus_monotonic_ns);
        let path = self.writer.finish(&cause, UtcNs(ended.0))?;
        Ok(RunSummary { path, cycles, cycles_valid, cycles_lost, cause, timing })
    }
}

#[cfg(test)]
mod tests;
