//! Robot against bar on held-out segments of time, before and after calibration. The models come from
//! `calibrate::validation::held_out`; the errors are the differences of the two ends.

use super::nominal::bar_fitted;
use super::uncalibrated;
use crate::calibrate::Calibration;
use crate::calibrate::validation::held_out::Segment;
use crate::cost::{Closure, loop_closures};
use crate::kinematics::LinkParameter;
use crate::model::{Geometry, Model, Observation, ParameterId};
use crate::statistics::rms;

/// Difference between robot and bar at one sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseError {
    /// Time on the bar's clock, since the run's reference time \[s\].
    pub t_s: f64,
    /// Distance of the two ends; without encoders the distance from the bar's sphere \[m\].
    pub position_m: f64,
    /// Rotation angle between the two ends \[rad\].
    pub rotation_rad: f64,
}

/// Root mean square errors over a number of samples.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PoseErrorRms {
    /// Root mean square of the position error \[m\].
    pub position_m: f64,
    /// Root mean square of the rotation angle \[rad\].
    pub rotation_rad: f64,
}

impl PoseErrorRms {
    fn of<'a>(samples: impl Iterator<Item = &'a PoseError> + Clone) -> Self {
        Self {
            position_m: rms(samples.clone().map(|error| error.position_m)),
            rotation_rad: rms(samples.map(|error| error.rotation_rad)),
        }
    }
}

/// Errors of one held-out segment.
#[derive(Debug, Clone, PartialEq)]
pub struct HeldOutSegment {
    /// Index of its run, from 0.
    pub run: usize,
    /// Errors of the nominal robot, with the bar fitted to it on the rest of the run.
    pub nominal: Vec<PoseError>,
    /// Errors of the fit to all other data. With a cost that needs fewer encoders, the bar is fitted as for the nominal
    /// robot.
    pub predicted: Vec<PoseError>,
    /// Errors of the full fit, which includes the segment.
    pub fitted: Vec<PoseError>,
}

impl HeldOutSegment {
    /// Times of the first and last sample on the bar's clock, since the run's reference time \[s\].
    pub fn span_s(&self) -> [f64; 2] {
        let time_s = |error: Option<&PoseError>| error.map_or(0.0, |error| error.t_s);
        [time_s(self.fitted.first()), time_s(self.fitted.last())]
    }

    /// Root mean square errors: nominal, predicted, fitted.
    pub fn rms(&self) -> [PoseErrorRms; 3] {
        [&self.nominal, &self.predicted, &self.fitted].map(|samples| PoseErrorRms::of(samples.iter()))
    }
}

/// All held-out segments of all runs.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct HeldOut {
    /// Segments in the order of runs and time, without those that the other data could not predict.
    pub segments: Vec<HeldOutSegment>,
    /// Number of segments whose remaining data do not determine the parameters.
    pub undetermined: usize,
}

impl HeldOut {
    /// Root mean square errors over all segments: nominal, predicted, fitted.
    pub fn rms(&self) -> [PoseErrorRms; 3] {
        let rms = |errors: fn(&HeldOutSegment) -> &Vec<PoseError>| {
            PoseErrorRms::of(self.segments.iter().flat_map(errors))
        };
        [rms(|segment| &segment.nominal), rms(|segment| &segment.predicted), rms(|segment| &segment.fitted)]
    }
}

/// The nominal robot of each segment, with the bar fitted to it on the rest of the run; `None` if the rest could not predict
/// it.
pub fn nominals(calibration: &Calibration, segments: &[Segment]) -> Vec<Option<Geometry>> {
    let runs: Vec<_> = calibration.bar_runs().collect();
    let nominal = |segment: &Segment| {
        let (prepared, _) = runs.get(segment.run)?;
        Some(uncalibrated(segment.model.as_ref()?, &prepared.motion, &segment.others))
    };
    segments.iter().map(nominal).collect()
}

/// Errors of each segment for the parameters estimated without it, and for the nominal robot.
pub fn held_out(calibration: &Calibration, segments: &[Segment], nominals: &[Option<Geometry>]) -> HeldOut {
    let Some(cost) = calibration.cost() else { return HeldOut::default() };
    let measured = calibration.measured();
    let by_encoders = measured.contains(&true);
    let robot = calibration.model().robot();
    let is_estimated =
        |link| cost.identifies(&measured, ParameterId::Bar { link, parameter: LinkParameter::Theta }, robot);
    // A cost that does not use all encoders does not estimate their offsets. Then compare robots, each with its bar fitted.
    let all_estimated = measured.iter().enumerate().all(|(link, measured)| !measured || is_estimated(link));
    let geometry = |model: &Model, motion: &_, observations: &[Observation]| {
        if all_estimated { model.geometry(&[]) } else { bar_fitted(model.clone(), motion, observations) }
    };
    let runs: Vec<_> = calibration.bar_runs().collect();
    let full_fit: Vec<Geometry> = runs
        .iter()
        .map(|(prepared, model)| geometry(model, &prepared.motion, &prepared.observations))
        .collect();
    let mut all = HeldOut::default();
    for (segment, nominal) in segments.iter().zip(nominals) {
        let (Some(model), Some(nominal)) = (&segment.model, nominal) else {
            all.undetermined += 1;
            continue;
        };
        let (Some((prepared, _)), Some(full_fit)) = (runs.get(segment.run), full_fit.get(segment.run)) else {
            continue;
        };
        let errors_with = |geometry: &Geometry| -> Vec<PoseError> {
            let closures = loop_closures(geometry, &prepared.motion, &segment.seen_by_none);
            closures.iter().map(|closure| pose_error(closure, by_encoders)).collect()
        };
        all.segments.push(HeldOutSegment {
            run: segment.run,
            nominal: errors_with(nominal),
            predicted: errors_with(&geometry(model, &prepared.motion, &segment.others)),
            fitted: errors_with(full_fit),
        });
    }
    all
}

fn pose_error(closure: &Closure, by_encoders: bool) -> PoseError {
    PoseError {
        t_s: closure.t_s,
        position_m: closure.gap_m(by_encoders),
        rotation_rad: closure.turned_rad.norm(),
    }
}
