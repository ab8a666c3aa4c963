//! Takes cycles, events and timing of a run from the ring, and markers of people, and writes them to the run's file. It works
//! in a thread that may wait for the disk, so that the cycle never does. Twice per synchronisation period it writes a chunk,
//! which another thread synchronises. If the disk refuses the file, the run moves to another directory. `run::session` starts a
//! recorder for each run.

use std::collections::VecDeque;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::Receiver;
use std::thread;
use std::time::Duration;

use rtrb::{Consumer, Producer, PushError, RingBuffer};
use shared::recording::schema::{CycleRecord, Event, EventKind, PortCounts, Provenance, RunMetadata};
use shared::recording::{RecordingWriter, RunFile, TimingSummary, WriteError};
use shared::time::{MonoNs, UtcNs};

use super::progress::{Handed, RunProgress, Synced};
use super::storage::Storage;
use super::synchroniser::Synchroniser;
use crate::clock::Clock;
use crate::cycle::{BusNames, CycleEvent, CycleTiming, TimingSink, TimingSource, timing_ring};
use crate::problem::{Fact, Problem};
use crate::scheduler::Scheduler;

/// Queue of events; cycles carry their flags themselves, so that a lost event does no harm.
const EVENTS_MAX: usize = 1024;
/// Moves of a run to another place before it is given up.
const MOVES_MAX: u32 = 8;
/// Duration of a usual synchronisation. One that takes more than twice this, and twice any before, has the timing recorded
/// at once \[ns\].
const SYNC_USUAL_NS: u64 = 100_000_000;
/// The cycle's timing is recorded at least this often, for a run that is killed.
const TIMING_PERIOD: Duration = Duration::from_secs(60);
/// A larger change of UTC against the monotonic clock is a step \[ns\].
const CLOCK_STEP_NS: i64 = 100_000;

/// The cycle's end of the ring.
pub struct CycleSink {
    ring: Producer<CycleRecord>,
    events: Producer<CycleEvent>,
    timing: TimingSink,
    handed: Arc<Handed>,
    /// A full ring makes the cycle wait for the recorder; otherwise its record is lost and counted.
    waits: bool,
}

/// The recorder's end of the ring.
pub struct CycleSource {
    ring: Consumer<CycleRecord>,
    events: Consumer<CycleEvent>,
    timing: TimingSource,
    handed: Arc<Handed>,
}

/// Summary of a finished run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RunSummary {
    /// Path of the finished file.
    pub path: PathBuf,
    /// Number of cycles in it.
    pub cycles: u64,
    /// Cycles in which every encoder is valid.
    pub cycles_valid: u64,
    /// Cycles that were lost between bus and file; each is in the file as lost.
    pub cycles_lost: u64,
    /// Why the run ended.
    pub cause: String,
    /// Whether its counts are measured, simulated or replayed.
    pub provenance: Provenance,
    /// Timing of the cycle; `None` on virtual time.
    pub timing: Option<TimingSummary>,
}

/// Treatment of a cycle when the ring is full.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FullRing {
    /// It is counted as lost: the cycle never waits.
    Drops,
    /// It waits for the recorder, on virtual time.
    Waits,
}

/// A ring of `capacity` cycles between the real-time thread and the recorder.
pub fn ring(capacity: usize, full: FullRing) -> (CycleSink, CycleSource) {
    let (producer, consumer) = RingBuffer::new(capacity);
    let (events_in, events_out) = RingBuffer::new(EVENTS_MAX);
    let (timing_in, timing_out) = timing_ring(capacity);
    let (handed, waits) = (Arc::<Handed>::default(), full == FullRing::Waits);
    let sink = CycleSink {
        ring: producer,
        events: events_in,
        timing: timing_in,
        handed: Arc::clone(&handed),
        waits,
    };
    (sink, CycleSource { ring: consumer, events: events_out, timing: timing_out, handed })
}

impl CycleSource {
    /// Counts of the cycles that were due and of those that were lost.
    pub fn handed(&self) -> &Arc<Handed> {
        &self.handed
    }

    /// Takes the next cycle.
    pub fn take(&mut self) -> Option<CycleRecord> {
        self.ring.pop().ok()
    }

    /// Takes the next event.
    pub fn take_event(&mut self) -> Option<CycleEvent> {
        self.events.pop().ok()
    }

