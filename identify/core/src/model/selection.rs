//! Named sets of free parameters.

use super::{Group, Model, ParameterId};
use crate::kinematics::{Chain, LinkParameter};

/// Fixed in the thesis to make the remaining parameters identifiable (TFRT-6017 section 3.3): the offset plate, which defines
/// the scale (`ra6`, `ba5`), and one parameter of each dependent pair.
pub const THESIS_FIXED: [&str; 9] =
    ["ra6", "ba5", "rd1", "bd1", "rd3", "rtheta1", "bd5", "balpha2", "balpha5"];

/// Which parameters of a ball-bar model are free.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Selection {
    /// The 38 parameters of the thesis: robot and bar links and the bar's position, without [`THESIS_FIXED`].
    Thesis,
    /// [`Self::Thesis`] with clock shift and skew, for logs on two clocks.
    ThesisWithClocks,
    /// The 38 of the thesis and two rotations of the bar's base, which is never exactly parallel to the robot's in a real cell.
    Cell,
    /// [`Self::Cell`] with clock shift and skew, for logs on two clocks.
    CellWithClocks,
}

impl Selection {
    /// Whether the selection contains a parameter, regardless of what a cost can identify.
    pub fn contains(self, id: ParameterId) -> bool {
        match id {
            // Hayati's rotation is freed by name only, in place of the link's d.
            ParameterId::Robot { parameter: LinkParameter::Beta, .. } => false,
            ParameterId::Robot { .. } | ParameterId::Bar { .. } | ParameterId::Base { .. } => {
                !THESIS_FIXED.contains(&id.to_string().as_str())
            }
            ParameterId::BaseRotation { .. } => matches!(self, Self::Cell | Self::CellWithClocks),
            // The samples alone do not separate all others from the geometry: they have priors, or are freed with a measured
            // force, or belong to another instrument.
            _ => id.group() == Group::Clock && matches!(self, Self::ThesisWithClocks | Self::CellWithClocks),
        }
    }
}

impl Model {
    /// Frees the parameters that a selection contains and a cost identifies; fixes the rest. Pass
    /// [`crate::cost::Residual::identifies`] as `identifies`.
    pub fn select(&mut self, selection: Selection, identifies: impl Fn(ParameterId, &Chain) -> bool) {
        let (plate, robot) = (ParameterId::plate(self.axes()), self.robot().clone());
        self.free_only(|id| selection.contains(id) && id != plate && identifies(id, &robot));
    }
}
