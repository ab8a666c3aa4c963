//! Prepares a calibration: turns a recording and a robot log, each with its own clock, into samples and start
//! values of a solve.
//!
//! The only prior knowledge is the nominal geometry. The clock difference, the offsets of the encoders, the position of the
//! bar's base and the bar's configuration are unknown. Each step is a plain function on values:
//!
//! 1. [`bar_angles`] converts counts to angles and drops cycles without valid counts. If the counters lost their origin, the
//!    following readings belong to a new *origin* with its own offsets. [`unwrapped_log`] makes the angles of robot joints
//!    continuous if they wrap after a turn. Optionally, both logs are smoothed by a moving average
//!    ([`Stream::averages`](crate::logs::Stream::averages)).
//! 2. [`fit_sphere`] finds the position of the bar's base and the bar's length from the robot's positions.
//! 3. [`Predictor`] places the nominal bar at this base. It computes the bar's joints from the robot's
//!    log by inverse kinematics.
//! 4. `align::rate` estimates the relative rate of the clocks from short sections of the run. [`correlate`] then compares
//!    predicted with measured joint *speeds*. The magnitudes of the speeds do not depend on offsets, signs or
//!    configurations. The root of the sum of the squared speeds does not depend on the order of the joints either. The peaks
//!    of the cross-correlation are candidates for the clock difference, however large it is.
//! 5. At each candidate the angles are compared. [`find_encoder_map`] finds the joint and the direction of each encoder.
//!    `segments` then finds the offsets of each origin of the counters, and the configuration in each segment between
//!    singular poses. The candidate whose angles fit best is used.
//! 6. `refine` fits the clocks, the base and the offsets to the angles. In this fit, all parameters of both chains may
//!    change within their tolerances. The residuals of the fit show the outliers (`samples::angle_errors`). Changes during
//!    the run are normally found later, after the links have been calibrated (`calibrate::change`). Only changes so large
//!    that no fit succeeds are found here (`slip`, `parts`).
//! 7. [`select`] and [`spread_over_sphere`] choose the samples of the solve. Samples at standstill, near singular poses or
//!    beyond the wanted number are left out.
//! 8. If a force was measured, `forces` adds its component along the bar to each sample.
//!
//! The solve receives each sample in the configuration in which it was measured. A conversion to another
//! configuration would depend on the offsets, which are only estimates of the preparation. Only the [`Timeline`]
//! shows all samples in one configuration.
//!
//! Times stay integers until they are small differences, because the clocks may be decades apart.

mod align;
mod encoders;
mod error;
mod findings;
mod forces;
mod readings;
mod samples;
mod sphere;
mod steps;
mod timeline;
mod torque;

pub use align::aligned::AlignedLog;
pub use align::correlate::{Channels, Match, candidates, correlate};
pub use align::placement::{PROBE_SIGMA_M, Sighted, all_placements};
pub use align::predict::{PredictedBar, Predictor};
pub use align::tracker::{AlignedPoses, Moving, align_poses};
pub use encoders::encoder_map::{
    AnglePair, EncoderMap, EncoderMapChoice, EncoderMapReport, EncoderPlace, find_encoder_map,
};
pub use encoders::origins::OriginSpan;
pub use error::{ComparedLog, PrepareError};
pub use findings::{Deviations, Place, PoorFit};
pub use forces::{BarForces, ForceError};
pub use readings::averaged::{Averaged, AveragedJoints, AveragedPoint};
pub use readings::bar_angles::{BarAngles, BarReading, bar_angles};
pub use readings::standstill::{Jitter, MOVING_RAD_S, Standstill};
pub use readings::unwrap::{unwrapped_counters, unwrapped_log};
pub use samples::angle_errors::LocalShift;
pub use samples::select::{select, spread_over_sphere};
pub use sphere::{SphereFit, fit_sphere};
pub use steps::prepare;
pub use timeline::{SampleStatus, Timeline, TimelinePoint};

use std::collections::BTreeMap;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use shared::recording::schema::required;
use shared::time::UtcNs;

use crate::kinematics::BAR_JOINTS;
use crate::model::Observation;

