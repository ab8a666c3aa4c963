//! An unmodified ethercrab brings the segment from INIT to OP, and then exchanges cycles with it.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use ballbard::segment::simulated::{
    Conversion, EncoderSource, Periods, Revision, SegmentConfig, Signal, SimulatedSegment, SmoothMotion,
};
use ethercrab::subdevice_group::{DcConfiguration, HasDc, Op, PreOp};
use ethercrab::{DcSync, DefaultLock, RegisterAddress, SubDeviceGroup, SubDeviceState};

use super::executor::{Bench, now_ns, pass_ns};

pub const PERIOD_NS: i64 = 10_000_000;
const SHIFT: Duration = Duration::from_millis(2);
const SYNC1: Duration = Duration::from_micros(25);

pub type PreOpGroup = SubDeviceGroup<16, 128, DefaultLock, PreOp>;
pub type OpGroup = SubDeviceGroup<16, 128, DefaultLock, Op, HasDc>;

/// An encoder source whose position is a linear function of system time. Each encoder has its own start position.
pub struct Ramp;

impl Ramp {
    pub fn count(channel: usize, system_time_ns: i64, bits: u32) -> u32 {
        (Self::position(channel, system_time_ns) >> (32 - bits)) as u32
    }

    fn position(channel: usize, time_ns: i64) -> i64 {
        // A period has 2^32 fraction steps and lasts 2^22 ns (4.2 ms), so the position advances by 1024 steps a nanosecond.
        (time_ns << 10).wrapping_add(channel as i64 * 7 * Periods::ONE)
    }
}

impl EncoderSource for Ramp {
    fn signal(&mut self, channel: usize, at: Conversion) -> Signal {
        let time_ns = at.system_time_ns.unwrap_or(at.true_time_ns);
        turning(Periods(Self::position(channel, time_ns)), 238.0)
    }
}

pub fn turning(position: Periods, periods_per_s: f64) -> Signal {
    Signal::Turning {
        position,
        periods_per_s,
        amplitude: 1.0,
        reference_mark: None,
        on_reference_mark: false,
    }
}

pub fn segment_with(terminals: usize, source: impl EncoderSource + 'static) -> SimulatedSegment {
    SimulatedSegment::new(&SegmentConfig { terminals, ..SegmentConfig::default() }, Box::new(source))
}

pub fn preop(bench: &mut Bench) -> PreOpGroup {
    let maindevice = bench.maindevice;
    bench.run(maindevice.init_single_group::<16, 128>(|| now_ns() as u64)).expect("PRE-OP")
}

/// Brings the group into OP in the same way as the daemon. SYNC0 occurs every 10 ms, and SYNC1 25 us after it. Frames are
/// sent in the middle between two SYNC0 pulses.
pub fn operational(bench: &mut Bench, mut group: PreOpGroup) -> OpGroup {
    let maindevice = bench.maindevice;
    for mut subdevice in group.iter_mut(maindevice) {
        if subdevice.name() == "EL5021" {
            subdevice.set_dc_sync(DcSync::Sync01 { sync1_period: SYNC1 });
        }
    }
    let group = bench.run(group.into_pre_op_pdi(maindevice)).expect("process image");
    let configuration = DcConfiguration {
        start_delay: Duration::from_millis(100),
        sync0_period: Duration::from_nanos(PERIOD_NS as u64),
        sync0_shift: SHIFT,
    };
    let group = bench.run(group.configure_dc_sync(maindevice, configuration)).expect("distributed clocks");
    let group = bench.run(group.into_safe_op(maindevice)).expect("SAFE-OP");
    let group = bench.run(group.request_into_op(maindevice)).expect("OP requested");
    for _ in 0..100 {
        if cycle(bench, &group).all_op {
            return group;
        }
    }
    panic!("no OP within 100 cycles");
}

pub struct Cycle {
    pub working_counter: u16,
    pub all_op: bool,
    pub dc_time_ns: i64,
}

