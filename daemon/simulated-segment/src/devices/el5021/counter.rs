//! The counter of the EL5021. It counts and interpolates signal periods, latches the count at the reference mark, can be
//! reset and set, and reports errors at high speed. Input C is the reference mark. Behaviour and limits follow the
//! documentation of the terminal.

use super::mapping::{Inputs, Outputs};
use crate::source::{Periods, Signal};

/// Interpolation of the terminal, from smallest to largest \[bits per signal period\].
pub const BITS: std::ops::RangeInclusive<u8> = 8..=13;
/// Highest permitted input frequency, for each interpolation in [`BITS`] \[Hz\].
const FREQUENCY_MAX_HZ: [f64; 6] = [250e3, 250e3, 250e3, 170e3, 80e3, 40e3];
/// Frequency above which the resolution decreases, for each interpolation in [`BITS`] \[Hz\].
const REDUCTION_START_HZ: [f64; 6] = [9000.0, 4500.0, 2500.0, 1500.0, 750.0, 650.0];
/// Number of interpolated bits that remain valid at any frequency.
const REMAINING_BITS: u8 = 6;
/// Amplitude below which the terminal reports an error, as a fraction of 1 Vpp. The value is an assumption, because the
/// limit of the real terminal is not published.
const AMPLITUDE_MIN: f64 = 0.5;

/// Settings in the object dictionary, with index and subindex.
#[derive(Debug, Clone, Copy)]
pub struct CounterSettings {
    /// 0x8000:01, set the counter to zero at the reference mark (C).
    pub reset_on_c: bool,
    /// 0x8000:0E, count backwards.
    pub reversed: bool,
    /// 0x8000:0F, the frequency window is in ms; otherwise it is in us.
    pub window_in_ms: bool,
    /// 0x8000:11, frequency window.
    pub window: u16,
    /// 0x8000:1D, frequency numerator.
    pub numerator: u32,
    /// 0x8000:1E, frequency denominator.
    pub denominator: u32,
    /// 0x8000:1F, frequency filter.
    pub filter: u16,
    /// 0x8001:01, report frequency errors.
    pub frequency_error: bool,
    /// 0x8001:02, report amplitude errors.
    pub amplitude_error: bool,
    /// 0x8001:11, bits per signal period, one of [`BITS`].
    pub bits: u8,
}

impl Default for CounterSettings {
    fn default() -> Self {
        Self {
            reset_on_c: false,
            reversed: false,
            window_in_ms: false,
            window: 10_000,
            numerator: 100,
            denominator: 1,
            filter: 0,
            frequency_error: true,
            amplitude_error: true,
            bits: 10,
        }
    }
}

impl CounterSettings {
    /// The value in `table` for the present interpolation. The table contains one value for each interpolation in [`BITS`].
    fn for_bits(&self, table: [f64; 6]) -> f64 {
        table[usize::from(self.bits.clamp(*BITS.start(), *BITS.end()) - BITS.start())]
    }

    /// Number of lowest bits that stay constant at a frequency. Where the reduction begins, it is one bit; each further
    /// doubling of the frequency adds one bit.
    fn constant_bits(&self, frequency_hz: f64) -> u8 {
        let start_hz = self.for_bits(REDUCTION_START_HZ);
        if frequency_hz < start_hz {
            return 0;
        }
        let octaves = (frequency_hz / start_hz).log2().min(32.0) as u8;
        (octaves + 1).min(self.bits - REMAINING_BITS)
    }

    /// Converts a position to a counter value. The upper bits are the whole periods, the
    /// lower bits the interpolated fraction.
    fn count(&self, position: Periods) -> u32 {
        (position.0 as u64 >> (32 - self.bits)) as u32
    }

    /// Inverse of [`Self::count`]: converts a counter value to a position.
    fn position(&self, count: u32) -> Periods {
        Periods(i64::from(count) << (32 - self.bits))
    }
}

/// State of the counter.
#[derive(Debug, Default)]
pub struct Counter {
    pub settings: CounterSettings,
    /// Difference between the position that is counted and the position of the encoder. It is stored in periods, so it stays
    /// correct if the interpolation changes.
    offset: Periods,
    /// Whether the next conversion must set the number of whole periods to zero, because the terminal has been powered up.
    begins_at_zero: bool,
    latch_armed: bool,
    latch_was_enabled: bool,
    set_was_requested: bool,
}

impl Counter {
    /// A counter after a power cycle, in which the number of whole periods was lost.
    pub fn after_power_cycle() -> Self {
        Self { begins_at_zero: true, ..Self::default() }
    }

