//! Distance of the robot's end from the sphere of a rigid bar, and the fraction of this distance that a force
//! explains (TFRT-6017 section 5.3).
//!
//! If encoders measure the bar's direction, the deviation is the gap between robot and bar along the rod. It
//! then takes into account that the axes of a real bar miss each other by some hundredths of a millimetre, so
//! that the robot does not move on an exact sphere.

use nalgebra::Vector3;

use super::RunEvidence;
use crate::calibrate::Calibration;
use crate::calibrate::pipeline::Solved;
use crate::cost::Closure;
use crate::model::{Model, ParameterId};
use crate::prepare::{BarForces, Prepared};
use crate::statistics::{Sizes, rms};

/// Deviation of one sample from the sphere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OffSphere {
    /// Time on the bar's clock, since the reference time \[s\].
    pub t_s: f64,
    /// Unit vector from the centre of the gimbal to the robot's end, in the robot's base.
    pub direction: Vector3<f64>,
    /// Radial distance of the robot's end from the end of a bar without force, positive outwards \[m\].
    pub off_m: f64,
    /// `off_m` minus the elongation by the force \[m\].
    pub unexplained_m: f64,
    /// Axial force on the bar \[N\], with the sign that it has in the log. Only this sign if `bplay` was estimated.
    pub force: f64,
}

/// Deviation from the sphere for one robot model.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ModelDeviation {
    /// Samples in order of time.
    pub samples: Vec<OffSphere>,
    /// Statistics of the absolute values of [`OffSphere::off_m`] \[m\].
    pub size_m: Sizes,
    /// Root mean square of [`OffSphere::unexplained_m`] \[m\].
    pub unexplained_rms_m: f64,
}

impl ModelDeviation {
    fn from_closures(closures: &[Closure], of_signs: bool, by_encoders: bool) -> Self {
        let radial_m = |closure: &Closure| {
            if by_encoders { closure.direction.dot(&closure.position_error_m) } else { closure.off_sphere_m }
        };
        // `off_m` refers to a bar without force, while the bar of a closure is elongated by the force.
        let sample = |closure: &Closure| OffSphere {
            t_s: closure.t_s,
            direction: closure.direction,
            off_m: radial_m(closure) + closure.by_force_m,
            unexplained_m: radial_m(closure),
            force: if of_signs { closure.force.side } else { closure.force.along_n },
        };
        let samples: Vec<OffSphere> = closures.iter().map(sample).collect();
        Self {
            size_m: Sizes::from_values(samples.iter().map(|sample| sample.off_m.abs())),
            unexplained_rms_m: rms(samples.iter().map(|sample| sample.unexplained_m)),
            samples,
        }
    }
}

/// Physical meaning of a positive force in the log.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PositiveForce {
    /// Tension: the bar is longer if the force is positive.
    Tension,
    /// Compression: the bar is shorter if the force is positive.
    Compression,
    /// The force has no significant effect on the bar's length.
    NotDetermined,
}

/// Estimated elongation of the bar by a force.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Elongation {
    /// Index of the run, from 0.
    pub run: usize,
    /// The force measurement of the run.
    pub measured: BarForces,
    /// The estimated parameter: usually `bcompliance`. It is `bplay` if only the sign of the force was measured or
    /// if `bplay` explains more.
    pub parameter: ParameterId,
    /// Value of the parameter, for the sign of the force in the log. For `bcompliance` it is the elongation per newton
    /// \[m/N\], for `bplay` the elongation under a positive force \[m\].
    pub value: f64,
    /// Standard deviation of `value`; `None` if the parameter was fixed.
    pub sigma: Option<f64>,
    /// Meaning of a positive force.
    pub positive: PositiveForce,
}

impl Elongation {
    /// Elongation of each run with a force measurement.
    pub fn all(calibration: &Calibration) -> Vec<Self> {
        let runs = calibration.bar_runs().enumerate();
        runs.filter_map(|(run, (prepared, model))| Self::of_run(calibration, run, prepared, model)).collect()
    }

    fn of_run(calibration: &Calibration, run: usize, prepared: &Prepared, model: &Model) -> Option<Self> {
        let Solved { columns, solution, .. } = &calibration.solved;
        let measured = prepared.force?;
        // A calibration frees `bplay` instead of `bcompliance` if `bplay` explains more.
        let candidates = [ParameterId::BarCompliance, ParameterId::BarPlay].into_iter();
        let mut estimated = candidates.filter(|id| model.column_of(*id).is_some());
        let parameter = estimated.next().unwrap_or_else(|| measured.parameter());
        let value = model.parameter(parameter)?.value;
        let column = model.column_of(parameter).and_then(|of_model| columns.of_run(run).get(of_model));
        let sigma = column.and_then(|column| solution.covariance.sigma(*column));
        let of_95 = solution.covariance.sigmas_from.sigmas_of_95();
        let is_significant = sigma.is_none_or(|sigma| value.abs() > of_95 * sigma) && value != 0.0;
        let positive = match is_significant {
            false => PositiveForce::NotDetermined,
            true if value > 0.0 => PositiveForce::Tension,
            true => PositiveForce::Compression,
        };
        Some(Self { run, measured, parameter, value, sigma, positive })
    }

    /// The result as one or two sentences.
    pub fn sentence(&self) -> String {
        let unit = self.parameter.unit();
        // Play is displayed in um, because it is some hundredths of a millimetre.
        let (factor, symbol) = if self.parameter == ParameterId::BarPlay {
            (1e6, "um")
        } else {
            (unit.display_factor(), unit.display_symbol())
        };
        let sigma =
            self.sigma.map_or_else(|| " (fixed)".into(), |sigma| format!(" +- {:.4}", sigma * factor));
        let what = match self.parameter {
            ParameterId::BarPlay => "half of the bar's play",
            _ => "compliance of the bar",
        };
        let value = format!("{what}: {:.4}{sigma} {symbol}", self.value.abs() * factor);
        match self.positive {
            PositiveForce::Tension => format!("{value}; the log's force is positive in tension"),
            PositiveForce::Compression => format!("{value}; the log's force is positive in compression"),
            PositiveForce::NotDetermined => format!(
                "{what}: {:.4}{sigma} {symbol}, which cannot be distinguished from zero: the force does not explain the bar's length",
                self.value * factor
            ),
        }
    }
}

/// Deviation of one run from the sphere, before and after calibration. If a force was measured, it also
/// contains the elongation of the bar by the force.
#[derive(Debug, Clone, PartialEq)]
pub struct SphereDeviation {
    /// Deviation with the nominal robot, and with the bar fitted to this robot.
    pub before: ModelDeviation,
    /// Deviation with the calibrated robot.
    pub after: ModelDeviation,
    /// Elongation of the bar by the force. `None` if no force was measured.
    pub elongation: Option<Elongation>,
}

impl SphereDeviation {
    /// Deviations of each run.
    pub fn all(calibration: &Calibration, runs: &[RunEvidence]) -> Vec<Self> {
        let by_encoders = calibration.measures_end();
        let of_run = |((run, evidence), (prepared, model)): ((usize, &RunEvidence), (&Prepared, &Model))| {
            let elongation = Elongation::of_run(calibration, run, prepared, model);
            let of_signs = elongation.is_some_and(|elongation| elongation.parameter == ParameterId::BarPlay);
            let [before, after] = [&evidence.before, &evidence.after]
                .map(|closures| ModelDeviation::from_closures(closures, of_signs, by_encoders));
            Self { before, after, elongation }
        };
        runs.iter().enumerate().zip(calibration.bar_runs()).map(of_run).collect()
    }
}