/// Limits and sizes of the preparation. The defaults suit a run of half a minute to an hour.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PrepareOptions {
    /// Smallest correlation of the speeds at which two logs match (1 means identical). Logs of the same run reach 0.99; logs
    /// of different runs stay below 0.5.
    pub correlation_min: f64,
    /// Shortest allowed overlap of two logs \[s\].
    pub overlap_min_s: f64,
    /// Smallest overlap as a fraction of the duration of the shorter log.
    pub overlap_min_part: f64,
    /// Largest spread of the difference between measured and predicted angles (1.48 times the median deviation) \[mrad\].
    pub spread_max_mrad: f64,
    /// Largest distance of a robot position from the sphere at which the position still counts as lying on it \[mm\].
    pub sphere_tolerance_mm: f64,
    /// Largest difference of the sphere's radius from the bar's configured length \[mm\].
    pub length_tolerance_mm: f64,
    /// Samples nearer than this to a singular pose of the bar are left out \[deg\].
    pub singular_margin_deg: f64,
    /// Largest number of samples that are kept; 0 keeps all samples that move. The kept samples are spread over the sphere
    /// and, in each region of the sphere, over the order of the samples.
    pub points_max: usize,
    /// A sample is kept only if some bar joint has moved by at least this angle since the last kept sample \[mrad\].
    pub motion_min_mrad: f64,
    /// How joint and direction of each encoder are determined: `find`, `recorded`, or a list with the joint of each encoder.
    pub encoders: EncoderMapChoice,
    /// Width of a centred moving average over both logs \[ms\]; 0 for none. The thesis that introduced this method used 100
    /// ms. An average of this width preserves bends of the path ([`Stream::averages`](crate::logs::Stream::averages)); a
    /// much longer one does not.
    pub moving_average_ms: f64,
    /// Largest spread of the residuals of an encoder in the refined fit (1.48 times the median deviation) \[mrad\].
    pub fit_max_mrad: f64,
    /// Smallest required travel of every measured joint of the bar \[deg\].
    pub joint_travel_min_deg: f64,
    /// Limit for significant steps of an encoder or of a robot joint. Smaller steps are only reported; a run with a
    /// larger step is refused \[mrad\].
    pub slip_min_mrad: f64,
}

/// Offset of an encoder: angle of the joint minus angle of the encoder.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EncoderOffset {
    /// Bar joint, 1 to 5.
    pub joint: u8,
    /// Offset in (-pi, pi] \[rad\].
    pub offset_rad: f64,
    /// Robust standard deviation of the residuals of the refined fit: 1.48 times the median deviation \[rad\].
    pub spread_rad: f64,
}

impl Default for PrepareOptions {
    fn default() -> Self {
        Self {
            correlation_min: 0.85,
            overlap_min_s: required::OVERLAP_MIN_S,
            overlap_min_part: 0.25,
            spread_max_mrad: 50.0,
            sphere_tolerance_mm: 20.0,
            length_tolerance_mm: 50.0,
            singular_margin_deg: 5.0,
            points_max: 1500,
            motion_min_mrad: 2.0,
            encoders: EncoderMapChoice::Find,
            moving_average_ms: 0.0,
            fit_max_mrad: 3.0,
            joint_travel_min_deg: required::TRAVEL_MIN_DEG,
            slip_min_mrad: 0.3,
        }
    }
}

/// Number of bar cycles by status.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SampleCounts(BTreeMap<SampleStatus, usize>);

impl SampleCounts {
    /// Counts the statuses of all cycles.
    pub fn count(statuses: &[SampleStatus]) -> Self {
        let mut counts = Self::default();
        for status in statuses {
            *counts.0.entry(*status).or_default() += 1;
        }
        counts
    }

    /// Number of cycles with this status.
    pub fn of(&self, status: SampleStatus) -> usize {
        self.0.get(&status).copied().unwrap_or_default()
    }

    /// Number of all cycles of the recording.
    pub fn recorded(&self) -> usize {
        self.0.values().sum()
    }
}

