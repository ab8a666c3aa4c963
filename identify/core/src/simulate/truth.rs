//! The true parameters of simulated experiments: the nominal parameters plus static errors. They are written to
//! `truth.toml`. The module `comparison` compares them with the result of a calibration.

use std::collections::BTreeMap;

use rand::Rng;
use rand_distr::StandardNormal;
use serde::{Deserialize, Serialize};
use shared::time::UtcNs;

use super::{BarLoad, Design, Effects, Experiment, RandomStream, random};
use crate::kinematics::{Chain, LinkParameter, Pose};
use crate::model::thesis_fixed;

/// Static errors of the simulations in the thesis (TFRT-6017 table 3.1) \[mm|mrad\]. The first row of this table is
/// illegible, so the values of `ra1`, `ralpha1`, `btheta1` and `ox` are chosen here.
pub const THESIS_ERRORS: [(&str, f64); 28] = [
    ("ra1", 0.47),
    ("ralpha1", -0.64),
    ("btheta1", 0.53),
    ("ox", 1.05),
    ("ra2", 0.14),
    ("rd2", 0.27),
    ("ralpha2", 0.78),
    ("rtheta2", -0.09),
    ("btheta2", 1.27),
    ("oy", 0.80),
    ("ra3", -1.52),
    ("ralpha3", -1.36),
    ("rtheta3", 0.19),
    ("bd3", 0.24),
    ("btheta3", -1.90),
    ("oz", -0.70),
    ("ra4", -1.88),
    ("rd4", -0.16),
    ("ralpha4", 0.35),
    ("rtheta4", -0.12),
    ("btheta4", -0.19),
    ("ra5", 0.80),
    ("rd5", 1.80),
    ("ralpha5", 0.08),
    ("rtheta5", 0.72),
    ("btheta5", 0.98),
    ("rd6", -1.47),
    ("rtheta6", -0.22),
];

/// Errors of the true parameters, relative to the nominal parameters.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StaticErrors {
    /// True and nominal parameters are equal.
    None,
    /// Table 3.1 of the thesis.
    #[default]
    Thesis,
    /// Normally distributed errors with a standard deviation of 1 mm or 1 mrad, on each parameter that the thesis estimates.
    /// With six axes there are 38 such parameters.
    Drawn {
        /// Seed of the random numbers.
        seed: u64,
    },
}

impl StaticErrors {
    /// Errors of the parameters by name \[m|rad\]. Parameters that are not listed have no error.
    fn by_name(self, axes: usize) -> BTreeMap<String, f64> {
        match self {
            Self::None => BTreeMap::new(),
            Self::Thesis => {
                THESIS_ERRORS.iter().map(|&(name, error)| (name.to_owned(), error * 1e-3)).collect()
            }
            Self::Drawn { seed } => {
                let mut random = random(seed, RandomStream::StaticErrors);
                let fixed = thesis_fixed(axes).map(|id| id.to_string());
                // The tilt of the base (`orx` and `ory`) is excluded, because it is an effect (`Effects`).
                parameter_names(axes)
                    .into_iter()
                    .filter(|name| !fixed.contains(name) && !name.starts_with("or"))
                    .map(|name| (name, 1e-3 * random.sample::<f64, _>(StandardNormal)))
                    .collect()
            }
        }
    }
}

/// Names of all geometric parameters: links of a robot with `axes` axes, links of the bar, and position and tilt
/// of the bar's base.
pub fn parameter_names(axes: usize) -> Vec<String> {
    let links = |chain: char, count: usize| {
        LinkParameter::STANDARD
            .map(LinkParameter::name)
            .into_iter()
            .flat_map(move |name| (1..=count).map(move |link| format!("{chain}{name}{link}")))
    };
    let base = ["ox", "oy", "oz", "orx", "ory"].map(str::to_owned);
    links('r', axes).chain(links('b', 5)).chain(base).collect()
}

/// True parameters of the two clocks.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ClockTruth {
    /// Time of the first bar sample \[UTC ns\].
    pub bar_start: UtcNs,
    /// Reading of the robot's clock at the first bar sample \[ns\].
    pub robot_at_bar_start_ns: i64,
    /// Robot clock minus bar clock at the first bar sample \[s\], rounded to the precision of an `f64`.
    pub shift_s: f64,
    /// Rate of the robot's clock relative to the bar's clock, minus one.
    pub skew: f64,
}

impl ClockTruth {
    /// Reading of the robot's clock \[ns\] at the time `bar`. It is computed in integers, because an `f64` of about today's
    /// UTC in nanoseconds has a resolution of only 256 ns.
    pub fn robot_ns(&self, bar: UtcNs) -> i64 {
        let passed_ns = bar.ns_since(self.bar_start);
        let gained_ns = (passed_ns as f64 * self.skew).round() as i64;
        self.robot_at_bar_start_ns.saturating_add(passed_ns).saturating_add(gained_ns)
    }
}

/// The true offset of an encoder: `joint = sign * rad_per_count * counts + offset_rad`. `counts` are unwrapped, starting at
/// the first count of the recording.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct EncoderTruth {
    /// Bar joint, 1 to 5.
    pub joint: u8,
    /// Count at joint angle zero.
    pub zero_counts: i64,
    /// Joint angle at count zero, in (-pi, pi] \[rad\]. Only the sum of this offset and `btheta` of the
    /// joint can be identified.
    pub offset_rad: f64,
}

