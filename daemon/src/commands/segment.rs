//! `ballbard segment`: serves the simulated segment on a network interface, for any EtherCAT MainDevice. Faults are scheduled
//! by `--fault`, or switched by lines on the standard input. The line `play` starts a replay.

use std::io::{self, BufRead, Write};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use clap::Args;
use shared::output::say;
use shared::time::{MonoNs, NS_PER_S};

use super::fault::FaultParser;
use super::on_signal;
use crate::clock::Clock;
use crate::run::{open_replay, replaying_segment};
use crate::segment::faults::{FaultHandle, FaultSwitch, FaultWindow, FaultySegment, MisplacedFault};
use crate::segment::simulated::{
    EncoderSource, ReplayHandle, Revision, SegmentConfig, SimulatedSegment, SmoothMotion, TERMINALS_MAX,
};
use crate::segment::{EthernetWire, FRAME_BYTES_MAX, FrameWire};

#[derive(Debug, Args)]
pub struct SegmentArguments {
    /// Network interface to serve, such as one end of a veth pair
    #[arg(long, help_heading = "Connection")]
    interface: String,
    /// Recording whose motion the encoders repeat each time the line `play` is typed; it determines the number of terminals
    #[arg(long, help_heading = "Simulation", value_name = "FILE", conflicts_with_all = ["terminals", "lines"])]
    replay: Option<PathBuf>,
    /// Number of EL5021 terminals behind the EK1100, at most 16
    #[arg(long, help_heading = "Simulation", default_value_t = SegmentConfig::default().terminals as u8,
        value_parser = clap::value_parser!(u8).range(0..=i64::from(TERMINALS_MAX)))]
    terminals: u8,
    /// Signal periods per revolution of the simulated encoders
    #[arg(long, help_heading = "Simulation", default_value_t = 3600)]
    lines: u32,
    /// Revision of the terminals, 16 to 22: up to 18, some status bits are in other objects than
    /// 0x6000; 22 also measures frequency
    #[arg(long, help_heading = "Simulation", default_value_t = 20, value_parser = clap::value_parser!(u8).range(16..=22))]
    revision: u8,
    /// Seed of the motion, of the clocks of the devices and of random faults
    #[arg(long, help_heading = "Simulation", default_value_t = SegmentConfig::default().seed)]
    seed: u64,
    /// Inject a fault, such as lost:0.01 or gone:3@10s-15s (repeatable; `list` prints all faults). Lines such as
    /// `on gone:3` and `off gone:3` on standard input also switch faults
    #[arg(long = "fault", help_heading = "Simulation", value_name = "FAULT[@FROM[-UNTIL]]",
        value_parser = FaultParser)]
    faults: Vec<FaultWindow>,
}

pub fn run(arguments: &SegmentArguments) -> anyhow::Result<()> {
    let mut config = SegmentConfig {
        terminals: usize::from(arguments.terminals),
        seed: arguments.seed,
        revision: Revision::from_number(arguments.revision).unwrap_or_default(),
        ..SegmentConfig::default()
    };
    let (source, replay): (Box<dyn EncoderSource>, _) = match &arguments.replay {
        Some(file) => {
            let (recording, source, replay) = open_replay(file)?;
            config = replaying_segment(config, &recording);
            (Box::new(source), Some(replay))
        }
        None => (Box::new(SmoothMotion::new(config.terminals, arguments.lines, config.seed)), None),
    };
    let terminals = config.terminals;
    FaultWindow::ensure_effective(&arguments.faults, terminals)?;
    let segment = SimulatedSegment::new(&config, source);
    let (mut segment, faults) = FaultySegment::new(segment, config.seed);
    segment.schedule(&arguments.faults);
    let wire = EthernetWire::open(&arguments.interface)?;
    let stop = Arc::new(AtomicBool::new(false));
    let stop_serving = Arc::clone(&stop);
    say(format_args!("serving an EK1100 with {terminals} EL5021 on {}", arguments.interface))?;
    if let Some(file) = &arguments.replay {
        say(format_args!("type `play` to start the motion of {}", file.display()))?;
    }
    // The thread ends when the standard input or this program ends, whichever comes first.
    thread::Builder::new()
        .name("switches".into())
        .spawn(move || handle_lines(&faults, terminals, replay.as_ref()))?;
    let work = async { tokio::task::spawn_blocking(move || serve(segment, wire, &stop_serving)).await? };
    on_signal(work, |_| stop.store(true, Ordering::Release))
}

/// Reads lines from the standard input. Lines such as `on gone:3` and `off gone:3` switch faults. `play`
/// starts the replay from its beginning.
fn handle_lines(faults: &FaultHandle, terminals: usize, replay: Option<&ReplayHandle>) {
    for line in io::stdin().lock().lines().map_while(Result::ok).filter(|line| !line.trim().is_empty()) {
        let line = line.trim();
        match (line, replay) {
            ("play", Some(replay)) => replay.start_at_next(),
            ("play", None) => {
                tracing::warn!("there is nothing to play; add --replay FILE");
                continue;
            }
            _ => match line.parse() {
                Ok(FaultSwitch { fault, .. }) if fault.is_misplaced(terminals) => {
                    tracing::warn!("`{line}`: {MisplacedFault}");
                    continue;
                }
                Ok(FaultSwitch { fault, on: true }) => faults.begin(fault),
                Ok(FaultSwitch { fault, on: false }) => faults.end(fault),
                Err(error) => {
                    tracing::warn!("{error}");
                    continue;
                }
            },
        }
        // Ignore the error if the standard output is closed.
        let _ = writeln!(io::stdout(), "{line}");
    }
}

/// Replies to each frame until `stop` is set. If the interface goes down, this function waits, because
/// the interface may come up again.
fn serve(mut segment: FaultySegment, mut wire: EthernetWire, stop: &AtomicBool) -> anyhow::Result<()> {
    let clock = Clock::Real;
    let (mut frame, mut reply) = ([0; FRAME_BYTES_MAX], [0; FRAME_BYTES_MAX]);
    while !stop.load(Ordering::Acquire) {
        let idle_until = clock.now().plus_ns(NS_PER_S / 10);
        let until = segment.next_reply_ns().map_or(idle_until, |due_ns| idle_until.min(MonoNs(due_ns)));
        match wire.receive(&mut frame, until) {
            // No return delay is simulated, because the real wire has its own delay.
            Ok(Some(length)) => segment.exchange(clock.now().0, 0, &frame[..length]),
            Ok(None) => {}
            Err(_) => clock.sleep_until(until),
        }
        while let Some(length) = segment.take_reply(clock.now().0, &mut reply) {
            // A reply that cannot be sent is dropped.
            let _ = wire.send(&reply[..length]);
        }
    }
    Ok(())
}
