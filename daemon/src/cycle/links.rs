//! What the ports of all devices have counted since the run began: read from one device after the other, in the spare time of
//! cycles that went well.

use shared::recording::schema::PortCounts;
use shared::time::NS_PER_S;

use super::Acquisition;
use super::events::Happening;
use crate::bus::{CyclicExchange, DEVICES_MAX, PORTS, PortCounters};

/// Each device is looked at once in this time \[ns\].
const LOOK_PERIOD_NS: i64 = NS_PER_S;

/// Errors of all ports.
#[derive(Debug, Clone)]
pub struct Links {
    cycles_to_next: u64,
    next: usize,
    /// What each device showed last; none before the first look.
    shown: [Option<[PortCounters; PORTS]>; DEVICES_MAX],
    errors: [[PortCounts; PORTS]; DEVICES_MAX],
    /// As the recorder knows them.
    given: [[PortCounts; PORTS]; DEVICES_MAX],
    /// Of each port, as many as were told last in words.
    told: [[u32; PORTS]; DEVICES_MAX],
    /// Rises with every change of the errors.
    revision: u64,
}

impl Default for Links {
    fn default() -> Self {
        Self {
            cycles_to_next: 0,
            next: 0,
            shown: [None; DEVICES_MAX],
            errors: Default::default(),
            given: Default::default(),
            told: Default::default(),
            revision: 0,
        }
    }
}

impl Links {
    /// Counts from zero.
    pub(super) fn begin_run(&mut self) {
        (self.errors, self.given, self.told) = Default::default();
        self.revision += 1;
    }

    /// Errors of all ports, by position and port.
    pub fn errors(&self) -> &[[PortCounts; PORTS]; DEVICES_MAX] {
        &self.errors
    }

    /// Rises with every change of them.
    pub fn revision(&self) -> u64 {
        self.revision
    }

    /// The device to look at in this cycle.
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

    /// Adds what is new. A count that fell began anew at zero: the device was without power.
    fn take(&mut self, position: usize, now: &[PortCounters; PORTS]) {
        let Some(before) = self.shown[position].replace(*now) else { return };
        for ((errors, before), now) in self.errors[position].iter_mut().zip(before).zip(now) {
            let risen = |before: u8, now: u8| u32::from(now.checked_sub(before).unwrap_or(now));
            let all = errors.all();
            errors.invalid_frames += risen(before.invalid_frames, now.invalid_frames);
            errors.receive_errors += risen(before.receive_errors, now.receive_errors);
            errors.lost_links += risen(before.lost_links, now.lost_links);
            self.revision += u64::from(errors.all() != all);
        }
    }

    /// A port of a device that has counted since the recorder was given its errors, and whether they are worth words: they
    /// are twice those that were told last. A cable that is bad all day fills no log.
    fn take_change(&mut self, position: usize) -> Option<(PortCounts, bool)> {
        let ports = self.errors[position].iter().zip(&mut self.given[position]).zip(&mut self.told[position]);
        let changed =
            |(_, ((errors, given), _)): &(usize, ((&PortCounts, &mut PortCounts), &mut u32))| errors != given;
        ports.enumerate().find(changed).map(|(port, ((errors, given), told))| {
            *given = *errors;
            let is_news = errors.all() >= 2 * *told;
            *told = if is_news { errors.all() } else { *told };
            (PortCounts { position: position as u8, port: port as u8, ..*errors }, is_news)
        })
    }
}

impl Acquisition {
    /// Errors of the ports since the run began; before, since the bus came up.
    pub fn links(&self) -> &Links {
        &self.links
    }

    /// Looks at one device, if it is time and the cycle has some to spare.
    pub(super) fn look_at_links(&mut self, exchange: &CyclicExchange) {
        if exchange.reply.is_none_or(|reply| !reply.all_operational) {
            return;
        }
        let devices = self.devices.len();
        let cycles_between = LOOK_PERIOD_NS / self.period_ns.max(1) / devices.max(1) as i64;
        let Some(position) = self.links.due(cycles_between as u64, devices) else { return };
        let until = self.clock.now().plus_ns(self.period_ns / 4);
        let Some(counters) = self.bus.port_counters(position, until) else { return };
        self.links.take(position, &counters);
        if counters.iter().any(PortCounters::are_high) && self.bus.clear_port_counters(position, until) {
            self.links.shown[position] = Some(Default::default());
        }
        while let Some((counts, is_news)) = self.links.take_change(position) {
            self.tell(Happening::LinkErrors { counts, is_news });
        }
    }
}
