//! Poses that are planned for a tracker or a wire. They must be within the limits, free of collisions, and better than
//! random poses for a real robot.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "figures of a run")]

use std::collections::BTreeSet;
use std::path::Path;
use std::process::Output;

use identify::cost::PoseNoise;
use identify::instrument::{HoldOut, Measures as _, Tracker};
use identify::kinematics::{Joints, flange_chain};
use identify::logs::{JointTableMapping, MeasuredPoseMapping, MeasuredPoses, PoseRow};
use identify::plan::{
    Bodies, Design, Language, MeasuredQuantity, PlannedPoses, PoseRequest, Way, pose_program, poses,
    poses_position_m_min, random_postures,
};
use identify::robot::import;
use nalgebra::{Point3, Vector3};
use rand::seq::index;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use shared::config::{self, RobotConfig};

use crate::support::browser;
use crate::support::command::identify;
use crate::support::rows::Alone;
use crate::support::{measured_data, repository, ur10};

fn request(robot: &RobotConfig, measures: MeasuredQuantity) -> PoseRequest<'_> {
    let noise = PoseNoise { position_m: 5e-5, rotation_rad: 1e-4 };
    PoseRequest { robot, measures, target_m: [0.0, 0.0, 0.1], anchor_m: [1.5, -0.5, 0.2], noise }
}

/// Rows of a real UR10. A plan may select rows from `offered`. The rows `others` are held out.
struct Rows {
    offered: Vec<PoseRow>,
    others: Vec<PoseRow>,
}

impl Rows {
    fn read(path: &Path, seed: u64, offered: usize, others: usize) -> Self {
        let mapping: MeasuredPoseMapping = config::load(&repository("config/measured_pose.toml")).unwrap();
        let all: Vec<PoseRow> = MeasuredPoses::load(path, &mapping).unwrap().rows;
        let mixed =
            index::sample(&mut ChaCha8Rng::seed_from_u64(seed), all.len(), offered + others).into_vec();
        // Rows remain in the order of the file, which is the order of the motion.
        let some = |part: &[usize]| {
            part.iter().collect::<BTreeSet<_>>().into_iter().map(|&row| all[row]).collect::<Vec<_>>()
        };
        Self { offered: some(&mixed[..offered]), others: some(&mixed[offered..]) }
    }

    fn planned(&self, measures: MeasuredQuantity, count: usize) -> Vec<usize> {
        let joints: Vec<Joints> = self.offered.iter().map(|row| row.joints_rad).collect();
        poses(&request(&ur10(), measures), &joints, count, None, 1).unwrap().chosen
    }

    /// Mean position error of the held-out rows \[m\], after a calibration with the chosen rows.
    fn error_m(&self, how: &Alone, chosen: &[usize]) -> f64 {
        let chosen: BTreeSet<usize> = chosen.iter().copied().collect();
        let rows: Vec<PoseRow> = chosen.into_iter().map(|row| self.offered[row]).collect();
        let found = how.poses(&rows, &ur10()).unwrap();
        let errors = Tracker::new(&self.others).errors(&found.model().geometry(&[]));
        errors.iter().map(|error| error.position_m).sum::<f64>() / errors.len() as f64
    }

    fn random(&self, how: &Alone, count: usize, seeds: u64) -> Vec<f64> {
        let error_m = |seed| {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            self.error_m(how, &index::sample(&mut random, self.offered.len(), count).into_vec())
        };
        let mut errors: Vec<f64> = (1..=seeds).map(error_m).collect();
        errors.sort_by(f64::total_cmp);
        errors
    }
}

#[test]
#[ignore = "dozens of calibrations: most of a minute"]
fn fifty_planned_rows_calibrate_a_real_robot_better_than_most_random_fifties() {
    let rows = Rows::read(&repository("identify/tests/data/ur10/grid.csv"), 1, 250, 120);
    let how = Alone { hold_out: Some(HoldOut::Rows), joint_waves: Some(30), ..Alone::default() };
    let planned = rows.error_m(&how, &rows.planned(MeasuredQuantity::Poses, 50));
    let random = rows.random(&how, 50, 5);
    println!("planned {planned:.6} m, random {random:.6?}");
    assert!(planned < random[2], "{planned} {random:?}");
}