    /// Performs one conversion. The inputs are computed from the encoder's signal and from the requests in the outputs.
    pub fn convert(&mut self, signal: Signal, outputs: &Outputs, inputs: &mut Inputs) {
        match signal {
            Signal::Recorded { count } => {
                inputs.counter = count;
                (inputs.frequency_error, inputs.amplitude_error) = (false, false);
            }
            Signal::Turning { position, periods_per_s, amplitude, reference_mark, on_reference_mark } => {
                let frequency_hz = periods_per_s.abs();
                let directed = self.directed(position);
                if std::mem::take(&mut self.begins_at_zero) {
                    // The signal determines the fraction of a period, but not the number of whole
                    // periods, which starts at zero.
                    self.offset = Periods(directed.0.div_euclid(Periods::ONE).wrapping_mul(-Periods::ONE));
                }
                self.serve_set(directed, outputs, inputs);
                self.serve_latch(reference_mark, outputs, inputs);
                let settings = &self.settings;
                inputs.level_c = on_reference_mark;
                inputs.frequency_error =
                    settings.frequency_error && frequency_hz > settings.for_bits(FREQUENCY_MAX_HZ);
                inputs.amplitude_error = settings.amplitude_error && amplitude < AMPLITUDE_MIN;
                // At high frequencies, the lowest bits keep the value of the previous conversion.
                let constant = (1 << settings.constant_bits(frequency_hz)) - 1;
                let count = settings.count(self.shifted(directed));
                inputs.counter = (count & !constant) | (inputs.counter & constant);
            }
        }
    }

    /// The position in the counting direction of the terminal: its sign is reversed if the terminal counts backwards.
    fn directed(&self, position: Periods) -> Periods {
        if self.settings.reversed { Periods(position.0.wrapping_neg()) } else { position }
    }

    fn shifted(&self, position: Periods) -> Periods {
        Periods(position.0.wrapping_add(self.offset.0))
    }

    /// Sets the offset so that the count at `position` is `count`.
    fn set(&mut self, position: Periods, count: u32) {
        self.offset = Periods(self.settings.position(count).0.wrapping_sub(position.0));
    }

    /// Sets the counter when `set_counter` changes from false to true. `set_done` always equals `set_counter`.
    fn serve_set(&mut self, position: Periods, outputs: &Outputs, inputs: &mut Inputs) {
        if outputs.set_counter && !self.set_was_requested {
            self.set(position, outputs.set_value);
        }
        self.set_was_requested = outputs.set_counter;
        inputs.set_done = outputs.set_counter;
    }

