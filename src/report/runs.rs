//! Every run below a results folder, and `runs.csv`.
//!
//! A run is a folder `WORLD/METHOD[/VARIANT]/eta-E/seed-N` below the results folder, or a part of its
//! archive ([`crate::experiment::archive`]); `WORLD/eta-E/seed-N` is one of the method `game`. With an
//! `evaluation.json` it is finished; without one it has failed if its `manifest.json` says so, and is in
//! progress otherwise: left out, with a note. A failed run stays a row, so that failures show.
//! A run with a damaged file is left out, too, and the note names the file.
//!
//! Results of other programs enter the same tables without a `manifest.json`: with an
//! `evaluation.json`, or simply with an `episodes.csv`, which has a line per episode and these columns
//! in any order (at most 64 MiB, some three million episodes):
//!
//! | column | meaning |
//! |---|---|
//! | `return` | the return J of the episode |
//! | `steps` | its length |
//! | `end` | `goal`, `lava` or `timeout` |
//! | `protagonist` | `greedy` or `sampled`; may be left out: `greedy` |
//! | `chance` | who decided the outcomes: `nominal`, `antagonist` (the learned one) or `exact` (the worst case); may be left out: `nominal` |
//! | `clearance` | least distance to lava in the episode; may be left out |
//!
//! A return that the world cannot have, more steps than its time limit and a clearance that is no distance
//! are refused. Their regret is computed here, where the optimum is known: exactly, or by a certificate that
//! comes with the program. A `config.toml` beside the episodes may say which task they are of
//! ([`super::settings`]).
//!
//! Runs of one method, variant, world and eta whose task or training differ are not of one row; each has a
//! label that says what differs, such as `slip=0.3`.
//!
//! `runs.csv`, ordered by method, variant, world, eta and seed; alpha = 1/eta; numbers with six decimals; an empty
//! field is a number that does not exist (say, a certificate where the world has no yardstick) or a
//! CVaR whose tail holds fewer than ten recorded episodes. The columns from `class_regret` to `exploitability`
//! are left out where no run has one of them, as in results of former versions:
//!
//! | column | meaning |
//! |---|---|
//! | `env`, `eta`, `seed` | which run |
//! | `method`, `variant` | after `env`, where there are other runs than those of the method `game` without a variant |
//! | `settings` | after them, where runs of one method, variant and world differ in their settings: the label |
//! | `status` | `finished`, `failed` (the run stopped with an error), or `no goal`: its greedy protagonist reaches the goal in fewer than half of its episodes, though the best policy that is known does (or none is known) |
//! | `steps`, `seconds` | environment steps and seconds of training: processor time of its one thread; wall-clock time with a graphics card, and of former versions, whose manifests name no `clock` |
//! | `evaluation_seconds` | seconds of the evaluation and of the figures' data; left out where no run has them |
//! | `steps_to_close`, `seconds_to_close` | environment steps and seconds of training when the regret was first measured to be at most 0.05; left out where no run has them |
//! | `greedy_mean`, `greedy_cvar` | mean and CVaR_alpha of the return J, greedy protagonist, nominal chance |
//! | `greedy_lava`, `greedy_goal`, `greedy_timeout` | shares of its episodes that end so |
//! | `greedy_cvar_0.04`, `greedy_cvar_0.01` | its CVaR at alpha = 0.04 and 0.01 |
//! | `greedy_var` | its VaR_alpha, the alpha-quantile of J |
//! | `greedy_steps_to_goal` | mean length in steps of its episodes that reach the goal |
//! | `greedy_clearance` | mean over its episodes of the least distance to lava (grid: cells, point: m) |
//! | `sampled_mean`, `sampled_cvar`, `sampled_lava`, `sampled_cvar_0.04`, `sampled_cvar_0.01` | the same of the sampled protagonist |
//! | `game_value`, `game_value_se` | mean return of the sampled protagonist under its antagonist, and its standard error; at eta = 1, where the antagonist is powerless, `sampled_mean` |
//! | `greedy_game_value` | mean return of the greedy protagonist under its antagonist; at eta = 1 `greedy_mean` |
//! | `bound_slack` | `game_value - sampled_cvar`, not below 0 but for sampling error: else the budget leaks |
//! | `regret`, `regret_se` | V*(eta) - greedy CVaR_alpha (lava-point: the oracle's certified CVaR in place of V*), and its standard error |
//! | `antagonist_gap`, `antagonist_gap_se` | greedy game value - greedy CVaR_alpha, and its standard error |
//! | `class_regret` | CVaR_alpha of the best stationary policy found - greedy CVaR_alpha, where the protagonist does not see the time; exact |
//! | `response_gain`, `response_error` | mean return of the best response to the antagonist - V*(eta), and an estimate of its numerical error |
//! | `exploitability` | the larger one of `regret` and `response_gain` |
//! | `budget_use` | max over audited trajectories of prod delta / eta, at most 1 |
//! | `budget_violations` | steps or trajectories beyond tolerance, 0 |

