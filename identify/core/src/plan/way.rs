//! Finds a collision-free path of an arm between two postures, for the moves between planned poses. A posture is a set of
//! joint variables. One tree of postures starts at each end. The trees grow towards random postures and towards each other
//! until they meet (RRT-Connect, Kuffner and LaValle 2000). Intermediate postures that are not needed are then removed.

use std::f64::consts::{PI, TAU};

use rand::Rng;

use super::poses::Way;
use crate::kinematics::Joints;
use crate::statistics::largest_difference;

/// Largest number of random postures towards which the trees grow. If no path exists, the search ends after this number,
/// which takes some seconds.
const TRIES: usize = 1500;
/// The same limit for a target that differs from the requested posture by whole turns. If a path to such a target exists,
/// the first trials find it.
const TRIES_TURNED: usize = 100;
/// Largest change of a joint in one step of a tree \[rad, m\].
const STEP: f64 = 0.4;
/// Every second random posture is drawn near both ends: within this distance from the range of joints between them \[rad,
/// m\]. Most paths around an obstacle stay there.
const ROUND: f64 = 1.0;

/// A tree of postures that are connected with the first posture. `before` contains the index of each posture's predecessor.
struct Tree {
    postures: Vec<Joints>,
    before: Vec<usize>,
}

impl Tree {
    fn new(root: Joints) -> Self {
        Self { postures: vec![root], before: vec![0] }
    }

    /// Makes one step from the nearest posture of the tree to the posture `towards`. Returns the end of the step, or `None`
    /// if the motion is not free of collisions.
    fn grow(&mut self, towards: &Joints, is_clear: impl Fn(&Joints, &Joints) -> bool) -> Option<Joints> {
        let distance = |node: usize| largest_difference(&self.postures[node], towards);
        let nearest = (0..self.postures.len()).min_by(|a, b| distance(*a).total_cmp(&distance(*b)))?;
        let from = self.postures[nearest];
        let part = STEP / distance(nearest);
        let to = match part < 1.0 {
            true => Joints::from_fn(from.len(), |axis| from[axis] + part * (towards[axis] - from[axis])),
            false => *towards,
        };
        if !is_clear(&from, &to) {
            return None;
        }
        self.postures.push(to);
        self.before.push(nearest);
        Some(to)
    }

    /// Postures from the last added posture back to the root.
    fn branch(&self) -> Vec<Joints> {
        let mut node = self.postures.len() - 1;
        let mut branch = vec![self.postures[node]];
        while node > 0 {
            node = self.before[node];
            branch.push(self.postures[node]);
        }
        branch
    }
}

/// Finds a path from one posture to another. If no path is found, it tries target postures that differ by whole turns of
/// joints. A joint that cannot pass an angle then moves in the other direction. Returns the reached posture and the path to
/// this posture. Joints stay within `range`; `turns` is true for revolute joints.
pub(super) fn to_posture(
    from: Joints,
    to: Joints,
    (range, turns): (&[[f64; 2]], &[bool]),
    is_clear: impl Fn(&Joints, &Joints) -> bool,
    random: &mut impl Rng,
) -> (Joints, Way) {
    let mut way_to = |to: &Joints, tries| match is_clear(&from, to) {
        true => Some(Way::Straight),
        false => path_around([from, *to], range, tries, &is_clear, random).map(Way::Through),
    };
    if let Some(way) = way_to(&to, TRIES) {
        return (to, way);
    }
    let found = |to: &Joints| Some((*to, way_to(to, TRIES_TURNED)?));
    with_whole_turns(&from, &to, range, turns).iter().find_map(found).unwrap_or((to, Way::Blocked))
}

