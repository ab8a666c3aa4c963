//! Robot against bar on segments of time that no fit has seen, before and after calibration.

use super::nominal::bar_fitted;
use super::{rms, uncalibrated};
use crate::calibrate::Calibration;
use crate::calibrate::validation::held_out::Segment;
use crate::cost::{Closure, closures};
use crate::kinematics::LinkParameter;
use crate::model::{Geometry, Model, Observation, ParameterId};

/// Robot against bar at one sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseError {
    /// Bar clock, since the run's reference time \[s\].
    pub t_s: f64,
    /// Distance of the two ends; without encoders the distance from the bar's sphere \[m\].
    pub position_m: f64,
    /// Angle between them \[rad\].
    pub rotation_rad: f64,
}

/// Root mean squares over some samples.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PoseErrorRms {
    /// \[m\]
    pub position_m: f64,
    /// \[rad\]
    pub rotation_rad: f64,
}

impl PoseErrorRms {
    fn of<'a>(samples: impl Iterator<Item = &'a PoseError> + Clone) -> Self {
        Self {
            position_m: rms(samples.clone().map(|one| one.position_m)),
            rotation_rad: rms(samples.map(|one| one.rotation_rad)),
        }
    }
}

/// One segment.
#[derive(Debug, Clone, PartialEq)]
pub struct HeldOutSegment {
    /// Number of its run, from 0.
    pub run: usize,
    /// Nominal robot, the bar fitted to it on the rest of the run.
    pub nominal: Vec<PoseError>,
    /// Robot, bar and clocks as fitted to everything else; with a cost that leaves encoders out, the bar fitted as to the nominal
    /// robot.
    pub predicted: Vec<PoseError>,
    /// The whole fit, which has seen the segment.
    pub fitted: Vec<PoseError>,
}

impl HeldOutSegment {
    /// First and last sample, bar clock since the run's reference time \[s\].
    pub fn span_s(&self) -> [f64; 2] {
        let at = |one: Option<&PoseError>| one.map_or(0.0, |one| one.t_s);
        [at(self.fitted.first()), at(self.fitted.last())]
    }

    /// Root mean squares: nominal, predicted, fitted.
    pub fn rms(&self) -> [PoseErrorRms; 3] {
        [&self.nominal, &self.predicted, &self.fitted].map(|samples| PoseErrorRms::of(samples.iter()))
    }
}

/// All segments of all runs.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct HeldOut {
    /// In the order of runs and time, but those that the rest could not predict.
    pub segments: Vec<HeldOutSegment>,
    /// Segments without which the parameters are not determined.
    pub undetermined: usize,
}

impl HeldOut {
    /// Root mean squares over all segments: nominal, predicted, fitted.
    pub fn rms(&self) -> [PoseErrorRms; 3] {
        let all =
            |of: fn(&HeldOutSegment) -> &Vec<PoseError>| PoseErrorRms::of(self.segments.iter().flat_map(of));
        [all(|one| &one.nominal), all(|one| &one.predicted), all(|one| &one.fitted)]
    }
}

/// The nominal robot of each segment, the bar fitted to it on the rest of the run; none where the rest could not predict it.
pub fn nominals(calibration: &Calibration, segments: &[Segment]) -> Vec<Option<Geometry>> {
    let runs: Vec<_> = calibration.bar_runs().collect();
    let nominal = |segment: &Segment| {
        let (prepared, _) = runs.get(segment.run)?;
        Some(uncalibrated(segment.model.as_ref()?, &prepared.motion, &segment.others))
    };
    segments.iter().map(nominal).collect()
}

/// Looks at each segment with the parameters that were found without it, and with the nominal robot.
pub fn held_out(calibration: &Calibration, segments: &[Segment], nominals: &[Option<Geometry>]) -> HeldOut {
    let Some(cost) = calibration.cost() else { return HeldOut::default() };
    let measured = calibration.measured();
    let by_encoders = measured.contains(&true);
    let is_estimated =
        |link| cost.identifies(&measured, ParameterId::Bar { link, parameter: LinkParameter::Theta });
    // A cost without some of the encoders leaves their offsets as they were: robots are compared, each with its bar fitted.
    let all_estimated = measured.iter().enumerate().all(|(link, measured)| !measured || is_estimated(link));
    let geometry = |model: &Model, motion: &_, observations: &[Observation]| {
        if all_estimated { model.geometry(&[]) } else { bar_fitted(model.clone(), motion, observations) }
    };
    let runs: Vec<_> = calibration.bar_runs().collect();
    let whole: Vec<Geometry> = runs
        .iter()
        .map(|(prepared, model)| geometry(model, &prepared.motion, &prepared.observations))
        .collect();
    let mut all = HeldOut::default();
    for (segment, nominal) in segments.iter().zip(nominals) {
        let (Some(model), Some(nominal)) = (&segment.model, nominal) else {
            all.undetermined += 1;
            continue;
        };
        let (Some((prepared, _)), Some(whole)) = (runs.get(segment.run), whole.get(segment.run)) else {
            continue;
        };
        let at = |geometry: &Geometry| -> Vec<PoseError> {
            let seen = closures(geometry, &prepared.motion, &segment.seen_by_none);
            seen.iter().map(|closure| apart(closure, by_encoders)).collect()
        };
        all.segments.push(HeldOutSegment {
            run: segment.run,
            nominal: at(nominal),
            predicted: at(&geometry(model, &prepared.motion, &segment.others)),
            fitted: at(whole),
        });
    }
    all
}

fn apart(closure: &Closure, by_encoders: bool) -> PoseError {
    PoseError {
        t_s: closure.t_s,
        position_m: closure.gap_m(by_encoders),
        rotation_rad: closure.turned_rad.norm(),
    }
}
