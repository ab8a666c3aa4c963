//! Maps of the expected position error over the workspace, with the nominal and the calibrated robot, for the certificate.

use maud::{Markup, html};
use plotters::style::RGBColor;

use super::figures::dots;
use super::plot::Panel;
use crate::evaluate::{PlaceError, WorkspaceError};
use crate::report::page::sections::mm;

/// Colour of each fifth of the positions, sorted from the smallest errors to the largest.
const FIFTHS: [RGBColor; 5] = [
    RGBColor(186, 212, 236),
    RGBColor(124, 174, 214),
    RGBColor(66, 128, 184),
    RGBColor(28, 82, 140),
    RGBColor(180, 40, 60),
];

/// Width and height of one map \[px\]. The certificate shows two maps side by side.
const SHEET: (u32, u32) = (450, 300);

/// Two maps, one with the nominal and one with the calibrated robot. Empty without positions.
pub(in crate::report::page) fn map(workspace: &WorkspaceError) -> Markup {
    if workspace.places.is_empty() {
        return html! {};
    }
    html! { figure {
        div.panels {
            (one_map("Nominal robot", &workspace.places, |place| place.before_m))
            (one_map("Calibrated robot", &workspace.places, |place| place.after_m))
        }
        figcaption {
            "Position error that is expected by place, root mean square. Each dot is a posture within the joint limits, each colour a "
            "fifth of the postures; each map has its own scale. Red: the worst fifth, where more measurements help most."
        }
    } }
}

/// Draws one map, with a dot for each position. Each fifth of the positions is a series, and the name of the series is the
/// largest error in the fifth.
fn one_map(title: &str, places: &[PlaceError], error_m: fn(&PlaceError) -> f64) -> Markup {
    let mut sorted: Vec<&PlaceError> = places.iter().collect();
    sorted.sort_by(|a, b| error_m(a).total_cmp(&error_m(b)));
    // Distance from the first axis and height [mm].
    let point = |place: &&PlaceError| {
        let [x, y, z] = place.position_m;
        (x.hypot(y) * 1e3, z * 1e3)
    };
    let fifths = sorted.chunks(sorted.len().div_ceil(FIFTHS.len())).zip(FIFTHS);
    let series = fifths.map(|(fifth, colour)| {
        let most_m = fifth.last().map_or(0.0, |place| error_m(place));
        dots(mm(most_m), colour, fifth.iter().map(point).collect())
    });
    let axes = ["distance from axis 1 [mm]", "height [mm]"];
    Panel::new(format!("{title}, up to [mm]"), axes, SHEET, series.collect()).draw()
}
