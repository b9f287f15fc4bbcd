//! Event files that TensorBoard reads, one in each run's folder.
//!
//! A file is a sequence of records: length (u64), its checksum, the event, its checksum; numbers are
//! little endian, checksums CRC-32C masked as `rotate_right(15) + 0xa282ead8`. An event is the protocol
//! buffer `Event { double wall_time = 1; int64 step = 2; string file_version = 3; Summary summary = 5 }`
//! with `Summary { repeated Value value = 1 }`, `Value { string tag = 1; float simple_value = 2 }`.

use super::growing_file::{Extent, GrowingFile};
use std::io::{self, Write};
use std::path::Path;

/// Name of the file in a run's folder; TensorBoard looks for `tfevents` in it.
pub const FILE: &str = "events.out.tfevents.cvar-game";

/// What TensorBoard expects in the first event.
const VERSION: &[u8] = b"brain.Event:2";

/// An event file that grows event by event, so that a run can be watched.
#[derive(Debug)]
pub struct EventFile(GrowingFile);

impl EventFile {
    /// Begins the file of a run's folder; `wall_time` is in seconds since 1970.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn create(folder: &Path, wall_time: f64) -> io::Result<Self> {
        let mut file = EventFile(GrowingFile::create(&folder.join(FILE))?);
        let mut event = Vec::new();
        double(&mut event, 1, wall_time);
        bytes(&mut event, 3, VERSION);
        file.record(&event)?;
        Ok(file)
    }

    /// Continues the file of a run's folder after `extent`, which ends with a whole event.
    ///
    /// # Errors
    /// If the file cannot be written or has changed.
    pub fn resume(folder: &Path, extent: Extent) -> io::Result<Self> {
        GrowingFile::resume(&folder.join(FILE), extent).map(EventFile)
    }

    /// What was written so far, which is on the disk then.
    ///
    /// # Errors
    /// If it cannot be written to the disk.
    pub fn extent(&self) -> io::Result<Extent> {
        self.0.extent()
    }

    /// Adds numbers by tag; those that are not finite are omitted.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn add(&mut self, wall_time: f64, step: u64, scalars: &[(String, f64)]) -> io::Result<()> {
        let mut summary = Vec::new();
        for (tag, value) in scalars.iter().filter(|(_, value)| value.is_finite()) {
            let mut entry = Vec::new();
            bytes(&mut entry, 1, tag.as_bytes());
            float(&mut entry, 2, *value as f32);
            bytes(&mut summary, 1, &entry);
        }
        let mut event = Vec::new();
        double(&mut event, 1, wall_time);
        key(&mut event, 2, 0);
        varint(&mut event, step);
        bytes(&mut event, 5, &summary);
        self.record(&event)
    }

    /// One record in one write: a reader sees only complete records.
    fn record(&mut self, event: &[u8]) -> io::Result<()> {
        let length = (event.len() as u64).to_le_bytes();
        let mut record = Vec::with_capacity(event.len() + 16);
        record.extend(length);
        record.extend(checksum(&length));
        record.extend(event);
        record.extend(checksum(event));
        self.0.write_all(&record)
    }
}

fn checksum(data: &[u8]) -> [u8; 4] {
    crc32c::crc32c(data).rotate_right(15).wrapping_add(0xa282_ead8).to_le_bytes()
}

/// Number and wire type of a field.
fn key(out: &mut Vec<u8>, field: u64, wire: u64) {
    varint(out, field << 3 | wire);
}

fn varint(out: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

fn double(out: &mut Vec<u8>, field: u64, value: f64) {
    key(out, field, 1);
    out.extend(value.to_le_bytes());
}

fn float(out: &mut Vec<u8>, field: u64, value: f32) {
    key(out, field, 5);
    out.extend(value.to_le_bytes());
}

fn bytes(out: &mut Vec<u8>, field: u64, value: &[u8]) {
    key(out, field, 2);
    varint(out, value.len() as u64);
    out.extend(value);
}
