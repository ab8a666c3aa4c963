//! A bus that differs from the configuration is refused, and the error names the difference.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

use std::collections::HashSet;
use std::io;
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use ballbard::bus::{Bus, BusError, BusPlan, Operational};
use ballbard::clock::Clock;
use ballbard::cycle::Acquisition;
use ballbard::problem::Fact;
use ballbard::segment::simulated::{SegmentConfig, SimulatedSegment, SmoothMotion};
use ballbard::segment::{FRAME_BYTES_MAX, FrameWire, InProcessWire};
use shared::config::EncoderConfig;
use shared::time::{MonoNs, UtcNs};

fn plan(terminals: u8) -> BusPlan {
    BusPlan {
        name: "simulated".into(),
        encoders: (1..=terminals).map(EncoderConfig::ern_1080).collect(),
        cycle_period: Duration::from_millis(10),
        distributed_clocks: true,
        sync0_shift: Duration::from_millis(5),
        reply_timeout: Duration::from_millis(4),
    }
}

fn segment_with(terminals: usize) -> SimulatedSegment {
    let config = SegmentConfig { terminals, ..SegmentConfig::default() };
    SimulatedSegment::new(&config, Box::new(SmoothMotion::new(terminals, 3600, 1)))
}

fn bring_up(terminals: usize, plan: &BusPlan) -> Result<Operational, BusError> {
    let clock = Clock::virtual_from(UtcNs(0));
    let wire = InProcessWire::new(segment_with(terminals), clock.clone());
    Bus::new(Box::new(wire), clock, plan.reply_timeout).bring_up(plan)
}

#[test]
fn the_bus_of_the_configuration_comes_up_and_names_its_devices() {
    for terminals in [1, 4, 5] {
        let operational = bring_up(terminals.into(), &plan(terminals)).unwrap();
        assert_eq!(operational.working_counter_expected, 3 * u16::from(terminals));
        let names: Vec<_> = operational.devices.iter().map(|device| device.name.as_str()).collect();
        assert!(names[0].starts_with("EK1100") && names[1..].iter().all(|name| name.starts_with("EL5021")));
        assert_eq!(names.len(), 1 + usize::from(terminals));
    }
}

#[test]
fn interpolation_can_be_13_bits_and_the_bus_can_run_without_distributed_clocks() {
    let mut fine = plan(5);
    fine.encoders.iter_mut().for_each(|encoder| encoder.interpolation_bits = 13);
    bring_up(5, &fine).unwrap();
    bring_up(5, &BusPlan { distributed_clocks: false, ..plan(5) }).unwrap();
}

#[test]
fn a_missing_or_surplus_terminal_is_named_by_its_position() {
    for (there, wanted, first_wrong) in [(4, 5, 5), (5, 4, 5), (0, 5, 1)] {
        match bring_up(there, &plan(wanted)) {
            Err(error) => match error.fact() {
                Fact::BusDeviceMissing { position, expected, found }
                | Fact::BusDeviceUnexpected { position, expected, found } => {
                    assert_eq!(*position, first_wrong);
                    assert_eq!((expected.len(), found.len()), (1 + usize::from(wanted), 1 + there));
                }
                _ => panic!("{there} of {wanted}: {error}"),
            },
            Ok(_) => panic!("{there} terminals passed for {wanted}"),
        }
    }
}

/// A network cable without a device at its end. Frames are sent, but no reply arrives.
struct Nowhere(Clock);

impl FrameWire for Nowhere {
    fn send(&mut self, _frame: &[u8]) -> io::Result<()> {
        Ok(())
    }

    fn receive(&mut self, _buffer: &mut [u8; FRAME_BYTES_MAX], until: MonoNs) -> io::Result<Option<usize>> {
        self.0.sleep_until(until);
        Ok(None)
    }
}

/// A network interface that is down, so that every call fails.
struct Dead;

impl FrameWire for Dead {
    fn send(&mut self, _frame: &[u8]) -> io::Result<()> {
        Err(io::ErrorKind::NetworkDown.into())
    }

    fn receive(&mut self, _buffer: &mut [u8; FRAME_BYTES_MAX], _until: MonoNs) -> io::Result<Option<usize>> {
        Err(io::ErrorKind::NetworkDown.into())
    }
}

