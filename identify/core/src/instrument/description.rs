//! Descriptions of an instrument for reports: sources of its scale, its noise, groups of its samples, and reasons why its figures
//! may be wrong.

use super::Contradiction;
use crate::cost::AngleNoise;
use crate::prepare::EncoderMap;

/// Samples that share a part of the instrument, such as a station.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Section {
    /// Name of the section in reports.
    pub name: String,
    /// Prefix of the names of its parameters.
    pub parameters: String,
    /// Its samples, used or not.
    pub samples: Vec<usize>,
}

/// Reason why the figures of a data set may be wrong.
#[derive(Debug, Clone, PartialEq)]
pub enum Doubt {
    /// The encoder map or a counting direction differs from that of the recording.
    OtherEncoders(EncoderMap),
    /// Another time alignment fits nearly as well, because the motion repeats.
    MotionRepeats,
    /// Rows contradict the table of sockets or faces.
    OtherTable(Vec<Contradiction>),
}

/// Source of the scale of all lengths.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ScaleFrom {
    /// Dimensions of the ball-bar.
    Plate,
    /// Positions measured by the tracker.
    Tracker,
    /// Lengths measured by the wire.
    Wire,
    /// Table of the sockets.
    Sockets,
    /// Known distances between faces.
    Faces,
    /// The robot's file alone: nothing measured has a scale.
    Robot,
}

/// Standard deviation of a reading.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Noise {
    /// Bar encoders and robot joints.
    Angles(AngleNoise),
    /// A coordinate or a length \[m\].
    Length(f64),
}

impl Section {
    /// One section for each named part, with parameters numbered from 1; `part_of` yields the part of each sample, from 0.
    pub(super) fn each(
        names: &[String],
        parameters: &str,
        part_of: impl Iterator<Item = usize>,
    ) -> Vec<Self> {
        let mut sections: Vec<Self> = (1..)
            .zip(names)
            .map(|(number, name)| Self {
                name: name.clone(),
                parameters: format!("{parameters}{number}"),
                samples: Vec::new(),
            })
            .collect();
        for (sample, part) in part_of.enumerate() {
            if let Some(section) = sections.get_mut(part) {
                section.samples.push(sample);
            }
        }
        sections
    }
}

/// Text that names the other part which a sample fits best; `off_m` returns its distance from each part. Empty if its own is
/// nearest.
pub(super) fn nearest(names: &[String], own: usize, off_m: impl Fn(usize) -> f64) -> String {
    let nearest = (0..names.len()).min_by(|a, b| off_m(*a).total_cmp(&off_m(*b)));
    nearest.filter(|part| *part != own).map_or_else(String::new, |part| {
        format!(", {:.2} mm from `{}`: look for a wrong name", off_m(part) * 1e3, names[part])
    })
}
