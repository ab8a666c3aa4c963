//! Named sets of free parameters.

use super::{Group, Model, ParameterId};
use crate::kinematics::{Chain, LinkParameter};

/// Fixed in the thesis to make the remaining parameters identifiable (TFRT-6017 section 3.3), on a robot with `axes` axes: the
/// offset plate, which defines the scale (`ra6` of six axes, `ba5`), and one parameter of each dependent pair.
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

/// Which parameters of a ball-bar model are free.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Selection {
    /// The 38 parameters of the thesis: robot and bar links and the bar's position, without [`thesis_fixed`].
    Thesis,
    /// [`Self::Thesis`] with clock shift and skew, for logs on two clocks.
    ThesisWithClocks,
    /// The 38 of the thesis and two rotations of the bar's base, which is never exactly parallel to the robot's in a real cell.
    Cell,
    /// [`Self::Cell`] with clock shift and skew, for logs on two clocks.
    CellWithClocks,
}

impl Selection {
    /// Whether the selection for a robot with `axes` axes contains a parameter, regardless of what a cost can identify.
    pub fn contains(self, id: ParameterId, axes: usize) -> bool {
        match id {
            // Hayati's rotation is freed by name only, in place of the link's d.
            ParameterId::Robot { parameter: LinkParameter::Beta, .. } => false,
            ParameterId::Robot { .. } | ParameterId::Bar { .. } | ParameterId::Base { .. } => {
                !thesis_fixed(axes).contains(&id)
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
        let robot = self.robot().clone();
        self.free_only(|id| selection.contains(id, robot.links.len()) && identifies(id, &robot));
    }
}
