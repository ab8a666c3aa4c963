//! Costs of the ball-bar, which differ in the quantities that they compare, and the noise of the ball-bar's angles.

pub(in crate::cost) mod angle_noise;
pub(in crate::cost) mod closure;
pub(in crate::cost) mod fill_in;
pub(in crate::cost) mod length;
pub(in crate::cost) mod pose;
pub(in crate::cost) mod position;
pub(in crate::cost) mod position_angles;
pub(in crate::cost) mod transform;
