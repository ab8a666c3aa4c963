//! What a path does and determines, and where the bar might stand, for a terminal.

use std::fmt::Write;

use crate::plan::{Checked, Found, Information, Places};

/// So many places are shown.
const PLACES_SHOWN: usize = 10;

/// The lines about a path, each ended. `found` is how it was found.
pub fn summary(checked: &Checked, information: &Information, found: Option<&Found>) -> String {
    let mut text = String::new();
    let mm = |m: f64| format!("{:.4} mm", m * 1e3);
    // Writing to a string cannot fail.
    let expected = information.position(&checked.normal);
    let _ = writeln!(
        text,
        "{:.1} s; expected RMS position error over the workspace after a calibration, from white noise:\n\
         {} where the axes have no errors, {} with all terms of the axes, {} with the plate's length, too;\n\
         of the terms a calibration takes those that it finds, each of them alone:",
        checked.duration_s,
        mm(expected.axes_exact_m),
        mm(expected.with_terms_m),
        mm(expected.with_plate_m)
    );
    for one in information.with_each(&checked.normal) {
        let _ = writeln!(text, "  {:<34}{}", one.group.name(), mm(one.position_m));
    }
    if let Some(found) = found {
        let best = found.random_scores.iter().copied().fold(f64::INFINITY, f64::min);
        let _ = writeln!(
            text,
            "{} moves; {} of {} changes taken; criterion {:.3} times that of the best of {} random paths",
            found.route.path.moves.len(),
            found.progress.taken,
            found.progress.tried,
            found.progress.score / best,
            found.random_scores.len()
        );
    }
    let row = |name: &str, values: Vec<f64>, digits: usize| {
        let values: String = values.iter().map(|value| format!("{:>9.digits$}", value + 0.0)).collect();
        format!("{name:<28}{values}\n")
    };
    let degrees = |values: &mut dyn Iterator<Item = f64>| values.map(f64::to_degrees).collect::<Vec<_>>();
    let range = |end: usize| degrees(&mut checked.joint_range_rad.iter().map(|range| range[end]));
    text.push_str(&row("robot joint, lowest [deg]", range(0), 1));
    text.push_str(&row("  highest [deg]", range(1), 1));
    text.push_str(&row("  speed [rad/s]", checked.speed_rad_s.to_vec(), 2));
    text.push_str(&row("  acceleration [rad/s2]", checked.acceleration_rad_s2.to_vec(), 2));
    text.push_str(&row("  jerk [rad/s3]", checked.jerk_rad_s3.to_vec(), 0));
    let winding = |end: usize| degrees(&mut checked.winding_rad.iter().map(|range| range[end]));
    text.push_str(&row("bar joint from start [deg]", winding(0), 1));
    text.push_str(&row("", winding(1), 1));
    let clearance =
        checked.clearance_m.map_or_else(String::new, |m| format!(", clearance {:.0} mm", m * 1e3));
    let _ = writeln!(
        text,
        "nearest to a singular pose of the bar {:.1} deg, of the robot {:.3} (singular value){clearance};\n\
         off the sphere at most {}",
        checked.bar_margin_rad.to_degrees(),
        checked.dexterity,
        mm(checked.off_sphere_m)
    );
    for one in &checked.violations {
        let _ = writeln!(
            text,
            "violated: {}, first at {:.3} s, for {:.3} s in all",
            one.obstacle, one.first_s, one.duration_s
        );
    }
    if checked.violations.is_empty() {
        text.push_str("all constraints are kept, checked every millisecond\n");
    }
    text
}

/// The best places of the bar, a line for each.
pub fn places(places: &Places) -> String {
    let mut text = format!(
        "{} places with a path, {} without; expected RMS position error where the axes have no errors, and with all their terms\n\
         {:>26}{:>9}{:>12}{:>12}   {}\n",
        places.found.len(),
        places.without_path,
        "--base [m]",
        "rod [m]",
        "[mm]",
        "[mm]",
        "--posture [deg]"
    );
    for place in places.found.iter().take(PLACES_SHOWN) {
        let base: Vec<String> = place.base_m.iter().map(|x| format!("{:.2}", x + 0.0)).collect();
        let posture: Vec<String> = place.posture_deg.iter().map(|q| format!("{:.0}", q + 0.0)).collect();
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "{:>26}{:>9.3}{:>12.4}{:>12.4}   {}",
            base.join(","),
            place.length_m,
            place.expected.axes_exact_m * 1e3,
            place.expected.with_terms_m * 1e3,
            posture.join(",")
        );
    }
    text
}
