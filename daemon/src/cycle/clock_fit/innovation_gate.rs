//! Readings that no delay explains: a misread one, a stepped clock, or another rate?
//!
//! The filter goes on as if there was nothing. A deviation from it that stays the same is a step, one that grows is
//! another rate, and one that is gone with the next reading was a misread bus time. A reply so slow that it would fit
//! with the step as well as without it decides nothing.

use shared::time::MonoNs;

/// A verdict takes as many readings.
const READINGS_MIN: u32 = 3;
/// Readings that decide nothing after which the first one is taken for misread.
const UNDECIDED_MAX: u32 = 100;
/// Times that readings contradict all before: such a clock is not usable as it is.
const ERRATIC_MAX: u32 = 10;
/// Two readings of the same deviation differ by this beside their delays \[ns\].
const NOISE_NS: f64 = 1_000.0;
/// Readings decide something whose deviation is as many times what delays may have done to it.
const SIGNAL_TO_NOISE: f64 = 6.0;
/// A deviation that grew by this part of the first one grows ...
const GROWTH: f64 = 1.0 / 3.0;
/// ... or by this much, where that is less \[ns\].
const GROWTH_NS: f64 = 10_000.0;
/// No rate jumps as far as this from one reading to the next \[ns\].
const JUMP_NS: f64 = 1_000_000.0;
/// What `adjtime` and NTP do to the host's clock \[ns/s\]: a verdict waits until it would show ...
const RATE_USUAL: f64 = 500e3;
/// ... but not longer than this \[s\].
const WAIT_S_MAX: f64 = 0.25;
/// The most that chrony does \[ns/s\].
const RATE_MAX: f64 = 100e6;

/// What a reading tells: where it lies beside the prediction, and why it may.
#[derive(Debug, Clone, Copy)]
pub(super) struct Deviation {
    pub at: MonoNs,
    /// Later on the bus' clock than predicted by this \[ns\].
    pub by_ns: f64,
    /// Its own delay explains this much \[ns\] ...
    pub delayed_ns: f64,
    /// ... and the prediction's uncertainty that much \[ns\].
    pub predicted_ns: f64,
}

impl Deviation {
    pub fn is_explained(&self) -> bool {
        self.by_ns.abs() <= self.delayed_ns + self.predicted_ns
    }
}

/// What readings since the first unexplained one say.
#[derive(Debug, Clone)]
pub(super) struct Doubt {
    first: Deviation,
    /// Readings that are not explained, as the first is not.
    agreeing: u32,
    undecided: u32,
    erratic: u32,
    largest_ns: f64,
}

/// What a further reading makes of a doubt.
pub(super) enum Verdict {
    /// All is as it was.
    Unfounded,
    /// Further readings will tell.
    Unsure(Doubt),
    /// One of the clocks was stepped.
    Stepped,
    /// One of the clocks changed its rate, by about this much \[ns/s\].
    OtherRate(f64),
}

impl Doubt {
    pub fn begin(first: Deviation) -> Self {
        Self { first, agreeing: 1, undecided: 0, erratic: 0, largest_ns: first.by_ns.abs() }
    }

    /// How far the fit may be wrong \[ns\].
    pub fn largest_ns(&self) -> f64 {
        self.largest_ns
    }

    /// Takes a further reading into account.
    pub fn judge(mut self, reading: Deviation) -> Verdict {
        let noise_ns = reading.delayed_ns + self.first.delayed_ns + NOISE_NS;
        let grown_ns = reading.by_ns - self.first.by_ns;
        if reading.is_explained() && grown_ns.abs() > noise_ns {
            return Verdict::Unfounded;
        }
        let signal_ns = reading.by_ns.abs().max(self.first.by_ns.abs());
        if reading.is_explained() || noise_ns > signal_ns / SIGNAL_TO_NOISE {
            self.undecided += 1;
            if !reading.is_explained() && reading.delayed_ns < self.first.delayed_ns {
                (self.first, self.agreeing) = (reading, 1);
            }
            return if self.undecided > UNDECIDED_MAX { Verdict::Unfounded } else { Verdict::Unsure(self) };
        }
        self.largest_ns = self.largest_ns.max(reading.by_ns.abs());
        if reading.by_ns * self.first.by_ns < 0.0 {
            return self.contradicted(reading);
        }
        self.agreeing += 1;
        let lasted_s = reading.at.seconds_since(self.first.at);
        if self.agreeing < READINGS_MIN || lasted_s < self.wait_s(noise_ns) {
            return Verdict::Unsure(self);
        }
        if grown_ns.abs() <= noise_ns + self.growth_ns() {
            return Verdict::Stepped;
        }
        let rate = grown_ns / lasted_s.max(1e-9);
        if rate * self.first.by_ns > 0.0 && rate.abs() <= RATE_MAX {
            return Verdict::OtherRate(rate);
        }
        self.contradicted(reading)
    }

    /// Growth of a deviation that is not worth the name \[ns\].
    fn growth_ns(&self) -> f64 {
        let part_ns = GROWTH * self.first.by_ns.abs();
        if self.first.by_ns.abs() > JUMP_NS { part_ns } else { part_ns.min(GROWTH_NS) }
    }

    /// After as long a usual rate shows in spite of the noise.
    fn wait_s(&self, noise_ns: f64) -> f64 {
        if self.first.by_ns.abs() > JUMP_NS {
            return 0.0;
        }
        ((noise_ns + self.growth_ns()) / RATE_USUAL).min(WAIT_S_MAX)
    }

    /// A reading that agrees neither with what was before nor with the first doubted one: begins anew.
    fn contradicted(self, reading: Deviation) -> Verdict {
        let erratic = self.erratic + 1;
        if erratic >= ERRATIC_MAX {
            return Verdict::Stepped;
        }
        let largest_ns = self.largest_ns.max(reading.by_ns.abs());
        Verdict::Unsure(Self { erratic, largest_ns, ..Self::begin(reading) })
    }
}
