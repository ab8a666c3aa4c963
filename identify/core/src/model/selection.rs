//! Named sets of free parameters.

use super::{Group, Model, ParameterId};
use crate::kinematics::{Chain, LinkParameter};

/// Parameters that the thesis fixes so that the remaining parameters are identifiable (TFRT-6017 section 3.3), for a robot
/// with `axes` axes. They are the lengths of the offset plate, which define the scale (`ra6` for six axes, and `ba5`), and
/// one parameter of each pair of dependent parameters.
pub const fn thesis_fixed(axes: usize) -> [ParameterId; 9] {
    use LinkParameter::{A, Alpha, D, Theta};
    const fn robot(number: usize, parameter: LinkParameter) -> ParameterId {
        ParameterId::Robot { link: number - 1, parameter }
    }
    const fn bar(number: usize, parameter: LinkParameter) -> ParameterId {
        ParameterId::Bar { link: number - 1, parameter }
    }
    [
        ParameterId::plate(axes),
        bar(5, A),
        robot(1, D),
        bar(1, D),
        robot(3, D),
        robot(1, Theta),
        bar(5, D),
        bar(2, Alpha),
        bar(5, Alpha),
    ]
}

/// Named sets of free parameters of a ball-bar model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Selection {
    /// The 38 parameters of the thesis: robot and bar links and the bar's position, except [`thesis_fixed`].
    Thesis,
    /// [`Self::Thesis`] with clock shift and skew, for logs on two clocks.
    ThesisWithClocks,
    /// [`Self::Thesis`] with two rotations of the bar's base, because the bar's base is never exactly parallel to that of
    /// the robot in a real cell.
    Cell,
    /// [`Self::Cell`] with clock shift and skew, for logs on two clocks.
    CellWithClocks,
}

impl Selection {
    /// Whether the selection contains a parameter, for a robot with `axes` axes. The answer does not depend on the cost.
    pub fn contains(self, id: ParameterId, axes: usize) -> bool {
        match id {
            // Hayati's rotation replaces the link's `d`. It is freed only by name.
            ParameterId::Robot { parameter: LinkParameter::Beta, .. } => false,
            ParameterId::Robot { .. } | ParameterId::Bar { .. } | ParameterId::Base { .. } => {
                !thesis_fixed(axes).contains(&id)
            }
            ParameterId::BaseRotation { .. } => matches!(self, Self::Cell | Self::CellWithClocks),
            // Samples alone cannot determine any other parameter separately. Such parameters have priors, are freed together
            // with a measured force, or belong to another instrument.
            _ => id.group() == Group::Clock && matches!(self, Self::ThesisWithClocks | Self::CellWithClocks),
        }
    }
}

impl Model {
    /// Frees the parameters that are in the selection and that the cost identifies, and fixes all others. `identifies` is
    /// [`crate::cost::Residual::identifies`] of the cost.
    pub fn select(&mut self, selection: Selection, identifies: impl Fn(ParameterId, &Chain) -> bool) {
        let robot = self.robot().clone();
        self.free_only(|id| selection.contains(id, robot.links.len()) && identifies(id, &robot));
    }
}
