//! Calibration from poses with a position or a whole pose measured at each: a tracker and its probe on the flange.
//!
//! Unknown are the place of the tracker, the mounting of the probe, the robot's links, and the errors of its joints. They
//! come in this order, each stage from the one before: tracker and probe with the nominal robot; links, with priors from
//! tolerances; joint errors, each kind only if fitting rows left out are predicted better with it. Held-out rows take no
//! part in any of this; the figures on them are what counts.

mod error;
mod figures;
mod report;
mod samples;
mod start;
mod terms;
mod validate;

use nalgebra::{Rotation3, Vector3};

use super::split::{self, HoldOut, Split};
use crate::kinematics::{Chain, LinkParameter, Pose, ROBOT_JOINTS};
use crate::model::{Axis, Model, ModelError, ParameterId, Role, Unit};
use crate::solver::{LossName, Solution, Summary};
use samples::{Samples, Weighing};

pub use error::PoseError;
pub(super) use figures::quantile;
pub use figures::{Apart, PoseFigures, Sizes, Stages};
pub use report::PoseReport;
pub use terms::TermReport;
pub use validate::validate;

/// A pose of the robot and what the tracker measured there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseRow {
    /// Joint variables of the model \[rad\].
    pub joints_rad: [f64; ROBOT_JOINTS],
    /// Of the probe, in the tracker's frame \[m\].
    pub position_m: Vector3<f64>,
    /// `tracker_from_probe`; used where every row has it.
    pub rotation: Option<Rotation3<f64>>,
}

/// Highest order of the joints' waves that is tried as a rule: there is no finer tooth near the output of a strain wave gear.
pub const WAVES_PER_TURN_MAX: u8 = 64;

/// How the calibration is done.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseOptions {
    /// What is held out together, from the figures and from each fold of the choice of joint errors.
    pub hold_out: HoldOut,
    /// Part of the rows that the fit never sees.
    pub held_out: f64,
    /// Decides which.
    pub seed: u64,
    /// How much rows count that do not fit.
    pub loss: LossName,
    /// Prior of the links' lengths around nominal, one standard deviation \[m\].
    pub link_sigma_m: f64,
    /// Prior of the links' angles around nominal, one standard deviation \[rad\].
    pub link_sigma_rad: f64,
    /// Highest order of the joints' waves that is tried.
    pub waves_per_turn_max: u8,
    /// Joint errors may be taken.
    pub joint_errors: bool,
    /// Parameters that stay where they start: links at nominal, the probe on the flange, no joint error.
    pub fix: Vec<ParameterId>,
}

impl Default for PoseOptions {
    fn default() -> Self {
        Self {
            hold_out: HoldOut::default(),
            held_out: 0.2,
            seed: 1,
            loss: LossName::Huber,
            link_sigma_m: 1e-2,
            link_sigma_rad: 2e-2,
            waves_per_turn_max: WAVES_PER_TURN_MAX,
            joint_errors: true,
            fix: Vec::new(),
        }
    }
}

/// Fewest rows of a fit: as many numbers as tracker, probe and links together, twice.
const ROWS_MIN: usize = 20;
/// The probe is expected within this of the flange \[m\]: decides only where the poses do not tell.
const PROBE_SIGMA_M: f64 = 1.0;

fn check(rows: &[PoseRow], options: &PoseOptions) -> Result<(), PoseError> {
    check_rows(rows)?;
    for (option, value) in
        [("link_sigma_m", options.link_sigma_m), ("link_sigma_rad", options.link_sigma_rad)]
    {
        if !(value.is_finite() && value > 0.0) {
            return Err(PoseError::BadOption { option, value, remedy: "give a number above zero" });
        }
    }
    if !(0.0..0.9).contains(&options.held_out) {
        let (option, value) = ("held_out", options.held_out);
        return Err(PoseError::BadOption { option, value, remedy: "give a part from 0 to below 0.9" });
    }
    Ok(())
}

fn check_rows(rows: &[PoseRow]) -> Result<(), PoseError> {
    for (index, row) in rows.iter().enumerate() {
        let rotation = row.rotation.iter().flat_map(|rotation| rotation.matrix().iter());
        let mut numbers = row.joints_rad.iter().chain(row.position_m.iter()).chain(rotation);
        if !numbers.all(|number| number.is_finite()) {
            return Err(PoseError::BadRow { row: index + 1 });
        }
    }
    Ok(())
}

