//! The drawing of the bar shows its configured lengths and its joints.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::path::{Path, PathBuf};

use shared::config::{self, BallBarConfig};
use shared::drawing::ball_bar;

fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

fn shipped() -> BallBarConfig {
    config::load(&repository("config/ball_bar.toml")).unwrap()
}

/// Lines of the SVG that contain this text.
fn lines<'a>(svg: &'a str, text: &str) -> Vec<&'a str> {
    svg.lines().filter(|line| line.contains(text)).collect()
}

#[test]
fn lengths_have_the_proportions_and_the_numbers_of_the_file() {
    let bar = shipped();
    let twice = BallBarConfig { length_m: 2.0 * bar.length_m, plate_m: 2.0 * bar.plate_m, ..bar.clone() };
    let (once, twice) = (ball_bar(&bar), ball_bar(&twice));
    assert_eq!(twice, once.replace("600 mm", "1200 mm").replace("250 mm", "500 mm"));
    assert!(!once.contains(">tool "));
    let adapted = ball_bar(&BallBarConfig { length_m: 0.600_012_3, tool_m: 0.08, ..bar });
    assert!(adapted.contains(">length 600.012 mm<") && adapted.contains(">tool 80 mm<"), "{adapted}");
}

#[test]
fn each_joint_is_an_element_with_its_encoder_if_it_has_one() {
    let mut bar = shipped();
    bar.encoders.retain(|encoder| encoder.joint != 3);
    let svg = ball_bar(&bar);
    for number in 1..=5 {
        let begin = format!("<g class=\"bar-joint\" id=\"bar-joint-{number}\">");
        let joint = svg.split(&begin).nth(1).and_then(|rest| rest.split("</g>").next()).unwrap();
        assert!(joint.contains(&format!(">joint {number}<")), "{joint}");
        assert_eq!(joint.contains("\"encoder\""), number != 3, "{joint}");
    }
}

#[test]
fn axes_that_point_the_other_way_are_turned_the_other_way() {
    let (bar, mut other) = (shipped(), shipped());
    other.links.iter_mut().for_each(|link| link.alpha_deg = -link.alpha_deg);
    let (bar, other) = (ball_bar(&bar), ball_bar(&other));
    assert_eq!(lines(&bar, "\"body\""), lines(&other, "\"body\""));
    let turns = lines(&bar, "\"turn\"").into_iter().zip(lines(&other, "\"turn\""));
    let differ: Vec<bool> = turns.map(|(one, other)| one != other).collect();
    // The joints are drawn in the order 1, 3, 2, 5, 4.
    assert_eq!(differ, [false, false, true, false, true]);
}
