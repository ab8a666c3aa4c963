//! Compares the stated position error of a calibrated robot with its true error. The comparison covers the full model and
//! the parameters that a controller applies. `CAMPAIGNS=full` evaluates more runs of each kind.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "figures of a run")]

use identify::calibrate::validation::deployment::Deployment;
use identify::calibrate::{IdentifyConfig, calibrate_run};
use identify::evaluate::{Expected, evidence, random_postures};
use identify::instrument::standing;
use identify::model::Model;
use identify::simulate::{Design, Simulated, true_model};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use shared::config::{BallBarConfig, RobotConfig};
use statrs::distribution::{Binomial, DiscreteCDF};

use crate::support::campaign::size;
use crate::support::laboratory::{self, Level};
use crate::support::{bar, irb2400, nj220};

/// Stated mean position error over the workspace with its interval, and the true one \[m\].
struct Claim {
    claimed: Expected,
    true_m: f64,
}

impl Claim {
    fn holds(&self) -> bool {
        let [low_m, high_m] = self.claimed.interval_m;
        (low_m..=high_m).contains(&self.true_m)
    }
}

/// Stated and true errors of the nominal robot, of the calibrated robot, and of each deployment.
fn claims(run: &Simulated, robot: &RobotConfig, bar: &BallBarConfig) -> Vec<(&'static str, Claim)> {
    let found =
        calibrate_run(&run.cycles, &run.encoders, &run.robot_log, robot, bar, &IdentifyConfig::default())
            .unwrap();
    let limits = &robot.joint_limits();
    let seen = evidence(&found, limits).with_validation(&found, None).unwrap();
    let truth = true_model(found.model(), &run.truth.parameters);
    let postures = standing(random_postures(limits));
    let claim = |model: &Model, claimed: Expected| {
        let [true_robot, robot] = [&truth, model].map(|model| model.geometry(&model.start()));
        let apart_m = postures.iter().map(|state| {
            (true_robot.robot_end(state).translation.vector - robot.robot_end(state).translation.vector)
                .norm()
        });
        Claim { claimed, true_m: apart_m.sum::<f64>() / postures.len() as f64 }
    };
    let mut nominal = found.model().clone();
    nominal.reset_to_nominal(|_| true);
    let mut all = vec![
        ("nominal", claim(&nominal, seen.workspace.before)),
        ("full", claim(found.model(), seen.workspace.after)),
    ];
    for (deployed, _) in &seen.deployed {
        let name = if deployed.deployment == Deployment::Dh { "links" } else { "offsets" };
        all.push((name, claim(&deployed.model, seen.workspace.deployed[&deployed.deployment])));
    }
    all
}

/// The shipped bar, but its plate length differs from the true one by a random error, as large as its stated uncertainty.
fn measured(seed: u64) -> BallBarConfig {
    let off: f64 = ChaCha8Rng::seed_from_u64(41_000 + seed).sample(StandardNormal);
    BallBarConfig { plate_m: bar().plate_m + 1e-6 * bar().plate_u_um * off, ..bar() }
}

/// Calibrates this number of runs of each kind with each robot. Prints each stated error
/// with its interval, and the true error.
fn of_runs(seeds: u64) -> Vec<(&'static str, Claim)> {
    let mut all = Vec::new();
    for robot in [irb2400(), nj220()] {
        for (kind, level) in [("usual", Level::USUAL), ("hard", Level::HARD)] {
            for seed in 1..=seeds {
                let run = laboratory::run(&robot, &bar(), seed, &level, Design::for_robot(&robot));
                for (name, claim) in claims(&run, &robot, &measured(seed)) {
                    let Claim { claimed: Expected { mean_m, interval_m: [low_m, high_m], .. }, true_m } =
                        claim;
                    println!(
                        "{} {kind} {seed} {name}: claimed {:.4} ({:.4} to {:.4}), true {:.4} mm{}",
                        robot.name,
                        mean_m * 1e3,
                        low_m * 1e3,
                        high_m * 1e3,
                        true_m * 1e3,
                        if claim.holds() { "" } else { ", OUTSIDE" }
                    );
                    all.push((name, claim));
                }
            }
        }
    }
    all
}

fn hold(all: &[(&'static str, Claim)]) {
    for name in ["nominal", "full", "links", "offsets"] {
        let of: Vec<&Claim> = all.iter().filter(|(of, _)| *of == name).map(|(_, claim)| claim).collect();
        let holding = of.iter().filter(|claim| claim.holds()).count() as u64;
        let mut times: Vec<f64> = of.iter().map(|claim| claim.claimed.mean_m / claim.true_m).collect();
        times.sort_by(f64::total_cmp);
        let median = times[times.len() / 2];
        println!("{name}: {holding} of {} hold, claimed over true {median:.2} (median)", of.len());
        // A correct interval contains the true value with a probability of 95 %. Once in a hundred cases, fewer than
        // `least` intervals contain it by chance.
        let least = Binomial::new(0.95, of.len() as u64).unwrap().inverse_cdf(0.01);
        assert!(holding >= least, "{name}: {holding} of {}", of.len());
        assert!((0.8..2.5).contains(&median), "{name}: {median}");
    }
}

#[test]
#[ignore = "calibrations and their deployments: half a minute"]
fn claims_of_the_full_model_of_links_and_of_offsets_contain_the_truth() {
    hold(&of_runs(size(2, 10)));
}
