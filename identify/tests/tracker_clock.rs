//! A tracker and a robot with independent clocks. The motion aligns them, and the solve estimates the clock shift and rate.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "figures of a run")]

use std::path::Path;

use identify::calibrate::{Calibration, DataSets, calibrate};
use identify::instrument::Tracker;
use identify::logs::{MeasuredPoseMapping, TimedPoses};
use identify::model::ParameterId;
use identify::prepare::AlignedPoses;
use identify::report::result::file::CalibrationFile;

use crate::support::rows::Alone;
use crate::support::tracker_log::{Followed, Sizes};
use crate::support::ur10;

fn calibrated(tracker: Tracker) -> Calibration {
    let Alone { config, .. } = Alone::default().without_joint_errors();
    let rows = vec![tracker.into()];
    calibrate(&DataSets { rows, ..DataSets::default() }, &ur10(), &config, None).unwrap()
}

/// Error of a calibration, and error of a calibration of the same rows with the true times of measurement \[m\].
fn errors_m(followed: &Followed, aligned: &AlignedPoses, found: &Calibration) -> [f64; 2] {
    let perfect = calibrated(Tracker::new(&followed.with_perfect_times(aligned)));
    [found, &perfect].map(|found| followed.error_m(&found.runs[0].model))
}

#[test]
fn clocks_of_a_moving_target_are_found_and_calibrate_as_well_as_perfect_times() {
    for seed in 1..=4 {
        // Some trackers measure at regular times, others on request.
        let uneven_s = if seed % 2 == 0 { 4e-3 } else { 0.0 };
        let followed = Followed::new(seed, Sizes { with_rotation: seed == 1, uneven_s, ..Sizes::default() });
        let aligned = followed.aligned().unwrap();
        let found = calibrated(followed.measured(&aligned));
        let [shift_s, skew] = followed.clock_errors(&aligned, &found.runs[0].model);
        let sigmas = [ParameterId::ClockShift, ParameterId::ClockSkew].map(|id| found.sigma(id).unwrap());
        let [error_m, perfect_m] = errors_m(&followed, &aligned, &found);
        println!(
            "seed {seed}: {:.2} us (sigma {:.2}), {:.3} ppm (sigma {:.3}); {:.2} um, perfect times {:.2} um; {:?}",
            shift_s * 1e6,
            sigmas[0] * 1e6,
            skew * 1e6,
            sigmas[1] * 1e6,
            error_m * 1e6,
            perfect_m * 1e6,
            aligned.alignment
        );
        assert!(shift_s.abs() < 5e-5 && skew.abs() < 2e-6, "{shift_s} {skew}");
        assert!(shift_s.abs() < 4.0 * sigmas[0] && skew.abs() < 4.0 * sigmas[1], "{sigmas:?}");
        assert!(error_m < 1.5 * perfect_m, "{error_m} {perfect_m}");
        assert!(aligned.alignment.correlation > 0.99 && !aligned.alignment.ambiguous);
    }
}

#[test]
fn two_milliseconds_of_jitter_leave_a_third_of_one() {
    for (seed, uneven_s) in [(1, 0.0), (2, 4e-3), (3, 0.0)] {
        let sizes = Sizes { jitter_s: 2e-3, uneven_s, rate_hz: 50.0, ..Sizes::default() };
        let followed = Followed::new(seed, sizes);
        let aligned = followed.aligned().unwrap();
        let found = calibrated(followed.measured(&aligned));
        let [shift_s, skew] = followed.clock_errors(&aligned, &found.runs[0].model);
        let [error_m, perfect_m] = errors_m(&followed, &aligned, &found);
        let poses = followed.poses();
        let evened = poses.stamps.is_some();
        println!(
            "seed {seed}: {:.1} us, {:.2} ppm; {:.1} um, perfect times {:.1} um; evened: {evened}",
            shift_s * 1e6,
            skew * 1e6,
            error_m * 1e6,
            perfect_m * 1e6,
        );
        assert!(shift_s.abs() < 3e-4, "{shift_s}");
        // Times of a regular clock are recovered. Other times remain uncertain, which also affects the measured positions.
        assert_eq!(evened, uneven_s == 0.0);
        let is_remarked = poses.remarks.iter().any(|one| one.contains("the regular clock behind the stamps"));
        assert_eq!(is_remarked, evened, "{:?}", poses.remarks);
        assert!(error_m < if evened { 3.0 * perfect_m } else { 1.5e-4 }, "{error_m} {perfect_m}");
    }
}

