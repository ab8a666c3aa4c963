//! Position of the bar and length of its rod, for `identify plan place`: random positions that the robot reaches, ranked by the
//! expected accuracy of a calibration on the best of some random paths there.

use std::f64::consts::PI;
use std::time::{Duration, Instant};

use nalgebra::Vector3;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, UnitSphere};
use shared::config::{BallBarConfig, RobotConfig};

use super::random::random_route_until;
use super::search::{Pieces, tight_design, tightened};
use super::{Bodies, Constraints, Criterion, Design, ExpectedPosition, Information};
use crate::kinematics::{Chain, Joints, ball_bar_chain, ball_bar_inverse, robot_chain};
use crate::model::ModelError;
use crate::solver::Normal;

/// Number of random paths at each position; the best one counts.
const PATHS: usize = 2;
/// Space of the robot's foot and the bar's stand around the robot's vertical axis, as a part of its reach: robots of 0.7 m
/// reach stand on 0.2 m, of 2 m on 0.6 m.
const PEDESTAL: f64 = 0.25;
/// Positions are multiples of this \[m\]: a bar is not mounted more accurately, and its position is estimated.
const STEP_M: f64 = 0.05;

/// A position of the bar, and the expected accuracy of a calibration there.
#[derive(Debug, Clone, PartialEq)]
pub struct RatedPlace {
    /// Centre of the gimbal in the robot's base frame \[m\].
    pub base_m: [f64; 3],
    /// Length of the rod \[m\].
    pub length_m: f64,
    /// A posture of the robot on the sphere \[deg, mm\].
    pub posture_deg: Joints,
    /// Value of the criterion, smaller is better.
    pub score: f64,
    /// Expected position errors after a calibration.
    pub expected: ExpectedPosition,
    /// Information of the path there.
    pub normal: Normal,
}

/// Effect of a second run in addition to one at the best position.
#[derive(Debug, Clone, PartialEq)]
pub struct SecondRun {
    /// Best second position of the same bar.
    pub place: RatedPlace,
    /// Expected position errors after a calibration of both runs, each with its own base, offsets and clocks.
    pub expected: ExpectedPosition,
    /// The same for a run of twice the length at the best position instead.
    pub twice_as_long: ExpectedPosition,
}

/// Requirements on the places.
#[derive(Debug, Clone)]
pub struct PlaceRequest<'a> {
    /// Configuration of the robot.
    pub robot: &'a RobotConfig,
    /// The bar; its configured length is tried first.
    pub bar: &'a BallBarConfig,
    /// Margins, speeds and duration of the paths.
    pub design: &'a Design,
    /// Bodies that must not touch.
    pub bodies: &'a Bodies,
    /// Highest acceleration of a robot joint \[rad/s², m/s²\].
    pub acceleration_rad_s2: f64,
    /// Lengths of the rod \[m\].
    pub lengths_m: &'a [f64],
    /// Lowest and highest position of the gimbal above the robot's base frame \[m\].
    pub height_m: [f64; 2],
    /// Criterion of the search.
    pub criterion: Criterion,
}

/// Positions with and without a path.
#[derive(Debug, Clone, PartialEq)]
pub struct Places {
    /// Positions with a path, best first.
    pub found: Vec<RatedPlace>,
    /// Number of places without one.
    pub without_path: usize,
    /// Second position; `None` if only one position with the best rod length has a path.
    pub second: Option<SecondRun>,
}

/// Tries positions until `budget` has elapsed or `is_over` returns true, which receives the number of positions tried.
///
/// # Errors
/// [`ModelError`] if the model lacks a parameter.
pub fn places(
    request: &PlaceRequest<'_>,
    seed: u64,
    budget: Duration,
    mut is_over: impl FnMut(usize) -> bool,
) -> Result<Places, ModelError> {
    let begun = Instant::now();
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut places = Places { found: Vec::new(), without_path: 0, second: None };
    let mut tried = 0;
    while begun.elapsed() < budget && !is_over(tried) {
        let length_m = request.lengths_m.get(tried % request.lengths_m.len().max(1)).copied();
        let bar = request.bar_with_length(length_m.unwrap_or(request.bar.length_m));
        // A position in progress does not count as tried.
        let before = tried;
        let mut is_over = || begun.elapsed() >= budget || is_over(before);
        tried += 1;
        let Some((base_m, posture_deg)) = request.random_position(&bar, &mut random) else {
            places.without_path += 1;
            continue;
        };
        match request.best_at(&bar, base_m, posture_deg, &mut random, &mut is_over)? {
            Some(place) => places.found.push(place),
            // An incomplete position is not counted.
            None if is_over() => {}
            None => places.without_path += 1,
        }
    }
    places.found.sort_by(|a, b| a.score.total_cmp(&b.score));
    places.second = request.second_position(&places.found)?;
    Ok(places)
}

