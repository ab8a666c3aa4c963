//! Progress of a long solve on a terminal, and Ctrl-C that ends it.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::Duration;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::solver::{Progress, Watch};

/// Ctrl-C was pressed.
static INTERRUPTED: AtomicBool = AtomicBool::new(false);
/// Set when the handler of Ctrl-C has been installed.
static HANDLER: OnceLock<()> = OnceLock::new();
/// The running command polls [`INTERRUPTED`] and keeps its partial result: the first Ctrl-C does not end the program.
static POLLED: AtomicBool = AtomicBool::new(false);
/// The visible bar, so that Ctrl-C leaves a clean line.
static SHOWN: Mutex<Option<ProgressBar>> = Mutex::new(None);

/// Exit code of a program that Ctrl-C ended, as shells have it.
const EXIT_INTERRUPTED: i32 = 130;
/// A solve that is shorter than this shows no progress.
const PATIENCE: Duration = Duration::from_millis(500);

/// Ends the running command, as Ctrl-C does, or lets the next one run.
pub fn interrupt(ends: bool) {
    INTERRUPTED.store(ends, Ordering::Relaxed);
}

/// A progress bar on the terminal, where there is one. Ctrl-C ends the program immediately with exit code 130, or, where the command
/// keeps what it has so far, asks it to end; a second Ctrl-C then ends the program.
#[derive(Debug)]
pub struct OnTerminal {
    bar: ProgressBar,
    /// Part of the work that runs.
    stage: Mutex<String>,
}

impl OnTerminal {
    /// For a command that polls for Ctrl-C and keeps what it has.
    pub fn new() -> Self {
        Self::with_polling(true)
    }

    /// For a command that writes nothing before it has everything: Ctrl-C ends it from anywhere.
    pub fn all_or_nothing() -> Self {
        Self::with_polling(false)
    }

    fn with_polling(polled: bool) -> Self {
        HANDLER.get_or_init(|| {
            // Without a handler Ctrl-C ends the program, which writes no file either. A program that has one keeps it.
            let _ = ctrlc::try_set_handler(|| {
                if INTERRUPTED.swap(true, Ordering::Relaxed) || !POLLED.load(Ordering::Relaxed) {
                    if let Some(bar) = &*SHOWN.lock().unwrap_or_else(PoisonError::into_inner) {
                        bar.finish_and_clear();
                    }
                    std::process::exit(EXIT_INTERRUPTED);
                }
            });
        });
        POLLED.store(polled, Ordering::Relaxed);
        let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::hidden());
        let style = ProgressStyle::with_template("{spinner} {msg} {wide_bar} {pos}/{len} samples, {elapsed}");
        let bar = style.map_or_else(|_| bar.clone(), |style| bar.clone().with_style(style));
        *SHOWN.lock().unwrap_or_else(PoisonError::into_inner) = Some(bar.clone());
        let shown = bar.clone();
        // Without a thread nothing is shown.
        let _ = std::thread::Builder::new().spawn(move || {
            std::thread::sleep(PATIENCE);
            if !shown.is_finished() {
                shown.set_draw_target(ProgressDrawTarget::stderr());
                // Also shown while no pass over samples reports.
                shown.enable_steady_tick(PATIENCE);
            }
        });
        Self { bar, stage: Mutex::default() }
    }

    /// Shows a sentence about work that has no known end; false once Ctrl-C was pressed.
    pub fn says(&self, sentence: impl FnOnce() -> String) -> bool {
        self.set_template("{msg}");
        self.bar.set_message(sentence());
        !INTERRUPTED.load(Ordering::Relaxed)
    }

    /// Shows how much of some work is done; false once Ctrl-C was pressed.
    pub fn counts(&self, done: usize, of: usize, what: &str) -> bool {
        self.set_template(&format!("{{wide_bar}} {{pos}}/{{len}} {what}, {{eta}} left"));
        self.bar.set_length(of as u64);
        self.bar.set_position(done as u64);
        !INTERRUPTED.load(Ordering::Relaxed)
    }

    fn set_template(&self, template: &str) {
        if let Ok(style) = ProgressStyle::with_template(template) {
            self.bar.set_style(style);
        }
    }
}

/// Takes the bar off the terminal, also before the message of an error.
impl Drop for OnTerminal {
    fn drop(&mut self) {
        POLLED.store(false, Ordering::Relaxed);
        self.bar.finish_and_clear();
    }
}

impl Watch for OnTerminal {
    fn begins(&self, stage: &str) {
        stage.clone_into(&mut self.stage.lock().unwrap_or_else(PoisonError::into_inner));
        self.bar.set_message(stage.to_owned());
        self.bar.set_position(0);
    }

    fn goes_on(&self, progress: &Progress) -> bool {
        self.bar.set_length(progress.samples as u64);
        self.bar.set_position(progress.samples_done as u64);
        let stage = self.stage.lock().unwrap_or_else(PoisonError::into_inner);
        self.bar.set_message(progress.cost.map_or_else(
            || format!("{stage}: first pass"),
            |cost| format!("{stage}: iteration {}, cost {cost:.3e}", progress.iteration + 1),
        ));
        !INTERRUPTED.load(Ordering::Relaxed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// As a command that returns early with an error.
    #[test]
    fn the_bar_is_off_the_terminal_however_its_command_ends() {
        let bar = {
            let on_terminal = OnTerminal::new();
            on_terminal.bar.clone()
        };
        assert!(bar.is_finished() && !POLLED.load(Ordering::Relaxed));
    }
}
