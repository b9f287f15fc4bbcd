//! What the figures and the page need of a run beside its evaluation, each where it is there.

use super::ReportError;
use super::runs::{Run, corrupt, read_json, read_text, require_own};
use crate::experiment::figure_data::{FigureData, WorldData};
use lava_envs::scene::Scene;
use serde::Deserialize;

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
    /// `progress.csv`.
    pub progress: Vec<Update>,
    /// The data of its figures.
    pub figure_data: Option<FigureData>,
}

impl Records {
    /// Reads what there is. What is not there is left out: results of other programs and of older
    /// versions have none of it. So is a file that cannot be read or is not of this run, and `notes` name
    /// it. `scene` is the run's world.
    pub fn read(run: &Run, scene: Option<&Scene>, notes: &mut Vec<String>) -> Records {
        let mut noted = |error: ReportError| notes.push(format!("{error}."));
        Records {
            progress: progress(run).unwrap_or_else(|error| {
                noted(error);
                Vec::new()
            }),
            figure_data: figure_data(run, scene).unwrap_or_else(|error| {
                noted(error);
                None
            }),
        }
    }
}

fn figure_data(run: &Run, scene: Option<&Scene>) -> Result<Option<FigureData>, ReportError> {
    for file in FIGURE_DATA {
        let found: Option<FigureData> = read_json(&run.files, file)?;
        if let Some(found) = found {
            if let Some(name) = &found.run {
                require_own(&run.files, file, name)?;
            }
            found
                .check()
                .and_then(|()| scene.map_or(Ok(()), |scene| fits(&found, scene)))
                .map_err(|what| corrupt(&run.files, file, what))?;
            return Ok(Some(found));
        }
    }
    Ok(None)
}

/// Whether the data can be of a world: files of former versions do not say of which run they are.
fn fits(data: &FigureData, scene: &Scene) -> Result<(), String> {
    match &data.world {
        WorldData::Cells(_) if !scene.cells => {
            Err("its maps are of cells, but the world is a plane".to_owned())
        }
        WorldData::Plane(_) if scene.cells => {
            Err("its maps are of a plane, but the world has cells".to_owned())
        }
        WorldData::Cells(cells) => {
            let (found, expected) = (cells.occupancy.len(), scene.size[0] * scene.size[1]);
            if found == 0 || found as f64 == expected {
                return Ok(());
            }
            Err(format!("its maps have {found} cells, but the world has {expected}"))
        }
        WorldData::Plane(_) => Ok(()),
    }
}

fn progress(run: &Run) -> Result<Vec<Update>, ReportError> {
    let file = "progress.csv";
    let Some(text) = read_text(&run.files, file)? else { return Ok(Vec::new()) };
    let rows: Result<Vec<Update>, csv::Error> =
        csv::Reader::from_reader(text.as_bytes()).deserialize().collect();
    rows.map_err(|error| corrupt(&run.files, file, error.to_string()))
}