    /// Timing of the cycle so far; `None` on virtual time.
    pub fn timing(&mut self) -> Option<TimingSummary> {
        self.timing.drain();
        self.timing.summary()
    }

    /// Whether the other end is dropped; some content may remain.
    pub fn is_over(&self) -> bool {
        self.ring.is_abandoned()
    }
}

impl CycleSink {
    /// Adds one cycle. Wait-free on real time; a full ring loses the record but not its number, and counts the loss.
    pub fn push(&mut self, record: &CycleRecord) {
        self.handed.due.store(record.cycle + 1, Ordering::Release);
        while let Err(PushError::Full(_)) = self.ring.push(*record) {
            if !self.waits || self.ring.is_abandoned() {
                self.handed.lost.fetch_add(1, Ordering::Relaxed);
                return;
            }
            thread::yield_now();
        }
    }

    /// Adds an event. Wait-free; dropped if the queue is full.
    pub fn push_event(&mut self, event: CycleEvent) {
        let _ = self.events.push(event);
    }

    /// Adds the timing of a cycle, except on virtual time. Wait-free.
    pub fn push_timing(&mut self, timing: CycleTiming) {
        if !self.waits {
            self.timing.push(timing);
        }
    }

    /// Whether the recorder has given up.
    pub fn is_abandoned(&self) -> bool {
        self.ring.is_abandoned()
    }
}

/// A marker that a person set.
#[derive(Debug)]
pub struct Marker {
    /// Time of the marker.
    pub at: MonoNs,
    /// Text of the marker.
    pub text: String,
}

/// Connections of a recorder while it runs.
pub struct RunLink {
    /// Markers that people set.
    pub marks: Receiver<Marker>,
    /// Progress of the run, for other threads.
    pub progress: Arc<RunProgress>,
    /// Provides another place if the run's own is lost.
    pub storage: Storage,
    /// Runs the synchronisations, which wait for the disk.
    pub scheduler: Arc<dyn Scheduler>,
}

/// Writes the content of the ring until its other end is dropped, then finishes the file. Cycles are written each period,
/// after which they survive a kill of the program; another thread synchronises them, after which they survive a power
/// failure. While the disk accepts nothing the cycles wait in the ring.
pub struct Recorder {
    source: CycleSource,
    writer: RecordingWriter<RunFile>,
    synchroniser: Synchroniser,
    clock: Clock,
    period: Duration,
    /// A chunk with this number of cycles is written before its period is over.
    chunk_cycles: u64,
    /// `UTC - monotonic` of the run's sample times \[ns\].
    utc_minus_monotonic_ns: i64,
    /// `UTC - monotonic` of the host when it was last read \[ns\].
    host_offset_ns: i64,
    cycle_period_ns: i64,
    provenance: Provenance,
    names: BusNames,
    /// The longest wait for the disk that was recorded \[s\].
    noted_wait_s: f64,
    /// Cycles that the full ring dropped, and that are in the file as lost.
    cycles_lost: u64,
    /// Cycles written when the timing was last recorded.
    timing_cycles: u64,
    /// The longest synchronisation until then \[ns\].
    timing_sync_ns: u64,
    /// Cycles written up to the last chunk.
    chunk_end_cycles: u64,
    /// When the last chunk was written.
    chunk_at: MonoNs,
    /// Events and markers, by time, that wait for the cycle before which they happened.
    notes: Vec<Event>,
    /// Error counts of ports, with the cycle from which they apply.
    port_counts: VecDeque<(u64, PortCounts)>,
    moves: u32,
    link: RunLink,
    /// The last cycle written.
    last: Option<CycleRecord>,
}

impl Recorder {
    /// Period in which the ring is emptied.
    pub const PERIOD: Duration = Duration::from_millis(20);

    /// A recorder of the run that `writer` began with `run`.
    pub fn new(
        source: CycleSource,
        writer: RecordingWriter<RunFile>,
        run: &RunMetadata,
        link: RunLink,
    ) -> Self {
        let synchroniser = Synchroniser::new(&link.progress, &*link.scheduler);
        let clock = link.scheduler.clock().clone();
        // Half of it: the other half is a margin for a late disk or processor.
        let period = link.progress.sync_period() / 2;
        Self {
            source,
            synchroniser,
            writer,
            host_offset_ns: clock.utc_minus_monotonic_ns(),
            chunk_end_cycles: 0,
            chunk_at: clock.now(),
            clock,
            period,
            // On virtual time, and after a wait, a second of cycles arrives at once.
            chunk_cycles: (period.as_nanos() as u64 / run.cycle_period_ns.max(1)).max(1),
            utc_minus_monotonic_ns: run.utc_minus_monotonic_ns,
            cycle_period_ns: run.cycle_period_ns as i64,
            provenance: run.provenance(),
            names: BusNames::new(run),
            noted_wait_s: 0.0,
            cycles_lost: 0,
            timing_cycles: 0,
            timing_sync_ns: 0,
            notes: Vec::new(),
            port_counts: VecDeque::new(),
            moves: 0,
            link,
            last: None,
        }
    }

