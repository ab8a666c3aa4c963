//! Converts time on the clock of the bus to time on the host's clock. The input is one pair of times per cycle, to which a
//! filter fits offset and drift between the two clocks.
//!
//! The pair of a cycle comes from its frame. The reply contains the bus time at which the start of the frame passed the
//! reference clock. On the host's clock, this moment is later than the sending of the frame. It is also at least one frame
//! duration earlier than the end of the reply. These two limits are the *hard bound* of a reading, and their centre is the
//! *reading*. A Kalman filter with two states estimates offset and drift between the clocks. A reply that took longer than
//! the quickest one has a wider bound, and therefore less weight.
//!
//! If a reading deviates from the prediction, either the frame was delayed or one of the clocks has changed. A delay is
//! visible in the round trip. If no delay explains the deviation, the innovation gate (`innovation_gate`) withholds the
//! reading from the filter until further readings classify the deviation. If a clock has stepped, the step is reported. The
//! fit does not follow it, because the terminals' clocks did not step. If a rate has changed, the filter follows the change.

mod covariance;
mod filter;
mod innovation_gate;

use shared::time::{DcNs, MonoNs};

use filter::Filter;
use innovation_gate::{Class, InnovationGate};

/// A bus time that was read by a frame, with the host times at which that frame was sent and received.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClockPair {
    /// Bus time at which the start of the frame passed the reference clock.
    pub dc: DcNs,
    /// When the frame was passed to the network interface.
    pub sent: MonoNs,
    /// When the reply was received completely.
    pub received: MonoNs,
    /// Duration of the frame on the wire, from its first to its last bit \[ns\].
    pub frame_ns: i64,
}

/// How the fit used a pair.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PairStatus {
    /// The pair agrees with the fit, or shows a changed rate. The fit was updated with it.
    Followed,
    /// No delay explains the pair. The value is its deviation, on the clock of the bus \[ns\]. The fit does not use the
    /// pair; further pairs will classify the deviation.
    Gated(i64),
    /// One of the clocks stepped. Relative to the fit, the clock of the bus is now ahead by this value \[ns\]. The fit is
    /// unchanged; [`ClockFit::restarted`] starts a new one.
    Stepped(i64),
}

/// Estimates `bus time - monotonic time`.
#[derive(Debug, Clone, Default)]
pub struct ClockFit {
    /// `None` until the first pair.
    filter: Option<Filter>,
    /// State of the innovation gate. `None` while no pair is unexplained.
    gate: Option<InnovationGate>,
    /// Estimate of the fit before a restart. The clocks and the path are the same, so it is the prior for the first pair.
    known: Option<Filter>,
}

/// The offset between the clocks according to one pair, with its hard bound.
#[derive(Debug, Clone, Copy)]
struct Reading {
    at: MonoNs,
    offset_ns: i64,
    /// Half the width of the hard bound, which is the largest error of `offset_ns` \[ns\].
    half_ns: f64,
}

impl Reading {
    fn from_pair(pair: ClockPair) -> Self {
        let width_ns = pair.received.ns_since(pair.sent).saturating_sub(pair.frame_ns).max(0);
        let at = pair.sent.plus_ns(width_ns / 2);
        Self { at, offset_ns: pair.dc.0.wrapping_sub(at.0), half_ns: width_ns as f64 / 2.0 }
    }
}

impl ClockFit {
    /// Updates the fit with one pair.
    pub fn observe(&mut self, pair: ClockPair) -> PairStatus {
        let reading = Reading::from_pair(pair);
        let Some(filter) = &mut self.filter else {
            self.filter = Some(Filter::first(&reading, self.known.as_ref()));
            return PairStatus::Followed;
        };
        // Predict the offset at the time of the reading and classify the deviation. Then either correct the filter, or
        // withhold the reading from it.
        let dt_s = filter.predict(reading.at);
        let innovation = filter.innovation(&reading);
        let deviation_ns = innovation.by_ns;
        let class = match self.gate.take() {
            Some(gate) => gate.classify(innovation),
            None if innovation.is_explained() => Class::Accepted,
            None if filter.follows_trend(&innovation) => Class::RateChanged(deviation_ns / dt_s.max(1e-9)),
            None => Class::Undecided(InnovationGate::begin(innovation)),
        };
        match class {
            Class::Accepted => filter.correct(&reading, dt_s),
            Class::RateChanged(rate) => {
                filter.inflate(deviation_ns, rate);
                filter.correct(&reading, dt_s);
            }
            Class::Undecided(gate) => {
                self.gate = Some(gate);
                return PairStatus::Gated(deviation_ns.round() as i64);
            }
            Class::Stepped => {
                // Until the fit is restarted, its error is the step. The gate adds the step to the uncertainty of the fit.
                self.gate = Some(InnovationGate::begin(innovation));
                return PairStatus::Stepped(deviation_ns.round() as i64);
            }
        }
        PairStatus::Followed
    }

    /// A new fit without readings. It keeps the estimated rates of the clocks and the delays of the path.
    pub fn restarted(&self) -> Self {
        let known = self.filter.as_ref().or(self.known.as_ref()).cloned();
        Self { filter: None, gate: None, known }
    }

    /// Converts bus time `dc` to host time. Before the first pair, both clocks are assumed to be equal.
    pub fn monotonic_from_dc(&self, dc: DcNs) -> MonoNs {
        self.filter.as_ref().map_or(MonoNs(dc.0), |filter| filter.monotonic_from_dc(dc))
    }

    /// Standard deviation of the host time at bus time `dc` \[ns\]. It includes the uncertainty of the filter, a possible
    /// asymmetry of the delay, and the largest deviation that is still unexplained.
    pub fn uncertainty_ns(&self, dc: DcNs) -> u32 {
        let Some(filter) = &self.filter else { return u32::MAX };
        let gated_ns = self.gate.as_ref().map_or(0.0, InnovationGate::largest_ns);
        let variance = filter.variance_ns2(dc) + gated_ns * gated_ns;
        variance.sqrt().ceil().min(f64::from(u32::MAX)) as u32
    }
}

#[cfg(test)]
mod tests;
