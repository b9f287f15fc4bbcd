//! Every run below a results folder, and `runs.csv`.
//!
//! A run is a folder `DIR/ENV/eta-E/seed-N` ([`crate::experiment::artefacts`]). With an
//! `evaluation.json` it is finished; without one it has failed if its `manifest.json` says so, and is
//! in progress otherwise: skipped, and mentioned. A failed run stays a row, so that nobody loses it
//! from sight.
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
//! `runs.csv`, ordered by world, eta and seed; alpha = 1/eta; numbers with six decimals; an empty
//! field is a number that does not exist (say, a certificate where the world has no yardstick) or a
//! CVaR whose tail holds fewer than ten recorded episodes:
//!
//! | column | meaning |
//! |---|---|
//! | `env`, `eta`, `seed` | which run |
//! | `status` | `finished` or `failed` |
//! | `steps`, `seconds` | environment steps and wall-clock seconds of training |
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
//! | `budget_use` | max over audited trajectories of prod delta / eta, at most 1 |
//! | `budget_violations` | steps or trajectories beyond tolerance, 0 |

use super::{ReportError, statistics};
use crate::experiment::artefacts::{Chance, Evaluation, Manifest, Mode, Play, SCHEMA};
use crate::files::{LARGEST_FILE, read_at_most};
use crate::game::returns::{Atom, ReturnLaw};
use lava_envs::End;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A run that came to an end.
#[derive(Debug, Clone)]
pub struct Run {
    /// Name of the world.
    pub env: String,
    /// Budget eta.
    pub eta: f64,
    /// Seed.
    pub seed: u64,
    /// Why it failed, if it did.
    pub failure: Option<String>,
    /// Environment steps of training.
    pub steps: u64,
    /// Wall-clock seconds of training.
    pub seconds: f64,
    /// What the evaluation found; a failed run may have none.
    pub evaluation: Option<Evaluation>,
    /// Where all that lies.
    pub folder: PathBuf,
}

impl Run {
    /// Risk level alpha = 1/eta.
    pub fn alpha(&self) -> f64 {
        1.0 / self.eta
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
        let nominal = || self.law(protagonist, Chance::Nominal).filter(|_| self.eta == 1.0);
        self.law(protagonist, Chance::Antagonist).or_else(nominal)
    }

    /// Mean least distance to lava of the greedy protagonist under nominal chance.
    pub fn clearance(&self) -> Option<f64> {
        self.plays(Mode::Greedy, Chance::Nominal).find_map(|play| play.mean_clearance)
    }

    fn plays(&self, protagonist: Mode, chance: Chance) -> impl Iterator<Item = &Play> {
        let plays = self.evaluation.iter().flat_map(|evaluation| &evaluation.plays);
        plays.filter(move |play| play.protagonist == protagonist && play.chance == chance)
    }

    /// `ENV/eta-E/seed-N`.
    pub fn name(&self) -> String {
        format!("{}/eta-{}/seed-{}", self.env, self.eta, self.seed)
    }

    /// The row of `runs.csv`, field by field in the order of [`COLUMNS`].
    fn row(&self) -> Vec<String> {
        let alpha = self.alpha();
        let greedy = self.law(Mode::Greedy, Chance::Nominal);
        let sampled = self.law(Mode::Sampled, Chance::Nominal);
        let game = self.game_law(Mode::Sampled);
        let cvar =
            |law: Option<&ReturnLaw>, alpha| law.and_then(|law| statistics::cvar(law, alpha));
        let end = |law: Option<&ReturnLaw>, end| law.map(|law| law.probability(end));
        let mean = |law: Option<&ReturnLaw>| law.map(ReturnLaw::mean);
        let sampled_cvar = cvar(sampled, alpha);
        let certificate = self.evaluation.as_ref().and_then(|evaluation| evaluation.certificate);
        let audit = self.evaluation.as_ref().and_then(|evaluation| evaluation.audit);
        let count = |count: Option<u64>| count.map(|count| count.to_string()).unwrap_or_default();
        vec![
            self.env.clone(),
            self.eta.to_string(),
            self.seed.to_string(),
            if self.failure.is_some() { "failed" } else { "finished" }.to_owned(),
            self.steps.to_string(),
            number(Some(self.seconds)),
            number(mean(greedy)),
            number(cvar(greedy, alpha)),
            number(end(greedy, End::Lava)),
            number(end(greedy, End::Goal)),
            number(end(greedy, End::Timeout)),
            number(cvar(greedy, 0.04)),
            number(cvar(greedy, 0.01)),
            number(greedy.filter(|_| cvar(greedy, alpha).is_some()).map(|law| law.var(alpha))),
            number(greedy.and_then(ReturnLaw::steps_to_goal)),
            number(self.clearance()),
            number(mean(sampled)),
            number(sampled_cvar),
            number(end(sampled, End::Lava)),
            number(cvar(sampled, 0.04)),
            number(cvar(sampled, 0.01)),
            number(mean(game)),
            number(game.map(ReturnLaw::mean_standard_error)),
            number(mean(self.game_law(Mode::Greedy))),
            number(mean(game).zip(sampled_cvar).map(|(value, cvar)| value - cvar)),
            number(certificate.map(|certificate| certificate.regret)),
            number(certificate.map(|certificate| certificate.regret_standard_error)),
            number(certificate.map(|certificate| certificate.antagonist_gap)),
            number(certificate.map(|certificate| certificate.antagonist_gap_standard_error)),
            number(audit.map(|audit| audit.max_budget_use)),
            count(audit.map(|audit| audit.violations)),
        ]
    }
}

