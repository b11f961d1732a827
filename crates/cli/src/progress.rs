//! A progress bar for those who wait.

use std::io::IsTerminal;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::Duration;

use greybox_commands::{diagnose, identify};
use greybox_diagnose::{ProgressListener, Stage, Weighed};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::log::{self, Log};

/// How long a command may be silent.
const PATIENCE: Duration = Duration::from_secs(2);

/// A bar on standard error that appears after two seconds, and only where standard error is a terminal;
/// it is gone when dropped. With `--log` there are lines in its place.
#[derive(Debug)]
pub(crate) struct Progress {
    bar: ProgressBar,
    log: Option<Log>,
    /// Wakes the thread that waits to show the bar; `None` once dropped.
    waiting: Option<(Sender<()>, JoinHandle<()>)>,
}

impl Progress {
    /// A bar over `steps` steps.
    pub(crate) fn steps(steps: u64) -> Progress {
        Progress::show("{spinner} [{elapsed}] {bar:24} {msg}", Some(steps))
    }

    /// As many steps as come, for work of unknown length.
    pub(crate) fn open() -> Progress {
        Progress::show("{spinner} [{elapsed}] {msg}", None)
    }

    fn show(template: &str, steps: Option<u64>) -> Progress {
        let bar = ProgressBar::with_draw_target(steps, ProgressDrawTarget::hidden());
        if let Ok(style) = ProgressStyle::with_template(template) {
            bar.set_style(style);
        }
        let log = log::is_wanted().then(Log::new);
        if log.is_some() || !std::io::stderr().is_terminal() {
            return Progress { bar, log, waiting: None };
        }
        let (stop, stopped) = channel();
        let shown = bar.clone();
        let thread = std::thread::spawn(move || {
            if stopped.recv_timeout(PATIENCE) == Err(RecvTimeoutError::Timeout) {
                shown.set_draw_target(ProgressDrawTarget::stderr());
                shown.enable_steady_tick(Duration::from_millis(120));
            }
        });
        Progress { bar, log, waiting: Some((stop, thread)) }
    }

    /// Says what is being done now.
    pub(crate) fn stage(&self, what: impl Into<String>) {
        let what = what.into();
        if let Some(log) = &self.log {
            log.stage(&what);
        }
        self.bar.set_message(what);
    }

    /// One step is done.
    pub(crate) fn advance(&self) {
        self.bar.inc(1);
    }
}

impl ProgressListener for Progress {
    fn stage(&self, stage: Stage) {
        Progress::stage(self, diagnose::stage_text(stage));
    }

    fn weighed(&self, weighed: &Weighed<'_>) {
        if let Some(log) = &self.log {
            log.fact(&diagnose::told_weighed(weighed));
        }
    }
}

impl greybox_identify::ProgressListener for Progress {
    fn stage(&self, name: &str) {
        Progress::stage(self, identify::stage_text(name));
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if let Some((stop, thread)) = self.waiting.take() {
            drop(stop);
            // The thread only waits and draws; there is nothing to learn from how it ended.
            let _ = thread.join();
        }
        self.bar.finish_and_clear();
    }
}
