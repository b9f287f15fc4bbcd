//! The figures: SVG with real text, and PNG of the same SVG.
//!
//! | figure | module |
//! |---|---|
//! | how far every row is from the best that is known | `overview` |
//! | learning curves, frontier, cross matrix, regret, budget over time | `curves` |
//! | worlds of cells: the map, where the protagonist goes, where its antagonists change its moves | `maps` |
//! | worlds in the plane: trajectories, how the antagonist shifts the noise | `maps` |
//! | worlds in the plane: episodes that run, of the least and the greatest budget | `race` |
//! | what a constant of the world does, where the runs differ in it | `axis` |
//! | panels, colours, axes, PNG | `canvas` |
//!
//! Every row of the table has one colour (Okabe & Ito's, which the colour-blind can tell apart), and
//! panels of one figure have one pair of axes.

mod axis;
mod canvas;
mod curves;
mod maps;
mod overview;
mod race;

pub use canvas::{Picture, png, rgb};
pub use curves::{Line, lines};
pub use maps::moment;

use super::Worlds;
use super::group::Group;
use super::records::Records;
use super::runs::Run;
use super::settings::Task;
use super::table::Results;
use crate::experiment::names::as_file;

/// Name of the figure that a page opens with.
pub const OVERVIEW: &str = "overview";

/// A finished figure.
#[derive(Debug, Clone, PartialEq)]
pub struct Figure {
    /// Name of its files, such as `lava-grid-frontier`.
    pub name: String,
    /// The world that it is of.
    pub world: String,
    /// Headline.
    pub title: String,
    /// What it shows, and how it was made.
    pub caption: String,
    /// The picture.
    pub picture: Picture,
}

/// The runs of one world, method and eta, with their records.
pub struct Panel<'a> {
    /// The runs, measured.
    pub group: &'a Group<'a>,
    /// By seed.
    pub seeds: Vec<(&'a Run, Records)>,
}

impl Panel<'_> {
    /// What was played; all seeds share it.
    pub fn task(&self) -> &Task {
        &self.group.runs[0].settings.task
    }
}

/// Reads the records of all runs, by world, then by method and eta, and notes about files that cannot
/// be read.
pub fn panels<'a>(
    results: &'a [Results<'a>],
    worlds: &dyn Worlds,
) -> (Vec<Panel<'a>>, Vec<String>) {
    let mut groups: Vec<&Group> = results.iter().flat_map(|results| &results.groups).collect();
    // Stable: within a world the methods keep their order.
    groups.sort_by_key(|group| group.env);
    let mut notes = Vec::new();
    let panels = groups.into_iter().map(|group| {
        let scene = worlds.scene(group.env, &group.runs[0].settings.task.constants);
        let records = |run| (run, Records::read(run, scene.as_ref(), &mut notes));
        Panel { group, seeds: group.runs.iter().map(records).collect() }
    });
    (panels.collect(), notes)
}

/// What could be drawn, and what could not and why.
#[derive(Debug, Clone, Default)]
pub struct Figures {
    /// By world, in the order of reading.
    pub drawn: Vec<Figure>,
    /// Figures left out.
    pub missing: Vec<String>,
    /// Files that could not be read, and are missing in the figures.
    pub notes: Vec<String>,
    /// Whole runs that are missing, and why.
    pub left_out: Vec<String>,
}

/// Draws all figures that the records allow.
pub fn draw(panels: &[Panel], notes: Vec<String>, worlds: &dyn Worlds) -> Figures {
    let mut figures = Figures { notes, ..Figures::default() };
    for panels in panels.chunk_by(|a, b| a.group.env == b.group.env) {
        figures.add_world(panels, worlds);
    }
    figures
}

impl Figures {
    fn add_world(&mut self, panels: &[Panel], worlds: &dyn Worlds) {
        let env = panels[0].group.env;
        let task = panels[0].task();
        let scene = worlds.scene(env, &task.constants);
        let mut add = |name: &str, title: &str, figure: Option<(Picture, String)>| match figure {
            Some((picture, caption)) => self.drawn.push(Figure {
                name: format!("{}-{name}", as_file(env)),
                world: env.to_owned(),
                title: format!("{env}: {title}"),
                caption,
                picture,
            }),
            None => self.missing.push(format!("{env}: {title}")),
        };
        // Maps show the panels of one and the same world.
        let (here, elsewhere): (Vec<_>, Vec<_>) =
            (panels.iter().enumerate()).partition(|(_, panel)| panel.task() == task);
        let overview = overview::overview(panels);
        if overview.is_some() {
            add(OVERVIEW, "how far from the best", overview);
        }
        match &scene {
            Some(scene) if scene.cells => {
                add("map", "the map", maps::map(scene));
                add("occupancy", "where the protagonist goes", maps::occupancy(scene, &here));
                add(
                    "deviations",
                    "where the antagonist changes moves",
                    maps::deviations(scene, &here),
                );
            }
            Some(scene) => {
                add("trajectories", "where the protagonist goes", maps::trajectories(scene, &here));
                add("shifts", "how the antagonist shifts the noise", maps::shifts(scene, &here));
                let race = race::race(scene, &here);
                if race.is_some() {
                    add("race", "the same episodes at two budgets", race);
                }
            }
            None => {}
        }
        let greatest = panels.iter().map(|panel| panel.group.eta).fold(1.0, f64::max);
        let optima = Some(task).filter(|_| here.len() == panels.len()).and_then(|of| {
            worlds.frontier(env, &of.constants, of.gamma, &curves::frontier_budgets(greatest))
        });
        add("frontier", "mean against CVaR", curves::frontier(panels, optima.as_deref(), greatest));
        let regret = curves::regret(panels);
        // Without an exact yardstick there is no regret in training.
        if optima.is_some() || regret.is_some() {
            add("regret", "regret in training", regret);
        }
        let profile = curves::profile(panels);
        if profile.is_some() {
            add("profile", "performance profile", profile);
        }
        let improvement = curves::improvement(panels);
        if improvement.is_some() {
            add("improvement", "probability of improvement", improvement);
        }
        for (name, title, picture, caption) in axis::constant(panels, worlds) {
            add(&name, &title, Some((picture, caption)));
        }
        add("cross", "every policy at every level", curves::cross(panels));
        add("learning", "learning curves", curves::learning(panels));
        add("budget", "the budget over time", curves::budget(panels));
        self.missing.extend(elsewhere.iter().map(|(_, panel)| {
            let title = panel.group.title();
            format!("{env}: maps of {title}, whose constants are not those of the others")
        }));
    }
}