    /// Takes the ring's content and writes it if that is due. Returns false once the ring's other end was dropped and all is
    /// taken: then call [`Self::finish`]. To be called each [`Self::PERIOD`]; never sleeps, but waits for the disk.
    pub fn poll(&mut self) -> Result<bool, WriteError> {
        // Read before emptying: cycles pushed before the other end was dropped are still taken.
        let last_round = self.source.ring.is_abandoned();
        self.take_notes();
        while let Ok(record) = self.source.ring.pop() {
            // Events were pushed before the cycle in which they happened.
            self.take_notes();
            self.add_cycle(&record)?;
            if self.writer.cycles() >= self.chunk_end_cycles + self.chunk_cycles {
                self.write_chunk()?;
            }
        }
        self.source.timing.drain();
        if last_round {
            return Ok(false);
        }
        if self.clock.now().ns_since(self.chunk_at) >= self.period.as_nanos() as i64 {
            self.write_chunk()?;
        }
        if let Some(problem) = self.synchroniser.problem() {
            self.move_elsewhere(WriteError::Sink(problem))?;
        }
        // Another thread has missed the file; it may be in its place again.
        if self.link.progress.lost().is_some() {
            match self.writer.sink().place().check() {
                Ok(()) => self.link.progress.found_again(),
                Err(lost) => self.move_elsewhere(lost)?,
            }
        }
        Ok(true)
    }

    /// Adds one cycle to the chunk, after the lost cycles and the notes that precede it.
    fn add_cycle(&mut self, record: &CycleRecord) -> Result<(), WriteError> {
        self.fill_lost(record.cycle)?;
        self.write_notes(record.sample_time)?;
        while let Some((cycle, counts)) = self.port_counts.front()
            && *cycle <= record.cycle
        {
            self.writer.set_port_counts(*counts);
            self.port_counts.pop_front();
        }
        let written = self.writer.write_cycle(record);
        self.last = Some(*record);
        self.move_if_refused(written)
    }

    /// Adds the cycles before `until` that the full ring dropped, by number and reason. None precedes the first record: cycle 0
    /// of a run finds an empty ring.
    fn fill_lost(&mut self, until: u64) -> Result<(), WriteError> {
        let Some(last) = self.last else { return Ok(()) };
        let first = last.cycle + 1;
        if until <= first {
            return Ok(());
        }
        let cycle_period_ns = self.cycle_period_ns;
        let lost_at = |cycle: u64| {
            let since_ns = (cycle - last.cycle) as i64 * cycle_period_ns;
            CycleRecord::lost(cycle, last.sample_time.plus_ns(since_ns), &last)
        };
        for cycle in first..until {
            let written = self.writer.write_cycle(&lost_at(cycle));
            self.move_if_refused(written)?;
        }
        let missing = until - first;
        let time = lost_at(first).sample_time;
        self.cycles_lost += missing;
        self.last = Some(lost_at(until - 1));
        self.note(event_of(time, first, EventKind::Gap, Fact::CyclesLost { cycles: missing }));
        Ok(())
    }

    /// Writes all cycles taken, and synchronises them unless the previous synchronisation is still running.
    fn write_chunk(&mut self) -> Result<(), WriteError> {
        // Cycles that arrive while the disk works wait for the next chunk, so the period starts here.
        self.chunk_end_cycles = self.writer.cycles();
        self.chunk_at = self.clock.now();
        self.link.progress.writing();
        self.note_clock_step();
        self.write_notes(self.last.map_or(UtcNs(i64::MIN), |last| last.sample_time))?;
        self.write_timing_if_due()?;
        let written = self.writer.cut();
        self.move_if_refused(written)?;
        self.note_wait();
        self.link.progress.wrote(self.writer.cycles(), self.cycles_lost);
        let timing = self.timing();
        self.link.progress.set_figures(timing, self.writer.flagged());
        self.synchroniser.begin(self.writer.sink().synchroniser(), self.as_synced());
        Ok(())
    }

