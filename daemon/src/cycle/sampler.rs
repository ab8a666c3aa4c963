//! Converts one exchange with the bus to one record. Counts that are new and reliable are marked as valid. For other counts,
//! the record gets flags that show the reason.

use shared::recording::schema::{CycleRecord, EncoderSample, MAX_ENCODERS, flags};
use shared::time::{DcNs, UtcNs};

use crate::bus::{CyclicExchange, CyclicReply};
use crate::devices::el5021;

/// Time at which a cycle's encoders were sampled.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SampleTime {
    /// Estimated UTC at which the encoders were sampled.
    pub utc: UtcNs,
    /// Standard deviation of `utc` \[ns\].
    pub uncertainty_ns: u32,
    /// The same time on the clock of the bus. 0 without distributed clocks.
    pub dc: DcNs,
}

/// Converts exchanges to records. It compares the inputs of each cycle with those of the previous cycle.
#[derive(Debug, Clone)]
pub struct Sampler {
    joints: [u8; MAX_ENCODERS],
    encoder_count: usize,
    working_counter_expected: u16,
    /// Flags that every record of this bus has.
    always: u32,
    /// Toggle bit in the last input of each encoder. The terminal inverts this bit with each new sample.
    /// `None` before the first input.
    toggles: [Option<bool>; MAX_ENCODERS],
}

impl Sampler {
    /// A sampler for the encoders of `joints`, in bus order. Without distributed clocks, every record gets the flag `NO_DC`.
    pub fn new(
        joints: impl IntoIterator<Item = u8>,
        working_counter_expected: u16,
        distributed_clocks: bool,
    ) -> Self {
        let mut sampler = Self {
            joints: [0; MAX_ENCODERS],
            encoder_count: 0,
            working_counter_expected,
            always: if distributed_clocks { 0 } else { flags::NO_DC },
            toggles: [None; MAX_ENCODERS],
        };
        for (place, joint) in sampler.joints.iter_mut().zip(joints) {
            *place = joint;
            sampler.encoder_count += 1;
        }
        sampler
    }

    /// Flags that every record of this bus has.
    pub fn flags_always(&self) -> u32 {
        self.always
    }

    /// Flags of a record that not every record of this bus has.
    pub fn flags_of(&self, record: &CycleRecord) -> u32 {
        record.flags & !self.always
    }

    /// The record of cycle number `cycle`, in which `exchange` took place.
    pub fn sample(&mut self, cycle: u64, time: SampleTime, exchange: &CyclicExchange) -> CycleRecord {
        let mut record = self.blank(cycle, time, exchange);
        match &exchange.reply {
            Some(reply) => self.check_inputs(&mut record, reply),
            None => {
                self.skip_cycle();
                record.flags |= flags::NO_REPLY;
            }
        }
        record
    }

    /// The record of a cycle whose sample is lost. The next sample has overwritten it before `exchange` could fetch it.
    pub fn missed(&mut self, cycle: u64, time: SampleTime, exchange: &CyclicExchange) -> CycleRecord {
        self.skip_cycle();
        let mut record = self.blank(cycle, time, exchange);
        record.working_counter = 0;
        record.flags |= flags::DEADLINE_MISSED;
        record
    }

    /// Updates the toggle bits for a cycle whose sample was not received. With distributed clocks, the terminals sample in
    /// every cycle and invert their toggle bits. Without distributed clocks, a terminal samples only when a frame arrives.
    /// It is unknown whether the frame arrived, so the bits are left unchanged.
    fn skip_cycle(&mut self) {
        if self.always & flags::NO_DC == 0 {
            self.toggles.iter_mut().flatten().for_each(|toggle| *toggle = !*toggle);
        }
    }

