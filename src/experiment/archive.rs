//! The files of runs: each in the folder of its run, or all packed into one archive, `runs.zip`.
//!
//! A results folder `DIR` holds runs `WORLD/METHOD[/VARIANT]/eta-E/seed-N`; a folder `WORLD/eta-E/seed-N`
//! is a run of the method `game`. `DIR/runs.zip` may hold the files of further runs under the same
//! names. Readers see no difference: [`Store`] lists the runs of both, and [`RunFiles`] reads a file of
//! one of them. Where both hold a run, its folder counts if a result (`evaluation.json` or
//! `episodes.csv`) is in it, and otherwise the archive.
//!
//! [`pack`] makes the archive. The same files give the same bytes: members are sorted by name, and have
//! one time, one mode and one level of compression. Checkpoints and event files are not packed, weights as
//! [`PackedWeights`] says.

use super::artefacts::Manifest;
use super::lock::RunLock;
use super::names;
use super::words::{counted, thousands};
use crate::files::{LARGEST_FILE, read_at_most};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, DateTime, ZipArchive, ZipWriter};

/// Name of the archive in a results folder.
pub const ARCHIVE: &str = "runs.zip";

/// The method of a run whose name has none, and the first one in tables.
pub const FIRST_METHOD: &str = "game";

/// Files of a run that are results: with one of them a run is finished.
const RESULTS: [&str; 2] = ["evaluation.json", "episodes.csv"];

/// Other files of a run that are packed.
const RECORDS: [&str; 5] =
    ["config.toml", "manifest.json", "progress.csv", "figure_data.json", "exhibits.json"];

/// The networks at the end of training.
const WEIGHTS: &str = "final.safetensors";

/// More runs than any sweep has.
const MOST_RUNS: usize = 1_000_000;

/// Level of compression.
const LEVEL: i64 = 9;

/// The name of a run of any program: names of its world, method and variant, budget and seed.
#[derive(Debug, Clone, PartialEq)]
pub struct RunName {
    /// World, with a `/` and its scene where it is not on its own; in paths the `/` is a `+`.
    pub world: String,
    /// Method of training.
    pub method: String,
    /// What differs from the other runs of the method.
    pub variant: Option<String>,
    /// Budget eta, at least 1.
    pub eta: f64,
    /// Seed.
    pub seed: u64,
}

impl RunName {
    /// The run of a path `WORLD[/METHOD[/VARIANT]]/eta-E/seed-N`; `None` if it is no such path.
    pub fn parse(path: &str) -> Option<RunName> {
        let parts: Vec<&str> = path.split('/').collect();
        let (names, &[eta, seed]) = parts.split_last_chunk::<2>()?;
        if names.iter().any(|name| name.is_empty() || name.starts_with('.')) {
            return None;
        }
        let (eta, seed) = (eta_of(eta)?, seed_of(seed)?);
        let (world, method, variant) = match names {
            [world] => (world, FIRST_METHOD, None),
            [world, method] => (world, *method, None),
            [world, method, variant] => (world, *method, Some((*variant).to_owned())),
            _ => return None,
        };
        let world = names::of_file(world);
        Some(RunName { world, method: method.to_owned(), variant, eta, seed })
    }

    /// `METHOD` or `METHOD/VARIANT`.
    pub fn label(&self) -> String {
        match &self.variant {
            Some(variant) => format!("{}/{variant}", self.method),
            None => self.method.clone(),
        }
    }

    /// Whether it is of the method `game`, without a variant.
    pub fn is_plain(&self) -> bool {
        self.method == FIRST_METHOD && self.variant.is_none()
    }

    /// Name without the spelling of numbers and without the method where it is `game`.
    fn key(&self) -> String {
        self.to_string()
    }
}

/// `WORLD/METHOD[/VARIANT]/eta-E/seed-N`; plain runs of the method `game` are `WORLD/eta-E/seed-N`.
impl fmt::Display for RunName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let label = if self.is_plain() { String::new() } else { format!("/{}", self.label()) };
        let world = names::as_file(&self.world);
        f.pad(&format!("{world}{label}/eta-{}/seed-{}", self.eta, self.seed))
    }
}

fn eta_of(name: &str) -> Option<f64> {
    let eta: f64 = name.strip_prefix("eta-")?.parse().ok()?;
    (eta >= 1.0 && eta.is_finite()).then_some(eta)
}

fn seed_of(name: &str) -> Option<u64> {
    name.strip_prefix("seed-")?.parse().ok()
}

