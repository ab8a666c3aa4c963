//! Describes in a sentence what determines the scale of all lengths (the reference of the scale). If there is only one
//! reference, no other measurement can verify it.

use std::borrow::Cow;
use std::path::Path;

use shared::config::{BallBarConfig, Source};
use shared::output::named;

use super::Budget;
use crate::instrument::{Run, ScaleFrom};
use crate::model::{ParameterId, Role};

/// Length error of a plate that serves as an example in the sentence \[m\].
const LONGER_M: f64 = 1e-4;

/// The sentence about the reference of the scale. References are the plates of `bars`, each with the source of its
/// configuration, and the instruments of `others`, each with the file of its mapping. The budget contains the effect of a
/// plate error on positions.
pub fn scale_sentence<'a>(
    bars: impl IntoIterator<Item = (&'a BallBarConfig, Source)>,
    others: impl IntoIterator<Item = (&'a Run, &'a Path)>,
    budget: &Budget,
) -> String {
    const NAMED: usize = 3;
    let mut references: Vec<String> = Vec::new();
    let plates = bars.into_iter().map(|(bar, source)| plate(bar, &source));
    let others = others.into_iter().filter_map(|(run, mapping)| other_reference(run, mapping));
    for reference in plates.chain(others) {
        if !references.contains(&reference) {
            references.push(reference);
        }
    }
    let moved = budget.moved_by_plate.map(|per_metre| {
        format!(
            "; a plate longer by {} mm would move positions by {:.2} mm (RMS over the workspace)",
            LONGER_M * 1e3,
            per_metre * LONGER_M * 1e3
        )
    });
    named(&references, NAMED) + &moved.unwrap_or_default()
}

fn plate(bar: &BallBarConfig, source: &Source) -> String {
    let file = file_name(source.path());
    let plate_mm = bar.plate_m * 1e3;
    let rod = bar.length_u_um.map(|u_um| {
        format!(" and the rod's length of {:.3} mm within {:.3} mm", bar.length_m * 1e3, u_um * 1e-3)
    });
    let plate = if bar.plate_u_um > 0.0 {
        format!("the offset plate of {plate_mm:.3} mm within {:.3} mm (one sigma)", bar.plate_u_um * 1e-3)
    } else {
        format!("the offset plate of {plate_mm:.3} mm, taken as exact")
    };
    // A configured value equal to the default has the same meaning as the default.
    let is_default = bar.plate_u_um == BallBarConfig::PLATE_U_UM;
    let source = if matches!(source, Source::BuiltIn(..)) {
        "an example that is built in: write the lengths of your bar into ball_bar.toml".to_owned()
    } else if is_default {
        format!(
            "the default for a calliper: write plate_u_um into {file} if the plate was measured by other means"
        )
    } else {
        format!("as {file} states")
    };
    format!("{plate}{}, {source}", rod.unwrap_or_default())
}

fn other_reference(Run { instrument, model }: &Run, mapping: &Path) -> Option<String> {
    let from = instrument.scale();
    let reference = match from {
        ScaleFrom::Plate => return None,
        ScaleFrom::Tracker => "the positions of the tracker",
        ScaleFrom::Wire => "the lengths of the wire",
        ScaleFrom::Sockets => "the table of sockets, within the uncertainty that it states",
        ScaleFrom::Faces => "the distances between faces, within the uncertainty that their table states",
        ScaleFrom::Robot => "the lengths of the robot's own file: no distance between the faces is known",
    };
    let file = file_name(mapping);
    let uncertainty = match model.role(ParameterId::Scale) {
        Some(Role::Prior { sigma, .. }) => {
            let is_usual = sigma == from.usual_u_ppm() * 1e-6;
            let source = if is_usual {
                format!("the default: state scale_u_ppm in {file} if yours differs")
            } else {
                format!("as {file} states")
            };
            format!(" within {} (one sigma), {source}", ParameterId::Scale.unit().display(sigma))
        }
        Some(Role::Free) => ", with an estimated scale".to_owned(),
        Some(Role::Fixed | Role::Considered { .. }) => ", taken as exact".to_owned(),
        None => String::new(),
    };
    Some(reference.to_owned() + &uncertainty)
}

fn file_name(path: &Path) -> Cow<'_, str> {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy()
}
