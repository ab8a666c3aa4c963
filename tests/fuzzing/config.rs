//! Fuzz target: reads every type of configuration file from arbitrary text.

use std::path::Path;

use ballbard::smoke::SmokeConfig;
use identify::calibrate::IdentifyConfig;
use identify::instrument::{FaceTable, SocketTable};
use identify::logs::{
    BarLogMapping, ContactMapping, ForceLogMapping, JointConversion, MeasuredLengthMapping,
    MeasuredPoseMapping, RobotLogMapping, TouchMapping,
};
use shared::config::{BallBarConfig, DaemonConfig, RobotConfig, Validate, parse};

use super::explained;

const FILES: [(u8, &str); 16] = [
    (b'd', "daemon.toml"),
    (b'k', "smoke.toml"),
    (b'b', "ball_bar.toml"),
    (b'i', "identify.toml"),
    (b'l', "measured_length.toml"),
    (b'm', "robot_log.toml"),
    (b'p', "measured_pose.toml"),
    (b'e', "bar_log.toml"),
    (b'f', "force_log.toml"),
    (b'c', "contact.toml"),
    (b's', "sockets.toml"),
    (b't', "touch.toml"),
    (b'a', "faces.toml"),
    (b'r', "robots/irb2400_16.toml"),
    (b'r', "robots/nj220_2_7.toml"),
    (b'r', "robots/irb120_3.toml"),
];

/// Reads a configuration. The first byte selects the type of file, and the other bytes are the text. If the text is
/// accepted, the configuration must be usable. If it is refused, the error must contain a reason.
pub fn any_text(bytes: &[u8]) {
    let Some((kind, text)) = bytes.split_first() else { return };
    let Ok(text) = std::str::from_utf8(text) else { return };
    match kind {
        b'd' => {
            if let Some(config) = accepted::<DaemonConfig>(text) {
                assert!(!config.cycle_period().is_zero() && config.reply_timeout() < config.cycle_period());
            }
        }
        b'k' => {
            if let Some(config) = accepted::<SmokeConfig>(text) {
                assert!(config.cycles.iter().all(|cycles| cycles.cycles() > 0));
            }
        }
        b'b' => {
            if let Some(config) = accepted::<BallBarConfig>(text) {
                let counts = config.encoders.iter().map(|encoder| encoder.scale().counts_per_revolution());
                assert!(counts.into_iter().all(|counts| counts > 0));
            }
        }
        b'i' => drop(accepted::<IdentifyConfig>(text)),
        b'l' => drop(accepted::<MeasuredLengthMapping>(text)),
        b'm' => drop(accepted::<RobotLogMapping>(text)),
        b'p' => drop(accepted::<MeasuredPoseMapping>(text)),
        b'e' => drop(accepted::<BarLogMapping>(text)),
        b'f' => drop(accepted::<ForceLogMapping>(text)),
        b'c' => drop(accepted::<ContactMapping>(text)),
        b't' => drop(accepted::<TouchMapping>(text)),
        b'a' => drop(accepted::<FaceTable>(text)),
        b's' => {
            if let Some(table) = accepted::<SocketTable>(text) {
                assert!(!table.names().is_empty());
            }
        }
        _ => {
            if let Some(robot) = accepted::<RobotConfig>(text) {
                let zero = JointConversion::new(&robot.log).map(|conversion| conversion.to_joint(&[0.0; 6]));
                if let Err(error) = zero {
                    explained(&error);
                }
            }
        }
    }
}

fn accepted<T: serde::de::DeserializeOwned + Validate>(text: &str) -> Option<T> {
    parse(text, Path::new("fuzzed.toml")).inspect_err(|error| explained(error)).ok()
}

/// Seeds: the shipped configuration files, each after the byte that selects its type.
pub fn shipped() -> Vec<Vec<u8>> {
    let file = |(kind, name): (u8, &str)| {
        let text = std::fs::read(crate::config_directory().join(name)).expect("a shipped file");
        [&[kind], &text[..]].concat()
    };
    FILES.map(file).to_vec()
}
