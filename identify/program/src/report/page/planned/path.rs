//! `path.html`: animation and motion of a planned or checked path, and the expected standard deviation of
//! each parameter after a calibration.

use std::path::{Path, PathBuf};

use maud::{Markup, html};

use super::path_view::{self, Carried, FRAMES, View, view};
use crate::kinematics::BAR_JOINTS;
use crate::logs::RobotLog;
use crate::model::ParameterId;
use crate::plan::{Bodies, Checked, Constraints, Path as BarPath};
use crate::report::page::document_with;
use crate::report::page::drawing::figures::{ROUND, WIDE, dots, from_above, sphere_from_above};
use crate::report::page::drawing::plot::{BLUE, COLOURS, GREY, Mark, Panel, Series};
use crate::report::path::has_prismatic;
use crate::report::result::file::{FileError, replace};

/// Largest number of points of a curve on the page.
const POINTS: usize = 600;

/// Content of the page.
#[derive(Debug)]
pub struct PathPage<'a> {
    /// Name of the robot.
    pub robot: &'a str,
    /// Robot, bar, and the constraints on the path.
    pub constraints: &'a Constraints<'a>,
    /// Path of the bar's joints.
    pub path: &'a BarPath,
    /// Joint positions of the robot along the path.
    pub robot_path: &'a RobotLog,
    /// Extremes of the motion, and violations of constraints.
    pub checked: &'a Checked,
    /// Summary of the path, as on the terminal.
    pub summary: &'a str,
    /// Expected standard deviation of each parameter after a calibration, in SI units.
    pub sigmas: &'a [(ParameterId, f64)],
}