use super::settings::{self, Settings, Task};
use super::{Optimum, ReportError, Worlds, statistics};
use crate::exact::yardstick::Exploitability;
use crate::experiment::archive::{FIRST_METHOD, RunFiles, RunName, Store};
use crate::experiment::artefacts::{
    Audit, Certificate, Chance, Close, Evaluation, Manifest, Play, SCHEMA,
};
use crate::experiment::clock::Clock;
use crate::experiment::registry::Limits;
use crate::game::returns::{Atom, ReturnLaw};
use crate::learn::policy::Mode;
use lava_envs::End;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use std::path::Path;

/// The name of reference rows of certified controllers.
pub(super) const ORACLE: &str = "oracle";

/// A run that has ended.
#[derive(Debug, Clone)]
pub struct Run {
    /// World, method, variant, eta and seed.
    pub name: RunName,
    /// Why it failed, if it did.
    pub failure: Option<String>,
    /// Environment steps of training.
    pub steps: u64,
    /// Seconds of training.
    pub seconds: f64,
    /// What the evaluation found; a failed run may have none.
    pub evaluation: Option<Evaluation>,
    /// Whether it counts as one: it has no evaluation, or its greedy protagonist does not reach the goal in half of its
    /// episodes, though the best policy that is known does (or none is known).
    pub failed: bool,
    /// The least and the greatest return of its task, where they are known.
    pub returns: Option<[f64; 2]>,
    /// How far it is from the optimum.
    pub regret: Regret,
    /// What it was trained and evaluated on.
    pub settings: Settings,
    /// What tells it apart from runs of the same method, variant and world with other settings.
    pub label: Option<String>,
    /// Where it comes from; results of other programs do not say.
    pub manifest: Option<Manifest>,
    /// Its files.
    pub files: RunFiles,
}

/// V*(eta) - CVaR_{1/eta} of the greedy protagonist under nominal chance.
#[derive(Debug, Clone, PartialEq)]
pub enum Regret {
    /// It is known.
    Known {
        /// The regret.
        value: f64,
        /// Its standard error; 0 where it is exact.
        standard_error: f64,
    },
    /// The program comes without a certificate for it.
    NotShipped,
    /// The optimum cannot be computed, for this reason.
    Refused(String),
    /// The world has no yardstick, or the run no CVaR.
    None,
}

impl Regret {
    /// The regret and its standard error.
    pub fn known(&self) -> Option<(f64, f64)> {
        match *self {
            Regret::Known { value, standard_error } => Some((value, standard_error)),
            _ => None,
        }
    }
}

impl Run {
    /// Risk level alpha = 1/eta.
    pub fn alpha(&self) -> f64 {
        1.0 / self.name.eta
    }

    /// The return's law of this kind of play, the exact one if there are several.
    pub fn law(&self, protagonist: Mode, chance: Chance) -> Option<&ReturnLaw> {
        let law = |exact: bool| {
            self.plays(protagonist, chance)
                .map(|play| &play.law)
                .find(|law| law.episodes().is_none() == exact)
        };
        law(true).or_else(|| law(false))
    }

    /// Under its antagonist; at eta = 1, where the antagonist has no power, the nominal law.
    pub fn game_law(&self, protagonist: Mode) -> Option<&ReturnLaw> {
        let nominal = || self.law(protagonist, Chance::Nominal).filter(|_| self.name.eta == 1.0);
        self.law(protagonist, Chance::Antagonist).or_else(nominal)
    }

    /// Mean least distance to lava of the greedy protagonist under nominal chance.
    pub fn clearance(&self) -> Option<f64> {
        self.plays(Mode::Greedy, Chance::Nominal).find_map(|play| play.mean_clearance)
    }

    /// When it came close to the optimum.
    pub fn close(&self) -> Option<Close> {
        self.manifest.as_ref()?.close
    }

    /// Which time its seconds are of; `None` where it is not known.
    pub fn clock(&self) -> Option<Clock> {
        self.manifest.as_ref()?.clock
    }

    /// Seconds of the evaluation and of the figures' data.
    pub fn evaluation_seconds(&self) -> Option<f64> {
        self.manifest.as_ref()?.evaluation_seconds
    }

    fn plays(&self, protagonist: Mode, chance: Chance) -> impl Iterator<Item = &Play> {
        let plays = self.evaluation.iter().flat_map(|evaluation| &evaluation.plays);
        plays.filter(move |play| play.protagonist == protagonist && play.chance == chance)
    }
}

