//! Kalman filter of the clock fit. Its state is offset and drift, in `bus time = t + base + offset + drift * (t - at)`,
//! where `t` is host time. The inputs are readings of the offset. The results are host times with their variance.
//!
//! For each reading, the state is first propagated to the time of the reading, then corrected. A reading that may be delayed
//! gets less weight. Its possible delay is half of the time by which its round trip exceeds the quickest round trip so far.
//! While the quickest round trip is unknown, the possible delay is half of the whole round trip. The duration of the frame
//! itself is not part of a round trip.

use shared::time::{DcNs, MonoNs};

use super::Reading;
use super::covariance::ClockCovariance;
use super::innovation_gate::Innovation;

/// Process noise of the offset \[ns^2/s\]: a random change of 10 ns in a second (standard deviation).
const OFFSET_WANDER_NS2_PER_S: f64 = 100.0;
/// Process noise of the drift \[(ns/s)^2/s\]: a random change of 1 ppm in a second, as for a quartz whose rate NTP adjusts.
const DRIFT_WANDER: f64 = 1e6;
/// Standard deviation of the drift without prior information \[ns/s\]: 200 ppm.
const DRIFT_SIGMA_START: f64 = 200e3;
/// Standard deviation of the change of drift between the same two clocks during a restart \[ns/s\]: 1 ppm.
const DRIFT_SIGMA_KNOWN: f64 = 1e3;
/// Standard deviation of a reading with the quickest round trip \[ns\]. Time stamps of host and bus are about this accurate.
const READING_SIGMA_NS: f64 = 500.0;
/// Until this many readings have arrived, the quickest round trip is unknown. Half of a reading's own round
/// trip then bounds its error.
const START_READINGS: u32 = 64;
/// Relative increase per second of the stored quickest round trip. Because of this increase, the filter notices when the
/// path has become slower.
const QUICKEST_FORGOTTEN_PER_S: f64 = 0.01;
/// The *scatter* measures how much quick readings contradict each other, and increases the uncertainty of readings. It is a
/// deviation minus its possible delay, and minus this number of standard deviations of the filter.
const SCATTER_SIGMAS: f64 = 3.0;
/// Fraction by which the scatter decays in each second.
const SCATTER_FORGOTTEN_PER_S: f64 = 0.3;
/// Largest scatter \[ns\]. Larger deviations are handled by the gate.
const SCATTER_NS_MAX: f64 = 50_000.0;
/// A deviation is unexplained if it exceeds the sum of the possible delays, of this number of standard deviations of the
/// filter, and of [`SLACK_NS`].
const SLACK_SIGMAS: f64 = 6.0;
/// Constant part of the tolerance for a deviation \[ns\]. It covers the uncertainty of the quickest round trip.
const SLACK_NS: f64 = 5_000.0;
/// If the mean deviation exceeds this number of standard deviations, the rate has changed. The mean
/// extends over about `TREND_READINGS` readings.
const TREND_SIGMAS: f64 = 2.0;
const TREND_READINGS: f64 = 16.0;
/// Limit of the mean deviation, in standard deviations. If the mean exceeds this limit and an unexplained deviation is to
/// the same side, the deviation is classified as a changed rate.
const CREEP_SIGMAS: f64 = 0.5;
/// Largest tolerance for this classification \[ns\]. If delays explain more than this, a trend
/// cannot be distinguished from chance.
const CREEP_SLACK_NS: f64 = 20_000.0;
/// A trend is detected about this number of readings after its beginning.
const TREND_ONSET_READINGS: f64 = 4.0;

