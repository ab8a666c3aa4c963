//! Checks the generator of runs. Results that use the generator are only evidence if the generator is correct.

use std::f64::consts::TAU;

use super::kinematics::{difference, position};
use super::*;

/// A run in which only the geometry differs from the nominal one. Readings have no errors.
fn exact(robot: Robot, family: Family) -> Run {
    let duration_s = Some(family.duration_s().min(60.0));
    let sizes = Sizes { duration_s, bound_mm_mrad: 1.0, ..Sizes::without_varying_errors() };
    Run::new(robot, family, &sizes, 5)
}

#[test]
fn the_reference_pose_is_that_of_the_product_specification() {
    let end = position(&Robot::irb2400().nominal.pose(&[0.0; 6]));
    assert!((end - Vector3::new(0.940, 0.0, 1.455)).norm() < 1e-9, "{end}");
}

#[test]
fn both_chains_end_in_the_same_pose_and_the_bar_keeps_to_its_sphere() {
    for robot in Robot::all() {
        let run = exact(robot, Family::Waypoints);
        let centre = Vector3::from(run.truth.base_m);
        let length_m = run.robot.bar_length_m + run.truth.bar_length_m;
        for (time_s, angles) in &run.true_rows {
            let end = run.true_arm.pose(angles);
            let apart = difference(&end, &run.true_bar.pose(&run.motion.bar_rad(*time_s), 0.0));
            assert!(apart.amax() < 1e-9, "{} at {time_s} s: {apart}", run.robot.name);
            // The difference is within the tolerances of the bar, 20 um or urad for each parameter.
            assert!(((position(&end) - centre).norm() - length_m).abs() < 2e-4);
        }
    }
}

#[test]
fn the_written_files_lead_back_to_the_true_angles() {
    for robot in [Robot::irb2400(), Robot::nj220(), Robot::kr10()] {
        let run = exact(robot, Family::Lissajous);
        let directory = tempfile::tempdir().unwrap();
        let files = run.write(directory.path());
        let rows = |path: &Path| -> Vec<Vec<f64>> {
            let mut reader = csv::Reader::from_path(path).unwrap();
            reader
                .records()
                .map(|row| row.unwrap().iter().map(|cell| cell.parse().unwrap()).collect())
                .collect()
        };
        let log = rows(&files.robot_log);
        assert_eq!(log.len(), run.true_rows.len());
        for (row, (time_s, angles)) in log.iter().zip(&run.true_rows) {
            assert!((row[0] - run.robot_s(*time_s)).abs() < 1e-6);
            let raw = RowVector6::from_fn(|_, joint| row[joint + 1] * run.robot.log.unit_rad);
            let joints = raw * run.robot.joints_from_raw;
            // The log has four decimals of a degree, so its resolution is 1e-4 deg.
            (0..6).for_each(|joint| assert!((joints[joint] - angles[joint]).abs() < 2e-6));
        }
        let recording = rows(&files.recording);
        assert_eq!(recording.len(), 6000);
        let mut turned = [0i64; 5];
        for pair in recording.windows(2) {
            let time_s = pair[1][0] - recording[0][0];
            let (begin, now) = (run.motion.bar_rad(0.0), run.motion.bar_rad(time_s));
            for joint in 0..5 {
                // Counters wrap at 32 bits, so the shorter difference between consecutive cycles is the true one.
                let step = (pair[1][joint + 1] as u32).wrapping_sub(pair[0][joint + 1] as u32).cast_signed();
                turned[joint] += i64::from(step);
                let read_rad = turned[joint] as f64 * TAU / COUNTS_PER_TURN;
                assert!((read_rad - (now[joint] - begin[joint])).abs() < 1e-6);
            }
        }
    }
}

#[test]
fn what_is_logged_moves_smoothly_on_every_kind_of_path() {
    for family in Family::ALL {
        let run = exact(Robot::irb2400(), family);
        let step_s = 1.0 / Sizes::default().robot_log_hz;
        let moving = run.true_rows.iter().filter(|row| run.motion.schedule.moves(row.0)).count();
        let share = moving as f64 * step_s / run.motion.duration_s;
        assert!(share > if family == Family::Bursts { 0.15 } else { 0.8 }, "{family:?}: {share}");
        for joint in 0..6 {
            let of = |index: usize| run.true_rows[index].1[joint];
            let third = |index: usize| of(index + 3) - 3.0 * of(index + 2) + 3.0 * of(index + 1) - of(index);
            let fastest = (1..run.true_rows.len()).map(|index| (of(index) - of(index - 1)).abs() / step_s);
            let jerk = (0..run.true_rows.len() - 3).map(|index| third(index).abs() / step_s.powi(3));
            assert!(fastest.fold(0.0, f64::max) < 1.05 * family.speed_rad_s().max(0.7), "{family:?}");
            // A step of 10 urad would appear as a jerk of 156 rad/s^3.
            let jerk = jerk.fold(0.0, f64::max);
            assert!(jerk < 100.0, "{family:?}, joint {}: {jerk} rad/s^3", joint + 1);
        }
    }
}

