//! The bar's samples about the reference time: what relates them to the robot's log, and which of them are kept.

use shared::time::UtcNs;

use super::select::apart;
use super::speeds::STEP_S;
use super::timeline::Sample;
use super::{
    AnglePair, BarSegment, ClockFit, EncoderOffset, Fate, Match, Offsets, Predictor, PrepareError,
    PrepareOptions, Relation, SampleCounts, find_offsets, refine, select,
};
use crate::kinematics::BAR_JOINTS;
use crate::model::Observation;

/// Travel between samples from which offsets and clocks are found \[rad\].
const PAIRS_APART_RAD: f64 = 0.01;
/// Samples so near to an end or a hole of the robot's log \[s\] might leave it when a solve moves the clocks.
const EDGE_S: f64 = 0.03;
/// Fewest samples that a solve can begin with.
const KEPT_MIN: usize = 50;

/// Bar samples with their times from the reference time.
pub(super) struct Samples {
    all: Vec<(f64, [f64; BAR_JOINTS])>,
    /// Reference time after the segment's first sample \[s\].
    pub t_ref_s: f64,
    t_ref_ns: i64,
}

/// Which samples are kept, and what became of the others.
pub(super) struct Kept {
    indices: Vec<usize>,
    /// Of each sample of the segment.
    pub fates: Vec<Fate>,
}

impl Samples {
    pub fn new(segment: &BarSegment, matched: &Match, log_duration_s: f64) -> Self {
        let since_first_ns = |time: &UtcNs| segment.times.first().map_or(0, |first| time.ns_since(*first));
        let shift_s = matched.shift * STEP_S;
        let end_s = segment.times.last().map_or(0.0, |last| since_first_ns(last) as f64 * 1e-9);
        let overlap_s = [(-shift_s).max(0.0), (log_duration_s - shift_s).min(end_s)];
        let t_ref_ns = (0.5e9 * (overlap_s[0] + overlap_s[1])).round() as i64;
        let all = segment
            .times
            .iter()
            .zip(&segment.angles_rad)
            .map(|(time, angles)| ((since_first_ns(time) - t_ref_ns) as f64 * 1e-9, *angles))
            .collect();
        Self { all, t_ref_s: t_ref_ns as f64 * 1e-9, t_ref_ns }
    }

    pub fn t_ref(&self, segment: &BarSegment) -> UtcNs {
        segment.times.first().copied().unwrap_or_default().plus_ns(self.t_ref_ns)
    }

    pub fn observations(&self, kept: &Kept, measured: &[bool; BAR_JOINTS]) -> Vec<Observation> {
        kept.indices
            .iter()
            .filter_map(|&index| self.all.get(index))
            .map(|&(t_s, bar_rad)| Observation { t_s, bar_rad, measured: *measured, length_m: None })
            .collect()
    }

    fn angles(&self) -> Vec<[f64; BAR_JOINTS]> {
        self.all.iter().map(|(_, angles)| *angles).collect()
    }

    /// Samples spread over the motion, with what the robot's log predicts there.
    fn pairs(&self, predictor: &Predictor<'_>, clock: ClockFit, margin_rad: f64) -> Vec<(usize, AnglePair)> {
        apart(&self.angles(), PAIRS_APART_RAD)
            .into_iter()
            .filter_map(|index| {
                let (t_s, measured_rad) = *self.all.get(index)?;
                let predicted = predictor.at(clock.tau_s(t_s)).filter(|bar| bar.margin_rad > margin_rad)?;
                Some((index, AnglePair { measured_rad, predicted }))
            })
            .collect()
    }

    pub fn keep(
        &self,
        predictor: &Predictor<'_>,
        clock: ClockFit,
        margin_rad: f64,
        options: &PrepareOptions,
    ) -> Result<Kept, PrepareError> {
        let mut fates = vec![Fate::Outside; self.all.len()];
        let mut usable = Vec::new();
        for (index, (t_s, _)) in self.all.iter().enumerate() {
            let tau_s = clock.tau_s(*t_s);
            let around = [tau_s - EDGE_S, tau_s + EDGE_S].map(|tau_s| predictor.at(tau_s).is_some());
            match predictor.at(tau_s).filter(|_| around == [true, true]) {
                None => {}
                Some(bar) if bar.margin_rad <= margin_rad => fates[index] = Fate::Singular,
                Some(_) => {
                    fates[index] = Fate::Standstill;
                    usable.push(index);
                }
            }
        }
        let angles: Vec<[f64; BAR_JOINTS]> =
            usable.iter().filter_map(|&index| self.all.get(index)).map(|(_, angles)| *angles).collect();
        let motion_min_rad = options.motion_min_mrad * 1e-3;
        let of_all = |indices: Vec<usize>| -> Vec<usize> {
            indices.into_iter().filter_map(|index| usable.get(index).copied()).collect()
        };
        for index in of_all(apart(&angles, motion_min_rad)) {
            fates[index] = Fate::Surplus;
        }
        let indices = of_all(select(&angles, motion_min_rad, options.points_max));
        for &index in &indices {
            fates[index] = Fate::Kept;
        }
        if indices.len() < KEPT_MIN {
            let counts = SampleCounts::of(&fates);
            return Err(PrepareError::NothingLeft {
                kept: indices.len(),
                outside: counts.outside_robot_log,
                singular: counts.singular,
                standstill: counts.standstill,
            });
        }
        Ok(Kept { indices, fates })
    }

    /// The samples with offsets added, for drawing.
    pub fn drawn(&self, segment: &BarSegment, offsets_rad: &[f64; BAR_JOINTS]) -> Vec<Sample> {
        let samples = segment.cycles.iter().zip(&self.all).map(|(&cycle, (t_s, angles_rad))| Sample {
            cycle,
            t_s: *t_s,
            bar_rad: std::array::from_fn(|joint| angles_rad[joint] + offsets_rad[joint]),
        });
        samples.collect()
    }
}

/// Offsets at the coarse alignment, then everything refined, then judged.
pub(super) fn relate(
    predictor: &Predictor<'_>,
    samples: &Samples,
    measured: &[bool; BAR_JOINTS],
    coarse: ClockFit,
    margin_rad: f64,
    options: &PrepareOptions,
) -> Result<Relation, PrepareError> {
    let angles =
        |pairs: &[(usize, AnglePair)]| -> Vec<AnglePair> { pairs.iter().map(|(_, pair)| *pair).collect() };
    let pairs = samples.pairs(predictor, coarse, margin_rad);
    // A skewed clock spreads the angles of a long run: judged only after the clock is refined.
    let rough = find_offsets(&angles(&pairs), measured, f64::INFINITY)?;
    let moving: Vec<(f64, [f64; BAR_JOINTS])> =
        pairs.iter().filter_map(|(index, _)| samples.all.get(*index).copied()).collect();
    let start = Relation { clock: coarse, base_m: predictor.base_m(), offsets: rough };
    let refined = refine(predictor, &moving, &start);
    let predictor = predictor.clone().with_base(refined.base_m);
    let pairs = samples.pairs(&predictor, refined.clock, margin_rad);
    let judged = find_offsets(&angles(&pairs), measured, options.spread_max_mrad)?;
    let encoders = judged
        .encoders
        .iter()
        .zip(&refined.offsets.encoders)
        .map(|(judged, refined)| EncoderOffset { offset_rad: refined.offset_rad, ..*judged })
        .collect();
    let offsets = Offsets { configuration: refined.offsets.configuration, encoders };
    Ok(Relation { offsets, ..refined })
}
