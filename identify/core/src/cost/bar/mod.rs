//! Costs of the ball-bar: the compared quantities of the closed chain, and the noise of its angles.

pub(in crate::cost) mod angle_noise;
pub(in crate::cost) mod closure;
pub(in crate::cost) mod fill_in;
pub(in crate::cost) mod length;
pub(in crate::cost) mod pose;
pub(in crate::cost) mod position;
pub(in crate::cost) mod position_angles;
pub(in crate::cost) mod transform;
