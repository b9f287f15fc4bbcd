//! The evaluation protocol of a finished run (the final weights, not the best ones).
//!
//! Greedy and sampled protagonist, under nominal chance and under its antagonist. In a finite world the
//! laws of the return under nominal chance are exact, computed from the policy's action probabilities;
//! all others are of recorded episodes, on streams that all runs share. Three numbers are kept
//! apart: the game value under the learned antagonist, the CVaR of the sampled policy, the CVaR of
//! the greedy policy.
//!
//! The evaluation does not depend on how the players were trained: it needs a policy and, where there
//! is one, an opponent.

use super::artefacts::{Audit, Certificate, Chance, Findings, Play};
use super::config::RunConfig;
use super::failure::RunError;
use super::frozen::FrozenOpponent;
use crate::exact::changes::Changes;
use crate::exact::table::TablePolicy;
use crate::exact::yardstick::{self, Evidence, Ratios, Solvable, Yardstick};
use crate::game::returns::{ReturnLaw, ReturnSoFar};
use crate::learn::method::{Arena, Players};
use crate::learn::play::{self, Played, Watcher};
use crate::learn::policy::{Draw, Mode, Nominal, Opponent, Response, Situation, Streams};
use crate::learn::vector_game::VectorGame;
use lava_envs::law::sample_index;
use lava_envs::{Law, World};

/// Slack of the audit: rounding of forty factors, and of the normalisation.
const TOLERANCE: f64 = 1e-6;

/// Trained players and their run.
pub struct Contestants<'a, W: World> {
    /// The run.
    pub run: &'a RunConfig,
    /// The world's constants.
    pub constants: &'a W::Constants,
    /// The players.
    pub players: &'a dyn Players<W>,
    /// Called at the end of every episode that is played.
    pub progress: &'a dyn Fn(),
}

/// All plays of the protocol, the budget audit and the certificate. The watcher sees the play of the greedy
/// protagonist against its antagonist, and at least so many of its episodes.
///
/// # Errors
/// If the world refuses its constants, cannot be solved, or the budget audit finds a violation.
pub fn protocol<W: Arena + Solvable>(
    of: &Contestants<'_, W>,
    (watcher, watched): (&mut dyn Watcher<W>, u64),
) -> Result<Findings, RunError> {
    let mut plays = Vec::new();
    let mut keep = |mode, chance, played: Played| {
        plays.push(to_play(mode, chance, &played));
        played
    };
    keep(Mode::Greedy, Chance::Nominal, of.play(Mode::Greedy, Chance::Nominal, &mut ())?);
    // Nominal episodes of the sampled protagonist also carry the antagonist's likelihood ratios.
    let mut shadow = of.players.opponent().unwrap_or_else(|| Box::new(Nominal));
    let episodes = of.run.evaluation.episodes;
    let weighted =
        of.play_episodes(Mode::Sampled, shadow.as_mut(), Draw::Nominal, episodes, &mut ())?;
    let weighted = keep(Mode::Sampled, Chance::Nominal, weighted);
    let mut audit = None;
    if let Some(mut opponent) = of.players.opponent() {
        let all = episodes.max(watched);
        let mut greedy =
            of.play_episodes(Mode::Greedy, opponent.as_mut(), Draw::Perturbed, all, watcher)?;
        greedy.episodes.truncate(episodes as usize);
        let greedy = keep(Mode::Greedy, Chance::Antagonist, greedy);
        let sampled = of.play(Mode::Sampled, Chance::Antagonist, &mut ())?;
        let sampled = keep(Mode::Sampled, Chance::Antagonist, sampled);
        audit = Some(budget_audit(of.run, &[&greedy, &sampled, &weighted])?);
    }
    let certificate = of.certify(&mut plays)?;
    Ok(Findings { plays, audit, certificate })
}

fn to_play(protagonist: Mode, chance: Chance, played: &Played) -> Play {
    Play { protagonist, chance, law: played.law(), mean_clearance: played.mean_clearance() }
}

