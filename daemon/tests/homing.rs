//! Homing on the simulated segment, in virtual time. Homing must find the true reference marks and detect wrong wiring.
//! After a power cycle and a new homing, the same pose must have the same angles.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

use std::cell::Cell;
use std::f64::consts::TAU;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use ballbard::bus::{Bus, BusPlan};
use ballbard::clock::Clock;
use ballbard::cycle::Acquisition;
use ballbard::homing::{FoundMark, HomingError, HomingStep, Miswired, Sequence, verify};
use ballbard::segment::InProcessWire;
use ballbard::segment::faults::{Fault, FaultHandle, FaultySegment};
use ballbard::segment::simulated::{
    Conversion, EncoderSource, Hand, HandTurned, Periods, SegmentConfig, Signal, SimulatedSegment,
    SmoothMotion,
};
use shared::config::{EncoderConfig, HomingConfig};
use shared::encoder::Direction;
use shared::recording::schema::{CycleRecord, EncoderInfo};
use shared::time::UtcNs;

const TERMINALS: usize = 5;
const COUNTS_PER_REVOLUTION: u32 = 3600 << 12;

fn encoders() -> Vec<EncoderConfig> {
    (1..=TERMINALS as u8).map(EncoderConfig::ern_1080).collect()
}

/// A bus whose joints do not move until the simulated hand of a person turns one joint.
struct Bench {
    acquisition: Acquisition,
    hand: Hand,
    faults: FaultHandle,
    true_marks: Vec<Periods>,
    positions: Positions,
}

/// Position of each encoder at its last conversion, shared with the test.
type Positions = Arc<Mutex<[Periods; TERMINALS]>>;

struct Watched(HandTurned, Positions);

impl EncoderSource for Watched {
    fn signal(&mut self, channel: usize, at: Conversion) -> Signal {
        let signal = self.0.signal(channel, at);
        if let Signal::Turning { position, .. } = signal {
            self.1.lock().unwrap()[channel] = position;
        }
        signal
    }
}

impl Bench {
    fn new(seed: u64) -> Self {
        let motion = SmoothMotion::new(TERMINALS, 3600, seed);
        let true_marks = (0..TERMINALS).map(|joint| motion.reference_mark(joint).unwrap()).collect();
        let (source, hand) = HandTurned::new(motion);
        hand.hold();
        let positions = Positions::default();
        let source = Watched(source, Arc::clone(&positions));
        let segment = SimulatedSegment::new(&SegmentConfig::default(), Box::new(source));
        let (segment, faults) = FaultySegment::new(segment, seed);
        let clock = Clock::virtual_from(UtcNs(0));
        let plan = BusPlan {
            name: "simulated".into(),
            encoders: encoders(),
            cycle_period: Duration::from_millis(10),
            distributed_clocks: true,
            sync0_shift: Duration::from_millis(5),
            reply_timeout: Duration::from_millis(4),
        };
        let wire = InProcessWire::with_faults(segment, clock.clone());
        let bus = Bus::new(Box::new(wire), clock.clone(), plan.reply_timeout);
        let acquisition = Acquisition::start(bus, &plan, clock).unwrap();
        Self { acquisition, hand, faults, true_marks, positions }
    }

    /// Homes these encoders. `obeys` simulates the operator. It is called whenever the homing requests
    /// that a joint be turned.
    fn home(
        &mut self,
        encoders: &[EncoderConfig],
        obeys: impl Fn(&Hand, u8),
    ) -> Result<Vec<FoundMark>, HomingError> {
        let hand = &self.hand;
        let mut turned_rad_max = 0.0f64;
        let mut watch = |step| match step {
            HomingStep::Turn { joint, .. } => obeys(hand, joint),
            HomingStep::Turning { turned_rad, .. } => turned_rad_max = turned_rad_max.max(turned_rad.abs()),
            HomingStep::Found(_) => hand.hold(),
        };
        let mut sequence = Sequence::begin(&mut self.acquisition, encoders);
        let found = loop {
            if let Some(found) = sequence.step(&mut self.acquisition, &mut |_| (), &mut watch, None) {
                break found;
            }
        };
        assert!(found.is_err() || turned_rad_max > 0.08, "no progress was reported");
        found
    }

    fn record(&mut self) -> CycleRecord {
        let mut last = None;
        self.acquisition.next_cycle(&mut |record| last = Some(*record));
        last.unwrap()
    }

