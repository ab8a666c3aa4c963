//! Tables of poses with a measured length: mappings, reading, and files that must be refused.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::path::Path;

use identify::logs::{LogError, MeasuredLengthMapping, MeasuredLengths};
use proptest::prelude::*;
use shared::config::{self, ConfigError};

const HEADER: &str = "x_mm,y_mm,z_mm,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,cable_mm";

fn example() -> MeasuredLengthMapping {
    config::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/measured_length.toml")).unwrap()
}

fn mapping(text: &str) -> Result<MeasuredLengthMapping, ConfigError> {
    config::parse(text, Path::new("mapping.toml"))
}

fn read(text: &str, mapping: &MeasuredLengthMapping) -> Result<MeasuredLengths, LogError> {
    MeasuredLengths::read(text.as_bytes(), Path::new("lengths.csv"), mapping)
}

fn table(row: &str) -> String {
    format!("{HEADER}\n{}", format!("{row}\n").repeat(12))
}

#[test]
fn the_shipped_example_reads_degrees_and_millimetres() {
    let rows = read(&table("1,2,3,-74.5,33.9,-30.8,-15.1,80.5,-59.7,509.19"), &example()).unwrap().rows;
    assert_eq!(rows.len(), 12);
    assert_eq!(rows[0].line, 2);
    assert!((rows[3].length_m - 0.50919).abs() < 1e-12);
    assert!((rows[3].joints_rad[0] + 74.5_f64.to_radians()).abs() < 1e-12);
    assert!((rows[3].joints_rad[5] + 59.7_f64.to_radians()).abs() < 1e-12);
    assert_eq!(rows[3].flange_m, Some([1e-3, 2e-3, 3e-3]));
}

#[test]
fn semicolons_decimal_commas_signs_and_offsets_follow_the_mapping() {
    let joints: String = (1..=6)
        .map(|joint| {
            format!("[[joints]]\ncolumn = \"j{joint}\"\nunit = \"rad\"\nsign = -1\noffset_deg = 90\n")
        })
        .collect();
    let text = format!(
        "[csv]\ndelimiter = \";\"\ndecimal_comma = true\n[length]\ncolumn = \"L\"\nunit = \"m\"\n{joints}"
    );
    let mapping = mapping(&text).unwrap();
    let csv = format!("j1;j2;j3;j4;j5;j6;L\n{}", "0,5;1;1;1;1;1;0,75\r\n".repeat(10));
    let row = read(&csv, &mapping).unwrap().rows[0];
    assert!((row.length_m - 0.75).abs() < 1e-12);
    assert!((row.joints_rad[0] - (std::f64::consts::FRAC_PI_2 - 0.5)).abs() < 1e-12);
    assert_eq!(row.flange_m, None);
}

#[test]
fn bad_cells_are_refused_with_line_and_column() {
    let good = table("1,2,3,-74.5,33.9,-30.8,-15.1,80.5,-59.7,509.19");
    for (row, column, problem) in [
        ("1,2,3,-74.5,33.9,-30.8,NaN,80.5,-59.7,509.19", "q4_deg", "finite"),
        ("1,2,3,-74.5,33.9,-30.8,-15.1,80.5,-59.7,", "cable_mm", "empty"),
        ("1,2,3,-74.5,33.9,-30.8,-15.1,80.5,-59.7,-5", "cable_mm", "above 0 and at most 20 m"),
        ("1,2,3,-74.5,33.9,-30.8,-15.1,80.5,-59.7,0", "cable_mm", "above 0 and at most 20 m"),
        ("1,2,3,-74.5,3390,-30.8,-15.1,80.5,-59.7,509.19", "q2_deg", "two turns; correct or remove the row"),
    ] {
        let error = read(&format!("{good}{row}\n"), &example()).unwrap_err().to_string();
        assert!(error.contains(&format!("line 14 column `{column}`")), "{error}");
        assert!(error.contains(problem), "{error}");
    }
    let error = read(&good.replace("cable_mm", "wire"), &example()).unwrap_err().to_string();
    assert!(error.contains("`cable_mm` is missing") && error.contains("wire"), "{error}");
    assert!(matches!(read(HEADER, &example()), Err(LogError::TooFewRows { rows: 0, .. })));
}

#[test]
fn a_layout_that_the_file_does_not_have_is_refused_with_what_to_write() {
    let good = table("1,2,3,-74.5,33.9,-30.8,-15.1,80.5,-59.7,509.19");
    let refusal = |text: &str| read(text, &example()).unwrap_err().to_string();
    let semicolons = refusal(&good.replace(',', ";").replace('.', ","));
    assert!(semicolons.contains("write delimiter = \";\" under [csv]"), "{semicolons}");
    let without_header = refusal(good.trim_start_matches(HEADER).trim_start());
    assert!(without_header.contains("There are numbers in place of the header"), "{without_header}");
    let cut = refusal(&good[..good.len() - ",509.19\n".len()]);
    assert!(cut.contains("line 13: 9 cells where the header has 10, in the last line"), "{cut}");
    let short = refusal(&good.replacen(",509.19", "", 1));
    assert!(short.contains("line 2: 9 cells") && !short.contains("last line"), "{short}");
}

