//! A recording that is replayed passes over the bus unchanged.

use ballbard::segment::simulated::{
    Conversion, EncoderSource, Replay, ReplayError, SegmentConfig, Signal, SimulatedSegment,
};
use rand::{Rng, SeedableRng, rngs::StdRng};

use super::executor::Bench;
use super::frames::{OP, TERMINAL, Wire};
use super::operation::{PERIOD_NS, cycle, inputs, operational, preop};

fn recording(rows: usize, channels: usize) -> Vec<u32> {
    let mut random = StdRng::seed_from_u64(3);
    (0..rows * channels).map(|_| random.random()).collect()
}

fn valid(counts: &[u32]) -> Vec<Option<u32>> {
    counts.iter().copied().map(Some).collect()
}

#[test]
fn every_recorded_row_arrives_bit_for_bit_one_a_cycle_on_drifting_clocks() {
    const ROWS: usize = 2000;
    let counts = recording(ROWS, 5);
    let (replay, handle) = Replay::new(valid(&counts), 5, PERIOD_NS).unwrap();
    let config = SegmentConfig { drift_ppm: 50.0, ..SegmentConfig::default() };
    let mut bench = Bench::new(SimulatedSegment::new(&config, Box::new(replay)));
    let group = preop(&mut bench);
    let group = operational(&mut bench, group);
    let last = cycle(&mut bench, &group);
    assert_eq!(inputs(&bench, &group, 3).1, counts[3], "the first row, before the start");
    handle.start_at((last.dc_time_ns / PERIOD_NS + 2) * PERIOD_NS);
    cycle(&mut bench, &group);
    assert_eq!((handle.rows_played(), handle.rows()), (0, ROWS));
    for (row, recorded) in counts.chunks(5).enumerate() {
        assert!(!handle.has_ended());
        cycle(&mut bench, &group);
        let shown: Vec<u32> = (0..5).map(|terminal| inputs(&bench, &group, terminal).1).collect();
        assert_eq!(shown, recorded, "row {row}");
        assert_eq!(handle.rows_played(), row + 1);
    }
    assert!(handle.has_ended());
    cycle(&mut bench, &group);
    assert_eq!(inputs(&bench, &group, 0).1, counts[5 * (ROWS - 1)], "the last row stays");
}

#[test]
fn a_replay_that_starts_at_the_next_cycle_shows_every_row_and_can_be_repeated() {
    const ROWS: usize = 20;
    let counts = recording(ROWS, 5);
    let (replay, handle) = Replay::new(valid(&counts), 5, PERIOD_NS).unwrap();
    let mut bench = Bench::new(SimulatedSegment::new(&SegmentConfig::default(), Box::new(replay)));
    let group = preop(&mut bench);
    let group = operational(&mut bench, group);
    for _ in 0..2 {
        handle.start_at_next();
        let mut shown = Vec::new();
        while !handle.has_ended() {
            cycle(&mut bench, &group);
            shown.push((0..5).map(|terminal| inputs(&bench, &group, terminal).1).collect::<Vec<_>>());
        }
        assert!(shown.iter().map(Vec::as_slice).eq(counts.chunks(5)), "{shown:?}");
    }
}

#[test]
fn without_distributed_clocks_rows_follow_the_frames() {
    let counts = recording(20, 1);
    let (replay, handle) = Replay::new(valid(&counts), 1, PERIOD_NS).unwrap();
    let mut wire = Wire::new(1, replay);
    wire.enter_safeop(TERMINAL);
    wire.process_data(0, 0);
    assert_eq!(wire.request(TERMINAL, OP), (OP, 0));
    wire.process_data(0, 0);
    wire.pass_ms(10);
    handle.start_at(wire.now_ns);
    let mut shown = Vec::new();
    for _ in 0..=counts.len() {
        let frame_ns = wire.now_ns;
        shown.push(u32::from_le_bytes(wire.process_data(0, 0).1[2..6].try_into().unwrap()));
        wire.now_ns = frame_ns + PERIOD_NS;
    }
    // A terminal that is synchronised with frames returns the conversion of the previous frame. Counts
    // are therefore one cycle late.
    assert_eq!(shown[1..], counts);
    assert!(handle.has_ended());
}

#[test]
fn after_the_clock_of_the_bus_was_set_encoders_stand_between_two_rows() {
    // Counts increase by 1000 from row to row, and wrap once.
    let counts: Vec<u32> = (0..40u32).map(|row| (row * 1000).wrapping_sub(10_500)).collect();
    let (mut replay, handle) = Replay::new(valid(&counts), 1, PERIOD_NS).unwrap();
    handle.start_at(0);
    for (row, &recorded) in counts.iter().enumerate().take(39) {
        let nominal_ns = row as i64 * PERIOD_NS;
        // The clock drifts by 0.1 us a cycle. From row 10 on, it is also set back by a quarter of a cycle.
        let later_ns = if row < 10 { 0 } else { -PERIOD_NS / 4 };
        let true_time_ns = nominal_ns + 100 * row as i64 + later_ns;
        let Signal::Recorded { count } =
            replay.signal(0, Conversion { true_time_ns, system_time_ns: Some(nominal_ns) })
        else {
            panic!("a recording shows counts");
        };
        assert_eq!(count, recorded.wrapping_sub(if row < 10 { 0 } else { 250 }), "row {row}");
    }
}

#[test]
fn in_a_row_without_a_valid_count_the_input_has_no_signal() {
    let (mut replay, handle) = Replay::new(vec![Some(7), None, Some(9)], 1, PERIOD_NS).unwrap();
    handle.start_at(0);
    let shown = [0, 1, 2].map(|row| {
        let now_ns = row * PERIOD_NS;
        replay.signal(0, Conversion { true_time_ns: now_ns, system_time_ns: Some(now_ns) })
    });
    let expected = [Signal::Recorded { count: 7 }, Signal::NOT_CONNECTED, Signal::Recorded { count: 9 }];
    assert_eq!(shown, expected);
}

#[test]
fn a_table_that_is_not_whole_is_refused() {
    for (counts, channels) in [(0, 5), (7, 5), (5, 0)] {
        let refused = Replay::new(vec![Some(0); counts], channels, PERIOD_NS);
        assert_eq!(refused.unwrap_err(), ReplayError::Shape { counts, channels });
    }
    assert_eq!(Replay::new(vec![Some(0); 5], 5, 0).unwrap_err(), ReplayError::Period(0));
}
