//! Runs cycles on the simulated segment in real time, and runs cyclictest.

use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use ballbard::bus;
use ballbard::clock::Clock;
use ballbard::cycle::{Acquisition, RealtimeReport};
use ballbard::segment::simulated::{SegmentConfig, SimulatedSegment, SmoothMotion};
use ballbard::segment::{EthernetWire, FRAME_BYTES_MAX, FrameWire, InProcessWire};
use shared::config::RealtimeConfig;
use shared::recording::schema::CycleRecord;

use crate::support::{TrueInstants, plan};

/// A sample of durations \[ns\], in ascending order.
#[derive(Debug, Clone, Default)]
pub struct Distribution(Vec<i64>);

impl Distribution {
    pub fn new(mut values_ns: Vec<i64>) -> Self {
        values_ns.sort_unstable();
        Self(values_ns)
    }

    pub fn append(&mut self, mut other: Self) {
        self.0.append(&mut other.0);
        self.0.sort_unstable();
    }

    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The smallest duration that is not exceeded by the fraction `part` of all durations \[us\].
    pub fn quantile_us(&self, part: f64) -> f64 {
        let place = ((part * self.0.len() as f64).ceil() as usize).max(1) - 1;
        self.0.get(place).map_or(f64::NAN, |ns| *ns as f64 * 1e-3)
    }

    /// Number of durations above a limit \[us\].
    pub fn above_us(&self, limit_us: f64) -> usize {
        self.0.iter().filter(|ns| **ns as f64 * 1e-3 > limit_us).count()
    }

    const QUANTILES: [f64; 4] = [0.5, 0.99, 0.999, 1.0];

    pub fn row(&self) -> String {
        Self::QUANTILES.map(|part| format!("{:8.1}", self.quantile_us(part))).join(" ")
    }

    /// Minimum, median and maximum of these figures, as text.
    pub fn range(mut figures: Vec<f64>) -> String {
        figures.sort_by(f64::total_cmp);
        let at = |place: usize| figures.get(place).copied().unwrap_or(f64::NAN);
        format!("{:.2} {:.2} {:.2}", at(0), at(figures.len() / 2), at(figures.len().saturating_sub(1)))
    }

    pub fn ratio_row(&self, other: &Self) -> String {
        Self::QUANTILES
            .map(|part| format!("{:8.2}", self.quantile_us(part) / other.quantile_us(part)))
            .join(" ")
    }
}

pub struct Measured {
    pub lateness: Distribution,
    /// Absolute errors of the sample times.
    pub errors: Distribution,
    pub sigma: Distribution,
    /// Percentage of the errors that are within three times the stated uncertainty.
    pub covered_percent: f64,
    pub cycles: usize,
    /// Number of cycles that are not valid.
    pub flagged: usize,
}

/// Where the simulated segment runs.
#[derive(Debug, Clone)]
pub enum Bus {
    /// In the thread of the cycle, called without a network.
    InProcess,
    /// In another thread, at the far end of a veth pair. The names are those of the near and the far end.
    Veth([String; 2]),
}

/// Runs cycles on a thread with the same scheduling as the daemon's cycle, and returns their statistics.
pub fn run_cycles(bus: Bus, rate_hz: u64, cycles: u64, priority: i32) -> Measured {
    let realtime = RealtimeConfig { core: None, fifo_priority: priority };
    std::thread::spawn(move || {
        let _realtime = RealtimeReport::apply(realtime);
        cycle(&bus, rate_hz, cycles)
    })
    .join()
    .unwrap()
}

