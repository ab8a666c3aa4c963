//! Records a run. The recorder takes cycles, events and timing from the ring, and the markers of people, and writes all of
//! them to the file of the run.
//!
//! The recorder has its own thread, which may wait for the disk, so that the cycle never has to wait. Twice per
//! synchronisation period the recorder writes a *chunk*, which contains the cycles since the last chunk. Another
//! thread synchronises the file. If the disk refuses the file, the run moves to another directory. `run::session`
//! starts a recorder for each run.
//!
//! A *note* is an event or a marker in the recorder's memory. It is written just before the cycle in which it happened.

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
use crate::cycle::{BusNames, CycleEvent, CycleTiming, TimingSource, timing_ring};
use crate::problem::{Fact, Problem};
use crate::scheduler::Scheduler;

/// Capacity of the queue of events. The loss of an event does no harm, because the records of the cycles contain the flags.
const EVENTS_MAX: usize = 1024;
/// Largest number of moves of a run to another directory. After a further failure, the run ends with an error.
const MOVES_MAX: u32 = 8;
/// Duration of a usual synchronisation \[ns\]. The timing is recorded at once if a synchronisation takes more than twice
/// this duration, and more than twice the longest duration that was recorded before.
const SYNC_USUAL_NS: u64 = 100_000_000;
/// Longest time between two records of the timing. If a run is killed, the timing of this time may be lost.
const TIMING_PERIOD: Duration = Duration::from_secs(60);
/// Smallest change of UTC against the monotonic clock that counts as a step \[ns\].
const CLOCK_STEP_NS: i64 = 100_000;

/// The end of the ring into which the cycle writes.
pub struct CycleSink {
    ring: Producer<CycleRecord>,
    events: Producer<CycleEvent>,
    timing: Producer<CycleTiming>,
    handed: Arc<Handed>,
    /// Whether the cycle waits for the recorder if the ring is full. If not, the record is lost, and the loss is counted.
    waits: bool,
}

/// The end of the ring from which the recorder reads.
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
    /// Number of cycles in the file.
    pub cycles: u64,
    /// Cycles in which every encoder is valid.
    pub cycles_valid: u64,
    /// Number of cycles that were lost between bus and file. The file contains each of them, marked as lost.
    pub cycles_lost: u64,
    /// Why the run ended.
    pub cause: String,
    /// Whether the counts are measured, simulated or replayed.
    pub provenance: Provenance,
    /// Timing of the cycle; `None` in virtual time.
    pub timing: Option<TimingSummary>,
}

/// What happens to a cycle when the ring is full.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FullRing {
    /// The cycle is dropped and counted as lost. The cycle's thread never waits.
    Drops,
    /// The thread of the cycle waits for the recorder. This is used in virtual time.
    Waits,
}

/// Creates a ring of `capacity` cycles between the real-time thread and the recorder.
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
    /// Number of cycles that were due, and number of cycles that were lost because the ring was full.
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

    /// Timing of the cycle so far; `None` in virtual time.
    pub fn timing(&mut self) -> Option<TimingSummary> {
        self.timing.drain();
        self.timing.summary()
    }

    /// Whether the other end of the ring was dropped. The ring may still contain records.
    pub fn is_over(&self) -> bool {
        self.ring.is_abandoned()
    }
}

impl CycleSink {
    /// Adds one cycle. In real time, this does not wait. If the ring is full, the record is lost and the loss is counted.
    /// The number of a lost record is not used again.
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

    /// Adds an event, without waiting. If the queue is full, the event is dropped.
    pub fn push_event(&mut self, event: CycleEvent) {
        let _ = self.events.push(event);
    }

    /// Adds the timing of a cycle, without waiting. No effect in virtual time.
    pub fn push_timing(&mut self, timing: CycleTiming) {
        if !self.waits {
            // If the ring is full, only one entry of a histogram is lost. It is not worthwhile to wait for that.
            let _ = self.timing.push(timing);
        }
    }

    /// Whether the recorder has ended.
    pub fn is_abandoned(&self) -> bool {
        self.ring.is_abandoned()
    }
}

/// A marker that a person has set.
#[derive(Debug)]
pub struct Marker {
    /// Time of the marker.
    pub at: MonoNs,
    /// Text of the marker.
    pub text: String,
}

/// Connections of a recorder to other threads, for the duration of a run.
pub struct RunLink {
    /// Markers that people set.
    pub marks: Receiver<Marker>,
    /// Progress of the run, for other threads.
    pub progress: Arc<RunProgress>,
    /// Provides another directory if the run's own is lost.
    pub storage: Storage,
    /// Runs the synchronisations, which wait for the disk.
    pub scheduler: Arc<dyn Scheduler>,
}