/// What the columns of `runs.csv` are computed from.
struct Facts<'a> {
    run: &'a Run,
    greedy: Option<&'a ReturnLaw>,
    sampled: Option<&'a ReturnLaw>,
    game: Option<&'a ReturnLaw>,
    certificate: Option<Certificate>,
    audit: Option<Audit>,
}

impl<'a> Facts<'a> {
    fn of(run: &'a Run) -> Self {
        Facts {
            run,
            greedy: run.law(Mode::Greedy, Chance::Nominal),
            sampled: run.law(Mode::Sampled, Chance::Nominal),
            game: run.game_law(Mode::Sampled),
            certificate: run.evaluation.as_ref().and_then(|evaluation| evaluation.certificate),
            audit: run.evaluation.as_ref().and_then(|evaluation| evaluation.audit),
        }
    }

    fn class_regret(&self) -> Option<f64> {
        self.certificate?.class_regret
    }

    fn exploitability(&self) -> Option<Exploitability> {
        self.certificate?.exploitability
    }

    /// CVaR at the run's own level.
    fn own_cvar(&self, law: Option<&ReturnLaw>) -> Option<f64> {
        cvar(law, self.run.alpha())
    }
}

fn mean(law: Option<&ReturnLaw>) -> Field {
    Field::Number(law.map(ReturnLaw::mean))
}

fn cvar(law: Option<&ReturnLaw>, alpha: f64) -> Option<f64> {
    law.and_then(|law| statistics::cvar(law, alpha))
}

fn share(law: Option<&ReturnLaw>, end: End) -> Field {
    Field::Number(law.map(|law| law.probability(end)))
}

/// A field of `runs.csv`.
enum Field {
    Text(String),
    Count(Option<u64>),
    Number(Option<f64>),
}

impl Field {
    fn text(self) -> String {
        match self {
            Field::Text(text) => text,
            Field::Count(count) => count.map(|count| count.to_string()).unwrap_or_default(),
            Field::Number(value) => number(value),
        }
    }
}

