//! The evaluation protocol of a finished run (the final weights, never the best).
//!
//! Greedy and sampled protagonist, under nominal chance and under its antagonist. On the grid the
//! laws of the return under nominal chance are exact, computed from the weights; all others are of
//! recorded episodes, on streams that all runs share. Three numbers are never conflated: the game
//! value under the learned antagonist, the CVaR of the sampled policy, the CVaR of the greedy policy.

use super::failure::RunError;
use crate::arena::Arena;
use crate::contest::{self, Choosing, Opponent};
use crate::head::CategoricalPolicy;
use crate::pair::Pair;
use crate::play::{self, Played, Watcher};
use crate::weights;
use cvar_game::exact::antagonist::WorstCase;
use cvar_game::exact::grid::ExactGrid;
use cvar_game::exact::oracle;
use cvar_game::exact::policy::Policy;
use cvar_game::experiment::artefacts::{Audit, Certificate, Chance, Mode, Play};
use cvar_game::experiment::config::{Device, Oracle, RunConfig, WorldConfig};
use cvar_game::files::{LARGEST_FILE, read_at_most};
use lava_envs::law::{FiniteLaw, MOVES, sample_index};
use lava_envs::random::ChaCha8Rng;
use lava_envs::{ConfigError, GridConfig, LavaGrid, LavaPoint, PointConfig, World};
use std::path::Path;

/// A world that can be built from constants and may have an exact yardstick.
pub trait Yardstick: Arena + Sized {
    /// Its constants.
    type Constants;

    /// A batch of the world.
    ///
    /// # Errors
    /// If a constant is out of range.
    fn build(constants: &Self::Constants, episodes: usize) -> Result<Self, ConfigError>;

    /// Replaces laws of recorded episodes by exact ones where they can be had, and certifies.
    ///
    /// # Errors
    /// If the world cannot be solved.
    fn certify(
        constants: &Self::Constants,
        run: &RunConfig,
        pair: &Pair<Self>,
        plays: &mut [Play],
    ) -> Result<Option<Certificate>, RunError>;

    /// Lets `play` meet the exact worst-case antagonist of the greedy protagonist.
    ///
    /// # Errors
    /// If there is none for this world, or `play` fails.
    fn against_exact(
        constants: &Self::Constants,
        run: &RunConfig,
        pair: &Pair<Self>,
        play: &mut dyn FnMut(&dyn Opponent<Self>) -> Result<Played, RunError>,
    ) -> Result<Played, RunError>;
}

/// Slack of the audit: rounding of forty factors, and of the normalisation.
const TOLERANCE: f64 = 1e-6;

/// What the protocol finds of a pair.
pub struct Findings {
    /// Greedy and sampled, nominal and (eta > 1) antagonist.
    pub plays: Vec<Play>,
    /// The budget audit; `None` at eta = 1.
    pub audit: Option<Audit>,
    /// Certificates where the world has a yardstick.
    pub certificate: Option<Certificate>,
}

/// All plays of the protocol, the budget audit and the certificate.
///
/// # Errors
/// If the world refuses its constants, cannot be solved, or the budget audit finds a violation.
pub fn protocol<W: Yardstick>(
    run: &RunConfig,
    constants: &W::Constants,
    pair: &Pair<W>,
) -> Result<Findings, RunError> {
    let antagonist = pair.antagonist.is_some();
    // Nominal episodes of the sampled protagonist also carry the antagonist's ratios, for the audit.
    let nominal = if antagonist { contest::Chance::Shadowed } else { contest::Chance::Nominal };
    let mut plays = Vec::new();
    let mut played = |mode, chance, kind| -> Result<Played, RunError> {
        let episodes = play_episodes(run, constants, pair, mode, chance, &mut ())?;
        plays.push(to_play(mode, kind, &episodes));
        Ok(episodes)
    };
    played(Mode::Greedy, contest::Chance::Nominal, Chance::Nominal)?;
    let weighted = played(Mode::Sampled, nominal, Chance::Nominal)?;
    let mut audit = None;
    if antagonist {
        let greedy = played(Mode::Greedy, contest::Chance::Antagonist, Chance::Antagonist)?;
        let sampled = played(Mode::Sampled, contest::Chance::Antagonist, Chance::Antagonist)?;
        audit = Some(budget_audit(run, &[&greedy, &sampled, &weighted])?);
    }
    let certificate = W::certify(constants, run, pair, &mut plays)?;
    Ok(Findings { plays, audit, certificate })
}

