//! From the bus' clock to the host's: a filtered fit of pairs read once per cycle.
//!
//! Each reply tells the bus time at which the start of the frame passed the reference clock. That was not before
//! the frame was sent, and not later than one frame time before the reply was complete: a hard bound, whose middle
//! is the reading. Offset and drift are followed by a Kalman filter of two states; a reply that took longer than
//! the quickest counts less, because its middle says less.
//!
//! A deviation is either a delay, which shows in the round trip, or a clock that does not run as it did. What no delay
//! explains is left out of the filter until readings agree on what it is (`doubt`): a step, which is told and not
//! followed (the terminals' clocks have not taken part in it), or another rate, which is followed.

mod covariance;
mod doubt;
mod filter;

use shared::time::{DcNs, MonoNs};

use doubt::{Doubt, Verdict};
use filter::Filter;

/// Bus time read by a frame, and when that frame was sent and received.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClockPair {
    /// Bus time at which the start of the frame passed the reference clock.
    pub dc: DcNs,
    /// Frame handed to the wire.
    pub sent: MonoNs,
    /// Reply received, whole.
    pub received: MonoNs,
    /// From the first to the last bit of the frame on the wire \[ns\].
    pub frame_ns: i64,
}

/// What a pair did to the fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Observation {
    /// It agrees with those before.
    Followed,
    /// No delay explains it: it is later on the bus' clock than it should be by this much \[ns\]. Left out of the fit
    /// until others say what it means.
    Doubted(i64),
    /// One of the clocks was stepped: the bus' is later than it should be by this much \[ns\]. The fit stays as it was;
    /// [`ClockFit::restarted`] begins anew.
    Stepped(i64),
}

/// Follows `bus time - monotonic time`.
#[derive(Debug, Clone, Default)]
pub struct ClockFit {
    filter: Option<Filter>,
    doubt: Option<Doubt>,
    /// What is known of both clocks and of the way between them before the first reading.
    known: Option<Filter>,
}

/// The offset that one pair tells.
#[derive(Debug, Clone, Copy)]
struct Reading {
    at: MonoNs,
    offset_ns: i64,
    /// The offset is within this of `offset_ns` \[ns\].
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
    pub fn observe(&mut self, pair: ClockPair) -> Observation {
        let reading = Reading::of(pair);
        let Some(filter) = &mut self.filter else {
            self.filter = Some(Filter::first(&reading, self.known.as_ref()));
            return Observation::Followed;
        };
        let dt_s = filter.predict(reading.at);
        let deviation = filter.deviation(&reading);
        let deviation_ns = deviation.by_ns;
        let verdict = match self.doubt.take() {
            Some(doubt) => doubt.judge(deviation),
            None if deviation.is_explained() => Verdict::Unfounded,
            None if filter.crept_to(&deviation) => Verdict::OtherRate(deviation_ns / dt_s.max(1e-9)),
            None => Verdict::Unsure(Doubt::begin(deviation)),
        };
        match verdict {
            Verdict::Unfounded => filter.correct(&reading, dt_s),
            Verdict::OtherRate(rate) => {
                filter.open(deviation_ns, rate);
                filter.correct(&reading, dt_s);
            }
            Verdict::Unsure(doubt) => {
                self.doubt = Some(doubt);
                return Observation::Doubted(deviation_ns.round() as i64);
            }
            Verdict::Stepped => {
                // The fit is wrong by the step until it begins anew, and says so.
                self.doubt = Some(Doubt::begin(deviation));
                return Observation::Stepped(deviation_ns.round() as i64);
            }
        }
        Observation::Followed
    }

    /// A fit without readings that knows what this one has learned of the clocks' rates and of the way between them.
    pub fn restarted(&self) -> Self {
        let known = self.filter.as_ref().or(self.known.as_ref()).cloned();
        Self { filter: None, doubt: None, known }
    }

    /// When the bus shows `dc`, the host shows this. Before the first pair both are taken as equal.
    pub fn monotonic_from_dc(&self, dc: DcNs) -> MonoNs {
        self.filter.as_ref().map_or(MonoNs(dc.0), |filter| filter.monotonic_from_dc(dc))
    }

    /// One standard deviation of the host time that stands for `dc` \[ns\]: the filter's own at that time, what an
    /// unequal way there and back can hide, and what is in doubt.
    pub fn uncertainty_ns(&self, dc: DcNs) -> u32 {
        let Some(filter) = &self.filter else { return u32::MAX };
        let doubted_ns = self.doubt.as_ref().map_or(0.0, Doubt::largest_ns);
        let variance = filter.variance_ns2(dc) + doubted_ns * doubted_ns;
        variance.sqrt().ceil().min(f64::from(u32::MAX)) as u32
    }
}

#[cfg(test)]
mod tests;
