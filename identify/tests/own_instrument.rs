//! An instrument that is defined only in this file calibrates a robot. It is a gauge that measures the height of a point of
//! the flange above a plate. It gets the same features as the instruments of the library: tables, residuals, page, limits,
//! held-out figures, deployments and change detection.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use identify::calibrate::{Calibration, DataSets, IdentifyConfig, calibrate};
use identify::cost::{CostError, DataSet, LoopProblem, Movement, Residual, Scene};
use identify::evaluate::evidence;
use identify::instrument::{
    Cause, Deviation, Instrument, Measures, Mistake, Noise, RejectedRow, RowError, ScaleFrom,
};
use identify::kinematics::{Chain, Joints, flange_chain};
use identify::logs::JointMistake;
use identify::model::{
    Axis, ClockRelation, Geometry, JointState, Model, ModelError, Observation, Owner, ParameterId,
    PerObservation, Role,
};
use identify::report::result::residuals::residuals_csv;
use identify::report::rows::table;
use nalgebra::Vector3;
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use rand_distr::StandardNormal;

use crate::support::irb120;

/// The data of the gauge: rows of joints with the height above the plate \[m\].
#[derive(Debug, Clone)]
struct Column {
    states: Vec<JointState>,
    heights_m: Vec<f64>,
    observations: Vec<Observation>,
    groups: Vec<usize>,
    noise_m: f64,
}

impl Column {
    fn new(rows: &[(Joints, f64)]) -> Self {
        let at = |row| Observation::bar(PerObservation::time_s(row), Default::default());
        Self {
            states: rows.iter().map(|(q, _)| JointState::at_rest(*q)).collect(),
            heights_m: rows.iter().map(|(_, height_m)| *height_m).collect(),
            observations: (0..rows.len()).map(at).collect(),
            groups: (0..rows.len()).collect(),
            noise_m: 1.0,
        }
    }

    fn rows(&self) -> Vec<(Joints, f64)> {
        self.states.iter().map(|state| state.q).zip(self.heights_m.iter().copied()).collect()
    }
}

/// The residual `z(p + R attachment) + offset - height` \[m\]. `attachment` and `offset` are the
/// parameters with the same meaning of a wire.
struct Height<'a>(&'a [f64]);

impl Residual for Height<'_> {
    type Local = (f64, Vector3<f64>);

    const NAME: &'static str = "height";
    const ROWS: usize = 1;
    const ENCODERS: &'static [usize] = &[];

    fn depends_on(id: ParameterId, _: &Chain) -> bool {
        id.affects(Owner::Wire) && !matches!(id, ParameterId::Anchor { .. })
    }

    fn local(&self, scene: &Scene<'_>) -> Option<Self::Local> {
        Some((*self.0.get(scene.sample)?, scene.robot.rotation() * scene.geometry.wire.attachments_m[0]))
    }

    fn residual(&self, scene: &Scene<'_>, (height_m, arm): &Self::Local, out: &mut [f64]) {
        out[0] = scene.robot.position_m().z + arm.z + scene.geometry.wire.offset_m - height_m;
    }

    fn derivative(&self, scene: &Scene<'_>, (_, arm): &Self::Local, id: ParameterId, out: &mut [f64]) {
        out[0] = match (id, scene.movement(id)) {
            (_, Movement::Robot(twist)) => (twist.linear + twist.angular.cross(arm)).z,
            (ParameterId::Attachment { axis, .. }, _) => scene.robot.rotation()[(2, axis.index())],
            (ParameterId::LengthOffset, _) => 1.0,
            _ => 0.0,
        };
    }
}

impl Measures for Column {
    fn name(&self) -> &'static str {
        "column"
    }

    fn cost(&self) -> &'static str {
        Height::NAME
    }

    fn scale(&self) -> ScaleFrom {
        ScaleFrom::Wire
    }

    fn noise(&self) -> Noise {
        Noise::Length(self.noise_m)
    }

    fn samples(&self) -> usize {
        self.states.len()
    }

    fn fitted_out(&self, robot: Model) -> Model {
        robot.with_set_ups(Owner::Wire, [1, 1]).without_clocks()
    }

    fn place(&self, model: &mut Model, fix: &[ParameterId]) -> Result<bool, ModelError> {
        let own = Axis::ALL.map(|axis| ParameterId::Attachment { target: 0, axis });
        let own = own.into_iter().chain([ParameterId::LengthOffset]).filter(|id| !fix.contains(id));
        model.set_roles(own, Role::Prior { value: 0.0, sigma: 1.0 })?;
        Ok(true)
    }

    fn data_set<'a>(&'a self, model: &'a Model, sigma: f64) -> Result<Box<dyn DataSet + 'a>, CostError> {
        let (motion, sigma) = (self, sigma * self.noise_m);
        Ok(Box::new(LoopProblem::new(model, motion, &self.observations, Height(&self.heights_m), sigma)?))
    }

    fn reported(&self, sample: usize, _: &ClockRelation) -> Option<JointState> {
        self.states.get(sample).copied()
    }

    fn identifies(&self, id: ParameterId, robot: &Chain) -> bool {
        Height::depends_on(id, robot) && id.owner() != Owner::Clocks
    }

    fn causes(&self, _: &Geometry) -> Vec<Cause> {
        vec![Cause::new("the zero of the column", [ParameterId::LengthOffset])]
    }

    fn adapt(&mut self, model: &Model) -> Option<f64> {
        let squared = self.errors(&model.geometry(&[])).into_iter().map(|error| error.position_m.powi(2));
        self.noise_m = (squared.sum::<f64>() / self.samples() as f64).sqrt().max(1e-9);
        Some(self.noise_m)
    }

    fn independent(&self, count: usize) -> Vec<Vec<usize>> {
        let fold =
            |number| (0..self.groups.len()).filter(|row| self.groups[*row] % count == number).collect();
        (0..count).map(fold).collect()
    }

    fn group(&mut self, groups: &[usize], _: u64) {
        self.groups = groups.to_vec();
    }

    fn part(&self, samples: &[usize]) -> Instrument {
        let rows = self.rows();
        let mut part = Self::new(&samples.iter().map(|&sample| rows[sample]).collect::<Vec<_>>());
        part.groups = samples.iter().map(|&sample| self.groups[sample]).collect();
        part.noise_m = self.noise_m;
        part.into()
    }

    fn deviations(&self, geometry: &Geometry) -> Vec<Deviation> {
        let one = |(state, height_m): (&JointState, &f64)| {
            let end = geometry.robot_end(state).transform_point(&geometry.wire.attachments_m[0].into());
            Deviation::of_length(end.z + geometry.wire.offset_m - height_m)
        };
        self.states.iter().zip(&self.heights_m).map(one).collect()
    }

    fn contradicting(&self, _: &Chain) -> Result<Vec<RejectedRow>, RowError> {
        Ok(Vec::new())
    }

    fn mistakes(&self, axes: usize) -> Vec<Mistake> {
        Mistake::of_joints(axes)
    }

    fn undone(&self, mistake: Mistake, robot: &Chain) -> Vec<Instrument> {
        let Mistake::Joints(mistake) = mistake else { return Vec::new() };
        let undone = |(q, height_m): (Joints, f64)| (mistake.undone(&q, robot.joint_kinds()), height_m);
        vec![Self::new(&self.rows().into_iter().map(undone).collect::<Vec<_>>()).into()]
    }
}