/// Fifty planned rows are not quite as good as 200 random ones, because gear errors have more amplitudes than
/// fifty poses have measured coordinates.
#[test]
#[ignore = "needs the measured data: set BALLBAR_DATA; calibrates a hundred times"]
fn all_rows_of_the_real_grid_offer_poses_that_do_the_work_of_twice_as_many_random_ones() {
    let Some(data) = measured_data() else { return };
    let grid = data.join("ur10-tracker/grid_11911.csv");
    let how = Alone { joint_waves: Some(64), ..Alone::default() };
    for measures in [MeasuredQuantity::Poses, MeasuredQuantity::Positions] {
        let errors = |count: usize, planned: bool| {
            let mut errors: Vec<f64> = (1..=6)
                .map(|seed| {
                    let mut rows = Rows::read(&grid, seed, 2000, 1000);
                    if measures == MeasuredQuantity::Positions {
                        rows.offered.iter_mut().chain(&mut rows.others).for_each(|row| row.rotation = None);
                    }
                    match planned {
                        true => rows.error_m(&how, &rows.planned(measures, count)),
                        false => rows.random(&how, count, 1)[0],
                    }
                })
                .collect();
            errors.sort_by(f64::total_cmp);
            println!("{measures:?} {count} {}: {errors:.6?}", if planned { "planned" } else { "random" });
            0.5 * (errors[2] + errors[3])
        };
        let [planned_50, random_50] = [true, false].map(|planned| errors(50, planned));
        let [planned_100, random_100] = [true, false].map(|planned| errors(100, planned));
        let random_200 = errors(200, false);
        assert!(planned_50 < 0.85 * random_50 && planned_100 < random_100);
        assert!(planned_50 < 1.5 * random_200, "{planned_50} {random_200}");
    }
}

#[test]
#[ignore = "hundreds of amplitudes of gears at 1500 poses: minutes"]
fn fifty_poses_cannot_be_expected_to_do_the_work_of_two_hundred_random_ones() {
    let robot = ur10();
    for measures in [MeasuredQuantity::Poses, MeasuredQuantity::Positions] {
        let candidates =
            random_postures(&robot, &Bodies::for_reach(1.3), &design(0.05f64.to_degrees()), 1500, 1).unwrap();
        let request = request(&robot, measures);
        let [few, many] = [50, 200].map(|count| poses(&request, &candidates, count, None, 1).unwrap());
        let least_m = poses_position_m_min(&request, &candidates, 50).unwrap();
        println!(
            "{measures:?}: 50 planned {:.4e} m, bound of any 50 {least_m:.4e}, 50 random {:.4e}, 200 random {:.4e}, 200 planned {:.4e}",
            few.position_m, few.random_m, many.random_m, many.position_m
        );
        assert!(least_m < few.position_m && few.position_m < few.random_m);
        assert!(least_m > 1.2 * many.random_m, "{least_m} {}", many.random_m);
    }
}

#[test]
#[ignore = "needs chromium"]
fn a_browser_draws_the_arm_from_pose_to_pose_and_asks_nobody_else() {
    for count in ["8", "1"] {
        let directory = tempfile::tempdir().unwrap();
        let arguments = [
            "plan",
            "poses",
            "--draw",
            "60",
            "--link-radius-mm",
            "30",
            "--count",
            count,
            "--measures",
            "positions",
            "--floor",
            "-0.2",
        ];
        assert!(identify(&arguments, "ur10.toml", directory.path()).status.success());
        let shown = browser::shown(&std::fs::read_to_string(directory.path().join("poses.html")).unwrap());
        // The script of the page writes the number of the pose that it shows.
        let pose = shown.document.split_once("id=\"path-shown\">").unwrap().1.split_once('<').unwrap().0;
        let is_shown = pose.starts_with("pose ") && pose.ends_with(&format!(" of {count}"));
        assert!(is_shown, "{pose:?} {}", shown.stderr);
        assert_eq!(shown.foreign, Vec::<String>::new());
    }
}

#[test]
fn poses_are_drawn_over_the_whole_of_a_track() {
    let track = std::fs::read_to_string(repository("identify/tests/data/on_a_track.urdf")).unwrap();
    let mut robot = import(&track, Some("cell"), Some("tool")).unwrap().config;
    robot.joint_limits_m = vec![[0.0, 8.0]];
    // The margin of 3 deg corresponds to 3 mm on the track. Therefore positions are more than 2 mm from
    // the ends of the track at 0 and 8 m.
    let drawn = random_postures(&robot, &Bodies::for_reach(1.3), &design(3.0), 200, 1).unwrap();
    assert!(drawn.iter().all(|q| (0.002..7.998).contains(&q[0])));
    assert!(drawn.iter().any(|q| q[0] > 7.0) && drawn.iter().any(|q| q[0] < 1.0));
}