    fn blank(&self, cycle: u64, time: SampleTime, exchange: &CyclicExchange) -> CycleRecord {
        let mut record = CycleRecord {
            cycle,
            sample_time: time.utc,
            sample_time_uncertainty_ns: time.uncertainty_ns,
            dc_time: time.dc,
            send_time: exchange.sent,
            receive_time: exchange.received,
            working_counter: exchange.reply.map_or(0, |reply| reply.working_counter),
            working_counter_expected: self.working_counter_expected,
            flags: self.always,
            origin: 0,
            encoder_count: self.encoder_count as u8,
            encoders: [EncoderSample::default(); MAX_ENCODERS],
        };
        for (encoder, joint) in record.encoders.iter_mut().zip(self.joints) {
            encoder.joint = joint;
        }
        record
    }

    /// Marks every count of a record as invalid, and adds the flags `reason`.
    pub fn invalidate(record: &mut CycleRecord, reason: u32) {
        record.flags |= reason;
        record.encoders.iter_mut().for_each(|encoder| encoder.valid = false);
    }

    fn check_inputs(&mut self, record: &mut CycleRecord, reply: &CyclicReply) {
        let places = record.encoders.iter_mut().zip(&reply.inputs).zip(&mut self.toggles);
        for ((encoder, input), toggle_before) in places.take(self.encoder_count) {
            let toggle = input.status.toggle();
            let fresh = *toggle_before != Some(toggle);
            *toggle_before = Some(toggle);
            encoder.count = input.count;
            encoder.latch = input.latch;
            encoder.status = input.status.0;
            encoder.valid = fresh && !input.status.has_error();
            if !fresh {
                record.flags |= flags::STALE_INPUT;
            }
            if input.status.has_error() {
                record.flags |= flags::TERMINAL_ERROR;
            }
        }
        // ethercrab checks neither working counter nor state. If a terminal is missing,
        // ethercrab returns the previous inputs.
        if reply.working_counter != self.working_counter_expected {
            record.flags |= flags::WORKING_COUNTER;
        }
        if !reply.all_operational {
            record.flags |= flags::NOT_OPERATIONAL;
        }
        if record.flags & (flags::WORKING_COUNTER | flags::NOT_OPERATIONAL) != 0 {
            self.invalidate_unproven(record, reply);
        }
    }

    /// Invalidates counts if the working counter is wrong or a device is not in OP. In general this does not show which
    /// terminals are missing, so all counts become invalid. There is one exception: the working counter is too low by
    /// exactly the contribution of the terminals that do not answer. The other terminals have then processed the frame, so
    /// their counts stay valid.
    fn invalidate_unproven(&self, record: &mut CycleRecord, reply: &CyclicReply) {
        // The coupler is at position 0 and must answer. The terminal of encoder `index` is at position `index + 1`.
        let absent = |index: usize| reply.silent >> (index + 1) & 1 == 1;
        let missing = (0..self.encoder_count).filter(|index| absent(*index)).count() as u16;
        let explained = missing > 0
            && reply.silent & 1 == 0
            && reply.not_operational == reply.silent
            && self.working_counter_expected.checked_sub(missing * el5021::WORKING_COUNTER)
                == Some(reply.working_counter);
        for (index, encoder) in record.encoders.iter_mut().enumerate() {
            encoder.valid &= explained && !absent(index);
        }
    }
}

#[cfg(test)]
mod tests {
    use shared::time::MonoNs;

    use super::*;
    use crate::devices::el5021::{Input, StatusWord};

    const TIME: SampleTime = SampleTime { utc: UtcNs(1), uncertainty_ns: 2, dc: DcNs(3) };

    fn reply(toggle: bool) -> CyclicReply {
        let status = StatusWord(if toggle { 0x8000 } else { 0 });
        CyclicReply {
            working_counter: 6,
            all_operational: true,
            not_operational: 0,
            silent: 0,
            dc_time: None,
            inputs: [Input { status, count: 42, latch: 0 }; MAX_ENCODERS],
        }
    }

    fn exchange(reply: Option<CyclicReply>) -> CyclicExchange {
        CyclicExchange { sent: MonoNs(10), received: MonoNs(20), reply }
    }

    fn sampler() -> Sampler {
        Sampler::new([1, 2], 6, true)
    }

