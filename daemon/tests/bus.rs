//! A bus that is not what the configuration says is refused with the reason.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use ballbard::bus::{Bus, BusError, BusPlan, Operational};
use ballbard::clock::Clock;
use ballbard::segment::simulated::{SegmentConfig, SimulatedSegment, SmoothMotion};
use ballbard::segment::{FRAME_BYTES_MAX, InProcessWire, Wire};
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
            Err(BusError::WrongDevices { position, expected, found }) => {
                assert_eq!(position, first_wrong);
                assert_eq!((expected.len(), found.len()), (1 + usize::from(wanted), 1 + there));
            }
            Err(other) => panic!("{there} of {wanted}: {other}"),
            Ok(_) => panic!("{there} terminals passed for {wanted}"),
        }
    }
}

/// A cable that ends nowhere.
struct Nowhere(Clock);

impl Wire for Nowhere {
    fn send(&mut self, _frame: &[u8]) -> io::Result<()> {
        Ok(())
    }

    fn receive(&mut self, _buffer: &mut [u8; FRAME_BYTES_MAX], until: MonoNs) -> io::Result<Option<usize>> {
        self.0.sleep_until(until);
        Ok(None)
    }
}

/// An interface that was taken down.
struct Dead;

impl Wire for Dead {
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
    let wires: [Box<dyn Wire>; 2] = [Box::new(Nowhere(clock.clone())), Box::new(Dead)];
    for wire in wires {
        let error = Bus::new(wire, clock.clone(), Duration::from_millis(4)).bring_up(&plan(5)).err().unwrap();
        assert!(matches!(error, BusError::NoAnswer { .. }), "{error}");
    }
}

/// A segment whose replies are repeated, cut short and mixed with other traffic.
struct Noisy {
    inner: InProcessWire,
    repeat: Option<Vec<u8>>,
    step: u32,
}

impl Wire for Noisy {
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

/// A segment that loses one frame on its way there, or the reply to it on its way back.
struct Losing {
    inner: InProcessWire,
    sent: Arc<AtomicUsize>,
    lost: usize,
    on_the_way_back: bool,
}

impl Wire for Losing {
    fn send(&mut self, frame: &[u8]) -> io::Result<()> {
        let number = self.sent.fetch_add(1, Ordering::Relaxed);
        if number == self.lost && !self.on_the_way_back { Ok(()) } else { self.inner.send(frame) }
    }

    fn receive(&mut self, buffer: &mut [u8; FRAME_BYTES_MAX], until: MonoNs) -> io::Result<Option<usize>> {
        let received = self.inner.receive(buffer, until)?;
        if self.on_the_way_back
            && received.is_some()
            && self.sent.load(Ordering::Relaxed) == self.lost.saturating_add(1)
        {
            self.on_the_way_back = false;
            return self.inner.receive(buffer, until);
        }
        Ok(received)
    }
}

#[test]
fn whichever_frame_is_lost_there_or_back_the_bus_comes_up() {
    const PLACES: usize = 40;
    let bring_up = |lost, on_the_way_back| {
        let clock = Clock::virtual_from(UtcNs(0));
        let inner = InProcessWire::new(segment_with(5), clock.clone());
        let sent = Arc::new(AtomicUsize::new(0));
        let wire = Losing { inner, sent: Arc::clone(&sent), lost, on_the_way_back };
        let plan = plan(5);
        let up = Bus::new(Box::new(wire), clock, plan.reply_timeout).bring_up(&plan);
        up.map(|_| sent.load(Ordering::Relaxed))
    };
    let frames = bring_up(usize::MAX, false).unwrap();
    for place in 0..PLACES {
        for on_the_way_back in [false, true] {
            let lost = place * frames / PLACES;
            if let Err(error) = bring_up(lost, on_the_way_back) {
                panic!("frame {lost} of {frames}, back {on_the_way_back}: {error}");
            }
        }
    }
}
