//! The page of a refusal shows the cause and marks the time of the fault in the figures. It shows no result.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::path::Path;
use std::process::Output;

use crate::preparation_encoder_map::ambiguous;
use crate::support::command::identify;
use crate::support::refused::{Refused, Typed};
use crate::support::{bar, browser, irb2400, lengths, repository};
use identify::simulate::{self, Design, Effects, Experiment, Simulated};
use shared::config::RobotConfig;

const DURATION_S: f64 = 40.0;
/// Attribute of the line that marks the time of a fault in a figure.
const RED: &str = "stroke=\"rgb(180,40,60)\"";

fn simulated(seed: u64) -> Simulated {
    let (robot, bar) = (irb2400(), bar());
    let effects = Effects { robot_noise_urad: 15.0, encoder_noise_urad: 5.0, ..Effects::NONE };
    let design = Design { duration_s: DURATION_S, ..Design::for_robot(&robot) };
    simulate::run(&Experiment { seed, effects, design, ..Experiment::new(&robot, &bar) }).unwrap()
}

fn typed(run: &Simulated) -> Typed {
    Typed::new(run, &irb2400(), &bar())
}

/// The run with a slip of encoder `place`: from cycle `at` on, its counts are changed by this angle \[mrad\].
fn slipped(mut run: Simulated, place: usize, at: usize, mrad: f64) -> Simulated {
    let counts = (mrad * 1e-3 / run.encoders[place].scale.rad_per_count()) as i32;
    for cycle in &mut run.cycles[at..] {
        let count = &mut cycle.encoders[place].count;
        *count = count.wrapping_add(counts as u32);
    }
    run
}

fn slip() -> Refused {
    typed(&slipped(simulated(1), 0, 1000, 15.0)).refused(&["encoder of joint 1 slips"], &[])
}

/// For each figure with a red line: the title of the figure, and the position of the line on the time axis, from 0 to 1.
fn marks(page: &str) -> Vec<(String, f64)> {
    // Layout of the figures: three units per pixel. The axis extends from 62 to 326 px of 340 px.
    const AXIS: [f64; 2] = [186.0, 978.0];
    let figures = page.split("<svg").skip(1).map(|figure| figure.split("</svg>").next().unwrap());
    let mark = |figure: &str| {
        let path = figure.split("<path d=\"M").skip(1).find(|path| path.contains(RED))?;
        let x: f64 = path.split(' ').next().unwrap().parse().unwrap();
        let (before, _) = figure.rsplit_once("</text>")?;
        let title = before.rsplit('>').next().unwrap().to_owned();
        Some((title, (x - AXIS[0]) / (AXIS[1] - AXIS[0])))
    };
    figures.filter_map(mark).collect()
}

#[test]
fn a_slip_is_marked_where_it_is_in_both_logs_and_beside_the_robot() {
    let Refused { page, .. } = slip();
    assert!(page.contains("joint 1 of the bar; ") && page.contains("s after the recording's first sample"));
    assert!(page.contains("Check its coupling and cable, and record again."));
    let marks = marks(&page);
    let titles: Vec<&str> = marks.iter().map(|(title, _)| title.as_str()).collect();
    let (encoders, joints) = (["b1", "b2", "b3", "b4", "b5"], ["q1", "q2", "q3", "q4", "q5", "q6"]);
    assert_eq!(titles, [&encoders[..], &["Alignment"], &encoders, &joints].concat());
    for (title, at) in &marks[6..11] {
        // The fault is after a quarter of the recording. The figure has a small margin on both sides.
        assert!((at - (0.04 + 0.25) / 1.1).abs() < 0.02, "{title}: {at}");
    }
}

/// The encoder is dead for ten seconds in the first run, and until the end in the second.
#[test]
fn an_encoder_that_is_dead_while_the_others_move_is_named() {
    for (place, until) in [(1, 2000), (2, usize::MAX)] {
        let mut run = simulated(1);
        let until = until.min(run.cycles.len());
        let count = run.cycles[1000].encoders[place].count;
        run.cycles[1000..until].iter_mut().for_each(|cycle| cycle.encoders[place].count = count);
        let told = format!("the encoder of joint {} is constant from 10.0 s to", place + 1);
        typed(&run).refused(&[&told, "record again"], &[]);
    }
}

#[test]
fn a_clock_that_jumps_is_marked_in_all_joints() {
    let mut run = simulated(1);
    // Only the stamps of the bar have the step. A step of the robot's stamps would already
    // be found in the robot's log itself.
    let at = run.cycles.len() / 2;
    run.cycles[at..].iter_mut().for_each(|cycle| cycle.sample_time = cycle.sample_time.plus_ns(20_000_000));
    let Refused { page, .. } = typed(&run).refused(&["a clock jumps during the run"], &[]);
    let marks = marks(&page);
    // Six figures of the encoders and the alignment, five of the recording, and six of the robot's log have a mark.
    assert_eq!(marks.len(), 6 + 5 + 6, "{marks:?}");
    assert!(page.contains("Find out what sets the clock and record again"));
}