/// The default design with this margin between joints and their limits.
fn design(margin_deg: f64) -> Design {
    Design { limit_margin_deg: margin_deg, ..Design::IRB_2400 }
}

/// Largest motion of any joint between consecutive poses \[rad, m\].
fn moves(joints: &[Joints]) -> impl Iterator<Item = f64> + '_ {
    let far =
        |pair: &[Joints]| pair[0].iter().zip(&pair[1]).fold(0.0_f64, |most, (a, b)| most.max((a - b).abs()));
    joints.windows(2).map(far)
}

fn planned(robot: &RobotConfig, measures: MeasuredQuantity, bodies: &Bodies, count: usize) -> PlannedPoses {
    let candidates = random_postures(robot, bodies, &design(0.05f64.to_degrees()), 300, 1).unwrap();
    poses(&request(robot, measures), &candidates, count, Some(bodies), 1).unwrap()
}

#[test]
#[ignore = "plans for several arms: half a minute"]
fn poses_of_any_arm_and_instrument_are_clear_within_limits_and_expected_to_be_better_than_random_ones() {
    let track = std::fs::read_to_string(repository("identify/tests/data/on_a_track.urdf")).unwrap();
    let on_a_track = import(&track, Some("cell"), Some("tool")).unwrap().config;
    for (robot, measures) in [
        (ur10(), MeasuredQuantity::Positions),
        (ur10(), MeasuredQuantity::Lengths),
        (on_a_track, MeasuredQuantity::Poses),
    ] {
        let arm = flange_chain(&robot);
        let bodies = Bodies { floor_m: Some(-0.1), ..Bodies::for_reach(1.3) };
        let found = planned(&robot, measures, &bodies, 40);
        assert_eq!(found.chosen.iter().collect::<BTreeSet<_>>().len(), 40);
        for q in &found.joints {
            assert!(q.iter().zip(robot.joint_limits()).all(|(q, [low, high])| (low..=high).contains(q)));
            // Links must keep a distance of their radius plus the clearance from the floor.
            let height_m = arm.forward(q).translation.vector.z;
            assert!(height_m > -0.1 + bodies.link_radius_m + 0.02 - 1e-9, "{height_m}");
        }
        println!("{} {measures:?}: {} {} {}", robot.name, found.position_m, found.random_m, found.before_m);
        assert!(found.position_m < found.random_m && found.random_m < found.before_m);
        // The planned order of the poses makes the motion shorter than the random order of the candidates does.
        let mut by_number: Vec<_> = found.chosen.iter().zip(&found.joints).collect();
        by_number.sort_by_key(|(number, _)| **number);
        let by_number: Vec<Joints> = by_number.into_iter().map(|(_, q)| *q).collect();
        let [short, long]: [f64; 2] = [&found.joints, &by_number].map(|order| moves(order).sum());
        assert!(short < 0.8 * long, "{short} {long}");
        // If a joint must not pass a certain angle, it moves in the other direction. Therefore no move is blocked.
        assert!(found.blocked().is_empty(), "{} {measures:?}: {:?}", robot.name, found.blocked());
        // Each move is free of collisions. This is checked with smaller steps than in the planner.
        for (postures, way) in found.moves().zip(&found.ways[1..]) {
            assert_eq!(postures.len() > 2, *way != Way::Straight);
            for pair in postures.windows(2) {
                for step in 0..=100 {
                    let part = f64::from(step) / 100.0;
                    let q = Joints::from_fn(pair[0].len(), |i| pair[0][i] + part * (pair[1][i] - pair[0][i]));
                    let height_m = arm.forward(&q).translation.vector.z;
                    assert!(height_m > -0.1 + 0.5 * bodies.link_radius_m, "{height_m}");
                }
            }
        }
    }
}

#[test]
fn a_calibration_needs_as_many_poses_as_a_plan_states() {
    let needed = MeasuredQuantity::Poses.poses_min();
    let rows = Rows::read(&repository("identify/tests/data/ur10/grid.csv"), 1, needed, 1).offered;
    let is_too_few = |rows: &[PoseRow]| {
        let result = Alone::quick().without_joint_errors().poses(rows, &ur10());
        result.is_err_and(|error| error.to_string().contains("remain for the fit"))
    };
    assert!(is_too_few(&rows[1..]) && !is_too_few(&rows));
    assert_eq!(MeasuredQuantity::Lengths.poses_min(), 18);
}