/// Plays the greedy and the sampled protagonist of a finished run; against the exact antagonist, which
/// is that of the greedy protagonist, only the greedy one.
///
/// # Errors
/// If the run has no such antagonist.
pub fn plays<W: Arena + Solvable>(
    of: &Contestants<'_, W>,
    chance: Chance,
) -> Result<Vec<Play>, RunError> {
    modes(chance)
        .iter()
        .map(|&mode| Ok(to_play(mode, chance, &of.play(mode, chance, &mut ())?)))
        .collect()
}

/// The protagonists that [`plays`] plays.
pub fn modes(chance: Chance) -> &'static [Mode] {
    match chance {
        Chance::Exact => &[Mode::Greedy],
        Chance::Nominal | Chance::Antagonist => &[Mode::Greedy, Mode::Sampled],
    }
}

impl<W: Arena + Solvable> Contestants<'_, W> {
    /// The law of the greedy protagonist's return under nominal chance: exact where it can be computed, else of the
    /// episodes of the run's configuration.
    ///
    /// # Errors
    /// If the world refuses its constants or is too large.
    pub fn greedy_law(&self) -> Result<ReturnLaw, RunError> {
        if let (Some(yardstick), Some(policy)) = (self.yardstick()?, self.table()?)
            && let Some(exact) = yardstick.exact()
        {
            return Ok(exact.laws(&policy)?.greedy);
        }
        Ok(self.play(Mode::Greedy, Chance::Nominal, &mut ())?.law())
    }

    /// What single changes of the greedy protagonist are worth, at the run's budget or another.
    ///
    /// # Errors
    /// If the world is not finite or refuses its constants.
    pub fn changes(&self, eta: f64) -> Result<Changes, RunError> {
        let yardstick = self.yardstick()?;
        let exact = yardstick.as_ref().and_then(|yardstick| yardstick.exact());
        match (exact, self.table()?) {
            (Some(exact), Some(policy)) => Ok(exact.changes(eta, &policy)?),
            _ => Err(RunError::NotFinite(W::NAME)),
        }
    }

    /// Plays episodes of the run's evaluation, shown to `watcher`.
    ///
    /// # Errors
    /// If the world refuses its constants.
    pub fn play_episodes(
        &self,
        mode: Mode,
        opponent: &mut dyn Opponent<W>,
        draw: Draw,
        episodes: u64,
        watcher: &mut dyn Watcher<W>,
    ) -> Result<Played, RunError> {
        let run = self.run;
        let slots = run.evaluation.parallel_episodes.min(episodes as usize);
        let world = W::new(self.constants, slots)?;
        let (eta, gamma, seed) = (run.eta, run.gamma, run.evaluation.seed);
        let setting = play::Play { mode, draw, eta, gamma, episodes, seed };
        let mut protagonist = self.players.protagonist();
        let watcher = &mut Watched { watcher, progress: self.progress };
        Ok(play::play(world, protagonist.as_mut(), opponent, &setting, watcher))
    }

    /// Plays the episodes of the run's configuration, shown to `watcher`.
    ///
    /// # Errors
    /// If the run has no such antagonist.
    pub fn play(
        &self,
        mode: Mode,
        chance: Chance,
        watcher: &mut dyn Watcher<W>,
    ) -> Result<Played, RunError> {
        let episodes = self.run.evaluation.episodes;
        match chance {
            Chance::Nominal => {
                self.play_episodes(mode, &mut Nominal, Draw::Nominal, episodes, watcher)
            }
            Chance::Antagonist => {
                let mut opponent = self.players.opponent().ok_or(RunError::NoOpponent(
                    "this run has no learned antagonist, as every run at eta = 1; use --antagonist \
                     nominal",
                ))?;
                self.play_episodes(mode, opponent.as_mut(), Draw::Perturbed, episodes, watcher)
            }
            Chance::Exact if mode == Mode::Greedy => {
                let unknown = RunError::NoOpponent(
                    "the exact worst-case antagonist is known in finite worlds only, such as \
                     lava-grid; use --antagonist learned or nominal",
                );
                let yardstick = self.yardstick()?;
                let exact = yardstick.as_ref().and_then(|yardstick| yardstick.exact());
                let (Some(exact), Some(greedy)) = (exact, self.table()?) else {
                    return Err(unknown);
                };
                let ratios = exact.worst_case(self.run.eta.get(), &greedy)?;
                let mut opponent = WorstCase { greedy: &greedy, ratios };
                self.play_episodes(mode, &mut opponent, Draw::Perturbed, episodes, watcher)
            }
            Chance::Exact => Err(RunError::NoOpponent(
                "the exact worst-case antagonist is that of the greedy protagonist; use \
                 --protagonist greedy",
            )),
        }
    }

    /// The world's yardstick, if it has one.
    ///
    /// # Errors
    /// If the world refuses its constants or is too large.
    pub fn yardstick(&self) -> Result<Option<Box<dyn Yardstick>>, RunError> {
        Ok(W::yardstick(self.constants, self.run.gamma, &self.run.evaluation.yardstick())?)
    }

    /// The protagonist's action probabilities as a table, where the world is finite and the policy has
    /// such probabilities.
    ///
    /// # Errors
    /// If the world refuses its constants.
    pub fn table(&self) -> Result<Option<TablePolicy>, RunError> {
        table(self.constants, self.players)
    }

    /// Replaces laws of recorded episodes by exact ones where there are exact ones, and certifies.
    fn certify(&self, plays: &mut [Play]) -> Result<Option<Certificate>, RunError> {
        let Some(yardstick) = self.yardstick()? else { return Ok(None) };
        let policy = self.table()?;
        if let (Some(exact), Some(policy)) = (yardstick.exact(), &policy) {
            let laws = exact.laws(policy)?;
            for play in plays.iter_mut().filter(|play| play.chance == Chance::Nominal) {
                play.law = match play.protagonist {
                    Mode::Greedy => laws.greedy.clone(),
                    Mode::Sampled => laws.sampled.clone(),
                };
            }
        }
        let greedy = |chance| {
            let wanted = |play: &&Play| play.protagonist == Mode::Greedy && play.chance == chance;
            plays.iter().find(wanted).map(|play| &play.law)
        };
        let response = match (yardstick.exact(), self.players.opponent()) {
            (Some(exact), Some(mut opponent)) => {
                let mut frozen = FrozenOpponent::new(self.constants, opponent.as_mut())?;
                exact.best_response(self.run.eta.get(), &mut frozen)?
            }
            _ => None,
        };
        let evidence = Evidence {
            policy: policy.as_ref(),
            nominal: greedy(Chance::Nominal),
            opposed: greedy(Chance::Antagonist),
            response,
        };
        let found = yardstick.compare(self.run.eta.get(), &evidence)?;
        Ok(found.map(Certificate::from))
    }
}

