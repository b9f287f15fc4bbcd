//! Stopping on request without losing work.
//!
//! A signal makes a run write a checkpoint after its current update and end. While there is
//! nothing to write, as in the evaluation, which starts again from the trained players, the process
//! ends at once. Either way it exits with [`RESUME`] after SIGTERM, which schedulers send before a time
//! limit, and with 130 after SIGINT. A second SIGINT ends the process at once; a second SIGTERM does
//! not, because schedulers repeat it.

use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

/// Exit code that means "unfinished and intact: start the same command again" (EX_TEMPFAIL).
pub const RESUME: u8 = 75;

/// The exit code of a program that a signal stopped.
pub fn exit_code(signal: i32) -> u8 {
    if signal == SIGTERM { RESUME } else { 128 + signal as u8 }
}

/// A request to stop. Clones share it.
#[derive(Debug, Clone, Default)]
pub struct Stop {
    signal: Arc<AtomicUsize>,
    at_once: Arc<AtomicBool>,
}

impl Stop {
    /// Listens to SIGINT and SIGTERM.
    ///
    /// # Errors
    /// If the system refuses the handler.
    pub fn on_signals() -> io::Result<Stop> {
        Self::listening().map_err(|error| {
            io::Error::new(error.kind(), format!("cannot listen to signals: {error}"))
        })
    }

    fn listening() -> io::Result<Stop> {
        let stop = Stop::default();
        for signal in [SIGINT, SIGTERM] {
            let code = i32::from(exit_code(signal));
            flag::register_conditional_shutdown(signal, code, Arc::clone(&stop.at_once))?;
            flag::register_usize(signal, Arc::clone(&stop.signal), signal as usize)?;
        }
        let again = Arc::new(AtomicBool::new(false));
        flag::register_conditional_shutdown(SIGINT, 128 + SIGINT, Arc::clone(&again))?;
        flag::register(SIGINT, again)?;
        Ok(stop)
    }

    /// Asks to stop, as the signal of this number would.
    pub fn request(&self, signal: i32) {
        self.signal.store(signal as usize, Ordering::SeqCst);
        if self.at_once.load(Ordering::SeqCst) {
            std::process::exit(i32::from(exit_code(signal)));
        }
    }

    /// The number of the signal that requested the stop.
    pub fn signal(&self) -> Option<i32> {
        Some(self.signal.load(Ordering::SeqCst) as i32).filter(|&signal| signal != 0)
    }

    /// Does work during which a request ends the process at once; `None` if there was one before.
    pub fn interruptible<R>(&self, work: impl FnOnce() -> R) -> Option<R> {
        self.at_once.store(true, Ordering::SeqCst);
        let result = self.signal().is_none().then(work);
        self.at_once.store(false, Ordering::SeqCst);
        result
    }
}