    /// Records a wait for the disk, and again whenever one takes twice as long.
    fn note_wait(&mut self) {
        let late = self.link.progress.get().problems.into_iter().find_map(|problem| match *problem.fact {
            Fact::DiskBacklog { backlog_s: late_s, .. } | Fact::DiskSlow { unsynced_s: late_s } => {
                Some((late_s, problem))
            }
            _ => None,
        });
        let Some((late_s, problem)) = late.filter(|(late_s, _)| *late_s >= 2.0 * self.noted_wait_s) else {
            return;
        };
        self.noted_wait_s = late_s;
        self.note_disk(*problem.fact);
    }

    /// The extent that a synchronisation of the file would cover now.
    fn as_synced(&self) -> Synced {
        Synced {
            cycles: self.writer.cycles(),
            cycles_valid: self.writer.cycles_valid(),
            bytes: self.writer.sink().length(),
            at: Some(self.clock.now()),
        }
    }

    /// Moves the run elsewhere if the disk refused its file.
    fn move_if_refused(&mut self, outcome: Result<(), WriteError>) -> Result<(), WriteError> {
        match outcome {
            Err(error @ (WriteError::Sink(_) | WriteError::Io { .. } | WriteError::Lost(_))) => {
                self.move_elsewhere(error)
            }
            outcome => outcome,
        }
    }

    /// Moves the run with all its cycles to the first place that accepts it. A lost file may start again in its place; a disk
    /// that refused is not tried again.
    fn move_elsewhere(&mut self, why: WriteError) -> Result<(), WriteError> {
        self.moves += 1;
        if self.moves > MOVES_MAX {
            return Err(why);
        }
        // Nothing is reported as safe until the run is moved.
        self.link.progress.set_lost(self.writer.sink().place(), why.to_string());
        let storage = &self.link.storage;
        let (directory, spare) = (storage.directory().to_owned(), storage.spare().to_owned());
        let candidates = [matches!(why, WriteError::Lost(_)).then_some(directory), Some(spare)];
        for candidate in candidates.into_iter().flatten() {
            if let Some(full) = storage.full(&candidate) {
                tracing::warn!("{why}; cannot move the run to {}: {full}", candidate.display());
                continue;
            }
            let moved = self.writer.sink_mut().move_to(&candidate).and_then(|()| self.writer.write_out());
            match moved {
                Ok(()) => {
                    self.continue_after_move(&why);
                    return Ok(());
                }
                Err(error) => {
                    tracing::warn!("{why}; cannot move the run to {}: {error}", candidate.display());
                }
            }
        }
        Err(why)
    }

    fn continue_after_move(&mut self, why: &WriteError) {
        let place = self.writer.sink().place().clone();
        let moved = Fact::FileMoved { file: place.path().to_owned(), error: why.to_string() };
        // The previous synchroniser may hang on the lost disk.
        self.synchroniser = Synchroniser::new(&self.link.progress, &*self.link.scheduler);
        self.link.progress.moved(place, why.to_string());
        self.note_disk(moved);
    }

    /// Due whenever the run has doubled in length, later once per period, so that a short run has timing, too; and whenever a
    /// synchronisation took twice as long as any before.
    fn write_timing_if_due(&mut self) -> Result<(), WriteError> {
        let period_cycles = TIMING_PERIOD.as_nanos() as u64 / self.cycle_period_ns.max(1) as u64;
        let (cycles, sync_ns) = (self.writer.cycles(), self.link.progress.longest().sync_longest_ns);
        let is_slower = sync_ns > 2 * self.timing_sync_ns.max(SYNC_USUAL_NS);
        if cycles - self.timing_cycles < self.timing_cycles.min(period_cycles) && !is_slower {
            return Ok(());
        }
        (self.timing_cycles, self.timing_sync_ns) = (cycles, sync_ns);
        self.write_timing().map(drop)
    }

    /// Timing of cycle and disk so far; `None` on virtual time.
    fn timing(&mut self) -> Option<TimingSummary> {
        let disk = self.link.progress.longest();
        self.source.timing().map(|timing| TimingSummary { disk, ..timing })
    }