impl identify::model::RobotMotion for Column {
    fn at(&self, tau_s: f64) -> Option<JointState> {
        self.states.get(tau_s.round() as usize).copied()
    }
}

/// Joints and measured heights \[m\] of a robot with random errors.
fn measured(rows: usize) -> Vec<(Joints, f64)> {
    let (robot, mut random) = (irb120(), StdRng::seed_from_u64(3));
    let mut truth = flange_chain(&robot);
    for link in &mut truth.links {
        for number in [&mut link.a_m, &mut link.d_m, &mut link.alpha_rad, &mut link.theta_rad] {
            *number += 1e-3 * random.sample::<f64, _>(StandardNormal);
        }
    }
    let limits = robot.joint_limits();
    let row = |_| {
        let q: Joints = limits.iter().map(|[low, high]| random.random_range(0.8 * low..0.8 * high)).collect();
        let end = truth.forward(&q).transform_point(&Vector3::new(0.05, -0.02, 0.1).into());
        (q, end.z - 0.2 + 2e-5 * random.sample::<f64, _>(StandardNormal))
    };
    (0..rows).map(row).collect()
}

fn calibrated(rows: &[(Joints, f64)]) -> Calibration {
    let data = DataSets { rows: vec![Column::new(rows).into()], ..DataSets::default() };
    calibrate(&data, &irb120(), &IdentifyConfig::default(), None).unwrap()
}

#[test]
fn an_instrument_of_ones_own_is_calibrated_and_told_of_as_any_other() {
    let robot = irb120();
    let rows = measured(300);
    let found = calibrated(&rows);
    // The result has held-out figures, deployments, limits, tables and residuals.
    let held_out = found.rows[0].held_out();
    let [nominal_m, calibrated_m] = [held_out.nominal, held_out.joints].map(|stage| stage.position_m.rms);
    assert!(held_out.joints.rows >= 50 && calibrated_m < 5e-5, "{held_out:?}");
    assert!(calibrated_m < 0.05 * nominal_m, "{held_out:?}");
    let seen = evidence(&found, &robot.joint_limits()).with_validation(&found, None).unwrap();
    assert!(!seen.deployed.is_empty() && !seen.limits.is_empty());
    let run = &found.runs[0];
    let lines: Vec<u64> = (2..).take(rows.len()).collect();
    let text = table(&found.rows[0], run, &lines, &[], &[]);
    assert!(text.contains("nominal robot, column fitted"), "{text}");
    let residuals = residuals_csv(&found, &[&lines]).unwrap();
    assert_eq!(residuals.lines().count(), 1 + rows.len());
    assert!(residuals.lines().nth(1).unwrap().starts_with("1,column,1,2,"));
}

#[test]
fn what_changes_while_an_instrument_of_ones_own_measures_is_named() {
    let mut rows = measured(300);
    rows.iter_mut().skip(200).for_each(|(_, height_m)| *height_m += 1e-3);
    let found = calibrated(&rows);
    let changed: Vec<String> = found.changed.iter().map(ToString::to_string).collect();
    assert!(
        changed
            .iter()
            .any(|one| one.contains("the zero of the column steps by") && one.contains("67 % of the rows")),
        "{changed:?}"
    );
}

#[test]
fn a_mistake_with_an_instrument_of_ones_own_is_refused_with_its_cause() {
    let (robot, mut rows) = (irb120(), measured(300));
    rows.iter_mut().for_each(|(q, _)| *q = JointMistake::Exchanged(1, 2).undone(q, robot.joint_kinds()));
    let data = DataSets { rows: vec![Column::new(&rows).into()], ..DataSets::default() };
    let error = calibrate(&data, &robot, &IdentifyConfig::default(), None).unwrap_err().to_string();
    assert!(error.contains("joints 2 and 3 are exchanged"), "{error}");
}
