//! The lock of a run's folder: one process at a time works on a run.

use crate::files::open_file;
use std::fs::{File, OpenOptions, TryLockError};
use std::io;
use std::path::Path;

/// Held by the process that carries out a run. The system releases it when that process ends, however
/// it ends, so no lock outlasts its process; the empty file `.lock` stays.
#[derive(Debug)]
pub struct RunLock {
    _file: File,
}

impl RunLock {
    /// Takes the lock of a run's folder; `None` while another process has it.
    ///
    /// # Errors
    /// If the folder cannot be written or its file system has no locks.
    pub fn take(folder: &Path) -> io::Result<Option<RunLock>> {
        let path = folder.join(".lock");
        let options = &mut OpenOptions::new();
        let file = open_file(&path, options.create(true).truncate(false).write(true)).map_err(
            |error| io::Error::new(error.kind(), format!(".lock cannot be opened: {error}")),
        )?;
        match file.try_lock() {
            Ok(()) => Ok(Some(RunLock { _file: file })),
            Err(TryLockError::WouldBlock) => Ok(None),
            Err(TryLockError::Error(error)) => Err(error),
        }
    }
}