    /// Returns the angles of all joints \[rad\], counted from the marks of `homing`. Also returns the joints whose
    /// marks are no longer valid.
    fn angles_rad(&mut self, homing: &HomingConfig) -> (Vec<f64>, Vec<u8>) {
        let record = self.record();
        assert!(record.is_valid());
        let mut infos: Vec<EncoderInfo> =
            encoders().iter().map(|one| EncoderInfo { joint: one.joint, scale: one.scale() }).collect();
        let latches: Vec<u32> = record.encoders().iter().map(|encoder| encoder.latch).collect();
        let stale = homing.apply(&mut infos, &latches);
        let angle = |(info, encoder): (&EncoderInfo, &shared::recording::schema::EncoderSample)| {
            info.scale.counts_to_rad(info.scale.unwrapper().next(encoder.count))
        };
        (infos.iter().zip(record.encoders()).map(angle).collect(), stale)
    }

    /// Checks that each angle is the distance of the encoder from the mark on its disc, up to whole turns. This must be true
    /// for any start value of the counters.
    fn assert_angles_are_those_from_the_true_marks(&mut self, homing: &HomingConfig) {
        let (angles_rad, stale) = self.angles_rad(homing);
        assert!(stale.is_empty(), "the terminals show their marks");
        let positions = *self.positions.lock().unwrap();
        for ((angle_rad, position), mark) in angles_rad.iter().zip(positions).zip(&self.true_marks) {
            let from_mark_rad = (position.0 - mark.0) as f64 / Periods::ONE as f64 / 3600.0 * TAU;
            let off_rad = (angle_rad - from_mark_rad + TAU / 2.0).rem_euclid(TAU) - TAU / 2.0;
            assert!(off_rad.abs() <= 1.01 * TAU / f64::from(COUNTS_PER_REVOLUTION), "{off_rad} rad off");
        }
    }
}

fn obedient(hand: &Hand, joint: u8) {
    hand.turn(usize::from(joint) - 1);
}

fn saved_marks(encoders: &[EncoderConfig], found: &[FoundMark]) -> HomingConfig {
    HomingConfig::new(UtcNs(0), encoders, &verify(encoders, found).unwrap())
}

#[test]
fn the_marks_found_are_the_true_ones() {
    for seed in 0..4 {
        let mut bench = Bench::new(seed);
        let found = bench.home(&encoders(), obedient).unwrap();
        for (found, true_mark) in verify(&encoders(), &found).unwrap().iter().zip(&bench.true_marks) {
            // The disc has one mark in each revolution, so the difference is a whole number of revolutions.
            let apart = found.wrapping_sub((true_mark.0 >> 20) as u32) as i32;
            assert_eq!(apart % COUNTS_PER_REVOLUTION as i32, 0);
        }
    }
}

#[test]
fn after_a_power_cycle_and_homing_again_the_same_pose_reads_the_same_angle() {
    let mut bench = Bench::new(4);
    let first = bench.home(&encoders(), obedient).unwrap();
    let homing = saved_marks(&encoders(), &first);
    bench.assert_angles_are_those_from_the_true_marks(&homing);
    let counts = bench.record().encoders.map(|encoder| encoder.count);

    bench.faults.begin(Fault::DevicesGone { from: 1 });
    for _ in 0..100 {
        bench.record();
    }
    bench.faults.end(Fault::DevicesGone { from: 1 });
    while !bench.record().is_valid() {}
    let counts_after = bench.record().encoders.map(|encoder| encoder.count);
    assert!(counts.iter().zip(counts_after).all(|(before, after)| before.abs_diff(after) > 4096));
    // After the power cycle the counters have restarted, so the old marks must not be applied.
    assert_eq!(bench.angles_rad(&homing).1, [1, 2, 3, 4, 5]);

    let again = bench.home(&encoders(), obedient).unwrap();
    assert!(first.iter().zip(&again).all(|(first, again)| first.reference_counts != again.reference_counts));
    bench.assert_angles_are_those_from_the_true_marks(&saved_marks(&encoders(), &again));
}

#[test]
fn a_joint_whose_mark_was_found_may_pass_its_mark_again() {
    let mut bench = Bench::new(4);
    let (hand, is_second) = (bench.hand.clone(), Cell::new(false));
    let mut watch = |step| match step {
        HomingStep::Turn { joint, .. } => {
            is_second.set(joint == 2);
            obedient(&hand, joint);
        }
        HomingStep::Turning { .. } => {}
        HomingStep::Found(_) => hand.hold(),
    };
    let mut sequence = Sequence::begin(&mut bench.acquisition, &encoders());
    let mut cycles = 0;
    let found = loop {
        if let Some(outcome) = sequence.step(&mut bench.acquisition, &mut |_| (), &mut watch, None) {
            break outcome.unwrap();
        }
        if is_second.get() {
            cycles += 1;
            match cycles {
                // Joint 2 has turned by more than 5 degrees.
                12 => hand.turn(0),
                // Joint 1 has turned by more than a whole turn.
                552 => hand.turn(1),
                _ => {}
            }
        }
    };
    let homing = saved_marks(&encoders(), &found);
    assert!(bench.angles_rad(&homing).1.is_empty());
}