/// An open archive.
struct Packed {
    path: PathBuf,
    archive: Mutex<ZipArchive<File>>,
    /// The folder of every run in it, by [`RunName::key`].
    runs: BTreeMap<String, (RunName, String)>,
    /// Names of all members that are files of runs.
    members: BTreeSet<String>,
}

impl fmt::Debug for Packed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Packed").field("path", &self.path).finish_non_exhaustive()
    }
}

impl Packed {
    /// Opens the archive of a results folder; `None` if there is no archive.
    fn open(dir: &Path) -> io::Result<Option<Packed>> {
        let path = dir.join(ARCHIVE);
        let file = match crate::files::open(&path) {
            Ok(file) => file,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(error),
        };
        Packed::read(path, file).map(Some)
    }

    fn read(path: PathBuf, file: File) -> io::Result<Packed> {
        let archive = ZipArchive::new(file).map_err(io::Error::other)?;
        let mut members = BTreeSet::new();
        let mut runs = BTreeMap::new();
        for name in archive.file_names() {
            let name = name.map_err(io::Error::other)?;
            let Some((folder, _)) = name.rsplit_once('/') else { continue };
            let Some(run) = RunName::parse(folder) else { continue };
            let found = runs.entry(run.key()).or_insert_with(|| (run, folder.to_owned()));
            if found.1 != folder {
                let problem = format!("its folders {} and {folder} are one run", found.1);
                return Err(io::Error::new(io::ErrorKind::InvalidData, problem));
            }
            members.insert(name.into_owned());
        }
        if runs.len() > MOST_RUNS {
            let problem = format!("it has more than {MOST_RUNS} runs");
            return Err(io::Error::new(io::ErrorKind::FileTooLarge, problem));
        }
        Ok(Packed { path, archive: Mutex::new(archive), runs, members })
    }

    /// A member, unpacked; `None` if there is no member of this name.
    fn member(&self, name: &str, limit: u64) -> io::Result<Option<Vec<u8>>> {
        if !self.members.contains(name) {
            return Ok(None);
        }
        let mut archive = self.archive.lock().expect("no thread panics while it reads");
        let member = archive.by_name(name).map_err(io::Error::other)?;
        // The size that the archive states is not trusted: the member may be a decompression bomb.
        let mut bytes = Vec::new();
        member.take(limit + 1).read_to_end(&mut bytes)?;
        if bytes.len() as u64 > limit {
            let problem = format!("it is larger than {limit} bytes");
            return Err(io::Error::new(io::ErrorKind::FileTooLarge, problem));
        }
        Ok(Some(bytes))
    }
}

/// The files of one run.
#[derive(Debug, Clone)]
pub struct RunFiles {
    /// Which run.
    pub name: RunName,
    /// The name as it is spelled by its folder.
    pub path: String,
    folder: PathBuf,
    packed: Option<Arc<Packed>>,
}

impl RunFiles {
    /// The files of the run whose folder is, or would be, `folder`: from there, or else from the archive
    /// of the results folder above it; `None` if no run is named like `folder`. Where no archive says which
    /// folder above is the results folder, `name` is read as if it had no method.
    ///
    /// # Errors
    /// If there is an archive and it cannot be read.
    pub fn at(folder: &Path) -> io::Result<Option<RunFiles>> {
        let mut found = None;
        for depth in 3..=5 {
            let Some(dir) = folder.ancestors().nth(depth) else { break };
            let path = folder.strip_prefix(dir).unwrap_or(folder).to_string_lossy().into_owned();
            let Some(name) = RunName::parse(&path.replace('\\', "/")) else { continue };
            if has_result(folder) {
                return Ok(Some(RunFiles { name, path, folder: folder.to_owned(), packed: None }));
            }
            if let Some(packed) = Packed::open(dir)?
                && let Some((name, path)) = packed.runs.get(&name.key()).cloned()
            {
                let folder = packed.path.join(&path);
                return Ok(Some(RunFiles { name, path, folder, packed: Some(Arc::new(packed)) }));
            }
            found.get_or_insert(RunFiles { name, path, folder: folder.to_owned(), packed: None });
        }
        Ok(found)
    }

    /// Whether they are in an archive.
    pub fn is_packed(&self) -> bool {
        self.packed.is_some()
    }

    /// Where a file is, for messages: in an archive, the path of the archive and then that in it.
    pub fn place(&self, file: &str) -> PathBuf {
        self.folder.join(file)
    }