/// State of the filter, with statistics of the readings.
#[derive(Debug, Clone)]
pub(super) struct Filter {
    /// Time to which offset and covariance refer.
    at: MonoNs,
    /// Integer part of the offset \[ns\]. It keeps the floating point numbers of the filter small.
    base_ns: i64,
    /// Rest of the offset, in addition to `base_ns` \[ns\].
    offset_ns: f64,
    /// Rate of the bus' clock relative to the host's clock, minus one \[ns/s\].
    drift: f64,
    /// Covariance from which the gains are computed. It treats all readings with the quickest round trip as equally
    /// accurate, so the filter follows them.
    covariance: ClockCovariance,
    /// Conservative covariance, with the same gains. It assumes that each delay may be in either direction, so that a random
    /// sequence of delays can look like a drift.
    conservative: ClockCovariance,
    /// Number of readings so far, counted up to [`START_READINGS`].
    readings: u32,
    /// Half the width of the narrowest hard bound so far \[ns\]. It grows slowly ([`QUICKEST_FORGOTTEN_PER_S`]).
    quickest_half_ns: f64,
    /// Mean half width of the hard bounds, weighted like the readings \[ns\]. If all delay was in one direction, this is the
    /// error of the offset.
    asymmetry_ns: f64,
    /// Mean deviation of the last quick readings, divided by their standard deviation.
    trend: f64,
    /// Recent deviation of readings that no delay explains \[ns\], see [`SCATTER_SIGMAS`].
    scatter_ns: f64,
}

impl Filter {
    /// A filter with its first reading. `known` is an earlier estimate for the same clocks and path, if there is one.
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

    /// Converts bus time `dc` to host time.
    pub fn monotonic_from_dc(&self, dc: DcNs) -> MonoNs {
        self.at.plus_ns(self.since_ns(dc).round() as i64)
    }

    /// Variance of the host time at `dc` \[ns^2\]. It includes delays in random directions, and a constant difference
    /// between the delays of the two directions.
    pub fn variance_ns2(&self, dc: DcNs) -> f64 {
        let dt_s = (self.since_ns(dc) * 1e-9).abs();
        let filter_variance = self.conservative.offset
            + dt_s * (2.0 * self.conservative.cross.abs() + dt_s * self.conservative.drift)
            + OFFSET_WANDER_NS2_PER_S * dt_s;
        // It is unknown how the delay is divided between the two directions. The error is therefore assumed to be uniformly
        // distributed within the bounds.
        filter_variance + self.asymmetry_ns.powi(2) / 3.0 + READING_SIGMA_NS.powi(2)
    }

    /// Solves `dc = monotonic + base + offset + drift * (monotonic - at)` for `monotonic - at` \[ns\].
    fn since_ns(&self, dc: DcNs) -> f64 {
        let dc_since_ns = dc.0.wrapping_sub(self.base_ns).wrapping_sub(self.at.0) as f64 - self.offset_ns;
        dc_since_ns / (1.0 + self.drift * 1e-9)
    }

    /// Propagates the state to the time `at`. Returns the time step \[s\].
    pub fn predict(&mut self, at: MonoNs) -> f64 {
        let dt_s = at.seconds_since(self.at).max(0.0);
        self.at = at;
        self.offset_ns += self.drift * dt_s;
        self.covariance.predict(dt_s, OFFSET_WANDER_NS2_PER_S, DRIFT_WANDER);
        self.conservative.predict(dt_s, OFFSET_WANDER_NS2_PER_S, DRIFT_WANDER);
        self.quickest_half_ns *= 1.0 + QUICKEST_FORGOTTEN_PER_S * dt_s;
        dt_s
    }

    /// Computes the innovation of a reading. The innovation is the deviation from the prediction, with the contributions
    /// that may explain it.
    ///
    /// Compared with the quickest round trip, a delay moves the centre of the bound by at most half of the delay. This is
    /// true for the new reading and for the readings already in the filter. While the quickest round trip is unknown, the
    /// whole round trip may be such a delay.
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