#[test]
fn silence_is_reported_as_no_answer() {
    let clock = Clock::virtual_from(UtcNs(0));
    let wires: [Box<dyn FrameWire>; 2] = [Box::new(Nowhere(clock.clone())), Box::new(Dead)];
    for wire in wires {
        let error = Bus::new(wire, clock.clone(), Duration::from_millis(4)).bring_up(&plan(5)).err().unwrap();
        assert!(matches!(error.fact(), Fact::BusNoAnswer { .. }), "{error}");
    }
}

/// A segment that repeats every third reply. A repeated reply may be truncated.
struct Noisy {
    inner: InProcessWire,
    repeat: Option<Vec<u8>>,
    step: u32,
}

impl FrameWire for Noisy {
    fn send(&mut self, frame: &[u8]) -> io::Result<()> {
        self.inner.send(frame)
    }

    fn receive(&mut self, buffer: &mut [u8; FRAME_BYTES_MAX], until: MonoNs) -> io::Result<Option<usize>> {
        self.step += 1;
        if let Some(old) = self.repeat.take() {
            let length = if self.step.is_multiple_of(5) { old.len() / 2 } else { old.len() };
            buffer[..length].copy_from_slice(&old[..length]);
            return Ok(Some(length));
        }
        let received = self.inner.receive(buffer, until)?;
        if self.step.is_multiple_of(3) {
            self.repeat = received.map(|length| buffer[..length].to_vec());
        }
        Ok(received)
    }
}

#[test]
fn repeated_and_broken_replies_do_not_stop_the_bus() {
    let clock = Clock::virtual_from(UtcNs(0));
    let inner = InProcessWire::new(segment_with(5), clock.clone());
    let wire = Noisy { inner, repeat: None, step: 0 };
    let mut bus = Bus::new(Box::new(wire), clock.clone(), Duration::from_millis(4));
    let operational = bus.bring_up(&plan(5)).unwrap();
    let mut answered = 0;
    for _ in 0..1000 {
        let cycle = bus.exchange(&operational);
        answered += usize::from(cycle.reply.is_some_and(|reply| reply.working_counter == 15));
        clock.sleep_until(cycle.sent.plus_ns(10_000_000));
    }
    assert_eq!(answered, 1000);
    assert!(bus.wire_counters().rejected > 1000, "{:?}", bus.wire_counters());
}

/// A segment that loses some frames. A frame is lost before it arrives, or its reply is lost on the way back.
struct Losing<F> {
    inner: InProcessWire,
    sent: Arc<AtomicUsize>,
    /// Returns true for the numbers of the frames that are lost. Frames are numbered from 0.
    loses: F,
    on_the_way_back: bool,
}

impl<F: Fn(usize) -> bool + Send> FrameWire for Losing<F> {
    fn send(&mut self, frame: &[u8]) -> io::Result<()> {
        let number = self.sent.fetch_add(1, Ordering::Relaxed);
        if (self.loses)(number) && !self.on_the_way_back { Ok(()) } else { self.inner.send(frame) }
    }

    fn receive(&mut self, buffer: &mut [u8; FRAME_BYTES_MAX], until: MonoNs) -> io::Result<Option<usize>> {
        let received = self.inner.receive(buffer, until)?;
        // At most one request is pending, so the reply belongs to the frame that was sent last.
        let number = self.sent.load(Ordering::Relaxed).saturating_sub(1);
        if self.on_the_way_back && received.is_some() && (self.loses)(number) {
            return self.inner.receive(buffer, until);
        }
        Ok(received)
    }
}

/// Brings up a bus on a [`Losing`] segment. Returns the number of frames that the bring-up sends.
fn bring_up_losing(
    loses: impl Fn(usize) -> bool + Send + 'static,
    on_the_way_back: bool,
) -> Result<usize, BusError> {
    let clock = Clock::virtual_from(UtcNs(0));
    let inner = InProcessWire::new(segment_with(5), clock.clone());
    let sent = Arc::new(AtomicUsize::new(0));
    let wire = Losing { inner, sent: Arc::clone(&sent), loses, on_the_way_back };
    let plan = plan(5);
    Bus::new(Box::new(wire), clock, plan.reply_timeout).bring_up(&plan)?;
    Ok(sent.load(Ordering::Relaxed))
}