/// A column of `runs.csv`: its name, and how a run fills it.
type Column = (&'static str, fn(&Facts) -> Field);

/// The columns that say of which method a run is; left out where all runs are plain ones of `game`.
const METHOD_COLUMNS: [Column; 2] = [
    ("method", |of| Field::Text(of.run.name.method.clone())),
    ("variant", |of| Field::Text(of.run.name.variant.clone().unwrap_or_default())),
];

/// The column that tells runs of one method apart by their settings, where there are such.
const SETTINGS_COLUMN: Column =
    ("settings", |of| Field::Text(of.run.label.clone().unwrap_or_default()));

/// Groups of columns that runs of former versions do not fill; one is left out where no run fills any of it.
const LATER_COLUMNS: [&[&str]; 3] = [
    &["evaluation_seconds"],
    &["steps_to_close", "seconds_to_close"],
    &["class_regret", "response_gain", "response_error", "exploitability"],
];

/// The other columns, in order.
const COLUMNS: [Column; 38] = [
    ("env", |of| Field::Text(of.run.name.world.clone())),
    ("eta", |of| Field::Text(of.run.name.eta.to_string())),
    ("seed", |of| Field::Count(Some(of.run.name.seed))),
    ("status", |of| {
        let (stopped, failed) = (of.run.failure.is_some(), of.run.failed);
        Field::Text(
            if stopped {
                "failed"
            } else if failed {
                "no goal"
            } else {
                "finished"
            }
            .to_owned(),
        )
    }),
    ("steps", |of| Field::Count(Some(of.run.steps))),
    ("seconds", |of| Field::Number(Some(of.run.seconds))),
    ("evaluation_seconds", |of| Field::Number(of.run.evaluation_seconds())),
    ("steps_to_close", |of| Field::Count(of.run.close().map(|of| of.steps))),
    ("seconds_to_close", |of| Field::Number(of.run.close().map(|of| of.seconds))),
    ("greedy_mean", |of| mean(of.greedy)),
    ("greedy_cvar", |of| Field::Number(of.own_cvar(of.greedy))),
    ("greedy_lava", |of| share(of.greedy, End::Lava)),
    ("greedy_goal", |of| share(of.greedy, End::Goal)),
    ("greedy_timeout", |of| share(of.greedy, End::Timeout)),
    ("greedy_cvar_0.04", |of| Field::Number(cvar(of.greedy, 0.04))),
    ("greedy_cvar_0.01", |of| Field::Number(cvar(of.greedy, 0.01))),
    ("greedy_var", |of| {
        // Where the tail is too thin for a CVaR, it is for a quantile, too.
        let greedy = of.greedy.filter(|_| of.own_cvar(of.greedy).is_some());
        Field::Number(greedy.map(|law| law.var(of.run.alpha())))
    }),
    ("greedy_steps_to_goal", |of| Field::Number(of.greedy.and_then(ReturnLaw::steps_to_goal))),
    ("greedy_clearance", |of| Field::Number(of.run.clearance())),
    ("sampled_mean", |of| mean(of.sampled)),
    ("sampled_cvar", |of| Field::Number(of.own_cvar(of.sampled))),
    ("sampled_lava", |of| share(of.sampled, End::Lava)),
    ("sampled_cvar_0.04", |of| Field::Number(cvar(of.sampled, 0.04))),
    ("sampled_cvar_0.01", |of| Field::Number(cvar(of.sampled, 0.01))),
    ("game_value", |of| mean(of.game)),
    ("game_value_se", |of| Field::Number(of.game.map(ReturnLaw::mean_standard_error))),
    ("greedy_game_value", |of| mean(of.run.game_law(Mode::Greedy))),
    ("bound_slack", |of| {
        let (value, cvar) = (of.game.map(ReturnLaw::mean), of.own_cvar(of.sampled));
        Field::Number(value.zip(cvar).map(|(value, cvar)| value - cvar))
    }),
    ("regret", |of| Field::Number(of.run.regret.known().map(|(regret, _)| regret))),
    ("regret_se", |of| Field::Number(of.run.regret.known().map(|(_, error)| error))),
    ("antagonist_gap", |of| Field::Number(of.certificate.map(|of| of.antagonist_gap))),
    ("antagonist_gap_se", |of| {
        Field::Number(of.certificate.map(|of| of.antagonist_gap_standard_error))
    }),
    ("class_regret", |of| Field::Number(of.class_regret())),
    ("response_gain", |of| Field::Number(of.exploitability().map(|of| of.response_gain))),
    ("response_error", |of| Field::Number(of.exploitability().map(|of| of.response_error))),
    ("exploitability", |of| Field::Number(of.exploitability().map(|of| of.epsilon))),
    ("budget_use", |of| Field::Number(of.audit.map(|of| of.max_budget_use))),
    ("budget_violations", |of| Field::Count(of.audit.map(|of| of.violations))),
];

/// All runs of a results folder.
#[derive(Debug, Clone)]
pub struct Runs {
    /// Finished and failed runs, by method and variant (plain runs of the method `game` first), world, eta
    /// and seed. Never empty.
    pub runs: Vec<Run>,
    /// What is best for each task of the runs at each of its budgets, and the risk-neutral best measured there:
    /// runs that nothing trained, without a seed of their own.
    pub references: Vec<Run>,
    /// What was found and left out.
    pub notes: Vec<String>,
}

impl Runs {
    /// Reads the runs of a results folder, from their folders and from its archive. A run with a file
    /// that cannot be read, or is not what it should be, is left out, and a note names the file; so is an
    /// archive.
    ///
    /// # Errors
    /// If there is no run, none can be read, or the folder cannot be read.
    pub fn read(dir: &Path, worlds: &dyn Worlds) -> Result<Runs, ReportError> {
        let unreadable = |path, source| ReportError::Read { path, source };
        let mut lost = None;
        let store = Store::open(dir).unwrap_or_else(|error| {
            lost = Some(unreadable(Store::archive(dir), error));
            Store::without_archive(dir)
        });
        let found = store.list().map_err(|(path, source)| unreadable(path, source))?;
        let (mut runs, mut notes) = (Vec::new(), found.notes);
        notes.extend(lost.iter().map(|error| format!("LEFT OUT: {}. {error}.", "all packed runs")));
        let mut in_progress = Vec::new();
        let mut damaged = lost;
        let mut tasks = Tasks { worlds, known: Vec::new() };
        for files in found.runs {
            let path = files.path.clone();
            match read_run(files, &mut tasks) {
                Ok(Some(run)) => runs.push(run),
                Ok(None) => in_progress.push(path),
                Err(error) => {
                    notes.push(format!("LEFT OUT: {path}. {error}."));
                    damaged.get_or_insert(error);
                }
            }
        }
        if !in_progress.is_empty() {
            notes.push(format!("Still in progress and left out: {}.", in_progress.join(", ")));
        }
        if runs.is_empty() {
            let none = || ReportError::NoRuns { dir: dir.to_path_buf(), notes };
            return Err(damaged.unwrap_or_else(none));
        }
        sort(&mut runs);
        // `eta-25` and `eta-25.0` are two folders and one experiment.
        if let Some(pair) = runs.windows(2).find(|pair| pair[0].name == pair[1].name) {
            return Err(ReportError::Corrupt {
                path: dir.join(&pair[0].name.world),
                what: format!("two folders hold {}", pair[0].name),
            });
        }
        for of_world in runs.chunk_by_mut(|a, b| line(a) == line(b)) {
            notes.extend(tell_apart(of_world));
        }
        let references = references(&runs, &mut tasks);
        Ok(Runs { runs, references, notes })
    }

    /// Whether all are of the method `game` without a variant and of one kind of settings, so that rows
    /// need not name them.
    pub fn are_plain(&self) -> bool {
        self.runs.iter().all(|run| run.name.is_plain() && run.label.is_none())
    }

    /// The text of `runs.csv`.
    pub fn to_csv(&self) -> String {
        let filled = |name: &&str| {
            let column = COLUMNS.iter().find(|(of, _)| of == name);
            let (_, get) = column.expect("the columns have it");
            self.runs.iter().any(|run| !get(&Facts::of(run)).text().is_empty())
        };
        let mut columns = COLUMNS.to_vec();
        for group in LATER_COLUMNS.iter().filter(|group| !group.iter().any(filled)) {
            columns.retain(|(name, _)| !group.contains(name));
        }
        if !self.are_plain() {
            columns.splice(1..1, METHOD_COLUMNS);
        }
        if self.runs.iter().any(|run| run.label.is_some()) {
            columns.insert(3, SETTINGS_COLUMN);
        }
        let header = columns.iter().map(|(name, _)| (*name).to_owned()).collect();
        let row = |run| {
            let facts = Facts::of(run);
            columns.iter().map(|(_, get)| get(&facts).text()).collect()
        };
        csv_text(std::iter::once(header).chain(self.runs.iter().map(row)))
    }
}

/// A number of a CSV file: six decimals, nothing if there is none, and no minus before a zero.
pub(super) fn number(value: Option<f64>) -> String {
    let Some(value) = value.filter(|value| value.is_finite()) else { return String::new() };
    let text = format!("{value:.6}");
    if text == "-0.000000" { text[1..].to_owned() } else { text }
}

/// Lines of fields as CSV.
pub(super) fn csv_text(rows: impl IntoIterator<Item = Vec<String>>) -> String {
    let mut writer = csv::Writer::from_writer(Vec::new());
    for row in rows {
        writer.write_record(&row).expect("rows of one length go into memory");
    }
    let bytes = writer.into_inner().expect("memory takes every byte");
    String::from_utf8(bytes).expect("fields are text")
}

/// What names a row beside its eta and its label: plain runs of `game` come first.
fn line(run: &Run) -> (bool, &str, Option<&str>, &str) {
    let of = &run.name;
    (of.method != FIRST_METHOD, &of.method, of.variant.as_deref(), &of.world)
}

/// By method and variant, world, eta and seed.
fn sort(runs: &mut [Run]) {
    runs.sort_by(|a, b| {
        let (a_name, b_name) = (&a.name, &b.name);
        (line(a).cmp(&line(b)))
            .then(a_name.eta.total_cmp(&b_name.eta))
            .then(a_name.seed.cmp(&b_name.seed))
    });
}

/// Gives runs of one method, variant and world whose settings differ their labels and sorts them by these;
/// a note says so.
fn tell_apart(runs: &mut [Run]) -> Option<String> {
    // One of each kind.
    let mut kinds: Vec<&Settings> = Vec::new();
    let mut places = Vec::new();
    for run in runs.iter() {
        let known = kinds.iter().position(|kind| kind.are_alike(&run.settings));
        places.push(known.unwrap_or_else(|| {
            kinds.push(&run.settings);
            kinds.len() - 1
        }));
    }
    if kinds.len() == 1 {
        return None;
    }
    let labels = settings::labels(&kinds);
    let name = &runs[0].name;
    let note = format!(
        "{}: the runs of {} in this folder differ in their settings ({}). They are in rows of their own.",
        name.world,
        name.label(),
        labels.join(" | ")
    );
    for (run, place) in runs.iter_mut().zip(&places) {
        run.label = Some(labels[*place].clone());
    }
    let order = |run: &Run| labels.iter().position(|label| run.label.as_ref() == Some(label));
    runs.sort_by_key(order); // stable: by eta and seed
    Some(note)
}

/// What the registry says of each task, asked once.
struct Tasks<'a> {
    worlds: &'a dyn Worlds,
    known: Vec<Asked>,
}

