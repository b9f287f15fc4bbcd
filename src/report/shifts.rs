//! Model error: trained policies, judged in worlds whose constants are not those of their training. The paper's claim
//! that an antagonist makes a policy robust to such errors is tested here.

use super::figures::{self, Figure, Line};
use super::runs::{Run, Runs, csv_text, number};
use super::{Optimum, ReportError, Worlds, persist, persist_figure, statistics};
use crate::experiment::config::{Shift, as_toml};
use crate::experiment::names::as_file;
use crate::game::returns::ReturnLaw;
use lava_envs::End;
use std::path::Path;

/// What is judged unless something else is asked for.
pub const USUAL: [&str; 4] = [
    "lava-grid.slip=0.01,0.02,0.05,0.1,0.15,0.2",
    "lava-point.noise=0.5,1,1.5,2,2.5",
    "lava-point.acceleration=1.5,2,2.5,3,3.5",
    "lava-point.velocity_retention=0.3,0.4,0.5,0.6,0.7",
];

/// A run in a world with another constant.
struct Judged<'a> {
    run: &'a Run,
    constant: &'a str,
    value: f64,
    law: ReturnLaw,
    /// The best CVaR_{1/eta} there, where it is known.
    optimum: Option<f64>,
}

impl Judged<'_> {
    /// CVaR_{1/eta}; `None` if its tail holds too few episodes.
    fn cvar(&self) -> Option<f64> {
        statistics::cvar(&self.law, self.run.alpha())
    }
}

/// The law of the return of a run's greedy protagonist under these constants, or why there is none.
pub type Judge<'a> = dyn Fn(&Run, &toml::Table) -> Result<ReturnLaw, String> + 'a;

/// The runs of a folder, and the shifts under which they are to be judged.
#[derive(Debug)]
pub struct Shifted<'a> {
    dir: &'a Path,
    shifts: &'a [Shift],
    runs: Runs,
}

impl<'a> Shifted<'a> {
    /// The runs of a folder under these shifts.
    ///
    /// # Errors
    /// If the folder cannot be read.
    pub fn read(
        dir: &'a Path,
        shifts: &'a [Shift],
        worlds: &dyn Worlds,
    ) -> Result<Self, ReportError> {
        Ok(Shifted { dir, shifts, runs: Runs::read(dir, worlds)? })
    }

    /// Number of judgements that [`Shifted::write`] makes: every run under every shift of its world.
    pub fn judgements(&self) -> usize {
        self.work().count()
    }

    fn work(&self) -> impl Iterator<Item = (&Run, &Shift, f64)> {
        self.runs.runs.iter().filter(|run| run.evaluation.is_some()).flat_map(|run| {
            let here = self.shifts.iter().filter(|shift| shift.world == run.name.world);
            here.flat_map(move |shift| shift.values.iter().map(move |&value| (run, shift, value)))
        })
    }

    /// Judges; writes `shifts.csv` and the figures, and answers with what a reader must know. `judged` is called
    /// after each run and value.
    ///
    /// # Errors
    /// If the folder cannot be written, or no run can be judged.
    pub fn write(
        &self,
        worlds: &dyn Worlds,
        judge: &Judge<'_>,
        judged: &dyn Fn(),
    ) -> Result<Vec<String>, ReportError> {
        let dir = self.dir;
        let mut notes = self.runs.notes.clone();
        let (mut found, mut refused) = (Vec::new(), Vec::new());
        for (run, shift, value) in self.work() {
            let mut constants = run.settings.task.constants.clone();
            constants.insert(shift.constant.clone(), as_toml(value));
            match judge(run, &constants) {
                Ok(law) => {
                    let (task, eta) = (&run.settings.task, run.name.eta);
                    let best = worlds.optimum(&run.name.world, &constants, task.gamma, eta);
                    let optimum = match best {
                        Optimum::Known(best) => Some(best.cvar(run.alpha())),
                        _ => None,
                    };
                    found.push(Judged { run, constant: &shift.constant, value, law, optimum });
                }
                Err(why) => refused.push((&run.name, why)),
            }
            judged();
        }
        refused.dedup();
        if found.is_empty() {
            let none = || "it has no runs of these worlds".to_owned();
            let what = refused.first().map_or_else(none, |(_, why)| why.clone());
            return Err(ReportError::NotJudged { dir: dir.to_path_buf(), what });
        }
        notes.extend(refused.iter().map(|(run, why)| format!("LEFT OUT: {run}, {why}.")));
        persist(&dir.join("shifts.csv"), to_csv(&found).as_bytes())?;
        for figure in drawn(&found) {
            persist_figure(dir, &figure)?;
        }
        Ok(notes)
    }
}