/// Answers frames until `stop` is set. The thread inherits the scheduling of the cycle, because real terminals are not
/// delayed by other load either.
fn serve(mut segment: SimulatedSegment, mut wire: EthernetWire, stop: &AtomicBool) {
    let (mut frame, mut reply) = ([0; FRAME_BYTES_MAX], [0; FRAME_BYTES_MAX]);
    while !stop.load(Ordering::Relaxed) {
        let until = Clock::Real.now().plus_ns(100_000_000);
        let Ok(Some(length)) = wire.receive(&mut frame, until) else { continue };
        let arrival = Clock::Real.now();
        if let Some(length) = segment.exchange(arrival.0, &frame[..length], &mut reply) {
            // A veth pair transmits a frame immediately. On a wire the frame would take the round trip,
            // so the reply is delayed.
            let back = arrival.plus_ns(segment.round_trip_ns(length));
            while Clock::Real.now() < back {
                std::hint::spin_loop();
            }
            wire.send(&reply[..length]).unwrap();
        }
    }
}

fn cycle(bus: &Bus, rate_hz: u64, cycles: u64) -> Measured {
    let plan = plan(rate_hz);
    // Before the run, the bring-up and the convergence of the clock fit need cycles of some seconds. They are stored too.
    let (source, instants) = TrueInstants::watch(SmoothMotion::new(5, 3600, 1), cycles as usize + 100_000);
    let segment = SimulatedSegment::new(&SegmentConfig::default(), Box::new(source));
    let stop = Arc::new(AtomicBool::new(false));
    let mut serving = None;
    let wire: Box<dyn FrameWire> = match bus {
        Bus::InProcess => Box::new(InProcessWire::new(segment, Clock::Real)),
        Bus::Veth([near, far]) => {
            let (far, stop) = (EthernetWire::open(far).unwrap(), Arc::clone(&stop));
            serving = Some(std::thread::spawn(move || serve(segment, far, &stop)));
            Box::new(EthernetWire::open(near).unwrap())
        }
    };
    let bus = bus::Bus::new(wire, Clock::Real, plan.reply_timeout);
    let mut acquisition = Acquisition::start(bus, &plan, Clock::Real).unwrap();
    acquisition.begin_run(|_| ());
    let mut records: Vec<CycleRecord> = Vec::with_capacity(2 * cycles as usize);
    let mut lateness_ns = Vec::with_capacity(cycles as usize);
    while (records.len() as u64) < cycles {
        acquisition.next_cycle(&mut |record| records.push(*record));
        lateness_ns.extend(acquisition.last_timing().map(|timing| timing.late_ns));
    }
    stop.store(true, Ordering::Relaxed);
    // The next run needs the far end of the veth pair, so this waits until the thread no longer uses it.
    serving.into_iter().for_each(|serving| serving.join().unwrap());
    let offset_ns = acquisition.utc_minus_monotonic_ns();
    let stamped = instants.judge(&records, offset_ns);
    let covered = stamped.iter().filter(|one| one.error_ns.abs() <= 3 * one.sigma_ns).count();
    Measured {
        lateness: Distribution::new(lateness_ns),
        errors: Distribution::new(stamped.iter().map(|one| one.error_ns.abs()).collect()),
        sigma: Distribution::new(stamped.iter().map(|one| one.sigma_ns).collect()),
        covered_percent: 100.0 * covered as f64 / stamped.len().max(1) as f64,
        cycles: records.len(),
        flagged: records.iter().filter(|record| !record.is_valid()).count(),
    }
}

/// Lateness that one thread of cyclictest measures with the same period and priority, and with locked memory. `None`
/// if cyclictest is not installed.
pub fn cyclictest(rate_hz: u64, cycles: u64, priority: i32) -> Option<Distribution> {
    let interval = (1_000_000 / rate_hz).to_string();
    let output = Command::new("cyclictest")
        .args(["-m", "-t1", "-d0", "-N", "-v", "-q", "-p", &priority.to_string()])
        .args(["-i", &interval, "-l", &cycles.to_string()])
        .output()
        .ok()?;
    // A line has the form `thread: number: latency in ns`.
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let sample = |line: &str| line.rsplit(':').next()?.trim().parse::<i64>().ok();
    let samples: Vec<i64> =
        text.lines().filter(|line| line.matches(':').count() == 2).filter_map(sample).collect();
    (!samples.is_empty()).then(|| Distribution::new(samples))
}