/// Writes the content of the ring to the file until the other end of the ring is dropped, then finishes the file. Cycles
/// that are written survive a kill of the program. Another thread then synchronises the file; after that, the cycles survive
/// a power failure. While the disk accepts no data, cycles wait in the ring.
pub struct Recorder {
    source: CycleSource,
    writer: RecordingWriter<RunFile>,
    synchroniser: Synchroniser,
    clock: Clock,
    /// Time from one chunk to the next.
    period: Duration,
    /// Largest number of cycles in a chunk. When it is reached, the chunk is written at once.
    chunk_cycles: u64,
    /// `UTC - monotonic` of the run's sample times \[ns\].
    utc_minus_monotonic_ns: i64,
    /// `UTC - monotonic` of the host when it was last read \[ns\]. If this value changes, the host's UTC has stepped.
    host_offset_ns: i64,
    cycle_period_ns: i64,
    provenance: Provenance,
    names: BusNames,
    /// Longest wait for the disk for which an event was recorded \[s\].
    noted_wait_s: f64,
    /// Number of cycles that the full ring dropped. The file contains them, marked as lost.
    cycles_lost: u64,
    /// Number of cycles that were written when the timing was last recorded.
    timing_cycles: u64,
    /// Longest synchronisation at the time when the timing was last recorded \[ns\].
    timing_sync_ns: u64,
    /// Number of cycles that were written when the last chunk was cut.
    chunk_end_cycles: u64,
    /// Time at which the last chunk was cut.
    chunk_at: MonoNs,
    /// Notes in order of time. Each note is written just before the cycle in which it happened.
    notes: Vec<Event>,
    /// Error counts of ports. Each is valid from the cycle with the given number on.
    port_counts: VecDeque<(u64, PortCounts)>,
    /// Number of moves to another directory so far.
    moves: u32,
    link: RunLink,
    /// The last cycle written.
    last: Option<CycleRecord>,
}

impl Recorder {
    /// Period in which the ring must be emptied.
    pub const PERIOD: Duration = Duration::from_millis(20);