/// How the two logs were aligned.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Alignment {
    /// Correlation of the speeds at the best shift.
    pub correlation: f64,
    /// Highest correlation at any clearly different shift.
    pub runner_up: f64,
    /// Whether the angles fit equally well at another shift, which occurs if the motion repeats. In this case, the
    /// shift with the longest overlap was chosen. The resulting geometry is the same for all these shifts, but the
    /// clock difference is not.
    pub ambiguous: bool,
    /// Duration of the overlap of the logs \[s\].
    pub overlap_s: f64,
    /// Robot clock minus the clock of the bar or tracker, at the reference time \[ns\].
    pub clock_difference_ns: i64,
    /// Relative rate of the robot's clock minus one, estimated from the angles or positions.
    pub skew: f64,
}

impl Alignment {
    /// Robot clock minus the clock of the bar or tracker at the reference time \[ns\], corrected by the shift `shift_s` that
    /// a solve has estimated \[s\].
    pub fn solved_difference_ns(&self, shift_s: f64) -> i64 {
        self.clock_difference_ns.saturating_add((shift_s * 1e9).round() as i64)
    }
}

/// Samples that are ready for a solve, and the start values of the solve: centre of the gimbal, offsets of the encoders,
/// and skew of the clocks.
#[derive(Debug, Clone, PartialEq)]
pub struct Prepared {
    /// Reference time on the bar's clock: the middle of the overlap.
    pub t_ref: UtcNs,
    /// Time of the first valid sample of the recording, counted from `t_ref` \[s\]. Times in messages count from it.
    pub first_s: f64,
    /// The samples of the solve: times since `t_ref`, and encoder angles to which the offsets have not been added.
    pub observations: Vec<Observation>,
    /// The robot's motion as a function of robot time. According to the alignment, this time is zero at `t_ref`.
    pub motion: AlignedLog,
    /// Bar joints with an encoder.
    pub measured: [bool; BAR_JOINTS],
    /// Centre of the gimbal in the robot's base \[m\].
    pub base_m: Vector3<f64>,
    /// The relation of the clocks, and how well the logs match.
    pub alignment: Alignment,
    /// Offset of each encoder, and the spread of its residuals.
    pub offsets: Vec<EncoderOffset>,
    /// The sphere on which the robot's positions lie.
    pub sphere: SphereFit,
    /// Number of samples by status.
    pub counts: SampleCounts,
    /// Overview of the run for reports.
    pub timeline: Timeline,
    /// Joint and direction of each encoder, and alternatives that fit.
    pub encoder_map: EncoderMapReport,
    /// Sections of the recording between two changes of the counters' origin, in the order of time.
    pub origins: Vec<OriginSpan>,
    /// How the alignment varies along the run: one value for about every 5 s.
    pub local_shifts: Vec<LocalShift>,
    /// Residuals, present only if the angles fit no geometry near the nominal one. The solve then searches for a
    /// change during the run.
    pub poor_fit: Option<PoorFit>,
    /// The force on the bar, if it was measured.
    pub force: Option<BarForces>,
}

impl Prepared {
    /// Wraps samples that need no preparation: all times are on one clock, the angles are measured from the encoders'
    /// reference marks, and the links are nearly nominal. The bar's base is at `base_m`.
    pub fn aligned(
        t_ref: UtcNs,
        observations: Vec<Observation>,
        motion: AlignedLog,
        measured: [bool; BAR_JOINTS],
        base_m: Vector3<f64>,
    ) -> Self {
        let kept = observations.len();
        let [first_s, last_s] =
            [observations.first(), observations.last()].map(|sample| sample.map_or(0.0, |sample| sample.t_s));
        let overlap_s = last_s - first_s;
        Self {
            t_ref,
            first_s,
            observations,
            motion,
            measured,
            base_m,
            alignment: Alignment { correlation: 1.0, overlap_s, ..Alignment::default() },
            offsets: Vec::new(),
            sphere: SphereFit { centre_m: base_m, inliers: 1.0, ..SphereFit::default() },
            counts: SampleCounts([(SampleStatus::Kept, kept)].into()),
            timeline: Timeline::default(),
            encoder_map: EncoderMapReport::default(),
            origins: Vec::new(),
            local_shifts: Vec::new(),
            poor_fit: None,
            force: None,
        }
    }
}
