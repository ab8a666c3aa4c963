//! Error counts of all devices' ports since the run began, read from one device after the other in the spare time of good
//! cycles.

use shared::recording::schema::PortCounts;
use shared::time::NS_PER_S;

use super::Acquisition;
use super::events::Happening;
use crate::bus::{CyclicExchange, DEVICES_MAX, PORTS, PortCounters};

/// Period in which each device is read once \[ns\].
const READ_PERIOD_NS: i64 = NS_PER_S;

/// Errors of all ports.
#[derive(Debug, Clone, Default)]
pub struct Links {
    /// Number of cycles until a device is read again.
    cycles_to_next: u64,
    /// Position of that device.
    next: usize,
    /// Last reading of each device; `None` before the first.
    last: [Option<[PortCounters; PORTS]>; DEVICES_MAX],
    errors: [[PortCounts; PORTS]; DEVICES_MAX],
    /// Counts that the recorder has received.
    delivered: [[PortCounts; PORTS]; DEVICES_MAX],
    /// Counts of each port when they were last reported as text.
    reported: [[u32; PORTS]; DEVICES_MAX],
    /// Increases with every change of the counts.
    revision: u64,
}

impl Links {
    /// Resets the counts for a run.
    pub(super) fn begin_run(&mut self) {
        (self.errors, self.delivered, self.reported) = Default::default();
        self.revision += 1;
    }

    /// Error counts by position and port.
    pub fn errors(&self) -> &[[PortCounts; PORTS]; DEVICES_MAX] {
        &self.errors
    }

    /// Increases with every change of them.
    pub fn revision(&self) -> u64 {
        self.revision
    }

    /// The device to read in this cycle, if one is due.
    fn due(&mut self, cycles_between: u64, devices: usize) -> Option<usize> {
        if self.cycles_to_next > 0 {
            self.cycles_to_next -= 1;
            return None;
        }
        self.cycles_to_next = cycles_between.max(1) - 1;
        let position = self.next;
        self.next = (position + 1) % devices.clamp(1, DEVICES_MAX);
        Some(position)
    }

    /// Adds the errors since the previous reading. A count that decreased restarted at zero: the device was without power.
    fn take(&mut self, position: usize, now: &[PortCounters; PORTS]) {
        let Some(before) = self.last[position].replace(*now) else { return };
        for ((errors, before), now) in self.errors[position].iter_mut().zip(before).zip(now) {
            let risen = |before: u8, now: u8| u32::from(now.checked_sub(before).unwrap_or(now));
            let total_before = errors.all();
            errors.invalid_frames += risen(before.invalid_frames, now.invalid_frames);
            errors.receive_errors += risen(before.receive_errors, now.receive_errors);
            errors.lost_links += risen(before.lost_links, now.lost_links);
            self.revision += u64::from(errors.all() != total_before);
        }
    }

    /// A port with errors that the recorder has not received, and whether to report them as text: only if they have doubled
    /// since the last report, so that a bad cable does not fill the log.
    fn take_change(&mut self, position: usize) -> Option<(PortCounts, bool)> {
        let has_changed = |port: &usize| self.errors[position][*port] != self.delivered[position][*port];
        let port = (0..PORTS).find(has_changed)?;
        let errors = self.errors[position][port];
        self.delivered[position][port] = errors;
        let reported = &mut self.reported[position][port];
        let is_news = errors.all() >= 2 * *reported;
        if is_news {
            *reported = errors.all();
        }
        Some((PortCounts { position: position as u8, port: port as u8, ..errors }, is_news))
    }
}

impl Acquisition {
    /// Errors of the ports since the run began; before, since the bus came up.
    pub fn links(&self) -> &Links {
        &self.links
    }

    /// Reads one device if it is due and the cycle has spare time.
    pub(super) fn read_links(&mut self, exchange: &CyclicExchange) {
        if exchange.reply.is_none_or(|reply| !reply.all_operational) {
            return;
        }
        let devices = self.devices.len();
        let cycles_between = READ_PERIOD_NS / self.period_ns.max(1) / devices.max(1) as i64;
        let Some(position) = self.links.due(cycles_between as u64, devices) else { return };
        let until = self.clock.now().plus_ns(self.period_ns / 4);
        let Some(counters) = self.bus.port_counters(position, until) else { return };
        self.links.take(position, &counters);
        if counters.iter().any(PortCounters::are_high) && self.bus.clear_port_counters(position, until) {
            self.links.last[position] = Some(Default::default());
        }
        while let Some((counts, is_news)) = self.links.take_change(position) {
            self.report(Happening::LinkErrors { counts, is_news });
        }
    }
}
