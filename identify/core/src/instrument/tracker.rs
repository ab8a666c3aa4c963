//! A tracker that measures positions or poses of targets on the flange, from one or more stations. The robot stands still or
//! moves. The residual is the predicted pose of the target minus the measured pose ([`MeasuredPose`]) or position
//! ([`MeasuredPosition`]). In addition to the robot, the fit estimates the poses of the stations (`places`), the poses of
//! the targets (`probes`), and the scale.

use nalgebra::{Rotation3, Vector3};

use super::cause::numbered;
use super::rows::{MEDIAN_OF_THREE, RowNoise, Standing};
use super::{
    Cause, Deviation, HoldOut, Instrument, Measures, Mistake, Noise, PoseError, RejectedRow, RowError,
    ScaleFrom, set_scale_prior,
};
use crate::cost::{CostError, DataSet, LoopProblem, MeasuredPose, MeasuredPosition, PoseNoise, Residual};
use crate::kinematics::{Chain, Joints, Pose, rotation_vector};
use crate::logs::{PoseRow, PoseUncertainty};
use crate::model::{
    Axis, ClockRelation, Coordinate, Geometry, Group, JointState, Model, ModelError, Observation, Owner,
    ParameterId, PerObservation, Placement, RobotMotion, Role, SetUp,
};
use crate::prepare::{Moving, PROBE_SIGMA_M, Sighted, all_placements};
use crate::statistics::median_size;

/// Minimum number of rows of a fit. They contain at least twice as many coordinates as
/// tracker, probe and links have unknowns.
const ROWS_MIN: usize = 20;
/// Minimum number of rows of each station, if there is more than one. They contain twice as many coordinates as the station
/// has unknowns (six), even if some rows are held out.
const STATION_ROWS_MIN: usize = 5;
/// Minimum number of rows of each target, if there is more than one.
const TARGET_ROWS_MIN: usize = 3;

/// The rows of one file, and the noise of each row.
#[derive(Debug, Clone)]
pub struct Tracker {
    rows: Standing<PoseRow>,
    /// Times of the rows, and the robot's log. `None` if the robot stood still.
    moving: Option<Moving>,
    /// Time of each row.
    observations: Vec<Observation>,
    /// Whether every row has a rotation.
    has_rotations: bool,
    /// Noise of each measurement, estimated from the residuals and the stated uncertainties.
    noise: Vec<PoseNoise>,
    /// Standard uncertainty of the scale \[ppm\]; zero means exact.
    scale_u_ppm: f64,
}

impl Tracker {
    /// Creates the instrument for a robot that stood still at each row. `rows` are in the
    /// order in which the robot visited them.
    pub fn new(rows: &[PoseRow]) -> Self {
        Self::from_parts(Standing::new(rows, |row| row.joints_rad), None)
    }

    /// Creates the instrument for rows that were measured while the robot moved.
    pub fn of_moving(rows: &[PoseRow], moving: Moving) -> Self {
        Self::from_parts(Standing::new(rows, |row| row.joints_rad), Some(moving))
    }

    /// Sets the standard uncertainty of the scale to the value that the mapping states \[ppm\]. Zero means that the scale
    /// is exact. `None` keeps the default.
    #[must_use]
    pub fn with_scale_u_ppm(self, stated: Option<f64>) -> Self {
        Self { scale_u_ppm: stated.unwrap_or(self.scale_u_ppm), ..self }
    }

    /// The instrument with other rows, treated as if the robot had stood still. The joints are those of the first alignment.
    fn at_rest(&self, rows: Standing<PoseRow>) -> Instrument {
        Self::from_parts(rows, None).with_scale_u_ppm(Some(self.scale_u_ppm)).into()
    }

    fn from_parts(rows: Standing<PoseRow>, moving: Option<Moving>) -> Self {
        let observation = |row| {
            let measured_s = moving.as_ref().and_then(|moving| moving.t_s.get(row).copied());
            Observation::time_only(measured_s.unwrap_or(PerObservation::time_s(row)))
        };
        Self {
            observations: (0..rows.rows.len()).map(observation).collect(),
            has_rotations: rows.rows.iter().all(|row| row.rotation.is_some()),
            noise: vec![PoseNoise { position_m: 1.0, rotation_rad: 1.0 }; rows.rows.len()],
            scale_u_ppm: ScaleFrom::Tracker.usual_u_ppm(),
            moving,
            rows,
        }
    }

