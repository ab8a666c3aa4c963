//! Simulates simultaneous angles of robot and bar, without clocks and counters, as in the simulations of the thesis.

use super::{BarPath, Experiment, SimulateError, Truth};
use crate::kinematics::{BAR_JOINTS, Joints};

/// Number of additional rows of the robot before the first pair and after the last pair. They are needed to interpolate the
/// robot's motion at both ends.
pub const LEAD_ROWS: usize = 4;

/// Simultaneous readings of robot and bar.
#[derive(Debug, Clone, PartialEq)]
pub struct Pairs {
    /// Time of each row of the robot \[s\], evenly spaced. The path starts at 0.
    pub t_s: Vec<f64>,
    /// The robot's joints \[rad\]. At each end there are [`LEAD_ROWS`] rows that belong to no pair.
    pub robot_rad: Vec<Joints>,
    /// The bar's joints, one row for each pair \[rad\].
    pub bar_rad: Vec<[f64; BAR_JOINTS]>,
    /// True parameters of robot and bar.
    pub truth: Truth,
}

/// Simulates `count` pairs, evenly spaced in time along a path. `start_rad` are joints of the robot near the start of the
/// path. The bar is sampled later than the robot by `time_difference_s`.
///
/// # Errors
/// [`SimulateError`].
pub fn pairs(
    experiment: &Experiment<'_>,
    path: &(impl BarPath + ?Sized),
    start_rad: Joints,
    count: usize,
    time_difference_s: f64,
) -> Result<Pairs, SimulateError> {
    let (truth, motion, _) = experiment.motion(path, start_rad)?;
    let step_s = path.duration_s() / count.saturating_sub(1).max(1) as f64;
    let t_s: Vec<f64> =
        (0..count + 2 * LEAD_ROWS).map(|row| (row as f64 - LEAD_ROWS as f64) * step_s).collect();
    let mut reading = experiment.robot_reading();
    let mut near_rad = motion.start_rad;
    let mut robot_rad = Vec::with_capacity(t_s.len());
    for &t_s in &t_s {
        near_rad =
            motion.robot_joints(t_s, &near_rad).map_err(|source| SimulateError::Follow { t_s, source })?;
        robot_rad.push(reading.read(&near_rad));
    }
    let mut reading = experiment.bar_reading();
    let of_pairs = t_s.iter().skip(LEAD_ROWS).take(count);
    let bar_rad = of_pairs.map(|t_s| reading.read(&path.bar_rad(t_s + time_difference_s))).collect();
    Ok(Pairs { t_s, robot_rad, bar_rad, truth })
}
