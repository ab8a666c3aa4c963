//! Figures as SVG text.

use plotters::coord::Shift;
use plotters::prelude::*;

/// A figure that cannot be drawn.
#[derive(Debug, thiserror::Error)]
#[error("the figure `{title}` cannot be drawn: {reason}")]
pub struct PlotError {
    title: String,
    reason: String,
}

/// Colours of sets, in their order.
pub(in crate::report) const COLOURS: [RGBColor; 6] = [
    RGBColor(31, 111, 178),
    RGBColor(214, 110, 22),
    RGBColor(42, 140, 86),
    RGBColor(150, 70, 150),
    RGBColor(120, 120, 120),
    RGBColor(180, 40, 60),
];

/// How points are shown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Mark {
    Dots,
    Line,
}

/// One set of points.
#[derive(Debug, Clone)]
pub(super) struct Series {
    pub name: &'static str,
    pub colour: RGBColor,
    pub mark: Mark,
    pub points: Vec<(f64, f64)>,
}

/// One pair of axes.
#[derive(Debug, Clone)]
pub(super) struct Panel {
    pub title: String,
    pub x: &'static str,
    pub y: String,
    /// \[px\]
    pub size: (u32, u32),
    pub series: Vec<Series>,
    /// The vertical axis includes zero.
    pub from_zero: bool,
}

pub(super) const BLUE: RGBColor = RGBColor(31, 111, 178);
pub(super) const ORANGE: RGBColor = RGBColor(214, 110, 22);
pub(super) const GREEN: RGBColor = RGBColor(42, 140, 86);
pub(super) const GREY: RGBColor = RGBColor(150, 158, 168);
const INK: RGBColor = RGBColor(70, 80, 92);
const MESH: RGBColor = RGBColor(230, 234, 239);
const FONT: &str = "system-ui, sans-serif";

/// SVG coordinates of the library are whole numbers: drawn larger, curves are smooth.
const FINE: u32 = 3;

/// More points are not seen and make the page slow.
const POINTS_MAX: usize = 1200;

impl Panel {
    pub fn draw(&self) -> Result<String, PlotError> {
        let mut text = String::new();
        {
            let area = SVGBackend::with_string(&mut text, (self.size.0 * FINE, self.size.1 * FINE))
                .into_drawing_area();
            self.onto(&area).map_err(|reason| self.error(reason))?;
            area.present().map_err(|error| self.error(error.to_string()))?;
        }
        Ok(text)
    }

    fn error(&self, reason: String) -> PlotError {
        PlotError { title: self.title.clone(), reason }
    }

    fn onto(&self, area: &DrawingArea<SVGBackend<'_>, Shift>) -> Result<(), String> {
        let finite =
            || self.series.iter().flat_map(|one| &one.points).filter(|(x, y)| x.is_finite() && y.is_finite());
        let (x, y) = (range(finite().map(|p| p.0), false), range(finite().map(|p| p.1), self.from_zero));
        let mut chart = ChartBuilder::on(area)
            .caption(&self.title, (FONT, 15 * FINE).into_font().color(&INK))
            .margin(6 * FINE)
            .margin_right(14 * FINE)
            .x_label_area_size(36 * FINE)
            .y_label_area_size(56 * FINE)
            .build_cartesian_2d(x.0..x.1, y.0..y.1)
            .map_err(text)?;
        chart
            .configure_mesh()
            .x_desc(self.x)
            .y_desc(&self.y)
            .label_style((FONT, 12 * FINE).into_font().color(&INK))
            .axis_desc_style((FONT, 13 * FINE).into_font().color(&INK))
            .axis_style(MESH.stroke_width(FINE))
            .bold_line_style(MESH.stroke_width(FINE))
            .light_line_style(TRANSPARENT)
            .x_labels(7)
            .y_labels(6)
            .x_label_formatter(&|value| short(*value, x.1 - x.0))
            .y_label_formatter(&|value| short(*value, y.1 - y.0))
            .draw()
            .map_err(text)?;
        for one in &self.series {
            let points = thinned(&one.points);
            let colour = one.colour;
            let drawn = match one.mark {
                Mark::Line => chart.draw_series(LineSeries::new(points, colour.stroke_width(2 * FINE))),
                Mark::Dots => {
                    let dot = |point| Circle::new(point, FINE + 1, colour.mix(0.55).filled());
                    chart.draw_series(points.into_iter().map(dot))
                }
            };
            drawn
                .map_err(text)?
                .label(one.name)
                .legend(move |(x, y)| Circle::new((x + 9 * FINE as i32, y), 4 * FINE, colour.filled()));
        }
        if self.series.len() > 1 {
            chart
                .configure_series_labels()
                .position(SeriesLabelPosition::UpperRight)
                .background_style(WHITE.mix(0.85))
                .legend_area_size(20 * FINE)
                .margin(4 * FINE)
                .label_font((FONT, 12 * FINE).into_font().color(&INK))
                .draw()
                .map_err(text)?;
        }
        Ok(())
    }
}

