//! From the bus' clock to the host's: a filtered fit of pairs read once per cycle.
//!
//! Each reply tells the bus time at which the frame passed the reference clock, somewhere between sending and
//! receiving. The offset and its drift are followed by a Kalman filter of two states; a reply that took longer
//! than the quickest counts less, because its middle says less.

use shared::time::{DcNs, MonoNs};

/// Bus time read by a frame, and when that frame was sent and received.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClockPair {
    /// Bus time at which the frame passed the reference clock.
    pub dc: DcNs,
    /// Frame handed to the wire.
    pub sent: MonoNs,
    /// Reply received.
    pub received: MonoNs,
}

/// Wander of the offset between two clocks \[ns^2/s\]: some 10 ns in a second.
const OFFSET_WANDER_NS2_PER_S: f64 = 100.0;
/// Wander of their drift \[(ns/s)^2/s\]: 1 ppb in a second, a quartz in a room.
const DRIFT_WANDER: f64 = 1.0;
/// Drift before anything is known \[ns/s\]: 200 ppm.
const DRIFT_SIGMA_START: f64 = 200e3;
/// What a reading is worth when its round trip is the quickest \[ns\].
const READING_SIGMA_NS: f64 = 500.0;
/// The quickest round trip is forgotten by this part each second, so that a changed path is noticed.
const QUICKEST_FORGOTTEN_PER_S: f64 = 0.01;

/// Follows `bus time - monotonic time`.
#[derive(Debug, Clone, Default)]
pub struct ClockFit {
    state: Option<State>,
}

#[derive(Debug, Clone)]
struct State {
    /// Time to which offset and covariance refer.
    at: MonoNs,
    /// Whole part of the offset \[ns\]; keeps the filter's numbers small.
    base_ns: i64,
    /// Offset beyond `base_ns` \[ns\].
    offset_ns: f64,
    /// \[ns/s\]
    drift: f64,
    p_offset: f64,
    p_cross: f64,
    p_drift: f64,
    quickest_ns: f64,
}

impl ClockFit {
    /// Takes one pair into account.
    pub fn observe(&mut self, pair: ClockPair) {
        let round_trip_ns = pair.received.ns_since(pair.sent).max(0);
        let middle = pair.sent.plus_ns(round_trip_ns / 2);
        let measured_ns = pair.dc.0 - middle.0;
        match &mut self.state {
            Some(state) => state.update(middle, measured_ns, round_trip_ns as f64),
            None => self.state = Some(State::first(middle, measured_ns, round_trip_ns as f64)),
        }
    }

    /// When the bus shows `dc`, the host shows this. Before the first pair both are taken as equal.
    pub fn monotonic_from_dc(&self, dc: DcNs) -> MonoNs {
        let Some(state) = &self.state else { return MonoNs(dc.0) };
        // dc = monotonic + base + offset + drift * (monotonic - at), solved for monotonic - at.
        let dc_since_ns = (dc.0 - state.base_ns - state.at.0) as f64 - state.offset_ns;
        let since_ns = dc_since_ns / (1.0 + state.drift * 1e-9);
        state.at.plus_ns(since_ns.round() as i64)
    }

    /// One standard deviation of a mapped time \[ns\]: the filter's own, and half the quickest round trip as the
    /// bound of what an unequal way there and back can hide.
    pub fn uncertainty_ns(&self) -> u32 {
        let Some(state) = &self.state else { return u32::MAX };
        let asymmetry_ns = state.quickest_ns / 2.0 / 3f64.sqrt();
        (state.p_offset + asymmetry_ns * asymmetry_ns).sqrt().ceil().min(f64::from(u32::MAX)) as u32
    }
}

impl State {
    fn first(at: MonoNs, base_ns: i64, round_trip_ns: f64) -> Self {
        Self {
            at,
            base_ns,
            offset_ns: 0.0,
            drift: 0.0,
            p_offset: (round_trip_ns / 2.0).powi(2) + READING_SIGMA_NS.powi(2),
            p_cross: 0.0,
            p_drift: DRIFT_SIGMA_START.powi(2),
            quickest_ns: round_trip_ns,
        }
    }

