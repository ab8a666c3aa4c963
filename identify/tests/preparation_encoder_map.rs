//! Encoders are connected in any order and direction. The program determines order and direction from the data and reports
//! them. If the data do not determine them, the user must state them.
#![allow(clippy::unwrap_used, reason = "tests")]

use crate::support::laboratory::exchange;
use crate::support::{bar, irb2400, nj220};
use identify::calibrate::{IdentifyConfig, calibrate_run};
use identify::model::ParameterId;
use identify::prepare::{
    AnglePair, EncoderMap, EncoderMapChoice, PrepareError, PrepareOptions, Prepared, find_encoder_map,
    prepare,
};
use identify::simulate::Comparison;
use identify::simulate::{self, Design, Effects, Experiment, Simulated};
use shared::config::{BallBarConfig, RobotConfig};
use shared::encoder::Direction;

fn run(robot: &RobotConfig, bar: &BallBarConfig) -> Simulated {
    let design = Design { duration_s: 60.0, ..Design::for_robot(robot) };
    simulate::run(&Experiment { design, ..Experiment::new(robot, bar) }).unwrap()
}

fn reversed(run: &mut Simulated, places: &[usize]) {
    for &place in places {
        run.encoders[place].scale.direction = Direction::Negative;
    }
}

fn prepared(run: &Simulated, encoders: EncoderMapChoice) -> Result<Prepared, PrepareError> {
    let options = PrepareOptions { encoders, ..PrepareOptions::default() };
    prepare(&run.cycles, &run.encoders, &run.robot_log, &irb2400(), &bar(), &options)
}

fn joints_and_directions(encoder_map: &EncoderMap) -> Vec<(u8, bool)> {
    encoder_map.encoders.iter().map(|place| (place.joint, place.reversed)).collect()
}

#[test]
#[ignore = "takes more than four seconds"]
fn shuffled_and_reversed_encoders_calibrate_without_a_hand() {
    let (robot, mut bar) = (irb2400(), bar());
    for four in [false, true] {
        if four {
            bar.encoders.remove(2);
        }
        let mut run = run(&robot, &bar);
        let order: &[usize] = if four { &[3, 0, 2, 1] } else { &[4, 2, 0, 3, 1] };
        let true_joints: Vec<u8> = run.encoders.iter().map(|encoder| encoder.joint).collect();
        // Joints 1, 3 and 5 cannot all be reversed, because this would be the mirror image of the motion.
        let places: &[usize] = if four { &[0, 1, 2] } else { &[0, 1, 4] };
        reversed(&mut run, places);
        exchange(&mut run, order);
        let found = prepared(&run, EncoderMapChoice::Find).unwrap();
        let used = &found.encoder_map.used;
        assert!(!used.is_as_recorded());
        println!("{used}; others {:?}", found.encoder_map.others);
        for (place, joint) in used.encoders.iter().zip(&true_joints) {
            assert_eq!(place.joint, *joint);
            // On joints 2 and 4, a reversed direction is equivalent to another configuration of the bar.
            let negative = places.iter().any(|place| true_joints[*place] == *joint);
            assert!(matches!(joint, 2 | 4) || place.reversed == negative, "{used}");
        }
        assert!(found.encoder_map.others.is_empty());
        let config = IdentifyConfig::default();
        let calibration =
            calibrate_run(&run.cycles, &run.encoders, &run.robot_log, &robot, &bar, &config).unwrap();
        let of_robot =
            Comparison::new(&calibration, &run.truth).only(|id| matches!(id, ParameterId::Robot { .. }));
        let error = of_robot.euclidean_mm_mrad();
        println!("{} encoders: {error:.5} mm|mrad", order.len());
        assert!(error < 0.05, "{error}");
    }
}