/// All true values of a simulated experiment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Truth {
    /// The robot's name.
    pub robot: String,
    /// The bar's name.
    pub ball_bar: String,
    /// Seed of path, encoder offsets and noise.
    pub seed: u64,
    /// Clocks of bar and robot.
    pub clock: ClockTruth,
    /// Choice of the static errors.
    pub errors: StaticErrors,
    /// Effects other than errors of the geometry.
    pub effects: Effects,
    /// Force on the bar.
    #[serde(default)]
    pub load: BarLoad,
    /// Position of the bar and limits of the motion.
    pub design: Design,
    /// Nominal parameters by name \[m|rad\]. `ox`, `oy` and `oz` are the design's position of the bar.
    pub nominal: BTreeMap<String, f64>,
    /// True parameters by name \[m|rad\].
    pub parameters: BTreeMap<String, f64>,
    /// Encoders in bus order.
    pub encoders: Vec<EncoderTruth>,
}

impl Truth {
    /// Computes the true parameters of an experiment. `robot` and `bar` are the nominal chains.
    pub(super) fn new(experiment: &Experiment<'_>, robot: &Chain, bar: &Chain) -> Self {
        let mut errors = experiment.errors.by_name(robot.links.len());
        let mut nominal = nominal(robot, bar);
        for (name, error) in &experiment.added_errors {
            *errors.entry(name.clone()).or_default() += error * 1e-3;
            nominal.entry(name.clone()).or_default();
        }
        let [orx, ory] = experiment.effects.base_tilt_rad();
        let mut parameters: BTreeMap<String, f64> = nominal
            .iter()
            .map(|(name, value)| {
                let tilt = match name.as_str() {
                    "orx" => orx,
                    "ory" => ory,
                    _ => 0.0,
                };
                (name.clone(), value + tilt + errors.get(name).copied().unwrap_or(0.0))
            })
            .collect();
        let BarLoad { force_n, compliance_um_per_n, play_um, .. } = experiment.load;
        if force_n > 0.0 {
            parameters.insert("bcompliance".into(), compliance_um_per_n * 1e-6);
            parameters.insert("bplay".into(), play_um * 1e-6);
        }
        let clocks = experiment.clocks;
        let shift_ns = i128::from(clocks.robot_at_bar_start_ns) - i128::from(clocks.bar_start.0);
        Self {
            robot: experiment.robot.name.clone(),
            ball_bar: experiment.bar.name.clone(),
            seed: experiment.seed,
            clock: ClockTruth {
                bar_start: clocks.bar_start,
                robot_at_bar_start_ns: clocks.robot_at_bar_start_ns,
                shift_s: shift_ns as f64 * 1e-9,
                skew: clocks.skew,
            },
            errors: experiment.errors,
            effects: experiment.effects,
            load: experiment.load,
            design: experiment.design.clone(),
            nominal,
            parameters,
            encoders: Vec::new(),
        }
    }

    /// True minus nominal value \[m|rad\]; zero for an unknown name.
    pub fn error(&self, name: &str) -> f64 {
        let value = |map: &BTreeMap<String, f64>| map.get(name).copied().unwrap_or(0.0);
        value(&self.parameters) - value(&self.nominal)
    }

    /// The chain of the true robot, computed from the nominal chain.
    pub fn robot_chain(&self, nominal: &Chain) -> Chain {
        self.with_errors(nominal, 'r')
    }

    /// The chain of the true bar on its true base, computed from the nominal chain. The base of `nominal` is ignored.
    pub fn bar_chain(&self, nominal: &Chain) -> Chain {
        let value = |name: &str| self.parameters.get(name).copied().unwrap_or(0.0);
        let position = nalgebra::Translation3::new(value("ox"), value("oy"), value("oz"));
        let about_x = nalgebra::Rotation3::from_axis_angle(&nalgebra::Vector3::x_axis(), value("orx"));
        let about_y = nalgebra::Rotation3::from_axis_angle(&nalgebra::Vector3::y_axis(), value("ory"));
        let root_from_base = Pose::from_parts(position, about_x * about_y);
        Chain { root_from_base, ..self.with_errors(nominal, 'b') }
    }

    /// The nominal chain plus the errors of its parameters. `chain` is the first letter of the parameters' names: `r` for
    /// the robot, `b` for the bar.
    fn with_errors(&self, nominal: &Chain, chain: char) -> Chain {
        let mut moved = nominal.clone();
        for (index, link) in moved.links.iter_mut().enumerate() {
            for parameter in LinkParameter::ALL {
                let name = format!("{chain}{}{}", parameter.name(), index + 1);
                *link.number_mut(parameter) += self.error(&name);
            }
        }
        moved
    }
}

/// Nominal parameters \[m|rad\] by the names of [`parameter_names`].
fn nominal(robot: &Chain, bar: &Chain) -> BTreeMap<String, f64> {
    let links = [('r', robot), ('b', bar)].into_iter().flat_map(|(letter, chain)| {
        chain.links.iter().enumerate().flat_map(move |(index, link)| {
            [("a", link.a_m), ("d", link.d_m), ("alpha", link.alpha_rad), ("theta", link.theta_rad)]
                .map(|(kind, value)| (format!("{letter}{kind}{}", index + 1), value))
        })
    });
    let base = bar.root_from_base.translation.vector;
    let base = [("ox", base.x), ("oy", base.y), ("oz", base.z), ("orx", 0.0), ("ory", 0.0)]
        .map(|(name, value)| (name.to_owned(), value));
    links.chain(base).collect()
}