#[test]
fn every_kind_of_refusal_has_its_page() {
    let run = simulated(1);
    // The robot log is that of another run.
    let other = Simulated { robot_log: simulated(9).robot_log, ..run.clone() };
    let Refused { page, stderr, .. } =
        typed(&other).refused(&["different runs", "give the log of this run"], &[]);
    assert!(marks(&page).is_empty(), "nothing is known of a place");
    let sheet = page.split_once("</section>").unwrap().0;
    // The page has no field for a signature.
    assert!(!sheet.contains("Signature") && sheet.contains("2026-05-28 20:26:40 UTC"), "{sheet}");
    assert!(stderr.contains("recording.mcap with "), "{stderr}");
    // The configuration is that of another robot with the same columns.
    let mut longer: RobotConfig = irb2400();
    longer.links[2].a_m += 0.4;
    Typed::new(&run, &longer, &bar())
        .refused(&["is not that of this cell", "correct the configuration"], &[]);
    // The configuration is that of another bar.
    let longer = shared::config::BallBarConfig { length_m: 0.7, ..bar() };
    Typed::new(&run, &irb2400(), &longer).refused(&["sphere of 59", "700 mm"], &[]);
    // The stated encoder map is not the true one.
    typed(&run).refused(&["do not fit as stated", "--encoders 1,2,3,4,5"], &["--encoders", "2,1,3,4,5"]);
    // The motion does not determine this parameter.
    typed(&run).refused(
        &["free parameters are identified", "not identified: dependent rd1|oz", "--fix rd1"],
        &["--free", "rd1"],
    );
    // The bar lacks an encoder that the cost requires.
    let mut four = bar();
    four.encoders.remove(2);
    let of_four = simulate::run(&Experiment::new(&irb2400(), &four)).unwrap();
    let why = ["needs the encoder of bar joint 3", "choose another cost"];
    Typed::new(&of_four, &irb2400(), &four).refused(&why, &["--cost", "transform"]);
}

#[test]
fn an_ambiguous_encoder_map_is_shown_line_by_line() {
    let run = ambiguous(&irb2400(), &bar());
    let Refused { page, .. } = typed(&run).refused(&["--encoders 1,2,3,4,5 for", "Check on the bar"], &[]);
    assert!(page.contains("\n  --encoders "), "each on a line of its own");
}

#[test]
#[ignore = "takes more than four seconds"]
fn of_several_runs_the_one_that_is_refused_is_named() {
    let (good, bad) = (typed(&simulated(1)), typed(&slipped(simulated(2), 3, 1500, -5.0)));
    let one_bar = bad.arguments.len() - 4;
    let more: Vec<&str> = bad.arguments[..one_bar].iter().map(|one| one.to_str().unwrap()).collect();
    let Refused { page, stderr, .. } = good.refused(&["encoder of joint 4 slips"], &more);
    let first = good.inputs.path().to_str().unwrap();
    assert!(!stderr.split("not calibrated").next().unwrap().contains(first), "{stderr}");
    assert!(page.contains("<dd>Run 2 of 2, "));
    // The figures of the first run have no mark of a fault.
    assert_eq!(marks(&page).len(), 6 + 5 + 6);
}

