//! Recovery of recordings after a crash, a disk failure or a flipped bit. Either the undamaged cycles are recovered, or the
//! file is refused. The result never contains wrong data.
#![allow(unsafe_code, clippy::unwrap_used, clippy::panic, reason = "tests; an allocator that looks")]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::io::{self, Cursor, Read, Seek, SeekFrom};

use proptest::prelude::*;
use rand::{Rng, SeedableRng, rngs::StdRng};
use shared::recording::schema::{CycleRecord, Event, EventKind, RunMetadata, flags};
use shared::recording::{Recording, RecordingWriter, SalvageError, WriteError, salvage, verify};
use shared::time::UtcNs;

use crate::support::disk::DiskFile;
use crate::support::run::{START, cycle, run, timing};

/// An allocator that stores the size of the largest allocation of the calling thread \[bytes\].
struct Watching;

thread_local! {
    static LARGEST: Cell<usize> = const { Cell::new(0) };
}

// SAFETY: all calls are passed to the system allocator unchanged.
unsafe impl GlobalAlloc for Watching {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        LARGEST.set(LARGEST.get().max(layout.size()));
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        LARGEST.set(LARGEST.get().max(size));
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Watching = Watching;

/// Number of cycles between two synchronisations.
const SYNC_CYCLES: u64 = 4;
const CYCLES: u64 = 16;
/// Distance between the bytes that a test damages. The campaign damages every byte.
const STEP: usize = 29;

fn small_run() -> RunMetadata {
    let mut run = run("small");
    run.encoders.truncate(2);
    run
}

fn small_cycle(number: u64) -> CycleRecord {
    CycleRecord { encoder_count: 2, ..cycle(number) }.only_used()
}

trait OnlyUsed {
    fn only_used(self) -> Self;
}

impl OnlyUsed for CycleRecord {
    /// Clears the entries after the used encoders, because the file does not contain them.
    fn only_used(mut self) -> Self {
        let used = usize::from(self.encoder_count);
        self.encoders[used..].fill_with(Default::default);
        self
    }
}

fn marker(number: u64) -> Event {
    Event {
        time: cycle(number).sample_time,
        cycle: number,
        kind: EventKind::Marker,
        text: format!("m{number}"),
        code: String::new(),
    }
}

/// Writes the run until all cycles are written or the disk refuses a write.
fn write_until_refused(disk: DiskFile) -> Result<RecordingWriter<DiskFile>, WriteError> {
    let mut writer = RecordingWriter::begin(disk, &small_run())?;
    for number in 0..CYCLES {
        writer.write_cycle(&small_cycle(number))?;
        if number % SYNC_CYCLES == SYNC_CYCLES - 1 {
            writer.write_event(&marker(number))?;
            writer.sync()?;
        }
    }
    Ok(writer)
}

/// The bytes of an unfinished run, and the lengths of its file at its synchronisations.
fn unfinished() -> (Vec<u8>, Vec<usize>) {
    let disk = DiskFile::default();
    let writer = write_until_refused(disk.clone()).unwrap();
    let (bytes, synced) = (disk.bytes(), disk.0.borrow().synced.clone());
    drop(writer);
    (bytes, synced)
}

fn finished() -> Vec<u8> {
    let disk = DiskFile::default();
    let mut writer = write_until_refused(disk.clone()).unwrap();
    writer.write_timing(&timing()).unwrap();
    writer.end("stopped", START).unwrap();
    disk.bytes()
}

/// Recovers `bytes` and returns the number of recovered cycles, or `None` if the file is refused. Recovered cycles must
/// equal the original ones. All other cycles must be flagged as lost.
fn true_cycles_in(bytes: &[u8]) -> Option<u64> {
    let (salvaged, recovered) = match salvage(Cursor::new(bytes), Cursor::new(Vec::new())) {
        Ok(whole) => whole,
        Err(SalvageError::NothingWhole(_)) => return None,
        Err(other) => panic!("{other}"),
    };
    let recovered = recovered.into_inner();
    verify(&recovered[..], &salvaged).unwrap();
    let recording = Recording::read(&recovered[..]).unwrap();
    assert_eq!(recording.run, small_run());
    let kept = true_cycles_of(&recording, small_cycle);
    let markers: Vec<_> = (0..CYCLES).filter(|n| n % SYNC_CYCLES == SYNC_CYCLES - 1).map(marker).collect();
    let mut told = recording.events.iter().filter(|event| event.kind == EventKind::Marker);
    let mut markers = markers.iter();
    assert!(told.all(|one| markers.any(|marker| marker == one)), "{:?}", recording.events);
    assert!(recording.end.recovered && recording.end.cause.contains("recovered"), "{}", recording.end.cause);
    assert_eq!(salvaged.cycles - salvaged.cycles_lost, kept);
    Some(kept)
}

/// Number of cycles that equal those of `truth`. Each other cycle must be flagged as lost and have no data.
fn true_cycles_of(recording: &Recording, truth: impl Fn(u64) -> CycleRecord) -> u64 {
    let lost: Vec<_> = recording.cycles.iter().filter(|cycle| cycle.flags & flags::LOST != 0).collect();
    for cycle in &lost {
        let expected = truth(cycle.cycle);
        assert_eq!(**cycle, CycleRecord::lost(cycle.cycle, cycle.sample_time, &expected));
        assert!(cycle.sample_time.ns_since(expected.sample_time).abs() < 1_000_000, "{cycle:?}");
    }
    assert_eq!(recording.end.cycles_lost, lost.len() as u64);
    let kept = recording.cycles.iter().filter(|cycle| cycle.flags & flags::LOST == 0);
    assert!(kept.clone().all(|cycle| *cycle == truth(cycle.cycle)));
    kept.count() as u64
}

fn cycles_synced_within(length: usize, synced: &[usize]) -> Option<u64> {
    // The first synchronisation only covers the metadata.
    (synced.iter().filter(|&&at| at <= length).count() as u64).checked_sub(1).map(|n| n * SYNC_CYCLES)
}

#[test]
fn every_prefix_gives_all_that_was_synchronised_in_it() {
    every_prefix_gives_all_that_was_synchronised_in_it_by(STEP);
}

fn every_prefix_gives_all_that_was_synchronised_in_it_by(step: usize) {
    let (bytes, synced) = unfinished();
    for length in (0..=bytes.len()).step_by(step) {
        let expected = cycles_synced_within(length, &synced);
        let found = true_cycles_in(&bytes[..length]);
        assert!(found >= expected, "{length} of {} bytes: {found:?} of {expected:?} cycles", bytes.len());
    }
    assert_eq!(true_cycles_in(&bytes), Some(CYCLES));
}

/// Flips each single bit of the bytes at these positions in turn, and calls `look` with the damaged bytes and a description.
fn for_each_flipped_bit(
    bytes: &[u8],
    positions: impl Iterator<Item = usize>,
    look: &mut dyn FnMut(&[u8], &str),
) {
    for_flipped_bits(bytes, positions.flat_map(|position| (0..8).map(move |bit| (position, bit))), look);
}

fn for_flipped_bits(
    bytes: &[u8],
    flips: impl Iterator<Item = (usize, usize)>,
    look: &mut dyn FnMut(&[u8], &str),
) {
    let mut damaged = bytes.to_vec();
    for (position, bit) in flips {
        damaged[position] ^= 1 << bit;
        look(&damaged, &format!("bit {bit} of byte {position}"));
        damaged[position] ^= 1 << bit;
    }
}

#[test]
fn a_flipped_bit_in_any_byte_costs_one_chunk_at_most_which_is_reported_and_falsifies_nothing() {
    flips_cost_one_chunk_at_most(|from, until| {
        Box::new((from..until).step_by(5).map(|position| (position, position % 8)))
    });
}

/// Distance between the bytes whose bits are flipped: 5, or 1 with `CAMPAIGNS=full`.
fn campaign_step() -> usize {
    if std::env::var_os("CAMPAIGNS").is_some_and(|size| size == "full") { 1 } else { 5 }
}

#[test]
#[ignore = "minutes"]
fn every_flipped_bit_costs_one_chunk_at_most_which_is_reported_and_falsifies_nothing() {
    flips_cost_one_chunk_at_most(|from, until| {
        Box::new(
            (from..until)
                .step_by(campaign_step())
                .flat_map(|position| (0..8).map(move |bit| (position, bit))),
        )
    });
}

fn flips_cost_one_chunk_at_most(flips: impl Fn(usize, usize) -> Box<dyn Iterator<Item = (usize, usize)>>) {
    // The finished file begins with all bytes of the unfinished one.
    let (bytes, end) = (finished(), unfinished().0.len());
    assert_eq!(bytes[..end], unfinished().0);
    for (name, bytes, from) in [("unfinished", &bytes[..end], 0), ("finished", &bytes, end)] {
        for_flipped_bits(bytes, flips(from, bytes.len()), &mut |damaged, at| {
            let cycles = true_cycles_in(damaged).unwrap_or_else(|| panic!("{at}, {name}: refused"));
            assert!(cycles >= CYCLES - SYNC_CYCLES, "{at}, {name}: {cycles} cycles");
            let said = || salvage(Cursor::new(damaged), Cursor::new(Vec::new())).unwrap().0.damage.is_some();
            assert!(cycles == CYCLES || said(), "{at}, {name}: {cycles} cycles and no word about the others");
        });
    }
}

/// A finished run of half a minute with five encoders: its bytes, and the lengths of its file at its synchronisations.
fn long_run() -> (Vec<u8>, Vec<usize>) {
    const SYNC_CYCLES: u64 = 50;
    let disk = DiskFile::default();
    let mut writer = RecordingWriter::begin(disk.clone(), &run("long")).unwrap();
    for number in 0..LONG_CYCLES {
        writer.write_cycle(&cycle(number)).unwrap();
        if number % SYNC_CYCLES == SYNC_CYCLES - 1 {
            writer.sync().unwrap();
        }
    }
    let synced = disk.0.borrow().synced.clone();
    writer.end("stopped", cycle(LONG_CYCLES).sample_time).unwrap();
    (disk.bytes(), synced)
}

const LONG_CYCLES: u64 = 3000;

/// Recovers a damaged copy of the long run. Returns the number of undamaged cycles.
fn long_cycles_in(bytes: &[u8]) -> u64 {
    let (salvaged, recovered) = salvage(Cursor::new(bytes), Cursor::new(Vec::new())).unwrap();
    verify(&recovered.get_ref()[..], &salvaged).unwrap();
    let recording = Recording::read(&recovered.get_ref()[..]).unwrap();
    assert_eq!(recording.run, run("long"));
    true_cycles_of(&recording, cycle)
}

/// Flips one random bit of the long run in `count` cases. Checks the percentage of cycles that survive on average, and the
/// smallest number in one case.
fn rows_kept_over_flips(count: u64) {
    let (bytes, _) = long_run();
    let mut random = StdRng::seed_from_u64(11);
    let kept = (0..count).map(|_| {
        let mut damaged = bytes.clone();
        damaged[random.random_range(0..bytes.len())] ^= 1 << random.random_range(0..8);
        long_cycles_in(&damaged)
    });
    let (least, all) = kept.fold((LONG_CYCLES, 0), |(least, all), kept| (least.min(kept), all + kept));
    let share = all as f64 / (count * LONG_CYCLES) as f64;
    println!("{count} flips: {:.2} % of the rows kept, {least} of {LONG_CYCLES} at least", share * 100.0);
    assert!(share >= 0.97 && least >= LONG_CYCLES - 50, "{share}, {least}");
}

/// Truncates the long run at random in `count` cases. All synchronised cycles must be recovered.
fn whole_chunks_kept_over_cuts(count: u64) {
    let (bytes, synced) = long_run();
    let mut random = StdRng::seed_from_u64(12);
    for _ in 0..count {
        let length = random.random_range(synced[0]..bytes.len());
        let expected = cycles_synced_within(length, &synced).unwrap() / SYNC_CYCLES * 50;
        let kept = long_cycles_in(&bytes[..length]);
        assert!(kept >= expected, "{length} of {} bytes: {kept} of {expected} cycles", bytes.len());
    }
}

#[test]
fn random_flips_cost_less_than_three_percent_of_the_rows() {
    rows_kept_over_flips(15);
}

#[test]
#[ignore = "half a minute"]
fn a_thousand_random_flips_cost_less_than_three_percent_of_the_rows() {
    rows_kept_over_flips(1000);
}

#[test]
fn random_cuts_cost_no_whole_chunk() {
    whole_chunks_kept_over_cuts(15);
}

#[test]
#[ignore = "half a minute"]
fn a_thousand_random_cuts_cost_no_whole_chunk() {
    whole_chunks_kept_over_cuts(1000);
}

#[test]
fn a_beginning_that_is_lost_costs_only_the_cycles_in_it() {
    let (bytes, synced) = unfinished();
    // Metadata, schemas and the first cycles are lost. The second copy of the metadata is not damaged.
    let mut damaged = bytes.clone();
    damaged[..synced[0] + 100].fill(0);
    assert_eq!(true_cycles_in(&damaged), Some(CYCLES - SYNC_CYCLES));
}

#[test]
fn old_blocks_of_another_run_behind_the_end_add_nothing() {
    let (bytes, synced) = unfinished();
    let (head, tail) = bytes.split_at(synced[1]);
    let disk = DiskFile::default();
    let hour_before = |time: UtcNs| time.plus_ns(-3_600_000_000_000);
    let earlier = |number| CycleRecord {
        sample_time: hour_before(small_cycle(number).sample_time),
        ..small_cycle(number)
    };
    let mut writer = RecordingWriter::begin(disk.clone(), &small_run()).unwrap();
    for number in 0..CYCLES {
        writer.write_cycle(&earlier(number)).unwrap();
        if number % 2 == 1 {
            writer.sync().unwrap();
        }
    }
    let half = disk.bytes().len() / 2;
    writer.end("stopped", hour_before(cycle(CYCLES).sample_time)).unwrap();
    let stale = &disk.bytes()[half..];
    let on_disk = [head, stale].concat();
    assert_eq!(true_cycles_in(&on_disk), Some(SYNC_CYCLES));
    // The old end record contains a larger number of cycles.
    let (salvaged, _) = salvage(Cursor::new(on_disk), Cursor::new(Vec::new())).unwrap();
    assert_eq!((salvaged.cycles, salvaged.end), (SYNC_CYCLES, None));
    assert_eq!(true_cycles_in(&[head, stale, tail].concat()), Some(CYCLES));
}

/// A disk with one sector that cannot be read.
struct BadSector {
    bytes: Cursor<Vec<u8>>,
    bad: std::ops::Range<u64>,
}

impl Read for BadSector {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let at = self.bytes.position();
        if self.bad.contains(&at) {
            return Err(io::Error::from_raw_os_error(nix::libc::EIO));
        }
        let room =
            self.bad.start.checked_sub(at).map_or(buffer.len(), |before| buffer.len().min(before as usize));
        self.bytes.read(&mut buffer[..room])
    }
}

