//! Simulates a recording and a robot log, prepares them and solves. The result must be the true parameters.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::f64::consts::TAU;

use crate::support::{bar, irb2400, nj220};
use identify::cost::{LoopProblem, Residual, Transform};
use identify::kinematics::{LinkParameter, ball_bar_chain, robot_chain};
use identify::model::{Model, ParameterId, Role, Selection};
use identify::prepare::{PrepareOptions, Prepared, prepare};
use identify::simulate::{self, Experiment, Simulated, StaticErrors};
use identify::solver::{Options, Solution, solve};
use shared::config::{BallBarConfig, RobotConfig};

/// A model with the 38 parameters of the thesis and the two parameters of the clock. It starts at
/// the values of the preparation.
fn model(prepared: &Prepared, robot: &RobotConfig, bar: &BallBarConfig) -> Model {
    let mut bar_chain = ball_bar_chain(bar);
    bar_chain.root_from_base.translation.vector = prepared.base_m;
    let mut model = Model::ball_bar(&robot_chain(robot, bar), &bar_chain);
    model.select(Selection::Thesis, Transform::depends_on);
    model.set_roles([ParameterId::ClockShift, ParameterId::ClockSkew], Role::Free).unwrap();
    model.set_value(ParameterId::ClockSkew, prepared.alignment.skew).unwrap();
    for offset in &prepared.offsets {
        let link = usize::from(offset.joint) - 1;
        model
            .set_value(ParameterId::Bar { link, parameter: LinkParameter::Theta }, offset.offset_rad)
            .unwrap();
    }
    model
}

/// True value of a free parameter \[SI\].
fn truth(run: &Simulated, prepared: &Prepared, id: ParameterId) -> f64 {
    let clock = &run.truth.clock;
    let name = id.to_string();
    match id {
        ParameterId::ClockSkew => clock.skew,
        ParameterId::ClockShift => {
            let passed_ns = prepared.t_ref.ns_since(clock.bar_start);
            let base_ns =
                clock.robot_at_bar_start_ns - clock.bar_start.0 - prepared.alignment.clock_difference_ns;
            base_ns as f64 * 1e-9 + passed_ns as f64 * 1e-9 * clock.skew
        }
        ParameterId::Bar { link, parameter: LinkParameter::Theta } => {
            run.truth.parameters[&name]
                + run.truth.encoders.iter().find(|e| usize::from(e.joint) == link + 1).unwrap().offset_rad
        }
        _ => run.truth.parameters[&name],
    }
}

/// Error of each free parameter \[mm, mrad, ms, 0.1 %\]. All of these units have equal weight.
fn errors(
    run: &Simulated,
    prepared: &Prepared,
    model: &Model,
    solution: &Solution,
) -> Vec<(ParameterId, f64)> {
    model
        .columns()
        .zip(&solution.x)
        .map(|(parameter, x)| {
            let error = x - truth(run, prepared, parameter.id);
            let turn = matches!(parameter.id, ParameterId::Bar { parameter: LinkParameter::Theta, .. });
            (parameter.id, 1e3 * if turn { error - (error / TAU).round() * TAU } else { error })
        })
        .collect()
}

#[test]
fn static_errors_and_clocks_come_back_for_both_robots() {
    for robot in [irb2400(), nj220()] {
        for errors_drawn in [StaticErrors::Thesis, StaticErrors::Drawn { seed: 3 }] {
            let bar = bar();
            let run =
                simulate::run(&Experiment { errors: errors_drawn, ..Experiment::new(&robot, &bar) }).unwrap();
            let options = PrepareOptions::default();
            let prepared =
                prepare(&run.cycles, &run.encoders, &run.robot_log, &robot, &bar, &options).unwrap();
            let model = model(&prepared, &robot, &bar);
            let problem =
                LoopProblem::new(&model, &prepared.motion, &prepared.observations, Transform, 1.0).unwrap();
            let solution =
                solve(&problem, &model.start(), &Options::default()).unwrap().identified().unwrap();
            let errors = errors(&run, &prepared, &model, &solution);
            let norm = |clock: bool| {
                let is_clock =
                    |id: &ParameterId| matches!(id, ParameterId::ClockShift | ParameterId::ClockSkew);
                errors.iter().filter(|(id, _)| is_clock(id) == clock).map(|(_, e)| e * e).sum::<f64>().sqrt()
            };
            let (geometry, clocks) = (norm(false), norm(true));
            println!(
                "{} {errors_drawn:?}: {geometry:.5} mm|mrad, clock {:.2e} ms, {} samples, {} iterations, weakest {:.1e}",
                robot.name,
                clocks,
                solution.summary.samples_used,
                solution.summary.iterations,
                solution.identifiability.weakest()
            );
            assert_eq!(errors.len(), 40);
            assert!(geometry < 0.02, "{geometry} mm|mrad: {errors:.4?}");
            assert!(clocks < 0.001, "{clocks}");
            assert_eq!(solution.summary.samples_left_out, 0);
        }
    }
}