struct Asked {
    world: String,
    task: Task,
    limits: Option<Limits>,
    /// By eta.
    optima: Vec<(f64, Optimum)>,
}

impl Tasks<'_> {
    fn of(&mut self, world: &str, task: &Task) -> &mut Asked {
        let place = self.known.iter().position(|of| of.world == world && of.task == *task);
        let place = place.unwrap_or_else(|| {
            let limits = self.worlds.limits(world, &task.constants, task.gamma);
            let (world, task) = (world.to_owned(), task.clone());
            self.known.push(Asked { world, task, limits, optima: Vec::new() });
            self.known.len() - 1
        });
        &mut self.known[place]
    }

    fn limits(&mut self, world: &str, task: &Task) -> Option<Limits> {
        self.of(world, task).limits
    }

    fn optimum(&mut self, world: &str, task: &Task, eta: f64) -> &Optimum {
        let worlds = self.worlds;
        let asked = self.of(world, task);
        let place = asked.optima.iter().position(|(of, _)| *of == eta);
        let place = place.unwrap_or_else(|| {
            asked.optima.push((eta, worlds.optimum(world, &task.constants, task.gamma, eta)));
            asked.optima.len() - 1
        });
        &asked.optima[place].1
    }

    /// See [`Run::failed`].
    fn failed(&mut self, run: &Run) -> bool {
        let reaches = |law: &ReturnLaw| law.probability(End::Goal) >= 0.5;
        let Some(law) = run.law(Mode::Greedy, Chance::Nominal) else {
            return run.evaluation.is_none();
        };
        if reaches(law) {
            return false;
        }
        match self.optimum(&run.name.world, &run.settings.task, run.name.eta) {
            Optimum::Known(best) => reaches(best),
            _ => true,
        }
    }

    /// The regret of a run: as it was certified or, where it was not, by its law of the return.
    fn regret(&mut self, run: &Run) -> Regret {
        let evaluation = run.evaluation.as_ref();
        if let Some(found) = evaluation.and_then(|evaluation| evaluation.certificate) {
            let (value, standard_error) = (found.regret, found.regret_standard_error);
            return Regret::Known { value, standard_error };
        }
        let alpha = run.alpha();
        let Some(law) = run.law(Mode::Greedy, Chance::Nominal) else { return Regret::None };
        let Some(cvar) = statistics::cvar(law, alpha) else { return Regret::None };
        match self.optimum(&run.name.world, &run.settings.task, run.name.eta) {
            Optimum::Known(best) => {
                let error = law.cvar_standard_error(alpha);
                Regret::Known {
                    value: best.cvar(alpha) - cvar,
                    standard_error: error.hypot(best.cvar_standard_error(alpha)),
                }
            }
            Optimum::NotShipped => Regret::NotShipped,
            Optimum::Refused(why) => Regret::Refused(why.clone()),
            Optimum::None => Regret::None,
        }
    }
}

