//! Work on a thread of its own, while the caller's thread listens for Ctrl-C and tells of the stages.

use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use greybox_calibrate::Work;
use greybox_commands::{Failure, diagnose, identify};
use greybox_diagnose::evidence::Evidence;
use greybox_diagnose::{Stage, Weighed};
use pyo3::prelude::*;

use crate::error::raised;

/// How often signals are looked for.
const PATIENCE: Duration = Duration::from_millis(50);

/// Stack of the thread that works, bytes: what the main thread of the command has.
pub(crate) const STACK: usize = 8 << 20;

/// What the working thread says.
enum Word<T> {
    Stage(String),
    Done(thread::Result<Result<T, Failure>>),
}

/// Nobody waits for the answer any more: the payload with which the work unwinds.
struct Abandoned;

/// Whether the work is abandoned, and what then ends the fits that it is at.
#[derive(Default)]
struct Fate {
    abandoned: AtomicBool,
    work: Mutex<Option<Arc<Work>>>,
}

impl Fate {
    fn work(&self) -> MutexGuard<'_, Option<Arc<Work>>> {
        self.work.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn abandon(&self) {
        let work = self.work();
        self.abandoned.store(true, Ordering::Relaxed);
        if let Some(work) = &*work {
            work.give_up();
        }
    }

    /// The work has begun: from now on it is what [`Fate::abandon`] gives up.
    fn begins(&self, work: &Arc<Work>) {
        *self.work() = Some(work.clone());
    }
}

/// Tells of stages; ends the work where nobody waits for it any more.
pub(crate) struct Watch {
    tell: Box<dyn Fn(String) + Send + Sync>,
    fate: Arc<Fate>,
}

impl Watch {
    /// A stage begins.
    pub(crate) fn stage(&self, what: impl Into<String>) {
        self.step();
        (self.tell)(what.into());
    }

    /// A step of the work is done. Abandoned work unwinds (past the hook that would report a panic) to where
    /// [`watched`] catches it.
    fn step(&self) {
        if self.fate.abandoned.load(Ordering::Relaxed) {
            resume_unwind(Box::new(Abandoned));
        }
    }

    fn begins(&self, work: &Arc<Work>) {
        self.fate.begins(work);
        self.step();
    }
}

impl greybox_diagnose::ProgressListener for Watch {
    fn begins(&self, work: &Arc<Work>) {
        Watch::begins(self, work);
    }

    fn stage(&self, stage: Stage) {
        Watch::stage(self, diagnose::stage_text(stage));
    }

    fn tried(&self, _kind: &str, _expression: &str, _evidence: &Evidence) {
        self.step();
    }

    fn weighed(&self, _weighed: &Weighed<'_>) {
        self.step();
    }

    fn screened(&self, _ranking: &[(&str, f64)]) {
        self.step();
    }

    fn dropped(&self, _kind: &str) {
        self.step();
    }
}

impl greybox_identify::ProgressListener for Watch {
    fn begins(&self, work: &Arc<Work>) {
        Watch::begins(self, work);
    }

    fn stage(&self, name: &str) {
        Watch::stage(self, identify::stage_text(name));
    }
}

/// Does `work` without the interpreter's lock. Stages are told to `progress` on the caller's thread. An exception of
/// `progress`, or Ctrl-C, is raised at once; the work then ends soon, unheard: a fit with the step that it is at, all
/// the rest where the libraries next speak to their listener.
///
/// # Errors
/// What `work` says, an exception of `progress`, or `KeyboardInterrupt`. A panic is told as a failure of greybox.
pub(crate) fn watched<T: Send + 'static>(
    py: Python<'_>,
    progress: Option<&Bound<'_, PyAny>>,
    work: impl FnOnce(&Watch) -> Result<T, Failure> + Send + 'static,
) -> PyResult<T> {
    let fate = Arc::new(Fate::default());
    let (say, heard) = channel();
    let spoken = start(say, fate.clone(), work);
    raised(py, spoken)?;
    // `Receiver` alone may not be shared with the closure that runs without the lock.
    let heard = Mutex::new(heard);
    let listened = listen(py, progress, &heard);
    if listened.is_err() {
        fate.abandon();
    }
    raised(py, listened?)
}

fn start<T: Send + 'static>(
    say: Sender<Word<T>>,
    fate: Arc<Fate>,
    work: impl FnOnce(&Watch) -> Result<T, Failure> + Send + 'static,
) -> Result<(), Failure> {
    let tell = say.clone();
    // With nobody left to hear, there is nothing to say.
    let tell = move |what| drop(tell.send(Word::Stage(what)));
    let watch = Watch { tell: Box::new(tell), fate };
    let run = move || {
        let outcome = catch_unwind(AssertUnwindSafe(|| work(&watch)));
        drop(say.send(Word::Done(outcome)));
    };
    match thread::Builder::new().name("greybox".into()).stack_size(STACK).spawn(run) {
        Ok(_) => Ok(()),
        Err(e) => Err(Failure::internal(format!("no thread could be started: {e}"))),
    }
}

/// Waits for the end of the work.
fn listen<T: Send>(
    py: Python<'_>,
    progress: Option<&Bound<'_, PyAny>>,
    heard: &Mutex<Receiver<Word<T>>>,
) -> PyResult<Result<T, Failure>> {
    loop {
        let word = py.detach(|| heard.lock().unwrap_or_else(PoisonError::into_inner).recv_timeout(PATIENCE));
        match word {
            Ok(Word::Stage(what)) => {
                if let Some(progress) = progress {
                    progress.call1((what,))?;
                }
            }
            Ok(Word::Done(Ok(outcome))) => return Ok(outcome),
            Ok(Word::Done(Err(_))) | Err(RecvTimeoutError::Disconnected) => {
                return Ok(Err(Failure::fault()));
            }
            Err(RecvTimeoutError::Timeout) => {}
        }
        py.check_signals()?;
    }
}