#[test]
fn rows_of_standstills_get_the_joints_of_theirs() {
    let sizes = Sizes { rate_hz: 0.2, duration_s: 500.0, skew: 60e-6, ..Sizes::default() };
    for seed in 1..=3 {
        let followed = Followed::new(seed, sizes);
        let aligned = followed.aligned().unwrap();
        assert!(aligned.moving.is_none() && aligned.left_out == 0, "{}", aligned.left_out);
        let found = calibrated(followed.measured(&aligned));
        let [error_m, perfect_m] = errors_m(&followed, &aligned, &found);
        println!(
            "seed {seed}: {:.1} um, perfect times {:.1} um; {:?}",
            error_m * 1e6,
            perfect_m * 1e6,
            aligned.alignment
        );
        assert!(error_m < 1.5 * perfect_m, "{error_m} {perfect_m}");
    }
}

#[test]
fn a_tracker_that_is_moved_and_sees_two_targets_is_aligned_as_one() {
    for (rate_hz, duration_s) in [(100.0, 120.0), (0.2, 600.0)] {
        let sizes = Sizes { moved: true, rate_hz, duration_s, ..Sizes::default() };
        let followed = Followed::new(3, sizes);
        let aligned = followed.aligned().unwrap();
        assert_eq!((aligned.left_out, aligned.moving.is_some()), (0, rate_hz > 1.0));
        let found = calibrated(followed.measured(&aligned));
        let [error_m, perfect_m] = errors_m(&followed, &aligned, &found);
        let tracker = found.runs[0].model.geometry(&[]).tracker;
        let [one, other] = [0, 1].map(|target| tracker.probes[target].position_m);
        let off_m = (one - other).norm()
            - (followed.probes[0].translation.vector - followed.probes[1].translation.vector).norm();
        println!(
            "{:.1} um, perfect times {:.1} um, targets apart off by {:.1} um",
            error_m * 1e6,
            perfect_m * 1e6,
            off_m * 1e6
        );
        assert_eq!(tracker.places.len(), 2);
        assert!(error_m < 1.5 * perfect_m && off_m.abs() < 5e-5, "{error_m} {perfect_m} {off_m}");
        if aligned.moving.is_some() {
            let [shift_s, skew] = followed.clock_errors(&aligned, &found.runs[0].model);
            assert!(shift_s.abs() < 5e-5 && skew.abs() < 2e-6, "{shift_s} {skew}");
        }
    }
}

/// The logs cover an hour, in which the robot stops for 1.2 s at each row. The rate error of the robot's clock is twice the
/// usual one, so the clocks differ by a third of a second at the ends.
#[test]
fn clocks_that_run_apart_over_an_hour_of_stops_lose_no_row() {
    let sizes = Sizes { rate_hz: 0.1, duration_s: 3600.0, skew: 190e-6, stay: 0.06, ..Sizes::default() };
    let followed = Followed::new(2, sizes);
    let aligned = followed.aligned().unwrap();
    println!("{:?}", aligned.alignment);
    assert_eq!(aligned.left_out, 0);
    let found = calibrated(followed.measured(&aligned));
    let [error_m, perfect_m] = errors_m(&followed, &aligned, &found);
    assert!(error_m < 1.5 * perfect_m, "{error_m} {perfect_m}");
}