    /// A recorder for the run that `writer` has begun with the metadata `run`.
    pub fn new(
        source: CycleSource,
        writer: RecordingWriter<RunFile>,
        run: &RunMetadata,
        link: RunLink,
    ) -> Self {
        let synchroniser = Synchroniser::new(&link.progress, &*link.scheduler);
        let clock = link.scheduler.clock().clone();
        // Half of the configured period is used. The other half is a margin for a busy disk or processor.
        let period = link.progress.limits.sync_period / 2;
        // UTC may have stepped since the run began. With cycles that wait, the run has a UTC of its own, for example that of
        // a replayed recording.
        let host_offset_ns = if link.progress.limits.cycle_waits {
            clock.utc_minus_monotonic_ns()
        } else {
            run.utc_minus_monotonic_ns
        };
        Self {
            source,
            synchroniser,
            writer,
            host_offset_ns,
            chunk_end_cycles: 0,
            chunk_at: clock.now(),
            clock,
            period,
            // In virtual time, or after a wait for the disk, the cycles of a whole second can arrive at once.
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

    /// Takes the content of the ring, and writes a chunk if its time has come. Must be called every [`Self::PERIOD`]. The
    /// call does not sleep, but waits for the disk. Returns false if the other end of the ring was dropped, the ring is empty
    /// and no synchronisation is in progress. In that case [`Self::finish`] must be called.
    pub fn poll(&mut self) -> Result<bool, WriteError> {
        // This must be read before the ring is emptied. Otherwise cycles could be pushed in between, just before the other
        // end is dropped, and would stay in the ring.
        let last_round = self.source.ring.is_abandoned();
        self.take_notes();
        while let Ok(record) = self.source.ring.pop() {
            // An event is pushed before the cycle in which it happened. It must therefore be taken
            // before this cycle is added.
            self.take_notes();
            self.add_cycle(&record)?;
            if self.writer.cycles() >= self.chunk_end_cycles + self.chunk_cycles {
                self.write_chunk()?;
            }
        }
        self.source.timing.drain();
        // Move the run if a synchronisation has failed, or if the file is not in its place.
        if let Some(problem) = self.synchroniser.problem() {
            self.move_elsewhere(WriteError::Sink(problem))?;
        }
        if last_round {
            // The system reports a failed write only once. If the synchronisation in progress receives this error, the last
            // one would succeed although data are lost.
            return Ok(self.synchroniser.is_busy());
        }
        if self.clock.now().ns_since(self.chunk_at) >= self.period.as_nanos() as i64 {
            self.write_chunk()?;
        }
        // Another thread has reported that the file is missing. The file may have returned since.
        if self.link.progress.lost().is_some() {
            match self.writer.sink().place().check() {
                Ok(()) => self.link.progress.found_again(),
                Err(lost) => self.move_elsewhere(lost)?,
            }
        }
        Ok(true)
    }

    /// Adds one cycle to the chunk. First adds the lost cycles and the notes before this cycle.
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

    /// Adds the cycles before `until` that were dropped because the ring was full. They are marked as lost. No cycle can be
    /// dropped before the first record, because the ring is empty when a run begins.
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

    /// Writes the chunk with all cycles taken so far. Then starts a synchronisation, unless the
    /// previous one is still running.
    fn write_chunk(&mut self) -> Result<(), WriteError> {
        // The next chunk begins here, because cycles that arrive while the disk works belong to it.
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

    /// Adds an event if cycles have waited long for the disk. Another event is added only when a wait is twice as long as
    /// the last one for which an event was added.
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

    /// The content of the file that a synchronisation beginning now would make safe.
    fn as_synced(&self) -> Synced {
        Synced {
            cycles: self.writer.cycles(),
            cycles_valid: self.writer.cycles_valid(),
            bytes: self.writer.sink().length(),
            at: Some(self.clock.now()),
        }
    }

    /// Moves the run to another directory if the disk has refused its file. Passes on other errors.
    fn move_if_refused(&mut self, outcome: Result<(), WriteError>) -> Result<(), WriteError> {
        match outcome {
            Err(error @ (WriteError::Sink(_) | WriteError::Io { .. } | WriteError::Lost(_))) => {
                self.move_elsewhere(error)
            }
            outcome => outcome,
        }
    }

    /// Moves the run with all its cycles to the first directory that accepts it. If the file was lost, the directory of
    /// recordings is tried first, then the spare directory. If the disk refused the file, only the spare directory is tried.
    fn move_elsewhere(&mut self, why: WriteError) -> Result<(), WriteError> {
        self.moves += 1;
        if self.moves > MOVES_MAX {
            return Err(why);
        }
        // No cycle is reported as safe until the run has moved.
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
        // The previous synchroniser may hang on the lost disk, so a new one is created.
        self.synchroniser = Synchroniser::new(&self.link.progress, &*self.link.scheduler);
        self.link.progress.moved(place, why.to_string());
        self.note_disk(moved);
    }

    /// Writes the timing in three cases. At the beginning, it is written whenever the run has doubled in length, so that a
    /// short run also contains timing. Later, it is written once per period. It is also written when a synchronisation took
    /// more than twice as long as the longest one recorded before.
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

    /// Timing of cycle and disk so far. `None` in virtual time.
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

    /// Takes events of the bus and markers, and keeps them as notes with their own times.
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

    /// Number of the cycle at `time`, computed from the last cycle and the period.
    fn cycle_at(&self, time: UtcNs) -> u64 {
        let Some(last) = self.last else { return 0 };
        let cycles_later = time.ns_since(last.sample_time).div_euclid(self.cycle_period_ns.max(1));
        last.cycle.saturating_add_signed(cycles_later)
    }

    /// Adds a note at its place in the order of time.
    fn note(&mut self, event: Event) {
        let index = self.notes.partition_point(|other| other.time <= event.time);
        self.notes.insert(index, event);
    }

    /// Adds a note about a problem of the disk, with the current time.
    fn note_disk(&mut self, fact: Fact) {
        let time = UtcNs(self.clock.now().0 + self.utc_minus_monotonic_ns);
        self.note(event_of(time, self.cycle_at(time), EventKind::Disk, fact));
    }

    /// Writes the notes up to the time `until`. Readers then find each note next to the cycles of the same time.
    fn write_notes(&mut self, until: UtcNs) -> Result<(), WriteError> {
        while self.notes.first().is_some_and(|note| note.time <= until) {
            let note = self.notes.remove(0);
            let written = self.writer.write_event(&note);
            self.move_if_refused(written)?;
        }
        Ok(())
    }

    /// Adds a note if the host's UTC has stepped. The sample times of the run do not change, because they contain the offset
    /// from the beginning of the run.
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

    /// Writes the remaining cycles, then ends the file and gives it its final name.
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
        // `publish` has synchronised the file. No synchroniser has the number 0.
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
