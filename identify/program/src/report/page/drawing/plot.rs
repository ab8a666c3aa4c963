//! Figures with axes, as SVG text. A [`Panel`] is one pair of axes with its [`Series`] of points.
//!
//! The library `plotters` draws axes and lines. All dots of a series are one SVG path. If each dot were an element of its
//! own, the dots would take ten times as many bytes, and a browser would be slow. Title and names of the series are above
//! the axes, so that they hide no points.

use std::io;

use maud::{Markup, PreEscaped, html};
use plotters::coord::Shift;
use plotters::drawing::DrawingAreaErrorKind;
use plotters::prelude::*;

use super::thin;

/// Colours of the series, in their order.
pub(in crate::report) const COLOURS: [RGBColor; 6] = [
    RGBColor(31, 111, 178),
    RGBColor(214, 110, 22),
    RGBColor(42, 140, 86),
    RGBColor(150, 70, 150),
    RGBColor(120, 120, 120),
    RGBColor(180, 40, 60),
];

/// How the points of a series are drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::report) enum Mark {
    Dots,
    Line,
    /// Each pair of points is a separate line.
    Segments,
}

/// One set of points.
#[derive(Debug, Clone)]
pub(in crate::report) struct Series {
    /// Name of the series above the axes. If empty, the series is not named.
    pub name: String,
    pub colour: RGBColor,
    pub mark: Mark,
    pub points: Vec<(f64, f64)>,
}

impl Series {
    pub fn new(name: impl Into<String>, colour: RGBColor, mark: Mark, points: Vec<(f64, f64)>) -> Self {
        Self { name: name.into(), colour, mark, points }
    }
}

/// One pair of axes.
#[derive(Debug, Clone, Default)]
pub(in crate::report) struct Panel {
    title: String,
    x: String,
    y: String,
    /// Width and height \[px\].
    size: (u32, u32),
    series: Vec<Series>,
    /// Whether the vertical axis includes zero.
    with_zero: bool,
    /// Labels at 0, 1 and so on below the horizontal axis, in place of numbers.
    names: Vec<String>,
}

pub(in crate::report::page) const BLUE: RGBColor = COLOURS[0];
pub(in crate::report::page) const ORANGE: RGBColor = COLOURS[1];
pub(in crate::report::page) const GREEN: RGBColor = COLOURS[2];
pub(in crate::report::page) const GREY: RGBColor = RGBColor(150, 158, 168);
pub(in crate::report::page) const INK: RGBColor = RGBColor(70, 80, 92);
const MESH: RGBColor = RGBColor(230, 234, 239);
pub(in crate::report::page) const FONT: &str = "system-ui, sans-serif";

/// Number of SVG units per pixel. The library rounds coordinates to whole units, and one unit per pixel is too
/// coarse for smooth curves.
pub(in crate::report::page) const FINE: u32 = 3;

/// Height of a line of the heading, which contains title and names of series \[px\].
const TITLE_PX: u32 = 24;
const TITLE_FONT_PX: u32 = 15;
const NAME_FONT_PX: u32 = 12;
/// Width that is reserved for the labels of the vertical axis \[px\].
const LEFT_PX: u32 = 56;
const MARGIN_PX: u32 = 6;
/// Mean width of a letter divided by its height, used to estimate the width of title and names.
const LETTER: f64 = 0.56;

/// One series as one SVG path of strokes with round ends. A dot is a stroke of length zero.
struct Strokes {
    colour: RGBColor,
    path: String,
    /// Width in SVG units, see [`FINE`].
    width: u32,
    opacity: f64,
}

impl Strokes {
    /// Dots of a series. If a series has few dots, they are drawn larger.
    fn dots(colour: RGBColor, at: Vec<(i32, i32)>) -> Self {
        const FEW: usize = 200;
        let at = thin::dots(at);
        let width = if at.len() <= FEW { 5 * FINE } else { 8 * FINE / 3 };
        let path = at.iter().map(|(x, y)| format!("M{x} {y}h0")).collect();
        Self { colour, path, width, opacity: 0.7 }
    }

    fn segments(colour: RGBColor, ends: &[(i32, i32)]) -> Self {
        let line = |ends: &[(i32, i32)]| format!("M{} {}L{} {}", ends[0].0, ends[0].1, ends[1].0, ends[1].1);
        let path = ends.chunks_exact(2).map(line).collect();
        Self { colour, path, width: 2 * FINE, opacity: 1.0 }
    }

