//! `report.html`: one page with everything, that needs no network and no other file.
//!
//! A figure per world that says it all, then the summary, tables, figures, a player of stored episodes, and how each number
//! was made. Worlds and methods can be chosen: what has the attribute `data-world` or `data-method` is hidden with them.

use super::Worlds;
use super::figures::{Figure, Figures, OVERVIEW, Panel, Picture};
use super::render::{columns, legend, row_headings, row_name, rows, seeds, words};
use super::runs::Run;
use super::table::{Block, Cell, Row, Table, World};
use crate::exact::walk::Walk;
use crate::experiment::artefacts::Chance;
use crate::experiment::figure_data::StoredEpisode;
use lava_envs::scene::Scene;
use maud::{DOCTYPE, Markup, PreEscaped, html};
use serde::Serialize;

/// Seeds of one world, method and eta whose episodes the player has: the page stays small.
const PLAYED_SEEDS: usize = 5;

/// The text of `report.html`.
pub fn render(
    name: &str,
    table: &Table,
    panels: &[Panel],
    figures: &Figures,
    worlds: &dyn Worlds,
) -> String {
    let episodes = Episodes::of(panels, worlds);
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
                    (choice(table))
                    nav {
                        a href="#summary" { "Summary" }
                        a href="#tables" { "Tables" }
                        a href="#figures" { "Figures" }
                        a href="#episodes-played" { "Episodes" }
                        a href="#made" { "How it was made" }
                    }
                }
                main {
                    section id="summary" { h2 { "Summary" } (summary(table, figures)) }
                    section id="tables" { h2 { "Tables" } (tables(table)) }
                    section id="figures" { h2 { "Figures" } (pictures(figures)) }
                    section id="episodes-played" { h2 { "Episodes" } (player(&episodes)) }
                    section id="made" { h2 { "How it was made" } (made(table, panels)) }
                }
                script { (PreEscaped(include_str!("page.js"))) }
            }
        }
    };
    page.into_string()
}

/// Which world and which method are shown, where there are several.
fn choice(table: &Table) -> Markup {
    let worlds: Vec<&str> = table.worlds.iter().map(|world| world.name.as_str()).collect();
    let mut methods: Vec<&str> = Vec::new();
    for row in table.worlds.iter().flat_map(|world| &world.rows).filter(|row| !row.reference) {
        if table.heading.is_some() && !methods.contains(&row.name.as_str()) {
            methods.push(&row.name);
        }
    }
    let select = |id: &str, words: &str, all: &str, names: &[&str]| {
        html! {
            label hidden[names.len() < 2] { (words) select id=(id) {
                option value="" { (all) }
                @for name in names { option { (name) } }
            } }
        }
    };
    html! {
        form id="choice" hidden[worlds.len() < 2 && methods.len() < 2] {
            (select("only-world", "world", "all worlds", &worlds))
            (select("only-method", "method", "all methods", &methods))
        }
    }
}

/// The figure of each world that says it all, the main numbers of each row in a sentence, and what a reader must know
/// before trusting them.
fn summary(table: &Table, figures: &Figures) -> Markup {
    html! {
        @for note in &table.notes { p.note { (note) } }
        p { "A protagonist learns to reach a goal past lava while an antagonist reweights chance within a budget eta. "
            "If it is deterministic and both play their best, it maximises CVaR at alpha = 1/eta: the mean of its worst returns." }
        @for world in &table.worlds {
            div data-world=(world.name) {
                h3 { (world.name) }
                @for figure in figures.drawn.iter().filter(|of| opens(of) && of.world == world.name) {
                    figure id=(figure.name) { (drawing(figure, NARROW)) }
                }
                ul { @for row in &world.rows { @if !row.reference {
                    li data-method=(row.name) { (sentence(table, row)) }
                } } }
            }
        }
    }
}

