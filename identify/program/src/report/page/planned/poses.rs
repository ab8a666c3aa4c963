//! `poses.html`: animation of the selected poses, and the expected accuracy of the parameters that they determine.

use std::path::{Path, PathBuf};

use maud::{Markup, html};
use nalgebra::{Point3, Vector3};

use super::path::collisions;
use super::path_view::{self, Carried, View, view};
use crate::kinematics::{Chain, Joints};
use crate::model::ParameterId;
use crate::plan::{Bodies, Determined, PlannedPoses};
use crate::report::page::document_with;
use crate::report::page::drawing::figures::{ROUND, WIDE, dots};
use crate::report::page::drawing::plot::{BLUE, COLOURS, GREY, Mark, Panel, Series};
use crate::report::page::sections::{mm, number};
use crate::report::path;
use crate::report::result::file::{FileError, replace};

/// Number of frames of the animation from one selected pose to the next.
const FRAMES_PER_MOVE: usize = 12;
/// Largest number of parameters in the list of least determined parameters.
const WEAKEST: usize = 12;

/// Content of the page.
#[derive(Debug)]
pub struct PosesPage<'a> {
    /// Name of the robot.
    pub robot: &'a str,
    /// Nominal kinematic chain of the robot, from base to flange.
    pub arm: &'a Chain,
    /// Lower and upper limit of each joint \[rad, m\].
    pub limits: &'a [[f64; 2]],
    /// Position of the measured target in the flange's frame \[m\].
    pub target_m: [f64; 3],
    /// The selected poses, and their expected accuracy.
    pub planned: &'a PlannedPoses,
    /// Number of candidate poses.
    pub candidates: usize,
    /// Bodies that were checked for collisions, if any.
    pub bodies: Option<&'a Bodies>,
}