    /// State that the robot reports at each row, with the clock in `geometry`.
    fn states(&self, geometry: &Geometry) -> impl Iterator<Item = JointState> {
        let clock = geometry.clock;
        // The preparation removes rows near the ends of the log, so a reported state normally exists.
        let state = move |(row, state): (usize, &JointState)| self.reported(row, &clock).unwrap_or(*state);
        self.rows.states.iter().enumerate().map(state)
    }

    /// The tracker with only these rows.
    fn chosen(&self, rows: &[usize]) -> Self {
        let moving = self.moving.as_ref().map(|moving| Moving {
            t_s: rows.iter().map(|&row| moving.t_s[row]).collect(),
            ..moving.clone()
        });
        let noise = rows.iter().map(|&row| self.noise[row]).collect();
        Self { noise, scale_u_ppm: self.scale_u_ppm, ..Self::from_parts(self.rows.chosen(rows), moving) }
    }

    /// For each row, the pose of the station and the predicted pose of the target. `None` if the geometry does not
    /// contain the station or the target.
    fn predicted(&self, geometry: &Geometry) -> impl Iterator<Item = (&PoseRow, Option<[Pose; 2]>)> {
        let tracker = &geometry.tracker;
        let stations: Vec<Pose> = tracker.places.iter().map(Placement::pose).collect();
        let targets: Vec<Pose> = tracker.probes.iter().map(Placement::pose).collect();
        self.rows.rows.iter().zip(self.states(geometry)).map(move |(row, state)| {
            let station = stations.get(row.set_up.station).copied();
            let target = targets.get(row.set_up.target);
            let poses =
                station.zip(target).map(|(station, target)| [station, geometry.robot_end(&state) * target]);
            (row, poses)
        })
    }

    /// Standard deviation of a coordinate of the median row \[m\].
    pub fn noise_m(&self) -> f64 {
        median_size(self.noise.iter().map(|noise| noise.position_m))
    }

    /// The rows as a least-squares problem with this residual. Residuals are divided by `sigma`.
    fn loop_problem<'a, R: Residual + 'a>(
        &'a self,
        model: &'a Model,
        residual: R,
        sigma: f64,
    ) -> Result<Box<dyn DataSet + 'a>, CostError> {
        Ok(Box::new(LoopProblem::new(model, self, &self.observations, residual, sigma)?))
    }
}

impl RobotMotion for Tracker {
    fn at(&self, tau_s: f64) -> Option<JointState> {
        self.moving.as_ref().map_or_else(|| self.rows.states.at(tau_s), |moving| moving.log.at(tau_s))
    }
}