impl Seek for BadSector {
    fn seek(&mut self, position: SeekFrom) -> io::Result<u64> {
        self.bytes.seek(position)
    }
}

#[test]
fn a_sector_that_cannot_be_read_costs_only_what_was_in_it() {
    let (bytes, _) = long_run();
    for sector in [0, 7, bytes.len() as u64 / 8192] {
        let disk = BadSector { bytes: Cursor::new(bytes.clone()), bad: sector * 4096..(sector + 1) * 4096 };
        let (salvaged, recovered) = salvage(disk, Cursor::new(Vec::new())).unwrap();
        verify(&recovered.get_ref()[..], &salvaged).unwrap();
        let recording = Recording::read(&recovered.get_ref()[..]).unwrap();
        let kept = true_cycles_of(&recording, cycle);
        assert!(salvaged.damage.is_some() && kept >= LONG_CYCLES - 150, "sector {sector}: {kept}");
    }
}

#[test]
fn every_flipped_bit_of_a_finished_recording_is_refused_or_changes_nothing_that_is_read() {
    every_flipped_bit_of_a_finished_recording_is_refused_or_changes_nothing_that_is_read_by(STEP);
}

fn every_flipped_bit_of_a_finished_recording_is_refused_or_changes_nothing_that_is_read_by(step: usize) {
    let bytes = finished();
    let truth = Recording::read(&bytes[..]).unwrap();
    let mut unnoticed = 0;
    for_each_flipped_bit(&bytes, (0..bytes.len()).step_by(step), &mut |damaged, at| match Recording::read(
        damaged,
    ) {
        Ok(read) => {
            assert_eq!(read, truth, "{at} changed what is read");
            unnoticed += 1;
        }
        Err(error) => assert!(!error.to_string().is_empty(), "{at}"),
    });
    assert!(unnoticed < bytes.len() / 25, "{unnoticed} flips were not noticed");
}