/// Exchanges the frame of one bus cycle, then waits until the next cycle is due.
pub fn cycle(bench: &mut Bench, group: &OpGroup) -> Cycle {
    let response = bench.run(group.tx_rx_dc(bench.maindevice)).expect("a cycle");
    pass_ns(response.extra.next_cycle_wait.as_nanos() as i64);
    Cycle {
        working_counter: response.working_counter,
        all_op: response.subdevice_states.iter().all(|state| *state == SubDeviceState::Op),
        dc_time_ns: response.extra.dc_system_time as i64,
    }
}

pub fn inputs(bench: &Bench, group: &OpGroup, terminal: usize) -> (u16, u32, u32) {
    let subdevice = group.subdevice(bench.maindevice, 1 + terminal).unwrap();
    let bytes = subdevice.inputs_raw();
    let status = u16::from_le_bytes(bytes[..2].try_into().unwrap());
    let counter = u32::from_le_bytes(bytes[2..6].try_into().unwrap());
    (status, counter, u32::from_le_bytes(bytes[6..].try_into().unwrap()))
}

fn reaches_op_and_counts(terminals: usize) {
    let mut bench = Bench::new(segment_with(terminals, Ramp));
    let group = preop(&mut bench);
    assert_eq!(group.len(), 1 + terminals);
    let group = operational(&mut bench, group);
    let mut toggles = vec![None; terminals];
    for _ in 0..200 {
        let cycle = cycle(&mut bench, &group);
        assert_eq!(cycle.working_counter, 3 * terminals as u16);
        let sync0_ns = cycle.dc_time_ns / PERIOD_NS * PERIOD_NS;
        for (terminal, toggle) in toggles.iter_mut().enumerate() {
            let (status, counter, _) = inputs(&bench, &group, terminal);
            assert_eq!(counter, Ramp::count(terminal, sync0_ns, 10), "terminal {terminal}");
            assert_eq!(status & 0x7fff, 0, "no error, no latch");
            assert_ne!(toggle.replace(status >> 15), Some(status >> 15), "toggle stands still");
        }
    }
}

#[test]
fn five_terminals_reach_op_and_count_at_sync0_in_every_cycle() {
    reaches_op_and_counts(5);
}

#[test]
fn four_terminals_reach_op() {
    reaches_op_and_counts(4);
}

#[test]
fn a_single_terminal_reaches_op() {
    reaches_op_and_counts(1);
}

#[test]
fn the_clocks_agree_within_nanoseconds_after_static_synchronisation_and_stay_so() {
    let mut bench = Bench::new(segment_with(5, Ramp));
    let group = preop(&mut bench);
    let maindevice = bench.maindevice;
    let difference = |bench: &mut Bench, group: &PreOpGroup, position: usize| {
        let subdevice = group.subdevice(maindevice, position).unwrap();
        let raw: u32 = bench.run(subdevice.register_read(RegisterAddress::DcSystemTimeDifference)).unwrap();
        raw & 0x7fff_ffff
    };
    for position in 1..=5 {
        let difference_ns = difference(&mut bench, &group, position);
        assert!(difference_ns <= 5, "terminal {position}: {difference_ns} ns");
    }
    let group = operational(&mut bench, group);
    for _ in 0..300 {
        cycle(&mut bench, &group);
    }
    for position in 1..=5 {
        let subdevice = group.subdevice(maindevice, position).unwrap();
        let raw: u32 = bench.run(subdevice.register_read(RegisterAddress::DcSystemTimeDifference)).unwrap();
        assert!(raw & 0x7fff_ffff <= 5, "terminal {position}: {raw:#010x}");
    }
}

#[test]
fn delays_are_measured_as_they_are() {
    let mut bench = Bench::new(segment_with(5, Ramp));
    let group = preop(&mut bench);
    let delays: Vec<u32> =
        group.iter(bench.maindevice).map(|subdevice| subdevice.propagation_delay()).collect();
    assert_eq!(delays[0], 0);
    for pair in delays.windows(2) {
        assert!((144..=156).contains(&(pair[1] - pair[0])), "{delays:?}");
    }
}

