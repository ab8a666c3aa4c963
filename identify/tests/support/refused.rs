//! Runs that the command must refuse, and the page that it writes.

use std::path::PathBuf;
use std::process::Command;

use identify::simulate::{self, Simulated};
use shared::config::{BallBarConfig, RobotConfig};
use tempfile::TempDir;

/// Output of the command after a refusal.
pub struct Refused {
    /// Directory of the option `--out`.
    pub out: TempDir,
    pub stderr: String,
    /// Text of the page that the command wrote.
    pub page: String,
}

/// The files of one run, with the arguments that name them. The arguments `--robot` and `--bar` are the given
/// configurations, even if the run was simulated with others.
pub struct Typed {
    pub inputs: TempDir,
    pub arguments: Vec<PathBuf>,
}

impl Typed {
    pub fn new(run: &Simulated, robot: &RobotConfig, bar: &BallBarConfig) -> Self {
        let inputs = tempfile::tempdir().unwrap();
        let files = simulate::write(inputs.path(), run, robot, bar).unwrap();
        let [robot_path, bar_path] = ["robot.toml", "bar.toml"].map(|name| inputs.path().join(name));
        std::fs::write(&robot_path, toml::to_string(robot).unwrap()).unwrap();
        std::fs::write(&bar_path, toml::to_string(bar).unwrap()).unwrap();
        let pairs = [
            ("--recording", files.recording),
            ("--robot-log", files.robot_log),
            ("--robot", robot_path),
            ("--bar", bar_path),
        ];
        let arguments = pairs.into_iter().flat_map(|(option, path)| [option.into(), path]).collect();
        Self { inputs, arguments }
    }

    pub fn calibrate(&self, extra: &[&str], out: &std::path::Path) -> std::process::Output {
        Command::new(env!("CARGO_BIN_EXE_identify"))
            .arg("calibrate")
            .args(&self.arguments)
            .args(extra)
            .arg("--out")
            .arg(out)
            .env("RUST_LOG", "off")
            .output()
            .unwrap()
    }

    /// Calibrates and checks that this is refused. The output must contain the texts `why` and the path of the page, and no
    /// other file may be written.
    pub fn refused(&self, why: &[&str], extra: &[&str]) -> Refused {
        let out = tempfile::tempdir().unwrap();
        let output = self.calibrate(extra, out.path());
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(1), "{stderr}");
        let path = out.path().join("report.html");
        assert!(stderr.contains(&format!("not calibrated: {} shows", path.display())), "{stderr}");
        let left: Vec<_> = std::fs::read_dir(out.path()).unwrap().map(|one| one.unwrap().path()).collect();
        assert_eq!(left, std::slice::from_ref(&path));
        let page = std::fs::read_to_string(&path).unwrap();
        for why in why {
            assert!(stderr.contains(why), "`{why}` is missing in: {stderr}");
            // The first word may begin a sentence on the page, with a capital letter.
            let escaped = maud_escaped(why);
            let without_first = escaped.get(1..).unwrap();
            assert!(page.contains(without_first), "`{why}` is missing on the page");
        }
        states_the_verdict(&page);
        Refused { out, stderr, page }
    }
}

fn maud_escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// Checks the contents that all pages of refusals have: verdict, cause and remedy, both logs with their joints, and
/// the checksums of the inputs.
pub fn states_the_verdict(page: &str) {
    assert!(page.contains("<strong>Not calibrated. </strong>") && !page.contains("<strong>Calibrated"));
    for heading in [
        "What is wrong",
        "What to do",
        "Recording of the bar",
        "Robot's log",
        "SHA-256",
        "[identify.prepare]",
    ] {
        assert!(page.contains(heading), "`{heading}` is missing");
    }
    assert!(page.len() < 1_000_000, "{} bytes", page.len());
}
