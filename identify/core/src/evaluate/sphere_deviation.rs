//! How far the robot's end is from the sphere of a rigid bar, and what of it a force explains (TFRT-6017 section 5.3).
//!
//! Where the bar's encoders give its direction the deviation is the gap between robot and bar along the rod: a bar whose axes
//! miss each other by some hundredths of a millimetre leads the robot on no exact sphere about the gimbal.

use nalgebra::Vector3;

use super::figures::rms;
use super::{Quantiles, RunEvidence};
use crate::calibrate::Calibration;
use crate::calibrate::pipeline::Solved;
use crate::cost::Closure;
use crate::model::{Model, ParameterId};
use crate::prepare::{BarForces, Prepared};

/// One sample on the sphere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OffSphere {
    /// Bar clock, since the reference time \[s\].
    pub t_s: f64,
    /// From the centre to the robot's end, unit length, in the robot's base.
    pub direction: Vector3<f64>,
    /// Farther out than a bar without force would hold it \[m\].
    pub off_m: f64,
    /// The same minus what the force explains \[m\].
    pub unexplained_m: f64,
    /// Force along the bar as its log counts it \[N\], or its sign where only that is known.
    pub force: f64,
}

/// The deviation with one robot.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Deviation {
    /// In the order of time.
    pub samples: Vec<OffSphere>,
    /// Of [`OffSphere::off_m`] \[m\].
    pub rms_m: f64,
    /// Sizes of the same \[m\].
    pub size_m: Quantiles,
    /// Of [`OffSphere::unexplained_m`] \[m\].
    pub unexplained_rms_m: f64,
}

impl Deviation {
    fn of(closures: &[Closure], of_signs: bool, by_encoders: bool) -> Self {
        let out_m = |one: &Closure| {
            if by_encoders { one.direction.dot(&one.position_error_m) } else { one.off_sphere_m }
        };
        let sample = |one: &Closure| OffSphere {
            t_s: one.t_s,
            direction: one.direction,
            off_m: out_m(one) + one.by_force_m,
            unexplained_m: out_m(one),
            force: if of_signs { one.force.side } else { one.force.along_n },
        };
        let samples: Vec<OffSphere> = closures.iter().map(sample).collect();
        Self {
            rms_m: rms(samples.iter().map(|one| one.off_m)),
            size_m: Quantiles::of(samples.iter().map(|one| one.off_m.abs()).collect()),
            unexplained_rms_m: rms(samples.iter().map(|one| one.unexplained_m)),
            samples,
        }
    }
}

/// Which sign of the log's force pulls the bar.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PositiveForce {
    /// The bar is longer where the log is positive.
    Tension,
    /// It is shorter there.
    Compression,
    /// The bar's length does not follow the force by more than chance.
    NotDetermined,
}

/// What a force did to the bar.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Elongation {
    /// Number of the run, from 0.
    pub run: usize,
    /// As it was measured.
    pub measured: BarForces,
    /// `bcompliance`, or `bplay` where only the sign was measured or where that explains more.
    pub parameter: ParameterId,
    /// Its value: longer by this for a newton as the log counts, or on the positive side \[m/N or m\].
    pub value: f64,
    /// One standard deviation; none where a person fixed it.
    pub sigma: Option<f64>,
    /// What the sign means.
    pub positive: PositiveForce,
}

impl Elongation {
    /// Of the first run of a calibration that has a force; none without any.
    pub fn of(calibration: &Calibration) -> Option<Self> {
        Self::all(calibration).into_iter().next()
    }

    /// Of each run of a calibration that has a force.
    pub fn all(calibration: &Calibration) -> Vec<Self> {
        let runs = calibration.bar_runs().enumerate();
        runs.filter_map(|(run, (prepared, model))| Self::of_run(calibration, run, prepared, model)).collect()
    }

    fn of_run(calibration: &Calibration, run: usize, prepared: &Prepared, model: &Model) -> Option<Self> {
        let Solved { columns, solution, .. } = &calibration.solved;
        let measured = prepared.force?;
        // Play where it explains more than compliance, see the estimate.
        let free = [ParameterId::BarCompliance, ParameterId::BarPlay].into_iter();
        let mut free = free.filter(|id| model.column_of(*id).is_some());
        let parameter = free.next().unwrap_or_else(|| measured.parameter());
        let found = model.parameter(parameter)?;
        let column = model.column_of(parameter).and_then(|own| columns.of_run(run).get(own));
        let sigma = column.and_then(|column| solution.covariance.sigma(*column));
        let of_95 = solution.covariance.sigmas_from.sigmas_of_95();
        let told = sigma.is_none_or(|sigma| found.value.abs() > of_95 * sigma) && found.value != 0.0;
        let positive = match told {
            false => PositiveForce::NotDetermined,
            true if found.value > 0.0 => PositiveForce::Tension,
            true => PositiveForce::Compression,
        };
        Some(Self { run, measured, parameter, value: found.value, sigma, positive })
    }

    /// In a sentence or two.
    pub fn sentence(&self) -> String {
        let unit = self.parameter.unit();
        // Play is read in um here: it is some hundredths of a millimetre.
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

/// One run's deviation from the sphere before and after, and the force where there is one.
#[derive(Debug, Clone, PartialEq)]
pub struct SphereDeviation {
    /// With the nominal robot, the bar fitted to it.
    pub before: Deviation,
    /// With the calibrated one.
    pub after: Deviation,
    /// What a force did.
    pub elongation: Option<Elongation>,
}

impl SphereDeviation {
    /// Of each run.
    pub fn all(calibration: &Calibration, runs: &[RunEvidence]) -> Vec<Self> {
        let [first, second, ..] = calibration.measured();
        let of_run = |((run, seen), (prepared, model)): ((usize, &RunEvidence), (&Prepared, &Model))| {
            let elongation = Elongation::of_run(calibration, run, prepared, model);
            let of_signs = elongation.is_some_and(|elongation| elongation.parameter == ParameterId::BarPlay);
            let [before, after] = [&seen.before, &seen.after]
                .map(|closures| Deviation::of(closures, of_signs, first && second));
            Self { before, after, elongation }
        };
        runs.iter().enumerate().zip(calibration.bar_runs()).map(of_run).collect()
    }
}