#[test]
#[ignore = "takes more than four seconds"]
fn a_mirrored_robot_fits_reversed_encoders_and_which_of_both_it_is_gets_asked() {
    for robot in [irb2400(), nj220()] {
        let (bar, config) = (bar(), IdentifyConfig::default());
        let calibrated = |run: &Simulated, encoders: EncoderMapChoice| {
            let mut config = config.clone();
            config.prepare.encoders = encoders;
            calibrate_run(&run.cycles, &run.encoders, &run.robot_log, &robot, &bar, &config)
        };
        let mut mirrored = run(&robot, &bar);
        for joints in mirrored.robot_log.q_rad.iter_mut() {
            for joint in [0, 3, 5] {
                joints[joint] = -joints[joint];
            }
        }
        let refusal = calibrated(&mirrored, EncoderMapChoice::Find).unwrap_err().to_string();
        println!("{refusal}");
        assert!(refusal.contains("reversed signs of the robot's joints 1, 4 and 6"), "{refusal}");
        // Here the encoders themselves are reversed. The message is the same and contains the option to use.
        let mut run = run(&robot, &bar);
        reversed(&mut run, &[0, 2, 4]);
        let refusal = calibrated(&run, EncoderMapChoice::Find).unwrap_err().to_string();
        assert!(refusal.contains("type --encoders -1,2,-3,4,-5"), "{refusal}");
        let found = calibrated(&run, "-1,2,-3,4,-5".parse().unwrap()).unwrap();
        let error = Comparison::new(&found, &run.truth).only(|id| matches!(id, ParameterId::Robot { .. }));
        assert!(error.euclidean_mm_mrad() < 0.05, "{}", error.euclidean_mm_mrad());
    }
}

#[test]
fn order_and_directions_as_recorded_are_confirmed_and_nothing_else_fits() {
    let found = prepared(&run(&irb2400(), &bar()), EncoderMapChoice::Recorded).unwrap();
    assert!(found.encoder_map.used.is_as_recorded() && found.encoder_map.others.is_empty());
    assert!(found.encoder_map.used.spread_mrad() < 10.0);
}

#[test]
fn another_order_is_refused_where_only_the_recorded_one_may_be_used_and_named() {
    let mut run = run(&irb2400(), &bar());
    exchange(&mut run, &[4, 1, 2, 3, 0]);
    let message = prepared(&run, EncoderMapChoice::Recorded).unwrap_err().to_string();
    println!("{message}");
    assert!(message.contains("but as 5 -> 1") && message.contains("1 -> 5"), "{message}");
}

#[test]
fn a_stated_order_is_taken_and_a_senseless_one_refused() {
    let mut run = run(&irb2400(), &bar());
    reversed(&mut run, &[2]);
    exchange(&mut run, &[4, 1, 2, 3, 0]);
    let found = prepared(&run, EncoderMapChoice::Stated(vec![1, 2, -3, 4, 5])).unwrap();
    let wanted = vec![(1, false), (2, false), (3, true), (4, false), (5, false)];
    assert_eq!(joints_and_directions(&found.encoder_map.used), wanted);
    for senseless in [vec![1, 2, 3, 4], vec![1, 1, 2, 3, 4], vec![0, 1, 2, 3, 4], vec![1, 2, 3, 4, 6]] {
        let message = prepared(&run, EncoderMapChoice::Stated(senseless)).unwrap_err().to_string();
        assert!(message.contains("give 5 different bar joints"), "{message}");
    }
}

#[test]
fn a_stated_order_that_does_not_fit_is_refused_with_the_one_that_does() {
    let run = run(&irb2400(), &bar());
    for wrong in [vec![1, 2, -3, 4, 5], vec![1, 2, 3, 5, 4], vec![2, 1, 3, 4, 5]] {
        let message = prepared(&run, EncoderMapChoice::Stated(wrong)).unwrap_err().to_string();
        assert!(
            message.contains("do not fit as stated") && message.contains("take --encoders 1,2,3,4,5"),
            "{message}"
        );
    }
}

/// Generated pairs of recorded and predicted angles. Each entry of `alike` is a pair of joints that move together.
fn pairs(alike: &[[usize; 2]]) -> Vec<AnglePair> {
    let motion = |k: f64, joint: usize| (0.05 * k * (1.0 + 0.37 * joint as f64)).sin() + 0.3 * joint as f64;
    (0..400)
        .map(|k| {
            let mut predicted_rad: [f64; 5] = std::array::from_fn(|joint| motion(f64::from(k), joint));
            for [one, other] in alike {
                predicted_rad[*other] = predicted_rad[*one] + 0.2;
            }
            let mut recorded_rad = predicted_rad.map(|angle| angle + 1.7);
            // The encoders of joints 1 and 3 are exchanged.
            recorded_rad.swap(0, 2);
            AnglePair { recorded_rad, predicted_rad, ..AnglePair::default() }
        })
        .collect()
}