pub(super) fn text(error: impl std::fmt::Display) -> String {
    error.to_string()
}

/// At most so many points, evenly picked.
fn thinned(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let every = points.len().div_ceil(POINTS_MAX).max(1);
    points.iter().step_by(every).filter(|(x, y)| x.is_finite() && y.is_finite()).copied().collect()
}

/// Smallest to largest with a little room; something that can be drawn where there is nothing.
fn range(values: impl Iterator<Item = f64>, from_zero: bool) -> (f64, f64) {
    let start = if from_zero { (0.0, 0.0) } else { (f64::INFINITY, f64::NEG_INFINITY) };
    let (low, high) = values.fold(start, |(low, high), value| (low.min(value), high.max(value)));
    match high - low {
        width if width > 0.0 && width.is_finite() => {
            let low_room = if from_zero && low == 0.0 { 0.0 } else { 0.04 * width };
            (low - low_room, high + 0.06 * width)
        }
        _ if low.is_finite() => (low - 0.5, low + 0.5),
        _ => (0.0, 1.0),
    }
}

/// As many decimals as an axis of this width needs.
fn short(value: f64, width: f64) -> String {
    let decimals = (1.5 - width.abs().max(1e-12).log10()).ceil().clamp(0.0, 6.0) as usize;
    let written = format!("{value:.decimals$}");
    if written.trim_start_matches(['-', '0', '.']).is_empty() { "0".into() } else { written }
}

/// Values with intervals, several sets of them side by side under each name.
#[derive(Debug, Clone)]
pub(in crate::report) struct Intervals {
    pub title: String,
    pub y: String,
    pub names: Vec<String>,
    /// Per set, per name: value and half the width of its interval; none where there is none.
    pub sets: Vec<Vec<Option<(f64, f64)>>>,
}

impl Intervals {
    /// As SVG text.
    pub fn draw(&self) -> Result<String, PlotError> {
        let mut text = String::new();
        {
            let area = SVGBackend::with_string(&mut text, (920 * FINE, 260 * FINE)).into_drawing_area();
            let error = |reason| PlotError { title: self.title.clone(), reason };
            self.onto(&area).map_err(error)?;
            area.present().map_err(|failure| error(failure.to_string()))?;
        }
        Ok(text)
    }

    fn onto(&self, area: &DrawingArea<SVGBackend<'_>, Shift>) -> Result<(), String> {
        let ends =
            self.sets.iter().flatten().flatten().flat_map(|(value, half)| [value - half, value + half]);
        let (low, high) = range(ends.chain([0.0]), false);
        let right = self.names.len() as f64 - 0.5;
        let mut chart = ChartBuilder::on(area)
            .caption(&self.title, (FONT, 15 * FINE).into_font().color(&INK))
            .margin(6 * FINE)
            .x_label_area_size(30 * FINE)
            .y_label_area_size(56 * FINE)
            .build_cartesian_2d(-0.5..right.max(0.5), low..high)
            .map_err(text)?;
        chart
            .configure_mesh()
            .y_desc(&self.y)
            .label_style((FONT, 12 * FINE).into_font().color(&INK))
            .axis_desc_style((FONT, 13 * FINE).into_font().color(&INK))
            .axis_style(MESH.stroke_width(FINE))
            .bold_line_style(MESH.stroke_width(FINE))
            .light_line_style(TRANSPARENT)
            .x_labels(2 * self.names.len().max(1))
            .x_label_formatter(&|at| self.name_at(*at))
            .y_label_formatter(&|value| short(*value, high - low))
            .draw()
            .map_err(text)?;
        for (index, set) in self.sets.iter().enumerate() {
            let colour = COLOURS[index % COLOURS.len()];
            let aside = 0.6 * ((index as f64 + 0.5) / self.sets.len() as f64 - 0.5);
            for (name, (value, half)) in set.iter().enumerate().filter_map(|(i, one)| Some((i, (*one)?))) {
                let x = name as f64 + aside;
                let line =
                    PathElement::new([(x, value - half), (x, value + half)], colour.stroke_width(2 * FINE));
                chart.draw_series([line]).map_err(text)?;
                chart.draw_series([Circle::new((x, value), 3 * FINE, colour.filled())]).map_err(text)?;
            }
        }
        Ok(())
    }

    /// Labels stand at whole numbers; others stay empty.
    fn name_at(&self, at: f64) -> String {
        let whole = (at - at.round()).abs() < 1e-6;
        let name = self.names.get(at.round() as usize).filter(|_| whole && at > -0.5);
        name.cloned().unwrap_or_default()
    }
}