impl PlaceRequest<'_> {
    /// A posture of the robot, and a base from which the bar reaches its end within the design's ranges.
    fn random_position(&self, bar: &BallBarConfig, random: &mut ChaCha8Rng) -> Option<([f64; 3], Joints)> {
        const TRIES: usize = 2000;
        let (arm, mut chain) = (robot_chain(self.robot, bar), ball_bar_chain(bar));
        let limits = self.robot.joint_limits();
        // A joint needs no angles beyond half a turn: they give the same poses.
        let ranges: Vec<[f64; 2]> = limits.iter().map(|[low, high]| [low.max(-PI), high.min(PI)]).collect();
        for _ in 0..TRIES {
            let q = Joints::random(&ranges, random);
            let end = arm.forward(&q);
            let rod_direction: [f64; 3] = UnitSphere.sample(random);
            let exact_m = end.translation.vector - Vector3::from(rod_direction) * bar.length_m;
            let base_m: [f64; 3] = exact_m.map(|x| (x / STEP_M).round() * STEP_M).into();
            let pedestal = arm.root_from_base.translation.vector;
            let from_axis_m = (base_m[0] - pedestal.x).hypot(base_m[1] - pedestal.y);
            let height_is_allowed = (self.height_m[0]..=self.height_m[1]).contains(&base_m[2]);
            if !height_is_allowed || from_axis_m < PEDESTAL * arm.reach_m() {
                continue;
            }
            chain.root_from_base.translation.vector = base_m.into();
            let Ok(configurations) = ball_bar_inverse(&chain, &end) else { return None };
            let is_within = |bar_rad: &[f64; 5]| {
                bar_rad
                    .iter()
                    .zip(&self.design.bar_range_deg)
                    .all(|(angle, [low, high])| (low.to_radians()..high.to_radians()).contains(angle))
            };
            let Some((_, bar_rad)) = configurations.iter().find(|(_, bar_rad)| is_within(bar_rad)) else {
                continue;
            };
            let constraints = self.constraints(&arm, &chain, &limits, self.design);
            // The base was rounded, so the robot's joints change.
            if let Ok(q) = constraints.robot_at(bar_rad, &q) {
                let shown = q.iter().zip(&arm.links).map(|(q, link)| q * link.joint.display_factor());
                return Some((base_m, shown.map(f64::round).collect()));
            }
        }
        None
    }

    fn constraints<'c>(
        &self,
        arm: &'c Chain,
        bar: &'c Chain,
        limits: &[[f64; 2]],
        design: &'c Design,
    ) -> Constraints<'c> {
        Constraints::new(arm, bar, limits, design).with(Some(self.bodies.clone()), self.acceleration_rad_s2)
    }

    fn bar_with_length(&self, length_m: f64) -> BallBarConfig {
        BallBarConfig { length_m, ..self.bar.clone() }
    }

    fn information(&self, bar: &BallBarConfig, chains: (&Chain, &Chain)) -> Result<Information, ModelError> {
        Information::new((self.robot, bar), chains, self.criterion, self.design.duration_s)
    }

    /// The position of a second run that improves the result of the first most, with the same rod.
    fn second_position(&self, found: &[RatedPlace]) -> Result<Option<SecondRun>, ModelError> {
        let Some((first, others)) = found.split_first() else { return Ok(None) };
        let bar = self.bar_with_length(first.length_m);
        let information = self.information(&bar, (&robot_chain(self.robot, &bar), &ball_bar_chain(&bar)))?;
        let Some(after_first) = information.after_run(&first.normal) else { return Ok(None) };
        let mut twice = first.normal.clone();
        twice += &first.normal;
        let best = others
            .iter()
            .filter(|place| place.length_m == first.length_m)
            .map(|place| (after_first.score(&place.normal), place))
            .min_by(|a, b| a.0.total_cmp(&b.0));
        Ok(best.map(|(_, place)| SecondRun {
            place: place.clone(),
            expected: after_first.position(&place.normal),
            twice_as_long: information.position(&twice),
        }))
    }

    /// The position with the best of [`PATHS`] random paths; `None` if none is found.
    fn best_at(
        &self,
        bar: &BallBarConfig,
        base_m: [f64; 3],
        posture_deg: Joints,
        random: &mut ChaCha8Rng,
        is_over: &mut impl FnMut() -> bool,
    ) -> Result<Option<RatedPlace>, ModelError> {
        let design = Design { base_m, posture_deg, ..self.design.clone() };
        let (arm, mut chain) = (robot_chain(self.robot, bar), ball_bar_chain(bar));
        chain.root_from_base.translation.vector = base_m.into();
        let information = self.information(bar, (&arm, &chain))?;
        let limits = self.robot.joint_limits();
        let constraints = self.constraints(&arm, &chain, &limits, &design);
        let tight_design = tight_design(&design);
        let tight = tightened(&constraints, &tight_design);
        let mut best: Option<RatedPlace> = None;
        for _ in 0..PATHS {
            // A position at which the first path fails has too little space.
            let Ok(route) = random_route_until(&tight, random, is_over) else { break };
            let Ok(pieces) = Pieces::of(&tight, &information, &route, is_over) else { continue };
            let normal = pieces.total(&information);
            let (score, expected) = (information.score(&normal), information.position(&normal));
            if score.is_finite() && best.as_ref().is_none_or(|best| score < best.score) {
                best =
                    Some(RatedPlace { base_m, length_m: bar.length_m, posture_deg, score, expected, normal });
            }
        }
        Ok(best)
    }
}
