//! The results that the verbs print, as text or as JSON.

use crate::experiment::artefacts::{Chance, Evaluation, Play};
use crate::experiment::names::RunId;
use crate::game::budget::Eta;
use crate::game::returns::ReturnLaw;
use crate::learn::policy::Mode;
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
    mean: f64,
    /// Pairs of alpha and CVaR_alpha.
    cvar: Vec<(f64, f64)>,
    lava: f64,
    goal: f64,
    timeout: f64,
    /// The law of the return itself, atom by atom.
    law: ReturnLaw,
}

impl Plays {
    /// Of the plays of a run, with the CVaR at these levels.
    pub fn new(run: &RunId, plays: &[Play], alphas: &[f64]) -> Self {
        let summary = |play: &Play| PlaySummary {
            protagonist: play.protagonist,
            chance: play.chance,
            episodes: play.law.episodes(),
            mean: play.law.mean(),
            cvar: alphas.iter().map(|&alpha| (alpha, play.law.cvar(alpha))).collect(),
            lava: play.law.probability(End::Lava),
            goal: play.law.probability(End::Goal),
            timeout: play.law.probability(End::Timeout),
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
                Some(episodes) => format!("{episodes} episodes"),
                None => "exact".to_owned(),
            };
            writeln!(f, "\n{protagonist} protagonist {chance}, {source}")?;
            writeln!(f, "  mean      {:>8.4}", play.mean)?;
            for &(alpha, cvar) in &play.cvar {
                writeln!(f, "  {:<9} {cvar:>8.4}", format!("CVaR_{}", short(alpha)))?;
            }
            for (end, share) in
                [("goal", play.goal), ("lava", play.lava), ("timeout", play.timeout)]
            {
                writeln!(f, "  {end:<9} {share:>8.4}")?;
            }
        }
        Ok(())
    }
}