#[test]
fn names_and_identities_are_those_of_the_real_devices() {
    let config = SegmentConfig { revision: Revision::R17, ..SegmentConfig::default() };
    let mut bench = Bench::new(SimulatedSegment::new(&config, Box::new(Ramp)));
    let group = preop(&mut bench);
    let maindevice = bench.maindevice;
    let found: Vec<_> = group
        .iter(maindevice)
        .map(|subdevice| {
            let identity = subdevice.identity();
            (subdevice.name().to_owned(), identity.vendor_id, identity.product_id, identity.revision)
        })
        .collect();
    assert_eq!(found[0], ("EK1100".to_owned(), 2, 0x044c_2c52, 0x0012_0000));
    for terminal in &found[1..] {
        assert_eq!(*terminal, ("EL5021".to_owned(), 2, 0x139d_3052, 0x0011_0000));
    }
    let coupler = group.subdevice(maindevice, 0).unwrap();
    assert_eq!(bench.run(coupler.eeprom_size(maindevice)).unwrap(), 2048);
    assert_eq!(
        bench.run(coupler.description()).unwrap().unwrap().as_str(),
        "EK1100 EtherCAT-Koppler (2A E-Bus)"
    );
    let product: u32 = bench.run(coupler.eeprom_read(maindevice, 0x000a)).unwrap();
    assert_eq!(product, 0x044c_2c52);
}

#[test]
fn the_counter_follows_the_interpolation_that_is_set() {
    let mut bench = Bench::new(segment_with(2, Ramp));
    let group = preop(&mut bench);
    let maindevice = bench.maindevice;
    let terminal = group.subdevice(maindevice, 2).unwrap();
    assert_eq!(bench.run(terminal.sdo_read::<u8>(0x8001, 0x11)).unwrap(), 10);
    bench.run(terminal.sdo_write(0x8001, 0x11, 12u8)).unwrap();
    assert_eq!(bench.run(terminal.sdo_read::<u8>(0x8001, 0x11)).unwrap(), 12);
    let group = operational(&mut bench, group);
    for _ in 0..20 {
        let sync0_ns = cycle(&mut bench, &group).dc_time_ns / PERIOD_NS * PERIOD_NS;
        assert_eq!(inputs(&bench, &group, 0).1, Ramp::count(0, sync0_ns, 10));
        assert_eq!(inputs(&bench, &group, 1).1, Ramp::count(1, sync0_ns, 12));
    }
}

/// An encoder source that passes on the signals of another source. It logs channel and time of each conversion.
struct Logged<S>(S, Arc<Mutex<Vec<(usize, Conversion)>>>);

impl<S: EncoderSource> EncoderSource for Logged<S> {
    fn signal(&mut self, channel: usize, at: Conversion) -> Signal {
        self.1.lock().unwrap().push((channel, at));
        self.0.signal(channel, at)
    }
}

#[test]
fn each_terminal_converts_once_a_cycle_and_all_at_the_same_time() {
    let log = Arc::new(Mutex::new(Vec::new()));
    let motion = SmoothMotion::new(5, 3600, 7);
    let mut bench = Bench::new(segment_with(5, Logged(motion.clone(), Arc::clone(&log))));
    let group = preop(&mut bench);
    let group = operational(&mut bench, group);
    for _ in 0..300 {
        cycle(&mut bench, &group);
    }
    log.lock().unwrap().clear();
    for _ in 0..100 {
        cycle(&mut bench, &group);
        let conversions: Vec<_> = log.lock().unwrap().drain(..).collect();
        assert_eq!(conversions.iter().map(|(channel, _)| *channel).collect::<Vec<_>>(), [0, 1, 2, 3, 4]);
        let first = conversions[0].1;
        for (channel, at) in conversions {
            assert_eq!(at.system_time_ns, first.system_time_ns);
            assert!((at.true_time_ns - first.true_time_ns).abs() <= 10, "{at:?} against {first:?}");
            let periods = motion.angle_rad(channel, at.true_time_ns) * 3600.0 / std::f64::consts::TAU;
            let shown = inputs(&bench, &group, channel).1 as i32;
            let expected = motion.start_periods(channel).0 as f64 / Periods::ONE as f64 + periods;
            assert!((f64::from(shown) / 1024.0 - expected).abs() < 0.001);
        }
    }
}