#[test]
fn no_flipped_bit_asks_for_more_memory_than_a_record_may_have() {
    no_flipped_bit_asks_for_more_memory_than_a_record_may_have_by(STEP);
}

fn no_flipped_bit_asks_for_more_memory_than_a_record_may_have_by(step: usize) {
    let mut bytes = finished();
    LARGEST.set(0);
    for position in (0..bytes.len()).step_by(step) {
        // A length is stored with its last byte highest (little-endian), so at some position this flips the
        // highest bit of a length.
        bytes[position] ^= 0x80;
        let _ = salvage(Cursor::new(&bytes[..]), Cursor::new(Vec::new()));
        let _ = Recording::read(&bytes[..]);
        bytes[position] ^= 0x80;
    }
    // A record may have 64 MB. A growing buffer has spare capacity in addition.
    assert!(LARGEST.get() <= 160 << 20, "{} bytes at once", LARGEST.get());
}

#[test]
fn an_unfinished_recording_is_never_read_as_a_whole_one_not_cut_and_not_with_a_flipped_bit() {
    an_unfinished_recording_is_never_read_as_a_whole_one_not_cut_and_not_with_a_flipped_bit_by(STEP);
}

fn an_unfinished_recording_is_never_read_as_a_whole_one_not_cut_and_not_with_a_flipped_bit_by(step: usize) {
    let (bytes, _) = unfinished();
    let refused = |bytes: &[u8], at: &str| {
        let error = Recording::read(bytes).map(|_| at.to_owned()).unwrap_err();
        assert!(!error.to_string().is_empty(), "{at}");
    };
    for length in (0..=bytes.len()).step_by(step) {
        refused(&bytes[..length], "cut");
    }
    for_each_flipped_bit(&bytes, (0..bytes.len()).step_by(step), &mut |damaged, at| refused(damaged, at));
}