fn miswired(found: &[FoundMark], encoders: &[EncoderConfig]) -> String {
    let error: Miswired = verify(encoders, found).unwrap_err();
    error.to_string()
}

#[test]
fn encoders_on_each_others_terminals_are_named_with_what_to_write() {
    // The configuration lists joint 2 first and joint 1 second. In reality, the first terminal is wired to joint 1.
    let mut swapped = encoders();
    swapped.swap(0, 1);
    let found = Bench::new(4).home(&swapped, obedient).unwrap();
    assert_eq!(found.iter().map(|found| found.encoder).collect::<Vec<_>>(), [1, 0, 2, 3, 4]);
    let text = miswired(&found, &swapped);
    assert!(text.contains("terminal 1 measures joint 1, not joint 2"), "{text}");
    assert!(text.contains("encoder number 2 must have `joint = 2`"), "{text}");
    assert!(verify(&encoders(), &found).is_ok());
}

#[test]
fn a_joint_that_counts_the_other_way_is_named() {
    let turns_back = |hand: &Hand, joint: u8| match joint {
        3 => hand.turn_back(2),
        _ => obedient(hand, joint),
    };
    let found = Bench::new(4).home(&encoders(), turns_back).unwrap();
    let text = miswired(&found, &encoders());
    assert!(text.contains("joint 3 counts down") && text.contains("direction = \"negative\""), "{text}");
    assert!(!text.contains("joint 2"), "{text}");
    let mut right = encoders();
    right[2].direction = Direction::Negative;
    assert_eq!(verify(&right, &found).unwrap().len(), TERMINALS);
}

#[test]
fn nobody_turning_ends_with_what_to_do() {
    let error = Bench::new(4).home(&encoders(), |_, _| ()).unwrap_err();
    assert!(matches!(error, HomingError::NoMark { joint: 1, turned_deg } if turned_deg.abs() < 0.1));
    assert!(error.to_string().contains("by a whole turn"));
}

#[test]
fn joints_that_turn_together_or_a_joint_that_was_found_before_are_refused() {
    let together = Bench::new(1).home(&encoders(), |hand, _| hand.let_go()).unwrap_err();
    assert!(matches!(together, HomingError::Together { asked: 1, .. }), "{together}");
    let error = Bench::new(1).home(&encoders(), |hand, _| hand.turn(0)).unwrap_err();
    assert_eq!(error, HomingError::Again { asked: 2, terminal: 1, joint: 1 });
}

#[test]
fn a_bus_that_fails_and_a_person_who_leaves_end_it() {
    let mut bench = Bench::new(2);
    let faults = bench.faults.clone();
    let error = bench.home(&encoders(), |_, _| faults.begin(Fault::LinkDown)).unwrap_err();
    assert_eq!(error, HomingError::NoSignal(1));
    let mut bench = Bench::new(2);
    let mut sequence = Sequence::begin(&mut bench.acquisition, &encoders());
    let mut step = |stopped| sequence.step(&mut bench.acquisition, &mut |_| (), &mut |_| (), stopped);
    assert!((0..100).all(|_| step(None).is_none()));
    assert_eq!(step(Some("Ctrl-C".into())), Some(Err(HomingError::Stopped("Ctrl-C".into()))));
}

#[test]
fn a_short_power_cut_of_the_terminals_ends_it() {
    let gone = Fault::DevicesGone { from: 1 };
    // In cycle 5 the terminals are disarmed. In cycle 25 joint 1 turns, but not yet by 5 degrees.
    for cut in [5, 25] {
        let mut bench = Bench::new(2);
        let hand = bench.hand.clone();
        let mut watch = |step| {
            if let HomingStep::Turn { joint, .. } = step {
                obedient(&hand, joint);
            }
        };
        let mut sequence = Sequence::begin(&mut bench.acquisition, &encoders());
        let outcome = (0..).find_map(|cycle| {
            if cycle == cut {
                bench.faults.begin(gone);
            } else if cycle == cut + 1 {
                bench.faults.end(gone);
            }
            sequence.step(&mut bench.acquisition, &mut |_| (), &mut watch, None)
        });
        assert_eq!(outcome, Some(Err(HomingError::NoSignal(1))), "cut in cycle {cut}");
    }
}