#[test]
fn logs_that_do_not_belong_together_are_errors_that_say_so() {
    let [one, other] = [1, 2].map(|seed| Followed::new(seed, Sizes::default()));
    let said =
        |tracker: &Followed, robot: &Followed| tracker.aligned_with(&robot.log).unwrap_err().to_string();
    let another_run = said(&one, &other);
    assert!(another_run.contains("tracker's log do not match at any clock difference"), "{another_run}");
    // The robot's log ends shortly after the start of the tracker's log.
    let late = Followed::new(1, Sizes { lead_s: [60.0, -110.0], ..Sizes::default() });
    let late = late.aligned().unwrap_err().to_string();
    println!("{late}");
    assert!(late.contains("match, but overlap by"), "{late}");
    let stopping = Sizes { rate_hz: 0.2, duration_s: 500.0, ..Sizes::default() };
    let [one, other] = [1, 2].map(|seed| Followed::new(seed, stopping));
    let another_run = said(&one, &other);
    assert!(another_run.contains("do not match"), "{another_run}");
}

#[test]
fn a_motion_that_repeats_itself_fits_elsewhere_too_and_is_said_to() {
    let followed = Followed::new(1, Sizes { lap_s: Some(40.0), ..Sizes::default() });
    let aligned = followed.aligned().unwrap();
    assert!(aligned.alignment.ambiguous);
    // The alignment with the longest overlap is used. Here this is the correct one.
    let found = calibrated(followed.measured(&aligned));
    let [shift_s, _] = followed.clock_errors(&aligned, &found.runs[0].model);
    assert!(shift_s.abs() < 5e-5, "{shift_s}");
}

#[test]
#[ignore = "logs of forty minutes"]
fn clocks_that_drift_apart_by_far_are_followed_through_long_logs() {
    let sizes = Sizes { duration_s: 2400.0, rate_hz: 10.0, skew: 150e-6, ..Sizes::default() };
    let followed = Followed::new(5, sizes);
    let aligned = followed.aligned().unwrap();
    let found = calibrated(followed.measured(&aligned));
    let [shift_s, skew] = followed.clock_errors(&aligned, &found.runs[0].model);
    println!("{:.2} us, {:.4} ppm", shift_s * 1e6, skew * 1e6);
    assert!(shift_s.abs() < 5e-5 && skew.abs() < 2e-6, "{shift_s} {skew}");
}