    /// The bytes of a file; `None` if the run has no such file.
    ///
    /// # Errors
    /// If it cannot be read or is larger than [`LARGEST_FILE`].
    pub fn read(&self, file: &str) -> io::Result<Option<Vec<u8>>> {
        match &self.packed {
            Some(packed) => packed.member(&format!("{}/{file}", self.path), LARGEST_FILE),
            None => optional(read_at_most(&self.folder.join(file), LARGEST_FILE)),
        }
    }

    /// The text of a file; `None` if the run has no such file.
    ///
    /// # Errors
    /// As [`RunFiles::read`], and if it is not UTF-8.
    pub fn text(&self, file: &str) -> io::Result<Option<String>> {
        let text = self.read(file)?.map(String::from_utf8).transpose();
        text.map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error))
    }
}

/// A file of the run whose folder is, or would be, `folder`, and its place, for messages: from the archive of the results folder
/// above it if the run is packed there, or else from the folder, whatever its name. `None` if there is no such file.
///
/// # Errors
/// If the file or the archive cannot be read.
pub fn read_file(folder: &Path, file: &str) -> io::Result<(PathBuf, Option<Vec<u8>>)> {
    if let Some(packed) = RunFiles::at(folder)?.filter(RunFiles::is_packed)
        && let Some(bytes) = packed.read(file)?
    {
        return Ok((packed.place(file), Some(bytes)));
    }
    let place = folder.join(file);
    let bytes = optional(read_at_most(&place, LARGEST_FILE))?;
    Ok((place, bytes))
}

fn optional<T>(result: io::Result<T>) -> io::Result<Option<T>> {
    match result {
        Ok(found) => Ok(Some(found)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error),
    }
}

fn has_result(folder: &Path) -> bool {
    // `symlink_metadata`: a dangling link is a file that cannot be read, not an absent file.
    RESULTS.iter().any(|file| folder.join(file).symlink_metadata().is_ok())
}

/// The runs of a results folder.
#[derive(Debug)]
pub struct Store {
    dir: PathBuf,
    packed: Option<Arc<Packed>>,
}

/// What [`Store::list`] finds.
#[derive(Debug, Default)]
pub struct Listing {
    /// Every run, by path.
    pub runs: Vec<RunFiles>,
    /// Folders that look like runs but are not, in words.
    pub notes: Vec<String>,
}

impl Store {
    /// Opens a results folder.
    ///
    /// # Errors
    /// If it has an archive that cannot be read.
    pub fn open(dir: &Path) -> io::Result<Store> {
        Ok(Store { dir: dir.to_owned(), packed: Packed::open(dir)?.map(Arc::new) })
    }

    /// A results folder whose archive is not looked at.
    pub fn without_archive(dir: &Path) -> Store {
        Store { dir: dir.to_owned(), packed: None }
    }

    /// The path of its archive.
    pub fn archive(dir: &Path) -> PathBuf {
        dir.join(ARCHIVE)
    }

    /// All runs, in folders and in the archive.
    ///
    /// # Errors
    /// If a folder cannot be read; with its path.
    pub fn list(&self) -> Result<Listing, (PathBuf, io::Error)> {
        let mut listing = Listing::default();
        self.descend(&self.dir, "", 0, &mut listing)?;
        if let Some(packed) = &self.packed {
            let in_folders: BTreeMap<String, bool> = (listing.runs.iter())
                .map(|run| (run.name.key(), has_result(&run.folder)))
                .collect();
            let wins = |key: &String| in_folders.get(key) == Some(&true);
            listing
                .runs
                .retain(|run| wins(&run.name.key()) || !packed.runs.contains_key(&run.name.key()));
            for (key, (name, path)) in packed.runs.iter().filter(|(key, _)| !wins(key)) {
                debug_assert_eq!(*key, name.key());
                listing.runs.push(RunFiles {
                    name: name.clone(),
                    path: path.clone(),
                    folder: packed.path.join(path),
                    packed: Some(Arc::clone(packed)),
                });
            }
        }
        listing.runs.sort_by(|a, b| a.path.cmp(&b.path));
        Ok(listing)
    }

    /// `above` are the folders between the results folder and `dir`, `names` their number.
    fn descend(
        &self,
        dir: &Path,
        above: &str,
        names: usize,
        listing: &mut Listing,
    ) -> Result<(), (PathBuf, io::Error)> {
        for (name, folder) in folders(dir)? {
            let path = if above.is_empty() { name.clone() } else { format!("{above}/{name}") };
            if names > 0 && name.starts_with("eta-") {
                if eta_of(&name).is_none() {
                    listing.notes.push(format!("{path} left out: its name has no eta >= 1"));
                    continue;
                }
                for (seed, folder) in folders(&folder)? {
                    let path = format!("{path}/{seed}");
                    match RunName::parse(&path) {
                        Some(name) => {
                            listing.runs.push(RunFiles { name, path, folder, packed: None });
                        }
                        None if seed.starts_with("seed-") => {
                            listing.notes.push(format!("{path} left out: its name has no seed"));
                        }
                        None => {}
                    }
                }
            } else if names < 3 {
                self.descend(&folder, &path, names + 1, listing)?;
            }
        }
        Ok(())
    }
}