#[test]
fn every_prefix_of_a_finished_recording_is_recovered_with_what_is_whole() {
    every_prefix_of_a_finished_recording_is_recovered_with_what_is_whole_by(STEP);
}

fn every_prefix_of_a_finished_recording_is_recovered_with_what_is_whole_by(step: usize) {
    let bytes = finished();
    let counts: Vec<_> =
        (0..bytes.len()).rev().step_by(step).map(|length| true_cycles_in(&bytes[..length])).collect();
    assert!(counts.is_sorted_by(|longer, shorter| longer >= shorter));
    assert_eq!(counts.first(), Some(&Some(CYCLES)));
}

#[test]
fn a_recovered_recording_keeps_how_well_its_loop_kept_its_time() {
    let bytes = finished();
    // The last bytes of the footer are missing.
    let (_, recovered) = salvage(Cursor::new(&bytes[..bytes.len() - 5]), Cursor::new(Vec::new())).unwrap();
    assert_eq!(Recording::read(&recovered.into_inner()[..]).unwrap().timing, Some(timing()));
}

#[test]
fn what_a_killed_run_said_last_of_its_timing_is_what_is_read_of_it() {
    let mut early = timing();
    early.cycles = 3;
    let disk = DiskFile::default();
    let mut writer = write_until_refused(disk.clone()).unwrap();
    let said: Vec<_> = [early, timing()]
        .into_iter()
        .map(|timing| {
            writer.write_timing(&timing).unwrap();
            writer.sync().unwrap();
            (disk.bytes().len(), timing)
        })
        .collect();
    for (length, timing) in said {
        // The record after the timing is torn.
        let torn = &disk.bytes()[..disk.bytes().len().min(length + 30)];
        let (salvaged, recovered) = salvage(Cursor::new(torn), Cursor::new(Vec::new())).unwrap();
        assert_eq!((salvaged.cycles, salvaged.timing.as_ref()), (CYCLES, Some(&timing)));
        assert_eq!(Recording::read(&recovered.into_inner()[..]).unwrap().timing, Some(timing));
    }
}