#[test]
#[ignore = "takes more than four seconds"]
fn an_older_calibration_is_set_aside_and_a_newer_one_takes_the_page_away() {
    let typed = typed(&slipped(simulated(1), 0, 1000, 15.0));
    let out = tempfile::tempdir().unwrap();
    let older = [
        "calibration.toml",
        "calibration.json",
        "dh.csv",
        "robot.urdf",
        "corrections.csv",
        "corrections_log.csv",
        "offsets.csv",
        "offsets_log.csv",
        "report.html",
        "experiment.toml",
    ];
    for name in older.iter().chain(&["notes.txt"]) {
        std::fs::write(out.path().join(name), format!("older {name}")).unwrap();
    }
    let refused = || {
        let output = typed.calibrate(&[], out.path());
        assert_eq!(output.status.code(), Some(1));
        let page = std::fs::read_to_string(out.path().join("report.html")).unwrap();
        (String::from_utf8_lossy(&output.stderr).into_owned(), page)
    };
    let names = |directory: &Path| {
        let entries = std::fs::read_dir(directory).unwrap();
        let mut names: Vec<String> =
            entries.map(|one| one.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    };
    let (told, page) = refused();
    let earlier = out.path().join("earlier");
    assert!(told.contains(&format!("is now in {}", earlier.display())), "{told}");
    assert!(page.contains(&format!("<code>{}</code>", earlier.display())));
    assert_eq!(names(out.path()), ["earlier", "notes.txt", "report.html"]);
    for name in older {
        assert_eq!(std::fs::read_to_string(earlier.join(name)).unwrap(), format!("older {name}"));
    }
    // After a second refusal there is no calibration to move. If a calibration was written between two refusals, it must not
    // replace the one that was moved first.
    let (told, _) = refused();
    assert!(!told.contains("is now in") && !out.path().join("earlier-2").exists(), "{told}");
    std::fs::write(out.path().join("calibration.toml"), "newer").unwrap();
    refused();
    assert_eq!(names(out.path()), ["earlier", "earlier-2", "notes.txt", "report.html"]);
    assert_eq!(names(&out.path().join("earlier-2")), ["calibration.toml", "report.html"]);

    // A calibration replaces the page of a refusal, and that of an older calibration.
    let page = out.path().join("report.html");
    for text in [None, Some("<main><div class=\"verdict doubt\">"), Some("older")] {
        text.map_or(Ok(()), |text| std::fs::write(&page, text)).unwrap();
        let output = calibrated_from_lengths(200, out.path());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        assert!(out.path().join("calibration.toml").exists());
        assert!(
            std::fs::read_to_string(&page).unwrap().contains("<strong>Calibrated. </strong>"),
            "{text:?}"
        );
    }
}

/// Calibrates from lengths between an anchor and the flange of a nominal IRB 120. Returns the output of the command.
fn calibrated_from_lengths(rows: u32, out: &Path) -> Output {
    const ROBOT: &str = "irb120_3.toml";
    let robot = shared::config::load(&repository("config/robots").join(ROBOT)).unwrap();
    let inputs = tempfile::tempdir().unwrap();
    let path = inputs.path().join("lengths.csv");
    std::fs::write(&path, lengths::table(&robot, rows, 0.0)).unwrap();
    let mapping = repository("config/measured_length.toml");
    let arguments = ["calibrate", "wire", path.to_str().unwrap(), "--mapping", mapping.to_str().unwrap()];
    identify(&arguments, ROBOT, out)
}

#[test]
fn measured_lengths_that_are_refused_leave_a_page_and_no_older_calibration() {
    let out = tempfile::tempdir().unwrap();
    std::fs::write(out.path().join("calibration.toml"), "older").unwrap();
    let output = calibrated_from_lengths(12, out.path());
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{told}");
    assert!(told.contains("remain for the fit") && told.contains("is now in"), "{told}");
    let page = std::fs::read_to_string(out.path().join("report.html")).unwrap();
    for part in
        ["Not calibrated.", "remain for the fit", "Measure more poses.", "lengths.csv", "SHA-256", "hold_out"]
    {
        assert!(page.contains(part), "`{part}` is missing");
    }
    assert!(!out.path().join("calibration.toml").exists());
}

#[test]
fn what_was_mistyped_has_no_page_and_a_page_that_cannot_be_written_changes_nothing_of_the_error() {
    let clean = simulated(1);
    let sound = typed(&clean);
    let directory = tempfile::tempdir().unwrap();
    let out = directory.path().join("out");
    for mistyped in [["--free", "rgamma3"], ["--encoders", "-1,2"], ["--cost", "best"]] {
        let output = sound.calibrate(&mistyped, &out);
        let told = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && !told.contains("not calibrated"), "{told}");
        assert!(!out.exists(), "{mistyped:?}");
    }
    // A directory has the name of the page, so the page cannot be written.
    std::fs::create_dir_all(out.join("report.html/kept")).unwrap();
    let output = typed(&slipped(clean, 0, 1000, 15.0)).calibrate(&[], &out);
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(told.contains("slips") && !told.contains("not calibrated"), "{told}");
    assert!(told.trim_end().ends_with("record again"), "{told}");
}

#[test]
fn markup_in_a_name_is_shown_and_not_obeyed() {
    let robot = RobotConfig { name: "<script>alert('x')</script>".into(), ..irb2400() };
    let run = slipped(simulated(1), 0, 1000, 15.0);
    let Refused { page, .. } = Typed::new(&run, &robot, &bar()).refused(&["slips"], &[]);
    assert!(!page.contains("<script") && page.contains("&lt;script&gt;"));
}

#[test]
#[ignore = "needs chromium"]
fn a_browser_shows_the_page_and_asks_nobody_else() {
    let shown = browser::shown(&slip().page);
    assert!(shown.document.contains("Not calibrated."), "{}", shown.stderr);
    assert_eq!(shown.document.matches("<svg").count(), 6 + 5 + 6);
    assert_eq!(shown.foreign, Vec::<String>::new());
}
