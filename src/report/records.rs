//! What the figures and the page need of a run beside its evaluation, each where it is there.

use super::ReportError;
use super::runs::{Run, corrupt, read_bytes, read_json};
use crate::experiment::figure_data::FigureData;
use serde::Deserialize;
use std::collections::BTreeMap;

/// Names of the file with the data of figures: that of this version, and that of former ones.
const FIGURE_DATA: [&str; 2] = ["figure_data.json", "exhibits.json"];

/// A line of `progress.csv`, as far as figures need it.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Update {
    /// Environment steps so far.
    pub steps: f64,
    /// Mean return of the episodes that ended in the rollout.
    pub mean_return: f64,
    /// Regret of the greedy protagonist, where it was measured; former versions have no such column.
    #[serde(default)]
    pub regret: Option<f64>,
}

/// The records of a run beside its evaluation.
#[derive(Debug, Clone, Default)]
pub struct Records {
    /// Constants of the world and the discount gamma, from `config.toml`.
    pub constants: Option<Constants>,
    /// `progress.csv`.
    pub progress: Vec<Update>,
    /// The data of its figures.
    pub figure_data: Option<FigureData>,
}

/// Constants of a run's world, and gamma.
#[derive(Debug, Clone, PartialEq)]
pub struct Constants {
    /// Constants of the world.
    pub world: toml::Table,
    /// Discount factor.
    pub gamma: f64,
}

impl Records {
    /// Reads what there is. What is not there is left out: results of other programs and of older
    /// versions have none of it. So is a file that cannot be read, and `notes` name it.
    pub fn read(run: &Run, notes: &mut Vec<String>) -> Records {
        let mut noted = |error: ReportError| notes.push(format!("{error}."));
        Records {
            constants: constants(run).unwrap_or_else(|error| {
                noted(error);
                None
            }),
            progress: progress(run).unwrap_or_else(|error| {
                noted(error);
                Vec::new()
            }),
            figure_data: figure_data(run).unwrap_or_else(|error| {
                noted(error);
                None
            }),
        }
    }
}

fn figure_data(run: &Run) -> Result<Option<FigureData>, ReportError> {
    for file in FIGURE_DATA {
        let found: Option<FigureData> = read_json(&run.files, file)?;
        if let Some(found) = found {
            found.check().map_err(|what| corrupt(&run.files, file, what))?;
            return Ok(Some(found));
        }
    }
    Ok(None)
}

/// The two keys that figures need; other keys are the business of the version that wrote them.
#[derive(Deserialize)]
struct Config {
    gamma: f64,
    env: BTreeMap<String, toml::Table>,
}

fn constants(run: &Run) -> Result<Option<Constants>, ReportError> {
    let file = "config.toml";
    let Some(text) = text(run, file)? else { return Ok(None) };
    let refused = |what: String| corrupt(&run.files, file, what);
    let config: Config = toml::from_str(&text).map_err(|error| {
        refused(error.message().split_whitespace().collect::<Vec<_>>().join(" "))
    })?;
    let Config { gamma, mut env } = config;
    let world = env.remove(&run.name.world);
    let world = world.ok_or_else(|| refused(format!("it has no [env.{}]", run.name.world)))?;
    Ok(Some(Constants { world, gamma }))
}

fn progress(run: &Run) -> Result<Vec<Update>, ReportError> {
    let file = "progress.csv";
    let Some(text) = text(run, file)? else { return Ok(Vec::new()) };
    let rows: Result<Vec<Update>, csv::Error> =
        csv::Reader::from_reader(text.as_bytes()).deserialize().collect();
    rows.map_err(|error| corrupt(&run.files, file, error.to_string()))
}

fn text(run: &Run, file: &str) -> Result<Option<String>, ReportError> {
    let text = read_bytes(&run.files, file)?.map(String::from_utf8).transpose();
    text.map_err(|error| corrupt(&run.files, file, error.to_string()))
}