    fn update(&mut self, at: MonoNs, measured_ns: i64, round_trip_ns: f64) {
        let dt_s = at.seconds_since(self.at).max(0.0);
        self.at = at;
        self.offset_ns += self.drift * dt_s;
        self.p_offset += dt_s * (2.0 * self.p_cross + dt_s * self.p_drift) + OFFSET_WANDER_NS2_PER_S * dt_s;
        self.p_cross += dt_s * self.p_drift;
        self.p_drift += DRIFT_WANDER * dt_s;

        self.quickest_ns = (self.quickest_ns * (1.0 + QUICKEST_FORGOTTEN_PER_S * dt_s)).min(round_trip_ns);
        let reading_sigma_ns = READING_SIGMA_NS + (round_trip_ns - self.quickest_ns) / 2.0;
        let innovation_ns = (measured_ns - self.base_ns) as f64 - self.offset_ns;
        let spread = self.p_offset + reading_sigma_ns * reading_sigma_ns;
        let (gain_offset, gain_drift) = (self.p_offset / spread, self.p_cross / spread);
        self.offset_ns += gain_offset * innovation_ns;
        self.drift += gain_drift * innovation_ns;
        self.p_drift -= gain_drift * self.p_cross;
        self.p_cross -= gain_offset * self.p_cross;
        self.p_offset -= gain_offset * self.p_offset;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Readings every 10 ms of a bus clock that runs `drift_ppm` fast, with a quickest round trip of 60 us and
    /// now and then a slow way back. Returns the largest error of the last half \[ns\].
    fn worst_error_ns(drift_ppm: f64, slow_every: usize) -> f64 {
        let mut fit = ClockFit::default();
        let offset_ns = 1_000_000_000_000i64;
        let mut worst: f64 = 0.0;
        for step in 0..2000usize {
            let sent = MonoNs(5_000_000_000 + step as i64 * 10_000_000);
            let passed = sent.plus_ns(30_000);
            let elapsed_ns = (passed.0 - 5_000_000_000) as f64;
            let dc = DcNs(passed.0 + offset_ns + (elapsed_ns * drift_ppm * 1e-6).round() as i64);
            let slow_ns = if step % slow_every == slow_every - 1 { 400_000 } else { 0 };
            fit.observe(ClockPair { dc, sent, received: sent.plus_ns(60_000 + slow_ns) });
            if step >= 1000 {
                worst = worst.max((fit.monotonic_from_dc(dc).ns_since(passed) as f64).abs());
            }
        }
        worst
    }

    #[test]
    fn a_drifting_clock_is_followed_to_well_below_a_microsecond() {
        for drift_ppm in [-80.0, 0.0, 25.0, 120.0] {
            let worst = worst_error_ns(drift_ppm, 2001);
            assert!(worst < 100.0, "{drift_ppm} ppm: {worst} ns");
        }
    }

    #[test]
    fn slow_replies_do_not_pull_the_fit() {
        let worst = worst_error_ns(25.0, 7);
        assert!(worst < 1_000.0, "{worst} ns");
    }

    #[test]
    fn the_uncertainty_covers_an_unequal_way_there_and_back() {
        let mut fit = ClockFit::default();
        assert_eq!(fit.uncertainty_ns(), u32::MAX);
        for step in 0..500 {
            let sent = MonoNs(step * 10_000_000);
            // The frame passes the clock right after it is sent: half the round trip is the error.
            fit.observe(ClockPair { dc: DcNs(sent.0), sent, received: sent.plus_ns(100_000) });
        }
        let error_ns = fit.monotonic_from_dc(DcNs(4_990_000_000)).ns_since(MonoNs(4_990_000_000)).abs();
        assert!(error_ns > 40_000 && f64::from(fit.uncertainty_ns()) * 2.0 > error_ns as f64, "{error_ns}");
    }
}
