//! Proposes positions of the bar and lengths of its rod (`identify plan place`). Random positions within the robot's reach
//! are drawn, and some random paths are generated at each position. Positions are ranked by the expected accuracy of a
//! calibration on the best of these paths.

use std::time::{Duration, Instant};

use nalgebra::Vector3;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, UnitSphere};
use shared::config::{BallBarConfig, RobotConfig};

use super::poses::limit_to_half_turns;
use super::random::random_route_until;
use super::search::{Pieces, tight_design, tightened};
use super::{Bodies, Constraints, Criterion, Design, ExpectedPosition, Information};
use crate::kinematics::{Chain, Joints, ball_bar_chain, ball_bar_inverse, robot_chain};
use crate::model::ModelError;
use crate::solver::Normal;

/// Number of random paths at each position. The best path rates the position.
const PATHS: usize = 2;
/// Least distance of the bar from the robot's vertical axis, as a fraction of the robot's reach. This distance leaves
/// space for the robot's foot and the bar's stand. Robots of 0.7 m reach have a foot of 0.2 m, robots of 2 m reach a
/// foot of 0.6 m.
const PEDESTAL: f64 = 0.25;
/// Positions are rounded to multiples of this \[m\]. A bar is not mounted more accurately, and a
/// calibration estimates its position.
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
    /// Value of the criterion; smaller is better.
    pub score: f64,
    /// Expected position errors after a calibration.
    pub expected: ExpectedPosition,
    /// Normal equations of the path at this position.
    pub normal: Normal,
}

/// Effect of a second run in addition to a run at the best position.
#[derive(Debug, Clone, PartialEq)]
pub struct SecondRun {
    /// Best second position, with the same bar.
    pub place: RatedPlace,
    /// Expected position errors after a calibration of both runs. Each run has its own base of the bar, offsets and clocks.
    pub expected: ExpectedPosition,
    /// Expected position errors of the alternative: one run of twice the length at the best position.
    pub twice_as_long: ExpectedPosition,
}

/// What is required of the positions, and what the search may use.
#[derive(Debug, Clone)]
pub struct PlaceRequest<'a> {
    /// Configuration of the robot.
    pub robot: &'a RobotConfig,
    /// The bar; its configured length is tried first.
    pub bar: &'a BallBarConfig,
    /// Margins, speeds and duration of the paths.
    pub design: &'a Design,
    /// Bodies for the computation of collisions.
    pub bodies: &'a Bodies,
    /// Highest acceleration of a robot joint \[rad/s², m/s²\].
    pub acceleration_rad_s2: f64,
    /// Lengths of the rod to try \[m\].
    pub lengths_m: &'a [f64],
    /// Lowest and highest position of the gimbal above the robot's base frame \[m\].
    pub height_m: [f64; 2],
    /// Criterion of the search.
    pub criterion: Criterion,
}

/// Result of the search for positions.
#[derive(Debug, Clone, PartialEq)]
pub struct Places {
    /// Positions with a path, best first.
    pub found: Vec<RatedPlace>,
    /// Number of positions at which no path was found.
    pub without_path: usize,
    /// Position for a second run; `None` if no other position with the same rod length has a path.
    pub second: Option<SecondRun>,
}

/// Tries positions until `budget` has elapsed or `is_over` returns true. The argument of `is_over` is the
/// number of tried positions.
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
        // The number of tried positions does not include the current one.
        let before = tried;
        let mut is_over = || begun.elapsed() >= budget || is_over(before);
        tried += 1;
        let Some((base_m, posture_deg)) = request.random_position(&bar, &mut random) else {
            places.without_path += 1;
            continue;
        };
        match request.best_at(&bar, base_m, posture_deg, &mut random, &mut is_over)? {
            Some(place) => places.found.push(place),
            // If the time elapsed during the search at this position, the position does not count as one without a path.
            None if is_over() => {}
            None => places.without_path += 1,
        }
    }
    places.found.sort_by(|a, b| a.score.total_cmp(&b.score));
    places.second = request.second_position(&places.found)?;
    Ok(places)
}

impl PlaceRequest<'_> {
    /// Draws a random position: a base of the bar and a posture of the robot \[deg, mm\]. They are drawn so that the bar
    /// reaches the robot's end within the design's ranges. `None` after many failed trials.
    fn random_position(&self, bar: &BallBarConfig, random: &mut ChaCha8Rng) -> Option<([f64; 3], Joints)> {
        const TRIES: usize = 2000;
        let (arm, mut chain) = (robot_chain(self.robot, bar), ball_bar_chain(bar));
        let limits = self.robot.joint_limits();
        let mut ranges = limits.clone();
        limit_to_half_turns(&mut ranges, self.robot);
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
            // The base was rounded, so the robot's joints must be computed again.
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

    /// The position at which a second run with the same rod improves the result of the first run most.
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

    /// Rates a position by the best of [`PATHS`] random paths; `None` if no path is found.
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
        // The paths keep the same additional margins as those of a search.
        let mut best: Option<RatedPlace> = None;
        for _ in 0..PATHS {
            // If no path is found in the first trial, the position has too little space, and no further trial is made.
            let Ok(route) = random_route_until(&tight, random, is_over) else { break };
            let Ok(pieces) = Pieces::divide(&tight, &information, &route, is_over) else { continue };
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
