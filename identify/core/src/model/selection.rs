//! Named sets of free parameters.

use super::{Group, Model, ParameterId};
use crate::kinematics::LinkParameter;

/// Fixed by the thesis so that the rest is determined (TFRT-6017 section 3.3): the offset plate as the scale
/// (`ra6`, `ba5`), and one of each dependent pair.
pub const THESIS_FIXED: [&str; 9] =
    ["ra6", "ba5", "rd1", "bd1", "rd3", "rtheta1", "bd5", "balpha2", "balpha5"];

/// Which parameters of a ball-bar model are free.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Selection {
    /// The thesis' 38: robot and bar links and the bar's place, without [`THESIS_FIXED`].
    Thesis,
    /// And clock shift and skew, for logs on two clocks.
    ThesisWithClocks,
    /// The thesis' 38 and the two rotations of the bar's base, which is never parallel to the robot's in a real cell.
    Cell,
    /// And clock shift and skew, for logs on two clocks.
    CellWithClocks,
}

impl Selection {
    /// The parameters in question, whatever a cost can identify.
    pub fn contains(self, id: ParameterId) -> bool {
        match id {
            // Hayati's rotation is opted into by name, in place of the link's d.
            ParameterId::Robot { parameter: LinkParameter::Beta, .. } => false,
            ParameterId::Robot { .. } | ParameterId::Bar { .. } | ParameterId::Base { .. } => {
                !THESIS_FIXED.contains(&id.to_string().as_str())
            }
            ParameterId::BaseRotation { .. } => matches!(self, Self::Cell | Self::CellWithClocks),
            // All others are not separated from the geometry by samples alone and come with priors, or are freed where there is
            // a force, or of another instrument.
            _ => id.group() == Group::Clock && matches!(self, Self::ThesisWithClocks | Self::CellWithClocks),
        }
    }
}

impl Model {
    /// Frees what a selection contains and a cost identifies, fixes the rest. `identifies` is [`crate::cost::Residual::identifies`].
    pub fn select(&mut self, selection: Selection, identifies: impl Fn(ParameterId) -> bool) {
        let plate = ParameterId::plate(self.axes());
        self.free_only(|id| selection.contains(id) && id != plate && identifies(id));
    }
}
