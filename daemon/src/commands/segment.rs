//! `ballbard segment`: the simulated segment on a network interface, for any EtherCAT MainDevice.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use clap::Args;
use shared::time::NS_PER_S;

use super::on_signal;
use crate::clock::Clock;
use crate::segment::simulated::{SegmentConfig, SimulatedSegment, SmoothMotion};
use crate::segment::{EthernetWire, FRAME_BYTES_MAX, Wire};

#[derive(Debug, Args)]
pub struct SegmentArguments {
    /// Network interface to serve, such as one end of a veth pair
    #[arg(long)]
    interface: String,
    /// EL5021 terminals behind the EK1100
    #[arg(long, default_value_t = SegmentConfig::default().terminals)]
    terminals: usize,
    /// Signal periods per revolution of the simulated encoders
    #[arg(long, default_value_t = 3600)]
    lines: u32,
}

pub fn run(arguments: &SegmentArguments) -> anyhow::Result<()> {
    let config = SegmentConfig { terminals: arguments.terminals, ..SegmentConfig::default() };
    let motion = SmoothMotion::new(config.terminals, arguments.lines, config.seed);
    let segment = SimulatedSegment::new(&config, Box::new(motion));
    let wire = EthernetWire::open(&arguments.interface)?;
    let stop = Arc::new(AtomicBool::new(false));
    let serving = Arc::clone(&stop);
    println!("serving an EK1100 with {} EL5021 on {}", config.terminals, arguments.interface);
    on_signal(move || serve(segment, wire, &serving), |_| stop.store(true, Ordering::Release))
}

/// Answers each frame as it comes, until stopped.
fn serve(mut segment: SimulatedSegment, mut wire: EthernetWire, stop: &AtomicBool) -> anyhow::Result<()> {
    let clock = Clock::Real;
    let (mut frame, mut reply) = ([0; FRAME_BYTES_MAX], [0; FRAME_BYTES_MAX]);
    while !stop.load(Ordering::Acquire) {
        let Some(length) = wire.receive(&mut frame, clock.now().plus_ns(NS_PER_S / 10))? else { continue };
        if let Some(length) = segment.exchange(clock.now().0, &frame[..length], &mut reply) {
            wire.send(&reply[..length])?;
        }
    }
    Ok(())
}