    /// Corrects the state by a reading. The state must have been propagated to the time of the reading. `dt_s` is the time
    /// step of this propagation.
    pub fn correct(&mut self, reading: &Reading, dt_s: f64) {
        // Compute the possible delay of the reading. The delay and the scatter determine the variance of the reading.
        self.quickest_half_ns = self.quickest_half_ns.min(reading.half_ns);
        let excess_ns = reading.half_ns - self.quickest_half_ns;
        let possible_delay_ns = if self.is_starting() { reading.half_ns } else { excess_ns };
        self.readings = (self.readings + 1).min(START_READINGS);
        let deviation_ns = self.deviation_ns(reading);
        self.watch_scatter(deviation_ns.abs() - possible_delay_ns, dt_s);
        let delayed_sigma_ns = READING_SIGMA_NS + possible_delay_ns;
        let reading_sigma_ns = delayed_sigma_ns + self.scatter_ns;
        let variance = reading_sigma_ns * reading_sigma_ns;
        // Compute the Kalman gains, and correct state and covariances.
        let innovation_variance = self.covariance.offset + variance;
        let gain_offset = self.covariance.offset / innovation_variance;
        let gain_drift = self.covariance.cross / innovation_variance;
        self.offset_ns += gain_offset * deviation_ns;
        self.drift += gain_drift * deviation_ns;
        self.covariance.correct(gain_offset, gain_drift, variance);
        // Variance of a uniform distribution between the bounds, which are `half_ns` to either side of the reading.
        let uniform_variance = reading.half_ns.powi(2) / 3.0;
        self.conservative.correct(gain_offset, gain_drift, variance.max(uniform_variance));
        self.asymmetry_ns += gain_offset * (reading.half_ns - self.asymmetry_ns);
        self.stay_within(reading);
        self.watch_trend(deviation_ns, delayed_sigma_ns, dt_s);
    }

    /// Whether earlier readings deviated to the same side. If so, a rate has changed, and no clock has stepped. When the
    /// machine is busy, the readings are too inaccurate to show this.
    pub fn follows_trend(&self, innovation: &Innovation) -> bool {
        let slack_ns = innovation.delayed_ns + innovation.predicted_ns;
        let is_near = innovation.by_ns.abs() <= 2.0 * slack_ns && slack_ns <= CREEP_SLACK_NS;
        is_near && self.trend * innovation.by_ns.signum() > CREEP_SIGMAS
    }

    /// Updates the scatter. If quick replies contradict each other, the shortest delay varies.
    fn watch_scatter(&mut self, unexplained_ns: f64, dt_s: f64) {
        let scatter_ns = unexplained_ns - SCATTER_SIGMAS * self.covariance.offset.sqrt();
        let forgotten = 1.0 - SCATTER_FORGOTTEN_PER_S * dt_s.min(1.0);
        self.scatter_ns = (self.scatter_ns * forgotten).max(scatter_ns.min(SCATTER_NS_MAX));
    }

    /// Adds these values in quadrature to the standard deviations of offset and drift, and resets the trend.
    pub fn inflate(&mut self, offset_ns: f64, rate: f64) {
        self.covariance.inflate(offset_ns, rate);
        self.conservative.inflate(offset_ns, rate);
        self.trend = 0.0;
    }

    /// Limits the offset to the hard bound of the reading. This bound is valid for any weights of the filter.
    fn stay_within(&mut self, reading: &Reading) {
        let centre_ns = reading.offset_ns.wrapping_sub(self.base_ns) as f64;
        let half_ns = reading.half_ns + READING_SIGMA_NS;
        self.offset_ns = self.offset_ns.clamp(centre_ns - half_ns, centre_ns + half_ns);
    }

    /// Updates the trend. If small deviations keep their sign, the rate has changed. The covariance is then
    /// increased to cover the deviations. Only quick replies are used, because delayed replies can deviate to one
    /// side although no rate has changed.
    fn watch_trend(&mut self, deviation_ns: f64, sigma_ns: f64, dt_s: f64) {
        let weight = (READING_SIGMA_NS / sigma_ns).powi(2) / TREND_READINGS;
        self.trend += weight * (deviation_ns / sigma_ns - self.trend);
        if self.trend.abs() > TREND_SIGMAS && dt_s > 0.0 {
            self.inflate(deviation_ns, deviation_ns / (TREND_ONSET_READINGS * dt_s));
        }
    }
}
