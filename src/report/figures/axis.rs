//! What a constant of the world does, where the runs differ in it and in no other.

use super::curves::{Line, named_lines};
use super::{Panel, Picture};
use crate::report::group::Measures;
use crate::report::{Optimum, Worlds};
use std::collections::BTreeSet;

/// A number of a run.
type Quantity<'a> = &'a dyn Fn(&Panel, &Measures) -> Option<f64>;

/// A figure's name, headline, picture and caption.
pub(super) type Drawn = (String, String, Picture, String);

/// A row of panels in which only the constant differs: one method at one budget.
struct Row<'a> {
    method: &'a str,
    eta: f64,
    /// By the constant's value, ascending.
    panels: Vec<(f64, &'a Panel<'a>)>,
}

impl Row<'_> {
    /// A line over the constant: per seed the points of all values; what is missing is not a number.
    fn seeds(&self, of: impl Fn(&Panel, &Measures) -> Option<f64>) -> Vec<Vec<(f64, f64)>> {
        let seeds: BTreeSet<u64> = (self.panels.iter())
            .flat_map(|(_, panel)| panel.group.runs.iter().map(|run| run.name.seed))
            .collect();
        let point = |seed: u64, (value, panel): &(f64, &Panel)| {
            let place = panel.group.runs.iter().position(|run| run.name.seed == seed);
            let found = place.and_then(|place| of(panel, &panel.group.measures[place]));
            (*value, found.unwrap_or(f64::NAN))
        };
        let line = |seed| self.panels.iter().map(|of| point(seed, of)).collect();
        seeds.into_iter().map(line).collect()
    }

    /// The best CVaR_1/eta of each value, as far as it is known.
    fn optima(&self, worlds: &dyn Worlds) -> Vec<(f64, f64)> {
        let best = |(value, panel): &(f64, &Panel)| {
            let task = panel.task();
            match worlds.optimum(panel.group.env, &task.constants, task.gamma, self.eta) {
                Optimum::Known(law) => Some((*value, law.cvar(panel.group.alpha()))),
                _ => None,
            }
        };
        self.panels.iter().filter_map(best).collect()
    }
}

/// The constant in which the panels of a world differ, if it is one and a number.
fn varied(panels: &[Panel]) -> Option<String> {
    let first = panels.first()?.task();
    let others = || panels.iter().map(Panel::task);
    let differs = |name: &&String| {
        others().any(|task| task.constants.get(*name) != first.constants.get(*name))
    };
    let names: BTreeSet<&String> = others().flat_map(|task| task.constants.keys()).collect();
    let found: Vec<&String> = names.into_iter().filter(differs).collect();
    let [name] = found[..] else { return None };
    let is_number = |task: &super::Task| number(task.constants.get(name)?).map(|_| ());
    let same_game = others().all(|task| task.gamma == first.gamma && is_number(task).is_some());
    same_game.then(|| name.clone())
}

fn number(value: &toml::Value) -> Option<f64> {
    value.as_float().or_else(|| value.as_integer().map(|whole| whole as f64))
}

/// Rows by method and budget, each with at least two values.
fn rows<'a>(panels: &'a [Panel<'a>], constant: &str) -> Vec<Row<'a>> {
    let mut rows: Vec<Row> = Vec::new();
    for panel in panels {
        let (method, eta) = (panel.group.runs[0].name.method.as_str(), panel.group.eta);
        let Some(value) = panel.task().constants.get(constant).and_then(number) else { continue };
        match rows.iter_mut().find(|row| row.method == method && row.eta == eta) {
            // Of several settings of training at one value the first.
            Some(row) if row.panels.iter().any(|(known, _)| *known == value) => {}
            Some(row) => row.panels.push((value, panel)),
            None => rows.push(Row { method, eta, panels: vec![(value, panel)] }),
        }
    }
    for row in &mut rows {
        row.panels.sort_by(|a, b| a.0.total_cmp(&b.0));
    }
    rows.retain(|row| row.panels.len() > 1);
    rows.sort_by(|a, b| a.eta.total_cmp(&b.eta));
    rows
}

/// CVaR_1/eta with the best there is, regret, and antagonist gap over the constant, a line per method and budget.
pub(super) fn constant(panels: &[Panel], worlds: &dyn Worlds) -> Vec<Drawn> {
    let Some(constant) = varied(panels) else { return Vec::new() };
    let rows = rows(panels, &constant);
    let one_method = rows.iter().all(|row| row.method == rows[0].method);
    let title = |row: &Row| {
        let method = if one_method { String::new() } else { format!("{}, ", row.method) };
        format!("{method}eta = {}", row.eta)
    };
    let cvar = |panel: &Panel, of: &Measures| of.cvar[panel.group.level(panel.group.alpha())];
    let quantities: [(&str, &str, Quantity<'_>); 3] = [
        ("cvar", "CVaR_1/eta", &cvar),
        ("regret", "regret", &|_, of| of.regret),
        ("gap", "antagonist gap", &|_, of| of.antagonist_gap),
    ];
    let draw = |(name, words, of): (&str, &str, Quantity<'_>)| {
        let lines: Vec<Line> =
            rows.iter().map(|row| Line { title: title(row), seeds: row.seeds(of) }).collect();
        let is_cvar = name == "cvar";
        let optima: Vec<Vec<(f64, f64)>> = (rows.iter())
            .map(|row| if is_cvar { row.optima(worlds) } else { Vec::new() })
            .collect();
        let picture = named_lines(&lines, &optima, (&constant, words))?;
        let mut caption = format!(
            "The {words} of the greedy protagonist, trained and measured at each {constant}. Line: mean over seeds; band: \
             lowest and highest seed."
        );
        if optima.iter().any(|optima| !optima.is_empty()) {
            caption += " Dashed: the best policy that is known at each value.";
        }
        Some((format!("{constant}-{name}"), format!("{words} over {constant}"), picture, caption))
    };
    quantities.into_iter().filter_map(draw).collect()
}
