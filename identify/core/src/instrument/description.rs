//! Descriptions of an instrument for reports: the source of its scale, its noise, and groups of its samples.

use crate::cost::AngleNoise;
use crate::model::{Model, ModelError, ParameterId, Role};

/// Samples that were measured with the same part of the instrument, such as a station.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Section {
    /// Name of the section in reports.
    pub name: String,
    /// Prefix of the names of the parameters of this part.
    pub parameters: String,
    /// All samples of the section, including those that the fit does not use.
    pub samples: Vec<usize>,
}

/// Quantity that determines the scale of all lengths.
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
    /// The robot's file alone, because no measured quantity determines the scale.
    Robot,
}

impl ScaleFrom {
    /// Standard uncertainty of the scale for a typical instrument of this type \[ppm\]. Zero if the uncertainty of the scale
    /// follows from the uncertainties of known lengths.
    ///
    /// Laser trackers have an error limit of 15 um + 6 um/m (k = 2), of which the second term is a standard uncertainty
    /// of 3 ppm. The air changes the wavelength by 1 ppm/K and 0.27 ppm/hPa. Draw-wires have an error limit of 0.1 % of
    /// their range. If all errors within this limit are equally probable, the standard uncertainty is 577 ppm.
    /// Calibrated draw-wires have 100 to 200 ppm.
    pub const fn usual_u_ppm(self) -> f64 {
        match self {
            Self::Tracker => 5.0,
            Self::Wire => 500.0,
            Self::Plate | Self::Sockets | Self::Faces | Self::Robot => 0.0,
        }
    }
}

/// Gives the scale a prior with this standard uncertainty. If the uncertainty is zero or the scale is in
/// `fix`, the scale is exact and fixed.
pub(super) fn set_scale_prior(model: &mut Model, u_ppm: f64, fix: &[ParameterId]) -> Result<(), ModelError> {
    let is_exact = u_ppm == 0.0 || fix.contains(&ParameterId::Scale);
    let role = if is_exact { Role::Fixed } else { Role::Prior { value: 0.0, sigma: u_ppm * 1e-6 } };
    model.set_role(ParameterId::Scale, role)
}

/// Standard deviation of one reading.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Noise {
    /// Angles of bar encoders and robot joints.
    Angles(AngleNoise),
    /// A coordinate or a length \[m\].
    Length(f64),
}

/// Returns a text with the name of the part that fits a sample best. Empty if this is the part `own`, to which the sample
/// belongs. `off_m` returns the distance of the sample from a part \[m\].
pub(super) fn nearest(names: &[String], own: usize, off_m: impl Fn(usize) -> f64) -> String {
    let nearest = (0..names.len()).min_by(|a, b| off_m(*a).total_cmp(&off_m(*b)));
    nearest.filter(|part| *part != own).map_or_else(String::new, |part| {
        format!(", {:.2} mm from `{}`: look for a wrong name", off_m(part) * 1e3, names[part])
    })
}