/// Names and paths of the visible folders in `dir`, by name.
fn folders(dir: &Path) -> Result<BTreeMap<String, PathBuf>, (PathBuf, io::Error)> {
    let failed = |error| (dir.to_path_buf(), error);
    let mut folders = BTreeMap::new();
    for entry in fs::read_dir(dir).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if path.is_dir() && !name.starts_with('.') {
            folders.insert(name, path);
        }
    }
    Ok(folders)
}

/// Why nothing was packed. No file of a run is removed before all of them are in the archive.
#[derive(Debug, thiserror::Error)]
#[error("cannot pack {}: {source}; the folders of its runs are as they were", path.display())]
pub struct PackError {
    /// The file or folder.
    pub path: PathBuf,
    /// The error of the system.
    pub source: io::Error,
}

/// What [`pack`] has done.
#[derive(Debug, Default, Clone, PartialEq, Eq)]
pub struct Summary {
    /// Runs that were packed.
    pub packed: usize,
    /// Runs that are in the archive now.
    pub runs: usize,
    /// Size of the archive in bytes.
    pub bytes: u64,
    /// Folders of runs that are still there: of runs that have not ended, or with files that are not packed.
    pub left: Vec<PathBuf>,
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Summary { packed, runs, bytes, left } = self;
        let [packed, runs] = [packed, runs].map(|&number| counted(number as u64, "run"));
        write!(f, "{packed} packed; the archive has {runs} and {} bytes", thousands(*bytes))?;
        for folder in left {
            write!(f, "\nleft as it is: {}", folder.display())?;
        }
        Ok(())
    }
}

/// Whose networks at the end of training are packed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum PackedWeights {
    /// Nobody's.
    None,
    /// Those of the first seed of each row, so that what is said of single policies can be checked.
    First,
    /// Those of all runs.
    All,
}