/// A line per run and value; `cvar` is empty where its tail holds fewer than ten episodes. `optimum` is the best CVaR_{1/eta} under that value, exact in finite worlds.
fn to_csv(judged: &[Judged<'_>]) -> String {
    let header = [
        "env", "method", "variant", "eta", "seed", "constant", "value", "mean", "cvar", "goal",
        "lava", "episodes", "optimum",
    ]
    .map(str::to_owned);
    let row = |of: &Judged<'_>| {
        let (name, law) = (&of.run.name, &of.law);
        vec![
            name.world.clone(),
            name.method.clone(),
            name.variant.clone().unwrap_or_default(),
            name.eta.to_string(),
            name.seed.to_string(),
            of.constant.to_owned(),
            of.value.to_string(),
            number(Some(law.mean())),
            number(of.cvar()),
            number(Some(law.probability(End::Goal))),
            number(Some(law.probability(End::Lava))),
            law.episodes().map_or("exact".to_owned(), |episodes| episodes.to_string()),
            number(of.optimum),
        ]
    };
    csv_text(std::iter::once(header.to_vec()).chain(judged.iter().map(row)))
}

/// A figure per world, constant and eta, with a line per method.
fn drawn(judged: &[Judged<'_>]) -> Vec<Figure> {
    let key = |of: &Judged<'_>| {
        (of.run.name.world.clone(), of.constant.to_owned(), of.run.name.eta.to_string())
    };
    let mut keys: Vec<_> = judged.iter().map(key).collect();
    keys.sort();
    keys.dedup();
    let figure = |(world, constant, eta): (String, String, String)| {
        let here: Vec<&Judged<'_>> = judged
            .iter()
            .filter(|of| key(of) == (world.clone(), constant.clone(), eta.clone()))
            .collect();
        let name = |of: &Judged<'_>| {
            let label = of.run.name.label();
            of.run.label.as_ref().map_or(label.clone(), |own| format!("{label}, {own}"))
        };
        let mut names: Vec<String> = here.iter().map(|of| name(of)).collect();
        names.dedup();
        let line = |title: &String| {
            let mut seeds: Vec<(u64, Vec<(f64, f64)>)> = Vec::new();
            for of in here.iter().filter(|of| name(of) == *title) {
                let Some(cvar) = of.cvar() else { continue };
                let (seed, point) = (of.run.name.seed, (of.value, cvar));
                match seeds.iter_mut().find(|(known, _)| *known == seed) {
                    Some((_, points)) => points.push(point),
                    None => seeds.push((seed, vec![point])),
                }
            }
            let seeds = seeds.into_iter().map(|(_, points)| points).collect();
            Line { title: title.clone(), seeds }
        };
        let lines: Vec<Line> = names.iter().map(line).collect();
        let mut optima: Vec<(f64, f64)> =
            here.iter().filter_map(|of| Some((of.value, of.optimum?))).collect();
        optima.sort_by(|a, b| a.0.total_cmp(&b.0));
        optima.dedup();
        // One value is no line.
        if optima.len() < 2 {
            optima.clear();
        }
        let trained = here[0].run.settings.task.constants.get(&constant);
        let trained = trained
            .map_or(String::new(), |value| format!(" All were trained with {constant} = {value}."));
        let picture = figures::lines(&lines, &optima, (&constant, "CVaR_1/eta"))?;
        let mut caption = format!(
            "CVaR_1/eta of the greedy protagonist at eta = {eta} where {constant} is another than in training.{trained} \
             Line: mean over seeds; band: lowest and highest seed."
        );
        if !optima.is_empty() {
            caption += " Dashed: the best policy of each value.";
        }
        Some(Figure {
            name: format!("{}-{constant}-eta-{eta}", as_file(&world)),
            world: world.clone(),
            title: format!("{world}, eta = {eta}: another {constant} than in training"),
            caption,
            picture,
        })
    };
    keys.into_iter().filter_map(figure).collect()
}
