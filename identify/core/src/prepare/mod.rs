//! From a recording and a robot log, each on its own clock, to samples and start values of a solve.
//!
//! At the beginning only the nominal geometry is known. Unknown are the clocks, the encoders' offsets, the bar's place and its
//! configuration. The steps, each a plain function on values:
//!
//! 1. [`bar_angles`] converts counts to angles, drops bad cycles and splits runs where counters lost their origin.
//!    [`unwrapped_log`] makes joints continuous that wrap after a turn. A moving average of both logs is optional
//!    ([`Stream::averages`](crate::logs::Stream::averages)).
//! 2. [`fit_sphere`] finds the bar's base and length from the robot's own positions.
//! 3. [`Predictor`] computes the bar's joints from the robot's log with these, by nominal inverse kinematics of the bar.
//! 4. [`correlate`] compares predicted with measured joint *speeds*. Their magnitudes do not depend on offsets, signs or
//!    configurations, and the root of the sum of their squares does not depend on the order of the joints. The cross-correlation
//!    gives candidates for the clock difference, whatever its size. The relative rate of the clocks is found first, from short
//!    parts of the run (`align::rate`).
//! 5. At each candidate the angles are compared. [`find_encoder_map`] finds the joint and the direction of each encoder. Offsets
//!    and configurations follow for each segment between singular poses and changes of origin (`segments`). The candidate whose
//!    angles fit best is taken.
//! 6. `refine` fits clocks, base and offsets to the angles, and lets all numbers of both chains move within their tolerances.
//!    Residuals of this fit show the outliers (`samples::angle_errors`). Changes during the run are found later, with calibrated
//!    links (`calibrate::change`), except those so large that nothing fits (`slip`, `parts`).
//! 7. [`select`], [`spread_over_sphere`]: samples at standstill, near singular poses or beyond the wanted number are left out.
//! 8. Where a force was measured, each sample gets its component along the bar (`forces`).
//!
//! The solve gets each sample in the configuration in which it was measured: a conversion would include the offsets of the
//! preparation in it. Only the [`Timeline`] shows all samples in one configuration.
//!
//! Times stay integers until they are small differences: the clocks may be decades apart.

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
pub(crate) use align::placement::nearest_rotation;
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
    /// Smallest correlation of speeds at which two logs match (1 is identical). Runs of the same experiment reach 0.99;
    /// different runs stay below 0.5.
    pub correlation_min: f64,
    /// Shortest overlap of two logs \[s\].
    pub overlap_min_s: f64,
    /// Smallest overlap as a part of the shorter log.
    pub overlap_min_part: f64,
    /// Largest difference of measured and predicted angles (1.48 times the median deviation) \[mrad\].
    pub spread_max_mrad: f64,
    /// Largest distance of the robot's positions from one sphere \[mm\].
    pub sphere_tolerance_mm: f64,
    /// Largest difference of the sphere's radius from the bar's configured length \[mm\].
    pub length_tolerance_mm: f64,
    /// Samples nearer to a singular pose of the bar are left out \[deg\].
    pub singular_margin_deg: f64,
    /// Largest number of samples that are kept, spread over the sphere and, on each part of it, over the motion; 0 keeps all
    /// that move.
    pub points_max: usize,
    /// Samples are kept only where some bar joint has moved by this much since the last one \[mrad\].
    pub motion_min_mrad: f64,
    /// Joint and direction of each encoder: `find`, `recorded`, or stated one by one.
    pub encoders: EncoderMapChoice,
    /// Width of a centred moving average over both logs \[ms\]; 0 for none. The thesis of this method used 100 ms. An average of
    /// this width preserves bends of the path ([`Stream::averages`](crate::logs::Stream::averages)); a much longer one does not.
    pub moving_average_ms: f64,
    /// Largest residual of angles from the refined fit (1.48 times the median deviation) \[mrad\].
    pub fit_max_mrad: f64,
    /// Smallest travel of every measured joint of the bar \[deg\].
    pub joint_travel_min_deg: f64,
    /// Significant steps of an encoder or of a robot joint that are smaller than this are reported; larger ones refuse a run
    /// \[mrad\].
    pub slip_min_mrad: f64,
}

/// Angle of a joint minus that of its encoder.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EncoderOffset {
    /// Bar joint, 1 to 5.
    pub joint: u8,
    /// Offset in (-pi, pi] \[rad\].
    pub offset_rad: f64,
    /// 1.48 times the median deviation from the refined fit \[rad\]: a robust standard deviation.
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
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SampleCounts {
    /// All cycles of the recording.
    pub recorded: usize,
    /// Cycles with stale or invalid counts.
    pub invalid: usize,
    /// With a time stamp not later than the one before.
    pub time_not_increasing: usize,
    /// Between two changes of the counters' origin that are too close to find the offsets.
    pub other_origin: usize,
    /// Nearer to an end or a hole than the width of the moving average, if there is one.
    pub not_averaged: usize,
    /// At times that the robot's log does not cover.
    pub outside_robot_log: usize,
    /// Near singular poses of the bar.
    pub singular: usize,
    /// Neither robot nor bar moves.
    pub standstill: usize,
    /// Beyond the wanted number of samples.
    pub thinned: usize,
    /// With angles that do not fit those of their neighbours.
    pub outliers: usize,
    /// Without a force, if others have one.
    pub no_force: usize,
    /// Kept for the solve.
    pub kept: usize,
}