    fn svg(&self) -> String {
        let Self { colour: RGBColor(r, g, b), path, width, opacity } = self;
        format!(
            "<path d=\"{path}\" fill=\"none\" stroke=\"rgb({r},{g},{b})\" stroke-opacity=\"{opacity}\" \
             stroke-width=\"{width}\" stroke-linecap=\"round\"/>"
        )
    }
}

impl Panel {
    /// `x` and `y` are the labels of the axes, and `size` is width and height \[px\]. The axes extend as far as the points.
    pub fn new(title: impl Into<String>, [x, y]: [&str; 2], size: (u32, u32), series: Vec<Series>) -> Self {
        Self { title: title.into(), x: x.into(), y: y.into(), size, series, ..Self::default() }
    }

    /// The panel with a vertical axis that includes zero.
    pub fn with_zero(self) -> Self {
        Self { with_zero: true, ..self }
    }

    /// The panel with names in place of the numbers on the horizontal axis.
    pub fn with_names(self, names: Vec<String>) -> Self {
        Self { names, ..self }
    }

    /// Label at position `x` of the horizontal axis. `width` is the width of the axis's range.
    fn x_label(&self, x: f64, width: f64) -> String {
        if self.names.is_empty() {
            return short(x, width);
        }
        let is_whole = (x - x.round()).abs() < 1e-6 && x > -0.5;
        self.names.get(x.round() as usize).filter(|_| is_whole).cloned().unwrap_or_default()
    }

    /// Returns the figure as an SVG element. The library should not fail, because writing to a string cannot fail and the
    /// widths of letters are estimated instead of read from a font. If it fails anyway, its message replaces the figure.
    pub fn draw(&self) -> Markup {
        let mut text = String::new();
        let size = (self.size.0 * FINE, self.size.1 * FINE);
        let strokes = match self.onto(&SVGBackend::with_string(&mut text, size).into_drawing_area()) {
            Ok(strokes) => strokes,
            Err(reason) => return html! { "the figure `" (self.title) "` cannot be drawn: " (reason) },
        };
        let end = text.rfind("</svg>").unwrap_or(text.len());
        text.truncate(end);
        strokes.iter().for_each(|strokes| text.push_str(&strokes.svg()));
        text.push_str(&self.heading());
        text.push_str("</svg>\n");
        PreEscaped(text)
    }

    /// Draws axes and lines onto `area`. Returns the dots and segments, which the caller appends as SVG text.
    fn onto(
        &self,
        area: &DrawingArea<SVGBackend<'_>, Shift>,
    ) -> Result<Vec<Strokes>, DrawingAreaErrorKind<io::Error>> {
        let finite =
            || self.series.iter().flat_map(|one| &one.points).filter(|(x, y)| x.is_finite() && y.is_finite());
        let (x, y) = (range(finite().map(|p| p.0), false), range(finite().map(|p| p.1), self.with_zero));
        let mut chart = ChartBuilder::on(area)
            .margin(MARGIN_PX * FINE)
            .margin_top((self.heading_lines() * TITLE_PX + 4) * FINE)
            .margin_right(14 * FINE)
            .x_label_area_size(36 * FINE)
            .y_label_area_size(LEFT_PX * FINE)
            .build_cartesian_2d(x.0..x.1, y.0..y.1)?;
        chart
            .configure_mesh()
            .x_desc(&self.x)
            .y_desc(&self.y)
            .label_style((FONT, 12 * FINE).into_font().color(&INK))
            .axis_desc_style((FONT, 13 * FINE).into_font().color(&INK))
            .axis_style(MESH.stroke_width(FINE))
            .bold_line_style(MESH.stroke_width(FINE))
            .light_line_style(TRANSPARENT)
            .x_labels(if self.names.is_empty() { 7 } else { 2 * self.names.len() })
            .y_labels(6)
            .x_label_formatter(&|value| self.x_label(*value, x.1 - x.0))
            .y_label_formatter(&|value| short(*value, y.1 - y.0))
            .draw()?;
        let mut strokes = Vec::new();
        for one in &self.series {
            let at = one.points.iter().filter(|(x, y)| x.is_finite() && y.is_finite());
            let at: Vec<(i32, i32)> = at.map(|point| chart.as_coord_spec().translate(point)).collect();
            match one.mark {
                Mark::Dots => strokes.push(Strokes::dots(one.colour, at)),
                Mark::Segments => strokes.push(Strokes::segments(one.colour, &at)),
                Mark::Line => {
                    let line = thin::line(&at, FINE as i32);
                    area.draw(&PathElement::new(line, one.colour.stroke_width(2 * FINE)))?;
                }
            }
        }
        area.present()?;
        Ok(strokes)
    }

