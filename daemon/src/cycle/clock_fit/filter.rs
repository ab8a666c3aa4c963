//! Kalman filter of the clock fit, with the state offset and drift: `bus time = t + base + offset + drift * (t - at)` for host
//! time `t`. The inputs are readings of the offset, the results host times with their variance. A delay makes a reading less
//! accurate: the time beyond the quickest round trip so far, or all of its bound while that is unknown.

use shared::time::{DcNs, MonoNs};

use super::Reading;
use super::covariance::ClockCovariance;
use super::innovation_gate::Innovation;

/// Wander of the offset between two clocks \[ns^2/s\]: some 10 ns in a second.
const OFFSET_WANDER_NS2_PER_S: f64 = 100.0;
/// Wander of their drift \[(ns/s)^2/s\]: 1 ppm in a second, a quartz that NTP adjusts.
const DRIFT_WANDER: f64 = 1e6;
/// Drift without prior information \[ns/s\]: 200 ppm.
const DRIFT_SIGMA_START: f64 = 200e3;
/// Drift of the same two clocks after a restart \[ns/s\]: 1 ppm.
const DRIFT_SIGMA_KNOWN: f64 = 1e3;
/// Uncertainty of a reading with the quickest round trip \[ns\]; time stamps of host and bus are not more accurate.
const READING_SIGMA_NS: f64 = 500.0;
/// Before this number of readings the quickest round trip is unknown: the uncertainty of each reading is its own bound.
const START_READINGS: u32 = 64;
/// Relative increase of the quickest round trip per second, so that a changed path is noticed.
const QUICKEST_FORGOTTEN_PER_S: f64 = 0.01;
/// Up to this number of sigmas a deviation is attributed to the filter; the rest is scatter of the readings ...
const SCATTER_SIGMAS: f64 = 3.0;
/// ... which decays by this part each second ...
const SCATTER_FORGOTTEN_PER_S: f64 = 0.3;
/// ... and is limited to this: larger deviations go to the gate \[ns\].
const SCATTER_NS_MAX: f64 = 50_000.0;
/// A deviation is unexplained beyond this many of the filter's own sigmas, in addition to the delays ...
const SLACK_SIGMAS: f64 = 6.0;
/// ... and to the uncertainty of the quickest round trip \[ns\].
const SLACK_NS: f64 = 5_000.0;
/// Mean deviation, in sigmas and over about this number of readings, that means a changed rate.
const TREND_SIGMAS: f64 = 2.0;
const TREND_READINGS: f64 = 16.0;
/// Mean deviation before an unexplained one that classifies it as a changed rate, too.
const CREEP_SIGMAS: f64 = 0.5;
/// Readings with a larger tolerance cannot distinguish a trend from chance \[ns\].
const CREEP_SLACK_NS: f64 = 20_000.0;
/// A trend is detected about this number of readings after its beginning.
const TREND_ONSET_READINGS: f64 = 4.0;

#[derive(Debug, Clone)]
pub(super) struct Filter {
    /// Time to which offset and covariance refer.
    at: MonoNs,
    /// Whole part of the offset \[ns\]; keeps the filter's numbers small.
    base_ns: i64,
    /// Offset beyond `base_ns` \[ns\].
    offset_ns: f64,
    /// Rate of the bus' clock relative to the host's, minus one \[ns/s\].
    drift: f64,
    /// Covariance for the gains. It treats readings as quick as the quickest as equally accurate, so that they are followed.
    covariance: ClockCovariance,
    /// Conservative covariance under those gains, if each delay may divide between the directions in any way; a random run
    /// of delays then looks like a rate.
    conservative: ClockCovariance,
    /// Number of readings so far, up to [`START_READINGS`].
    readings: u32,
    /// Half the width of the narrowest hard bound, which increases slowly \[ns\].
    quickest_half_ns: f64,
    /// Half widths of the hard bounds, weighted like the readings: the error of the offset if all delay was in one direction
    /// \[ns\].
    asymmetry_ns: f64,
    /// Mean deviation of the last quick readings, in sigmas.
    trend: f64,
    /// Recent contradictions between readings beyond their delays \[ns\].
    scatter_ns: f64,
}

