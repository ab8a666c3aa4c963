//! Projects solids, arrows and dimensions onto a plane (parallel projection), and writes them as elements of an SVG.

use std::fmt::Write;
use std::ops::{Add, Mul, Neg, Sub};

/// A point or a direction in space \[px\].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Vector(pub [f64; 3]);

impl Vector {
    fn dot(self, other: Self) -> f64 {
        self.0.iter().zip(other.0).map(|(a, b)| a * b).sum()
    }

    /// Cross product of two vectors, by the right-hand rule.
    pub fn cross(self, Self([x, y, z]): Self) -> Self {
        let Self([a, b, c]) = self;
        Self([b * z - c * y, c * x - a * z, a * y - b * x])
    }

    fn unit(self) -> Self {
        self * (1.0 / self.dot(self).sqrt().max(f64::MIN_POSITIVE))
    }
}

impl Add for Vector {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self([0, 1, 2].map(|i| self.0[i] + other.0[i]))
    }
}

impl Mul<f64> for Vector {
    type Output = Self;
    fn mul(self, factor: f64) -> Self {
        Self(self.0.map(|value| value * factor))
    }
}

impl Neg for Vector {
    type Output = Self;
    fn neg(self) -> Self {
        self * -1.0
    }
}

impl Sub for Vector {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        self + -other
    }
}

/// A point of the SVG \[px\]. The first coordinate points right, the second down.
type PointPx = [f64; 2];

/// Rounds a coordinate of the SVG to a tenth of a pixel.
fn px(value: f64) -> f64 {
    // Adding 0.0 turns a negative zero into a positive one.
    (value * 10.0).round() / 10.0 + 0.0
}

/// Unit vector from one point to another.
fn unit(from: PointPx, to: PointPx) -> PointPx {
    let [x, y] = [to[0] - from[0], to[1] - from[1]];
    [x, y].map(|part| part / x.hypot(y).max(f64::MIN_POSITIVE))
}

/// Collects the elements of a drawing from back to front. Each element covers the elements before it.
#[derive(Debug)]
pub struct Pen {
    right: Vector,
    up: Vector,
    /// Direction from the drawing to the observer.
    towards: Vector,
    elements: String,
    low: PointPx,
    high: PointPx,
}

