//! Results: statistics, tables, figures and the page, only from the records of runs.
//!
//! [`write()`] reads every run below a results folder and leaves beside them
//!
//! | file | what | one row per |
//! |---|---|---|
//! | `runs.csv` | the numbers of the runs ([`runs`]) | run |
//! | `table.csv`, `table.md`, `table.tex` | statistics over seeds with intervals ([`table`]) | method, world and eta |
//! | `cross.csv` | greedy CVaR of every policy at every alpha ([`cross`]) | method, world, eta and alpha |
//!
//! [`write_all`] adds `figures/` ([`figures`]) and `report.html` ([`page`]), and [`write_comparison`] puts
//! several folders side by side. Methods and variants in one folder are compared in the same way.
//! [`shifts::Shifted`] judges the policies where the world is another than in training.
//!
//! Nothing is simulated here ([`shifts`] has its caller play, and a few episodes of the optimum are its yardstick's) and nothing is random: the same artefacts give the same bytes. What a world looks like, and its exact optima, are asked from
//! [`Worlds`].

pub mod cross;
pub mod figures;
pub mod group;
pub mod latex;
pub mod page;
pub mod records;
pub mod render;
pub mod runs;
pub mod settings;
pub mod shifts;
pub mod statistics;
pub mod table;

pub use render::screen_width;

use crate::exact::walk::Walk;
use crate::experiment::config::{RunConfig, scenes};
use crate::experiment::failure::RunError;
use crate::experiment::registry::{Limits, Registry};
use crate::files::write_in_place;
use crate::game::returns::ReturnLaw;
use figures::Figures;
use group::Group;
use latex::Latex;
use lava_envs::scene::Scene;
use render::{Csv, Json, Markdown, Render, Terminal};
use runs::Runs;
use std::path::{Path, PathBuf};
use table::{Results, Table};

/// Most episodes of the best policy that a page shows.
const WALKS: u64 = 6;

/// What the report asks about worlds, which it knows only by their names, and about configurations.
pub trait Worlds {
    /// The place where episodes of the world with these constants happen; `None` if it is not known or
    /// refuses the constants.
    fn scene(&self, world: &str, constants: &toml::Table) -> Option<Scene>;

    /// The laws of the return of the policies that are optimal at these budgets, without those that
    /// cannot be computed; `None` if the world has no exact yardstick.
    fn frontier(
        &self,
        world: &str,
        constants: &toml::Table,
        gamma: f64,
        etas: &[f64],
    ) -> Option<Vec<ReturnLaw>>;

    /// The best policy that is known at a budget.
    fn optimum(&self, world: &str, constants: &toml::Table, gamma: f64, eta: f64) -> Optimum;

    /// The first episodes of that policy in an evaluation with this seed, as far as they are at hand.
    fn walks(
        &self,
        world: &str,
        constants: &toml::Table,
        gamma: f64,
        eta: f64,
        seed: u64,
    ) -> Vec<Walk>;

    /// What an episode can be; `None` if the world is not known or does not say.
    fn limits(&self, world: &str, constants: &toml::Table, gamma: f64) -> Option<Limits>;

    /// All constants of the world: the given ones over its defaults; `None` if the world is not known or
    /// refuses them.
    fn constants(&self, world: &str, given: &toml::Table) -> Option<toml::Table>;

    /// The default discount.
    fn gamma(&self) -> f64;

    /// The `config.toml` of a run with all keys of this version; `None` if it is of another version or
    /// another program.
    fn configuration(&self, text: &str) -> Option<toml::Table>;
}

/// What is known of the optimum of a task.
#[derive(Debug, Clone, PartialEq)]
pub enum Optimum {
    /// The law of the return of the best policy that is known.
    Known(ReturnLaw),
    /// The program comes without a certificate of these constants and this budget.
    NotShipped,
    /// It cannot be computed, for this reason.
    Refused(String),
    /// The world has no yardstick, or is not known.
    None,
}

impl Worlds for Registry {
    fn scene(&self, world: &str, constants: &toml::Table) -> Option<Scene> {
        self.named(world)?.scene(constants)
    }

    fn frontier(
        &self,
        world: &str,
        constants: &toml::Table,
        gamma: f64,
        etas: &[f64],
    ) -> Option<Vec<ReturnLaw>> {
        self.named(world)?.frontier(constants, gamma, etas)
    }

