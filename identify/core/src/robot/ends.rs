//! Selects base and tip of the arm in a URDF file, if the user does not.
//!
//! Besides the arm, a file can contain a world before it, additional frames along it, and a gripper after it. For each link,
//! the module lists the moving joints (axes) between the base and this link. Links with the same axes are candidates for the
//! same end of an arm. Among the candidates, the tip is the link with a standard name or the last link.

use std::cmp::Reverse;

use shared::output::named;

use super::import::ImportError;
use super::urdf::{Urdf, UrdfJoint};

/// Names of a mechanical interface (ISO 9787), by decreasing priority. A link with such a name is the tip wherever it
/// is in the file.
const FLANGES: [&str; 2] = ["tool0", "flange"];
/// Further names of a mechanical interface. They are used only for links that are fixed behind the last axis.
const TOOLS: [&str; 5] = ["link8", "ee_link", "link_ee", "link_eef", "end_effector"];
/// Names of a robot's base link, by decreasing priority.
const BASES: [&str; 4] = ["base_link", "base", "link0", "link_0"];
/// Words in the names of gripper joints.
const GRIPPERS: [&str; 5] = ["gripper", "finger", "jaw", "knuckle", "thumb"];
/// Largest number of links that an error message lists.
const LISTED_MAX: usize = 12;

/// Base and tip of an arm.
pub(super) struct Ends<'a> {
    pub(super) base: String,
    pub(super) tip: String,
    /// Joints from base to tip.
    pub(super) joints: Vec<&'a UrdfJoint>,
    /// Descriptions of the links and joints that the defaults exclude, and of the options that include them.
    pub(super) left_out: Vec<String>,
}

impl<'a> Ends<'a> {
    /// Returns the requested base and tip. If `base` or `tip` is `None`, its default is used.
    pub(super) fn find(urdf: &'a Urdf, base: Option<&str>, tip: Option<&str>) -> Result<Self, ImportError> {
        for link in [base, tip].into_iter().flatten() {
            if !urdf.links.iter().any(|known| known == link) {
                return Err(ImportError::UnknownLink {
                    link: link.to_owned(),
                    known: named(&urdf.links, LISTED_MAX),
                });
            }
        }
        // Find the tip, the joints from the root of the tree to the tip, and the base.
        let mut left_out = Vec::new();
        let tip = match tip {
            Some(tip) => tip.to_owned(),
            None => find_tip(urdf, base, &mut left_out)?,
        };
        let joints = urdf.joints_to(&tip);
        let root = joints.first().map_or(tip.as_str(), |joint| &joint.parent);
        if let Some(joint) = urdf.joints.iter().find(|joint| joint.child == root) {
            return Err(ImportError::Wrong(format!(
                "its joints form a circle through joint `{}`",
                joint.name
            )));
        }
        let base = match base {
            Some(base) => base.to_owned(),
            None => find_base(urdf, root, &joints, &mut left_out),
        };
        // Remove the joints before the base.
        let begin = joints.iter().position(|joint| joint.parent == base);
        let Some(begin) = begin.or_else(|| (base == tip).then_some(joints.len())) else {
            let above: Vec<&String> = joints.iter().rev().map(|joint| &joint.parent).collect();
            return Err(ImportError::NotConnected { base, tip, above: named(&above, LISTED_MAX) });
        };
        let joints = joints[begin..].to_vec();
        if let Some(joint) = joints.iter().find(|joint| !urdf.links.contains(&joint.parent)) {
            let (joint, parent) = (joint.name.clone(), joint.parent.clone());
            return Err(ImportError::NoParent { joint, parent });
        }
        Ok(Self { base, tip, joints, left_out })
    }
}

/// A link with the axes between the base and this link. If a gripper's joint is among these axes, the list ends before it.
struct End<'a> {
    link: &'a str,
    axes: Vec<&'a UrdfJoint>,
    gripper: Option<&'a UrdfJoint>,
}

impl<'a> End<'a> {
    /// `joints` are the joints from the base to the link.
    fn new(link: &'a str, joints: &[&'a UrdfJoint]) -> Self {
        let moving = joints.iter().copied().filter(|joint| joint.moves());
        let mut gripper = None;
        let axes = moving.take_while(|joint| {
            gripper = Some(*joint).filter(|joint| is_of_gripper(joint));
            gripper.is_none()
        });
        Self { link, axes: axes.collect(), gripper }
    }

    /// Whether the axes of `other` are the first axes of this end. Both links are then on the same arm.
    fn continues(&self, other: &Self) -> bool {
        let mut pairs = self.axes.iter().zip(&other.axes);
        self.axes.len() >= other.axes.len() && pairs.all(|(own, other)| own.name == other.name)
    }
}