#[test]
fn a_seed_gives_the_same_run_again_and_another_gives_another() {
    let run = |seed| Run::new(Robot::irb2400(), Family::Short, &Sizes::default(), seed);
    let (one, again, other) = (run(1), run(1), run(2));
    assert!(one.rows == again.rows && one.cycles == again.cycles && one.truth.robot == again.truth.robot);
    assert!(one.rows != other.rows && one.truth.robot != other.truth.robot);
}

#[test]
fn errors_are_as_large_as_they_are_said_to_be() {
    let sizes = Sizes { duration_s: Some(60.0), ..Sizes::default() };
    let run = Run::new(Robot::irb2400(), Family::Waypoints, &sizes, 3);
    for joint in 0..6 {
        let errors: Vec<f64> = (run.rows.iter().zip(&run.true_rows))
            .filter(|(_, (time_s, _))| run.motion.schedule.moves(*time_s))
            .map(|(row, truth)| {
                let joints = RowVector6::from_row_slice(&row.1) * run.robot.joints_from_raw;
                joints[joint] - truth.1[joint]
            })
            .collect();
        let count = errors.len() as f64;
        let mean = errors.iter().sum::<f64>() / count;
        let rms = (errors.iter().map(|error| error.powi(2)).sum::<f64>() / count).sqrt();
        // The errors are three harmonics of 20 to 30 urad and some noise. The path may cover only a fraction of a period.
        assert!(mean.abs() < 1e-6 && (10e-6..60e-6).contains(&rms), "joint {}: {mean} {rms}", joint + 1);
    }
}

#[test]
fn stamps_go_wrong_only_as_they_are_told_to() {
    let rows: Vec<Row> = (0..1000).map(|index| (f64::from(index) * 0.004, [f64::from(index); 6])).collect();
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let mut of = |stamps: Stamps| stamps.applied(&rows, &mut random);
    assert_eq!(of(Stamps::Perfect), rows);
    let kinds = [Stamps::Rounded(15.6), Stamps::Jittered(2.0), Stamps::Duplicated(0.1), Stamps::Batched(5)];
    for kind in kinds {
        let written = of(kind);
        assert!(written.windows(2).all(|pair| pair[0].0 <= pair[1].0), "{kind:?} goes backwards");
        let late = written.iter().map(|(time_s, values)| time_s - values[0] * 0.004);
        let worst_s = late.fold(0.0f64, |worst, late| worst.max(late.abs()));
        let (least_s, most_s) = match kind {
            Stamps::Rounded(_) => (0.0075, 0.0078 + 1e-9),
            Stamps::Jittered(_) => (0.004, 0.010),
            Stamps::Duplicated(_) => (0.0, 1e-9),
            _ => (0.0158, 0.0162),
        };
        assert!((least_s..=most_s).contains(&worst_s), "{kind:?}: {worst_s}");
        let twice = written.windows(2).filter(|pair| pair[0] == pair[1]).count();
        assert_eq!(twice > 50, kind == Stamps::Duplicated(0.1));
    }
}

#[test]
fn what_no_motion_determines_has_no_bound() {
    let run = exact(Robot::irb2400(), Family::Waypoints);
    let bound = |undetermined: &'static [&'static str], poses: &[([f64; 5], [f64; 6])]| {
        let mut robot = run.robot.clone();
        robot.undetermined = undetermined;
        health::bound_mm_mrad(&robot, &run.true_arm, &run.true_bar, poses)
    };
    let rows = run.true_rows.iter().filter(|row| run.motion.schedule.moves(row.0));
    let poses: Vec<_> = rows.map(|(time_s, angles)| (run.motion.bar_rad(*time_s), *angles)).collect();
    let usual = bound(run.robot.undetermined, &poses);
    assert!((0.02..0.2).contains(&usual), "{usual}");
    // The first joint of the robot rotates the position of the bar, so rd1 and rd3 are not separated from this position.
    // With only a tenth of the path, their uncertainty is large.
    assert!(bound(&["rd1", "rd3"], &poses) > 100.0);
    assert!(bound(run.robot.undetermined, &poses[..poses.len() / 10]) > 3.0 * usual);
}