#[test]
fn the_command_takes_both_logs_and_what_it_writes_repeats_it() {
    let folder = tempfile::tempdir().unwrap();
    let followed = Followed::new(1, Sizes { duration_s: 60.0, ..Sizes::default() });
    followed.write(folder.path());
    let run = |arguments: &[&str], out: &str| {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_identify"));
        command.arg("calibrate").args(arguments).args(["--out", out]);
        let output = command.current_dir(folder.path()).output().unwrap();
        let [out, err] = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
        (output.status.success(), out, err)
    };
    let robot = crate::support::repository("config/robots/ur10.toml");
    let tracker = ["tracker", "tracker.csv", "--mapping", "tracker.toml", "--robot", robot.to_str().unwrap()];
    let with = |others: &[&str], out: &str| run(&[&tracker, others].concat(), out);
    let (done, out, err) = with(&["--robot-log", "robot.csv", "--joint-waves", "4", "--verbose"], "result");
    assert!(done, "{err}");
    assert!(out.contains("robot's clock minus tracker's: 4321.09") && out.contains("clock_skew"), "{out}");
    let page = std::fs::read_to_string(folder.path().join("result/report.html")).unwrap();
    assert!(page.contains("robot&#39;s clock minus tracker") || page.contains("robot's clock minus tracker"));
    // The clock of the tracker has no date, so the certificate has an empty field in which it can be written by hand.
    assert!(page.contains("<dt>Measured</dt><dd class=\"blank\"></dd>"), "{page:.2000}");
    let (done, _, err) = run(&["--experiment", "result/experiment.toml"], "again");
    assert!(done, "{err}");
    let found = |name: &str| CalibrationFile::open(&folder.path().join(name)).unwrap();
    assert_eq!(found("result").parameters, found("again").parameters);
    assert!(found("result").inputs.iter().any(|input| input.role == "robot log"));
    // Checks the estimated parameters of the clock.
    let clock = found("result").clocks.remove(0);
    assert_eq!((clock.data_set, clock.instrument.as_str()), (1, "tracker"));
    let reference_s: f64 = clock.reference_utc.split(' ').next().unwrap().parse().unwrap();
    let off_ns = clock.robot_minus_instrument_ns as f64 - 1e9 * followed.clock_difference_s(reference_s);
    let (sigma_ns, sigma_ppm) = (clock.sigma_ns.unwrap(), clock.skew_sigma_ppm.unwrap());
    println!("off by {off_ns:.0} ns (sigma {sigma_ns:.0}), {} ppm (sigma {sigma_ppm:.3})", clock.skew_ppm);
    // The reference time is written in whole milliseconds. At this rate, the rounding causes an error of 35 ns.
    assert!(off_ns.abs() < 4.0 * sigma_ns + 35.0 && sigma_ns < 2e4, "{off_ns} {sigma_ns}");
    assert!(
        (clock.skew_ppm - 35.0).abs() < 4.0 * sigma_ppm && sigma_ppm < 2.0,
        "{} {sigma_ppm}",
        clock.skew_ppm
    );
    assert!(clock.correlation > 0.99 && !clock.ambiguous);
    let json = std::fs::read_to_string(folder.path().join("result/calibration.json")).unwrap();
    assert!(json.contains("\"robot_minus_instrument_ns\":4321"));
    // The rows that validate the robot contain its joints. Rows with times contain no joints.
    let rows = followed.with_perfect_times(&followed.aligned().unwrap());
    let mut other = String::from("q1;q2;q3;q4;q5;q6;x;y;z\n");
    for row in rows.iter().step_by(20) {
        let numbers = row.joints_rad.iter().copied().chain(row.position_m.iter().map(|x| x * 1e3));
        other += &(numbers.map(|number| number.to_string()).collect::<Vec<_>>().join(";") + "\n");
    }
    std::fs::write(folder.path().join("other.csv"), other).unwrap();
    let joints: String =
        (1..=6).map(|joint| format!("[[joints]]\ncolumn = \"q{joint}\"\nunit = \"rad\"\n")).collect();
    let with_joints = followed.mapping().replace("[time]\ncolumn = \"t_ms\"\nunit = \"ms\"\n", "") + &joints;
    std::fs::write(folder.path().join("joints.toml"), with_joints).unwrap();
    let robot_log = ["--robot-log", "robot.csv", "--joint-waves", "4", "--validate"];
    let judged = [&robot_log[..], &["other.csv", "--validate-mapping", "joints.toml"]].concat();
    let (done, out, err) = with(&judged, "judged");
    assert!(done && out.contains("other.csv"), "{out}{err}");
    let inputs = found("judged").inputs;
    let has =
        |role: &str, path: &str| inputs.iter().any(|one| one.role == role && one.path == Path::new(path));
    assert!(has("validation", "other.csv") && has("validation mapping", "joints.toml"), "{inputs:?}");
    let (done, out, err) = run(&["--experiment", "judged/experiment.toml"], "judged again");
    assert!(done && out.contains("other.csv"), "{out}{err}");
    let (done, _, err) = with(&[&robot_log[..], &["other.csv"]].concat(), "out");
    assert!(!done && err.contains("tracker.toml") && err.contains("--validate-mapping"), "{err}");
    // Two inputs are refused: times without a robot log, and a robot log without times.
    let (done, _, err) = with(&[], "out");
    assert!(!done && err.contains("tracker.toml") && err.contains("--robot-log"), "{err}");
    let shipped = crate::support::repository("config/measured_pose.toml");
    let other = ["tracker", "tracker.csv", "--mapping", shipped.to_str().unwrap()];
    let with_joints = [&other[..], &tracker[4..], &["--robot-log", "robot.csv"]].concat();
    let (done, _, err) = run(&with_joints, "out");
    assert!(!done && err.contains("[time]"), "{err}");
    let both = followed.mapping() + "[[joints]]\ncolumn = \"x\"\nunit = \"rad\"\n";
    std::fs::write(folder.path().join("tracker.toml"), both).unwrap();
    let (done, _, err) = with(&["--robot-log", "robot.csv"], "out");
    assert!(!done && err.contains("rows with [time] get their joints from the robot's own log"), "{err}");
    // The log of another run is refused with a page, and the older calibration is moved to another name.
    followed.write(folder.path());
    let other = Followed::new(2, followed.sizes);
    std::fs::write(folder.path().join("tracker.csv"), &other.text).unwrap();
    let (done, _, err) = with(&["--robot-log", "robot.csv"], "result");
    assert!(!done && err.contains("do not match at any clock difference"), "{err}");
    assert!(err.contains("report.html") && !folder.path().join("result/calibration.toml").exists(), "{err}");
}