/// What the best risk-neutral policy's name ends with, away from eta = 1.
pub(super) const AT_NEUTRAL: &str = " at eta = 1";

/// See [`Runs::references`].
fn references(runs: &[Run], tasks: &mut Tasks) -> Vec<Run> {
    let mut references: Vec<Run> = Vec::new();
    for run in runs {
        let (world, task, eta) = (&run.name.world, &run.settings.task, run.name.eta);
        let known = |of: &Run| of.name.world == *world && of.settings.task == *task;
        if references.iter().any(|of| known(of) && of.name.eta == eta) {
            continue;
        }
        for best_at in [eta, 1.0] {
            let Optimum::Known(law) = tasks.optimum(world, task, best_at) else { continue };
            references.push(reference(run, law.clone(), best_at));
            if eta == 1.0 {
                break;
            }
        }
    }
    references
}

/// A policy that is the best at a budget, measured at that of a run of the same task.
fn reference(run: &Run, law: ReturnLaw, best_at: f64) -> Run {
    let whose = if law.episodes().is_none() { "optimum" } else { ORACLE };
    let method =
        if best_at == run.name.eta { whose.to_owned() } else { format!("{whose}{AT_NEUTRAL}") };
    let (protagonist, chance, mean_clearance) = (Mode::Greedy, Chance::Nominal, None);
    let evaluation = Evaluation {
        schema: SCHEMA,
        env: run.name.world.clone(),
        eta: run.name.eta,
        seed: 0,
        steps: 0,
        seconds: 0.0,
        plays: vec![Play { protagonist, chance, law, mean_clearance }],
        audit: None,
        certificate: None,
    };
    Run {
        name: RunName { method, variant: None, seed: 0, ..run.name.clone() },
        failure: None,
        failed: false,
        returns: None,
        steps: 0,
        seconds: 0.0,
        evaluation: Some(evaluation),
        regret: Regret::None,
        settings: run.settings.clone(),
        label: None,
        manifest: None,
        files: run.files.clone(),
    }
}