    #[test]
    fn toggling_inputs_of_a_whole_bus_are_valid() {
        let mut sampler = sampler();
        for cycle in 0..4 {
            let record = sampler.sample(cycle, TIME, &exchange(Some(reply(cycle % 2 == 0))));
            assert!(record.is_valid() && record.flags == 0, "{record:?}");
            assert_eq!(record.encoders().iter().map(|encoder| encoder.joint).collect::<Vec<_>>(), [1, 2]);
        }
    }

    #[test]
    fn an_input_that_did_not_toggle_is_stale_and_only_that_one() {
        let mut sampler = sampler();
        sampler.sample(0, TIME, &exchange(Some(reply(true))));
        let mut second = reply(true);
        second.inputs[1].status = StatusWord(0);
        let record = sampler.sample(1, TIME, &exchange(Some(second)));
        assert_eq!(record.flags, flags::STALE_INPUT);
        assert_eq!(record.encoders().iter().map(|encoder| encoder.valid).collect::<Vec<_>>(), [false, true]);
    }

    #[test]
    fn a_toggle_in_a_lost_cycle_is_counted() {
        let lost: [fn(&mut Sampler); 2] = [
            |sampler| assert_eq!(sampler.sample(1, TIME, &exchange(None)).flags, flags::NO_REPLY),
            |sampler| assert_eq!(sampler.missed(1, TIME, &exchange(None)).cycle, 1),
        ];
        for lose in lost {
            let after = |toggle: bool| {
                let mut sampler = sampler();
                sampler.sample(0, TIME, &exchange(Some(reply(true))));
                lose(&mut sampler);
                sampler.sample(2, TIME, &exchange(Some(reply(toggle)))).flags
            };
            assert_eq!(after(true), 0, "toggled twice");
            assert_eq!(
                after(false),
                flags::STALE_INPUT,
                "toggled once: the sample is that of the cycle before"
            );
        }
    }

    #[test]
    fn a_short_working_counter_or_a_device_out_of_op_invalidates_every_count() {
        let short = CyclicReply { working_counter: 3, ..reply(true) };
        let record = sampler().sample(0, TIME, &exchange(Some(short)));
        assert!(!record.encoders().iter().any(|encoder| encoder.valid));
        assert_eq!(record.flags, flags::WORKING_COUNTER);
        let safe_op = CyclicReply { all_operational: false, ..reply(true) };
        let record = sampler().sample(0, TIME, &exchange(Some(safe_op)));
        assert!(!record.encoders().iter().any(|encoder| encoder.valid));
        assert_eq!(record.flags, flags::NOT_OPERATIONAL);
    }

    #[test]
    fn terminals_before_missing_ones_stay_valid_only_if_the_counter_proves_it() {
        // The terminal at position 2 does not answer, so the working counter lacks its contribution of 3.
        let rest = CyclicReply {
            working_counter: 3,
            all_operational: false,
            not_operational: 4,
            silent: 4,
            ..reply(true)
        };
        let valid = |reply: CyclicReply| {
            let record = sampler().sample(0, TIME, &exchange(Some(reply)));
            assert_ne!(record.flags, 0);
            record.encoders().iter().map(|encoder| encoder.valid).collect::<Vec<_>>()
        };
        assert_eq!(valid(rest), [true, false]);
        let refused = [
            ("another terminal is short", CyclicReply { working_counter: 2, ..rest }),
            ("a contradiction", CyclicReply { working_counter: 6, ..rest }),
            ("a damaged counter", CyclicReply { working_counter: u16::MAX, ..rest }),
            ("the other is not in OP", CyclicReply { not_operational: 6, ..rest }),
            ("no coupler", CyclicReply { silent: 5, not_operational: 5, ..rest }),
        ];
        for (case, reply) in refused {
            assert_eq!(valid(reply), [false, false], "{case}");
        }
    }

    #[test]
    fn a_lost_reply_is_a_record_with_its_reason() {
        let record = sampler().sample(7, TIME, &exchange(None));
        assert_eq!((record.cycle, record.flags, record.is_valid()), (7, flags::NO_REPLY, false));
        assert_eq!(record.encoder_count, 2);
    }
}
