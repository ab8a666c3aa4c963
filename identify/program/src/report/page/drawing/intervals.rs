//! Values with intervals as SVG text.

use plotters::coord::Shift;
use plotters::prelude::*;

use super::plot::{COLOURS, FINE, FONT, INK, MESH, PlotError, range, short, text};

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
            let error = |reason| PlotError::new(&self.title, reason);
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