#[test]
fn joints_that_move_together_leave_the_order_open_and_it_is_asked_for() {
    let options = PrepareOptions::default();
    let clear = find_encoder_map(&pairs(&[]), &[1, 2, 3, 4, 5], &options).unwrap();
    assert_eq!(clear.used.encoders[0].joint, 3);
    let error = find_encoder_map(&pairs(&[[3, 4]]), &[1, 2, 3, 4, 5], &options).unwrap_err();
    let message = error.to_string();
    println!("{message}");
    assert!(matches!(error, PrepareError::AmbiguousEncoderMap { .. }) && message.contains("encoders = [..]"));
    // The message contains an option for each possible order.
    for choice in ["--encoders 3,2,1,4,5 for", "--encoders 3,2,1,5,4 for"] {
        assert!(message.contains(choice), "{message}");
    }
    // The data agree with several orders. The recorded order is one of them and is used. The other one is reported.
    let found = find_encoder_map(&pairs(&[[0, 2]]), &[1, 2, 3, 4, 5], &options).unwrap();
    assert!(found.used.is_as_recorded() && found.others.len() == 1, "{found:?}");
}

/// A complete run in which joints 3 and 5 move by less than the base tilt, and the cables of encoders 1 and 2 are exchanged.
pub fn ambiguous(robot: &RobotConfig, bar: &BallBarConfig) -> Simulated {
    let usual = Design::for_robot(robot);
    let mut bar_range_deg = usual.bar_range_deg;
    bar_range_deg[2] = [10.0, 13.6];
    bar_range_deg[4] = [-20.0, -16.4];
    let design = Design { bar_range_deg, ..usual };
    let effects = Effects { base_tilt_urad: 25_000.0, ..Effects::default() };
    let mut run = simulate::run(&Experiment { design, effects, ..Experiment::new(robot, bar) }).unwrap();
    exchange(&mut run, &[1, 0, 2, 3, 4]);
    run
}

#[test]
fn an_ambiguous_encoder_map_of_a_whole_run_is_asked_for_and_what_is_typed_resolves_it() {
    let (robot, bar) = (irb2400(), bar());
    let run = ambiguous(&robot, &bar);
    let message = prepared(&run, EncoderMapChoice::Find).unwrap_err().to_string();
    println!("{message}");
    let choices: Vec<&str> =
        message.split("--encoders ").skip(1).map(|rest| rest.split(' ').next().unwrap()).collect();
    assert!(choices.len() > 1 && choices.contains(&"1,2,3,4,5"), "{choices:?}");
    // The first encoder is on joint 1, but the recording assigns it to joint 2.
    let options = PrepareOptions {
        encoders: "1,2,3,4,5".parse().unwrap(),
        joint_travel_min_deg: 2.0,
        ..PrepareOptions::default()
    };
    let found = prepare(&run.cycles, &run.encoders, &run.robot_log, &robot, &bar, &options).unwrap();
    let wanted: Vec<(u8, bool)> = (1..=5).map(|joint| (joint, false)).collect();
    assert_eq!(joints_and_directions(&found.encoder_map.used), wanted);
    assert!(found.encoder_map.others.is_empty());
    // The preparation has fitted the geometry, so the base tilt no longer affects the angles.
    let spreads = found.offsets.iter().map(|offset| offset.spread_rad * 1e3);
    assert!(spreads.clone().all(|spread| spread < 1.0), "{:?} mrad", spreads.collect::<Vec<_>>());
}

#[test]
fn the_choice_is_typed_as_a_word_or_joint_by_joint() {
    let typed = |text: &str| text.parse::<EncoderMapChoice>();
    assert_eq!(typed("find").unwrap(), EncoderMapChoice::Find);
    assert_eq!(typed("recorded").unwrap(), EncoderMapChoice::Recorded);
    assert_eq!(typed("-1, 2,-3,5").unwrap(), EncoderMapChoice::Stated(vec![-1, 2, -3, 5]));
    for senseless in ["", "1;2", "one", "1,,2", "300"] {
        assert!(typed(senseless).unwrap_err().contains("find, recorded"), "{senseless}");
    }
}

#[test]
fn the_choice_is_read_from_configuration() {
    let read = |text: &str| toml::from_str::<PrepareOptions>(text).map(|options| options.encoders);
    assert_eq!(read("encoders = \"find\"").unwrap(), EncoderMapChoice::Find);
    assert_eq!(read("encoders = \"recorded\"").unwrap(), EncoderMapChoice::Recorded);
    assert_eq!(read("encoders = [5, -2, 3, 4, 1]").unwrap(), EncoderMapChoice::Stated(vec![5, -2, 3, 4, 1]));
    assert!(read("encoders = \"guess\"").is_err());
}