#[test]
fn the_arm_that_folds_into_itself_is_not_clear() {
    let (robot, bodies) = (ur10(), Bodies::for_reach(1.3));
    let arm = flange_chain(&robot);
    let is_clear = |degrees: [f64; 6]| bodies.is_clear(&arm, &degrees.map(f64::to_radians));
    assert!(is_clear([0.0, -90.0, 60.0, 0.0, 90.0, 0.0]));
    // The forearm is folded onto the upper arm, so the wrist is at the shoulder and collides.
    assert!(!is_clear([0.0, -90.0, 175.0, 0.0, 90.0, 0.0]));
}

#[test]
#[ignore = "takes more than four seconds"]
fn the_command_writes_poses_that_calibrate_reads_and_a_program_that_stops_at_each() {
    let directory = tempfile::tempdir().unwrap();
    let out = directory.path();
    // With links of the default radius, the folded arm could not leave some of these poses.
    let common = ["plan", "poses", "--draw", "60", "--link-radius-mm", "40"];
    let plan = |count: &str, more: &[&str]| {
        identify(&[&common[..], &["--count", count], more].concat(), "ur10.toml", out)
    };
    let planned =
        plan("20", &["--measures", "positions", "--stand", "2s", "--program", "urscript,rapid,krl"]);
    assert!(planned.status.success(), "{}", String::from_utf8_lossy(&planned.stderr));
    let said = String::from_utf8(planned.stdout).unwrap();
    assert!(said.contains("20 of 60 poses") && said.contains("waves per turn"), "{said}");
    // The default target is on the axis of joint 6, so a rotation of joint 6 does not move the target.
    assert!(said.contains("on the axis of joint 6") && said.contains("--target 0.1,0,0.1"), "{said}");
    assert!(said.contains("--count 20 is too few: `identify calibrate` needs at least 25"), "{said}");
    let mapping: JointTableMapping = config::load(&out.join("poses.toml")).unwrap();
    let joints = mapping.load(&out.join("poses.csv")).unwrap();
    assert_eq!(joints.len(), 20);
    let _: MeasuredPoseMapping = config::load(&out.join("poses.toml")).unwrap();
    let read = |name: &str| std::fs::read_to_string(out.join(name)).unwrap();
    // The page shows the arm in each pose. At every stop, the target must be where forward kinematics of the joints
    // in the table places it.
    let page = read("poses.html");
    let scene = browser::scene(&page);
    let (frames, point) = (scene["frames"].as_array().unwrap(), scene["ends"].as_u64().unwrap() as usize);
    let every = scene["frames_per_pose"].as_u64().unwrap() as usize;
    assert_eq!(frames.len(), 19 * every + 1);
    let arm = flange_chain(&ur10());
    for (frame, q) in frames.iter().step_by(every).zip(&joints) {
        let target = arm.forward(q) * Point3::new(0.0, 0.0, 0.1);
        let drawn = Point3::from(Vector3::from_fn(|axis, _| frame[3 * point + axis].as_f64().unwrap()));
        assert!((target - drawn).norm() < 2e-3, "{target} {drawn}");
    }
    for shown in ["with 20 random ones", "backlash", "travel in all", "links, lengths and angles alike"] {
        assert!(page.contains(shown), "{shown}");
    }
    let script = read("measure_poses.script");
    let stops: Vec<&str> = script.lines().filter_map(|line| line.trim().strip_prefix("movej([")).collect();
    assert_eq!(stops.len(), 20);
    for (stop, q) in stops.iter().zip(&joints) {
        let told = stop.split_once(']').unwrap().0.split(',').map(|angle| angle.parse::<f64>().unwrap());
        assert!(told.zip(q).all(|(told, q)| (told - q).abs() < 1e-6), "{stop}");
    }
    for (name, stop, wait) in [
        ("measure_poses.script", "movej(", "sleep(2)"),
        ("MeasurePoses.mod", ",fine,tool0;", "WaitTime 2;"),
        ("measure_poses.src", "PTP {", "WAIT SEC 2"),
    ] {
        let program = read(name);
        assert_eq!([program.matches(stop).count(), program.matches(wait).count()], [20, 20], "{name}");
    }
    // The table that was written can be read again.
    let (table, mapping) = (out.join("poses.csv"), out.join("poses.toml"));
    let [table, mapping] = [&table, &mapping].map(|path| path.to_str().unwrap());
    let again = identify(
        &[
            "plan",
            "poses",
            "--measures",
            "poses",
            "--count",
            "20",
            "--candidates",
            table,
            "--mapping",
            mapping,
        ],
        "ur10.toml",
        &out.join("again"),
    );
    assert!(again.status.success(), "{}", String::from_utf8_lossy(&again.stderr));
    for (count, more, told) in [
        ("20", &["--measures", "lengths"][..], "--measures lengths needs --anchor X,Y,Z"),
        ("20", &["--measures", "poses", "--anchor", "1,0,0"], "give it with --measures lengths only"),
        ("20", &["--measures", "positions", "--noise-mrad", "1"], "--noise-mrad is that of orientations"),
        ("20", &["--measures", "poses", "--floor", "5"], "random postures keep"),
        ("61", &["--measures", "poses"], "61 of 60 poses"),
        ("0", &["--measures", "poses"], "--count is 0; give at least one pose"),
    ] {
        let refused = plan(count, more);
        let said = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert!(!refused.status.success() && said.contains(told), "{said}");
    }
}