#[test]
fn whichever_frame_is_lost_there_or_back_the_bus_comes_up() {
    const PLACES: usize = 40;
    let frames = bring_up_losing(|_| false, false).unwrap();
    for place in 0..PLACES {
        for on_the_way_back in [false, true] {
            let lost = place * frames / PLACES;
            if let Err(error) = bring_up_losing(move |number| number == lost, on_the_way_back) {
                panic!("frame {lost} of {frames}, back {on_the_way_back}: {error}");
            }
        }
    }
}

#[test]
fn the_bus_comes_up_while_one_frame_in_a_hundred_is_lost() {
    for first in 0..25 {
        for on_the_way_back in [false, true] {
            if let Err(error) = bring_up_losing(move |number| number % 100 == 4 * first, on_the_way_back) {
                panic!("each hundredth from {} on, back {on_the_way_back}: {error}", 4 * first);
            }
        }
    }
}

/// A segment that delays its replies. It stores the frames that are sent to it.
struct Late {
    inner: InProcessWire,
    clock: Clock,
    delay_ns: Arc<AtomicI64>,
    reply: Option<(MonoNs, Vec<u8>)>,
    sent: Arc<Mutex<Vec<Vec<u8>>>>,
}

impl FrameWire for Late {
    fn send(&mut self, frame: &[u8]) -> io::Result<()> {
        self.sent.lock().unwrap().push(frame.to_vec());
        self.inner.send(frame)
    }

    fn receive(&mut self, buffer: &mut [u8; FRAME_BYTES_MAX], until: MonoNs) -> io::Result<Option<usize>> {
        if self.reply.is_none() {
            let received = self.inner.receive(buffer, until)?;
            let at = self.clock.now().plus_ns(self.delay_ns.load(Ordering::Relaxed));
            self.reply = received.map(|length| (at, buffer[..length].to_vec()));
        }
        let Some((_, reply)) = self.reply.take_if(|(at, _)| *at <= until) else {
            self.clock.sleep_until(until);
            return Ok(None);
        };
        buffer[..reply.len()].copy_from_slice(&reply);
        Ok(Some(reply.len()))
    }
}

#[test]
fn however_long_a_cyclic_frame_waits_for_its_reply_it_is_sent_once() {
    const CYCLES: usize = 40;
    let clock = Clock::virtual_from(UtcNs(0));
    let (delay_ns, sent) = (Arc::new(AtomicI64::new(0)), Arc::new(Mutex::new(Vec::new())));
    let wire = Late {
        inner: InProcessWire::new(segment_with(5), clock.clone()),
        clock: clock.clone(),
        delay_ns: Arc::clone(&delay_ns),
        reply: None,
        sent: Arc::clone(&sent),
    };
    // The reply time-out of the cycle is twice the time-out of a frame during bring-up.
    let reply_timeout = Duration::from_millis(40);
    let cycle_period = Duration::from_millis(100);
    let plan = BusPlan { cycle_period, sync0_shift: cycle_period / 2, reply_timeout, ..plan(5) };
    let bus = Bus::new(Box::new(wire), clock.clone(), reply_timeout);
    let mut acquisition = Acquisition::start(bus, &plan, clock).unwrap();
    sent.lock().unwrap().clear();
    delay_ns.store(30_000_000, Ordering::Relaxed);
    let before = acquisition.wire_counters();
    (0..CYCLES).for_each(|_| acquisition.idle());
    let after = acquisition.wire_counters();
    let sent = sent.lock().unwrap();
    let different: HashSet<&Vec<u8>> = sent.iter().collect();
    assert_eq!(different.len(), sent.len(), "a frame was sent again");
    assert!(after.received - before.received >= CYCLES as u64, "replies in time were not taken: {after:?}");
}

/// A segment that sets the flag `interrupt` after it has received `patience` frames.
struct Impatient {
    inner: InProcessWire,
    frames: Arc<AtomicUsize>,
    patience: usize,
    interrupt: Arc<AtomicBool>,
}

impl FrameWire for Impatient {
    fn send(&mut self, frame: &[u8]) -> io::Result<()> {
        let frames = self.frames.fetch_add(1, Ordering::Relaxed) + 1;
        self.interrupt.fetch_or(frames >= self.patience, Ordering::Relaxed);
        self.inner.send(frame)
    }