    fn optimum(&self, world: &str, constants: &toml::Table, gamma: f64, eta: f64) -> Optimum {
        let Some(world) = self.named(world) else { return Optimum::None };
        match world.optimum(constants, gamma, eta) {
            Ok(Some(law)) => Optimum::Known(law),
            Ok(None) => Optimum::NotShipped,
            Err(RunError::NoYardstick(_)) => Optimum::None,
            Err(error) => Optimum::Refused(error.to_string()),
        }
    }

    fn walks(
        &self,
        world: &str,
        constants: &toml::Table,
        gamma: f64,
        eta: f64,
        seed: u64,
    ) -> Vec<Walk> {
        let walks = self.named(world).map(|of| of.walks(constants, gamma, eta, seed, WALKS));
        walks.and_then(Result::ok).unwrap_or_default()
    }

    fn limits(&self, world: &str, constants: &toml::Table, gamma: f64) -> Option<Limits> {
        self.named(world)?.limits(constants, gamma)
    }

    fn constants(&self, world: &str, given: &toml::Table) -> Option<toml::Table> {
        let (name, world) = (world.parse().ok()?, self.named(world)?.info());
        let mut table = scenes::defaults(&world, &name)?;
        table.extend(given.clone());
        (world.check)(table).ok()
    }

    fn gamma(&self) -> f64 {
        let defaults = toml::from_str::<toml::Table>(self.catalogue().annotated_default());
        let gamma = defaults.ok().and_then(|table| table["gamma"].as_float());
        gamma.expect("the default configuration has a discount")
    }

    fn configuration(&self, text: &str) -> Option<toml::Table> {
        let run = RunConfig::parse(Path::new("config.toml"), text, self.catalogue()).ok()?;
        toml::Table::try_from(run).ok()
    }
}

