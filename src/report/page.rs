//! `report.html`: one page with everything, that needs no network and no other file.
//!
//! Summary first, then tables, figures, a player of stored episodes, and how each number was made.

use super::figures::Figures;
use super::group::Group;
use super::render::{columns, legend, row_headings, row_name, seeds, words};
use super::table::{Block, Cell, Row, Table, World};
use super::{ReportError, archive};
use crate::experiment::config::WorldConfig;
use crate::experiment::exhibits::StoredEpisode;
use lava_envs::LavaGrid;
use maud::{DOCTYPE, Markup, PreEscaped, html};
use serde::Serialize;
use std::collections::BTreeMap;

/// Seeds of one world and eta whose episodes the player has: the page stays small.
const PLAYED_SEEDS: usize = 5;

/// The text of `report.html`.
///
/// # Errors
/// If a file of a run is there and cannot be read.
pub fn render(
    name: &str,
    table: &Table,
    groups: &[Group],
    figures: &Figures,
) -> Result<String, ReportError> {
    let episodes = Episodes::read(groups)?;
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { (name) " - cvar-game" }
                // No request for an icon.
                link rel="icon" href="data:,";
                style { (PreEscaped(include_str!("page.css"))) }
            }
            body {
                header {
                    h1 { "Results: " (name) }
                    nav {
                        a href="#summary" { "Summary" }
                        a href="#tables" { "Tables" }
                        a href="#figures" { "Figures" }
                        a href="#episodes-played" { "Episodes" }
                        a href="#made" { "How it was made" }
                    }
                }
                main {
                    section id="summary" { h2 { "Summary" } (summary(table)) }
                    section id="tables" { h2 { "Tables" } (tables(table)) }
                    section id="figures" { h2 { "Figures" } (pictures(figures)) }
                    section id="episodes-played" { h2 { "Episodes" } (player(&episodes)) }
                    section id="made" { h2 { "How it was made" } (made(table)) }
                }
                script { (PreEscaped(include_str!("page.js"))) }
            }
        }
    };
    Ok(page.into_string())
}

/// The main numbers of each row in a sentence, and what a reader must know before trusting them.
fn summary(table: &Table) -> Markup {
    html! {
        @for note in &table.notes { p.note { (note) } }
        p { "A protagonist learns to reach a goal past lava while an antagonist reweights chance within a budget eta. "
            "It should maximise CVaR at alpha = 1/eta: the mean of its worst returns." }
        @for world in &table.worlds {
            h3 { (world.name) }
            ul { @for row in &world.rows { li { (sentence(row)) } } }
        }
    }
}

fn sentence(row: &Row) -> String {
    let said = |key: &str| {
        let place = super::table::COLUMNS.iter().position(|column| column.key == key)?;
        let cell = row.cells[place];
        let number = !matches!(cell, Cell::Missing | Cell::Baseline);
        number.then(|| {
            let (value, interval) = words(super::table::COLUMNS[place].format, cell);
            interval.map_or(value.clone(), |interval| format!("{value} {interval}"))
        })
    };
    let seeds = if row.seeds == 1 { "seed" } else { "seeds" };
    let mut text = format!("eta = {} ({} {seeds})", row.eta, row.seeds);
    for (key, before, unit) in [
        ("mean", "mean return", ""),
        ("cvar", "CVaR at 1/eta", ""),
        ("gain", "gain over eta = 1", ""),
        ("regret", "regret", ""),
        ("lava", "lava", " %"),
    ] {
        if let Some(number) = said(key) {
            text += &format!("; {before} {number}{unit}");
        }
    }
    text
}

fn tables(table: &Table) -> Markup {
    html! {
        p { "A click on a heading sorts. Green and bold: the best of its column, or not told apart from it." }
        @for world in &table.worlds {
            @for block in Block::ALL {
                @if !columns(world, block).is_empty() {
                    h3 { (world.name) ": " (block.title()) }
                    div.scroll tabindex="0" { (one_table(table, world, block)) }
                }
            }
        }
    }
}

fn one_table(table: &Table, world: &World, block: Block) -> Markup {
    let columns = columns(world, block);
    html! {
        table {
            thead { tr {
                @for heading in row_headings(table) { th scope="col" { button { (heading) } } }
                @for (_, column) in &columns {
                    th scope="col" { button title=(column.meaning) { (column.title) } }
                }
            } }
            tbody {
                @for row in &world.rows {
                    tr {
                        @for name in row_name(table, row) { td data-value=(name) { (name) } }
                        @let (count, failed) = seeds(row);
                        td data-value=(row.seeds) { (count) @if let Some(failed) = failed { small { (failed) } } }
                        @for &(place, column) in &columns {
                            @let (value, interval) = words(column.format, row.cells[place]);
                            td.best[row.best[place]] data-value=[sort_key(row.cells[place])] {
                                (value) @if let Some(interval) = interval { small { (interval) } }
                            }
                        }
                    }
                }
            }
        }
    }
}

fn sort_key(cell: Cell) -> Option<f64> {
    match cell {
        Cell::Missing | Cell::Baseline => None,
        Cell::Count(count) => Some(count as f64),
        Cell::Estimate(estimate) => Some(estimate.value),
        Cell::Worst { value, .. } => Some(value),
    }
    .filter(|value| value.is_finite())
}