impl PosesPage<'_> {
    /// Writes `poses.html` into the directory, completely or not at all.
    ///
    /// # Errors
    /// [`FileError`].
    pub fn write(&self, directory: &Path) -> Result<PathBuf, FileError> {
        replace(directory, "poses.html", &self.render().into_string())
    }

    /// Renders the page as HTML.
    pub fn render(&self) -> Markup {
        let planned = self.planned;
        let title = format!("Poses for {}", self.robot);
        let count = planned.joints.len();
        let body = html! {
            header {
                h1 { (title) }
                p.about { (planned.joints.len()) " poses to be measured, chosen out of " (self.candidates) }
            }
            main {
                (self.view())
                @if let Some(note) = path::ways(planned) { p.note { (note) } }
                @if let Some(bodies) = self.bodies { (collisions(bodies, false)) }
                h2 { "Position error that is expected" }
                div.numbers {
                    (number(mm(planned.before_m) + " mm", "of the robot as it is"))
                    (number(mm(planned.position_m) + " mm", "after a calibration with these poses"))
                    (number(mm(planned.random_m) + " mm", format!("with {count} random ones, the median")))
                }
                p.note {
                    "Root mean square over all poses that were chosen from, for white noise and the errors of links, loads and gears that a "
                    "calibration expects. What no parameter describes comes on top."
                }
                h2 { "Where the target goes" }
                figure { div.panels {
                    (self.places("From above", ["x [m]", "y [m]"], |at| (at.x, at.y)))
                    (self.places("From the side", ["distance from the base's z [m]", "z [m]"], |at| (at.x.hypot(at.y), at.z)))
                } }
                h2 { "What the robot does" }
                figure { (self.angles()) }
                (self.travel())
                h2 { "What a calibration is expected to know" }
                (self.determined())
                h2 { "Least determined parameters" }
                (self.weakest())
            }
        };
        document_with(&title, path_view::SCRIPTS, &body)
    }

    /// Position of the target in the robot's base frame \[m\].
    fn target(&self, q: &Joints) -> Vector3<f64> {
        (self.arm.forward(q) * Point3::from(Vector3::from(self.target_m))).coords
    }

    /// The animation of the arm from pose to pose.
    fn view(&self) -> Markup {
        let joints = &self.planned.joints;
        // Returns the frames of one move. The move passes through its postures at equal time intervals. The unit of
        // time is one move.
        let frames_of_move = |(move_number, postures): (usize, Vec<Joints>)| {
            (0..FRAMES_PER_MOVE).map(move |frame| {
                let part = frame as f64 / FRAMES_PER_MOVE as f64;
                let along = part * (postures.len() - 1) as f64;
                let (from, to) = (&postures[along as usize], &postures[along as usize + 1]);
                let q = Joints::from_fn(from.len(), |i| from[i] + along.fract() * (to[i] - from[i]));
                (move_number as f64 + part, q)
            })
        };
        let last = joints.last().map(|q| ((joints.len() - 1) as f64, *q));
        view(&View {
            arm: self.arm,
            carried: Carried::Target(self.target_m.into()),
            motion: self.planned.moves().enumerate().flat_map(frames_of_move).chain(last).collect(),
            frames_per_pose: Some(FRAMES_PER_MOVE),
            bodies: self.bodies,
        })
    }

    fn places(&self, title: &str, axes: [&str; 2], project: fn(&Vector3<f64>) -> (f64, f64)) -> Markup {
        let places = self.planned.joints.iter().map(|q| project(&self.target(q))).collect();
        Panel::new(title, axes, ROUND, vec![dots("", BLUE, places)]).draw()
    }

    fn angles(&self) -> Markup {
        let series = |joint: usize| {
            let value = |(pose, q): (usize, &Joints)| (pose as f64 + 1.0, q[joint] * self.unit(joint).0);
            let points = self.planned.joints.iter().enumerate().map(value).collect();
            let colour = COLOURS.get(joint).copied().unwrap_or(GREY);
            Series::new(format!("joint {}", joint + 1), colour, Mark::Line, points)
        };
        let y = if path::has_prismatic(self.arm) { "[deg, mm]" } else { "[deg]" };
        let series = (0..self.limits.len()).map(series).collect();
        Panel::new("Robot joints", ["pose", y], WIDE, series).draw()
    }

    /// Factor from SI to the displayed unit of a joint, and that unit.
    fn unit(&self, joint: usize) -> (f64, &'static str) {
        let kind = self.arm.links.get(joint).map(|link| link.joint).unwrap_or_default();
        (kind.display_factor(), kind.display_symbol())
    }

    /// Total travel of a joint on all moves \[rad, m\].
    fn travelled(&self, joint: usize) -> f64 {
        let of_move = |postures: Vec<Joints>| -> f64 {
            postures.windows(2).map(|pair| (pair[1][joint] - pair[0][joint]).abs()).sum()
        };
        self.planned.moves().map(of_move).sum()
    }

    /// Range, limits and travel of each joint.
    fn travel(&self) -> Markup {
        let joints = &self.planned.joints;
        html! { table {
            thead { tr {
                th { "Joint" } th { "lowest" } th { "highest" } th { "limits" } th { "of their range" } th { "travel in all" }
            } }
            tbody { @for (joint, limits) in self.limits.iter().enumerate() {
                @let [low, high] = crate::statistics::extremes(joints.iter().map(|q| q[joint]));
                @let travel = self.travelled(joint);
                @let (factor, unit) = self.unit(joint);
                // Adding zero turns -0 into 0.
                @let [lowest, highest, from, to, in_all] =
                    [low, high, limits[0], limits[1], travel].map(|value| format!("{:.0}", value * factor + 0.0));
                tr {
                    td { (joint + 1) }
                    td { (lowest) " " (unit) }
                    td { (highest) " " (unit) }
                    td { (from) " to " (to) " " (unit) }
                    td { (format!("{:.0} %", 100.0 * (high - low) / (limits[1] - limits[0]))) }
                    td { (in_all) " " (unit) }
                }
            } }
        } }
    }

    /// Number of parameters in each group, and their standard deviations before and after the measurements.
    fn determined(&self) -> Markup {
        let size =
            |one: &Determined, si: f64| one.ids.first().map_or_else(String::new, |id| id.unit().display(si));
        html! {
            table {
                thead { tr {
                    th.text { "Error of" } th { "parameters" } th { "before" } th { "after" } th { "after / before" } th { "undetermined" }
                } }
                tbody { @for one in &self.planned.determined { tr {
                    td.text { (one.name) }
                    td { (one.ids.len()) }
                    td { (size(one, one.prior)) }
                    td { (size(one, one.sigma)) }
                    td { (format!("{:.0} %", 100.0 * one.sigma / one.prior)) }
                    td { (one.undetermined().count()) }
                } } }
            }
            p.note { "Standard deviations, root mean square over the parameters of a kind." }
        }
    }

    /// Lists the parameters whose standard deviation decreases least, with the ratio of the standard deviations after
    /// and before the measurements.
    fn weakest(&self) -> Markup {
        let parts_left = self.planned.determined.iter().flat_map(|kind| kind.ids.iter().zip(&kind.left));
        let mut parts_left: Vec<(&ParameterId, &f64)> = parts_left.collect();
        parts_left.sort_by(|(_, a), (_, b)| b.total_cmp(a));
        html! { table.narrow {
            thead { tr { th { "Parameter" } th { "after / before" } } }
            tbody { @for (id, left) in parts_left.into_iter().take(WEAKEST) { tr {
                td { (id) }
                td { (format!("{:.0} %", 100.0 * left)) }
            } } }
        } }
    }
}
