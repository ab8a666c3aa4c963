//! Shows the progress of a long command on a terminal, and ends the command at Ctrl-C.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::Duration;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::solver::{Progress, Watch};

/// True after Ctrl-C was pressed or [`interrupt`] was called.
static INTERRUPTED: AtomicBool = AtomicBool::new(false);
/// Set when the handler of Ctrl-C has been installed.
static HANDLER: OnceLock<()> = OnceLock::new();
/// Whether the running command polls [`INTERRUPTED`] to keep its partial result. If so, the first Ctrl-C does
/// not end the program.
static POLLED: AtomicBool = AtomicBool::new(false);
/// Progress bar of the running command. The handler of Ctrl-C removes it from the terminal.
static SHOWN: Mutex<Option<ProgressBar>> = Mutex::new(None);

/// Exit code of a program that Ctrl-C ended, by the convention of shells.
const EXIT_INTERRUPTED: i32 = 130;
/// No progress is shown for work that takes less time than this.
const PATIENCE: Duration = Duration::from_millis(500);

/// Ends the running command in the same way as the first Ctrl-C. Later commands also end, until [`allow_commands`] is called.
pub fn interrupt() {
    INTERRUPTED.store(true, Ordering::Relaxed);
}

/// Lets commands run again after [`interrupt`].
pub fn allow_commands() {
    INTERRUPTED.store(false, Ordering::Relaxed);
}

/// A progress bar, which is visible only on a terminal. Ctrl-C ends the program immediately with exit code 130. If the
/// command keeps its partial result, the first Ctrl-C only asks the command to end, and the second Ctrl-C ends the program.
#[derive(Debug)]
pub struct OnTerminal {
    bar: ProgressBar,
    /// Name of the current stage of the work.
    stage: Mutex<String>,
}

impl OnTerminal {
    /// Progress bar of a command that polls for Ctrl-C and keeps its partial result.
    pub fn new() -> Self {
        Self::with_polling(true)
    }

    /// Progress bar of a command without partial results. Ctrl-C ends the program at any point.
    pub fn all_or_nothing() -> Self {
        Self::with_polling(false)
    }

    fn with_polling(polled: bool) -> Self {
        HANDLER.get_or_init(|| {
            // A handler that the program installed before is kept. If none can be installed, Ctrl-C ends the program.
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
        // If the thread cannot be started, the bar remains hidden.
        let _ = std::thread::Builder::new().spawn(move || {
            std::thread::sleep(PATIENCE);
            if !shown.is_finished() {
                shown.set_draw_target(ProgressDrawTarget::stderr());
                // The bar is also redrawn between reports of progress.
                shown.enable_steady_tick(PATIENCE);
            }
        });
        Self { bar, stage: Mutex::default() }
    }

    /// Shows a sentence about work of unknown length. Returns false after Ctrl-C was pressed.
    pub fn show_sentence(&self, sentence: impl FnOnce() -> String) -> bool {
        self.set_template("{msg}");
        self.bar.set_message(sentence());
        !INTERRUPTED.load(Ordering::Relaxed)
    }

    /// Shows that `done` of `all` items are done. Returns false after Ctrl-C was pressed.
    pub fn show_count(&self, done: usize, all: usize, items: &str) -> bool {
        self.set_template(&format!("{{wide_bar}} {{pos}}/{{len}} {items}, {{eta}} left"));
        self.bar.set_length(all as u64);
        self.bar.set_position(done as u64);
        !INTERRUPTED.load(Ordering::Relaxed)
    }

    fn set_template(&self, template: &str) {
        if let Ok(style) = ProgressStyle::with_template(template) {
            self.bar.set_style(style);
        }
    }
}

/// Removes the bar from the terminal, also before the message of an error.
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

    /// A command that returns early with an error drops its bar.
    #[test]
    fn a_dropped_bar_is_removed_from_the_terminal() {
        let bar = {
            let on_terminal = OnTerminal::new();
            on_terminal.bar.clone()
        };
        assert!(bar.is_finished() && !POLLED.load(Ordering::Relaxed));
    }
}