impl Filter {
    /// From one reading and an earlier estimate for the same clocks and path.
    pub fn first(reading: &Reading, known: Option<&Self>) -> Self {
        let offset_sigma_ns = reading.half_ns.hypot(READING_SIGMA_NS);
        let start = |known: Option<ClockCovariance>| {
            let drift_sigma =
                known.map_or(DRIFT_SIGMA_START, |known| DRIFT_SIGMA_KNOWN.hypot(known.drift.sqrt()));
            ClockCovariance::independent(offset_sigma_ns, drift_sigma)
        };
        Self {
            at: reading.at,
            base_ns: reading.offset_ns,
            offset_ns: 0.0,
            drift: known.map_or(0.0, |known| known.drift),
            covariance: start(known.map(|known| known.covariance)),
            conservative: start(known.map(|known| known.conservative)),
            readings: known.map_or(1, |known| known.readings),
            quickest_half_ns: known
                .map_or(reading.half_ns, |known| known.quickest_half_ns.min(reading.half_ns)),
            asymmetry_ns: reading.half_ns,
            trend: 0.0,
            scatter_ns: known.map_or(0.0, |known| known.scatter_ns),
        }
    }

    pub fn monotonic_from_dc(&self, dc: DcNs) -> MonoNs {
        self.at.plus_ns(self.since_ns(dc).round() as i64)
    }

    /// Variance of the host time at `dc`: for delays that divide randomly, and for a constant asymmetry of the delay.
    pub fn variance_ns2(&self, dc: DcNs) -> f64 {
        let dt_s = (self.since_ns(dc) * 1e-9).abs();
        let filter_variance = self.conservative.offset
            + dt_s * (2.0 * self.conservative.cross.abs() + dt_s * self.conservative.drift)
            + OFFSET_WANDER_NS2_PER_S * dt_s;
        // How the delay divides between the directions is unknown: uniform within the bounds.
        filter_variance + self.asymmetry_ns.powi(2) / 3.0 + READING_SIGMA_NS.powi(2)
    }

    /// `dc = monotonic + base + offset + drift * (monotonic - at)`, solved for `monotonic - at` \[ns\].
    fn since_ns(&self, dc: DcNs) -> f64 {
        let dc_since_ns = dc.0.wrapping_sub(self.base_ns).wrapping_sub(self.at.0) as f64 - self.offset_ns;
        dc_since_ns / (1.0 + self.drift * 1e-9)
    }

    /// Propagates the state to `at`; returns the time step \[s\].
    pub fn predict(&mut self, at: MonoNs) -> f64 {
        let dt_s = at.seconds_since(self.at).max(0.0);
        self.at = at;
        self.offset_ns += self.drift * dt_s;
        self.covariance.predict(dt_s, OFFSET_WANDER_NS2_PER_S, DRIFT_WANDER);
        self.conservative.predict(dt_s, OFFSET_WANDER_NS2_PER_S, DRIFT_WANDER);
        self.quickest_half_ns *= 1.0 + QUICKEST_FORGOTTEN_PER_S * dt_s;
        dt_s
    }

    /// Innovation of a reading: its deviation from the prediction.
    ///
    /// A delay beyond the quickest round trip moves the centre by at most half of it; the same holds for the readings in the
    /// filter. While the quickest round trip is unknown, all of it may be such a delay.
    pub fn innovation(&self, reading: &Reading) -> Innovation {
        let quickest_half_ns = if self.is_starting() { 0.0 } else { self.quickest_half_ns };
        let fit_delayed_ns = (self.asymmetry_ns - quickest_half_ns).abs();
        Innovation {
            at: reading.at,
            by_ns: self.deviation_ns(reading),
            delayed_ns: (reading.half_ns - quickest_half_ns).abs(),
            predicted_ns: fit_delayed_ns + SLACK_SIGMAS * self.covariance.offset.sqrt() + SLACK_NS,
        }
    }

    fn deviation_ns(&self, reading: &Reading) -> f64 {
        reading.offset_ns.wrapping_sub(self.base_ns) as f64 - self.offset_ns
    }