/// Plans a single pose, which takes little time.
fn plan_one_pose(language: &str, out: &Path) -> Output {
    let arguments = ["plan", "poses", "--measures", "positions", "--draw", "5", "--count", "1"];
    identify(&[&arguments[..], &["--program", language]].concat(), "ur10.toml", out)
}

#[test]
fn a_program_of_earlier_poses_is_removed() {
    let directory = tempfile::tempdir().unwrap();
    let out = directory.path();
    for (language, written) in [("rapid", "MeasurePoses.mod"), ("krl", "measure_poses.src")] {
        let planned = plan_one_pose(language, out);
        assert!(planned.status.success(), "{}", String::from_utf8_lossy(&planned.stderr));
        assert!(out.join(written).exists());
    }
    assert!(!out.join("MeasurePoses.mod").exists());
}

#[test]
fn a_table_with_measurements_is_not_overwritten() {
    let directory = tempfile::tempdir().unwrap();
    let (out, file) = (directory.path(), directory.path().join("poses.csv"));
    for _ in 0..2 {
        let planned = plan_one_pose("urscript", out);
        assert!(planned.status.success(), "{}", String::from_utf8_lossy(&planned.stderr));
    }
    let empty = std::fs::read_to_string(&file).unwrap();
    let measured = empty.replacen(",,,,", ",,1.5,,", 1);
    assert_ne!(measured, empty);
    for table in [measured, empty.replace(',', ";")] {
        std::fs::write(&file, &table).unwrap();
        let refused = plan_one_pose("urscript", out);
        let said = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert!(refused.status.code() == Some(1) && said.contains("may contain measurements"), "{said}");
        assert_eq!(std::fs::read_to_string(&file).unwrap(), table);
    }
}

/// For each language, checks the program for two moves: one without a free path, and one through an intermediate posture.
#[test]
fn programs_stop_before_a_blocked_move_and_drive_through_the_postures_of_others() {
    let mut robot = ur10();
    // A FANUC program needs this coupling of joints 2 and 3.
    robot.log.raw_to_joint[1][2] = -1.0;
    let joints: Vec<Joints> = (1..=3).map(|pose| Joints::from_array([0.1 * f64::from(pose); 6])).collect();
    let through = Joints::from_array([0.25; 6]);
    let planned = PlannedPoses {
        chosen: vec![0, 1, 2],
        ways: vec![Way::Straight, Way::Through(vec![through]), Way::Blocked],
        joints,
        before_m: 0.0,
        position_m: 0.0,
        random_m: 0.0,
        determined: Vec::new(),
    };
    for (language, moves, waits, stop) in [
        (Language::Rapid, "MoveAbsJ ", "WaitTime", "Stop\\NoRegain;"),
        (Language::Krl, "PTP {", "WAIT SEC", "HALT"),
        (Language::Urscript, "movej(", "sleep(", "  halt"),
        (Language::Fanuc, "J P[", "WAIT ", "PAUSE"),
    ] {
        let text = pose_program(language, &planned, &robot, 2.0).unwrap();
        let lines: Vec<&str> = text
            .lines()
            .filter(|line| line.contains(moves) || line.contains(waits) || line.contains(stop))
            .collect();
        let is = |line: &&str| [moves, waits, stop].iter().position(|word| line.contains(word)).unwrap();
        assert_eq!(lines.iter().map(is).collect::<Vec<_>>(), [0, 1, 0, 0, 1, 2, 0, 1], "{text}");
        assert!(text.contains("jog by hand to pose 3"), "{text}");
        // Comments are wrapped to the line length of the language, so their lines are joined here.
        let before = text.split_once(stop).unwrap().0.replace(['!', ';', '\n'], " ");
        let is_word =
            |word: &&str| word.strip_suffix(':').is_none_or(|number| number.parse::<u32>().is_err());
        let before = before.split_whitespace().filter(is_word).collect::<Vec<_>>().join(" ");
        assert!(before.contains("no path without collision from pose 2 to pose 3"), "{text}");
    }
}

