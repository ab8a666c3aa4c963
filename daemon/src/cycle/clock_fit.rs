//! From the bus' clock to the host's: a filtered fit of pairs read once per cycle.
//!
//! Each reply contains the bus time at which the start of the frame passed the reference clock. That was not before
//! the frame was sent, and not later than one frame time before the reply was complete: a hard bound, whose centre
//! is the reading. A Kalman filter with two states estimates offset and drift; a reply that took longer than the
//! quickest has less weight, because its bound is wider.
//!
//! A deviation is either a delay, which shows in the round trip, or a clock that has changed. If no delay explains it,
//! the innovation gate (`innovation_gate`) keeps it from the filter until further readings classify it: a step, which is
//! reported and not followed (the terminals' clocks did not step), or a changed rate, which is followed.

mod covariance;
mod filter;
mod innovation_gate;

use shared::time::{DcNs, MonoNs};

use filter::Filter;
use innovation_gate::{Class, InnovationGate};

/// Bus time read by a frame, and when that frame was sent and received.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClockPair {
    /// Bus time at which the start of the frame passed the reference clock.
    pub dc: DcNs,
    /// When the frame was handed to the wire.
    pub sent: MonoNs,
    /// When the reply was received completely.
    pub received: MonoNs,
    /// From the first to the last bit of the frame on the wire \[ns\].
    pub frame_ns: i64,
}

/// Effect of a pair on the fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PairStatus {
    /// It agrees with those before.
    Followed,
    /// No delay explains it: it deviates by this much on the bus' clock \[ns\]. Excluded from the fit until further pairs
    /// classify it.
    Gated(i64),
    /// One of the clocks stepped; the bus' clock is ahead by this much \[ns\]. The fit is unchanged;
    /// [`ClockFit::restarted`] starts a new one.
    Stepped(i64),
}

/// Estimates `bus time - monotonic time`.
#[derive(Debug, Clone, Default)]
pub struct ClockFit {
    filter: Option<Filter>,
    gate: Option<InnovationGate>,
    /// Earlier estimate for the same clocks and path, before the first reading.
    known: Option<Filter>,
}

/// The offset according to one pair.
#[derive(Debug, Clone, Copy)]
struct Reading {
    at: MonoNs,
    offset_ns: i64,
    /// Bound of the error of `offset_ns` \[ns\].
    half_ns: f64,
}

impl Reading {
    fn of(pair: ClockPair) -> Self {
        let width_ns = pair.received.ns_since(pair.sent).saturating_sub(pair.frame_ns).max(0);
        let at = pair.sent.plus_ns(width_ns / 2);
        Self { at, offset_ns: pair.dc.0.wrapping_sub(at.0), half_ns: width_ns as f64 / 2.0 }
    }
}

impl ClockFit {
    /// Takes one pair into account.
    pub fn observe(&mut self, pair: ClockPair) -> PairStatus {
        let reading = Reading::of(pair);
        let Some(filter) = &mut self.filter else {
            self.filter = Some(Filter::first(&reading, self.known.as_ref()));
            return PairStatus::Followed;
        };
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
                // The fit is wrong by the step until it restarts, and its uncertainty covers that.
                self.gate = Some(InnovationGate::begin(innovation));
                return PairStatus::Stepped(deviation_ns.round() as i64);
            }
        }
        PairStatus::Followed
    }

    /// A fit without readings that keeps the estimated rates of the clocks and delays of the path.
    pub fn restarted(&self) -> Self {
        let known = self.filter.as_ref().or(self.known.as_ref()).cloned();
        Self { filter: None, gate: None, known }
    }

    /// Host time at bus time `dc`. Before the first pair both are assumed equal.
    pub fn monotonic_from_dc(&self, dc: DcNs) -> MonoNs {
        self.filter.as_ref().map_or(MonoNs(dc.0), |filter| filter.monotonic_from_dc(dc))
    }

    /// One standard deviation of the host time at `dc` \[ns\]: the filter's own, the possible asymmetry of the delay, and
    /// the largest unexplained deviation.
    pub fn uncertainty_ns(&self, dc: DcNs) -> u32 {
        let Some(filter) = &self.filter else { return u32::MAX };
        let gated_ns = self.gate.as_ref().map_or(0.0, InnovationGate::largest_ns);
        let variance = filter.variance_ns2(dc) + gated_ns * gated_ns;
        variance.sqrt().ceil().min(f64::from(u32::MAX)) as u32
    }
}

#[cfg(test)]
mod tests;