/// Plays the episodes of the run's evaluation, shown to `watcher`.
pub(super) fn play_episodes<W: Yardstick>(
    run: &RunConfig,
    constants: &W::Constants,
    pair: &Pair<W>,
    mode: Mode,
    chance: contest::Chance<'_, W>,
    watcher: &mut impl Watcher<W>,
) -> Result<Played, RunError> {
    let slots = run.evaluation.parallel_episodes.min(run.evaluation.episodes as usize);
    let world = W::build(constants, slots)?;
    let choosing = match mode {
        Mode::Greedy => Choosing::Greedy,
        Mode::Sampled => Choosing::Sampled,
    };
    let setting = play::Play {
        choosing,
        chance,
        eta: run.eta,
        gamma: run.gamma,
        episodes: run.evaluation.episodes,
        seed: run.evaluation.seed,
    };
    Ok(play::play(world, pair, &setting, watcher))
}

fn to_play(protagonist: Mode, chance: Chance, played: &Played) -> Play {
    Play { protagonist, chance, law: played.law(), mean_clearance: played.mean_clearance() }
}

/// The budget audit: `[greedy, sampled]` episodes under the antagonist and the sampled protagonist's
/// nominal episodes with the antagonist's ratios.
fn budget_audit(
    run: &RunConfig,
    [greedy, sampled, weighted]: &[&Played; 3],
) -> Result<Audit, RunError> {
    let all = [greedy, sampled, weighted];
    let uses = || {
        all.iter().flat_map(|played| &played.episodes).map(|e| e.likelihood_ratio / run.eta.get())
    };
    let max_budget_use = uses().fold(0.0, f64::max);
    let max_normalisation_error =
        all.iter().map(|played| played.normalisation_error).fold(0.0, f64::max);
    let violations = uses().filter(|&used| used > 1.0 + TOLERANCE).count() as u64
        + u64::from(max_normalisation_error > TOLERANCE);
    if violations > 0 {
        return Err(RunError::Budget {
            use_of_budget: max_budget_use,
            normalisation_error: max_normalisation_error,
        });
    }
    let (antagonist_mean, antagonist_standard_error) =
        mean(sampled.episodes.iter().map(|e| e.atom.value));
    let (weighted_nominal_mean, weighted_nominal_standard_error) =
        mean(weighted.episodes.iter().map(|e| e.likelihood_ratio * e.atom.value));
    Ok(Audit {
        trajectories: all.iter().map(|played| played.episodes.len() as u64).sum(),
        max_budget_use,
        max_normalisation_error,
        violations,
        antagonist_mean,
        antagonist_standard_error,
        weighted_nominal_mean,
        weighted_nominal_standard_error,
    })
}

/// Mean and its standard error.
fn mean(values: impl Iterator<Item = f64> + Clone) -> (f64, f64) {
    let count = values.clone().count() as f64;
    let mean = values.clone().sum::<f64>() / count;
    let variance = values.map(|value| (value - mean).powi(2)).sum::<f64>() / (count - 1.0).max(1.0);
    (mean, (variance / count).sqrt())
}

/// What to play with a finished run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Request {
    /// Who decides the law of chance.
    pub chance: Chance,
    /// Episodes of each play, if not those of the run's configuration.
    pub episodes: Option<u64>,
    /// Seed of the streams, if not that of the run's configuration.
    pub seed: Option<u64>,
}

impl Request {
    /// The configuration of the run in `folder`, changed as requested.
    pub(super) fn load(&self, folder: &Path) -> Result<RunConfig, RunError> {
        tch::set_num_threads(1);
        let mut run = RunConfig::load(&folder.join("config.toml")).map_err(|error| {
            RunError::file(&folder.join("config.toml"))(std::io::Error::other(error))
        })?;
        run.evaluation.episodes = self.episodes.unwrap_or(run.evaluation.episodes);
        run.evaluation.seed = self.seed.unwrap_or(run.evaluation.seed);
        Ok(run)
    }
}

/// Plays the greedy and the sampled protagonist of the finished run in `folder`; against the exact
/// antagonist, which is that of the greedy protagonist, this one alone. Writes nothing.
///
/// # Errors
/// If the folder holds no finished run or the request makes no sense for it.
pub fn evaluate_run(folder: &Path, request: &Request) -> Result<Vec<Play>, RunError> {
    let run = request.load(folder)?;
    match &run.env {
        WorldConfig::LavaGrid(constants) => {
            answer::<LavaGrid>(&run, constants, folder, request.chance)
        }
        WorldConfig::LavaPoint(constants) => {
            answer::<LavaPoint>(&run, constants, folder, request.chance)
        }
    }
}