impl PathPage<'_> {
    /// Writes `path.html` into the directory, completely or not at all.
    ///
    /// # Errors
    /// [`FileError`].
    pub fn write(&self, directory: &Path) -> Result<PathBuf, FileError> {
        replace(directory, "path.html", &self.render().into_string())
    }

    /// Renders the page as HTML.
    pub fn render(&self) -> Markup {
        let title = format!("Path for {}", self.robot);
        let sigmas_of = |is_robot: bool| {
            self.sigmas.iter().filter(move |(id, _)| matches!(id, ParameterId::Robot { .. }) == is_robot)
        };
        let table = |name: &str, is_robot: bool| {
            html! { table {
                thead { tr { th { (name) } th { "sigma" } th.text { "" } } }
                tbody { @for (id, sigma) in sigmas_of(is_robot) { tr {
                    td { (id) }
                    td { (format!("{:.4}", sigma * id.unit().display_factor())) }
                    td.unit { (id.unit().display_symbol()) }
                } } }
            } }
        };
        let body = html! {
            header {
                h1 { (title) }
                p.about { (format!("{:.0} s with the ball-bar, planned", self.checked.duration_s)) }
            }
            main {
                (self.view())
                pre.table { (self.summary) }
                @if let Some(bodies) = &self.constraints.bodies { (collisions(bodies, true)) }
                h2 { "Where the bar goes" }
                figure {
                    div.panels { (self.sphere()) (self.margin()) }
                    figcaption { "Left: equal areas of the sphere are equal areas of the figure." }
                }
                h2 { "What the robot does" }
                figure { (self.angles()) (self.speeds()) }
                h2 { "How far the bar's cables are wound" }
                figure { (self.winding()) }
                h2 { "What a calibration is expected to know" }
                div.columns { (table("Robot", true)) (table("Bar, base, clock and errors of axes", false)) }
                p.note {
                    "sigma: one standard deviation for white noise, with the priors of a calibration's default settings and all its "
                    "terms. Errors that no parameter describes come on top."
                }
            }
        };
        document_with(&title, path_view::SCRIPTS, &body)
    }

    /// The animation of the path, thinned to at most [`FRAMES`] frames.
    fn view(&self) -> Markup {
        let rows = &self.robot_path.q_rad;
        view(&View {
            arm: self.constraints.robot,
            carried: Carried::Bar(self.constraints.bar.root_from_base.translation.vector),
            motion: rows
                .t_s
                .iter()
                .copied()
                .zip(rows.iter().copied())
                .step_by(rows.len().div_ceil(FRAMES).max(1))
                .collect(),
            frames_per_pose: None,
            bodies: self.constraints.bodies.as_ref(),
        })
    }

    /// Time and index of the rows that are drawn. Their number is at most [`POINTS`].
    fn rows(&self) -> impl Iterator<Item = (f64, usize)> {
        let every = self.robot_path.q_rad.len().div_ceil(POINTS).max(1);
        self.robot_path.q_rad.t_s.iter().enumerate().step_by(every).map(|(row, t_s)| (*t_s, row))
    }

    /// One curve for each joint. The arguments of `value` are the time, the row of the robot's path and the joint.
    fn by_joint(&self, count: usize, value: impl Fn(f64, usize, usize) -> Option<f64>) -> Vec<Series> {
        let series = |joint: usize| {
            let points = self.rows().filter_map(|(t_s, row)| Some((t_s, value(t_s, row, joint)?))).collect();
            let colour = COLOURS.get(joint).copied().unwrap_or(GREY);
            Series::new(format!("joint {}", joint + 1), colour, Mark::Line, points)
        };
        (0..count).map(series).collect()
    }

    fn angles(&self) -> Markup {
        let arm = self.constraints.robot;
        let series = self.by_joint(self.robot_path.axes(), |_, row, joint| {
            Some(self.robot_path.q_rad.get(row)?[joint] * arm.links.get(joint)?.joint.display_factor())
        });
        over_time("Robot joints", if has_prismatic(arm) { "[deg, mm]" } else { "[deg]" }, series)
    }

    fn speeds(&self) -> Markup {
        let log = self.robot_path;
        let series = self.by_joint(log.axes(), |_, row, joint| {
            let next = row + 1;
            let change = log.q_rad.get(next)?[joint] - log.q_rad.get(row)?[joint];
            Some(change / (log.q_rad.t_s.get(next)? - log.q_rad.t_s.get(row)?))
        });
        let y = if has_prismatic(self.constraints.robot) { "[rad/s, m/s]" } else { "[rad/s]" };
        over_time("Their speeds", y, series)
    }

    fn winding(&self) -> Markup {
        let series = self.by_joint(BAR_JOINTS, |t_s, _, joint| {
            Some((self.path.at(t_s)[joint] - self.path.start_rad[joint]).to_degrees())
        });
        over_time("Bar joints from the start", "[deg]", series)
    }

    fn sphere(&self) -> Markup {
        let bar = self.constraints.bar;
        let gimbal = bar.root_from_base.translation.vector;
        let place = |t_s: f64| {
            let rod = bar.forward(&self.path.at(t_s)).translation.vector - gimbal;
            from_above(&(rod / rod.norm().max(1e-12)))
        };
        let line = self.rows().map(|(t_s, _)| place(t_s)).collect();
        let points = self.path.moves.iter().map(|step| place(step.end_s())).collect();
        let series = [Series::new("", BLUE, Mark::Line, line), dots("ends of moves", BLUE, points)];
        sphere_from_above("Directions of the rod", series)
    }

    fn margin(&self) -> Markup {
        let bar_links = &self.constraints.bar.links;
        let margin =
            |t_s: f64| crate::kinematics::singularity_margin_rad(bar_links, &self.path.at(t_s)).to_degrees();
        let series =
            vec![Series::new("", BLUE, Mark::Line, self.rows().map(|(t_s, _)| (t_s, margin(t_s))).collect())];
        let title = "Distance of the bar from a singular pose";
        Panel::new(title, ["[s]", "[deg]"], ROUND, series).with_zero().draw()
    }
}

/// A note on the bodies that were checked for collisions.
pub(in crate::report::page) fn collisions(bodies: &Bodies, with_bar: bool) -> Markup {
    html! { p.note {
        "Collisions: links of the robot as capsules of " (format!("{:.0}", bodies.link_radius_m * 1e3)) " mm"
        @if with_bar { ", rod and plate of " (format!("{:.0}", bodies.rod_radius_m * 1e3)) " mm" }
        ", " (bodies.boxes_m.len()) " boxes, "
        @match bodies.floor_m {
            Some(floor_m) => { "floor at " (format!("{floor_m:.3}")) " m." }
            None => { "no floor." }
        }
        " Cables and other objects in the cell are not included: drive it slowly first."
    } }
}

fn over_time(title: &str, unit: &str, series: Vec<Series>) -> Markup {
    Panel::new(title, ["[s]", unit], WIDE, series).draw()
}
