//! Covariance `P` of offset and drift between two clocks, for the filter of the clock fit. In time it is propagated by `F P
//! F^T + Q` with `F = [1 dt; 0 1]`. A reading, which measures the offset (`H = [1 0]`), corrects it.

/// Covariance of offset \[ns\] and drift \[ns/s\].
#[derive(Debug, Clone, Copy)]
pub(super) struct ClockCovariance {
    /// Variance of the offset \[ns^2\].
    pub offset: f64,
    /// Covariance of offset and drift \[ns^2/s\].
    pub cross: f64,
    /// Variance of the drift \[(ns/s)^2\].
    pub drift: f64,
}

impl ClockCovariance {
    pub fn independent(offset_sigma_ns: f64, drift_sigma: f64) -> Self {
        Self { offset: offset_sigma_ns.powi(2), cross: 0.0, drift: drift_sigma.powi(2) }
    }

    /// Propagates the covariance by `dt_s`. The process noise `Q` is the growth of the variances of
    /// offset and drift per second.
    pub fn predict(&mut self, dt_s: f64, offset_wander: f64, drift_wander: f64) {
        self.offset += dt_s * (2.0 * self.cross + dt_s * self.drift) + offset_wander * dt_s;
        self.cross += dt_s * self.drift;
        self.drift += drift_wander * dt_s;
    }

    /// Corrects the covariance by a reading with the variance `r` (`reading_variance`). Joseph's form is used, which is
    /// valid even if the gains `K` of offset and drift are not optimal: `(I - K H) P (I - K H)^T + K r K^T`.
    pub fn correct(&mut self, gain_offset: f64, gain_drift: f64, reading_variance: f64) {
        let Self { offset, cross, drift } = *self;
        let kept = 1.0 - gain_offset;
        self.offset = kept * kept * offset + gain_offset * gain_offset * reading_variance;
        self.cross = kept * (cross - gain_drift * offset) + gain_offset * gain_drift * reading_variance;
        self.drift = drift - 2.0 * gain_drift * cross + gain_drift * gain_drift * (offset + reading_variance);
    }

    /// Adds these values in quadrature to the standard deviations of offset and drift.
    pub fn inflate(&mut self, offset_sigma_ns: f64, drift_sigma: f64) {
        self.offset += offset_sigma_ns.powi(2);
        self.drift += drift_sigma.powi(2);
    }
}
