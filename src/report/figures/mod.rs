//! The figures: SVG with real text, and PNG of the same SVG.
//!
//! | figure | module |
//! |---|---|
//! | learning curves, frontier, cross matrix, regret, budget over time | `curves` |
//! | the grid, where the protagonist goes, where its antagonists make moves slip | `maps` |
//! | trajectories of the point mass, how its antagonist shifts the noise | `maps` |
//! | panels, colours, axes, PNG | `canvas` |
//!
//! Every eta has one colour (Okabe & Ito's, told apart by the colour-blind), and panels of one figure
//! have one pair of axes.

mod canvas;
mod curves;
mod maps;

pub use canvas::png;

use super::ReportError;
use super::archive::Archive;
use super::group::Group;
use super::runs::Run;

/// A finished figure.
#[derive(Debug, Clone, PartialEq)]
pub struct Figure {
    /// Name of its files, such as `lava-grid-frontier`.
    pub name: String,
    /// Headline.
    pub title: String,
    /// What is to be seen, and how it was made.
    pub caption: String,
    /// The picture.
    pub svg: String,
}

/// The runs of one world and eta, with all that lies in their folders.
struct Panel<'a> {
    group: &'a Group<'a>,
    archives: Vec<(&'a Run, Archive)>,
}

/// What could be drawn, and what could not and why.
#[derive(Debug, Clone, Default)]
pub struct Figures {
    /// By world, in the order of reading.
    pub drawn: Vec<Figure>,
    /// Figures left out.
    pub missing: Vec<String>,
}

/// Draws all figures that the artefacts allow.
///
/// # Errors
/// If a file of a run is there and cannot be read.
pub fn draw(groups: &[Group]) -> Result<Figures, ReportError> {
    let mut figures = Figures::default();
    for groups in groups.chunk_by(|a, b| a.env == b.env) {
        let panels: Vec<Panel> = groups
            .iter()
            .map(|group| {
                let archives = (group.runs.iter())
                    .map(|run| Ok((run, Archive::read(run)?)))
                    .collect::<Result<_, ReportError>>()?;
                Ok(Panel { group, archives })
            })
            .collect::<Result<_, ReportError>>()?;
        figures.add_world(groups[0].env, &panels);
    }
    Ok(figures)
}

impl Figures {
    fn add_world(&mut self, env: &str, panels: &[Panel]) {
        let world = panels.iter().flat_map(|panel| &panel.archives);
        let constants = world.clone().find_map(|(_, archive)| archive.world.as_ref());
        let mut add = |name: &str, title: &str, figure: Option<(String, String)>| match figure {
            Some((svg, caption)) => self.drawn.push(Figure {
                name: format!("{env}-{name}"),
                title: format!("{env}: {title}"),
                caption,
                svg,
            }),
            None => self.missing.push(format!("{env}: {title}")),
        };
        use crate::experiment::config::WorldConfig::{LavaGrid, LavaPoint};
        match constants {
            Some((LavaGrid(config), gamma)) => {
                add("map", "the map", maps::grid(config));
                add("occupancy", "where the protagonist goes", maps::occupancy(config, panels));
                add("deviations", "where chance is bent", maps::deviations(config, panels));
                add(
                    "frontier",
                    "mean against CVaR",
                    curves::frontier(panels, Some((config, *gamma))),
                );
                add("regret", "regret in training", curves::regret(panels));
            }
            Some((LavaPoint(config), _)) => {
                add(
                    "trajectories",
                    "where the protagonist goes",
                    maps::trajectories(config, panels),
                );
                add("shifts", "how chance is bent", maps::shifts(config, panels));
                add("frontier", "mean against CVaR", curves::frontier(panels, None));
            }
            None => add("frontier", "mean against CVaR", curves::frontier(panels, None)),
        }
        add("cross", "every policy at every level", curves::cross(panels));
        add("learning", "learning curves", curves::learning(panels));
        add("budget", "the budget over time", curves::budget(panels));
    }
}
