//! Episodes that run: the same noise, met by the protagonists of the least and the greatest budget.

use super::Panel;
use super::canvas::{GOAL, LAVA, Picture, colour};
use super::maps::{Stage, stage};
use crate::experiment::figure_data::WorldData;
use lava_envs::scene::{AreaKind, Scene};
use plotters::prelude::RGBColor;
use std::fmt::Write as _;

/// Seconds of a step on the screen, and of the pause at the end.
const STEP: f64 = 0.2;
const PAUSE: f64 = 1.5;

/// The greedy protagonists of one seed at the least and the greatest budget of the first method, in the same nominal
/// episodes: an SVG that moves. `None` if there are no two such budgets.
pub(super) fn race(scene: &Scene, panels: &[(usize, &Panel)]) -> Option<(Picture, String)> {
    let first = panels.first()?.1;
    let mut method: Vec<_> =
        panels.iter().filter(|(_, panel)| panel.group.method == first.group.method).collect();
    method.sort_by(|a, b| a.1.group.eta.total_cmp(&b.1.group.eta));
    let ends = [*method.first()?, *method.last()?];
    if ends[0].1.group.eta == ends[1].1.group.eta {
        return None;
    }
    // A seed that both have.
    let seeds = ends[0].1.seeds.iter().map(|(run, _)| run.name.seed);
    let (seed, paths) = seeds
        .filter_map(|seed| Some((seed, [of_seed(ends[0].1, seed)?, of_seed(ends[1].1, seed)?])))
        .find(|(_, paths)| paths.iter().all(|paths| !paths.is_empty()))?;
    let titles = ends.map(|(_, panel)| format!("eta = {}", panel.group.eta));
    let (mut picture, stages) = stage(scene, &titles)?;
    let steps = paths.iter().flat_map(|paths| paths.iter().map(Vec::len)).max()?;
    let moving: String = (paths.iter().zip(&stages).zip(&ends))
        .flat_map(|((paths, stage), (place, _))| {
            paths.iter().map(move |path| dot(scene, stage, path, steps, colour(*place)))
        })
        .collect();
    let end = picture.svg.rfind("</svg>")?;
    picture.svg.insert_str(end, &moving);
    let caption = format!(
        "Greedy protagonists of seed {seed} in their first {} nominal episodes, which meet the same noise. A dot turns green in \
         the goal and orange in lava. {}",
        paths[0].len().min(paths[1].len()),
        scene.rules
    );
    Some((picture, caption))
}

/// The first nominal episodes of a seed.
fn of_seed<'a>(panel: &'a Panel, seed: u64) -> Option<&'a Vec<Vec<[f64; 2]>>> {
    let (_, records) = panel.seeds.iter().find(|(run, _)| run.name.seed == seed)?;
    match &records.figure_data.as_ref()?.world {
        WorldData::Plane(of) => Some(&of.trajectories),
        WorldData::Cells(_) => None,
    }
}

/// An episode as a faint line and a dot that runs along it.
fn dot(scene: &Scene, stage: &Stage, path: &[[f64; 2]], steps: usize, own: RGBColor) -> String {
    let hex = |RGBColor(r, g, b): RGBColor| format!("#{r:02X}{g:02X}{b:02X}");
    let places: Vec<(i32, i32)> = path.iter().map(|&[x, y]| stage.at(x, y)).collect();
    let Some(&(x, y)) = places.first() else { return String::new() };
    let total = STEP * (steps - 1).max(1) as f64 + PAUSE;
    let time = |step: usize| STEP * step as f64 / total;
    let ended = time(places.len() - 1);
    let list = |of: &dyn Fn(&(i32, i32)) -> i32| {
        let values: Vec<String> =
            places.iter().chain(places.last()).map(|place| of(place).to_string()).collect();
        values.join(";")
    };
    let times: Vec<String> = (0..places.len())
        .map(|step| format!("{:.4}", time(step)))
        .chain(["1".to_owned()])
        .collect();
    let times = times.join(";");
    let line: Vec<String> = places.iter().map(|(x, y)| format!("{x},{y}")).collect();
    let mut svg = format!(
        "<polyline points=\"{}\" fill=\"none\" stroke=\"{}\" stroke-opacity=\"0.25\" stroke-width=\"2\"/>\n\
         <circle cx=\"{x}\" cy=\"{y}\" r=\"8\" fill=\"{}\">",
        line.join(" "),
        hex(own),
        hex(own)
    );
    for (axis, values) in [("cx", list(&|of| of.0)), ("cy", list(&|of| of.1))] {
        let _ = write!(
            svg,
            "<animate attributeName=\"{axis}\" values=\"{values}\" keyTimes=\"{times}\" dur=\"{total:.2}s\" \
             repeatCount=\"indefinite\"/>"
        );
    }
    if let Some(colour) = path.last().and_then(|&last| ending(scene, last)) {
        let _ = write!(
            svg,
            "<animate attributeName=\"fill\" calcMode=\"discrete\" values=\"{};{}\" keyTimes=\"0;{ended:.4}\" \
             dur=\"{total:.2}s\" repeatCount=\"indefinite\"/>",
            hex(own),
            hex(colour)
        );
    }
    svg + "</circle>\n"
}

/// The colour of what an episode that ends here ended in.
fn ending(scene: &Scene, [x, y]: [f64; 2]) -> Option<RGBColor> {
    // A disc touches lava a radius away from it.
    let near = 0.02 * scene.size[0].max(scene.size[1]);
    let within = |kinds: &[AreaKind], margin: f64| {
        scene.areas.iter().filter(|area| kinds.contains(&area.kind)).any(|area| {
            x >= area.min[0] - margin
                && x <= area.max[0] + margin
                && y >= area.min[1] - margin
                && y <= area.max[1] + margin
        })
    };
    if within(&[AreaKind::Goal, AreaKind::LesserGoal], 1e-3) {
        Some(GOAL)
    } else {
        within(&[AreaKind::Lava], near).then_some(LAVA)
    }
}