/// The run of these files; `None` while it is in progress.
fn read_run(files: RunFiles, tasks: &mut Tasks) -> Result<Option<Run>, ReportError> {
    let manifest: Option<Manifest> = read_json(&files, "manifest.json")?;
    if let Some(manifest) = &manifest {
        require_own(&files, "manifest.json", &manifest.run)?;
    }
    let settings = Settings::of(&files.name, read_text(&files, "config.toml")?, tasks.worlds)
        .map_err(|what| corrupt(&files, "config.toml", what))?;
    let limits = tasks.limits(&files.name.world, &settings.task);
    let mut file = "evaluation.json";
    let mut evaluation: Option<Evaluation> = read_json(&files, file)?;
    if evaluation.is_none() {
        file = "episodes.csv";
        evaluation = read_episodes(&files, file, limits)?;
    }
    if let Some(evaluation) = &evaluation {
        check(evaluation, &files.name, limits).map_err(|what| corrupt(&files, file, what))?;
    }
    let failure = manifest.as_ref().and_then(|manifest| manifest.failure.clone());
    if evaluation.is_none() && failure.is_none() {
        return Ok(None);
    }
    let trained = (evaluation.as_ref().map(|of| (of.steps, of.seconds)))
        .or(manifest.as_ref().map(|of| (of.steps, of.seconds)));
    let (steps, seconds) = trained.unwrap_or_default();
    let (name, label, regret) = (files.name.clone(), None, Regret::None);
    let mut run = Run {
        name,
        failure,
        failed: false,
        returns: limits.map(|limits| limits.returns),
        steps,
        seconds,
        evaluation,
        regret,
        settings,
        label,
        manifest,
        files,
    };
    run.regret = tasks.regret(&run);
    run.failed = tasks.failed(&run);
    Ok(Some(run))
}

/// Refuses a file that says that it is of another run. Former versions named no method and no variant.
pub(super) fn require_own(files: &RunFiles, file: &str, found: &str) -> Result<(), ReportError> {
    let former = found.split('/').count() == 3;
    let same = |found: RunName| {
        let place = |of: &RunName| (of.world.clone(), of.eta, of.seed);
        found == files.name || former && place(&found) == place(&files.name)
    };
    if RunName::parse(found).is_some_and(same) {
        return Ok(());
    }
    Err(corrupt(
        files,
        file,
        format!("it is of the run {found}, but this is the folder of {}", files.path),
    ))
}

/// The text of a file; `None` if there is none.
pub(super) fn read_text(files: &RunFiles, file: &str) -> Result<Option<String>, ReportError> {
    let text = read_bytes(files, file)?.map(String::from_utf8).transpose();
    text.map_err(|error| corrupt(files, file, error.to_string()))
}

pub(super) fn corrupt(files: &RunFiles, file: &str, what: String) -> ReportError {
    ReportError::Corrupt { path: files.place(file), what }
}

/// The bytes of a file; `None` if there is none.
pub(super) fn read_bytes(files: &RunFiles, file: &str) -> Result<Option<Vec<u8>>, ReportError> {
    files.read(file).map_err(|source| ReportError::Read { path: files.place(file), source })
}

/// Reads a file of ours; `None` if there is none. The version is looked at first: what another
/// version wrote is not damaged.
pub(super) fn read_json<T: DeserializeOwned>(
    files: &RunFiles,
    file: &str,
) -> Result<Option<T>, ReportError> {
    let Some(text) = read_bytes(files, file)? else { return Ok(None) };
    let corrupt = |what: String| corrupt(files, file, what);
    let value: serde_json::Value =
        serde_json::from_slice(&text).map_err(|error| corrupt(error.to_string()))?;
    let found = value.get("schema").and_then(serde_json::Value::as_u64);
    let found = found.ok_or_else(|| corrupt("it names no schema version".to_owned()))?;
    if found != u64::from(SCHEMA) {
        return Err(ReportError::Schema { path: files.place(file), found, expected: SCHEMA });
    }
    serde_json::from_value(value).map(Some).map_err(|error| corrupt(error.to_string()))
}

/// A line of `episodes.csv`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Episode {
    #[serde(rename = "return")]
    value: f64,
    steps: u32,
    end: End,
    #[serde(default = "greedy")]
    protagonist: Mode,
    #[serde(default = "nominal")]
    chance: Chance,
    clearance: Option<f64>,
}

fn greedy() -> Mode {
    Mode::Greedy
}

fn nominal() -> Chance {
    Chance::Nominal
}

