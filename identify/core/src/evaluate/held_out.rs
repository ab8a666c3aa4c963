//! Compares robot and bar on segments of time that were held out of the fit, before and after calibration.
//! `calibrate::validation::held_out` provides the models that were fitted without each segment. The errors are the
//! differences of the two ends.

use super::nominal::bar_fitted;
use super::uncalibrated;
use crate::calibrate::Calibration;
use crate::calibrate::rows::PoseFigures;
use crate::calibrate::validation::held_out::Segment;
use crate::cost::{Closure, loop_closures};
use crate::instrument::PoseError;
use crate::kinematics::{BAR_JOINTS, LinkParameter};
use crate::model::{Geometry, Model, Observation, ParameterId};

/// Errors of one held-out segment.
#[derive(Debug, Clone, PartialEq)]
pub struct HeldOutSegment {
    /// Index of the run that contains the segment, from 0.
    pub run: usize,
    /// Errors in three stages. Each error comes with the time of its sample on the bar's clock, since the run's reference
    /// time \[s\]. The stages are:
    /// - nominal: the nominal robot, with the bar fitted to this robot on the other samples of the run;
    /// - predicted: the fit to all data except the segment;
    /// - fitted: the fit to all data, including the segment.
    ///
    /// If the cost does not estimate the offsets of all encoders, the bar is also fitted again in the
    /// stages predicted and fitted.
    pub stages: [Vec<(f64, PoseError)>; 3],
}

impl HeldOutSegment {
    /// Times of the first and last sample on the bar's clock, since the run's reference time \[s\].
    pub fn span_s(&self) -> [f64; 2] {
        let [.., fitted] = &self.stages;
        [fitted.first(), fitted.last()].map(|sample| sample.map_or(0.0, |(t_s, _)| *t_s))
    }

    /// Root mean square error of each stage: nominal, predicted, fitted.
    pub fn rms(&self) -> [PoseError; 3] {
        rms(std::slice::from_ref(self))
    }
}

/// All held-out segments of all runs.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct HeldOut {
    /// Segments in the order of runs and time. Segments that the other data could not predict are omitted.
    pub segments: Vec<HeldOutSegment>,
    /// Number of segments that were omitted because the other data do not determine all parameters.
    pub undetermined: usize,
}

impl HeldOut {
    /// Root mean square error of each stage over all segments: nominal, predicted, fitted.
    pub fn rms(&self) -> [PoseError; 3] {
        rms(&self.segments)
    }
}

fn rms(segments: &[HeldOutSegment]) -> [PoseError; 3] {
    let errors = |stage: usize| segments.iter().flat_map(move |segment| &segment.stages[stage]);
    [0, 1, 2].map(|stage| PoseFigures::from_errors(errors(stage).map(|(_, error)| *error)).rms())
}

/// For each segment, the nominal robot with the bar fitted to this robot on the other samples of the run. `None` if
/// the other data do not determine all parameters.
pub fn nominals(calibration: &Calibration, segments: &[Segment]) -> Vec<Option<Geometry>> {
    let runs: Vec<_> = calibration.bar_runs().collect();
    let nominal = |segment: &Segment| {
        let (prepared, _) = runs.get(segment.run)?;
        Some(uncalibrated(segment.model.as_ref()?, &prepared.motion, &segment.others))
    };
    segments.iter().map(nominal).collect()
}

/// Errors of each segment in all three stages. The argument `nominals` is the result of the function [`nominals`].
pub fn held_out(calibration: &Calibration, segments: &[Segment], nominals: &[Option<Geometry>]) -> HeldOut {
    let Some(cost) = calibration.cost() else { return HeldOut::default() };
    let measured = calibration.measured();
    let robot = calibration.model().robot();
    let is_estimated =
        |link| cost.identifies(&measured, ParameterId::Bar { link, parameter: LinkParameter::Theta }, robot);
    // A cost that does not use all encoders does not estimate their offsets. The bar is then fitted to each robot, so the
    // comparison shows differences between the robots only.
    let all_estimated = measured.iter().enumerate().all(|(link, measured)| !measured || is_estimated(link));
    let geometry = |model: &Model, motion: &_, observations: &[Observation]| {
        if all_estimated { model.geometry(&[]) } else { bar_fitted(model.clone(), motion, observations) }
    };
    let runs: Vec<_> = calibration.bar_runs().collect();
    let full_fit: Vec<Geometry> = runs
        .iter()
        .map(|(prepared, model)| geometry(model, &prepared.motion, &prepared.observations))
        .collect();
    // All measured encoders count, including those that the cost does not use.
    let by_encoders = calibration.measures_end();
    let pose_error = |closure: &Closure| PoseError {
        position_m: closure.gap_m(by_encoders),
        rotation_rad: (measured == [true; BAR_JOINTS]).then(|| closure.turned_rad.norm()),
    };
    let errors = |(segment, nominal): (&Segment, &Option<Geometry>)| {
        let (prepared, _) = runs.get(segment.run)?;
        let predicted = geometry(segment.model.as_ref()?, &prepared.motion, &segment.others);
        let stages = [nominal.as_ref()?, &predicted, full_fit.get(segment.run)?].map(|geometry| {
            let closures = loop_closures(geometry, &prepared.motion, &segment.seen_by_none);
            closures.iter().map(|closure| (closure.t_s, pose_error(closure))).collect()
        });
        Some(HeldOutSegment { run: segment.run, stages })
    };
    let predicted: Vec<HeldOutSegment> = segments.iter().zip(nominals).filter_map(errors).collect();
    HeldOut { undetermined: segments.len() - predicted.len(), segments: predicted }
}