#[test]
fn a_tail_of_zeros_as_a_power_cut_leaves_it_costs_only_itself() {
    a_tail_of_zeros_as_a_power_cut_leaves_it_costs_only_itself_by(STEP);
}

fn a_tail_of_zeros_as_a_power_cut_leaves_it_costs_only_itself_by(step: usize) {
    let (bytes, synced) = unfinished();
    for length in (0..bytes.len()).step_by(step) {
        let mut torn = bytes[..length].to_vec();
        torn.resize(bytes.len() + 4096, 0);
        assert!(true_cycles_in(&torn) >= cycles_synced_within(length, &synced), "{length}");
    }
}

#[test]
fn a_disk_that_refuses_at_any_offset_keeps_what_was_synchronised_before() {
    a_disk_that_refuses_at_any_offset_keeps_what_was_synchronised_before_by(STEP);
}

fn a_disk_that_refuses_at_any_offset_keeps_what_was_synchronised_before_by(step: usize) {
    let (bytes, _) = unfinished();
    for errno in [nix::libc::ENOSPC, nix::libc::EIO] {
        for capacity in (0..bytes.len()).step_by(step) {
            let disk = DiskFile::full_at(capacity, errno);
            let refused = write_until_refused(disk.clone()).map(drop);
            assert!(refused.is_err(), "{capacity} bytes were enough for {}", bytes.len());
            let expected = cycles_synced_within(capacity, &disk.0.borrow().synced);
            assert!(true_cycles_in(&disk.bytes()) >= expected, "{capacity} bytes");
        }
    }
}