    fn is_starting(&self) -> bool {
        self.readings < START_READINGS
    }

    /// Update by a reading, after the state was propagated to its time by `dt_s`.
    pub fn correct(&mut self, reading: &Reading, dt_s: f64) {
        self.quickest_half_ns = self.quickest_half_ns.min(reading.half_ns);
        let excess_ns = reading.half_ns - self.quickest_half_ns;
        let possible_delay_ns = if self.is_starting() { reading.half_ns } else { excess_ns };
        self.readings = (self.readings + 1).min(START_READINGS);
        let deviation_ns = self.deviation_ns(reading);
        self.watch_scatter(deviation_ns.abs() - possible_delay_ns, dt_s);
        let delayed_sigma_ns = READING_SIGMA_NS + possible_delay_ns;
        let reading_sigma_ns = delayed_sigma_ns + self.scatter_ns;
        let variance = reading_sigma_ns * reading_sigma_ns;
        let innovation_variance = self.covariance.offset + variance;
        let gain_offset = self.covariance.offset / innovation_variance;
        let gain_drift = self.covariance.cross / innovation_variance;
        self.offset_ns += gain_offset * deviation_ns;
        self.drift += gain_drift * deviation_ns;
        self.covariance.correct(gain_offset, gain_drift, variance);
        // Uniform between the bounds, which are `half_ns` to either side.
        let uniform_variance = reading.half_ns.powi(2) / 3.0;
        self.conservative.correct(gain_offset, gain_drift, variance.max(uniform_variance));
        self.asymmetry_ns += gain_offset * (reading.half_ns - self.asymmetry_ns);
        self.stay_within(reading);
        self.watch_trend(deviation_ns, delayed_sigma_ns, dt_s);
    }

    /// Whether earlier readings deviated to the same side, which means a changed rate and not a step. Under load readings
    /// cannot show that.
    pub fn follows_trend(&self, innovation: &Innovation) -> bool {
        let slack_ns = innovation.delayed_ns + innovation.predicted_ns;
        let is_near = innovation.by_ns.abs() <= 2.0 * slack_ns && slack_ns <= CREEP_SLACK_NS;
        is_near && self.trend * innovation.by_ns.signum() > CREEP_SIGMAS
    }

    /// Quick replies that contradict each other show that the shortest delay varies.
    fn watch_scatter(&mut self, unexplained_ns: f64, dt_s: f64) {
        let scatter_ns = unexplained_ns - SCATTER_SIGMAS * self.covariance.offset.sqrt();
        let forgotten = 1.0 - SCATTER_FORGOTTEN_PER_S * dt_s.min(1.0);
        self.scatter_ns = (self.scatter_ns * forgotten).max(scatter_ns.min(SCATTER_NS_MAX));
    }

    /// Adds these to the standard deviations of offset and drift (in quadrature), and restarts the trend.
    pub fn inflate(&mut self, offset_ns: f64, rate: f64) {
        self.covariance.inflate(offset_ns, rate);
        self.conservative.inflate(offset_ns, rate);
        self.trend = 0.0;
    }

    /// The hard bound holds independently of the filter's weights.
    fn stay_within(&mut self, reading: &Reading) {
        let centre_ns = reading.offset_ns.wrapping_sub(self.base_ns) as f64;
        let half_ns = reading.half_ns + READING_SIGMA_NS;
        self.offset_ns = self.offset_ns.clamp(centre_ns - half_ns, centre_ns + half_ns);
    }

    /// Small deviations that keep their sign mean a changed rate: the covariance is increased to cover them. Only quick
    /// replies show this; a slow one deviates to one side anyway.
    fn watch_trend(&mut self, deviation_ns: f64, sigma_ns: f64, dt_s: f64) {
        let weight = (READING_SIGMA_NS / sigma_ns).powi(2) / TREND_READINGS;
        self.trend += weight * (deviation_ns / sigma_ns - self.trend);
        if self.trend.abs() > TREND_SIGMAS && dt_s > 0.0 {
            self.inflate(deviation_ns, deviation_ns / (TREND_ONSET_READINGS * dt_s));
        }
    }
}
