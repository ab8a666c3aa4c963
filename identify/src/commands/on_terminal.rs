//! Progress of a long solve on a terminal, and Ctrl-C that ends it.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};

use crate::solver::{Progress, Watch};

/// Somebody pressed Ctrl-C.
static INTERRUPTED: AtomicBool = AtomicBool::new(false);
static HANDLER: OnceLock<()> = OnceLock::new();
/// Something looks whether it was pressed.
static WATCHED: AtomicBool = AtomicBool::new(false);

/// Exit code of a program that Ctrl-C ended, as shells have it.
const EXIT_INTERRUPTED: i32 = 130;
/// A solve that is over before this shows nothing.
const PATIENCE: Duration = Duration::from_millis(500);

/// Ends the command that runs, as Ctrl-C does, or lets the next one go on.
pub fn interrupt(ends: bool) {
    INTERRUPTED.store(ends, Ordering::Relaxed);
}

/// A bar on the terminal, where there is one, that Ctrl-C ends. A second Ctrl-C ends the program at once, and so does the first where
/// the bar is gone.
#[derive(Debug)]
pub struct OnTerminal {
    bar: ProgressBar,
    began: std::time::Instant,
}

impl OnTerminal {
    pub fn new() -> Self {
        HANDLER.get_or_init(|| {
            // Without a handler Ctrl-C ends the program, which writes no file either. A program that has one keeps it.
            let _ = ctrlc::try_set_handler(|| {
                if INTERRUPTED.swap(true, Ordering::Relaxed) || !WATCHED.load(Ordering::Relaxed) {
                    std::process::exit(EXIT_INTERRUPTED);
                }
            });
        });
        WATCHED.store(true, Ordering::Relaxed);
        let bar = ProgressBar::no_length();
        let style = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} samples");
        Self {
            bar: style.map_or_else(|_| bar.clone(), |style| bar.clone().with_style(style)),
            began: std::time::Instant::now(),
        }
    }

    /// Shows a sentence about work that has no known end; false once Ctrl-C was pressed.
    pub fn says(&self, sentence: impl FnOnce() -> String) -> bool {
        if self.began.elapsed() > PATIENCE {
            if let Ok(style) = ProgressStyle::with_template("{msg}") {
                self.bar.set_style(style);
            }
            self.bar.set_message(sentence());
        }
        !INTERRUPTED.load(Ordering::Relaxed)
    }

    /// Shows how much of some work is done; false once Ctrl-C was pressed.
    pub fn counts(&self, done: usize, of: usize, what: &str) -> bool {
        if self.began.elapsed() > PATIENCE {
            let template = format!("{{wide_bar}} {{pos}}/{{len}} {what}, {{eta}} left");
            if let Ok(style) = ProgressStyle::with_template(&template) {
                self.bar.set_style(style);
            }
            self.bar.set_length(of as u64);
            self.bar.set_position(done as u64);
        }
        !INTERRUPTED.load(Ordering::Relaxed)
    }

    /// Takes the bar off the terminal.
    pub fn finish(&self) {
        WATCHED.store(false, Ordering::Relaxed);
        self.bar.finish_and_clear();
    }
}

impl Watch for OnTerminal {
    fn goes_on(&self, progress: &Progress) -> bool {
        if self.began.elapsed() > PATIENCE {
            self.bar.set_length(progress.samples as u64);
            self.bar.set_position(progress.samples_done as u64);
            self.bar.set_message(progress.cost.map_or_else(
                || "first pass".to_owned(),
                |cost| format!("iteration {}, cost {cost:.3e}", progress.iteration + 1),
            ));
        }
        !INTERRUPTED.load(Ordering::Relaxed)
    }
}
