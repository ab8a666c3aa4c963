//! Messages about configuration files that cannot be read.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::path::Path;

use proptest::prelude::*;
use shared::config::{self, BallBarConfig, DaemonConfig, Maker, RobotConfig, Validate};

fn shipped(name: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config").join(name);
    std::fs::read_to_string(path).unwrap()
}

fn message<T: serde::de::DeserializeOwned + Validate>(text: &str) -> String {
    match config::parse::<T>(text, Path::new("cell.toml")) {
        Ok(_) => "accepted".to_owned(),
        Err(error) => error.to_string(),
    }
}

#[test]
fn a_key_that_does_not_exist_is_named_with_its_line_and_the_nearest_that_does() {
    let text = shipped("daemon.toml").replace("rate_hz", "rate_Hz");
    let line = 1 + text.lines().position(|line| line.contains("rate_Hz")).unwrap();
    let message = message::<DaemonConfig>(&text);
    let begin = format!("cell.toml, line {line}: unknown key `rate_Hz`; did you mean `rate_hz`? Keys here: ");
    assert!(message.starts_with(&begin), "{message}");
    assert!(!message.contains("TOML parse error"), "{message}");
}

#[test]
fn a_key_of_a_table_is_named_with_the_table() {
    let message = message::<DaemonConfig>("\n[realtime]\nfifo_prioritty = 3\n");
    assert!(
        message.starts_with(
            "cell.toml, line 3: unknown key `realtime.fifo_prioritty`; did you mean `fifo_priority`?"
        ),
        "{message}"
    );
}

#[test]
fn a_key_like_no_other_gets_no_guess() {
    let message = message::<DaemonConfig>("zzz = 1\n");
    assert!(message.starts_with("cell.toml, line 1: unknown key `zzz`. Keys here: "), "{message}");
}

#[test]
fn a_value_of_another_type_is_reported_with_what_was_expected() {
    let message = message::<DaemonConfig>("# cell\nrate_hz = \"fast\"\n");
    assert!(
        message.starts_with("cell.toml, line 2: key `rate_hz`: invalid type: string \"fast\", expected"),
        "{message}"
    );
}

#[test]
fn a_value_of_none_of_several_forms_is_reported_without_names_of_the_program() {
    #[derive(Debug, serde::Deserialize)]
    #[serde(untagged)]
    enum Form {
        Number(f64),
        List(Vec<f64>),
    }
    #[derive(Debug, serde::Deserialize)]
    struct File {
        form: Form,
    }
    impl Validate for File {
        fn validate(&self) -> Result<(), config::Violation> {
            let usable = match &self.form {
                Form::Number(number) => number.is_finite(),
                Form::List(list) => !list.is_empty(),
            };
            usable.then_some(()).ok_or_else(|| config::Violation::new("form", "nothing", "give numbers"))
        }
    }
    assert_eq!(message::<File>("form = [1.0]"), "accepted");
    let message = message::<File>("\nform = \"1,2\"\n");
    assert!(message.starts_with("cell.toml, line 2: key `form`: its value has an unknown form"), "{message}");
    assert!(!message.contains("untagged") && !message.contains("Form"), "{message}");
}

#[test]
fn a_value_that_makes_no_sense_is_named_with_its_line_also_within_a_table_of_several() {
    let text = shipped("ball_bar.toml");
    let (last, line) =
        (text.rfind("lines = 3600").unwrap(), |at: usize| text[..at].matches('\n').count() + 1);
    let wrong = format!("{}lines = 0{}", &text[..last], &text[last + "lines = 3600".len()..]);
    let place = format!("cell.toml, line {}: key `encoders[4].lines`: ", line(last));
    assert!(message::<BallBarConfig>(&wrong).starts_with(&place), "{}", message::<BallBarConfig>(&wrong));
    let wrong = text.replace("plate_u_um = 10.0", "plate_u_um = -1.0");
    let place = format!("cell.toml, line {}: key `plate_u_um`: ", line(text.find("plate_u_um =").unwrap()));
    assert!(message::<BallBarConfig>(&wrong).starts_with(&place), "{}", message::<BallBarConfig>(&wrong));
}

