//! Checkpoints: what a run that was cut short continues from.
//!
//! A run's folder keeps the last two as `checkpoint-<update>.bin`, written in one piece. A file is
//!
//! | bytes | what |
//! |---|---|
//! | 0..8 | `CVARGAME` |
//! | 8..12 | [`SCHEMA`], little-endian as all numbers |
//! | 12..16 | CRC-32 of the payload |
//! | 16.. | the payload: a [`Checkpoint`] as postcard |
//!
//! A file that is damaged or belongs to another run is skipped for the one before it. The sizes
//! of all parts are checked against the run, so a foreign file is refused and does no harm.

use super::artefacts::SCHEMA;
use super::progress_file::ProgressExtent;
use crate::files::{read_at_most, write_in_place};
use serde::{Deserialize, Serialize};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

const MAGIC: &[u8; 8] = b"CVARGAME";
const HEADER: usize = 16;
/// Larger files are refused unread: the largest configuration needs far less.
const LARGEST: u64 = 1 << 30;
/// Checkpoints that are kept: if the last one is damaged there is one before it.
const KEPT: usize = 2;

/// Everything that a run continues from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Checkpoint {
    /// [`super::artefacts::BUILD`] of its program: another one might end with other bits.
    pub program: String,
    /// [`super::config::RunConfig::training_text`] of the run.
    pub config: String,
    /// Seconds of training so far.
    pub seconds: f64,
    /// How much of `progress.csv` and of the event file belongs to it.
    pub progress: ProgressExtent,
    /// State of training, in the method's own format.
    pub training: Vec<u8>,
}

/// Why a run cannot continue from a file.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// It cannot be read.
    #[error("cannot be read ({0})")]
    Read(#[from] io::Error),
    /// It is not a checkpoint, or was cut short.
    #[error("is not a checkpoint")]
    Foreign,
    /// It has another schema version.
    #[error("has schema version {0}, this program reads {SCHEMA}")]
    Schema(u32),
    /// Its bytes have changed.
    #[error("is damaged")]
    Damaged,
    /// It belongs to something else.
    #[error("does not fit: {0}")]
    Unfit(String),
}

/// A checkpoint as the bytes of its file.
///
/// # Errors
/// If its state cannot be represented.
pub fn to_bytes(checkpoint: &Checkpoint) -> io::Result<Vec<u8>> {
    let mut bytes = vec![0; HEADER];
    bytes = postcard::to_extend(checkpoint, bytes).map_err(io::Error::other)?;
    let crc = crc32fast::hash(&bytes[HEADER..]);
    bytes[..8].copy_from_slice(MAGIC);
    bytes[8..12].copy_from_slice(&SCHEMA.to_le_bytes());
    bytes[12..16].copy_from_slice(&crc.to_le_bytes());
    Ok(bytes)
}

/// The checkpoint in the bytes of a file.
///
/// # Errors
/// If they are not a checkpoint.
pub fn from_bytes(bytes: &[u8]) -> Result<Checkpoint, CheckpointError> {
    let (header, payload) = bytes.split_at_checked(HEADER).ok_or(CheckpointError::Foreign)?;
    let number = |at: usize| {
        header[at..].first_chunk().map_or(0, |bytes: &[u8; 4]| u32::from_le_bytes(*bytes))
    };
    if !header.starts_with(MAGIC) {
        return Err(CheckpointError::Foreign);
    }
    if number(8) != SCHEMA {
        return Err(CheckpointError::Schema(number(8)));
    }
    if number(12) != crc32fast::hash(payload) {
        return Err(CheckpointError::Damaged);
    }
    match postcard::take_from_bytes(payload) {
        Ok((checkpoint, [])) => Ok(checkpoint),
        _ => Err(CheckpointError::Damaged),
    }
}

/// Writes the checkpoint after `update` and removes those that are no longer needed.
///
/// # Errors
/// If the folder cannot be written.
pub fn save(folder: &Path, update: u64, checkpoint: &Checkpoint) -> io::Result<()> {
    write_in_place(&folder.join(format!("checkpoint-{update}.bin")), &to_bytes(checkpoint)?)?;
    list(folder)?.iter().skip(KEPT).try_for_each(fs::remove_file)
}

/// The checkpoint in a file.
///
/// # Errors
/// If the file cannot be read or is not a checkpoint.
pub fn load(path: &Path) -> Result<Checkpoint, CheckpointError> {
    from_bytes(&read_at_most(path, LARGEST)?)
}

/// The checkpoints of a folder, the last one first.
///
/// # Errors
/// If the folder cannot be read.
pub fn list(folder: &Path) -> io::Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name();
        let number = name.to_str().and_then(|name| {
            name.strip_prefix("checkpoint-")?.strip_suffix(".bin")?.parse::<u64>().ok()
        });
        found.extend(number.map(|number| (number, entry.path())));
    }
    found.sort();
    Ok(found.into_iter().rev().map(|(_, path)| path).collect())
}

/// Removes the checkpoints of a folder.
///
/// # Errors
/// If the folder cannot be read or written.
pub fn remove(folder: &Path) -> io::Result<()> {
    list(folder)?.iter().try_for_each(fs::remove_file)
}