fn pictures(figures: &Figures) -> Markup {
    html! {
        @for figure in &figures.drawn {
            figure id=(figure.name) {
                h3 { (figure.title) }
                div.scroll tabindex="0" role="img" aria-label=(figure.title) { (PreEscaped(scalable(&figure.svg))) }
                figcaption { (figure.caption) }
            }
        }
        @if !figures.missing.is_empty() {
            p.note { "Left out, for want of artefacts: " (figures.missing.join("; ")) "." }
        }
    }
}

/// Its size in pixels becomes the largest one: on a narrower page the viewBox keeps the shape.
fn scalable(svg: &str) -> String {
    let parts = svg.split_once("width=\"").zip(svg.split_once('>'));
    let Some(((_, width), (head, rest))) = parts else { return svg.to_owned() };
    let width = width.split('"').next().unwrap_or_default();
    let kept = |word: &&str| !word.starts_with("width=") && !word.starts_with("height=");
    let head: Vec<&str> = head.split(' ').filter(kept).collect();
    let style = format!("max-width:{width}px;min-width:min({width}px,620px)");
    format!("{} style=\"{style}\">{rest}", head.join(" "))
}

fn player(episodes: &Episodes) -> Markup {
    if episodes.runs.is_empty() {
        return html! { p.note { "No episodes were stored." } };
    }
    let json = serde_json::to_string(episodes).expect("episodes are representable as JSON");
    html! {
        p { "The greedy protagonist's episodes, the first ones and the first that end in lava. Blue arrow: the "
            "chosen action; rose arrow: what chance decided. In nominal episodes the likelihood ratios are those that the learned "
            "antagonist would have given to what happened." }
        div id="player" {
            div.row {
                @for (id, words) in [("env", "world"), ("eta", "eta"), ("seed", "seed"), ("chance", "under"), ("episode", "episode")] {
                    label { (words) select id=(id) {} }
                }
            }
            div.row {
                button id="play" type="button" { "Play" }
                input id="scrub" type="range" min="0" step="1" value="0" aria-label="step";
            }
            output id="told" aria-live="off" {}
            canvas id="scene" width="1000" height="700" role="img" aria-label="the episode in its world" {}
        }
        // A tag or a comment inside the data would end the script, or keep it from ending.
        script id="episodes" type="application/json" { (PreEscaped(json.replace('<', "\\u003c"))) }
    }
}

fn made(table: &Table) -> Markup {
    html! {
        p { "From the artefacts of the runs alone, by " code { "cvar-game report" } " " (env!("CARGO_PKG_VERSION")) "; nothing was simulated for this page." }
        dl { @for (term, meaning) in legend(table, "green and bold") { dt { (term) } dd { (meaning) } } }
    }
}

/// What the player plays.
#[derive(Serialize)]
struct Episodes {
    scenes: BTreeMap<String, Scene>,
    runs: Vec<Played>,
}

#[derive(Serialize)]
struct Played {
    env: String,
    eta: f64,
    seed: u64,
    stored: Vec<StoredEpisode>,
}

/// A world's look: lengths in cells or metres.
#[derive(Serialize)]
struct Scene {
    size: [f64; 2],
    areas: Vec<Area>,
    /// From a place to its middle: half a cell, or 0 for the centre of a body.
    offset: f64,
}

#[derive(Serialize)]
struct Area {
    kind: &'static str,
    min: [f64; 2],
    max: [f64; 2],
}

impl Episodes {
    fn read(groups: &[Group]) -> Result<Episodes, ReportError> {
        let mut episodes = Episodes { scenes: BTreeMap::new(), runs: Vec::new() };
        for group in groups {
            let mut played = 0;
            for run in group.runs {
                let exhibits = archive::exhibits(run)?;
                let Some(exhibits) =
                    exhibits.filter(|of| played < PLAYED_SEEDS && !of.stored.is_empty())
                else {
                    continue;
                };
                let world = archive::world(&run.folder.join("config.toml"))?;
                let Some(scene) = world.and_then(|(world, _)| Scene::of(&world)) else { continue };
                episodes.scenes.entry(run.env.clone()).or_insert(scene);
                let (env, stored) = (run.env.clone(), exhibits.stored);
                episodes.runs.push(Played { env, eta: run.eta, seed: run.seed, stored });
                played += 1;
            }
        }
        Ok(episodes)
    }
}

impl Scene {
    fn of(world: &WorldConfig) -> Option<Scene> {
        match world {
            WorldConfig::LavaGrid(config) => {
                let grid = LavaGrid::new(config, 1).ok()?;
                let kind = |cell| match () {
                    () if grid.is_lava(cell) => Some("lava"),
                    () if grid.is_goal(cell) => Some("goal"),
                    () if grid.is_wall(cell) => Some("wall"),
                    () => None,
                };
                let area = |cell| {
                    let (x, y) = grid.coordinates(cell);
                    let min = [x as f64, y as f64];
                    Some(Area { kind: kind(cell)?, min, max: min.map(|side| side + 1.0) })
                };
                Some(Scene {
                    size: [grid.width() as f64, grid.height() as f64],
                    areas: (0..grid.cells()).filter_map(area).collect(),
                    offset: 0.5,
                })
            }
            WorldConfig::LavaPoint(config) => Some(Scene {
                size: config.arena,
                areas: [("lava", config.lava), ("goal", config.goal)]
                    .map(|(kind, area)| Area { kind, min: area.min, max: area.max })
                    .into(),
                offset: 0.0,
            }),
        }
    }
}
