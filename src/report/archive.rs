//! What the figures and the page need of a run beside its evaluation, each where it is there.

use super::ReportError;
use super::runs::{Run, read_json};
use crate::experiment::config::WorldConfig;
use crate::experiment::exhibits::Exhibits;
use crate::files::read_text;
use serde::Deserialize;
use std::path::Path;

/// A line of `progress.csv`, as far as figures need it.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Update {
    /// Environment steps so far.
    pub steps: f64,
    /// Whose update it was.
    pub player: String,
    /// Mean return of the episodes that ended in the rollout.
    pub mean_return: f64,
    /// Regret of the greedy protagonist, where it was measured; former versions have no such column.
    #[serde(default)]
    pub regret: Option<f64>,
}

/// What lies in a run's folder beside the evaluation.
#[derive(Debug, Clone, Default)]
pub struct Archive {
    /// Constants of the world and the discount gamma, from `config.toml`.
    pub world: Option<(WorldConfig, f64)>,
    /// `progress.csv`.
    pub progress: Vec<Update>,
    /// `exhibits.json`.
    pub exhibits: Option<Exhibits>,
}

impl Archive {
    /// Reads what there is. What is not there is left out: results of other programs and of older
    /// versions have none of it.
    ///
    /// # Errors
    /// If a file is there and cannot be read.
    pub fn read(run: &Run) -> Result<Archive, ReportError> {
        Ok(Archive {
            world: world(&run.folder.join("config.toml"))?,
            progress: progress(&run.folder.join("progress.csv"))?,
            exhibits: exhibits(run)?,
        })
    }
}

/// `exhibits.json` of a run.
pub(super) fn exhibits(run: &Run) -> Result<Option<Exhibits>, ReportError> {
    let path = run.folder.join("exhibits.json");
    let exhibits: Option<Exhibits> = read_json(&path)?;
    if let Some(exhibits) = &exhibits {
        exhibits.check().map_err(|what| ReportError::Corrupt { path, what })?;
    }
    Ok(exhibits)
}

/// The two keys that figures need; other keys are the business of the version that wrote them.
#[derive(Deserialize)]
struct Constants {
    gamma: f64,
    env: WorldConfig,
}

/// Constants of the world and gamma.
pub(super) fn world(path: &Path) -> Result<Option<(WorldConfig, f64)>, ReportError> {
    let Some(text) = text(path)? else { return Ok(None) };
    let corrupt = |what: &str| ReportError::Corrupt {
        path: path.to_path_buf(),
        what: what.split_whitespace().collect::<Vec<_>>().join(" "),
    };
    let constants: Constants = toml::from_str(&text).map_err(|error| corrupt(error.message()))?;
    constants.env.validate().map_err(|error| corrupt(&error.to_string()))?;
    Ok(Some((constants.env, constants.gamma)))
}

fn progress(path: &Path) -> Result<Vec<Update>, ReportError> {
    let Some(text) = text(path)? else { return Ok(Vec::new()) };
    let rows: Result<Vec<Update>, csv::Error> =
        csv::Reader::from_reader(text.as_bytes()).deserialize().collect();
    rows.map_err(|error| ReportError::Corrupt { path: path.to_path_buf(), what: error.to_string() })
}

fn text(path: &Path) -> Result<Option<String>, ReportError> {
    match read_text(path) {
        Ok(text) => Ok(Some(text)),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(source) => Err(ReportError::Read { path: path.to_path_buf(), source }),
    }
}
