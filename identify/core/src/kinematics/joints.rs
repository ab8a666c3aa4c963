//! A list of one number for each axis of an arm, stored without allocation.

use std::ops::{Deref, DerefMut};

use rand::Rng;
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};

pub use shared::config::AXES_MAX;

/// One number for each axis of an arm, base to flange. The numbers are joint variables \[rad; m for prismatic axes\],
/// their rates, or torques.
///
/// The length is the number of axes. The numbers are stored in place instead of in a `Vec`, because ten hours of log contain
/// millions of such lists.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Joints {
    /// The numbers, followed by zeros from index `count` on.
    values: [f64; AXES_MAX],
    count: usize,
}

impl Joints {
    /// Zero for each of `count` axes.
    pub const fn zeros(count: usize) -> Self {
        let count = if count < AXES_MAX { count } else { AXES_MAX };
        Self { values: [0.0; AXES_MAX], count }
    }

    /// Joints from an array; usable in constants.
    pub const fn from_array<const N: usize>(numbers: [f64; N]) -> Self {
        let mut joints = Self::zeros(N);
        let mut axis = 0;
        while axis < joints.count {
            joints.values[axis] = numbers[axis];
            axis += 1;
        }
        joints
    }

    /// Joints from a function of the axis index, from 0.
    #[inline]
    pub fn from_fn(count: usize, value_of: impl FnMut(usize) -> f64) -> Self {
        (0..count).map(value_of).collect()
    }

    /// Random numbers, uniform between the lower and upper limit of each axis.
    pub fn random(limits: &[[f64; 2]], random: &mut impl Rng) -> Self {
        limits.iter().map(|[low, high]| low + (high - low) * random.random::<f64>()).collect()
    }

    /// Applies a function to each number.
    #[must_use]
    pub fn map(mut self, mut function: impl FnMut(f64) -> f64) -> Self {
        self.iter_mut().for_each(|value| *value = function(*value));
        self
    }
}

impl Serialize for Joints {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        (**self).serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for Joints {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let numbers = Vec::<f64>::deserialize(deserializer)?;
        if numbers.len() > AXES_MAX {
            return Err(D::Error::invalid_length(
                numbers.len(),
                &"at most as many numbers as an arm may have axes",
            ));
        }
        Ok(numbers.into_iter().collect())
    }
}

impl Deref for Joints {
    type Target = [f64];

    #[inline]
    fn deref(&self) -> &[f64] {
        &self.values[..self.count]
    }
}

impl AsRef<[f64]> for Joints {
    fn as_ref(&self) -> &[f64] {
        self
    }
}

impl DerefMut for Joints {
    #[inline]
    fn deref_mut(&mut self) -> &mut [f64] {
        &mut self.values[..self.count]
    }
}

/// Numbers beyond [`AXES_MAX`] are dropped.
impl FromIterator<f64> for Joints {
    #[inline]
    fn from_iter<I: IntoIterator<Item = f64>>(numbers: I) -> Self {
        let mut joints = Self::default();
        for (value, number) in joints.values.iter_mut().zip(numbers) {
            *value = number;
            joints.count += 1;
        }
        joints
    }
}

impl<const N: usize> From<[f64; N]> for Joints {
    fn from(numbers: [f64; N]) -> Self {
        numbers.into_iter().collect()
    }
}

impl<const N: usize> PartialEq<[f64; N]> for Joints {
    fn eq(&self, other: &[f64; N]) -> bool {
        **self == other[..]
    }
}

impl IntoIterator for Joints {
    type Item = f64;
    type IntoIter = std::iter::Take<std::array::IntoIter<f64, AXES_MAX>>;

    fn into_iter(self) -> Self::IntoIter {
        self.values.into_iter().take(self.count)
    }
}

impl<'a> IntoIterator for &'a mut Joints {
    type Item = &'a mut f64;
    type IntoIter = std::slice::IterMut<'a, f64>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter_mut()
    }
}

impl<'a> IntoIterator for &'a Joints {
    type Item = &'a f64;
    type IntoIter = std::slice::Iter<'a, f64>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}