#[test]
fn a_disk_that_refuses_once_at_any_offset_and_then_goes_on_leaves_no_wrong_record() {
    a_disk_that_refuses_once_at_any_offset_and_then_goes_on_leaves_no_wrong_record_by(STEP);
}

fn a_disk_that_refuses_once_at_any_offset_and_then_goes_on_leaves_no_wrong_record_by(step: usize) {
    let (bytes, _) = unfinished();
    for offset in (0..bytes.len()).step_by(step) {
        let disk = DiskFile::refusing_once_at(offset, nix::libc::EIO);
        // The unfinished writer is dropped here. This may write its buffered data behind the gap.
        assert!(write_until_refused(disk.clone()).is_err(), "byte {offset}");
        let expected = cycles_synced_within(offset, &disk.0.borrow().synced);
        assert!(true_cycles_in(&disk.bytes()) >= expected, "byte {offset}");
    }
}

#[test]
fn writes_that_come_in_small_parts_make_the_same_file() {
    for bytes_at_once in [1, 7, 64] {
        let disk = DiskFile::taking_at_most(bytes_at_once);
        drop(write_until_refused(disk.clone()).unwrap());
        assert_eq!(true_cycles_in(&disk.bytes()), Some(CYCLES), "{bytes_at_once} bytes at once");
    }
}

#[test]
fn a_tear_at_any_offset_with_what_follows_on_disk_falsifies_nothing() {
    a_tear_at_any_offset_with_what_follows_on_disk_falsifies_nothing_by(STEP);
}

fn a_tear_at_any_offset_with_what_follows_on_disk_falsifies_nothing_by(step: usize) {
    let (bytes, synced) = unfinished();
    for &keep in &synced {
        let expected = cycles_synced_within(keep, &synced);
        for tear in (keep..bytes.len()).step_by(step) {
            // In one case, only the later of two writes reached the disk. In the other case, both are on
            // the disk in reverse order.
            let hole = [&bytes[..keep], &vec![0; tear - keep], &bytes[tear..]].concat();
            let exchanged = [&bytes[..keep], &bytes[tear..], &bytes[keep..tear]].concat();
            for on_disk in [hole, exchanged] {
                assert!(true_cycles_in(&on_disk) >= expected, "synchronised {keep}, torn at {tear}");
            }
        }
    }
}

#[test]
fn a_synchronisation_that_fails_is_an_error_and_loses_nothing_before_it() {
    for syncs in 0..=(CYCLES / SYNC_CYCLES) as usize {
        let disk = DiskFile::failing_after(syncs, nix::libc::EIO);
        let result = write_until_refused(disk.clone()).map(drop);
        assert!(result.is_err(), "{syncs}");
        let on_disk = disk.0.borrow().synced.last().copied().unwrap_or(0);
        let kept = true_cycles_in(&disk.bytes()[..on_disk]);
        assert_eq!(kept, (syncs as u64).checked_sub(1).map(|n| n * SYNC_CYCLES));
    }
}

#[test]
fn recovering_onto_a_full_disk_is_an_error_and_never_a_short_file() {
    recovering_onto_a_full_disk_is_an_error_and_never_a_short_file_by(STEP);
}

fn recovering_onto_a_full_disk_is_an_error_and_never_a_short_file_by(step: usize) {
    let (bytes, _) = unfinished();
    let (_, whole) = salvage(Cursor::new(&bytes[..]), Cursor::new(Vec::new())).unwrap();
    for capacity in (0..whole.get_ref().len()).step_by(step) {
        let disk = DiskFile::full_at(capacity, nix::libc::ENOSPC);
        assert!(
            matches!(salvage(Cursor::new(&bytes[..]), disk), Err(SalvageError::Write(_))),
            "{capacity} bytes"
        );
    }
}

