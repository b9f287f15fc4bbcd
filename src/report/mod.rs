//! Results: statistics and tables, from artefacts alone.
//!
//! [`write()`] reads every run below a results folder and leaves beside them
//!
//! | file | what | one row per |
//! |---|---|---|
//! | `runs.csv` | the numbers of the runs ([`runs`]) | run |
//! | `table.csv`, `table.md` | statistics over seeds with intervals ([`table`]) | world and eta |
//! | `cross.csv` | greedy CVaR of every policy at every alpha ([`cross`]) | world, eta and alpha |
//!
//! Nothing is simulated and nothing drawn except the bootstrap, whose streams are named: the same
//! artefacts give the same bytes.

pub mod cross;
pub mod group;
pub mod render;
pub mod runs;
pub mod statistics;
pub mod table;

use render::{Csv, Json, Markdown, Render, Terminal};
use runs::Runs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use table::Table;

/// Why no report could be made. Every message names the file and says what to do.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// The folder holds no run.
    #[error(
        "no runs in {}: expected folders ENV/eta-E/seed-N with an evaluation.json; \
         give the folder that `bench` or `train` wrote to{}",
        .dir.display(), .notes.iter().map(|note| format!(" ({note})")).collect::<String>()
    )]
    NoRuns {
        /// The folder that was searched.
        dir: PathBuf,
        /// What was found instead.
        notes: Vec<String>,
    },
    /// A file or folder could not be read.
    #[error("cannot read {}: {source}; check the path and its permissions", .path.display())]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A file does not hold what its name promises.
    #[error(
        "{} is damaged or not ours: {what}; restore the file, or move its run folder away and run it again",
        .path.display()
    )]
    Corrupt {
        /// The file.
        path: PathBuf,
        /// What is wrong in it.
        what: String,
    },
    /// A file of another version of the formats.
    #[error(
        "{} has schema {found}, this program reads schema {expected}; use the version of the program \
         that wrote it (see manifest.json) or run the benchmark again into another folder",
        .path.display()
    )]
    Schema {
        /// The file.
        path: PathBuf,
        /// Its version.
        found: u64,
        /// The version that is read here.
        expected: u32,
    },
    /// A result could not be written.
    #[error("cannot write {}: {source}; check permissions and space on the disk", .path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
}

/// Reads the runs below `dir`, writes `runs.csv`, `table.csv`, `table.md` and `cross.csv` into it and
/// answers with the table as text for a terminal (at most 140 columns wide).
///
/// Each file is replaced in one step: a reader sees the old one or the new one, never a part.
///
/// # Errors
/// If `dir` holds no run, a file in it cannot be read or is not what it should be, or a result cannot
/// be written. Nothing is written unless everything could be read.
pub fn write(dir: &Path) -> Result<String, ReportError> {
    let runs = Runs::read(dir)?;
    let groups = group::groups(&runs);
    let table = Table::new(&runs, &groups);
    persist(&dir.join("runs.csv"), &runs.to_csv())?;
    persist(&dir.join("table.csv"), &Csv.render(&table))?;
    persist(&dir.join("table.md"), &Markdown.render(&table))?;
    persist(&dir.join("cross.csv"), &cross::to_csv(&groups))?;
    Ok(Terminal.render(&table))
}

/// The table for programs: one object with `schema`, `columns`, `worlds` and `notes`. Writes nothing.
///
/// # Errors
/// As [`write()`].
pub fn table_json(dir: &Path) -> Result<serde_json::Value, ReportError> {
    let runs = Runs::read(dir)?;
    let groups = group::groups(&runs);
    Ok(Json.value(&Table::new(&runs, &groups)))
}

fn persist(path: &Path, text: &str) -> Result<(), ReportError> {
    let attempt = || {
        let mut builder = tempfile::Builder::new();
        builder.prefix(".report-");
        // A temporary file is private by default; results are for everybody the umask admits.
        #[cfg(unix)]
        builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
        let mut file = builder.tempfile_in(path.parent().unwrap_or(Path::new(".")))?;
        file.write_all(text.as_bytes())?;
        file.persist(path).map_err(|failed| failed.error)
    };
    attempt().map(|_| ()).map_err(|source| ReportError::Write { path: path.to_path_buf(), source })
}