/// Packs the finished and the failed runs below `dir` into `DIR/runs.zip`, in addition to those that are in it
/// already, checks every member, and then removes what was packed. Files that are not packed stay where they are.
///
/// # Errors
/// If a file cannot be read or the archive cannot be written. Nothing has been removed then.
pub fn pack(dir: &Path, weights: PackedWeights) -> Result<Summary, PackError> {
    let failed = |path: &Path| {
        let path = path.to_owned();
        move |source: io::Error| PackError { path, source }
    };
    let path = Store::archive(dir);
    let store = Store::open(dir).map_err(failed(&path))?;
    let mut folders = Listing::default();
    let unreadable = |(path, source)| PackError { path, source };
    store.descend(dir, "", 0, &mut folders).map_err(unreadable)?;

    let row = |name: &RunName| RunName { seed: 0, ..name.clone() }.key();
    let mut first: BTreeMap<_, u64> = BTreeMap::new();
    let packed = store.packed.iter().flat_map(|packed| packed.runs.values().map(|(name, _)| name));
    for name in folders.runs.iter().map(|run| &run.name).chain(packed) {
        let seed = first.entry(row(name)).or_insert(name.seed);
        *seed = name.seed.min(*seed);
    }
    let with_weights = |name: &RunName| match weights {
        PackedWeights::None => false,
        PackedWeights::First => first[&row(name)] == name.seed,
        PackedWeights::All => true,
    };

    let mut summary = Summary::default();
    let mut locks = Vec::new();
    let mut members: BTreeMap<String, Source> = BTreeMap::new();
    let mut replaced = BTreeSet::new();
    for run in folders.runs {
        // A run that another process works on is not touched.
        let lock = RunLock::take(&run.folder).map_err(failed(&run.folder))?;
        if lock.is_none() || !has_ended(&run) {
            summary.left.push(run.folder);
            continue;
        }
        if !replaced.insert(run.name.key()) {
            let problem = io::Error::other(format!("two folders hold {}", run.name));
            return Err(PackError { path: run.folder, source: problem });
        }
        let weights = with_weights(&run.name).then_some(&WEIGHTS);
        for file in RESULTS.iter().chain(&RECORDS).chain(weights) {
            let source = run.folder.join(file);
            if source.is_file() {
                members.insert(format!("{}/{file}", run.path), Source::File(source));
            }
        }
        locks.push((lock, run.folder));
    }
    summary.packed = locks.len();
    if let Some(packed) = &store.packed {
        let kept = packed.runs.iter().filter(|(key, _)| !replaced.contains(*key));
        let kept: BTreeSet<&str> = kept.map(|(_, (_, folder))| folder.as_str()).collect();
        for member in &packed.members {
            if member.rsplit_once('/').is_some_and(|(folder, _)| kept.contains(folder)) {
                members.insert(member.clone(), Source::Member(Arc::clone(packed)));
            }
        }
    }
    if locks.is_empty() {
        summary.runs = store.packed.as_ref().map_or(0, |packed| packed.runs.len());
        summary.bytes = fs::metadata(&path).map_or(0, |archive| archive.len());
        return Ok(summary);
    }

    let written = write(dir, &members).map_err(failed(&path))?;
    let file = written.reopen().map_err(failed(&path))?;
    let packed = Packed::read(path.clone(), file).map_err(failed(&path))?;
    for (name, source) in &members {
        let found = packed.member(name, LARGEST_FILE).map_err(failed(&path.join(name)))?;
        let expected = source.read(name).map_err(failed(&path.join(name)))?;
        if found != Some(expected) {
            let problem = io::Error::other("it does not come out of the archive as it went in");
            return Err(PackError { path: path.join(name), source: problem });
        }
    }
    summary.runs = packed.runs.len();
    written.persist(&path).map_err(|error| failed(&path)(error.error))?;
    summary.bytes = fs::metadata(&path).map_or(0, |archive| archive.len());

    // Results first: from then on the archive counts, and a folder that is partly removed does not.
    let rank = |name: &str| usize::from(!RESULTS.iter().any(|result| name.ends_with(result)));
    let mut files: Vec<(&String, &PathBuf)> = (members.iter())
        .filter_map(|(name, source)| match source {
            Source::File(file) => Some((name, file)),
            Source::Member(_) => None,
        })
        .collect();
    files.sort_by_key(|(name, _)| rank(name));
    for (_, file) in files {
        fs::remove_file(file).map_err(failed(file))?;
    }
    for (lock, folder) in locks {
        drop(lock);
        let _ = fs::remove_file(folder.join(".lock"));
        // Folders that are not empty stay; so does, in the end, `dir`.
        for folder in folder.ancestors().take_while(|folder| *folder != dir) {
            if fs::remove_dir(folder).is_err() {
                break;
            }
        }
        if folder.exists() {
            summary.left.push(folder);
        }
    }
    Ok(summary)
}

/// Whether a run has finished or failed.
fn has_ended(run: &RunFiles) -> bool {
    let failed = || {
        let manifest = run.read("manifest.json").ok().flatten();
        let manifest = manifest.and_then(|text| serde_json::from_slice::<Manifest>(&text).ok());
        manifest.is_some_and(|manifest| manifest.failure.is_some())
    };
    has_result(&run.folder) || failed()
}

/// Where the bytes of a new member are.
enum Source {
    File(PathBuf),
    Member(Arc<Packed>),
}

impl Source {
    fn read(&self, name: &str) -> io::Result<Vec<u8>> {
        match self {
            Source::File(path) => read_at_most(path, LARGEST_FILE),
            Source::Member(packed) => {
                packed.member(name, LARGEST_FILE)?.ok_or_else(|| io::ErrorKind::NotFound.into())
            }
        }
    }
}

/// Writes the members into a temporary file next to the archive.
fn write(dir: &Path, members: &BTreeMap<String, Source>) -> io::Result<tempfile::NamedTempFile> {
    let mut file = tempfile::Builder::new();
    file.prefix(".part-");
    #[cfg(unix)] // temporary files are private by default, artefacts are not
    file.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let mut file = file.tempfile_in(dir)?;
    let options = SimpleFileOptions::default()
        .compression_method(CompressionMethod::Deflated)
        .compression_level(Some(LEVEL))
        .last_modified_time(DateTime::default())
        .unix_permissions(0o644);
    let mut writer = ZipWriter::new(file.as_file_mut());
    for (name, source) in members {
        writer.start_file(name.as_str(), options).map_err(io::Error::other)?;
        writer.write_all(&source.read(name)?)?;
    }
    writer.finish().map_err(io::Error::other)?.sync_all()?;
    Ok(file)
}
