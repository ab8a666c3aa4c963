//! Aligns a stop-and-go log: the tracker's rows are seconds apart, and the robot stood still at each row.
//!
//! The robot's log first gives the times at which the robot is at rest. A clock is possible if the robot is at rest at
//! nearly all rows. For each possible clock, the poses of tracker and probe are computed from the rows. The distances from
//! row to row are then correlated with the predicted distances.

use std::ops::Range;

use nalgebra::Vector3;

use super::{TrackerFit, TrackerSearch};
use crate::kinematics::Pose;
use crate::model::ClockRelation;
use crate::prepare::align::clock::SKEW_SIGMA;
use crate::prepare::align::placement::placements;
use crate::prepare::readings::standstill::MOVING_RAD_S;
use crate::prepare::{Channels, Match, correlate};
use crate::solver::GoodShare;
use crate::statistics::largest_difference;

/// A robot counts as at rest at an instant if its mean speed is below [`MOVING_RAD_S`] in the interval from this time before
/// the instant to this time after the instant \[s\].
pub(super) const REST_S: f64 = 0.05;
/// Fraction of the rows within the robot's log at which the robot must be at rest.
const AT_REST_MIN: f64 = 0.9;
/// Difference between successive rates of the clock that are tried. At a row one hour from the middle of the window, this
/// difference changes the robot time by 36 ms, which is less than the duration of a standstill.
const SKEW_STEP: f64 = 0.1 * SKEW_SIGMA;
/// Number of steps of the rate in each direction: up to two standard deviations.
const SKEW_STEPS: i64 = 20;

/// The shifts at which the robot is at rest at nearly all rows, for one rate.
#[derive(Default)]
struct AtRest {
    skew: f64,
    /// Shifts, as numbers of grid steps from the coarse shift.
    shift_steps: Vec<i64>,
    /// Number of rows at which the robot is at rest, summed over these shifts.
    rows: usize,
}

impl TrackerSearch<'_> {
    /// Whether the robot is at rest, at each grid point of its log.
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

    /// Whether the robot is at rest at the time `tau_s` of its log; `None` outside the log. `resting` is
    /// the result of [`Self::resting`].
    pub(super) fn rests_at(&self, resting: &[bool], tau_s: f64) -> Option<bool> {
        let place = (tau_s / self.step_s).round() as usize;
        resting.get(place).copied().filter(|_| tau_s >= 0.0)
    }

    /// Finds clocks near `coarse` at which the robot is at rest at nearly all rows. Several rates are tried, each with many
    /// shifts. The rate with the largest number of rows at rest, summed over the shifts, is selected. Each range of
    /// consecutive shifts at this rate gives one clock, with the shift in the middle of the range.
    pub(super) fn clocks_at_standstills(
        &self,
        window: &Range<usize>,
        coarse: ClockRelation,
    ) -> Vec<ClockRelation> {
        let resting = self.resting();
        let times_s = self.observed_m.t_s.get(window.clone()).unwrap_or_default();
        let middle_s = 0.5 * (times_s.first().unwrap_or(&0.0) + times_s.last().unwrap_or(&0.0));
        let reach = (0.5 * self.period_s / self.step_s) as i64;
        // The shift is defined at the middle of the window, so that a change of the rate does not change the robot times there.
        let clock = |steps: i64, skew: f64| ClockRelation {
            shift_s: coarse.shift_s + steps as f64 * self.step_s - skew * middle_s,
            skew,
        };
        // Number of rows at which the robot is at rest. `None` if they are less than [`AT_REST_MIN`] of the rows
        // within the robot's log.
        let rows_at_rest = |clock: &ClockRelation| {
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
        // Rates are tried from zero outwards, so that among equally good rates the rate nearest to zero is selected.
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

    /// Computes the poses of tracker and target from rows at standstills, for a fixed clock.
    pub(super) fn fit_at_standstills(
        &self,
        window: &Range<usize>,
        clock: ClockRelation,
    ) -> Option<TrackerFit> {
        let flange_and_position = |row: usize| {
            let flange = self.flange(clock.robot_time_s(self.observed_m.t_s[row]))?;
            Some((flange, self.observed_m[row]))
        };
        let (flanges, observed_m): (Vec<Pose>, Vec<Vector3<f64>>) =
            window.clone().filter_map(flange_and_position).unzip();
        let [tracker, probe] = placements(&flanges, &observed_m, std::iter::empty())?;
        let (tracker, probe_m) = (tracker.pose(), probe.position_m);
        // Each squared distance is the sum of squares of three residuals.
        let squared = flanges.iter().zip(&observed_m).map(|(flange, observed_m)| {
            let predicted = flange.transform_point(&probe_m.into());
            ((predicted - tracker.transform_point(&(*observed_m).into())).norm_squared(), 3)
        });
        Some(TrackerFit { clock, probe_m, spread_m: GoodShare::NINE_TENTHS.spread(squared) })
    }

    /// Match between the measured and the predicted distances from row to row, without a shift.
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
        // With this smallest overlap, only shift 0 is possible.
        let overlap_min = predicted_m.len().checked_sub(1)?;
        let matched = correlate(&distances(&predicted_m), &distances(&observed_m), overlap_min)?;
        let covered_s = predicted_m.len() as f64 / window.len().max(1) as f64 * self.duration_s(window);
        Some(Match { overlap: (covered_s / self.step_s) as usize, ..matched })
    }
}
