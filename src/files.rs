//! Reading and writing of whole files: none is left half written, none from elsewhere is read without
//! a limit, and nothing waits for a pipe in the place of a file.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Write};
use std::path::Path;

/// How the names of files begin that are being written.
const PART: &str = ".part-";

/// Writes a file in one piece: a reader sees all of it or none.
///
/// # Errors
/// If the folder or the disk refuses.
pub fn write_in_place(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = tempfile::Builder::new();
    file.prefix(PART);
    #[cfg(unix)] // temporary files are private by default, artefacts are not
    file.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let mut file = file.tempfile_in(path.parent().unwrap_or(Path::new(".")))?;
    file.write_all(bytes)?;
    // Otherwise the name may reach the disk before the bytes do, and a power cut leaves an empty file.
    file.as_file().sync_all()?;
    file.persist(path)?;
    Ok(())
}

/// Removes what [`write_in_place`] leaves of a file when its process is killed.
///
/// # Errors
/// If the folder cannot be read or written.
pub fn remove_parts(folder: &Path) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        if entry.file_name().as_encoded_bytes().starts_with(PART.as_bytes()) {
            fs::remove_file(entry.path())?;
        }
    }
    Ok(())
}

/// Opens a regular file, or makes one where `options` say so. A pipe or a device in its place is refused:
/// opening or reading it could wait forever.
///
/// # Errors
/// If it is something else than a file, or cannot be opened.
pub fn open_file(path: &Path, options: &mut OpenOptions) -> io::Result<File> {
    if fs::metadata(path).is_ok_and(|found| !found.is_file() && !found.is_dir()) {
        let problem = "it is a pipe or a device; put a regular file in its place";
        return Err(io::Error::new(io::ErrorKind::InvalidInput, problem));
    }
    #[cfg(unix)] // it may become a pipe before it is opened
    std::os::unix::fs::OpenOptionsExt::custom_flags(options, libc::O_NONBLOCK);
    options.open(path)
}

/// Opens a regular file for reading, as [`open_file`].
///
/// # Errors
/// As [`open_file`].
pub fn open(path: &Path) -> io::Result<File> {
    open_file(path, OpenOptions::new().read(true))
}

/// Makes a regular file, or empties the one that is there, as [`open_file`].
///
/// # Errors
/// As [`open_file`].
pub fn create(path: &Path) -> io::Result<File> {
    open_file(path, OpenOptions::new().write(true).create(true).truncate(true))
}

/// More bytes than any configuration, evaluation or file of weights has.
pub const LARGEST_FILE: u64 = 64 << 20;

/// The bytes of a file that may come from elsewhere.
///
/// # Errors
/// If it cannot be read or is longer than `limit`.
pub fn read_at_most(path: &Path, limit: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open(path)?.take(limit + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > limit {
        let problem = format!("it is larger than {limit} bytes");
        return Err(io::Error::new(io::ErrorKind::FileTooLarge, problem));
    }
    Ok(bytes)
}

/// The text of a file that may come from elsewhere.
///
/// # Errors
/// If it cannot be read, is no text or is longer than [`LARGEST_FILE`].
pub fn read_text(path: &Path) -> io::Result<String> {
    String::from_utf8(read_at_most(path, LARGEST_FILE)?)
        .map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error))
}
