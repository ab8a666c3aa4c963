//! Innovation gate: classifies readings that no delay explains as misread, as a stepped clock, or as a changed rate.
//!
//! The filter continues without such readings. A deviation that stays constant is a step, one that grows is a changed
//! rate, and one that disappears with the next reading was a misread bus time. A reply so slow that it fits both with and
//! without the step decides nothing.

use shared::time::MonoNs;

/// Readings needed for a decision.
const READINGS_MIN: u32 = 3;
/// After this number of readings without a decision the first one counts as misread.
const UNDECIDED_MAX: u32 = 100;
/// Contradictions after which the clock is unusable and counts as stepped.
const ERRATIC_MAX: u32 = 10;
/// Difference of two readings of the same deviation, in addition to their delays \[ns\].
const NOISE_NS: f64 = 1_000.0;
/// A reading decides something if its deviation is this many times what delays may have contributed.
const SIGNAL_TO_NOISE: f64 = 6.0;
/// A deviation grows if it has grown by this part of the first one ...
const GROWTH: f64 = 1.0 / 3.0;
/// ... or by this much, whichever is less; beyond [`JUMP_NS`] only the part counts \[ns\].
const GROWTH_NS: f64 = 10_000.0;
/// No changed rate causes a larger deviation within one reading \[ns\].
const JUMP_NS: f64 = 1_000_000.0;
/// Rate change by `adjtime` and NTP \[ns/s\]: a decision waits until it would show ...
const RATE_USUAL: f64 = 500e3;
/// ... but not longer than this \[s\].
const WAIT_S_MAX: f64 = 0.25;
/// Largest rate change by chrony \[ns/s\].
const RATE_MAX: f64 = 100e6;

/// Deviation of a reading from the prediction, with the possible causes of the difference.
#[derive(Debug, Clone, Copy)]
pub(super) struct Innovation {
    pub at: MonoNs,
    /// Deviation on the bus' clock from the prediction \[ns\].
    pub by_ns: f64,
    /// Part that the reading's own delay explains \[ns\] ...
    pub delayed_ns: f64,
    /// ... and part that the prediction's uncertainty explains \[ns\].
    pub predicted_ns: f64,
}

impl Innovation {
    pub fn is_explained(&self) -> bool {
        self.by_ns.abs() <= self.delayed_ns + self.predicted_ns
    }
}

/// State of the gate since the first unexplained reading.
#[derive(Debug, Clone)]
pub(super) struct InnovationGate {
    first: Innovation,
    /// Number of unexplained readings that agree with the first.
    agreeing: u32,
    /// Number of readings that decided nothing.
    undecided: u32,
    /// Number of readings that agreed neither with the fit nor with the first one.
    erratic: u32,
    /// Largest unexplained deviation \[ns\].
    largest_ns: f64,
}

/// Classification after a further reading.
pub(super) enum Class {
    /// The deviations are explained.
    Accepted,
    /// Further readings are needed.
    Undecided(InnovationGate),
    /// One of the clocks stepped.
    Stepped,
    /// One of the clocks changed its rate, by about this much \[ns/s\].
    RateChanged(f64),
}

impl InnovationGate {
    pub fn begin(first: Innovation) -> Self {
        Self { first, agreeing: 1, undecided: 0, erratic: 0, largest_ns: first.by_ns.abs() }
    }

    /// Largest possible error of the fit \[ns\].
    pub fn largest_ns(&self) -> f64 {
        self.largest_ns
    }

    /// Takes a further reading into account.
    pub fn classify(mut self, reading: Innovation) -> Class {
        let noise_ns = reading.delayed_ns + self.first.delayed_ns + NOISE_NS;
        let grown_ns = reading.by_ns - self.first.by_ns;
        // The deviation has disappeared: the first reading was misread.
        if reading.is_explained() && grown_ns.abs() > noise_ns {
            return Class::Accepted;
        }
        let signal_ns = reading.by_ns.abs().max(self.first.by_ns.abs());
        // The reading fits with and without the step.
        if reading.is_explained() || noise_ns > signal_ns / SIGNAL_TO_NOISE {
            self.undecided += 1;
            if !reading.is_explained() && reading.delayed_ns < self.first.delayed_ns {
                (self.first, self.agreeing) = (reading, 1);
            }
            return if self.undecided > UNDECIDED_MAX { Class::Accepted } else { Class::Undecided(self) };
        }
        self.largest_ns = self.largest_ns.max(reading.by_ns.abs());
        if reading.by_ns * self.first.by_ns < 0.0 {
            return self.contradicted(reading);
        }
        self.agreeing += 1;
        let lasted_s = reading.at.seconds_since(self.first.at);
        if self.agreeing < READINGS_MIN || lasted_s < self.wait_s(noise_ns) {
            return Class::Undecided(self);
        }
        if grown_ns.abs() <= noise_ns + self.growth_ns() {
            return Class::Stepped;
        }
        let rate = grown_ns / lasted_s.max(1e-9);
        if rate * self.first.by_ns > 0.0 && rate.abs() <= RATE_MAX {
            return Class::RateChanged(rate);
        }
        self.contradicted(reading)
    }

    /// Growth of a deviation that still counts as constant \[ns\].
    fn growth_ns(&self) -> f64 {
        let part_ns = GROWTH * self.first.by_ns.abs();
        if self.first.by_ns.abs() > JUMP_NS { part_ns } else { part_ns.min(GROWTH_NS) }
    }

    /// Time after which a usual rate change exceeds the noise \[s\].
    fn wait_s(&self, noise_ns: f64) -> f64 {
        if self.first.by_ns.abs() > JUMP_NS {
            return 0.0;
        }
        ((noise_ns + self.growth_ns()) / RATE_USUAL).min(WAIT_S_MAX)
    }

    /// For a reading that agrees neither with the fit nor with the first unexplained one: starts again with it.
    fn contradicted(self, reading: Innovation) -> Class {
        let erratic = self.erratic + 1;
        if erratic >= ERRATIC_MAX {
            return Class::Stepped;
        }
        let largest_ns = self.largest_ns.max(reading.by_ns.abs());
        Class::Undecided(Self { erratic, largest_ns, ..Self::begin(reading) })
    }
}
