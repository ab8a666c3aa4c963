//! The innovation gate classifies readings that no delay explains. There are three causes: the bus time was misread, a clock
//! stepped, or a clock changed its rate.
//!
//! The filter does not use such readings. The gate compares the next readings with the first unexplained one. If
//! the deviation stays constant, a clock stepped. If the deviation grows, a rate has changed. If it disappears with
//! the next reading, the bus time was misread. A reply may be so slow that it fits both with and without the step;
//! such a reply is ignored.

use shared::time::MonoNs;

/// Number of agreeing readings that are needed for a decision.
const READINGS_MIN: u32 = 3;
/// After this number of readings without a decision, the bus time of the first reading is treated as misread.
const UNDECIDED_MAX: u32 = 100;
/// If this many readings contradict each other, the clock is unusable, and is treated as stepped.
const ERRATIC_MAX: u32 = 10;
/// Tolerance when two readings of the same deviation are compared, in addition to their delays \[ns\].
const NOISE_NS: f64 = 1_000.0;
/// A reading is used for the decision only if its deviation is at least this many times the possible contribution of delays.
const SIGNAL_TO_NOISE: f64 = 6.0;
/// A deviation counts as growing if it has grown by this fraction of the first deviation, or by [`GROWTH_NS`]. The smaller
/// of the two limits is used.
const GROWTH: f64 = 1.0 / 3.0;
/// A deviation that has grown by this amount counts as growing \[ns\]. If the first deviation is larger than [`JUMP_NS`],
/// only the fraction [`GROWTH`] is used.
const GROWTH_NS: f64 = 10_000.0;
/// Largest deviation that a changed rate can cause within one reading \[ns\].
const JUMP_NS: f64 = 1_000_000.0;
/// Usual rate change by `adjtime` and NTP \[ns/s\]. The decision waits until such a change would be visible.
const RATE_USUAL: f64 = 500e3;
/// Longest time for which the decision waits \[s\].
const WAIT_S_MAX: f64 = 0.25;
/// Largest rate change that chrony makes \[ns/s\].
const RATE_MAX: f64 = 100e6;

/// Deviation of a reading from the prediction, with the contributions that may explain it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Innovation {
    pub at: MonoNs,
    /// Deviation from the prediction, on the clock of the bus \[ns\].
    pub by_ns: f64,
    /// Largest contribution of the reading's own delay \[ns\].
    pub delayed_ns: f64,
    /// Largest contribution of the prediction's uncertainty \[ns\].
    pub predicted_ns: f64,
}

impl Innovation {
    pub fn is_explained(&self) -> bool {
        self.by_ns.abs() <= self.delayed_ns + self.predicted_ns
    }
}

/// State of the gate after an unexplained reading.
#[derive(Debug, Clone)]
pub(super) struct InnovationGate {
    /// The first unexplained reading, or a later one that replaced it because its delay is smaller.
    first: Innovation,
    /// Number of unexplained readings that agree with the first one, including the first one.
    agreeing: u32,
    /// Number of readings that could not be used for the decision.
    undecided: u32,
    /// Number of readings that agreed neither with the fit nor with the first reading.
    erratic: u32,
    /// Largest unexplained deviation \[ns\].
    largest_ns: f64,
}

/// Classification of the deviation after a further reading.
pub(super) enum Class {
    /// The deviation has been explained. The reading may be used.
    Accepted,
    /// More readings are needed.
    Undecided(InnovationGate),
    /// One of the clocks stepped.
    Stepped,
    /// One of the clocks changed its rate, approximately by this value \[ns/s\].
    RateChanged(f64),
}

impl InnovationGate {
    pub fn begin(first: Innovation) -> Self {
        Self { first, agreeing: 1, undecided: 0, erratic: 0, largest_ns: first.by_ns.abs() }
    }

    /// Largest error that the fit may have because of the deviation \[ns\].
    pub fn largest_ns(&self) -> f64 {
        self.largest_ns
    }

    /// Updates the gate with a further reading, and classifies the deviation.
    pub fn classify(mut self, reading: Innovation) -> Class {
        let noise_ns = reading.delayed_ns + self.first.delayed_ns + NOISE_NS;
        let grown_ns = reading.by_ns - self.first.by_ns;
        // The deviation has disappeared, so the bus time of the first reading was misread.
        if reading.is_explained() && grown_ns.abs() > noise_ns {
            return Class::Accepted;
        }
        let signal_ns = reading.by_ns.abs().max(self.first.by_ns.abs());
        // The reading fits both with and without a step, so it cannot be used for the decision.
        if reading.is_explained() || noise_ns > signal_ns / SIGNAL_TO_NOISE {
            self.undecided += 1;
            if !reading.is_explained() && reading.delayed_ns < self.first.delayed_ns {
                (self.first, self.agreeing) = (reading, 1);
            }
            return if self.undecided > UNDECIDED_MAX { Class::Accepted } else { Class::Undecided(self) };
        }
        // Here the reading is unexplained, and accurate enough for a decision.
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

    /// Largest growth at which a deviation still counts as constant \[ns\].
    fn growth_ns(&self) -> f64 {
        let part_ns = GROWTH * self.first.by_ns.abs();
        if self.first.by_ns.abs() > JUMP_NS { part_ns } else { part_ns.min(GROWTH_NS) }
    }

    /// Time after which a usual rate change would exceed the noise \[s\].
    fn wait_s(&self, noise_ns: f64) -> f64 {
        if self.first.by_ns.abs() > JUMP_NS {
            return 0.0;
        }
        ((noise_ns + self.growth_ns()) / RATE_USUAL).min(WAIT_S_MAX)
    }

    /// Handles a reading that agrees neither with the fit nor with the first unexplained reading. The gate starts again,
    /// with this reading as the first one.
    fn contradicted(self, reading: Innovation) -> Class {
        let erratic = self.erratic + 1;
        if erratic >= ERRATIC_MAX {
            return Class::Stepped;
        }
        let largest_ns = self.largest_ns.max(reading.by_ns.abs());
        Class::Undecided(Self { erratic, largest_ns, ..Self::begin(reading) })
    }
}
