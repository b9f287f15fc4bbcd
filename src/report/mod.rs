//! Results: statistics and tables, from artefacts alone.
//!
//! [`write()`] reads every run below a results folder and leaves beside them
//!
//! | file | what | one row per |
//! |---|---|---|
//! | `runs.csv` | the numbers of the runs ([`runs`]) | run |
//! | `table.csv`, `table.md`, `table.tex` | statistics over seeds with intervals ([`table`]) | world and eta |
//! | `cross.csv` | greedy CVaR of every policy at every alpha ([`cross`]) | world, eta and alpha |
//!
//! [`write_all`] adds `figures/` ([`figures`]) and `report.html` ([`page`]), and [`write_comparison`] puts
//! several folders side by side.
//!
//! Nothing is simulated and nothing drawn except the bootstrap, whose streams are named: the same
//! artefacts give the same bytes.

pub mod archive;
pub mod cross;
pub mod figures;
pub mod group;
pub mod latex;
pub mod page;
pub mod render;
pub mod runs;
pub mod statistics;
pub mod table;

use crate::files::write_in_place;
use figures::Figures;
use group::groups;
use latex::Latex;
use render::{Csv, Json, Markdown, Render, Terminal};
use runs::Runs;
use std::path::{Path, PathBuf};
use table::{Results, Table};

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

/// Reads the runs below `dir`, writes `runs.csv`, `table.csv`, `table.md`, `table.tex` and `cross.csv`
/// into it and answers with the table as text for a terminal (at most 140 columns wide).
///
/// Each file is replaced in one step: a reader sees the old one or the new one, never a part.
///
/// # Errors
/// If `dir` holds no run, a file in it cannot be read or is not what it should be, or a result cannot
/// be written. Nothing is written unless everything could be read.
pub fn write(dir: &Path) -> Result<String, ReportError> {
    let runs = Runs::read(dir)?;
    write_tables(dir, &Results { name: "", runs: &runs, groups: groups(&runs) })
        .map(|(_, terminal)| terminal)
}

/// What [`write_all`] has written.
#[derive(Debug)]
pub struct Written {
    /// The table as text for a terminal.
    pub table: String,
    /// The figures, and those left out.
    pub figures: Figures,
}

/// All that [`write()`] writes, the figures in `DIR/figures` as SVG and PNG, and `report.html`, a page
/// with all of it and stored episodes that needs no other file.
///
/// # Errors
/// As [`write()`].
pub fn write_all(dir: &Path) -> Result<Written, ReportError> {
    let runs = Runs::read(dir)?;
    let name = names(&[dir]).remove(0);
    let results = Results { name: &name, runs: &runs, groups: groups(&runs) };
    let figures = figures::draw(&results.groups)?;
    let (table, terminal) = write_tables(dir, &results)?;
    let page = page::render(&name, &table, &results.groups, &figures)?;
    persist_figures(dir, &figures)?;
    persist(&dir.join("report.html"), page.as_bytes())?;
    Ok(Written { table: terminal, figures })
}

fn write_tables(dir: &Path, results: &Results) -> Result<(Table, String), ReportError> {
    persist(&dir.join("runs.csv"), results.runs.to_csv().as_bytes())?;
    persist(&dir.join("cross.csv"), cross::to_csv(&results.groups).as_bytes())?;
    let table = Table::new(std::slice::from_ref(results));
    let terminal = write_table(&table, &dir.join("table"))?;
    Ok((table, terminal))
}

/// Puts `dir` and `others` side by side, as `comparison.csv`, `comparison.md` and `comparison.tex` in
/// `dir`, and answers with the table as text for a terminal. Differences are to `dir`.
///
/// # Errors
/// As [`write()`], of any of the folders.
pub fn write_comparison(dir: &Path, others: &[PathBuf]) -> Result<String, ReportError> {
    with_comparison(dir, others, |table| write_table(table, &dir.join("comparison")))
}

/// The table for programs: one object with `schema`, `columns`, `worlds` and `notes`. Writes nothing.
///
/// # Errors
/// As [`write()`].
pub fn table_json(dir: &Path, others: &[PathBuf]) -> Result<serde_json::Value, ReportError> {
    with_comparison(dir, others, |table| Ok(Json.value(table)))
}

/// Draws the figures of the runs below `dir` into `DIR/figures`, each as SVG and PNG.
///
/// # Errors
/// As [`write()`].
pub fn write_figures(dir: &Path) -> Result<Figures, ReportError> {
    let runs = Runs::read(dir)?;
    let figures = figures::draw(&groups(&runs))?;
    persist_figures(dir, &figures)?;
    Ok(figures)
}

fn persist_figures(dir: &Path, figures: &Figures) -> Result<(), ReportError> {
    let folder = dir.join("figures");
    std::fs::create_dir_all(&folder)
        .map_err(|source| ReportError::Write { path: folder.clone(), source })?;
    for figure in &figures.drawn {
        // The name of a world may have a dot.
        let file = |ending| folder.join(format!("{}.{ending}", figure.name));
        persist(&file("svg"), figure.svg.as_bytes())?;
        let path = file("png");
        let png = figures::png(&figure.svg).map_err(|what| ReportError::Write {
            path: path.clone(),
            source: std::io::Error::other(what),
        })?;
        persist(&path, &png)?;
    }
    Ok(())
}

fn with_comparison<T>(
    dir: &Path,
    others: &[PathBuf],
    then: impl FnOnce(&Table) -> Result<T, ReportError>,
) -> Result<T, ReportError> {
    let dirs: Vec<&Path> =
        std::iter::once(dir).chain(others.iter().map(PathBuf::as_path)).collect();
    let runs: Vec<Runs> = dirs.iter().map(|dir| Runs::read(dir)).collect::<Result<_, _>>()?;
    let names = names(&dirs);
    let results: Vec<Results> = (runs.iter().zip(&names))
        .map(|(runs, name)| Results { name, runs, groups: groups(runs) })
        .collect();
    then(&Table::new(&results))
}

/// Folders by their last part, or by the whole path where that is not enough.
fn names(dirs: &[&Path]) -> Vec<String> {
    let last = |dir: &Path| dir.file_name().map(|name| name.to_string_lossy().into_owned());
    let unique =
        |name: &String| dirs.iter().filter(|dir| last(dir).as_ref() == Some(name)).count() == 1;
    dirs.iter()
        .map(|dir| last(dir).filter(unique).unwrap_or_else(|| dir.display().to_string()))
        .collect()
}

fn write_table(table: &Table, stem: &Path) -> Result<String, ReportError> {
    persist(&stem.with_extension("csv"), Csv.render(table).as_bytes())?;
    persist(&stem.with_extension("md"), Markdown.render(table).as_bytes())?;
    persist(&stem.with_extension("tex"), Latex.render(table).as_bytes())?;
    Ok(Terminal.render(table))
}

fn persist(path: &Path, bytes: &[u8]) -> Result<(), ReportError> {
    write_in_place(path, bytes)
        .map_err(|source| ReportError::Write { path: path.to_path_buf(), source })
}