/// The columns of `runs.csv`.
pub const COLUMNS: [&str; 31] = [
    "env",
    "eta",
    "seed",
    "status",
    "steps",
    "seconds",
    "greedy_mean",
    "greedy_cvar",
    "greedy_lava",
    "greedy_goal",
    "greedy_timeout",
    "greedy_cvar_0.04",
    "greedy_cvar_0.01",
    "greedy_var",
    "greedy_steps_to_goal",
    "greedy_clearance",
    "sampled_mean",
    "sampled_cvar",
    "sampled_lava",
    "sampled_cvar_0.04",
    "sampled_cvar_0.01",
    "game_value",
    "game_value_se",
    "greedy_game_value",
    "bound_slack",
    "regret",
    "regret_se",
    "antagonist_gap",
    "antagonist_gap_se",
    "budget_use",
    "budget_violations",
];

/// All runs of a results folder.
#[derive(Debug, Clone)]
pub struct Runs {
    /// Finished and failed runs, by world, eta and seed. Never empty.
    pub runs: Vec<Run>,
    /// What was found and left out.
    pub notes: Vec<String>,
}

impl Runs {
    /// Reads `DIR/ENV/eta-E/seed-N` for all worlds, budgets and seeds.
    ///
    /// # Errors
    /// If there is no run, or a file cannot be read or is not what it should be.
    pub fn read(dir: &Path) -> Result<Runs, ReportError> {
        let mut runs = Vec::new();
        let mut notes = Vec::new();
        let mut in_progress = Vec::new();
        for (env, world) in folders(dir)? {
            for (eta_name, budget) in folders(&world)? {
                let Some(eta) = eta_name.strip_prefix("eta-") else { continue };
                let Some(eta) = eta.parse().ok().filter(|eta: &f64| *eta >= 1.0 && eta.is_finite())
                else {
                    notes.push(format!("{env}/{eta_name} left out: its name has no eta >= 1"));
                    continue;
                };
                for (seed_name, folder) in folders(&budget)? {
                    let Some(seed) = seed_name.strip_prefix("seed-") else { continue };
                    let Ok(seed) = seed.parse() else {
                        notes.push(format!(
                            "{env}/{eta_name}/{seed_name} left out: its name has no seed"
                        ));
                        continue;
                    };
                    match read_run(&folder, &env, eta, seed)? {
                        Some(run) => runs.push(run),
                        None => in_progress.push(format!("{env}/{eta_name}/{seed_name}")),
                    }
                }
            }
        }
        if !in_progress.is_empty() {
            notes.push(format!("Still in progress and left out: {}.", in_progress.join(", ")));
        }
        if runs.is_empty() {
            return Err(ReportError::NoRuns { dir: dir.to_path_buf(), notes });
        }
        runs.sort_by(|a, b| {
            a.env.cmp(&b.env).then(a.eta.total_cmp(&b.eta)).then(a.seed.cmp(&b.seed))
        });
        // `eta-25` and `eta-25.0` are two folders and one experiment.
        if let Some(pair) = runs.windows(2).find(|pair| pair[0].name() == pair[1].name()) {
            return Err(ReportError::Corrupt {
                path: dir.join(&pair[0].env),
                what: format!("two folders hold {}", pair[0].name()),
            });
        }
        Ok(Runs { runs, notes })
    }