/// Why no report could be made. Every message names the file and says what to do.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// The folder holds no run.
    #[error(
        "no runs in {}: expected folders WORLD/METHOD/eta-E/seed-N with an evaluation.json, or a runs.zip; \
         give the folder that `bench` or `train` wrote to{}",
        .dir.display(), .notes.iter().map(|note| format!(" ({note})")).collect::<String>()
    )]
    NoRuns {
        /// The folder that was searched.
        dir: PathBuf,
        /// What was found instead.
        notes: Vec<String>,
    },
    /// No policy of the folder could be judged in another world.
    #[error("no policy of {} could be judged there: {what}", .dir.display())]
    NotJudged {
        /// The folder.
        dir: PathBuf,
        /// Why, for one of them.
        what: String,
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

/// Reads the runs below `dir` and writes `runs.csv`, `table.csv`, `table.md`, `table.tex` and `cross.csv`
/// into it. Returns the table as text of so many columns for a terminal (see [`screen_width`]).
///
/// Each file is replaced in one step: a reader sees the old one or the new one, never a part.
///
/// # Errors
/// If `dir` holds no run or none of its runs can be read, or a result cannot be written.
pub fn write(dir: &Path, worlds: &dyn Worlds, width: usize) -> Result<String, ReportError> {
    let runs = Runs::read(dir, worlds)?;
    let name = names(&[dir]).remove(0);
    let results = Results::of(&[(&name, &runs)]);
    Ok(Terminal { width, file: "table.md" }.render(&write_tables(dir, &runs, &results)?))
}

/// What [`write_all`] has written.
#[derive(Debug)]
pub struct Written {
    /// The table.
    pub table: Table,
    /// The figures, and those left out.
    pub figures: Figures,
}

impl Written {
    /// The table as text of so many columns for a terminal.
    pub fn terminal(&self, width: usize) -> String {
        Terminal { width, file: "table.md" }.render(&self.table)
    }
}

/// All that [`write()`] writes, the figures in `DIR/figures` as SVG and PNG, and `report.html`, a page
/// with all of it and stored episodes that needs no other file.
///
/// # Errors
/// As [`write()`].
pub fn write_all(dir: &Path, worlds: &dyn Worlds) -> Result<Written, ReportError> {
    let runs = Runs::read(dir, worlds)?;
    let name = names(&[dir]).remove(0);
    let results = Results::of(&[(&name, &runs)]);
    let (panels, notes) = figures::panels(&results, worlds);
    let mut figures = figures::draw(&panels, notes, worlds);
    figures.left_out.clone_from(&runs.notes);
    let table = write_tables(dir, &runs, &results)?;
    let page = page::render(&name, &table, &panels, &figures, worlds);
    persist_figures(dir, &figures)?;
    persist(&dir.join("report.html"), page.as_bytes())?;
    Ok(Written { table, figures })
}

fn write_tables(dir: &Path, runs: &Runs, results: &[Results]) -> Result<Table, ReportError> {
    persist(&dir.join("runs.csv"), runs.to_csv().as_bytes())?;
    let groups: Vec<&Group> = results.iter().flat_map(|results| &results.groups).collect();
    persist(&dir.join("cross.csv"), cross::to_csv(&groups).as_bytes())?;
    let table = Table::new(results);
    write_table(&table, &dir.join("table"))?;
    Ok(table)
}

/// Puts `dir` and `others` side by side, as `comparison.csv`, `comparison.md` and `comparison.tex` in
/// `dir`. Returns the table as text of so many columns for a terminal. Differences are to `dir`, and if it has several methods
/// to its first one.
///
/// # Errors
/// As [`write()`], of any of the folders.
pub fn write_comparison(
    dir: &Path,
    others: &[PathBuf],
    worlds: &dyn Worlds,
    width: usize,
) -> Result<String, ReportError> {
    let table = comparison(dir, others, worlds)?;
    write_table(&table, &dir.join("comparison"))?;
    Ok(Terminal { width, file: "comparison.md" }.render(&table))
}

/// The table for programs: one object with `schema`, `columns`, `worlds` and `notes`. Writes nothing.
///
/// # Errors
/// As [`write()`].
pub fn table_json(
    dir: &Path,
    others: &[PathBuf],
    worlds: &dyn Worlds,
) -> Result<serde_json::Value, ReportError> {
    Ok(Json.value(&comparison(dir, others, worlds)?))
}

/// Draws the figures of the runs below `dir` into `DIR/figures`, each as SVG and PNG.
///
/// # Errors
/// As [`write()`].
pub fn write_figures(dir: &Path, worlds: &dyn Worlds) -> Result<Figures, ReportError> {
    let runs = Runs::read(dir, worlds)?;
    let name = names(&[dir]).remove(0);
    let results = Results::of(&[(&name, &runs)]);
    let (panels, notes) = figures::panels(&results, worlds);
    let mut figures = figures::draw(&panels, notes, worlds);
    figures.left_out.clone_from(&runs.notes);
    persist_figures(dir, &figures)?;
    Ok(figures)
}

fn persist_figures(dir: &Path, figures: &Figures) -> Result<(), ReportError> {
    figures.drawn.iter().try_for_each(|figure| persist_figure(dir, figure))
}

/// Writes a figure into the subfolder `figures`, as SVG and PNG.
fn persist_figure(dir: &Path, figure: &figures::Figure) -> Result<(), ReportError> {
    let folder = dir.join("figures");
    std::fs::create_dir_all(&folder)
        .map_err(|source| ReportError::Write { path: folder.clone(), source })?;
    // The name of a world may have a dot.
    let file = |ending| folder.join(format!("{}.{ending}", figure.name));
    persist(&file("svg"), figure.picture.svg.as_bytes())?;
    let path = file("png");
    let png = figures::png(&figure.picture.svg).map_err(|what| ReportError::Write {
        path: path.clone(),
        source: std::io::Error::other(what),
    })?;
    persist(&path, &png)
}

fn comparison(dir: &Path, others: &[PathBuf], worlds: &dyn Worlds) -> Result<Table, ReportError> {
    let dirs: Vec<&Path> =
        std::iter::once(dir).chain(others.iter().map(PathBuf::as_path)).collect();
    let runs: Vec<Runs> =
        dirs.iter().map(|dir| Runs::read(dir, worlds)).collect::<Result<_, _>>()?;
    let names = names(&dirs);
    let folders: Vec<(&str, &Runs)> = names.iter().map(String::as_str).zip(&runs).collect();
    Ok(Table::new(&Results::of(&folders)))
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

fn write_table(table: &Table, stem: &Path) -> Result<(), ReportError> {
    persist(&stem.with_extension("csv"), Csv.render(table).as_bytes())?;
    persist(&stem.with_extension("md"), Markdown.render(table).as_bytes())?;
    persist(&stem.with_extension("tex"), Latex.render(table).as_bytes())
}

fn persist(path: &Path, bytes: &[u8]) -> Result<(), ReportError> {
    write_in_place(path, bytes)
        .map_err(|source| ReportError::Write { path: path.to_path_buf(), source })
}