impl Pen {
    /// A pen for an observer who looks along `+y`. The position of the observer is first rotated about z by the azimuth,
    /// then raised by the elevation \[deg\].
    pub fn new([azimuth_deg, elevation_deg]: [f64; 2]) -> Self {
        let (sin, cos) = azimuth_deg.to_radians().sin_cos();
        let (sin_elevation, cos_elevation) = elevation_deg.to_radians().sin_cos();
        let right = Vector([cos, sin, 0.0]);
        let towards = Vector([sin * cos_elevation, -cos * cos_elevation, sin_elevation]);
        let (low, high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        Self { right, up: towards.cross(right), towards, elements: String::new(), low, high }
    }

    fn project(&self, point: Vector) -> PointPx {
        [point.dot(self.right), -point.dot(self.up)]
    }

    /// Enlarges the bounds of the drawing so that they contain a point.
    fn include(&mut self, place: PointPx) {
        for (i, value) in place.into_iter().enumerate() {
            (self.low[i], self.high[i]) = (self.low[i].min(value), self.high[i].max(value));
        }
    }

    fn path(&mut self, class: &str, data: &str) {
        _ = writeln!(self.elements, "<path class=\"{class}\" d=\"{data}\"/>");
    }

    /// Adds a path through corners. The path is closed if `end` is `Z`, and open if `end` is empty.
    fn corners(&mut self, class: &str, corners: &[PointPx], end: &str) {
        corners.iter().for_each(|corner| self.include(*corner));
        let points: Vec<String> = corners.iter().map(|[x, y]| format!("{} {}", px(*x), px(*y))).collect();
        self.path(class, &format!("M{}{end}", points.join("L")));
    }

    /// Adds the tip of an arrow from `from` to `to`. The tip is at `to`.
    fn tip(&mut self, from: PointPx, to: PointPx) {
        let [x, y] = unit(from, to);
        let side = |half: f64| [to[0] - 10.0 * x - half * y, to[1] - 10.0 * y + half * x];
        self.corners("tip", &[to, side(3.5), side(-3.5)], "Z");
    }

    /// Puts the elements that `draw` adds into a group with these attributes.
    pub fn group(&mut self, attributes: &str, draw: impl FnOnce(&mut Self)) {
        _ = writeln!(self.elements, "<g {attributes}>");
        draw(self);
        self.elements.push_str("</g>\n");
    }

    /// A line through points.
    pub fn line(&mut self, class: &str, points: &[Vector]) {
        let points: Vec<PointPx> = points.iter().map(|point| self.project(*point)).collect();
        self.corners(class, &points, "");
    }

    /// A cylinder, given by the centres of its ends. First its outline is drawn, then the end that faces the observer.
    pub fn cylinder(&mut self, class: &str, ends: [Vector; 2], radius: f64) {
        // The ends of the cylinder appear as ellipses. `ratio` is the minor axis divided by the major axis. It is negative
        // if the first end faces the observer.
        let ratio = (ends[1] - ends[0]).unit().dot(self.towards);
        let [near, far] = if ratio < 0.0 { ends } else { [ends[1], ends[0]] }.map(|end| self.project(end));
        let [x, y] = unit(far, near).map(|part| part * radius);
        let [minor, turned_deg] = [radius * ratio.abs(), x.atan2(-y).to_degrees()].map(px);
        let arc = format!("A{radius} {minor} {turned_deg} 0 1");
        let [[right, left], [far_right, far_left]] = [near, far].map(|[centre_x, centre_y]| {
            self.include([centre_x - radius, centre_y - radius]);
            self.include([centre_x + radius, centre_y + radius]);
            [1.0, -1.0].map(|side| format!("{} {}", px(centre_x - side * y), px(centre_y + side * x)))
        });
        self.path(class, &format!("M{far_right}{arc} {far_left}L{left}{arc} {right}Z"));
        self.path(class, &format!("M{right}{arc} {left}{arc} {right}Z"));
    }

    /// A block, given by its centre and three half edges.
    pub fn block(&mut self, class: &str, centre: Vector, halves: [Vector; 3]) {
        // The observer sees three of the six faces. Of two opposite faces, the nearer one is visible.
        for turn in 0..3 {
            let [normal, a, b] = [0, 1, 2].map(|i| halves[(turn + i) % 3]);
            let face_centre = centre + normal * normal.dot(self.towards).signum();
            let corners = [a + b, a - b, -a - b, b - a];
            self.corners(class, &corners.map(|corner| self.project(face_centre + corner)), "Z");
        }
    }

    /// An axis of a coordinate frame, with its name at the tip.
    pub fn axis(&mut self, from: Vector, to: Vector, beside: PointPx, name: &str) {
        self.line("thin", &[from, to - (to - from).unit() * 6.0]);
        self.tip(self.project(from), self.project(to));
        self.label(to, beside, name);
    }

    /// A curved arrow about an axis, in the direction of the right-hand rule, on the side that faces the observer.
    pub fn turn(&mut self, centre: Vector, axis: Vector, radius: f64) {
        let front = (self.towards - axis * self.towards.dot(axis)).unit();
        let side = axis.cross(front);
        let point_at = |deg: i32| {
            let (sin, cos) = f64::from(deg).to_radians().sin_cos();
            centre + (front * cos + side * sin) * radius
        };
        let points: Vec<Vector> = (-10..=10).map(|step| point_at(step * 10)).collect();
        self.line("turn", &points);
        self.tip(self.project(point_at(100)), self.project(point_at(116)));
    }

    /// A dimension line, parallel to the line between the points `ends` and displaced from it by `beside`. `ends` are in
    /// order from left to right. `text` is written above the line.
    pub fn dimension(&mut self, ends: [Vector; 2], beside: Vector, text: &str) {
        for end in ends {
            self.line("thin", &[end, end + beside + beside.unit() * 6.0]);
        }
        let ends = ends.map(|end| end + beside);
        self.line("thin", &ends);
        let [from, to] = ends.map(|end| self.project(end));
        self.tip(to, from);
        self.tip(from, to);
        let [right, down] = unit(from, to);
        let [x, y] = [0, 1].map(|i| px((from[i] + to[i]) / 2.0));
        let place = format!("translate({x} {y}) rotate({})", px(down.atan2(right).to_degrees()));
        _ = writeln!(
            self.elements,
            "<text text-anchor=\"middle\" transform=\"{place}\" y=\"-6\">{text}</text>"
        );
    }

    /// A text next to a point, displaced by `beside`. If `beside` points right, the text begins
    /// there; otherwise it ends there.
    pub fn label(&mut self, point: Vector, beside: PointPx, text: &str) {
        /// Width of a character and height of a line \[px\].
        const CHARACTER_PX: PointPx = [7.5, 14.0];
        let point = self.project(point);
        let [x, y] = [0, 1].map(|i| px(point[i] + beside[i]));
        self.include([x + CHARACTER_PX[0] * text.len() as f64 * beside[0].signum(), y - CHARACTER_PX[1]]);
        self.include([x, y + 4.0]);
        let anchor = if beside[0] < 0.0 { "end" } else { "start" };
        _ = writeln!(self.elements, "<text x=\"{x}\" y=\"{y}\" text-anchor=\"{anchor}\">{text}</text>");
    }

    /// The SVG with all elements. `head` is inserted before them.
    pub fn finish(self, attributes: &str, head: &str) -> String {
        const MARGIN_PX: f64 = 12.0;
        let [left, top] = self.low.map(|low| (low - MARGIN_PX).floor());
        let [width, height] = [self.high[0] - left, self.high[1] - top].map(|size| (size + MARGIN_PX).ceil());
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
             viewBox=\"{left} {top} {width} {height}\" {attributes}>\n{head}{}</svg>\n",
            self.elements
        )
    }
}
