//! Corrupted files of measured poses are refused, and the message names the cause.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "figures of a run")]

use identify::kinematics::Joints;
use identify::logs::{MeasuredPoseMapping, MeasuredPoses, PoseRow};
use nalgebra::{Rotation3, Vector3};
use shared::config::{self, RobotConfig};

use crate::support::rows::{Alone, Found};
use crate::support::{irb120, irb2400, ur10};

const FILES: [&str; 2] = ["iso_cubes.csv", "grid.csv"];

/// Rows of a real UR10 from a file of this repository.
fn measured(name: &str) -> Vec<PoseRow> {
    let mapping: MeasuredPoseMapping =
        config::load(&crate::support::repository("config/measured_pose.toml")).unwrap();
    let path = crate::support::repository("identify/tests/data/ur10").join(name);
    MeasuredPoses::load(&path, &mapping).unwrap().rows
}

/// Calibrates links only, without joint errors. The residuals of such a fit reveal the corruption.
fn calibrated(rows: &[PoseRow], robot: &RobotConfig) -> Result<Found, String> {
    Alone::quick().without_joint_errors().poses(rows, robot).map_err(|error| error.to_string())
}

/// Applies `change` to the rows of each file and calibrates. Returns the message for each file, or `accepted`.
fn said(change: impl Fn(Vec<PoseRow>) -> Vec<PoseRow>) -> Vec<String> {
    let of = |name: &&str| {
        calibrated(&change(measured(name)), &ur10()).map_or_else(|said| said, |_| "accepted".into())
    };
    let said: Vec<String> = FILES.iter().map(of).collect();
    println!("{}", said.join("\n"));
    said
}

fn joints(change: impl Fn(&mut Joints)) -> impl Fn(Vec<PoseRow>) -> Vec<PoseRow> {
    move |mut rows| {
        rows.iter_mut().for_each(|row| change(&mut row.joints_rad));
        rows
    }
}

fn all_say(said: &[String], words: &str) {
    assert!(said.iter().all(|said| said.contains(words)), "not {words:?}: {said:#?}");
}

#[test]
fn rows_as_they_were_measured_are_accepted() {
    for name in FILES {
        calibrated(&measured(name), &ur10()).unwrap();
        let half: Vec<PoseRow> = measured(name).into_iter().step_by(2).collect();
        calibrated(&half, &ur10()).unwrap();
    }
}

#[test]
#[ignore = "needs the whole measured data in the folder BALLBAR_DATA"]
fn all_rows_of_the_real_ur10_are_accepted_in_each_of_twenty_parts() {
    let Some(data) = crate::support::measured_data() else { return };
    let mapping: MeasuredPoseMapping =
        config::load(&crate::support::repository("config/measured_pose.toml")).unwrap();
    let rows = MeasuredPoses::load(&data.join("ur10-tracker/grid_11911.csv"), &mapping).unwrap().rows;
    for part in rows.chunks_exact(rows.len() / 20) {
        calibrated(part, &ur10()).unwrap();
    }
}

#[test]
#[ignore = "takes more than four seconds"]
fn a_joint_that_counts_the_other_way_is_named() {
    for joint in 0..6 {
        all_say(&said(joints(|q| q[joint] = -q[joint])), &format!("most likely joint {} counts", joint + 1));
    }
}

fn are_named(exchanged: impl Iterator<Item = (usize, usize)>) {
    for (one, other) in exchanged {
        let words = format!("most likely joints {} and {} are exchanged", one + 1, other + 1);
        all_say(&said(joints(|q| q.swap(one, other))), &words);
    }
}

#[test]
#[ignore = "takes more than four seconds"]
fn exchanged_joints_are_named() {
    are_named([(0, 3), (3, 4), (3, 5)].into_iter());
}

#[test]
#[ignore = "takes a minute"]
fn any_exchanged_joints_are_named() {
    are_named((0..6).flat_map(|one| (one + 1..6).map(move |other| (one, other))));
}

#[test]
fn joints_in_the_other_unit_are_named() {
    all_say(&said(joints(|q| *q = q.map(f64::to_radians))), "most likely the joints are in the other unit");
}

