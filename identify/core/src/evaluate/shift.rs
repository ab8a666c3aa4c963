//! The gap between robot and bar if one log is shifted in time. The curve shows the quality of the alignment, as figure 5.5
//! of the thesis does.

use crate::cost::loop_closures;
use crate::model::{Geometry, Observation, RobotMotion};
use crate::statistics::rms;

/// Gap between robot and bar as a function of an added time shift.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ShiftCurve {
    /// Shifts added to the robot's clock \[s\], ascending.
    pub shift_s: Vec<f64>,
    /// Root mean square distance of the robot's end from the bar's end \[m\].
    pub rms_m: Vec<f64>,
    /// Time shift at the vertex of a parabola through the minimum \[s\]. `None` if the minimum is at an end of the curve.
    pub minimum_s: Option<f64>,
}

/// Maximum number of samples of a curve. More samples do not change it visibly.
const SAMPLES_MAX: usize = 300;

/// Computes the curve at `2 steps + 1` shifts from `-reach_s` to `reach_s`. All parameters except the shift
/// are those of `geometry`.
pub fn shift_curve(
    geometry: &Geometry,
    motion: &impl RobotMotion,
    observations: &[Observation],
    reach_s: f64,
    steps: usize,
) -> ShiftCurve {
    let every = observations.len().div_ceil(SAMPLES_MAX).max(1);
    let sparse: Vec<Observation> = observations.iter().step_by(every).copied().collect();
    let mut curve = ShiftCurve::default();
    for step in 0..=2 * steps {
        let shift_s = reach_s * (step as f64 / steps as f64 - 1.0);
        let mut moved = geometry.clone();
        moved.clock.shift_s += shift_s;
        let closures = loop_closures(&moved, motion, &sparse);
        if closures.is_empty() {
            continue;
        }
        curve.shift_s.push(shift_s);
        curve.rms_m.push(rms(closures.iter().map(|closure| closure.position_error_m.norm())));
    }
    curve.minimum_s = minimum(&curve.shift_s, &curve.rms_m);
    curve
}

/// Time shift at the minimum of the curve. Squared gaps are quadratic in the shift. A parabola is therefore drawn through
/// the smallest squared gap and its two neighbours, and the result is its vertex.
fn minimum(shift_s: &[f64], rms_m: &[f64]) -> Option<f64> {
    let least = (0..rms_m.len()).min_by(|&a, &b| rms_m[a].total_cmp(&rms_m[b]))?;
    let square = |index: usize| rms_m.get(index).map(|rms| rms * rms);
    let (left, here, right) = (square(least.checked_sub(1)?)?, square(least)?, square(least + 1)?);
    let step_s = shift_s.get(least + 1)? - shift_s.get(least)?;
    let curvature = left - 2.0 * here + right;
    (curvature > 0.0).then(|| shift_s[least] + 0.5 * step_s * (left - right) / curvature)
}