#[test]
fn an_uncertainty_of_nothing_is_refused_for_the_rod_whose_length_may_be_left_out() {
    let with = |line: &str| {
        shipped("ball_bar.toml").replace("length_m = 0.6\n", &format!("length_m = 0.6\n{line}\n"))
    };
    for line in ["", "length_u_um = 20.0"] {
        assert_eq!(message::<BallBarConfig>(&with(line)), "accepted");
    }
    for line in ["length_u_um = 0.0", "length_u_um = -1.0", "length_u_um = nan"] {
        let message = message::<BallBarConfig>(&with(line));
        assert!(message.contains("length_u_um") && message.contains("leave it out"), "{message}");
    }
}

#[test]
fn a_key_that_is_missing_is_named() {
    let text = shipped("robots/ur10.toml");
    let without: String =
        text.lines().filter(|line| !line.starts_with("name")).map(|line| format!("{line}\n")).collect();
    let message = message::<RobotConfig>(&without);
    assert_eq!(message, "cell.toml: key `name` is missing; add it");
}

#[test]
fn text_that_is_no_toml_is_reported_with_its_line() {
    let refusal = message::<BallBarConfig>("length_m = 0.6\nplate_m 0.1\n");
    assert!(refusal.starts_with("cell.toml, line 2: this is not TOML: "), "{refusal}");
    assert!(!refusal.contains("quotes"), "{refusal}");
    let refusal = message::<RobotConfig>("<?xml version=\"1.0\"?>\n<robot name=\"arm\"/>\n");
    assert!(refusal.contains("`identify robot import`"), "{refusal}");
    for value in ["arm", "../arm.toml"] {
        let refusal = message::<RobotConfig>(&format!("name = {value}\n"));
        assert!(refusal.starts_with("cell.toml, line 1: this is not TOML: "), "{refusal}");
        assert!(refusal.ends_with("text needs quotes, such as \"arm\""), "{refusal}");
    }
}

#[test]
fn a_table_in_place_of_a_list_of_tables_is_reported_with_what_to_write() {
    let text = shipped("ball_bar.toml");
    let (before, from_first) = text.split_at(text.find("[[encoders]]").unwrap());
    let first = from_first.replacen("[[encoders]]", "[encoders]", 1);
    let (first, _) = first.split_once("[[encoders]]").unwrap();
    let refusal = message::<BallBarConfig>(&format!("{before}{first}"));
    assert!(
        refusal.contains("key `encoders` is a list of tables; write [[encoders]] above each"),
        "{refusal}"
    );
}

#[test]
fn the_maker_is_a_word_of_the_robot_s_name_however_it_is_written() {
    use Maker::{Abb, Fanuc, Kuka, UniversalRobots};
    for (name, maker) in [
        ("ABB IRB 2400/16", Some(Abb)),
        ("abb_irb120_3_58", Some(Abb)),
        ("irb4600-20-250", Some(Abb)),
        ("kuka_kr6r700sixx", Some(Kuka)),
        ("KR6 R700", Some(Kuka)),
        ("cell3-fanuc_lrmate200id", Some(Fanuc)),
        ("Fanuc M-10iA", Some(Fanuc)),
        ("Universal Robots UR10", Some(UniversalRobots)),
        ("ur5e_robot", Some(UniversalRobots)),
        ("UR", Some(UniversalRobots)),
        ("Comau NJ 220-2.7", None),
        ("kraken", None),
        ("urdf_arm", None),
        ("", None),
    ] {
        assert_eq!(Maker::in_name(name), maker, "{name}");
    }
}

proptest! {
    #[test]
    fn one_letter_too_many_in_any_key_names_its_line_and_the_key(which in 0_usize..100, letter in "[a-z]") {
        let text = shipped("daemon.toml");
        let keys: Vec<(usize, &str)> = text
            .lines()
            .enumerate()
            .filter_map(|(number, line)| Some((number, line.split_once(" = ")?.0)))
            .filter(|(_, key)| !key.contains(' '))
            .collect();
        let (number, key) = keys[which % keys.len()];
        let wrong = format!("{}{letter}{}", &key[..2], &key[2..]);
        let message = message::<DaemonConfig>(&text.replacen(&format!("{key} = "), &format!("{wrong} = "), 1));
        prop_assert!(message.starts_with(&format!("cell.toml, line {}: unknown key", number + 1)), "{message}");
        prop_assert!(message.contains(&format!("{wrong}`; did you mean `{key}`?")), "{message}");
    }

    #[test]
    fn no_text_is_a_panic(text in "\\PC{0,200}") {
        message::<DaemonConfig>(&text);
        message::<RobotConfig>(&text);
    }
}
