//! Draws the double ball-bar as an SVG. Lengths are to scale, but joints are symbols of fixed size. The book, the
//! technician's page and the report contain the drawing.
//!
//! Coordinates: the centre of the gimbal is the origin. `x` points to the robot, `y` away from the observer, `z` upward. The
//! bar consists of base, gimbal (joints 1 and 2), rod (joint 3), cardan (joints 4 and 5) and offset plate.

mod pen;

use self::pen::{Pen, Vector};
use crate::config::BallBarConfig;

/// Horizontal extent of rod and plate together; it determines the scale of the drawing \[px\].
const WIDTH_PX: f64 = 560.0;
/// Angle of the rod from the vertical axis of the base \[deg\].
const TILT_DEG: f64 = 60.0;
/// Azimuth and elevation of the observer \[deg\].
const OBSERVER_DEG: [f64; 2] = [-22.0, 22.0];
/// Direction from the bar to the robot.
const X: Vector = Vector([1.0, 0.0, 0.0]);
/// Direction away from the observer.
const Y: Vector = Vector([0.0, 1.0, 0.0]);
/// Direction upward, against gravity.
const Z: Vector = Vector([0.0, 0.0, 1.0]);

/// Style of lines and text. The page around the drawing defines the colours `--ink`, `--paper` and `--accent`.
const STYLE: &str = "<style>
.bar-drawing{color:var(--ink);font:15px system-ui,sans-serif}
.bar-drawing path{fill:none;stroke:currentColor;stroke-width:1.5;stroke-linejoin:round;stroke-linecap:round}
.bar-drawing .body{fill:var(--paper)}
.bar-drawing .encoder{fill:var(--accent)}
.bar-drawing .thin,.bar-drawing .axis{stroke-width:1}
.bar-drawing .axis{stroke-dasharray:14 4 2 4}
.bar-drawing .tip{fill:currentColor;stroke:none}
.bar-drawing text{fill:currentColor;stroke:var(--paper);stroke-width:4px;stroke-linejoin:round;paint-order:stroke}
</style>
";