/// A watcher, with a call at the end of each episode.
struct Watched<'a, W: World> {
    watcher: &'a mut dyn Watcher<W>,
    progress: &'a dyn Fn(),
}

impl<W: World> Watcher<W> for Watched<'_, W> {
    fn before(&mut self, world: &W, slot: usize) {
        self.watcher.before(world, slot);
    }

    fn after(&mut self, game: &VectorGame<W>, slot: usize, episode: usize, so_far: &ReturnSoFar) {
        self.watcher.after(game, slot, episode, so_far);
        if game.steps[slot].end.is_some() {
            (self.progress)();
        }
    }

    fn has_enough(&self) -> bool {
        self.watcher.has_enough()
    }

    fn keeps_episodes(&self) -> bool {
        self.watcher.keeps_episodes()
    }
}

/// The action probabilities of a protagonist in every state, by time if it sees the time; `None` where
/// the world is not finite or the policy does not have them.
fn table<W: World>(
    constants: &W::Constants,
    players: &dyn Players<W>,
) -> Result<Option<TablePolicy>, RunError> {
    let mut protagonist = players.protagonist();
    let sees_time = protagonist.sees_time();
    Ok(TablePolicy::ask::<W>(constants, sees_time, |world| protagonist.probabilities(world))?)
}

/// The exact worst-case antagonist of a greedy policy, as an opponent.
struct WorstCase<'a> {
    greedy: &'a TablePolicy,
    ratios: Box<dyn Ratios + 'a>,
}

