//! The three-dimensional animation of `path.html` and `poses.html`. It shows an arm with bar or target that moves along a
//! path or from pose to pose.
//!
//! A page provides the input as a [`View`]. A [`PathScene`] is computed from the view. It contains the positions of points
//! over time, and capsules that connect the points. The function [`view`] returns the HTML of the animation, which includes
//! the scene as JSON. The script `view.js` draws the scene with the library OGL.

use maud::{Markup, PreEscaped, html};
use nalgebra::{Point3, Vector3};
use serde::Serialize;

use crate::kinematics::{Chain, Joints};
use crate::plan::{Bodies, Skeleton};

/// Scripts in the order in which they must be loaded.
pub(super) const SCRIPTS: &[&str] = &[include_str!("ogl/ogl.iife.min.js"), include_str!("view.js")];

/// Largest number of frames of a path. Between two frames, points move in straight lines.
pub(super) const FRAMES: usize = 1000;
/// Pieces of a link that are not longer than this in any frame are not drawn \[m\].
const PIECE_M_MIN: f64 = 1e-3;

/// Input of the animation.
pub(super) struct View<'a> {
    pub arm: &'a Chain,
    pub carried: Carried,
    /// Time \[s\] and joint positions of each frame, from time zero.
    pub motion: Vec<(f64, Joints)>,
    /// Number of frames from one pose to the next; `None` for a path. If there are poses, they are marked, and pose numbers
    /// are displayed instead of times.
    pub frames_per_pose: Option<usize>,
    /// Bodies that were checked for collisions. If `None`, bodies of default sizes are drawn.
    pub bodies: Option<&'a Bodies>,
}

/// Object that the arm carries.
pub(super) enum Carried {
    /// The bar, with the position of its gimbal in the robot's base frame \[m\].
    Bar(Vector3<f64>),
    /// A target, with its position in the flange's frame \[m\].
    Target(Vector3<f64>),
}

/// The scene that `view.js` draws.
#[derive(Serialize)]
struct PathScene<'a> {
    times_s: Vec<f64>,
    /// Coordinates of all points in each frame \[m\]: x, y and z of the first point, then of the second point, and so on.
    frames: Vec<Vec<f64>>,
    /// Indices of the two end points, name of the colour, and radius \[m\].
    capsules: Vec<(usize, usize, &'static str, f64)>,
    /// Index of the point whose path is drawn: the end of the plate, or the target.
    ends: usize,
    frames_per_pose: Option<usize>,
    boxes_m: &'a [[[f64; 3]; 2]],
    floor_m: f64,
    reach_m: f64,
}

impl<'a> PathScene<'a> {
    fn from_view(view: &View<'_>, bodies: &'a Bodies) -> Self {
        let arm = view.arm;
        let (times_s, skeletons): (Vec<f64>, Vec<Skeleton>) =
            view.motion.iter().map(|(t_s, q)| (*t_s, Skeleton::at_posture(arm, q))).unzip();
        // `points` contains, for each point, its positions in all frames. Each capsule connects a point
        // with the previous point.
        let mut points: Vec<Vec<Vector3<f64>>> = Vec::new();
        let mut capsules = Vec::new();
        let in_frames =
            |position: &dyn Fn(&Skeleton) -> Vector3<f64>| skeletons.iter().map(position).collect::<Vec<_>>();
        points.push(in_frames(&|arm| arm.links.first().map_or_else(Vector3::zeros, |[start, ..]| *start)));
        let links = arm.links.len();
        let mut add = |to: Vec<Vector3<f64>>, colour: &'static str, radius_m: f64| {
            let from = points.len() - 1;
            if points.last().is_some_and(|last| is_long(last, &to)) {
                points.push(to);
                capsules.push((from, from + 1, colour, radius_m));
            }
        };
        for link in 0..links {
            let link_point = |number: usize| {
                in_frames(&move |arm| arm.links.get(link).map_or(arm.end, |link| link[number]))
            };
            // Each link is drawn in two pieces. The first piece runs along the joint's axis from the link's start (point 0)
            // to the corner (point 1). The second piece runs from the corner to the link's end (point 2). For the last link,
            // the plate replaces the second piece.
            add(link_point(1), "link", bodies.link_radius_m);
            if link + 1 < links {
                add(link_point(2), "link", bodies.link_radius_m);
            }
        }
        add(in_frames(&|arm| arm.end), "plate", bodies.rod_radius_m);
        add(gimbal_or_target(view), "rod", bodies.rod_radius_m);
        // With a bar, the last point is the gimbal, and the point before it is the end of the plate. With a target, the
        // last point is the target.
        let ends = points.len().saturating_sub(if matches!(view.carried, Carried::Bar(_)) { 2 } else { 1 });
        let rounded_to_mm = |x_m: f64| (x_m * 1e3).round() / 1e3;
        let frame = |row: usize| {
            points.iter().filter_map(|point| point.get(row)).flatten().map(|x| rounded_to_mm(*x)).collect()
        };
        Self {
            frames: (0..times_s.len()).map(frame).collect(),
            times_s,
            capsules,
            ends,
            frames_per_pose: view.frames_per_pose,
            boxes_m: &bodies.boxes_m,
            floor_m: bodies.floor_m.unwrap_or_default(),
            reach_m: arm.reach_m(),
        }
    }
}

/// Whether two points are further apart than [`PIECE_M_MIN`] in any frame.
fn is_long(from: &[Vector3<f64>], to: &[Vector3<f64>]) -> bool {
    from.iter().zip(to).any(|(from, to)| (to - from).norm() > PIECE_M_MIN)
}

/// Position of the bar's gimbal or of the target in the robot's base frame, in each frame of the animation \[m\].
fn gimbal_or_target(view: &View<'_>) -> Vec<Vector3<f64>> {
    let position = |(_, q): &(f64, Joints)| match view.carried {
        Carried::Bar(gimbal) => gimbal,
        Carried::Target(target) => (view.arm.forward(q) * Point3::from(target)).coords,
    };
    view.motion.iter().map(position).collect()
}

/// HTML of the animation with its controls.
pub(super) fn view(view: &View<'_>) -> Markup {
    let default_bodies = Bodies::for_reach(view.arm.reach_m());
    let scene = PathScene::from_view(view, view.bodies.unwrap_or(&default_bodies));
    let (what, when, as_thick) = match view.carried {
        Carried::Bar(_) => {
            ("The robot and the bar along the path", "Time along the path", "Links, plate and rod")
        }
        Carried::Target(_) => ("The robot in each pose", "Pose", "Links"),
    };
    // `<` is escaped, because it could end the surrounding element. Serialisation cannot fail, because all keys are text.
    let scene = serde_json::to_string(&scene).unwrap_or_default().replace('<', "\\u003c");
    html! {
        figure #path-view {
            canvas #path-canvas role="img" aria-label=(format!("{what}, in three dimensions")) {}
            div.controls {
                button #path-play type="button" { "Play" }
                input #path-time type="range" min="0" max="10000" value="0" aria-label=(when);
                output #path-shown {}
                button #path-nearer type="button" aria-label="Nearer" { "+" }
                button #path-farther type="button" aria-label="Farther" { "\u{2212}" }
            }
            figcaption {
                "Turn it with the mouse or a finger, shift it with the right button or two fingers. " (as_thick) " are as thick as in "
                "a check for collisions. A square of the grid is 0.5 m. The x axis of the robot's base is red, its y axis green."
            }
            p.note.unable { "This browser cannot draw in three dimensions (WebGL is off); the figures below show the same." }
            script #path-scene type="application/json" { (PreEscaped(scene)) }
        }
    }
}