/// Style that defines these colours, for a drawing in a file of its own.
const COLOURS: &str = "<style>
svg{--ink:#1b2430;--paper:#fff;--accent:#9cc3e6;background:var(--paper)}
@media(prefers-color-scheme:dark){svg{--ink:#e6eaef;--paper:#1b1f24;--accent:#2f6ea8}}
</style>
";

/// Draws the bar for a page that defines the colours `--ink`, `--paper` and `--accent`. Joint `n` is the SVG element with
/// the identifier `bar-joint-n` and the class `bar-joint`.
pub fn ball_bar(bar: &BallBarConfig) -> String {
    svg(bar, STYLE)
}

/// Draws the bar as an SVG file that defines its own colours.
pub fn ball_bar_file(bar: &BallBarConfig) -> String {
    svg(bar, &[COLOURS, STYLE].concat())
}

fn svg(bar: &BallBarConfig, style: &str) -> String {
    let mut pen = Pen::new(OBSERVER_DEG);
    draw(&mut pen, bar);
    let [length, plate] = [bar.length_m, bar.plate_m].map(mm);
    let head = format!(
        "<title id=\"bar-title\">The double ball-bar and its joints</title>\n<desc id=\"bar-desc\">A gimbal on the base has joints 1 \
         to 3: joint 1 turns about the axis of the base, joint 2 about an axis across the rod, joint 3 about the rod. A cardan, \
         {length} from the centre of the gimbal, has joints 4 and 5: joint 4 turns about an axis across the rod, joint 5 about an \
         axis parallel to the last axis of the robot. The offset plate keeps axis 5 at {plate} from it. Arrows show the positive \
         directions. Lengths are to scale, joints are not.</desc>\n{style}"
    );
    pen.finish("class=\"bar-drawing\" role=\"img\" aria-labelledby=\"bar-title bar-desc\"", &head)
}

/// A length as text for people, in mm, rounded to a micrometre.
fn mm(length_m: f64) -> String {
    format!("{} mm", (length_m * 1e6).round() / 1e3)
}

/// Draws all components from back to front. The rod is tilted towards the robot, whose flange faces down. The numbers in the
/// code are sizes of symbols \[px\].
fn draw(pen: &mut Pen, bar: &BallBarConfig) {
    let (sin, cos) = TILT_DEG.to_radians().sin_cos();
    let px_per_m = WIDTH_PX / (bar.length_m * sin + bar.plate_m);
    let [length, plate, tool] = [bar.length_m, bar.plate_m, bar.tool_m].map(|length_m| length_m * px_per_m);
    // Unit vectors: along the rod, and perpendicular to the rod in the plane of rod and plate.
    let (rod, across) = (X * sin + Z * cos, Z * sin - X * cos);
    let (gimbal, cardan) = (Vector([0.0; 3]), rod * length);
    let axis6 = cardan + X * plate;
    // The twist of links 1 to 3 is +90 or -90 degrees. Its sign determines the positive direction of axes 2 and 4.
    let twist = |link: usize| bar.links.get(link).map_or(1.0, |link| link.alpha_deg.signum());
    let axes = [Z, Y * -twist(0), rod, Y * (twist(0) * twist(1) * twist(2)), -Z];
    // Draws a joint: its encoder if it has one, an arrow for its positive direction, and its name.
    let joint = |pen: &mut Pen, number: usize, ends: [Vector; 2], beside: [f64; 2]| {
        pen.group(&format!("class=\"bar-joint\" id=\"bar-joint-{number}\""), |pen| {
            if bar.encoders.iter().any(|encoder| usize::from(encoder.joint) == number) {
                pen.cylinder("encoder", ends, 19.0);
            }
            pen.turn((ends[0] + ends[1]) * 0.5, axes[number - 1], 31.0);
            pen.label(ends[1], beside, &format!("joint {number}"));
        });
    };

    // Base and gimbal.
    pen.block("body", gimbal - Z * 122.0, [X * 46.0, Y * 46.0, Z * 7.0]);
    pen.label(gimbal - Z * 122.0 + X * 46.0, [24.0, 8.0], "base");
    joint(pen, 1, [gimbal - Z * 115.0, gimbal - Z * 92.0], [44.0, -4.0]);
    pen.cylinder("body", [gimbal - Z * 92.0, gimbal - Z * 72.0], 24.0);
    fork_behind(pen, gimbal, -Z);
    pen.axis(gimbal, gimbal + Z * 78.0, [8.0, 6.0], "z0");
    pen.axis(gimbal, gimbal + X * 136.0, [6.0, 6.0], "x0");
    pen.cylinder("body", [gimbal + Y * 15.0, gimbal - Y * 15.0], 15.0);
    pen.cylinder("body", [gimbal + rod * 12.0, gimbal + rod * 46.0], 13.0);
    joint(pen, 3, [gimbal + rod * 46.0, gimbal + rod * 68.0], [20.0, 12.0]);
    pen.cylinder("body", [gimbal + rod * 68.0, cardan - rod * 72.0], 9.0);
    fork_arm(pen, gimbal - Y * 36.0, -Z);
    joint(pen, 2, [gimbal - Y * 41.0, gimbal - Y * 63.0], [26.0, 22.0]);

    // Plate and robot.
    let top = 112.0_f64.max(tool + 84.0);
    pen.line("axis", &[axis6 - Z * 34.0, axis6 + Z * top]);
    for ([left, low], [right, high]) in
        [([78.0, -12.0], [plate + 40.0, 0.0]), ([66.0, -12.0], [78.0, 64.0]), ([20.0, 52.0], [66.0, 64.0])]
    {
        let centre = cardan + X * ((left + right) / 2.0) + Z * ((low + high) / 2.0);
        pen.block("body", centre, [X * ((right - left) / 2.0), Y * 20.0, Z * ((high - low) / 2.0)]);
    }
    pen.label(cardan + X * (plate / 2.0) - Z * 12.0, [0.0, 34.0], "offset plate");
    let flange = axis6 + Z * tool;
    if tool > 0.0 {
        let edge = [axis6, flange].map(|end| end + X * 42.0);
        pen.cylinder("body", [axis6, flange], 28.0);
        pen.dimension(edge, X * 24.0, "");
        pen.label((edge[0] + edge[1]) * 0.5 + X * 24.0, [8.0, 5.0], &format!("tool {}", mm(bar.tool_m)));
    }
    pen.cylinder("body", [flange, flange + Z * 14.0], 36.0);
    pen.cylinder("body", [flange + Z * 14.0, flange + Z * 62.0], 23.0);
    pen.label(flange + Z * 40.0, [34.0, 0.0], "robot's flange");
    pen.label(axis6 + Z * top, [8.0, 0.0], "last axis of the robot");

    // Cardan.
    pen.axis(cardan, cardan - X * 108.0, [-6.0, 5.0], "x5");
    pen.axis(cardan, cardan - Z * 112.0, [8.0, 4.0], "z5");
    fork_behind(pen, cardan, -rod);
    pen.cylinder("body", [cardan, cardan + Z * 48.0], 8.0);
    pen.cylinder("body", [cardan + Z * 48.0, cardan + Z * 70.0], 24.0);
    pen.line("axis", &[cardan + Z * 92.0, cardan + Z * top]);
    joint(pen, 5, [cardan + Z * 70.0, cardan + Z * 92.0], [-44.0, 6.0]);
    pen.cylinder("body", [cardan + Y * 15.0, cardan - Y * 15.0], 14.0);
    fork_arm(pen, cardan - Y * 36.0, -rod);
    joint(pen, 4, [cardan - Y * 41.0, cardan - Y * 63.0], [22.0, 36.0]);

    pen.dimension([gimbal, cardan], across * 80.0, &format!("length {}", mm(bar.length_m)));
    let ends = [cardan, axis6].map(|axis| axis + Z * top);
    pen.dimension(ends, Z * 30.0, &format!("plate {}", mm(bar.plate_m)));
}

/// The rear arm of a fork, and the crosspiece between its arms. `back` is the direction from the pin to the crosspiece.
fn fork_behind(pen: &mut Pen, centre: Vector, back: Vector) {
    fork_arm(pen, centre + Y * 36.0, back);
    pen.block("body", centre + back * 66.0, [Y * 41.0, back * 6.0, Y.cross(back) * 11.0]);
}

/// One arm of a fork. It begins at the pin, `end`, and extends in the direction `back`.
fn fork_arm(pen: &mut Pen, end: Vector, back: Vector) {
    pen.block("body", end + back * 23.0, [Y * 5.0, back * 37.0, Y.cross(back) * 11.0]);
}