/// Postures that differ from `to` by one whole turn of one joint or two joints and are within `range`,
/// nearest to `from` first.
fn with_whole_turns(from: &Joints, to: &Joints, range: &[[f64; 2]], turns: &[bool]) -> Vec<Joints> {
    let one_turn_away = |posture: &Joints| {
        let axes = (0..posture.len()).filter(|axis| turns[*axis]);
        let shifted = axes.flat_map(|axis| {
            [TAU, -TAU].map(|turn| {
                let mut shifted = *posture;
                shifted[axis] += turn;
                shifted
            })
        });
        let is_within = |q: &Joints| q.iter().zip(range).all(|(q, [low, high])| (*low..=*high).contains(q));
        shifted.filter(is_within).collect::<Vec<_>>()
    };
    let once = one_turn_away(to);
    let mut others: Vec<Joints> = Vec::new();
    for other in once.iter().copied().chain(once.iter().flat_map(one_turn_away)) {
        // The same posture can result from several orders of turns, with different rounding errors.
        let is_same = |known: &Joints| largest_difference(known, &other) < PI;
        if !is_same(to) && !others.iter().any(is_same) {
            others.push(other);
        }
    }
    others.sort_by(|a, b| largest_difference(from, a).total_cmp(&largest_difference(from, b)));
    others
}

/// Intermediate postures between `from` and `to`. They are connected by straight lines in joint space that are free of
/// collisions. Joints stay within `range`. `None` if no path was found.
fn path_around(
    [from, to]: [Joints; 2],
    range: &[[f64; 2]],
    tries: usize,
    is_clear: impl Fn(&Joints, &Joints) -> bool,
    random: &mut impl Rng,
) -> Option<Vec<Joints>> {
    let [mut growing, mut opposite] = [from, to].map(Tree::new);
    for attempt in 0..tries {
        // The trees grow alternately. Of every four attempts, the first two (one for each tree) draw a random posture near
        // both ends, and the other two draw from the whole range.
        let goal = Joints::from_fn(from.len(), |axis| {
            let [low, high] = range[axis];
            let (near_low, near_high) = (from[axis].min(to[axis]) - ROUND, from[axis].max(to[axis]) + ROUND);
            let [low, high] = match attempt % 4 < 2 {
                true => [low.max(near_low), high.min(near_high)],
                false => [low, high],
            };
            low + (high - low) * random.random::<f64>()
        });
        if let Some(reached) = growing.grow(&goal, &is_clear) {
            while let Some(grown) = opposite.grow(&reached, &is_clear) {
                if grown == reached {
                    let [mut first, mut second] = [growing.branch(), opposite.branch()];
                    // In odd attempts, the growing tree is the one that starts at `to`.
                    if attempt % 2 == 1 {
                        std::mem::swap(&mut first, &mut second);
                    }
                    first.reverse();
                    first.extend(second.into_iter().skip(1));
                    return Some(shortened(&first, is_clear));
                }
            }
        }
        std::mem::swap(&mut growing, &mut opposite);
    }
    None
}

/// Removes intermediate postures that are not needed. From each posture, the path continues at the farthest posture of `way`
/// that a free straight line reaches.
fn shortened(way: &[Joints], is_clear: impl Fn(&Joints, &Joints) -> bool) -> Vec<Joints> {
    let (mut at, last) = (0, way.len() - 1);
    let mut needed = Vec::new();
    while at < last {
        let next = (at + 1..=last).rev().find(|next| is_clear(&way[at], &way[*next]));
        at = next.unwrap_or(at + 1);
        needed.push(way[at]);
    }
    needed.pop();
    needed
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn postures_that_differ_by_whole_turns_are_each_tried_once() {
        // These angles do not return to the same value after a turn is added and subtracted, due to rounding.
        let to = Joints::from_fn(6, |axis| 0.1 + 0.3 * axis as f64);
        let others = with_whole_turns(&Joints::zeros(6), &to, &[[-10.0, 10.0]; 6], &[true; 6]);
        // Expected are one turn of each of six joints, and of each of the 15 pairs of joints, in both directions.
        assert_eq!(others.len(), 6 * 2 + 15 * 4);
        for (index, other) in others.iter().enumerate() {
            assert!(others[..index].iter().chain([&to]).all(|known| largest_difference(known, other) > PI));
        }
    }
}
