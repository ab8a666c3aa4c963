//! Free parameters: selections by name, and terms that are kept only if they improve the prediction of held-out data.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "figures of a run")]

use std::collections::BTreeSet;

use crate::support::laboratory::{self, Level};
use crate::support::{Cell, bar, irb2400, spread_poses};
use identify::calibrate::selection::structure::identifiable;
use identify::calibrate::{Calibration, IdentifyConfig, SelectionName, calibrate_run};
use identify::evaluate::{evidence, uncalibrated};
use identify::instrument::CostName;
use identify::model::TermGroup;
use identify::model::{ParameterId, Phase, Role, thesis_fixed};
use identify::simulate::{self, Design, Effects, Experiment};

fn calibrated(effects: Effects, selection: SelectionName) -> Calibration {
    let (robot, bar) = (irb2400(), bar());
    let effects = Effects { robot_noise_urad: 15.0, encoder_noise_urad: 5.0, ..effects };
    let design = Design { duration_s: 60.0, ..Design::for_robot(&robot) };
    let run = simulate::run(&Experiment { effects, design, ..Experiment::new(&robot, &bar) }).unwrap();
    let config = IdentifyConfig { selection, ..IdentifyConfig::default() };
    let found = calibrate_run(&run.cycles, &run.encoders, &run.robot_log, &robot, &bar, &config).unwrap();
    for candidate in &found.solved.candidates {
        println!("{effects:?} {candidate:?}");
    }
    found
}

fn taken(found: &Calibration) -> BTreeSet<&'static str> {
    found.solved.candidates.iter().filter(|one| one.accepted).map(|one| one.group.name()).collect()
}

fn names(ids: &[ParameterId]) -> BTreeSet<String> {
    ids.iter().map(ToString::to_string).collect()
}

/// Number of identifiable parameters of the reference set-up with the two rotations of the base: 41
/// for `transform`, 33 for `position`.
#[test]
fn all_identifiable_frees_as_many_as_the_rank_and_leaves_out_what_the_thesis_fixes() {
    let cell = Cell::irb2400();
    let (observations, joints) = spread_poses(&cell.robot, &cell.bar, 300, 7);
    let model = cell.model();
    let free = |cost| names(&identifiable(&model, &joints, &observations, cost).unwrap());
    let transform = free(CostName::Transform);
    assert_eq!(transform.len(), 41);
    assert_eq!(transform, free(CostName::Pose));
    // The cost `transform` uses the whole pose, which determines `balpha2`. For the other costs,
    // the thesis fixes this parameter.
    for name in thesis_fixed(model.axes()).map(|id| id.to_string()) {
        assert_eq!(transform.contains(&name), name == "balpha2", "{name}");
    }
    assert_eq!(free(CostName::Position).len(), 33);
    assert_eq!(free(CostName::Length).len(), 23);
}

#[test]
#[ignore = "takes more than four seconds"]
fn terms_are_taken_where_the_robot_has_the_error_and_left_out_where_not() {
    let none = calibrated(Effects::default(), SelectionName::Cell);
    assert!(taken(&none).len() <= 1, "{:?}", taken(&none));
    let offered: Vec<TermGroup> = none.solved.candidates.iter().map(|one| one.group).collect();
    let groups = TermGroup::OF_ROBOT.into_iter().chain([TermGroup::BarLength]);
    for group in groups {
        // A line spectrum is only offered if the spectrum of the residuals contains lines.
        // The spectrum of noise contains none.
        assert_eq!(offered.contains(&group), group != TermGroup::LineSpectrum, "{group:?}");
    }
    for (effects, group) in [
        (Effects { gear_sine_urad: 30.0, ..Effects::default() }, TermGroup::GearTwice),
        (Effects { cycloid_urad: 20.0, ..Effects::default() }, TermGroup::Cycloid),
        (Effects { backlash_urad: 20.0, ..Effects::default() }, TermGroup::Backlash),
    ] {
        let found = calibrated(effects, SelectionName::Cell);
        assert!(taken(&found).contains(group.name()), "{group:?} among {:?}", taken(&found));
        for candidate in &found.solved.candidates {
            assert!(!candidate.accepted || candidate.held_out_after < candidate.held_out_before);
        }
    }
}

#[test]
fn harmonics_of_encoders_are_found_and_tolerances_that_hold_stay() {
    let effects = Effects { encoder_eccentricity_urad: 40.0, ..Effects::default() };
    let found = calibrated(effects, SelectionName::Cell);
    let wave = |phase| ParameterId::EncoderWave { joint: 0, order: 1, phase };
    let value = |phase| found.model().parameter(wave(phase)).unwrap().value * 1e6;
    let amplitude_urad: f64 = f64::hypot(value(Phase::Sine), value(Phase::Cosine));
    assert!((amplitude_urad - 40.0).abs() < 12.0, "{amplitude_urad}");
    // The true errors have a size of about 1 mm|mrad.
    assert!((1.0..=2.0).contains(&found.solved.prior_scale), "{}", found.solved.prior_scale);
}

const LOBES: [f64; 6] = [57.0, 31.0, 44.0, 63.0, 52.0, 35.0];