/// What the links are freed to do: 4 numbers of each, by the two axes that it joins.
///
/// The first link's `d` and `theta` are the tracker's place, the last link is the probe's mounting. Between nearly
/// parallel axes `d` has no value and Hayati's `beta` takes its place; a length along such axes is told once, by the `d`
/// of the link after them.
fn link_parameters(link: usize, links: usize, alpha_rad: f64) -> &'static [LinkParameter] {
    use LinkParameter::{A, Alpha, Beta, D, Theta};
    /// Less than this from parallel.
    const PARALLEL: f64 = 0.1;
    if link + 1 == links {
        return &[];
    }
    match (link, alpha_rad.sin().abs() < PARALLEL) {
        (0, false) => &[A, Alpha],
        (0, true) => &[A, Alpha, Beta],
        (_, false) => &[A, D, Alpha, Theta],
        (_, true) => &[A, Alpha, Theta, Beta],
    }
}

fn link_ids(robot: &Chain) -> Vec<ParameterId> {
    let of = |(link, at): (usize, &crate::kinematics::DhLink)| {
        let free = link_parameters(link, robot.links.len(), at.alpha_rad);
        free.iter().map(move |&parameter| ParameterId::Robot { link, parameter })
    };
    robot.links.iter().enumerate().flat_map(of).collect()
}

/// Everything that the stages share.
struct Fit<'a> {
    rows: &'a [PoseRow],
    directions: &'a [[f64; ROBOT_JOINTS]],
    fitting: &'a [usize],
    samples: Samples,
    loss: LossName,
    fix: &'a [ParameterId],
}

impl<'a> Fit<'a> {
    fn new(
        rows: &'a [PoseRow],
        directions: &'a [[f64; ROBOT_JOINTS]],
        fitting: &'a [usize],
        loss: LossName,
        fix: &'a [ParameterId],
    ) -> Self {
        Self { rows, directions, fitting, samples: Samples::of(rows, directions, fitting), loss, fix }
    }

    fn errors(&self, model: &Model) -> Vec<Apart> {
        samples::apart(&model.geometry(&model.start()), self.rows, self.directions)
    }

    /// Noise by the rows as they fit now.
    fn weighing(&self, model: &Model) -> Weighing {
        let noise = samples::noise(&self.errors(model), self.fitting);
        Weighing { noise, loss: self.loss.for_spread(1.0, self.samples.rows()) }
    }

    /// Tracker and probe for the robot as the model has it.
    fn place(&self, model: &mut Model) -> Result<(), PoseError> {
        let geometry = model.geometry(&model.start());
        let chosen: Vec<&PoseRow> = self.fitting.iter().filter_map(|&row| self.rows.get(row)).collect();
        let flanges: Vec<Pose> = chosen.iter().map(|row| geometry.robot.forward(&row.joints_rad)).collect();
        let tracker = start::place(&flanges, &chosen)?;
        for axis in Axis::ALL {
            for (id, value) in [
                (ParameterId::Tracker(axis), tracker.place.position_m),
                (ParameterId::TrackerRotation(axis), tracker.place.rotation_rad),
                (ParameterId::Probe(axis), tracker.probe.position_m),
                (ParameterId::ProbeRotation(axis), tracker.probe.rotation_rad),
            ] {
                if !self.fix.contains(&id) {
                    model.set_value(id, value[axis.index()])?;
                }
                model.set_role(id, self.placement_role(id))?;
            }
        }
        self.settle(model)
    }

    /// Solves until the noise that a solve assumes is the one that it leaves. Rows that do not fit lose their pull on the
    /// way (Cauchy); the loss that was asked for has the last word.
    fn settle(&self, model: &mut Model) -> Result<(), PoseError> {
        const ROUNDS_MAX: usize = 20;
        const SETTLED: f64 = 0.98;
        for _ in 0..ROUNDS_MAX {
            let weighing = self.weighing(model);
            let loss = LossName::Cauchy.for_spread(1.0, self.samples.rows());
            self.samples.minimise(model, Weighing { loss, ..weighing })?;
            if self.weighing(model).noise.position_m > SETTLED * weighing.noise.position_m {
                break;
            }
        }
        self.samples.minimise(model, self.weighing(model)).map(drop)
    }