    /// The text of `runs.csv`.
    pub fn to_csv(&self) -> String {
        let header = COLUMNS.map(str::to_owned).to_vec();
        csv_text(std::iter::once(header).chain(self.runs.iter().map(Run::row)))
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

/// Names and paths of the visible folders in `dir`, by name.
fn folders(dir: &Path) -> Result<BTreeMap<String, PathBuf>, ReportError> {
    let failed = |source| ReportError::Read { path: dir.to_path_buf(), source };
    let mut folders = BTreeMap::new();
    for entry in std::fs::read_dir(dir).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if path.is_dir() && !name.starts_with('.') {
            folders.insert(name, path);
        }
    }
    Ok(folders)
}

/// The run in a folder; `None` while it is in progress.
fn read_run(folder: &Path, env: &str, eta: f64, seed: u64) -> Result<Option<Run>, ReportError> {
    let manifest: Option<Manifest> = read_json(&folder.join("manifest.json"))?;
    let mut path = folder.join("evaluation.json");
    let mut evaluation: Option<Evaluation> = read_json(&path)?;
    if evaluation.is_none() {
        path = folder.join("episodes.csv");
        evaluation = read_episodes(&path, env, eta, seed)?;
    }
    if let Some(evaluation) = &evaluation {
        check(evaluation, env, eta, seed)
            .map_err(|what| ReportError::Corrupt { path: path.clone(), what })?;
    }
    let failure = manifest.as_ref().and_then(|manifest| manifest.failure.clone());
    if evaluation.is_none() && failure.is_none() {
        return Ok(None);
    }
    let trained = (evaluation.as_ref().map(|of| (of.steps, of.seconds)))
        .or(manifest.map(|of| (of.steps, of.seconds)));
    let (steps, seconds) = trained.unwrap_or_default();
    let (env, folder) = (env.to_owned(), folder.to_owned());
    Ok(Some(Run { env, eta, seed, failure, steps, seconds, evaluation, folder }))
}

/// Reads a file of ours; `None` if there is none. The version is looked at first: what another
/// version wrote is not damaged.
pub(super) fn read_json<T: DeserializeOwned>(path: &Path) -> Result<Option<T>, ReportError> {
    let text = match read_at_most(path, LARGEST_FILE) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(source) => return Err(ReportError::Read { path: path.to_path_buf(), source }),
    };
    let corrupt = |what: String| ReportError::Corrupt { path: path.to_path_buf(), what };
    let value: serde_json::Value =
        serde_json::from_slice(&text).map_err(|error| corrupt(error.to_string()))?;
    let found = value.get("schema").and_then(serde_json::Value::as_u64);
    let found = found.ok_or_else(|| corrupt("it names no schema version".to_owned()))?;
    if found != u64::from(SCHEMA) {
        return Err(ReportError::Schema { path: path.to_path_buf(), found, expected: SCHEMA });
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
    path: &Path,
    env: &str,
    eta: f64,
    seed: u64,
) -> Result<Option<Evaluation>, ReportError> {
    let text = match read_at_most(path, LARGEST_FILE) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(source) => return Err(ReportError::Read { path: path.to_path_buf(), source }),
    };
    let corrupt = |what: String| ReportError::Corrupt { path: path.to_path_buf(), what };
    let mut episodes: Vec<Episode> = Vec::new();
    for line in csv::Reader::from_reader(&text[..]).deserialize() {
        episodes.push(line.map_err(|error| corrupt(error.to_string()))?);
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
        env: env.to_owned(),
        eta,
        seed,
        steps: 0,
        seconds: 0.0,
        plays,
        audit: None,
        certificate: None,
    }))
}

/// What the types of an evaluation do not promise.
fn check(evaluation: &Evaluation, env: &str, eta: f64, seed: u64) -> Result<(), String> {
    let (its_env, its_eta, its_seed) = (&evaluation.env, evaluation.eta, evaluation.seed);
    if its_env != env || its_eta != eta || its_seed != seed {
        return Err(format!(
            "it belongs to {its_env}/eta-{its_eta}/seed-{its_seed}, not into this folder"
        ));
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
            return Err(format!("{kind} has a return or probability that is none"));
        }
        if atoms.windows(2).any(|pair| pair[0].value > pair[1].value) {
            return Err(format!("{kind} has returns out of order"));
        }
        let mass: f64 = atoms.iter().map(|atom| atom.mass).sum();
        if (mass - 1.0).abs() > 1e-6 {
            return Err(format!("the probabilities of the {kind} sum to {mass}, not 1"));
        }
    }
    Ok(())
}