/// A calibration of a robot whose gears have 57, 31, 44 .. lobes. The configuration of the calibration has no
/// numbers of lobes, or wrong ones.
fn with_lobes(config: &IdentifyConfig) -> Calibration {
    let (mut robot, bar) = (irb2400(), bar());
    robot.drives.cycloid_lobes = LOBES.to_vec();
    let effects =
        Effects { cycloid_urad: 20.0, robot_noise_urad: 15.0, encoder_noise_urad: 5.0, ..Effects::default() };
    let run = simulate::run(&Experiment { effects, ..Experiment::new(&robot, &bar) }).unwrap();
    robot.drives.cycloid_lobes = vec![39.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    calibrate_run(&run.cycles, &run.encoders, &run.robot_log, &robot, &bar, config).unwrap()
}

#[test]
fn lobes_of_gears_that_nobody_has_counted_are_found() {
    let found = with_lobes(&IdentifyConfig::default());
    assert!(taken(&found).contains(TermGroup::LineSpectrum.name()), "{:?}", taken(&found));
    let waves = found.model().columns().filter_map(|parameter| match parameter.id {
        ParameterId::JointWave { axis, order, phase: Phase::Sine } => {
            let cosine = ParameterId::JointWave { axis, order, phase: Phase::Cosine };
            let cosine = found.model().parameter(cosine).unwrap().value;
            Some((axis, f64::from(order), parameter.value.hypot(cosine) * 1e6))
        }
        _ => None,
    });
    let waves: Vec<(usize, f64, f64)> = waves.collect();
    println!("{waves:?}");
    for (axis, lobes) in LOBES.into_iter().enumerate() {
        // A drive that turns only by a sixth of a turn does not determine the order exactly. The
        // order may be found as 45 instead of 44.
        let mut near = waves.iter().filter(|wave| wave.0 == axis && (wave.1 - lobes).abs() <= 1.0);
        let found = near.next().map(|(_, _, urad)| *urad);
        assert!(found.is_some_and(|urad| (urad - 20.0).abs() < 5.0), "axis {}: {found:?} urad", axis + 1);
    }
    // The simulated gear error has two harmonics: one of its order, and one of twice this
    // order with a quarter of the amplitude.
    let is_true = |(axis, order, _): &(usize, f64, f64)| {
        let lobes = LOBES[*axis];
        (order - lobes).abs() <= 1.0 || (order - 2.0 * lobes).abs() <= 2.0
    };
    assert!(waves.iter().all(is_true), "{waves:?}");

    // A calibration is compared with the nominal robot of the manufacturer, which has no harmonics.
    let mut nominal = uncalibrated(
        found.model(),
        &found.prepared().unwrap().motion,
        &found.prepared().unwrap().observations,
    );
    for wave in found.model().ids() {
        if matches!(wave, ParameterId::JointWave { .. }) {
            assert_eq!(nominal.parameter_mut(wave), Some(&mut 0.0), "{wave}");
        }
    }
}

#[test]
fn waves_can_be_freed_and_fixed_by_name() {
    let ids = |names: [&str; 2]| -> Vec<ParameterId> { names.map(|name| name.parse().unwrap()).to_vec() };
    let free = ids(["rsin31_2", "rcos31_2"]);
    let fix = ids(["rsin57_1", "rcos57_1"]);
    let found =
        with_lobes(&IdentifyConfig { free: free.clone(), fix: fix.clone(), ..IdentifyConfig::default() });
    let [freed, fixed] = [free, fix].map(|ids| {
        let [sine, cosine] = [0, 1].map(|index| found.model().parameter(ids[index]).unwrap());
        assert_eq!(sine.role, cosine.role);
        (sine.role, sine.value.hypot(cosine.value) * 1e6)
    });
    assert!(matches!(fixed, (Role::Considered { .. }, 0.0)), "{fixed:?}");
    assert!(freed.0 == Role::Free && (freed.1 - 20.0).abs() < 5.0, "{freed:?}");
}

/// The length of the laboratory's bar varies by 15 um twice per turn of joint 1, and by 10 um three times per turn
/// of joint 2. Joint 2 moves by less than half a turn, so orders two and three are similar. Therefore only the
/// harmonics of joint 1 are compared.
#[test]
fn how_the_length_of_the_bar_follows_its_direction_is_found() {
    let (robot, bar) = (irb2400(), bar());
    let level = Level { bar_um: 25.0, gear_sine_urad: 0.0, cycloid_urad: 0.0, ..Level::USUAL };
    let run = laboratory::run(&robot, &bar, 1, &level, Design::for_robot(&robot));
    let found =
        calibrate_run(&run.cycles, &run.encoders, &run.robot_log, &robot, &bar, &IdentifyConfig::default())
            .unwrap();
    assert!(taken(&found).contains(TermGroup::BarLength.name()), "{:?}", taken(&found));
    let amplitude_um = |joint, order| {
        let of = |phase| {
            found.model().parameter(ParameterId::BarWave { joint, order, phase }).unwrap().value * 1e6
        };
        of(Phase::Sine).hypot(of(Phase::Cosine))
    };
    for (joint, order, expected_um) in [(0, 2, 15.0), (0, 3, 0.0)] {
        let um: f64 = amplitude_um(joint, order);
        println!("joint {}, {order} per turn: {um:.2} um of {expected_um}", joint + 1);
        assert!((um - expected_um).abs() < 4.0, "joint {}, {order} per turn: {um}", joint + 1);
    }
    // None of these errors is caused by a force on the bar.
    let sphere = evidence(&found, &robot.joint_limits()).spheres.remove(0).after;
    assert!(sphere.size_m.rms > 0.0 && sphere.size_m.rms == sphere.unexplained_rms_m, "{sphere:?}");
}