/// Finds the default tip. A link with the name of a flange has priority. Without such a link, all ends must be on one arm.
/// The candidates are then the links behind the last axis of this arm. The tip is the candidate with the name of a tool, or
/// else the only candidate that no other candidate follows.
fn find_tip(urdf: &Urdf, base: Option<&str>, left_out: &mut Vec<String>) -> Result<String, ImportError> {
    // All links that have axes between the base and the link.
    let below_base = |link: &str| {
        let joints = urdf.joints_to(link);
        let begin = base.map_or(Some(0), |base| joints.iter().position(|joint| joint.parent == base))?;
        Some(joints[begin..].to_vec())
    };
    let end = |link| Some(End::new(link, &below_base(link)?));
    let ends = urdf.links.iter().filter_map(|link| end(link.as_str()));
    let ends: Vec<End<'_>> = ends.filter(|end| !end.axes.is_empty()).collect();
    // Use the link with the name of a flange, if there is exactly one.
    for name in FLANGES {
        let called: Vec<&End<'_>> = ends.iter().filter(|end| is_called(end.link, name)).collect();
        match called[..] {
            [] => {}
            [end] => return Ok(end.link.to_owned()),
            _ => return Err(several_tips(&called)),
        }
    }
    let is_parent = |link: &str| urdf.joints.iter().any(|joint| joint.parent == link);
    // The end with the largest number of axes. All other ends must be on the same arm.
    let Some(arm) = ends.iter().max_by_key(|end| end.axes.len()) else {
        if !urdf.joints.iter().any(UrdfJoint::moves) {
            return Err(ImportError::Wrong("no joint moves in it".into()));
        }
        if urdf.links.is_empty() {
            return Err(ImportError::Wrong("it has joints and no <link> that they join".into()));
        }
        let tips: Vec<&String> = urdf.links.iter().filter(|link| !is_parent(link)).collect();
        return Err(ImportError::Gripper { tips: named(&tips, LISTED_MAX) });
    };
    if !ends.iter().all(|end| arm.continues(end)) {
        return Err(several_tips(&ends.iter().filter(|end| !is_parent(end.link)).collect::<Vec<_>>()));
    }
    // Links behind the last axis: `grippers` belong to a gripper, `candidates` are all others. `tips` are the candidates
    // that no other candidate follows.
    let after_last_axis = ends.iter().filter(|end| end.axes.len() == arm.axes.len());
    let (grippers, candidates): (Vec<&End<'_>>, Vec<_>) =
        after_last_axis.partition(|end| end.gripper.is_some());
    let has_candidate_child = |link: &str| {
        let mut joints = urdf.joints.iter().filter(|joint| joint.parent == link);
        joints.any(|joint| candidates.iter().any(|end| end.link == joint.child))
    };
    let tips: Vec<&End<'_>> =
        candidates.iter().copied().filter(|end| !has_candidate_child(end.link)).collect();
    // The links that are fixed to the link of the last axis, without that link.
    let fixed_links = candidates
        .iter()
        .copied()
        .filter(|end| urdf.joints.iter().any(|joint| joint.child == end.link && !joint.moves()));
    let named_tool = TOOLS.iter().find_map(|name| fixed_links.clone().find(|end| is_called(end.link, name)));
    let tip = match (named_tool, &tips[..]) {
        (Some(end), _) => end,
        (None, [tip]) => *tip,
        (None, _) => return Err(several_tips(&tips)),
    };
    let first_gripper = grippers.first();
    if let Some((end, joint)) = first_gripper.and_then(|end| Some((end, end.gripper?))) {
        let (joint, link) = (&joint.name, end.link);
        left_out.push(format!("joint `{joint}` is taken for a gripper's; `--tip {link}` makes it an axis"));
    }
    Ok(tip.link.to_owned())
}

/// Finds the default base: a link before the first axis with the name of a robot's base, or else the link that
/// carries the first axis.
fn find_base(urdf: &Urdf, root: &str, joints: &[&UrdfJoint], left_out: &mut Vec<String>) -> String {
    let fixed_count = joints.iter().position(|joint| joint.moves()).unwrap_or(0);
    let children = joints[..fixed_count].iter().map(|joint| joint.child.as_str());
    let links: Vec<&str> = std::iter::once(root).chain(children).collect();
    let named = BASES.iter().find_map(|name| links.iter().rfind(|link| is_called(link, name)));
    let base = named.or(links.last()).map_or(root, |base| *base);
    if base != root {
        let is_link = urdf.links.iter().any(|link| link == root);
        let includes = if is_link { format!("; `--base {root}` includes it") } else { String::new() };
        left_out.push(format!("link `{root}` before `{base}` is left out{includes}"));
    }
    base.to_owned()
}

/// The error that lists possible tips: by decreasing number of axes, tips of grippers last.
fn several_tips(ends: &[&End<'_>]) -> ImportError {
    let mut ends = ends.to_vec();
    ends.sort_by_key(|end| (end.gripper.is_some(), Reverse(end.axes.len())));
    let tips: Vec<String> = ends.iter().map(|end| format!("{} ({})", end.link, end.axes.len())).collect();
    ImportError::SeveralTips { tips: named(&tips, LISTED_MAX) }
}

/// Whether a link has this name, possibly with a prefix such as `left_`. Upper and lower case are equal.
fn is_called(link: &str, name: &str) -> bool {
    let link = link.to_lowercase();
    link.strip_suffix(name)
        .is_some_and(|prefix| prefix.chars().next_back().is_none_or(|last| !last.is_alphanumeric()))
}

fn is_of_gripper(joint: &UrdfJoint) -> bool {
    let name = joint.name.to_lowercase();
    GRIPPERS.iter().any(|part| name.contains(part))
}