#[test]
fn a_run_recovered_again_stays_as_it_is() {
    let (bytes, synced) = unfinished();
    let (first, once) = salvage(Cursor::new(&bytes[..synced[3]]), Cursor::new(Vec::new())).unwrap();
    let (second, twice) = salvage(Cursor::new(&once.get_ref()[..]), Cursor::new(Vec::new())).unwrap();
    assert_eq!((first.cycles, &first.run), (second.cycles, &second.run));
    let read = |bytes: &Cursor<Vec<u8>>| Recording::read(&bytes.get_ref()[..]).unwrap();
    assert_eq!(read(&once).cycles, read(&twice).cycles);
}

#[test]
#[ignore = "minutes"]
fn the_same_at_every_single_byte() {
    let tests = [
        every_prefix_gives_all_that_was_synchronised_in_it_by,
        every_flipped_bit_of_a_finished_recording_is_refused_or_changes_nothing_that_is_read_by,
        no_flipped_bit_asks_for_more_memory_than_a_record_may_have_by,
        an_unfinished_recording_is_never_read_as_a_whole_one_not_cut_and_not_with_a_flipped_bit_by,
        every_prefix_of_a_finished_recording_is_recovered_with_what_is_whole_by,
        a_tail_of_zeros_as_a_power_cut_leaves_it_costs_only_itself_by,
        a_disk_that_refuses_at_any_offset_keeps_what_was_synchronised_before_by,
        a_disk_that_refuses_once_at_any_offset_and_then_goes_on_leaves_no_wrong_record_by,
        a_tear_at_any_offset_with_what_follows_on_disk_falsifies_nothing_by,
        recovering_onto_a_full_disk_is_an_error_and_never_a_short_file_by,
    ];
    tests.iter().for_each(|test| test(campaign_step()));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(100))]

    /// After a power failure, data that were not synchronised may be on the disk partly, in any order, torn, or not at all.
    #[test]
    fn unsynchronised_writes_in_any_order_never_give_a_wrong_record(
        last_sync in 0_usize..5,
        extra_writes in 1_usize..40,
        fate in prop::collection::vec((any::<bool>(), 0.0_f64..=1.0), 40),
        stale in any::<u8>(),
    ) {
        let (bytes, synced) = unfinished();
        let keep = synced[last_sync.min(synced.len() - 1)];
        let mut on_disk = bytes[..keep].to_vec();
        // Each remaining sector is written, torn, or unchanged.
        for (index, sector) in bytes[keep..].chunks(64).take(extra_writes).enumerate() {
            let (kept, part) = fate[index % fate.len()];
            let whole = if kept { sector.len() } else { (sector.len() as f64 * part * 0.99) as usize };
            on_disk.extend_from_slice(&sector[..whole]);
            on_disk.resize(on_disk.len() + sector.len() - whole, stale);
        }
        let expected = cycles_synced_within(keep, &synced);
        prop_assert!(true_cycles_in(&on_disk) >= expected);
    }

    /// Random bytes, alone and appended to the beginning of a recording. Alone they are refused; appended they add no cycle.
    #[test]
    fn any_bytes_are_refused_or_add_nothing(bytes in prop::collection::vec(any::<u8>(), 0..2000), at in 0_usize..5) {
        prop_assert_eq!(true_cycles_in(&bytes), None);
        let (recording, synced) = unfinished();
        let at = at.min(synced.len() - 1);
        let tail = [&recording[..synced[at]], &bytes].concat();
        prop_assert_eq!(true_cycles_in(&tail), Some(at as u64 * SYNC_CYCLES));
    }

    /// A block of a recording overwrites another place in it.
    #[test]
    fn shuffled_parts_never_give_a_wrong_record(
        from in any::<prop::sample::Index>(),
        to in any::<prop::sample::Index>(),
        length in 1_usize..600,
    ) {
        let (bytes, _) = unfinished();
        let mut shuffled = bytes.clone();
        let (from, to) = (from.index(bytes.len()), to.index(bytes.len()));
        let length = length.min(bytes.len() - from.max(to));
        shuffled.copy_within(from..from + length, to);
        prop_assert!(true_cycles_in(&shuffled).is_none_or(|cycles| cycles <= CYCLES));
    }
}