/// There are walls on both sides of the arm. It must fold to move from one half of the cell to the other.
#[test]
#[ignore = "takes more than four seconds"]
fn moves_go_round_a_wall_through_postures_that_are_clear() {
    let robot = ur10();
    let bodies = Bodies {
        boxes_m: vec![[[0.45, -0.02, -1.0], [3.0, 0.02, 3.0]], [[-3.0, -0.02, -1.0], [-0.45, 0.02, 3.0]]],
        ..Bodies::for_reach(1.3)
    };
    let arm = flange_chain(&robot);
    let found = planned(&robot, MeasuredQuantity::Positions, &bodies, 25);
    assert!(found.ways.iter().any(|way| matches!(way, Way::Through(_))), "{:?}", found.ways);
    for (postures, way) in found.moves().zip(&found.ways[1..]).filter(|(_, way)| **way != Way::Blocked) {
        assert_eq!(postures.len() > 2, *way != Way::Straight);
        for pair in postures.windows(2) {
            for step in 0..=200 {
                let part = f64::from(step) / 200.0;
                let q = Joints::from_fn(6, |axis| pair[0][axis] + part * (pair[1][axis] - pair[0][axis]));
                assert!(
                    bodies.is_clear(&arm, &q)
                        && q.iter().zip(robot.joint_limits()).all(|(q, [low, high])| low <= *q && *q <= high)
                );
            }
        }
    }
}

/// Two walls have a gap that is narrower than the wrist, so no path connects the two sides.
#[test]
#[ignore = "plans among obstacles: a minute and a half"]
fn blocked_moves_are_marked_everywhere_and_end_with_an_error() {
    let directory = tempfile::tempdir().unwrap();
    let out = directory.path();
    let arguments = ["plan", "poses", "--measures", "positions", "--draw", "60", "--count", "12"];
    let walls = ["--box", "-0.02,0.2,-1,0.02,3,3", "--box", "-0.02,-3,-1,0.02,-0.2,3"];
    let programs = ["--program", "urscript,rapid,krl"];
    let planned = identify(&[&arguments[..], &walls, &programs].concat(), "ur10.toml", out);
    let [said, error] =
        [&planned.stdout, &planned.stderr].map(|text| String::from_utf8_lossy(text).into_owned());
    assert_eq!(planned.status.code(), Some(1), "{said} {error}");
    assert!(
        error.contains("moves are blocked: no path without collision") && error.contains("--draw"),
        "{error}"
    );
    assert!(said.contains("no path without collision was found to pose "), "{said}");
    let read = |name: &str| std::fs::read_to_string(out.join(name)).unwrap();
    assert!(read("poses.html").contains("no path without collision was found to pose "));
    let table = read("poses.csv");
    let marked: Vec<usize> =
        table.lines().enumerate().filter(|(_, row)| row.contains("BLOCKED")).map(|(row, _)| row).collect();
    assert!(!marked.is_empty());
    for (name, stop) in [
        ("MeasurePoses.mod", "Stop\\NoRegain;"),
        ("measure_poses.src", "\nHALT\n"),
        ("measure_poses.script", "\n  halt\n"),
    ] {
        let program = read(name);
        assert_eq!(program.matches(stop).count(), marked.len(), "{name}");
        for pose in &marked {
            assert!(program.contains(&format!("jog by hand to pose {pose}")), "{name}");
        }
    }
    // Marks of blocked moves in the table do not prevent reading it.
    let mapping: JointTableMapping = config::load(&out.join("poses.toml")).unwrap();
    assert_eq!(mapping.load(&out.join("poses.csv")).unwrap().len(), 12);
}