#[test]
fn rows_that_are_shifted_against_the_measurements_are_named() {
    let words = "each row's joints belong to the measurement of the row before or after it";
    let later = |rows: Vec<PoseRow>| {
        let pairs = rows.windows(2).map(|pair| PoseRow { joints_rad: pair[1].joints_rad, ..pair[0] });
        pairs.collect()
    };
    let earlier = |rows: Vec<PoseRow>| {
        let pairs = rows.windows(2).map(|pair| PoseRow { joints_rad: pair[0].joints_rad, ..pair[1] });
        pairs.collect()
    };
    all_say(&said(later), words);
    all_say(&said(earlier), words);
}

#[test]
fn positions_in_metres_that_are_read_as_millimetres_are_named() {
    let read = |mut rows: Vec<PoseRow>| {
        rows.iter_mut().for_each(|row| row.position_m *= 1e-3);
        rows
    };
    all_say(&said(read), "the true lengths are 1000 times the lengths as read");
}

#[test]
fn exchanged_axes_of_the_positions_are_named() {
    for (one, other) in [(0, 1), (1, 2)] {
        let exchanged = |mut rows: Vec<PoseRow>| {
            rows.iter_mut().for_each(|row| row.position_m.swap_rows(one, other));
            rows
        };
        all_say(&said(exchanged), "two axes of the positions are exchanged");
    }
}

#[test]
fn angles_of_orientation_in_another_order_or_unit_are_named() {
    let words = "angles are in another order, frame or unit";
    let read = |other: fn(f64, f64, f64) -> Rotation3<f64>| {
        move |mut rows: Vec<PoseRow>| {
            for row in &mut rows {
                row.rotation = row.rotation.map(|rotation| {
                    let (x, y, z) = rotation.euler_angles();
                    other(x, y, z)
                });
            }
            rows
        }
    };
    all_say(&said(read(|x, y, z| Rotation3::from_euler_angles(z, y, x))), words);
    all_say(&said(read(|x, y, z| Rotation3::from_euler_angles(-x, -y, -z).inverse())), words);
    all_say(
        &said(read(|x, y, z| Rotation3::from_euler_angles(x.to_radians(), y.to_radians(), z.to_radians()))),
        words,
    );
}

#[test]
fn a_table_in_the_other_convention_is_named() {
    // The table of this robot is in the modified convention: lengths and twists are one row
    // later than in the standard convention.
    let mut typed = ur10();
    let links = typed.links.clone();
    for (link, before) in typed.links.iter_mut().skip(1).zip(&links) {
        (link.a_m, link.alpha_deg) = (before.a_m, before.alpha_deg);
    }
    (typed.links[0].a_m, typed.links[0].alpha_deg) = (0.0, 0.0);
    for name in FILES {
        let said = calibrated(&measured(name), &typed).map(|_| ()).unwrap_err();
        assert!(said.contains("most likely the robot's table is in the modified convention"), "{said}");
    }
}

#[test]
#[ignore = "takes more than four seconds"]
fn rows_of_another_robot_are_refused_without_a_guess() {
    for other in [irb2400(), irb120()] {
        for name in FILES {
            let said = calibrated(&measured(name), &other).map(|_| ()).unwrap_err();
            println!("{said}");
            assert!(!said.contains("most likely"), "{said}");
        }
    }
}

#[test]
fn a_tracker_that_was_moved_is_refused_with_the_row() {
    for name in FILES {
        let rows = measured(name);
        for (moved_mm, at) in [(30.0, 0.5), (10.0, 0.3)] {
            let from = (at * rows.len() as f64) as usize;
            let mut moved = rows.clone();
            moved[from..]
                .iter_mut()
                .for_each(|row| row.position_m += Vector3::new(0.6, -0.64, 0.48) * moved_mm * 1e-3);
            let said = calibrated(&moved, &ur10()).map(|_| ()).unwrap_err();
            println!("{name} {moved_mm} mm from row {}: {said}", from + 1);
            let near = said
                .split("near row ")
                .nth(1)
                .unwrap()
                .split([' ', ':'])
                .next()
                .unwrap()
                .parse::<usize>()
                .unwrap();
            assert!(near.abs_diff(from + 1) <= rows.len() / 20, "{said}");
        }
    }
}