impl Measures for Tracker {
    fn name(&self) -> &'static str {
        "tracker"
    }

    fn cost(&self) -> &'static str {
        if self.has_rotations { MeasuredPose::NAME } else { MeasuredPosition::NAME }
    }

    fn scale(&self) -> ScaleFrom {
        ScaleFrom::Tracker
    }

    fn noise(&self) -> Noise {
        Noise::Length(self.noise_m())
    }

    fn samples(&self) -> usize {
        self.rows.rows.len()
    }

    fn parts(&self) -> &'static str {
        "tracker and probe"
    }

    /// Adds the parameters of the stations and targets that occur in the rows.
    fn fitted_out(&self, robot: Model) -> Model {
        let model =
            robot.with_set_ups(Owner::Tracker, SetUp::counts(self.rows.rows.iter().map(|row| row.set_up)));
        if self.moving.is_some() { model } else { model.without_clocks() }
    }

    /// Estimates start values of stations and targets. Returns false if the positions measured from a station
    /// lie on a line.
    fn place(&self, model: &mut Model, fix: &[ParameterId]) -> Result<bool, ModelError> {
        let geometry = model.geometry(&[]);
        let rows = self.rows.rows.iter().zip(self.states(&geometry));
        let sighted = rows.map(|(seen, state)| Sighted { flange: geometry.robot_end(&state), seen: *seen });
        let sighted: Vec<Sighted> = sighted.collect();
        let Some(placements) = all_placements(&sighted) else { return Ok(false) };
        if let Some(moving) = &self.moving {
            for (id, value) in [(ParameterId::ClockShift, 0.0), (ParameterId::ClockSkew, moving.skew)] {
                model.set_value(id, value)?;
                model.set_role(id, if fix.contains(&id) { Role::Fixed } else { Role::Free })?;
            }
        }
        for id in model.ids() {
            let (placement, coordinate, role) = match id {
                ParameterId::Tracker { station, coordinate } => {
                    (placements.places.get(&station), coordinate, Role::Free)
                }
                ParameterId::Probe { target, coordinate } => {
                    let role = match coordinate {
                        Coordinate::Position(_) => Role::Prior { value: 0.0, sigma: PROBE_SIGMA_M },
                        // Positions alone do not determine the orientation of the probe, so keep it fixed.
                        Coordinate::Rotation(_) if !self.has_rotations => Role::Fixed,
                        Coordinate::Rotation(_) => Role::Free,
                    };
                    (placements.probes.get(&target), coordinate, role)
                }
                _ => continue,
            };
            let role = if fix.contains(&id) { Role::Fixed } else { role };
            // A station or target without rows cannot be estimated.
            let Some(placement) = placement else { continue };
            if role != Role::Fixed {
                model.set_value(id, placement.coordinate(coordinate))?;
            }
            model.set_role(id, role)?;
        }
        set_scale_prior(model, self.scale_u_ppm, fix)?;
        Ok(true)
    }

    fn data_set<'a>(&'a self, model: &'a Model, sigma: f64) -> Result<Box<dyn DataSet + 'a>, CostError> {
        let Self { rows: Standing { rows, .. }, noise, .. } = self;
        if self.has_rotations {
            self.loop_problem(model, MeasuredPose { rows, noise }, sigma)
        } else {
            self.loop_problem(model, MeasuredPosition { rows, noise }, sigma)
        }
    }

    fn reported(&self, sample: usize, clock: &ClockRelation) -> Option<JointState> {
        match &self.moving {
            Some(moving) => moving.log.at(clock.robot_time_s(*moving.t_s.get(sample)?)),
            None => self.rows.states.get(sample).copied(),
        }
    }

    fn identifies(&self, id: ParameterId, robot: &Chain) -> bool {
        let depends = if self.has_rotations {
            MeasuredPose::depends_on(id, robot)
        } else {
            MeasuredPosition::depends_on(id, robot)
        };
        depends && (self.moving.is_some() || id.group() != Group::Clock)
    }

    /// Estimates the standard deviations of position coordinates and of angles. Uses medians, because most errors are
    /// normally distributed. Returns the standard deviation of a coordinate of the median row \[m\].
    fn adapt(&mut self, model: &Model) -> Option<f64> {
        let errors = self.errors(&model.geometry(&[]));
        // Computes the standard deviation of each row, of the position or of the rotation.
        let sigmas = |error: fn(&PoseError) -> f64, stated: fn(&PoseUncertainty) -> Option<f64>| {
            let stated = || self.rows.rows.iter().map(move |row| stated(&row.uncertainty));
            let noise = RowNoise::behind(errors.iter().map(error).zip(stated()), MEDIAN_OF_THREE);
            stated().map(|stated| noise.sigma(stated)).collect::<Vec<_>>()
        };
        let position_m = sigmas(|error| error.position_m, |stated| stated.position_m);
        let rotation_rad = sigmas(|error| error.rotation_rad.unwrap_or(0.0), |stated| stated.rotation_rad);
        let noise = position_m.into_iter().zip(rotation_rad);
        self.noise = noise.map(|(position_m, rotation_rad)| PoseNoise { position_m, rotation_rad }).collect();
        Some(self.noise_m())
    }

    fn independent(&self, count: usize) -> Vec<Vec<usize>> {
        self.rows.independent(count, |row| row.set_up.station)
    }

    fn part(&self, samples: &[usize]) -> Instrument {
        self.chosen(samples).into()
    }

    fn group(&mut self, groups: &[usize], seed: u64) {
        self.rows.group(groups, seed);
    }

    /// If there are several stations, single poses are held out, because a region could contain all rows of one station.
    fn hold_out(&self) -> HoldOut {
        let several = self.moving.is_none() && self.rows.rows.iter().any(|row| row.set_up.station > 0);
        if several { HoldOut::Rows } else { HoldOut::Regions }
    }

    fn joints(&self) -> Vec<Joints> {
        self.rows.joints()
    }

    fn samples_min(&self) -> usize {
        ROWS_MIN
    }

    fn contradicting(&self, _: &Chain) -> Result<Vec<RejectedRow>, RowError> {
        self.rows.ensure_finite(|row| {
            let rotation = row.rotation.iter().flat_map(|rotation| rotation.matrix().iter());
            row.position_m.iter().chain(rotation).copied().collect::<Vec<_>>().into_iter()
        })?;
        let needed = [("station", STATION_ROWS_MIN), ("target", TARGET_ROWS_MIN)];
        self.rows.ensure_each_has_rows(|row| row.set_up, needed)?;
        Ok(Vec::new())
    }

    fn mistakes(&self, axes: usize) -> Vec<Mistake> {
        /// Number of segments of the file. At each boundary between two segments, a displacement is tried.
        const PLACES: usize = 40;
        let others = [Mistake::RowsShifted, Mistake::Mirrored, Mistake::ModifiedTable];
        let moved = (1..PLACES).map(|place| Mistake::Moved(place * self.samples() / PLACES));
        let others = others.into_iter().chain(Mistake::LENGTH_UNITS);
        Mistake::of_joints(axes).into_iter().chain(others).chain(moved).collect()
    }

    fn undone(&self, mistake: Mistake, robot: &Chain) -> Vec<Instrument> {
        let rows = &self.rows;
        match mistake {
            Mistake::Joints(mistake) => vec![self.at_rest(rows.undone(mistake, robot))],
            Mistake::RowsShifted => rows.shifted().map(|rows| self.at_rest(rows)).to_vec(),
            Mistake::Mirrored => {
                // One mirror image is sufficient. Any other one is equal to it, with another pose of the tracker.
                let mut mirrored = rows.clone();
                for row in &mut mirrored.rows {
                    row.position_m.z = -row.position_m.z;
                    row.rotation = None;
                }
                vec![self.at_rest(mirrored)]
            }
            Mistake::LengthUnit(thousandths) => {
                let mut scaled = rows.clone();
                for row in &mut scaled.rows {
                    row.position_m *= f64::from(thousandths) * 1e-3;
                }
                vec![self.at_rest(scaled)]
            }
            // Displacements and a modified table cannot be corrected in the rows.
            _ => Vec::new(),
        }
    }

    /// Predicted minus measured position of the target, in the frame of the robot's base. Also the
    /// angle between the two orientations.
    fn deviations(&self, geometry: &Geometry) -> Vec<Deviation> {
        let deviation = |(row, poses): (&PoseRow, Option<[Pose; 2]>)| {
            let Some([station, probe]) = poses else { return Deviation::of_place(Vector3::repeat(f64::NAN)) };
            let measured_m =
                station.transform_point(&(row.position_m / (1.0 + geometry.scale)).into()).coords;
            let angle = |rotation: Rotation3<f64>| {
                rotation_vector((probe.rotation.inverse() * station.rotation * rotation).matrix()).norm()
            };
            Deviation {
                rotation_rad: row.rotation.map(angle),
                ..Deviation::of_place(probe.translation.vector - measured_m)
            }
        };
        self.predicted(geometry).map(deviation).collect()
    }

    fn causes(&self, Geometry { tracker, .. }: &Geometry) -> Vec<Cause> {
        // A displacement of the station without a rotation is a separate cause. A test of all six coordinates does not
        // detect it if there are few poses, because rotations are measured very accurately.
        let station = |station| {
            let name = format!("the place of the tracker{}", numbered(" in station", station));
            let cause = |coordinates: &[Coordinate]| {
                let id = |coordinate: &Coordinate| ParameterId::Tracker { station, coordinate: *coordinate };
                Cause::new(name.clone(), coordinates.iter().map(id).collect::<Vec<_>>())
            };
            [cause(&Axis::ALL.map(Coordinate::Position)), cause(&Coordinate::ALL)]
        };
        let target = |target| {
            let name = format!("the place of the tracker's target{} on the flange", numbered("", target));
            let position = Axis::ALL.map(Coordinate::Position);
            Cause::new(name, position.map(|coordinate| ParameterId::Probe { target, coordinate }))
        };
        let stations = (0..tracker.places.len()).flat_map(station);
        stations.chain((0..tracker.probes.len()).map(target)).chain([Cause::clock()]).collect()
    }

    fn time_s(&self, sample: usize) -> Option<f64> {
        self.moving.as_ref()?.t_s.get(sample).copied()
    }

    fn relative_noise(&self) -> Vec<f64> {
        let median_m = self.noise_m();
        self.noise.iter().map(|noise| noise.position_m / median_m).collect()
    }
}