fn answer<W: Yardstick>(
    run: &RunConfig,
    constants: &W::Constants,
    folder: &Path,
    chance: Chance,
) -> Result<Vec<Play>, RunError> {
    let pair = load::<W>(run, folder)?;
    let modes: &[Mode] = match chance {
        Chance::Exact => &[Mode::Greedy],
        Chance::Nominal | Chance::Antagonist => &[Mode::Greedy, Mode::Sampled],
    };
    let play = |&mode| {
        let played = play_run(run, constants, &pair, mode, chance, &mut ())?;
        Ok(to_play(mode, chance, &played))
    };
    modes.iter().map(play).collect()
}

/// Plays the episodes of the run's configuration with its pair.
///
/// # Errors
/// If the run has no such antagonist.
pub(super) fn play_run<W: Yardstick>(
    run: &RunConfig,
    constants: &W::Constants,
    pair: &Pair<W>,
    mode: Mode,
    chance: Chance,
    watcher: &mut impl Watcher<W>,
) -> Result<Played, RunError> {
    let chance = match chance {
        Chance::Nominal => contest::Chance::Nominal,
        Chance::Antagonist if pair.antagonist.is_some() => contest::Chance::Antagonist,
        Chance::Antagonist => {
            return Err(RunError::NoOpponent(
                "a run at eta = 1 has no learned antagonist; use --antagonist nominal",
            ));
        }
        Chance::Exact if mode == Mode::Greedy => {
            return W::against_exact(constants, run, pair, &mut |opponent| {
                let chance = contest::Chance::Opponent(opponent);
                play_episodes(run, constants, pair, mode, chance, watcher)
            });
        }
        Chance::Exact => {
            return Err(RunError::NoOpponent(
                "the exact worst-case antagonist is that of the greedy protagonist; \
                 use --protagonist greedy",
            ));
        }
    };
    play_episodes(run, constants, pair, mode, chance, watcher)
}

/// The trained pair of a finished run.
pub(super) fn load<W: Arena>(run: &RunConfig, folder: &Path) -> Result<Pair<W>, RunError> {
    let path = folder.join("final.safetensors");
    let bytes = read_at_most(&path, LARGEST_FILE).map_err(RunError::file(&path))?;
    let device = device(run.device);
    let mut pair = Pair::<W>::new(&run.train, run.eta, run.seed, device);
    weights::load(&mut pair, &bytes, device)?;
    Ok(pair)
}

/// The device of the networks, as libtorch names it.
pub fn device(device: Device) -> tch::Device {
    match device {
        Device::Cpu => tch::Device::Cpu,
        Device::Cuda(number) => tch::Device::Cuda(number),
    }
}

impl Yardstick for LavaGrid {
    type Constants = GridConfig;

    fn build(constants: &GridConfig, episodes: usize) -> Result<Self, ConfigError> {
        LavaGrid::new(constants, episodes)
    }

    fn certify(
        constants: &GridConfig,
        run: &RunConfig,
        pair: &Pair<Self>,
        plays: &mut [Play],
    ) -> Result<Option<Certificate>, RunError> {
        let exact = ExactGrid::new(constants, run.gamma)?;
        let optimum = exact.optimum(run.eta.get())?;
        let sampled = policy_of(&exact, constants, pair)?;
        let found = exact.certificate(&optimum, &sampled, run.eta.get())?;
        // At eta = 1 there is no antagonist, and no gap.
        let mut value = (found.greedy.cvar, 0.0);
        for play in plays {
            match (play.protagonist, play.chance) {
                (Mode::Greedy, Chance::Nominal) => play.law = found.greedy_law.clone(),
                (Mode::Sampled, Chance::Nominal) => play.law = found.sampled_law.clone(),
                (Mode::Greedy, Chance::Antagonist) => {
                    value = (play.law.mean(), play.law.mean_standard_error());
                }
                _ => {}
            }
        }
        Ok(Some(Certificate {
            optimum: found.optimal_cvar,
            regret: found.regret,
            regret_standard_error: 0.0,
            antagonist_gap: found.antagonist_gap(value.0),
            antagonist_gap_standard_error: value.1,
        }))
    }

    fn against_exact(
        constants: &GridConfig,
        run: &RunConfig,
        pair: &Pair<Self>,
        play: &mut dyn FnMut(&dyn Opponent<Self>) -> Result<Played, RunError>,
    ) -> Result<Played, RunError> {
        let exact = ExactGrid::new(constants, run.gamma)?;
        let greedy = policy_of(&exact, constants, pair)?.greedy(exact.mdp());
        let worst = exact.worst_case(&greedy, run.eta.get())?;
        play(&ExactOpponent { exact: &exact, greedy: &greedy, worst })
    }
}