#[test]
fn the_bus_comes_back_after_a_restart_of_the_master() {
    let mut bench = Bench::new(segment_with(5, Ramp));
    let group = preop(&mut bench);
    let group = operational(&mut bench, group);
    let maindevice = bench.maindevice;
    let group = bench.run(group.into_safe_op(maindevice)).expect("OP to SAFE-OP");
    let group = bench.run(group.into_pre_op(maindevice)).expect("SAFE-OP to PRE-OP");
    bench.run(group.into_init(maindevice)).expect("PRE-OP to INIT");
    // The master was shut down in order before. Now it restarts without a shutdown.
    let group = preop(&mut bench);
    operational(&mut bench, group);
    let group = preop(&mut bench);
    let group = operational(&mut bench, group);
    assert_eq!(cycle(&mut bench, &group).working_counter, 15);
}

#[test]
fn without_distributed_clocks_counts_are_one_cycle_old() {
    let mut bench = Bench::new(segment_with(2, Ramp));
    let group = preop(&mut bench);
    let maindevice = bench.maindevice;
    let group = bench.run(group.into_pre_op_pdi(maindevice)).unwrap();
    let group = bench.run(group.into_safe_op(maindevice)).unwrap();
    let group = bench.run(group.request_into_op(maindevice)).unwrap();
    let mut before_ns = 0;
    for number in 0..50 {
        let sent_ns = now_ns();
        let response = bench.run(group.tx_rx(maindevice)).unwrap();
        assert_eq!(response.working_counter, 6);
        let bytes: [u8; 10] = group.subdevice(maindevice, 1).unwrap().inputs_raw()[..].try_into().unwrap();
        let shown = u32::from_le_bytes(bytes[2..6].try_into().unwrap());
        // The frame reaches the first terminal one hop after the coupler. The encoder turns by one count in 4 us.
        if number > 1 {
            assert!(Ramp::count(0, before_ns + 150, 10).abs_diff(shown) <= 1, "cycle {number}");
        }
        before_ns = sent_ns;
        pass_ns(sent_ns + PERIOD_NS - now_ns());
    }
}

#[test]
fn missed_frames_are_counted_and_a_long_pause_costs_nothing() {
    let mut bench = Bench::new(segment_with(5, Ramp));
    let group = preop(&mut bench);
    let group = operational(&mut bench, group);
    let maindevice = bench.maindevice;
    let missed = |bench: &mut Bench| {
        let terminal = group.subdevice(maindevice, 4).unwrap();
        bench.run(terminal.sdo_read::<u16>(0x1c33, 0x0b)).unwrap()
    };
    for _ in 0..10 {
        cycle(&mut bench, &group);
    }
    let before = missed(&mut bench);
    cycle(&mut bench, &group);
    pass_ns(3 * PERIOD_NS);
    cycle(&mut bench, &group);
    assert_eq!(inputs(&bench, &group, 3).0 >> 13 & 1, 1, "sync error of the last cycle");
    cycle(&mut bench, &group);
    assert_eq!(inputs(&bench, &group, 3).0 >> 13 & 1, 0, "not latched");
    assert_eq!(missed(&mut bench) - before, 3);
    pass_ns(30 * 86_400 * 1_000_000_000);
    assert_eq!(missed(&mut bench), u16::MAX, "259 200 000 events");
    for _ in 0..10 {
        assert_eq!(cycle(&mut bench, &group).working_counter, 15);
    }
}

#[test]
fn the_latch_finds_the_reference_mark_over_the_bus() {
    let motion = SmoothMotion::new(1, 3600, 11);
    let mut bench = Bench::new(segment_with(1, motion));
    let group = preop(&mut bench);
    let group = operational(&mut bench, group);
    group.subdevice(bench.maindevice, 1).unwrap().outputs_raw_mut()[0] = 0x01;
    let mut latched = Vec::new();
    for _ in 0..12_000 {
        cycle(&mut bench, &group);
        let (status, counter, latch) = inputs(&bench, &group, 0);
        if status & 1 != 0 {
            assert!(latched.is_empty() || latched.contains(&latch));
            if latched.is_empty() {
                assert!(latch.abs_diff(counter) < 3000, "the mark lies close to where it was passed");
            }
            latched.push(latch);
        }
    }
    assert!(!latched.is_empty());
}