/// When its beam is interrupted, the tracker writes zeros.
#[test]
fn rows_of_a_broken_beam_are_left_out_and_named() {
    let mut followed = Followed::new(1, Sizes::default());
    let whole = followed.aligned().unwrap();
    let count = followed.poses().rows.len();
    let bad: Vec<usize> = (100..count).step_by(100).flat_map(|row| [row, row + 1]).collect();
    let lines = followed.text.lines().enumerate().map(|(line, text)| {
        let stamp = text.split(';').next().unwrap();
        if bad.contains(&(line + 1)) { format!("{stamp};0;0;0") } else { text.to_owned() }
    });
    followed.text = lines.collect::<Vec<_>>().join("\n");
    let read = followed.poses();
    assert_eq!(read.rows.len(), count - bad.len());
    assert!(matches!(&read.remarks[..], [one] if one.contains("line 100, 101, 200")), "{:?}", read.remarks);
    let found = followed.aligned().unwrap().alignment;
    assert!((found.correlation - whole.alignment.correlation).abs() < 1e-3, "{found:?}");
}

#[test]
fn stamps_that_go_back_are_refused_by_their_line() {
    let followed = Followed::new(1, Sizes { duration_s: 1.0, ..Sizes::default() });
    let mapping: MeasuredPoseMapping = toml::from_str(&followed.mapping()).unwrap();
    let mut lines: Vec<&str> = followed.text.lines().collect();
    lines.swap(20, 21);
    let error = TimedPoses::read(lines.join("\n").as_bytes(), Path::new("t.csv"), &mapping).unwrap_err();
    assert!(error.to_string().contains("line 22"), "{error}");
}

/// Every row of the first target occurs once, and every row of the second target twice with the same stamp, as if a logger
/// had read faster than its buffer was filled.
#[test]
fn targets_that_are_seen_at_once_are_all_read_at_their_time() {
    let stamp_ms = |row: usize| 1e3 * row as f64 + 37.0 * (row * row % 7) as f64;
    let mut text = String::from("t_ms;x;y;z;station;target\n");
    for row in 0..40 {
        for target in ["red", "green", "green"] {
            text += &format!("{};{row};0;0;north;{target}\n", stamp_ms(row));
        }
    }
    let mapping = Followed::new(1, Sizes { moved: true, duration_s: 1.0, ..Sizes::default() }).mapping();
    let mapping: MeasuredPoseMapping = toml::from_str(&mapping).unwrap();
    let read = TimedPoses::read(text.as_bytes(), Path::new("t.csv"), &mapping).unwrap();
    assert_eq!(read.rows.len(), 80);
    let is_of_equal = |remark: &String| remark.starts_with("40 lines have the stamp of the one before");
    assert!(matches!(&read.remarks[..], [one] if is_of_equal(one)), "{:?}", read.remarks);
    for (t_s, row) in read.rows.t_s.iter().zip(read.rows.iter()) {
        let of_line = row.line as usize - 2;
        assert!((t_s - 1e-3 * stamp_ms(of_line / 3)).abs() < 1e-6, "line {}: {t_s}", row.line);
        assert_eq!(row.set_up.target, usize::from(!of_line.is_multiple_of(3)));
    }
}
