//! Fuzz target: reads and compares calibrations from arbitrary text.

use std::path::Path;

use identify::report::Consistency;
use identify::report::result::file::{CalibrationFile, ParameterEntry, ParameterStatus, SolveEntry};
use identify::report::side_by_side;

use super::explained;

/// Reads a text as `calibration.json` and as `calibration.toml`. An accepted calibration is compared with a changed copy of
/// itself. If the text is refused, the error must contain a reason.
pub fn any_text(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    for name in ["calibration.json", "calibration.toml"] {
        match CalibrationFile::parse(text, Path::new(name)) {
            Ok(file) => compare(&file),
            Err(error) => explained(&error),
        }
    }
}

fn compare(file: &CalibrationFile) {
    let mut other = file.clone();
    // The copy has other corrections and standard deviations.
    for entry in other.parameters.iter_mut().step_by(2) {
        entry.correction *= 0.5;
        entry.sigma = entry.sigma.map(|sigma| 2.0 * sigma);
    }
    match Consistency::new(&[file.clone(), other]) {
        Ok(consistency) => {
            assert!(consistency.p_corrected.is_none_or(|p| (0.0..=1.0).contains(&p)), "no probability");
            let names = ["first".to_owned(), "second".to_owned()];
            assert!(side_by_side::table(&consistency, &names).contains("parameter"));
            assert!(side_by_side::page(&consistency, &file.robot, &names).0.contains("</html>"));
        }
        Err(error) => explained(&error),
    }
}

/// Seeds: a calibration with few parameters, in both file formats.
pub fn files() -> Vec<Vec<u8>> {
    let solve = SolveEntry {
        cost: "pose".into(),
        ended: "converged".into(),
        iterations: 7,
        samples: 1500,
        parameters: 3,
        condition: 41.5,
        residual_rms_start: 3e-3,
        residual_rms: 2e-5,
    };
    let entry = |(name, unit, nominal, correction): (&str, &str, f64, f64)| ParameterEntry {
        name: name.into(),
        unit: unit.into(),
        nominal,
        value: nominal + correction,
        correction,
        sigma: (correction != 0.0).then_some(1e-5),
        status: if correction == 0.0 { ParameterStatus::Fixed } else { ParameterStatus::Identified },
    };
    let parameters = [
        ("ra1", "m", 0.1, 2e-4),
        ("rtheta2", "rad", 0.0, -1e-4),
        ("ox", "m", 1.0, 3e-3),
        ("rd3", "m", 0.0, 0.0),
    ]
    .map(entry);
    let file = CalibrationFile {
        created: "2026-11-22T10:15:00Z".into(),
        ..CalibrationFile::new("seed", "bar", solve, Vec::new(), parameters.to_vec())
    };
    vec![
        serde_json::to_vec(&file).expect("a calibration as JSON"),
        toml::to_string(&file).expect("a calibration as TOML").into_bytes(),
    ]
}
