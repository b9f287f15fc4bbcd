//! Files that grow while a run trains, with their length and checksum, so that a run that was cut
//! short continues each of them exactly from the state of its checkpoint.

use crate::files::{create, open_file};
use serde::{Deserialize, Serialize};
use std::fs::{File, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::Path;

/// The beginning of a file: its length and its CRC-32.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Extent {
    /// Bytes.
    pub bytes: u64,
    /// CRC-32 of these bytes.
    pub crc: u32,
}

/// A file that grows.
#[derive(Debug)]
pub struct GrowingFile {
    file: File,
    bytes: u64,
    crc: crc32fast::Hasher,
}

impl GrowingFile {
    /// Begins a new file.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn create(path: &Path) -> io::Result<Self> {
        Ok(GrowingFile { file: create(path)?, bytes: 0, crc: crc32fast::Hasher::new() })
    }

    /// Continues a file after `extent`; what follows is removed.
    ///
    /// # Errors
    /// If it cannot be read or written, or does not begin with that extent.
    pub fn resume(path: &Path, extent: Extent) -> io::Result<Self> {
        let mut file = open_file(path, OpenOptions::new().read(true).write(true))?;
        let mut head = Vec::new();
        (&mut file).take(extent.bytes).read_to_end(&mut head)?;
        let mut crc = crc32fast::Hasher::new();
        crc.update(&head);
        let found = Extent { bytes: head.len() as u64, crc: crc.clone().finalize() };
        if found != extent {
            return Err(io::Error::new(io::ErrorKind::InvalidData, "its content has changed"));
        }
        file.set_len(extent.bytes)?;
        file.seek(SeekFrom::End(0))?;
        Ok(GrowingFile { file, bytes: extent.bytes, crc })
    }

    /// What was written so far, which is on the disk then.
    ///
    /// # Errors
    /// If it cannot be written to the disk.
    pub fn extent(&self) -> io::Result<Extent> {
        self.file.sync_data()?;
        Ok(Extent { bytes: self.bytes, crc: self.crc.clone().finalize() })
    }
}

impl Write for GrowingFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let count = self.file.write(bytes)?;
        self.bytes += count as u64;
        self.crc.update(&bytes[..count]);
        Ok(count)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}