    fn placement_role(&self, id: ParameterId) -> Role {
        match id {
            id if self.fix.contains(&id) => Role::Fixed,
            ParameterId::Probe(_) => Role::Prior { value: 0.0, sigma: PROBE_SIGMA_M },
            // Positions alone do not tell how the probe is turned.
            ParameterId::ProbeRotation(_) if self.samples.cost() == "measured_position" => Role::Fixed,
            _ => Role::Free,
        }
    }

    /// The links as well, with their priors.
    fn links(&self, model: &mut Model, robot: &Chain, options: &PoseOptions) -> Result<Solution, PoseError> {
        for id in link_ids(robot).into_iter().filter(|id| !self.fix.contains(id)) {
            let Some(nominal) = model.parameter(id).map(|parameter| parameter.nominal) else { continue };
            let sigma = match id.unit() {
                Unit::Metre => options.link_sigma_m,
                _ => options.link_sigma_rad,
            };
            model.set_role(id, Role::Prior { value: nominal, sigma })?;
        }
        self.settle(model)?;
        self.samples.solve(model, self.weighing(model))
    }

    /// Joint errors, as far as left-out rows ask for them.
    fn joints(
        &self,
        model: &mut Model,
        folds: &[Vec<usize>],
        options: &PoseOptions,
    ) -> Result<(Vec<TermReport>, Summary), PoseError> {
        let kinds = terms::kinds(options.waves_per_turn_max, self.fix);
        *model = model.clone().with_joint_waves(ParameterId::joint_waves(options.waves_per_turn_max));
        let choose = |model: &mut Model| {
            for kind in &kinds {
                // A column of each; the scale of the prior is chosen below.
                let prior = Role::Prior { value: 0.0, sigma: kind.sigmas[0] };
                model.set_roles(kind.ids.iter().copied(), prior)?;
            }
            let weighing = self.weighing(model);
            let reports = terms::choose(self, model, &kinds, folds, weighing)?;
            let summary = self.samples.minimise(model, weighing)?;
            Ok::<_, PoseError>((reports, summary))
        };
        // The noise is a fifth of what it was once the joints are known: the second choice weighs priors by it.
        choose(model)?;
        let (reports, _) = choose(model)?;
        let summary = self.samples.minimise(model, self.weighing(model))?;
        Ok((reports, summary))
    }
}

/// Calibrates a robot from poses measured by a tracker; rows in the order in which the robot went there.
///
/// `robot` is the nominal chain to the flange.
///
/// # Errors
/// [`PoseError`] for rows, options or geometry that allow no calibration.
pub fn calibrate(rows: &[PoseRow], robot: &Chain, options: &PoseOptions) -> Result<PoseReport, PoseError> {
    check(rows, options)?;
    let positions_m: Vec<Vector3<f64>> =
        rows.iter().map(|row| robot.forward(&row.joints_rad).translation.vector).collect();
    let groups = split::groups(options.hold_out, &positions_m);
    let Split { fitting, held_out } = split::split(&groups, options.held_out, options.seed);
    if fitting.len() < ROWS_MIN {
        return Err(PoseError::TooFewRows { rows: fitting.len(), needed: ROWS_MIN });
    }
    let directions = samples::directions(rows);
    let fit = Fit::new(rows, &directions, &fitting, options.loss, &options.fix);
    let mut model = Model::measured_pose(robot);
    let waves = || ParameterId::joint_waves(options.waves_per_turn_max);
    if let Some(&id) =
        options.fix.iter().find(|id| model.parameter(**id).is_none() && waves().all(|one| one != **id))
    {
        return Err(ModelError::NotInModel { id }.into());
    }
    fit.place(&mut model)?;
    let nominal = fit.errors(&model);
    let solution = fit.links(&mut model, robot, options)?;
    let links = fit.errors(&model);
    let mut terms = Vec::new();
    let mut summary = solution.summary;
    if options.joint_errors {
        let folds = split::folds(&groups, &fitting, terms::FOLDS, options.seed.wrapping_add(1));
        (terms, summary) = fit.joints(&mut model, &folds, options)?;
    }
    summary.require_converged()?;
    let joints = fit.errors(&model);
    let sigmas = report::sigmas(&fit, &model)?;
    let weighing = fit.weighing(&model);
    let of = |chosen: &[usize]| report::stages([&nominal, &links, &joints], chosen);
    Ok(PoseReport {
        cost: fit.samples.cost(),
        fitted: of(&fitting),
        held_out: of(&held_out),
        terms,
        noise: weighing.noise,
        sigmas,
        summary,
        identifiability: solution.identifiability,
        model,
    })
}
