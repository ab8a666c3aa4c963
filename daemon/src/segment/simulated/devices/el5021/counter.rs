//! The counter of the EL5021: period counting and interpolation, latch, reset, set, and what goes wrong at
//! speed. Behaviour and limits as the terminal's documentation states them.

use super::mapping::{Inputs, Outputs};
use crate::segment::simulated::source::{Periods, Signal};

/// Smallest and largest interpolation, bits per signal period.
pub const BITS: std::ops::RangeInclusive<u8> = 8..=13;
/// Highest input frequency for each of [`BITS`] \[Hz\].
const FREQUENCY_MAX_HZ: [f64; 6] = [250e3, 250e3, 250e3, 170e3, 80e3, 40e3];
/// From this frequency on resolution falls, for each of [`BITS`] \[Hz\].
const REDUCTION_START_HZ: [f64; 6] = [9000.0, 4500.0, 2500.0, 1500.0, 750.0, 650.0];
/// Bits that remain at the highest frequency.
const REMAINING_BITS: u8 = 6;
/// The threshold of the amplitude error is not published.
const AMPLITUDE_MIN: f64 = 0.5;

/// What can be set by SDO.
#[derive(Debug, Clone, Copy)]
pub struct Settings {
    /// 0x8000:01, counter to zero on C.
    pub reset_on_c: bool,
    /// 0x8000:0E, counts backwards.
    pub reversed: bool,
    /// 0x8000:0F, frequency window in ms instead of us.
    pub window_in_ms: bool,
    /// 0x8000:11, frequency window.
    pub window: u16,
    /// 0x8000:1D, frequency numerator.
    pub numerator: u32,
    /// 0x8000:1E, frequency denominator.
    pub denominator: u32,
    /// 0x8000:1F, frequency filter.
    pub filter: u16,
    /// 0x8001:01.
    pub frequency_error: bool,
    /// 0x8001:02.
    pub amplitude_error: bool,
    /// 0x8001:11, bits per signal period, one of [`BITS`].
    pub bits: u8,
}

impl Default for Settings {
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

impl Settings {
    fn of(&self, table: [f64; 6]) -> f64 {
        table[usize::from(self.bits.clamp(*BITS.start(), *BITS.end()) - BITS.start())]
    }

    /// Bits that stand still at a frequency: the first one where reduction starts, one more with each octave.
    fn frozen_bits(&self, frequency_hz: f64) -> u8 {
        let start_hz = self.of(REDUCTION_START_HZ);
        if frequency_hz < start_hz {
            return 0;
        }
        let octaves = (frequency_hz / start_hz).log2().min(32.0) as u8;
        (octaves + 1).min(self.bits - REMAINING_BITS)
    }

    /// Counter value of a position: whole periods above, interpolated fraction below.
    fn count(&self, position: Periods) -> u32 {
        (position.0 as u64 >> (32 - self.bits)) as u32
    }

    fn position(&self, count: u32) -> Periods {
        Periods(i64::from(count) << (32 - self.bits))
    }
}

/// State of the counter.
#[derive(Debug, Default)]
pub struct Counter {
    /// Added to the encoder's position; in periods, so that it keeps its meaning when the bits change.
    offset: Periods,
    latch_armed: bool,
    latch_was_enabled: bool,
    set_was_requested: bool,
}

impl Counter {
    /// One conversion.
    pub fn convert(&mut self, signal: Signal, settings: &Settings, outputs: &Outputs, inputs: &mut Inputs) {
        match signal {
            Signal::Recorded { count } => inputs.counter = count,
            Signal::Turning { position, periods_per_s, amplitude, reference_mark, on_reference_mark } => {
                let frequency_hz = periods_per_s.abs();
                let directed = directed(position, settings);
                self.serve_set(directed, settings, outputs, inputs);
                self.serve_latch(reference_mark, settings, outputs, inputs);
                inputs.level_c = on_reference_mark;
                inputs.frequency_error =
                    settings.frequency_error && frequency_hz > settings.of(FREQUENCY_MAX_HZ);
                inputs.amplitude_error = settings.amplitude_error && amplitude < AMPLITUDE_MIN;
                let frozen = (1 << settings.frozen_bits(frequency_hz)) - 1;
                let count = settings.count(self.shifted(directed));
                inputs.counter = (count & !frozen) | (inputs.counter & frozen);
            }
        }
    }

    fn shifted(&self, position: Periods) -> Periods {
        Periods(position.0.wrapping_add(self.offset.0))
    }

    /// Offset with which `position` shows `count`.
    fn set(&mut self, position: Periods, count: u32, settings: &Settings) {
        self.offset = Periods(settings.position(count).0.wrapping_sub(position.0));
    }

    /// Copies the value on the rising request; done falls with the request.
    fn serve_set(&mut self, position: Periods, settings: &Settings, outputs: &Outputs, inputs: &mut Inputs) {
        if outputs.set_counter && !self.set_was_requested {
            self.set(position, outputs.set_value, settings);
        }
        self.set_was_requested = outputs.set_counter;
        inputs.set_done = outputs.set_counter;
    }

    /// Stores the position at C once after arming; sets the counter to zero there if that is chosen.
    fn serve_latch(
        &mut self,
        mark: Option<Periods>,
        settings: &Settings,
        outputs: &Outputs,
        inputs: &mut Inputs,
    ) {
        if outputs.enable_latch && !self.latch_was_enabled {
            self.latch_armed = true;
            inputs.latch_valid = false;
        } else if !outputs.enable_latch {
            self.latch_armed = false;
            inputs.latch_valid = false;
        }
        self.latch_was_enabled = outputs.enable_latch;
        let Some(mark) = mark.map(|mark| directed(mark, settings)) else { return };
        if self.latch_armed {
            inputs.latch = settings.count(self.shifted(mark));
            inputs.latch_valid = true;
            self.latch_armed = false;
        }
        if settings.reset_on_c {
            self.set(mark, 0, settings);
        }
    }
}

fn directed(position: Periods, settings: &Settings) -> Periods {
    if settings.reversed { Periods(position.0.wrapping_neg()) } else { position }
}