fn sentence(table: &Table, row: &Row) -> String {
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
    let method = table.heading.map_or(String::new(), |_| format!("{}, ", row.name));
    let mut text = format!("{method}eta = {} ({} {seeds})", row.eta, row.seeds);
    for (key, before, unit) in [
        ("mean", "mean return", ""),
        ("cvar", "CVaR at 1/eta", ""),
        ("gain_best_neutral", "gain over the best risk-neutral policy", ""),
        ("gain", "gain over the learned eta = 1", ""),
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
        p { "A click on a heading sorts. Green and bold: the best of its column, or not distinguishable from it." }
        @for world in &table.worlds {
            @for block in Block::ALL {
                @if !columns(world, block).is_empty() {
                    div data-world=(world.name) {
                        h3 { (world.name) ": " (block.title(world)) }
                        div.scroll tabindex="0" { (one_table(table, world, block)) }
                    }
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
                    th scope="col" { button title=(column.meaning) { (world.heading(column)) } }
                }
            } }
            tbody {
                @for row in rows(world, &columns) {
                    tr data-method=[(!row.reference).then_some(&row.name)] {
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
        @for figure in figures.drawn.iter().filter(|of| !opens(of)) {
            figure id=(figure.name) data-world=(figure.world) {
                h3 { (figure.title) }
                (drawing(figure, WIDE))
            }
        }
        @if !figures.missing.is_empty() {
            p.note { "Left out, because the runs have no data for them: " (figures.missing.join("; ")) "." }
        }
        @for note in &figures.notes { p.note { "Missing in the figures: " (note) } }
    }
}

/// Whether a page opens with a figure.
fn opens(figure: &Figure) -> bool {
    figure.name.ends_with(OVERVIEW)
}

/// Least widths of figures in pixels: of those that can be read on a phone, and of those with more to be seen.
const NARROW: u32 = 330;
const WIDE: u32 = 620;

fn drawing(figure: &Figure, least: u32) -> Markup {
    html! {
        div.scroll tabindex="0" role="img" aria-label=(figure.title) { (PreEscaped(scalable(&figure.picture, least))) }
        figcaption { (figure.caption) }
    }
}

/// Its width in pixels becomes the largest one: on a narrower page the viewBox keeps the shape.
fn scalable(Picture { svg, width }: &Picture, least: u32) -> String {
    let Some((head, rest)) = svg.split_once('>') else { return svg.clone() };
    let kept = |word: &&str| !word.starts_with("width=") && !word.starts_with("height=");
    let head: Vec<&str> = head.split(' ').filter(kept).collect();
    let style = format!("max-width:{width}px;min-width:min({width}px,{least}px)");
    format!("{} style=\"{style}\">{rest}", head.join(" "))
}

fn player(episodes: &Episodes) -> Markup {
    if episodes.runs.is_empty() {
        return html! { p.note { "No episodes were stored." } };
    }
    let json = serde_json::to_string(episodes).expect("episodes are representable as JSON");
    html! {
        p { "The greedy protagonist's episodes, the first ones and the first that end in lava. Blue arrow: the "
            "chosen action; rose arrow: the outcome of chance. In nominal episodes the likelihood ratios are those that the learned "
            "antagonist would have given to these outcomes. Beside it: another policy in the same nominal episode, with the same noise." }
        div id="player" {
            div.row {
                @for (id, words) in [("env", "world"), ("method", "method"), ("eta", "eta"), ("seed", "seed"), ("chance", "under"), ("episode", "episode")] {
                    label hidden[id == "method" && episodes.runs.iter().all(|run| run.method.is_none())] { (words) select id=(id) {} }
                }
                label { "beside" select id="beside" {} }
            }
            div.row {
                button id="play" type="button" { "Play" }
                input id="scrub" type="range" min="0" step="1" value="0" aria-label="step";
            }
            div id="stages" {
                @for (place, words) in [("", "the episode in its world"), ("beside-", "the same episode of the policy beside it")] {
                    div id=(format!("{place}stage")) {
                        output id=(format!("{place}step")) aria-live="off" {}
                        canvas id=(format!("{place}scene")) width="1000" height="700" role="img" aria-label=(words) {}
                    }
                }
            }
        }
        // A tag or a comment inside the data would end the script, or keep it from ending.
        script id="episodes" type="application/json" { (PreEscaped(json.replace('<', "\\u003c"))) }
    }
}

fn made(table: &Table, panels: &[Panel]) -> Markup {
    html! {
        p { "Only from the records of the runs, by " code { "cvar-game report" } " " (env!("CARGO_PKG_VERSION")) "; nothing was simulated for this page." }
        (origins(panels))
        (settings(panels))
        details open {
            summary { "What the columns mean" }
            dl { @for (term, meaning) in legend(table, "green and bold") { dt { (term) } dd { (meaning) } } }
        }
    }
}

/// Programs and machines that the runs come from, with the number of runs of each.
fn origins(panels: &[Panel]) -> Markup {
    let mut origins: Vec<([String; 5], usize)> = Vec::new();
    for run in panels.iter().flat_map(|panel| panel.group.runs) {
        let origin = match &run.manifest {
            None => ["of another program", "", "", "", ""].map(str::to_owned),
            Some(of) => [
                of.version.clone(),
                of.commit.clone().unwrap_or_else(|| "not built in a checkout".to_owned()),
                match &of.libtorch {
                    Some(version) => format!("{}, libtorch {version}", of.device),
                    None => of.device.clone(),
                },
                of.cpu.clone(),
                of.cores.map_or(String::new(), |cores| cores.to_string()),
            ],
        };
        match origins.iter_mut().find(|(known, _)| *known == origin) {
            Some((_, count)) => *count += 1,
            None => origins.push((origin, 1)),
        }
    }
    html! {
        details {
            summary { "Program and machine" }
            div.scroll tabindex="0" { table {
                thead { tr {
                    th scope="col" { "runs" }
                    @for title in ["version", "commit", "device", "processor", "cores"] { th.text scope="col" { (title) } }
                } }
                tbody { @for (origin, count) in &origins {
                    tr { td { (count) } @for field in origin { td.text { (field) } } }
                } }
            } }
        }
    }
}

/// The resolved configuration of each row, eta and seed apart.
fn settings(panels: &[Panel]) -> Markup {
    let mut shown: Vec<(String, &Run, &str)> = Vec::new();
    for panel in panels {
        let Some(run) = panel.group.runs.iter().find(|run| run.settings.text.is_some()) else {
            continue;
        };
        let method = panel.group.method.as_deref().unwrap_or(&run.name.method);
        let name = format!("{}, {method}", panel.group.env);
        if let Some(text) = run.settings.text.as_deref()
            && shown.iter().all(|(known, _, _)| *known != name)
        {
            shown.push((name, run, text));
        }
    }
    html! {
        @for (name, run, text) in &shown {
            details {
                summary { "Settings: " (name) }
                p { "Of the run " code { (run.files.path) } ". Its other budgets and seeds have the same task and training." }
                pre tabindex="0" { (text) }
            }
        }
    }
}

/// What the player plays.
#[derive(Serialize)]
struct Episodes {
    scenes: Vec<Scene>,
    runs: Vec<Played>,
}

#[derive(Serialize)]
struct Played {
    env: String,
    method: Option<String>,
    eta: f64,
    /// `None` of the best policy, which has no seed.
    seed: Option<u64>,
    /// Seed of the evaluation: episodes of one index meet the same noise.
    stream: Option<u64>,
    /// Place in `scenes`.
    scene: usize,
    stored: Vec<StoredEpisode>,
}

impl Episodes {
    fn of(panels: &[Panel], worlds: &dyn Worlds) -> Episodes {
        let mut episodes = Episodes { scenes: Vec::new(), runs: Vec::new() };
        let mut best: Vec<Played> = Vec::new();
        for panel in panels {
            let task = panel.task();
            let Some(scene) = worlds.scene(panel.group.env, &task.constants) else { continue };
            let stored = panel.seeds.iter().filter_map(|(run, records)| {
                let data = records.figure_data.as_ref().filter(|of| !of.stored.is_empty())?;
                Some((run, &data.stored))
            });
            let place = episodes.scenes.iter().position(|of| *of == scene);
            let place = place.unwrap_or_else(|| {
                episodes.scenes.push(scene);
                episodes.scenes.len() - 1
            });
            let shown: Vec<Played> = stored
                .take(PLAYED_SEEDS)
                .map(|(run, stored)| Played {
                    env: run.name.world.clone(),
                    method: panel.group.method.clone(),
                    eta: run.name.eta,
                    seed: Some(run.name.seed),
                    stream: run.settings.stream(),
                    scene: place,
                    stored: stored.clone(),
                })
                .collect();
            let (env, eta) = (panel.group.env, panel.group.eta);
            let stream = shown.iter().find_map(|of| of.stream);
            let known = |of: &Played| (of.scene, of.eta, of.stream) == (place, eta, stream);
            if let Some(stream) = stream
                && !best.iter().any(known)
            {
                let walks = worlds.walks(env, &task.constants, task.gamma, eta, stream);
                best.extend((!walks.is_empty()).then(|| Played {
                    env: env.to_owned(),
                    method: Some(BEST.to_owned()),
                    eta,
                    seed: None,
                    stream: Some(stream),
                    scene: place,
                    stored: walks.into_iter().map(stored_episode).collect(),
                }));
            }
            episodes.runs.extend(shown);
        }
        episodes.runs.extend(best);
        episodes
    }
}

/// What the best policy that is known is called.
const BEST: &str = "the best known";

/// An episode without an antagonist.
fn stored_episode(of: Walk) -> StoredEpisode {
    let Walk { index, end, value, path, actions, outcomes } = of;
    let (ratios, budgets) = (Vec::new(), Vec::new());
    StoredEpisode {
        chance: Chance::Nominal,
        index,
        end,
        value,
        path,
        actions,
        outcomes,
        ratios,
        budgets,
    }
}
