//! The real-time thread: brings the bus up, cycles, ends.

use std::sync::mpsc::{Receiver, SyncSender, TryRecvError};

use shared::recording::schema::DeviceInfo;

use super::source::Prepared;
use super::{RunError, Stop};
use crate::bus::Bus;
use crate::clock::Clock;
use crate::cycle::{Acquisition, RealtimeReport, RealtimeRequest};
use crate::recorder::CycleSink;

/// What the cycle's thread reports before the run begins.
pub(super) struct Ready {
    pub devices: Vec<DeviceInfo>,
    pub utc_minus_monotonic_ns: i64,
    pub realtime: Option<RealtimeReport>,
}

/// Bus, cycles, and the end of the run. Everything that may block is behind the ring or before the first cycle.
pub(super) fn run(
    prepared: Prepared,
    realtime: RealtimeRequest,
    mut sink: CycleSink,
    ready: &SyncSender<Result<Ready, RunError>>,
    go: &Receiver<()>,
    stop: &Stop,
) {
    let Prepared { wire, clock, plan, replay, cycles, .. } = prepared;
    let realtime = clock.is_real().then(|| realtime.apply());
    let bus = Bus::new(wire, clock.clone(), plan.reply_timeout);
    let mut acquisition = match Acquisition::start(bus, &plan, clock.clone()) {
        Ok(acquisition) => acquisition,
        Err(error) => {
            let _ = ready.send(Err(error.into()));
            return;
        }
    };
    if let Some((_, first_sample)) = &replay {
        acquisition.set_first_sample_time(*first_sample);
    }
    let devices = acquisition.devices().to_vec();
    let utc_minus_monotonic_ns = acquisition.utc_minus_monotonic_ns();
    let _ = ready.send(Ok(Ready { devices, utc_minus_monotonic_ns, realtime }));
    if !wait_for_go(&mut acquisition, &clock, go) {
        return;
    }
    acquisition.begin_run(|first_sample| {
        if let Some((replay, _)) = &replay {
            replay.start_at(first_sample.0);
        }
    });
    let mut done = 0;
    while !stop.is_stopped() && !sink.is_abandoned() && cycles.is_none_or(|wanted| done < wanted) {
        acquisition.next_cycle(&mut |record| {
            if cycles.is_none_or(|wanted| record.cycle < wanted) {
                sink.push(record);
                done = record.cycle + 1;
            }
        });
        while let Some(event) = acquisition.take_event() {
            sink.push_event(event);
        }
    }
    stop.stop(if replay.is_some() { "end of the replayed recording" } else { "duration reached" });
    tracing::info!(
        late_us_max = acquisition.late_ns_max() as f64 * 1e-3,
        wire = ?acquisition.wire_counters(),
        "cycle ended"
    );
}

/// Keeps the bus going until the recorder is ready; false if there will be no run.
fn wait_for_go(acquisition: &mut Acquisition, clock: &Clock, go: &Receiver<()>) -> bool {
    if !clock.is_real() {
        // Nothing happens on virtual time while nobody asks for it.
        return go.recv().is_ok();
    }
    loop {
        match go.try_recv() {
            Ok(()) => return true,
            Err(TryRecvError::Disconnected) => return false,
            Err(TryRecvError::Empty) => acquisition.idle(),
        }
    }
}