    fn receive(&mut self, buffer: &mut [u8; FRAME_BYTES_MAX], until: MonoNs) -> io::Result<Option<usize>> {
        self.inner.receive(buffer, until)
    }
}

#[test]
fn whenever_somebody_asks_for_the_end_the_bus_is_not_brought_up_any_further() {
    const PLACES: usize = 40;
    let bring_up = |patience| {
        let clock = Clock::virtual_from(UtcNs(0));
        let (frames, interrupt) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicBool::new(false)));
        let inner = InProcessWire::new(segment_with(5), clock.clone());
        let wire =
            Impatient { inner, frames: Arc::clone(&frames), patience, interrupt: Arc::clone(&interrupt) };
        let plan = plan(5);
        let mut bus = Bus::new(Box::new(wire), clock, plan.reply_timeout);
        bus.interrupt_by(interrupt);
        (bus.bring_up(&plan).map(|_| ()), frames.load(Ordering::Relaxed))
    };
    let (whole, frames) = bring_up(usize::MAX);
    whole.unwrap();
    // The last frame only reads that all devices are in OP, so an interruption there comes too late.
    for place in 0..PLACES {
        let patience = 1 + place * (frames - 2) / PLACES;
        let (ended, sent) = bring_up(patience);
        let ended = ended.unwrap_err();
        assert_eq!(*ended.fact(), Fact::BusInterrupted {}, "{patience} of {frames}");
        assert_eq!(sent, patience, "frames were sent after frame {patience} of {frames}");
    }
}

/// A segment whose bus clock is ahead of the host's clock by `by_ns`.
struct Shifted {
    inner: InProcessWire,
    by_ns: Arc<AtomicI64>,
}

impl FrameWire for Shifted {
    fn send(&mut self, frame: &[u8]) -> io::Result<()> {
        self.inner.send(frame)
    }

    fn receive(&mut self, buffer: &mut [u8; FRAME_BYTES_MAX], until: MonoNs) -> io::Result<Option<usize>> {
        /// Position and code of the command FRMW in a frame. This command distributes the bus time.
        const COMMAND: (usize, u8) = (16, 14);
        const DATA: std::ops::Range<usize> = 26..34;
        let received = self.inner.receive(buffer, until)?;
        if received.is_some() && buffer[COMMAND.0] == COMMAND.1 {
            let time_ns = i64::from_le_bytes(buffer[DATA].try_into().unwrap());
            let shown_ns = time_ns.wrapping_add(self.by_ns.load(Ordering::Relaxed));
            buffer[DATA].copy_from_slice(&shown_ns.to_le_bytes());
        }
        Ok(received)
    }
}

#[test]
fn a_bus_clock_that_shows_anything_is_followed_or_doubted_and_overflows_nothing() {
    let period_ns = 10_000_000;
    let round = |ns: i64| ns / period_ns * period_ns;
    // The clock overflows before, during and after the bring-up. The last shift makes it overflow in the middle of a cycle.
    for from_the_beginning in [true, false] {
        for by_ns in [round(i64::MAX - 1_700_000_000), i64::MAX, i64::MIN, i64::MIN + 1, -round(i64::MAX)] {
            let clock = Clock::virtual_from(UtcNs(0));
            let inner = InProcessWire::new(segment_with(5), clock.clone());
            let shift = Arc::new(AtomicI64::new(if from_the_beginning { by_ns } else { 0 }));
            let wire = Shifted { inner, by_ns: Arc::clone(&shift) };
            let plan = plan(5);
            let bus = Bus::new(Box::new(wire), clock.clone(), plan.reply_timeout);
            // The bring-up may refuse a clock that is not synchronous with SYNC0.
            let Ok(mut acquisition) = Acquisition::start(bus, &plan, clock) else { continue };
            shift.store(by_ns, Ordering::Relaxed);
            let mut cycles = Vec::new();
            acquisition.begin_run(|_| ());
            while cycles.len() < 500 {
                acquisition.next_cycle(&mut |record| cycles.push(record.cycle));
            }
            assert!(cycles.iter().copied().eq(0..cycles.len() as u64), "{by_ns}: a hole");
        }
    }
}
