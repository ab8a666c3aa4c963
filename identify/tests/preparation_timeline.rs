//! What the preparation adds to a report: an overview of the run, and standstills with their noise.
#![allow(clippy::unwrap_used, reason = "tests")]

use crate::support::{bar, irb2400};
use identify::prepare::{PrepareOptions, SampleStatus, Timeline, prepare};
use identify::simulate::{self, Design, Effects, Experiment};
use shared::recording::schema::flags;

#[test]
fn standstills_jitter_angles_and_statuses_are_those_of_the_simulated_run() {
    let (robot, bar) = (irb2400(), bar());
    let effects = Effects { robot_noise_urad: 15.0, encoder_noise_urad: 5.0, ..Effects::default() };
    let design = Design { duration_s: 60.0, ..Design::for_robot(&robot) };
    let mut run = simulate::run(&Experiment { effects, design, ..Experiment::new(&robot, &bar) }).unwrap();
    for invalid in [1, 2000, 2001, 2002] {
        let cycle = &mut run.cycles[invalid];
        cycle.flags = flags::STALE_INPUT;
        cycle.encoders[1].valid = false;
    }
    let prepared =
        prepare(&run.cycles, &run.encoders, &run.robot_log, &robot, &bar, &PrepareOptions::default())
            .unwrap();
    // Times in messages count from the first valid sample. The first point of the timeline shows the invalid cycle after it.
    let first_s = run.cycles[0].sample_time.seconds_since(prepared.t_ref);
    assert!(prepared.first_s == first_s && prepared.timeline.points[0].t_s > first_s);
    let Timeline { points, cycles_per_point, standstills, jitter, .. } = prepared.timeline;
    assert!(points.len() <= Timeline::POINTS_MAX && points.len() * cycles_per_point >= run.cycles.len());
    assert!(points.windows(2).all(|pair| pair[0].t_s < pair[1].t_s));
    assert!(points.iter().any(|point| point.status == SampleStatus::Invalid && point.measured_rad.is_none()));
    for joint in 0..5 {
        assert!((jitter.bar_urad[joint].unwrap() - 5.0).abs() < 1.0, "{jitter:?}");
    }
    // Interpolating between two stamps reduces the noise, so the values are below the simulated noise.
    assert!(jitter.robot_urad.iter().all(|urad| (8.0..17.0).contains(&urad.unwrap())), "{jitter:?}");

    let since_start_s = prepared.t_ref.seconds_since(run.truth.clock.bar_start);
    let path = &run.motion.path;
    let fastest = |t_s: f64| {
        let (a, b) = (path.at(t_s - 1e-3), path.at(t_s + 1e-3));
        a.iter().zip(b).map(|(a, b)| (b - a).abs() / 2e-3).fold(0.0, f64::max)
    };
    assert!(standstills.len() >= 4 && standstills[0].duration_s() > 1.5, "{standstills:?}");
    for standstill in &standstills {
        let middle_s = since_start_s + 0.5 * (standstill.from_s + standstill.to_s);
        assert!(fastest(middle_s) < 3e-3, "{standstill:?}");
    }
    for point in &points {
        let speed = fastest(since_start_s + point.t_s);
        if speed > 0.1 {
            assert!(point.bar_moves.unwrap_or(true) && point.robot_moves.unwrap_or(true), "{point:?}");
        }
        let (Some(measured), Some(predicted)) = (point.measured_rad, point.predicted_rad) else { continue };
        if point.margin_rad.unwrap() > 0.15 {
            let apart = measured.iter().zip(predicted).map(|(a, b)| (a - b).sin().abs());
            assert!(apart.fold(0.0, f64::max) < 0.03, "{point:?}");
        }
    }
}