    fn named(&self) -> impl Iterator<Item = &Series> {
        self.series.iter().filter(|one| !one.name.is_empty())
    }

    /// Total width of the names of all series \[px\].
    fn names_px(&self) -> f64 {
        self.named().map(|one| name_px(&one.name)).sum()
    }

    /// Number of lines of the heading. Title and names of series are on one line if the figure is wide enough.
    fn heading_lines(&self) -> u32 {
        let title_px = letters_px(&self.title, TITLE_FONT_PX);
        let together_px = title_px + self.names_px() + f64::from(LEFT_PX + 4 * MARGIN_PX);
        if self.named().next().is_some() && together_px > f64::from(self.size.0) { 2 } else { 1 }
    }

    fn heading(&self) -> String {
        let fine = f64::from(FINE);
        let left_px = f64::from(LEFT_PX + MARGIN_PX);
        let mut svg = label(left_px * fine, 19.0 * fine, TITLE_FONT_PX, &self.title);
        let lines = self.heading_lines();
        let right_px = f64::from(self.size.0 - 2 * MARGIN_PX) - self.names_px();
        let mut x_px = if lines > 1 { left_px } else { right_px };
        let y_px = f64::from(lines * TITLE_PX) - 5.0;
        for one in self.named() {
            let RGBColor(r, g, b) = one.colour;
            svg.push_str(&format!(
                "<circle cx=\"{:.0}\" cy=\"{:.0}\" r=\"{}\" fill=\"rgb({r},{g},{b})\"/>",
                (x_px + 6.0) * fine,
                (y_px - 4.0) * fine,
                4 * FINE
            ));
            svg.push_str(&label((x_px + 13.0) * fine, y_px * fine, NAME_FONT_PX, &one.name));
            x_px += name_px(&one.name);
        }
        svg
    }
}

/// Width of a name, with the dot before it and the space after it \[px\].
fn name_px(name: &str) -> f64 {
    letters_px(name, NAME_FONT_PX) + 22.0
}

fn letters_px(text: &str, font_px: u32) -> f64 {
    text.chars().count() as f64 * f64::from(font_px) * LETTER
}

fn label(x: f64, y: f64, font_px: u32, text: &str) -> String {
    let RGBColor(r, g, b) = INK;
    let text = html! { (text) }.into_string();
    format!(
        "<text x=\"{x:.0}\" y=\"{y:.0}\" font-size=\"{}\" font-family=\"{FONT}\" fill=\"rgb({r},{g},{b})\">{text}</text>",
        font_px * FINE
    )
}

/// Range of an axis, from the smallest to the largest value with a margin. Without finite values, it is a default range.
fn range(values: impl Iterator<Item = f64>, with_zero: bool) -> (f64, f64) {
    let start = if with_zero { (0.0, 0.0) } else { (f64::INFINITY, f64::NEG_INFINITY) };
    let (low, high) = values.fold(start, |(low, high), value| (low.min(value), high.max(value)));
    match high - low {
        width if width > 0.0 && width.is_finite() => {
            let low_room = if with_zero && low == 0.0 { 0.0 } else { 0.04 * width };
            (low - low_room, high + 0.06 * width)
        }
        _ if low.is_finite() => (low - 0.5, low + 0.5),
        _ => (0.0, 1.0),
    }
}

/// Writes a number on an axis whose range has this width. The number has as many decimals as such an axis needs. If the
/// margin has no room for them, the number is written with an exponent.
fn short(value: f64, width: f64) -> String {
    const DECIMALS_MAX: f64 = 4.0;
    let width = width.abs().max(1e-12);
    let decimals = (1.5 - width.log10()).ceil();
    if decimals > DECIMALS_MAX && value != 0.0 && value.abs() < 10.0 * width {
        // Because of rounding errors, the label at zero may have a very small value.
        return if value.abs() < 1e-6 * width { "0".into() } else { format!("{value:.1e}") };
    }
    let decimals = decimals.clamp(0.0, 6.0) as usize;
    let written = format!("{value:.decimals$}");
    if written.trim_start_matches(['-', '0', '.']).is_empty() { "0".into() } else { written }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_beside_an_axis_are_short_and_tell_its_steps_apart() {
        for exponent in -9..6 {
            let step = 10.0_f64.powi(exponent);
            let written: Vec<String> = (-2..=4).map(|at| short(f64::from(at) * step, 6.0 * step)).collect();
            assert!(written.iter().all(|one| one.len() <= 8), "{written:?}");
            assert!(written.windows(2).all(|pair| pair[0] != pair[1]), "{written:?}");
            assert_eq!(written[2], "0");
        }
    }
}