/// The sampled policy of a trained protagonist, by time where it is time-aware.
pub(super) fn policy_of(
    exact: &ExactGrid,
    constants: &GridConfig,
    pair: &Pair<LavaGrid>,
) -> Result<Policy, RunError> {
    let row = pair.views.protagonist_inputs::<LavaGrid>() + 1;
    let mut world = LavaGrid::new(constants, 1)?;
    let (cells, horizon) = (world.cells(), world.horizon());
    let (mut inputs, mut outputs) = (vec![0.0; row * cells], Vec::new());
    let mut at_time = |time: u32| -> Vec<[f64; MOVES]> {
        for (cell, row) in inputs.chunks_exact_mut(row).enumerate() {
            world.place(0, cell, time);
            pair.views.protagonist(&world, 0, row);
        }
        pair.protagonist.network.act(&inputs, &mut outputs);
        let logits =
            |cell| std::array::from_fn::<_, MOVES, _>(|i| f64::from(outputs[i * cells + cell]));
        (0..cells).map(|cell| CategoricalPolicy::probabilities(&logits(cell))).collect()
    };
    if pair.views.protagonist_sees_time() {
        let tables: Vec<_> = (0..horizon).map(at_time).collect();
        Ok(exact.timed_policy(|time, cell| tables[time as usize][cell])?)
    } else {
        let table = at_time(0);
        Ok(exact.stationary_policy(|cell| table[cell])?)
    }
}

/// The exact worst-case antagonist of the greedy protagonist, as an opponent.
struct ExactOpponent<'a> {
    exact: &'a ExactGrid,
    greedy: &'a Policy,
    worst: WorstCase<'a>,
}

impl Opponent<LavaGrid> for ExactOpponent<'_> {
    fn draw(
        &self,
        world: &LavaGrid,
        slot: usize,
        law: &FiniteLaw,
        random: &mut ChaCha8Rng,
    ) -> (usize, f64) {
        if world.time(slot) >= world.horizon() || world.is_over(slot) {
            return (0, 1.0); // an idle slot
        }
        let node = self.exact.node(world.time(slot), world.state(slot));
        let action = self.greedy.action(self.exact.mdp(), node);
        let ratios: [f64; MOVES] =
            std::array::from_fn(|outcome| self.worst.delta(node, action, outcome));
        let perturbed: [f64; MOVES] =
            std::array::from_fn(|outcome| law.probabilities[outcome] * ratios[outcome]);
        let outcome = sample_index(&perturbed, random);
        (outcome, ratios[outcome])
    }
}

impl Yardstick for LavaPoint {
    type Constants = PointConfig;

    fn build(constants: &PointConfig, episodes: usize) -> Result<Self, ConfigError> {
        LavaPoint::new(constants, episodes)
    }

    fn certify(
        constants: &PointConfig,
        run: &RunConfig,
        _: &Pair<Self>,
        plays: &mut [Play],
    ) -> Result<Option<Certificate>, RunError> {
        let (effort, eta) = (oracle::Effort::default(), run.eta.get());
        let oracle = match run.evaluation.oracle {
            Oracle::Shipped => oracle::shipped(constants, run.gamma, eta, &effort),
            Oracle::Computed => Some(match oracle::cache_folder() {
                Some(folder) => {
                    oracle::certify_cached(constants, run.gamma, eta, &effort, &folder)?
                }
                None => oracle::certify_with(constants, run.gamma, eta, &effort)?,
            }),
        };
        let law = |chance| {
            let play = plays.iter().find(|p| p.protagonist == Mode::Greedy && p.chance == chance);
            play.map(|play| &play.law)
        };
        let (Some(oracle), Some(greedy)) = (oracle, law(Chance::Nominal)) else { return Ok(None) };
        let alpha = run.eta.alpha();
        let (cvar, error) = (greedy.cvar(alpha), greedy.cvar_standard_error(alpha));
        // At eta = 1 there is no antagonist, and no gap.
        let (antagonist_gap, value_error) = law(Chance::Antagonist)
            .map_or((0.0, None), |law| (law.mean() - cvar, Some(law.mean_standard_error())));
        Ok(Some(Certificate {
            optimum: oracle.certified_cvar,
            regret: oracle.certified_cvar - cvar,
            regret_standard_error: error.hypot(oracle.law.cvar_standard_error(alpha)),
            antagonist_gap,
            antagonist_gap_standard_error: value_error.map_or(0.0, |value| value.hypot(error)),
        }))
    }

    fn against_exact(
        _: &PointConfig,
        _: &RunConfig,
        _: &Pair<Self>,
        _: &mut dyn FnMut(&dyn Opponent<Self>) -> Result<Played, RunError>,
    ) -> Result<Played, RunError> {
        Err(RunError::NoOpponent(
            "the exact worst-case antagonist is known on lava-grid alone; \
             use --antagonist learned or nominal",
        ))
    }
}
