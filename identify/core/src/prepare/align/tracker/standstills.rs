//! Rows of a tracker that were measured while the robot stood still, seconds apart: the clock at which the robot is at rest in
//! nearly all of them, and the places of station and target there.

use std::ops::Range;

use nalgebra::Vector3;

use super::{TrackerFit, TrackerSearch};
use crate::kinematics::Pose;
use crate::model::Clock;
use crate::prepare::align::clock::SKEW_SIGMA;
use crate::prepare::align::placement::placements;
use crate::prepare::readings::standstill::MOVING_RAD_S;
use crate::prepare::{Channels, Match, correlate};
use crate::solver::GoodShare;
use crate::statistics::largest_difference;

/// Time to either side of a row over which a robot at rest is slower than [`MOVING_RAD_S`] \[s\].
pub(super) const REST_S: f64 = 0.05;
/// Share of the rows of standstills at which the robot must have been at rest.
const AT_REST_MIN: f64 = 0.9;
/// Rates of clocks that are tried on standstills, up to two standard deviations either way: one step moves rows an hour from the
/// middle by less than a robot rests.
const SKEW_STEP: f64 = 0.1 * SKEW_SIGMA;
const SKEW_STEPS: i64 = 20;

/// Shifts at which nearly all rows are at rest, at one rate.
#[derive(Default)]
struct AtRest {
    skew: f64,
    shift_steps: Vec<i64>,
    /// Number of rows, summed over these shifts.
    rows: usize,
}

impl TrackerSearch<'_> {
    /// Whether the robot stands still, on the grid of its log.
    pub(super) fn resting(&self) -> Vec<bool> {
        let steps = (self.log_s / self.step_s) as usize + 1;
        let rests = |step: usize| {
            let tau_s = step as f64 * self.step_s;
            let around = [-REST_S, REST_S].map(|by_s| self.log.at(tau_s + by_s));
            let [Some(before), Some(after)] = around else { return false };
            largest_difference(&before.value, &after.value) < 2.0 * REST_S * MOVING_RAD_S
        };
        (0..steps).map(rests).collect()
    }

    /// Whether the robot is at rest at a time of its log; `None` outside the log.
    pub(super) fn rests_at(&self, resting: &[bool], tau_s: f64) -> Option<bool> {
        let place = (tau_s / self.step_s).round() as usize;
        resting.get(place).copied().filter(|_| tau_s >= 0.0)
    }

    /// Clocks near a coarse shift at which the robot is at rest in most of the rows: the middle of each range of such shifts, at the
    /// rate at which most rows are in standstills for most shifts.
    pub(super) fn clocks_at_standstills(&self, window: &Range<usize>, coarse: Clock) -> Vec<Clock> {
        let resting = self.resting();
        let times_s = self.observed_m.t_s.get(window.clone()).unwrap_or_default();
        let middle_s = 0.5 * (times_s.first().unwrap_or(&0.0) + times_s.last().unwrap_or(&0.0));
        let reach = (0.5 * self.period_s / self.step_s) as i64;
        // Shifts are those of the middle: there a rate changes nothing.
        let clock = |steps: i64, skew: f64| Clock {
            shift_s: coarse.shift_s + steps as f64 * self.step_s - skew * middle_s,
            skew,
        };
        // Number of rows at which the robot is at rest; `None` if these are not nearly all that its log covers.
        let rows_at_rest = |clock: &Clock| {
            let (mut covered, mut at_rest) = (0, 0);
            for rests in times_s.iter().filter_map(|t_s| self.rests_at(&resting, clock.robot_time_s(*t_s))) {
                covered += 1;
                at_rest += usize::from(rests);
            }
            (at_rest as f64 >= AT_REST_MIN * f64::from(covered.max(1))).then_some(at_rest)
        };
        let at_rate = |number: i64| {
            let mut found = AtRest { skew: number as f64 * SKEW_STEP, ..AtRest::default() };
            for steps in -reach..=reach {
                let Some(rows) = rows_at_rest(&clock(steps, found.skew)) else { continue };
                found.shift_steps.push(steps);
                found.rows += rows;
            }
            found
        };
        // Of equally good rates the one nearest to zero is the first.
        let rates = (0..=SKEW_STEPS).flat_map(|number| [number, -number]);
        let mut best = AtRest::default();
        for other in rates.map(at_rate) {
            if other.rows > best.rows {
                best = other;
            }
        }
        let middle = |range: &[i64]| range.get(range.len() / 2).map(|steps| clock(*steps, best.skew));
        best.shift_steps.chunk_by(|a, b| b - a == 1).filter_map(middle).collect()
    }

    /// Station and target from rows at standstills; the clock is fixed.
    pub(super) fn fit_at_standstills(&self, window: &Range<usize>, clock: Clock) -> Option<TrackerFit> {
        let flange_and_position = |row: usize| {
            let flange = self.flange(clock.robot_time_s(self.observed_m.t_s[row]))?;
            Some((flange, self.observed_m[row]))
        };
        let (flanges, observed_m): (Vec<Pose>, Vec<Vector3<f64>>) =
            window.clone().filter_map(flange_and_position).unzip();
        let [tracker, probe] = placements(&flanges, &observed_m, std::iter::empty())?;
        let (tracker, probe_m) = (tracker.pose(), probe.position_m);
        // The squared distance is that of three coordinates.
        let squared = flanges.iter().zip(&observed_m).map(|(flange, observed_m)| {
            let predicted = flange.transform_point(&probe_m.into());
            ((predicted - tracker.transform_point(&(*observed_m).into())).norm_squared(), 3)
        });
        Some(TrackerFit { clock, probe_m, spread_m: GoodShare::NINE_TENTHS.spread(squared) })
    }

    /// Match of the measured and predicted distances from row to row.
    pub(super) fn match_of_distances(&self, window: &Range<usize>, fit: &TrackerFit) -> Option<Match> {
        let both_positions = |row: usize| {
            let tau_s = fit.clock.robot_time_s(self.observed_m.t_s[row]);
            Some((self.predicted_m(tau_s, &fit.probe_m)?, self.observed_m[row]))
        };
        let (predicted_m, observed_m): (Vec<Vector3<f64>>, Vec<_>) =
            window.clone().filter_map(both_positions).unzip();
        let distances = |points_m: &[Vector3<f64>]| {
            let lengths: Vec<f64> = points_m.windows(2).map(|pair| (pair[1] - pair[0]).norm()).collect();
            Channels { known: vec![true; lengths.len()], values: vec![lengths] }
        };
        // All of them overlap only without a shift.
        let overlap_min = predicted_m.len().checked_sub(1)?;
        let matched = correlate(&distances(&predicted_m), &distances(&observed_m), overlap_min)?;
        let covered_s = predicted_m.len() as f64 / window.len().max(1) as f64 * self.duration_s(window);
        Some(Match { overlap: (covered_s / self.step_s) as usize, ..matched })
    }
}