/// Without a check, a cell with such a mark contains the following rows, and these rows are lost.
#[test]
fn a_quotation_mark_that_is_not_closed_is_refused_with_its_line() {
    let row = "1,2,3,-74.5,33.9,-30.8,-15.1,80.5,-59.7,509.19";
    let remarked = |header: &str, row: &dyn Fn(usize) -> String| {
        let rows: String = (0..12).map(|index| format!("{}\n", row(index))).collect();
        read(&format!("{header}\n{rows}"), &example())
    };
    let last = format!("{HEADER},remark");
    let from = |at: usize, remark: &'static str| move |index: usize| if index < at { "" } else { remark };
    let only = |at: usize, remark: &'static str| move |index: usize| if index == at { remark } else { "" };
    let closed = remarked(&last, &|index| format!("{row},{}", only(3, "\"slow, again\"")(index)));
    assert_eq!(closed.unwrap().rows.len(), 12);
    let ditto = remarked(&last, &|index| format!("{row},{}", from(3, "\"")(index)));
    let open = remarked(&last, &|index| format!("{row},{}", only(3, "\"fast")(index)));
    let first = remarked(&format!("remark,{HEADER}"), &|index| format!("{},{row}", only(3, "\"fast")(index)));
    let at_end = remarked(&last, &|index| format!("{row},{}", only(11, "\"")(index)));
    for (table, line) in [(ditto, 5), (open, 5), (first, 5), (at_end, 13)] {
        let error = table.unwrap_err().to_string();
        assert!(error.contains(&format!("line {line}: a quotation mark is not closed")), "{error}");
        assert!(!error.contains("last line"), "{error}");
    }
}

#[test]
fn stated_uncertainties_are_read_in_millimetres() {
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/measured_length.toml");
    let text = std::fs::read_to_string(shipped).unwrap();
    let stated = text.replace("# [uncertainty]\n# length_mm", "[uncertainty]\nlength_mm");
    let stated = self::mapping(&stated).unwrap();
    let rows = |last: &str| {
        let row = "1,2,3,-74.5,33.9,-30.8,-15.1,80.5,-59.7,509.19";
        format!("{HEADER},cable_u\n{}{row},{last}\n", format!("{row},0.2\n").repeat(12))
    };
    let read = self::read(&rows("1.5"), &stated).unwrap().rows;
    assert_eq!((read[0].uncertainty_m, read[12].uncertainty_m), (Some(0.2 * 1e-3), Some(1.5 * 1e-3)));
    // Stated uncertainties that are missing, too small, not a valid number, or in a wrong unit.
    for bad in ["", "0", "-0.1", "250"] {
        let error = self::read(&rows(bad), &stated).unwrap_err().to_string();
        assert!(error.contains("line 14 column `cable_u`"), "{error}");
    }
    let error = mapping(&text.replace("[length]", "[uncertainty]\nlength_m = \"u\"\n[length]")).unwrap_err();
    assert!(error.to_string().contains("length_m"), "{error}");
}

#[test]
fn a_mapping_that_cannot_work_is_refused_by_key() {
    let text =
        std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/measured_length.toml"))
            .unwrap();
    for (from, to, key) in [
        ("decimal_comma = false", "decimal_comma = true", "delimiter"),
        ("sign = 1", "sign = 2", "joints[0].sign"),
        ("delimiter = \",\"", "delimiter = \"#\"", "delimiter"),
        ("column = \"q6_deg\"", "colum = \"q6_deg\"", "joints"),
    ] {
        let error = mapping(&text.replace(from, to)).unwrap_err().to_string();
        assert!(error.contains(key), "{error}");
    }
}

proptest! {
    #[test]
    fn no_text_makes_the_reader_panic(text in "\\PC*") {
        let _ = read(&text, &example());
    }

    #[test]
    fn rows_come_back_as_written(values in prop::collection::vec((-360.0f64..360.0, 0.001f64..5000.0), 10..30)) {
        let rows: String = values.iter().map(|(q, length)| format!("0,0,0,{q},0,0,0,0,{q},{length}\n")).collect();
        let read = read(&format!("{HEADER}\n{rows}"), &example()).unwrap().rows;
        prop_assert_eq!(read.len(), values.len());
        for (row, (q, length)) in read.iter().zip(values) {
            prop_assert!((row.joints_rad[5] - q.to_radians()).abs() < 1e-12);
            prop_assert!((row.length_m - length * 1e-3).abs() < 1e-12);
        }
    }
}

#[test]
fn the_uncertainty_of_the_scale_is_optional_and_may_be_zero() {
    let with = |line: &str| {
        let text = std::fs::read_to_string(
            Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/measured_length.toml"),
        );
        mapping(&text.unwrap().replace("scale_u_ppm = 500.0", line))
    };
    assert_eq!(with("").unwrap().scale_u_ppm, None);
    assert_eq!(with("scale_u_ppm = 0.0").unwrap().scale_u_ppm, Some(0.0));
    for refused in ["scale_u_ppm = -1.0", "scale_u_ppm = 5e5", "scale_u_ppm = nan"] {
        let told = with(refused).unwrap_err().to_string();
        assert!(told.contains("scale_u_ppm"), "{told}");
    }
}