impl SampleCounts {
    /// Counts the statuses of all cycles.
    pub fn count(statuses: &[SampleStatus]) -> Self {
        let mut counts = Self { recorded: statuses.len(), ..Self::default() };
        for status in statuses {
            *match status {
                SampleStatus::Thinned => &mut counts.thinned,
                SampleStatus::Standstill => &mut counts.standstill,
                SampleStatus::NotAveraged => &mut counts.not_averaged,
                SampleStatus::Outside => &mut counts.outside_robot_log,
                SampleStatus::OtherOrigin => &mut counts.other_origin,
                SampleStatus::Singular => &mut counts.singular,
                SampleStatus::Kept => &mut counts.kept,
                SampleStatus::Invalid => &mut counts.invalid,
                SampleStatus::TimeNotIncreasing => &mut counts.time_not_increasing,
                SampleStatus::Outlier => &mut counts.outliers,
                SampleStatus::NoForce => &mut counts.no_force,
            } += 1;
        }
        counts
    }
}

/// How the two logs were aligned.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Alignment {
    /// Correlation of the speeds at the best shift.
    pub correlation: f64,
    /// Best correlation at a clearly different shift.
    pub runner_up: f64,
    /// The angles fit as well at another shift: the motion repeats, and the shift with the longest overlap was taken. The geometry
    /// is the same either way, the clocks are not.
    pub ambiguous: bool,
    /// Duration of the overlap of the logs \[s\].
    pub overlap_s: f64,
    /// Robot clock minus the other clock, of bar or tracker, at the reference time \[ns\].
    pub clock_difference_ns: i64,
    /// Relative rate of the robot's clock minus one, from the angles.
    pub skew: f64,
}

impl Alignment {
    /// Robot clock minus the other one at the reference time \[ns\], with the shift that a solve has found.
    pub fn solved_difference_ns(&self, shift_s: f64) -> i64 {
        self.clock_difference_ns.saturating_add((shift_s * 1e9).round() as i64)
    }
}

/// Samples ready for a solve, with its start values: the centre of the gimbal, the offsets, and the skew of the alignment.
#[derive(Debug, Clone, PartialEq)]
pub struct Prepared {
    /// Reference time on the bar's clock: the middle of the overlap.
    pub t_ref: UtcNs,
    /// Times relative to `t_ref`, angles without offsets.
    pub observations: Vec<Observation>,
    /// The robot's motion; by the alignment its time is zero at `t_ref`.
    pub motion: AlignedLog,
    /// Bar joints with an encoder.
    pub measured: [bool; BAR_JOINTS],
    /// Centre of the gimbal in the robot's base \[m\].
    pub base_m: Vector3<f64>,
    /// The clocks and how well the logs match.
    pub alignment: Alignment,
    /// Offset of each encoder and how well it fits the prediction.
    pub offsets: Vec<EncoderOffset>,
    /// The sphere on which the robot moved.
    pub sphere: SphereFit,
    /// Number of samples by status.
    pub counts: SampleCounts,
    /// Overview of the run for reports.
    pub timeline: Timeline,
    /// Joint and direction of each encoder, and alternatives that fit.
    pub encoder_map: EncoderMapReport,
    /// Parts of the recording between two changes of the counters' origin, in the order of time.
    pub origins: Vec<OriginSpan>,
    /// How the alignment varies along the run, about every 5 s.
    pub local_shifts: Vec<LocalShift>,
    /// Residuals, if the angles fit no geometry near the nominal one. The solve then looks for a change during the run.
    pub poor_fit: Option<PoorFit>,
    /// The force on the bar, if it was measured.
    pub force: Option<BarForces>,
}

impl Prepared {
    /// Samples that need no preparation: on one clock, angles from the encoders' marks, near nominal links, with the bar at `base_m`.
    pub fn aligned(
        t_ref: UtcNs,
        observations: Vec<Observation>,
        motion: AlignedLog,
        measured: [bool; BAR_JOINTS],
        base_m: Vector3<f64>,
    ) -> Self {
        let kept = observations.len();
        let overlap_s =
            observations.last().zip(observations.first()).map_or(0.0, |(last, first)| last.t_s - first.t_s);
        Self {
            t_ref,
            observations,
            motion,
            measured,
            base_m,
            alignment: Alignment { correlation: 1.0, overlap_s, ..Alignment::default() },
            offsets: Vec::new(),
            sphere: SphereFit { centre_m: base_m, inliers: 1.0, ..SphereFit::default() },
            counts: SampleCounts { recorded: kept, kept, ..SampleCounts::default() },
            timeline: Timeline::default(),
            encoder_map: EncoderMapReport::default(),
            origins: Vec::new(),
            local_shifts: Vec::new(),
            poor_fit: None,
            force: None,
        }
    }

    /// Time of the first valid sample \[s\].
    pub fn first_s(&self) -> f64 {
        self.timeline.points.first().map_or(0.0, |point| point.t_s)
    }
}