    fn write_timing(&mut self) -> Result<Option<TimingSummary>, WriteError> {
        let Some(timing) = self.timing() else { return Ok(None) };
        let written = self.writer.write_timing(&timing);
        self.move_if_refused(written)?;
        Ok(Some(timing))
    }

    /// Takes events of the bus and markers, each with its own time.
    fn take_notes(&mut self) {
        while let Ok(event) = self.source.events.pop() {
            self.port_counts.extend(event.port_counts().map(|counts| (event.cycle, counts)));
            if event.is_news() {
                self.note(event.to_event(&self.names));
            }
        }
        while let Ok(Marker { at, text }) = self.link.marks.try_recv() {
            let time = UtcNs(at.0 + self.utc_minus_monotonic_ns);
            let (cycle, code) = (self.cycle_at(time), String::new());
            self.note(Event { time, cycle, kind: EventKind::Marker, text, code });
        }
    }

    /// The cycle at `time`, assuming one cycle per period.
    fn cycle_at(&self, time: UtcNs) -> u64 {
        let Some(last) = self.last else { return 0 };
        let cycles_later = time.ns_since(last.sample_time).div_euclid(self.cycle_period_ns.max(1));
        last.cycle.saturating_add_signed(cycles_later)
    }

    /// Adds an event or marker to those that wait for their cycle.
    fn note(&mut self, event: Event) {
        let index = self.notes.partition_point(|other| other.time <= event.time);
        self.notes.insert(index, event);
    }

    /// Records a problem of the disk at this moment.
    fn note_disk(&mut self, fact: Fact) {
        let time = UtcNs(self.clock.now().0 + self.utc_minus_monotonic_ns);
        self.note(event_of(time, self.cycle_at(time), EventKind::Disk, fact));
    }

    /// Writes events up to `until`, so that readers find each among the cycles of its time.
    fn write_notes(&mut self, until: UtcNs) -> Result<(), WriteError> {
        while self.notes.first().is_some_and(|note| note.time <= until) {
            let note = self.notes.remove(0);
            let written = self.writer.write_event(&note);
            self.move_if_refused(written)?;
        }
        Ok(())
    }

    /// Sample times keep the offset of the run's beginning; a step of the host's UTC is recorded.
    fn note_clock_step(&mut self) {
        let offset_ns = self.clock.utc_minus_monotonic_ns();
        let moved_ns = offset_ns - self.host_offset_ns;
        if moved_ns.abs() <= CLOCK_STEP_NS {
            return;
        }
        self.host_offset_ns = offset_ns;
        let (cycle, time) = self.last.map_or((0, UtcNs(0)), |last| (last.cycle, last.sample_time));
        self.note(event_of(time, cycle, EventKind::Clock, Fact::ClockStepped { by_ns: moved_ns }));
    }

    /// Writes the remaining cycles and finishes the file.
    pub fn finish(mut self, cause: String) -> Result<RunSummary, WriteError> {
        let due = self.source.handed.due.load(Ordering::Acquire);
        self.fill_lost(due)?;
        self.take_notes();
        self.note_clock_step();
        if let Some(problem) = self.link.storage.problem() {
            self.note_disk(*problem.fact);
        }
        self.write_notes(UtcNs(i64::MAX))?;
        let timing = self.write_timing()?;
        let (cycles, cycles_valid, cycles_lost) =
            (self.writer.cycles(), self.writer.cycles_valid(), self.cycles_lost);
        let ended = self.clock.now().plus_ns(self.utc_minus_monotonic_ns);
        self.link.progress.writing();
        let closed = self.writer.close(&cause, UtcNs(ended.0));
        self.move_if_refused(closed)?;
        self.link.progress.wrote(cycles, cycles_lost);
        let path = loop {
            match self.writer.sink_mut().publish() {
                Ok(path) => break path,
                outcome => self.move_if_refused(outcome.map(drop))?,
            }
        };
        // `publish` has synchronised the file; 0 is the number of no synchroniser.
        self.link.progress.synced(0, Some(self.as_synced()));
        Ok(RunSummary { path, cycles, cycles_valid, cycles_lost, cause, provenance: self.provenance, timing })
    }
}

fn event_of(time: UtcNs, cycle: u64, kind: EventKind, fact: Fact) -> Event {
    let code = fact.code().to_owned();
    Event { time, cycle, kind, text: Problem::from(fact).text, code }
}

#[cfg(test)]
mod tests;
