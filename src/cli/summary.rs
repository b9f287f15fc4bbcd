//! The results that the verbs print, as text or as JSON.

use crate::experiment::artefacts::{Chance, Evaluation, Play};
use crate::experiment::names::RunId;
use crate::game::budget::Eta;
use crate::game::returns::{NORMAL_95, ReturnLaw};
use crate::learn::policy::Mode;
use crate::report::statistics;
use indicatif::HumanCount;
use lava_envs::End;
use serde::Serialize;
use std::fmt::{self, Display};
use std::path::{Path, PathBuf};

/// What `train` reports about its run.
#[derive(Debug, Serialize)]
pub struct Summary {
    env: String,
    eta: f64,
    seed: u64,
    steps: u64,
    seconds: f64,
    steps_per_second: f64,
    /// Mean return of the greedy protagonist under nominal chance.
    greedy_mean: Option<f64>,
    /// Its CVaR at alpha = 1/eta.
    greedy_cvar: Option<f64>,
    folder: PathBuf,
}

impl Summary {
    /// Of the run in the folder.
    pub fn new(evaluation: &Evaluation, folder: &Path) -> Self {
        let Greedy { mean, cvar } = Greedy::of(evaluation);
        Summary {
            env: evaluation.env.clone(),
            eta: evaluation.eta,
            seed: evaluation.seed,
            steps: evaluation.steps,
            seconds: evaluation.seconds,
            steps_per_second: evaluation.steps as f64 / evaluation.seconds.max(f64::MIN_POSITIVE),
            greedy_mean: mean,
            greedy_cvar: cvar,
            folder: folder.to_owned(),
        }
    }
}

impl Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Summary { env, eta, seed, steps, seconds, steps_per_second, .. } = self;
        let greedy = Greedy { mean: self.greedy_mean, cvar: self.greedy_cvar };
        writeln!(f, "{env}, eta {eta}, seed {seed}: {}", greedy.text(*eta))?;
        writeln!(
            f,
            "{} steps in {seconds:.1} s of training, {} per second",
            HumanCount(*steps),
            HumanCount(*steps_per_second as u64)
        )?;
        writeln!(f, "written to {}", self.folder.display())
    }
}

/// The greedy protagonist's return under nominal chance.
#[derive(Debug, Clone, Copy)]
pub struct Greedy {
    mean: Option<f64>,
    cvar: Option<f64>,
}

impl Greedy {
    /// Of a finished run.
    pub fn of(evaluation: &Evaluation) -> Self {
        let law = evaluation.play(Mode::Greedy, Chance::Nominal).map(|play| &play.law);
        let alpha = Eta::new(evaluation.eta).map_or(1.0, Eta::alpha);
        Greedy { mean: law.map(|law| law.mean()), cvar: law.map(|law| law.cvar(alpha)) }
    }

    /// In words: `greedy mean 0.445, CVaR_0.04 0.131`.
    pub fn text(self, eta: f64) -> String {
        let Greedy { mean: Some(mean), cvar: Some(cvar) } = self else {
            return "no greedy play was recorded".to_owned();
        };
        format!("greedy mean {mean:.3}, CVaR_{} {cvar:.3}", short(1.0 / eta))
    }
}

/// A number with at most three significant digits.
fn short(number: f64) -> String {
    // Zeros after the decimal point are not significant digits.
    let zeros = if number > 0.0 { (-number.log10().floor()).max(1.0) - 1.0 } else { 0.0 };
    let text = format!("{number:.*}", 3 + zeros as usize);
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

/// What `evaluate` reports.
#[derive(Debug, Serialize)]
pub struct Plays {
    run: String,
    plays: Vec<PlaySummary>,
}

#[derive(Debug, Serialize)]
struct PlaySummary {
    protagonist: Mode,
    chance: Chance,
    /// Number of episodes; `None` for an exact law.
    episodes: Option<u64>,
    mean: Estimated,
    /// Pairs of alpha and CVaR_alpha; `None` where its tail holds fewer than ten recorded episodes.
    cvar: Vec<(f64, Option<Estimated>)>,
    lava: Estimated,
    goal: Estimated,
    timeout: Estimated,
    /// The law of the return itself, atom by atom.
    law: ReturnLaw,
}

/// A number with its 95 % interval, which has no width for an exact law: of means and CVaR by their standard
/// errors, of shares Wilson's.
#[derive(Debug, Clone, Copy, Serialize)]
struct Estimated {
    value: f64,
    low: f64,
    high: f64,
}

impl Estimated {
    fn normal(value: f64, standard_error: f64) -> Self {
        let half = NORMAL_95 * standard_error;
        Estimated { value, low: value - half, high: value + half }
    }

    /// The share of episodes that end so.
    fn share(law: &ReturnLaw, end: End) -> Self {
        let value = law.probability(end);
        let interval =
            law.episodes().and_then(|all| statistics::wilson(value * all as f64, all as f64));
        let (low, high) = interval.map_or((value, value), |interval| (interval.low, interval.high));
        Estimated { value, low, high }
    }
}

impl Display for Estimated {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Estimated { value, low, high } = self;
        write!(f, "{value:>8.4}")?;
        if low < high { write!(f, "  [{low:.4}, {high:.4}]") } else { Ok(()) }
    }
}

impl Plays {
    /// Of the plays of a run, with the CVaR at these levels.
    pub fn new(run: &RunId, plays: &[Play], alphas: &[f64]) -> Self {
        let cvar = |law: &ReturnLaw, alpha| {
            let value = statistics::cvar(law, alpha)?;
            Some(Estimated::normal(value, law.cvar_standard_error(alpha)))
        };
        let summary = |play: &Play| PlaySummary {
            protagonist: play.protagonist,
            chance: play.chance,
            episodes: play.law.episodes(),
            mean: Estimated::normal(play.law.mean(), play.law.mean_standard_error()),
            cvar: alphas.iter().map(|&alpha| (alpha, cvar(&play.law, alpha))).collect(),
            lava: Estimated::share(&play.law, End::Lava),
            goal: Estimated::share(&play.law, End::Goal),
            timeout: Estimated::share(&play.law, End::Timeout),
            law: play.law.clone(),
        };
        Plays { run: run.to_string(), plays: plays.iter().map(summary).collect() }
    }
}

impl Display for Plays {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}", self.run)?;
        for play in &self.plays {
            let protagonist = match play.protagonist {
                Mode::Greedy => "greedy",
                Mode::Sampled => "sampled",
            };
            let chance = match play.chance {
                Chance::Nominal => "under nominal chance",
                Chance::Antagonist => "under the learned antagonist",
                Chance::Exact => "under the exact antagonist",
            };
            let source = match play.episodes {
                Some(1) => "1 episode, 95 % intervals".to_owned(),
                Some(episodes) => format!("{episodes} episodes, 95 % intervals"),
                None => "exact".to_owned(),
            };
            writeln!(f, "\n{protagonist} protagonist {chance}, {source}")?;
            writeln!(f, "  mean      {}", play.mean)?;
            for &(alpha, cvar) in &play.cvar {
                let label = format!("CVaR_{}", short(alpha));
                match cvar {
                    Some(cvar) => writeln!(f, "  {label:<9} {cvar}")?,
                    None => {
                        let needed = (statistics::TAIL_EPISODES / alpha - 1e-9).ceil();
                        writeln!(f, "  {label:<9} needs at least {needed} episodes")?;
                    }
                }
            }
            for (end, share) in
                [("goal", play.goal), ("lava", play.lava), ("timeout", play.timeout)]
            {
                writeln!(f, "  {end:<9} {share}")?;
            }
        }
        Ok(())
    }
}