impl<W: World> Opponent<W> for WorstCase<'_> {
    fn respond(
        &mut self,
        situation: &Situation<'_, W>,
        draw: Draw,
        streams: &mut [Streams],
        response: Response<'_, W>,
    ) {
        let world = situation.world;
        let model = world.finite().expect("only finite worlds have an exact worst case");
        for (slot, streams) in streams.iter_mut().enumerate() {
            let time = world.time(slot);
            let (mut index, mut ratio) = (0, 1.0);
            if time < world.horizon() && !model.is_over(slot) {
                let state = model.state(slot);
                let action = self.greedy.greedy_action(time, state);
                let ratios = self.ratios.ratios(time, state, action);
                let mut law = model.probabilities(state, action);
                if draw == Draw::Perturbed {
                    law.iter_mut()
                        .zip(&ratios)
                        .for_each(|(probability, delta)| *probability *= delta);
                }
                index = sample_index(&law, &mut streams.outcomes);
                ratio = ratios[index];
            }
            let outcome = W::Law::outcome(index).expect("outcomes of a finite world have indices");
            response.outcomes.push(outcome);
            response.ratios[slot] = ratio;
        }
    }
}

/// Measures the regret of the greedy protagonist during training.
pub struct RegretMeter<W: World> {
    /// How often it is asked in a run.
    pub points: u64,
    /// The regret of the protagonist; `None` where its policy does not say enough.
    pub measure: Box<Measure<W>>,
}

/// See [`RegretMeter::measure`].
pub type Measure<W> = dyn Fn(&dyn Players<W>) -> Result<Option<f64>, RunError>;

/// Points of the curve of the regret in training, where it is exact.
const EXACT_POINTS: u64 = 40;

/// The same where episodes must be played for each.
const PLAYED_POINTS: u64 = 20;

/// The least number of these episodes, and how many of them the tail holds at least.
const PLAYED_EPISODES: (u64, f64) = (2_000, 50.0);

/// The meter of the regret in training; `None` where no optimum is known without minutes of computation.
///
/// # Errors
/// If the world refuses its constants or is too large.
pub fn regret_meter<W: Arena + Solvable>(
    constants: &W::Constants,
    run: &RunConfig,
) -> Result<Option<RegretMeter<W>>, RunError> {
    let options =
        yardstick::Options { source: yardstick::Source::Shipped, ..run.evaluation.yardstick() };
    let Some(yardstick) = W::yardstick(constants, run.gamma, &options)? else { return Ok(None) };
    let (constants, eta, gamma) = (constants.clone(), run.eta, run.gamma);
    if yardstick.exact().is_some() {
        let measure = move |players: &dyn Players<W>| {
            let (Some(exact), Some(policy)) = (yardstick.exact(), table(&constants, players)?)
            else {
                return Ok(None);
            };
            Ok(Some(exact.regret(eta.get(), &policy)?))
        };
        return Ok(Some(RegretMeter { points: EXACT_POINTS, measure: Box::new(measure) }));
    }
    if yardstick.optimal_law(eta.get())?.is_none() {
        return Ok(None);
    }
    let (least, tail) = PLAYED_EPISODES;
    let episodes =
        ((tail * eta.get()).ceil() as u64).clamp(least, run.evaluation.episodes.max(least));
    let slots = run.evaluation.parallel_episodes.min(episodes as usize);
    let (mode, draw, seed) = (Mode::Greedy, Draw::Nominal, run.evaluation.seed);
    let setting = play::Play { mode, draw, eta, gamma, episodes, seed };
    let measure = move |players: &dyn Players<W>| {
        let (world, mut protagonist) = (W::new(&constants, slots)?, players.protagonist());
        let law = play::play(world, protagonist.as_mut(), &mut Nominal, &setting, &mut ()).law();
        let evidence = Evidence { nominal: Some(&law), ..Evidence::default() };
        Ok(yardstick.compare(eta.get(), &evidence)?.map(|found| found.regret))
    };
    Ok(Some(RegretMeter { points: PLAYED_POINTS, measure: Box::new(measure) }))
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
