//! Counts the errors at the ports of all devices since the run began. The devices are read one after the other, in the time
//! between a good cycle and the next cycle.
//!
//! Four sets of numbers are kept for each port. `last` is the reading of the device's own counters. `errors` is the sum of
//! their increases since the run began. `delivered` and `reported` are the values of `errors` when they were last passed to
//! the recorder, and when they were last reported as text.

use shared::recording::schema::PortCounts;
use shared::time::NS_PER_S;

use super::Acquisition;
use super::events::Happening;
use crate::bus::{CyclicExchange, DEVICES_MAX, PORTS, PortCounters};

/// Period in which all devices are read once \[ns\].
const READ_PERIOD_NS: i64 = NS_PER_S;

/// Error counts of all ports.
#[derive(Debug, Clone, Default)]
pub struct Links {
    /// Number of cycles until the next device is read.
    cycles_to_next: u64,
    /// Position of the next device.
    next: usize,
    /// Last reading of each device's counters. `None` before the first reading.
    last: [Option<[PortCounters; PORTS]>; DEVICES_MAX],
    /// Errors of each port since the run began.
    errors: [[PortCounts; PORTS]; DEVICES_MAX],
    /// Values of `errors` that the recorder has received.
    delivered: [[PortCounts; PORTS]; DEVICES_MAX],
    /// Number of errors of each port when they were last reported as text.
    reported: [[u32; PORTS]; DEVICES_MAX],
    /// Incremented with every change of `errors`.
    revision: u64,
}

impl Links {
    /// Sets all counts to zero for a new run.
    pub(super) fn begin_run(&mut self) {
        (self.errors, self.delivered, self.reported) = Default::default();
        self.revision += 1;
    }

    /// Errors since the run began, by position and port.
    pub fn errors(&self) -> &[[PortCounts; PORTS]; DEVICES_MAX] {
        &self.errors
    }

    /// Incremented with every change of the errors.
    pub fn revision(&self) -> u64 {
        self.revision
    }

    /// Position of the device to read in this cycle. `None` if no device is read in this cycle.
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

    /// Adds the errors since the previous reading of a device. If a counter has decreased, the device was without power, and
    /// the counter restarted at zero.
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

    /// Returns the counts of a port whose errors have changed since the recorder last received them. The second value states
    /// whether the counts must also be reported as text. This is the case if they have doubled since the last report. A bad
    /// cable therefore does not fill the log.
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
    /// Error counts of the ports since the run began. Before the first run, they are counted since the bus came up.
    pub fn links(&self) -> &Links {
        &self.links
    }

    /// Reads the counters of one device, if a device must be read in this cycle and all devices are in operation.
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