    /// Latches the count at the first reference mark after the latch was armed. If `reset_on_c` is set, every reference mark
    /// also sets the counter to zero.
    fn serve_latch(&mut self, mark: Option<Periods>, outputs: &Outputs, inputs: &mut Inputs) {
        if outputs.enable_latch && !self.latch_was_enabled {
            self.latch_armed = true;
            inputs.latch_valid = false;
        } else if !outputs.enable_latch {
            self.latch_armed = false;
            inputs.latch_valid = false;
        }
        self.latch_was_enabled = outputs.enable_latch;
        let Some(mark) = mark.map(|mark| self.directed(mark)) else { return };
        if self.latch_armed {
            inputs.latch = self.settings.count(self.shifted(mark));
            inputs.latch_valid = true;
            self.latch_armed = false;
        }
        if self.settings.reset_on_c {
            self.set(mark, 0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(periods: f64, periods_per_s: f64, mark: Option<f64>) -> Signal {
        Signal::Turning {
            position: Periods::from_f64(periods),
            periods_per_s,
            amplitude: 1.0,
            reference_mark: mark.map(Periods::from_f64),
            on_reference_mark: false,
        }
    }

    #[derive(Default)]
    struct Terminal {
        counter: Counter,
        outputs: Outputs,
        inputs: Inputs,
    }

    impl Terminal {
        fn with_bits(bits: u8) -> Self {
            let mut terminal = Self::default();
            terminal.counter.settings.bits = bits;
            terminal
        }

        fn convert(&mut self, signal: Signal) -> u32 {
            self.counter.convert(signal, &self.outputs, &mut self.inputs);
            self.inputs.counter
        }
    }

    #[test]
    fn whole_periods_are_above_the_interpolated_fraction() {
        for bits in BITS {
            let mut terminal = Terminal::with_bits(bits);
            assert_eq!(terminal.convert(at(5.75, 0.0, None)), (5 << bits) + 3 * (1 << bits) / 4);
            assert_eq!(terminal.convert(at(-0.25, 0.0, None)), 0u32.wrapping_sub(1 << (bits - 2)));
        }
    }

    #[test]
    fn at_12_bits_the_counter_wraps_after_1_048_576_periods() {
        let mut terminal = Terminal::with_bits(12);
        assert_eq!(terminal.convert(at(1_048_576.5, 0.0, None)), 2048);
    }

    #[test]
    fn resolution_is_full_below_750_hz_and_6_bits_at_80_khz() {
        let settings = CounterSettings { bits: 12, ..CounterSettings::default() };
        let constant = [(0.0, 0), (749.0, 0), (751.0, 1), (1499.0, 1), (1501.0, 2), (80e3, 6)];
        for (frequency_hz, bits) in constant {
            assert_eq!(settings.constant_bits(frequency_hz), bits, "{frequency_hz} Hz");
        }
    }

    #[test]
    fn constant_bits_keep_their_value_and_no_status_bit_reports_it() {
        let mut terminal = Terminal::with_bits(12);
        let slow = terminal.convert(at(1.0 + 5.0 / 4096.0, 100.0, None));
        let fast = terminal.convert(at(2.0 + 2.0 / 4096.0, 4000.0, None));
        assert_eq!((slow & 7, fast & 7, fast >> 3), (5, 5, 2 << 9));
        assert_eq!(terminal.inputs.status(), 0);
    }

    #[test]
    fn too_fast_or_too_weak_is_reported_and_makes_the_inputs_invalid() {
        let mut terminal = Terminal::with_bits(12);
        terminal.convert(at(0.0, -81e3, None));
        assert_eq!(terminal.inputs.status(), 1 << 3 | 1 << 14);
        let weak = Signal::Turning {
            position: Periods(0),
            periods_per_s: 0.0,
            amplitude: 0.1,
            reference_mark: None,
            on_reference_mark: true,
        };
        terminal.convert(weak);
        assert_eq!(terminal.inputs.status(), 1 << 4 | 1 << 10 | 1 << 14);
        terminal.counter.settings.amplitude_error = false;
        terminal.convert(weak);
        assert_eq!(terminal.inputs.status(), 1 << 10);
    }

    #[test]
    fn the_latch_takes_the_first_mark_after_arming_and_keeps_it() {
        let mut terminal = Terminal::with_bits(12);
        terminal.convert(at(1.0, 0.0, Some(0.5)));
        assert!(!terminal.inputs.latch_valid, "not armed");
        terminal.outputs.enable_latch = true;
        terminal.convert(at(3.0, 0.0, Some(2.25)));
        terminal.convert(at(9.0, 0.0, Some(8.0)));
        assert_eq!((terminal.inputs.latch_valid, terminal.inputs.latch), (true, (2 << 12) + 1024));
        terminal.outputs.enable_latch = false;
        terminal.convert(at(9.0, 0.0, None));
        assert!(!terminal.inputs.latch_valid);
        terminal.outputs.enable_latch = true;
        terminal.convert(at(12.0, 0.0, Some(11.0)));
        assert_eq!((terminal.inputs.latch_valid, terminal.inputs.latch), (true, 11 << 12));
    }

    #[test]
    fn set_counter_acts_on_the_rising_request_and_done_follows_it() {
        let mut terminal = Terminal::with_bits(10);
        terminal.outputs = Outputs { set_counter: true, set_value: 5000, enable_latch: false };
        assert_eq!(terminal.convert(at(7.5, 0.0, None)), 5000);
        assert_eq!(terminal.convert(at(8.5, 0.0, None)), 5000 + 1024, "once only");
        assert!(terminal.inputs.set_done);
        terminal.outputs.set_counter = false;
        terminal.convert(at(8.5, 0.0, None));
        assert!(!terminal.inputs.set_done);
    }

    #[test]
    fn reset_on_c_counts_from_the_mark() {
        let mut terminal = Terminal::with_bits(12);
        terminal.counter.settings.reset_on_c = true;
        assert_eq!(terminal.convert(at(10.25, 0.0, Some(10.0))), 1024);
        assert_eq!(terminal.convert(at(11.0, 0.0, None)), 4096);
    }

    #[test]
    fn reversed_counts_run_backwards() {
        let mut terminal = Terminal::with_bits(12);
        terminal.counter.settings.reversed = true;
        assert_eq!(terminal.convert(at(2.0, 0.0, None)), 0u32.wrapping_sub(2 << 12));
    }

    #[test]
    fn a_recorded_count_is_independent_of_the_settings() {
        let mut terminal = Terminal::with_bits(8);
        terminal.counter.settings.reversed = true;
        terminal.outputs.set_counter = true;
        assert_eq!(terminal.convert(Signal::Recorded { count: 0xdead_beef }), 0xdead_beef);
    }
}