/// The evaluation that the episodes of another program amount to; `None` if there is no such file.
fn read_episodes(
    files: &RunFiles,
    file: &str,
    limits: Option<Limits>,
) -> Result<Option<Evaluation>, ReportError> {
    let Some(text) = read_bytes(files, file)? else { return Ok(None) };
    let corrupt = |what: String| corrupt(files, file, what);
    let mut episodes: Vec<Episode> = Vec::new();
    let mut reader = csv::Reader::from_reader(&text[..]);
    let header = reader.headers().map_err(|error| corrupt(error.to_string()))?.clone();
    for record in reader.records() {
        let record = record.map_err(|error| corrupt(error.to_string()))?;
        let episode: Episode =
            record.deserialize(Some(&header)).map_err(|error| corrupt(error.to_string()))?;
        possible(episode.value, episode.steps, limits).and(distance(episode.clearance)).map_err(
            |what| {
                let line = record.position().map_or(0, csv::Position::line);
                corrupt(format!("line {line}: {what}"))
            },
        )?;
        episodes.push(episode);
    }
    if episodes.is_empty() {
        return Err(corrupt("it has no episodes".to_owned()));
    }
    let mut plays = Vec::new();
    for protagonist in [Mode::Greedy, Mode::Sampled] {
        for chance in [Chance::Nominal, Chance::Antagonist, Chance::Exact] {
            let of_kind = |of: &&Episode| of.protagonist == protagonist && of.chance == chance;
            let own: Vec<&Episode> = episodes.iter().filter(of_kind).collect();
            if own.is_empty() {
                continue;
            }
            let clearances: Vec<f64> = own.iter().filter_map(|of| of.clearance).collect();
            let law = ReturnLaw::recorded(own.iter().map(|of| Atom {
                value: of.value,
                undiscounted: of.value,
                steps: of.steps,
                end: of.end,
                mass: 1.0,
            }));
            let mean_clearance =
                statistics::mean(&clearances).filter(|_| clearances.len() == own.len());
            plays.push(Play { protagonist, chance, law, mean_clearance });
        }
    }
    Ok(Some(Evaluation {
        schema: SCHEMA,
        env: files.name.world.clone(),
        eta: files.name.eta,
        seed: files.name.seed,
        steps: 0,
        seconds: 0.0,
        plays,
        audit: None,
        certificate: None,
    }))
}

/// Slack of a return that another program has rounded.
const ROUNDING: f64 = 1e-3;

/// Whether an episode can have this return and this length.
fn possible(value: f64, steps: u32, limits: Option<Limits>) -> Result<(), String> {
    if !value.is_finite() {
        return Err(format!("the return {value} is no finite number"));
    }
    let Some(Limits { returns: [least, greatest], horizon }) = limits else { return Ok(()) };
    let slack = ROUNDING * (1.0 + least.abs().max(greatest.abs()));
    if !(least - slack..=greatest + slack).contains(&value) {
        return Err(format!(
            "the return {value} is impossible: with the constants of this world returns are from {least} \
             to {greatest}. If it was played with others, put a config.toml with [env.WORLD] beside it"
        ));
    }
    if !(1..=horizon).contains(&steps) {
        return Err(format!(
            "an episode of {steps} steps is impossible: the time limit is {horizon}"
        ));
    }
    Ok(())
}

/// Whether a clearance is one.
fn distance(clearance: Option<f64>) -> Result<(), String> {
    match clearance {
        Some(distance) if !(distance.is_finite() && distance >= 0.0) => Err(format!(
            "the clearance {distance} is no distance; leave the field empty where it is not known"
        )),
        _ => Ok(()),
    }
}

/// What the types of an evaluation do not promise.
fn check(evaluation: &Evaluation, name: &RunName, limits: Option<Limits>) -> Result<(), String> {
    let (env, eta, seed) = (&evaluation.env, evaluation.eta, evaluation.seed);
    if *env != name.world || eta != name.eta || seed != name.seed {
        return Err(format!("it belongs to {env}/eta-{eta}/seed-{seed}, not into this folder"));
    }
    for play in &evaluation.plays {
        let kind = format!("{:?} play under {:?} chance", play.protagonist, play.chance);
        let atoms = play.law.atoms();
        if play.law.episodes() == Some(0) || atoms.is_empty() {
            return Err(format!("{kind} has no episodes"));
        }
        if atoms
            .iter()
            .any(|atom| !atom.value.is_finite() || !(0.0..=1.0 + 1e-6).contains(&atom.mass))
        {
            return Err(format!(
                "{kind} has a return or a probability that is not a number in its range"
            ));
        }
        if atoms.windows(2).any(|pair| pair[0].value > pair[1].value) {
            return Err(format!("{kind} has returns out of order"));
        }
        let mass: f64 = atoms.iter().map(|atom| atom.mass).sum();
        if (mass - 1.0).abs() > 1e-6 {
            return Err(format!("the probabilities of the {kind} sum to {mass}, not 1"));
        }
        let sound = atoms.iter().try_for_each(|atom| possible(atom.value, atom.steps, limits));
        sound.and(distance(play.mean_clearance)).map_err(|what| format!("{kind}: {what}"))?;
    }
    Ok(())
}
