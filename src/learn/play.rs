//! Evaluation: whole episodes of a trained pair, each on random streams of its own.
//!
//! The streams of an episode depend on the evaluation's seed and the episode's index alone, so all
//! policies meet the same chance (common random numbers), and no episode depends on how many are
//! played at once.

use crate::arena::Arena;
use crate::contest::{Chance, Choosing, Contest, Streams};
use crate::pair::Pair;
use cvar_game::game::budget::Eta;
use cvar_game::game::returns::{Atom, ReturnLaw};
use lava_envs::random::{Purpose, stream};

/// What is played.
pub struct Play<'a, W: Arena> {
    /// How the protagonist picks its actions.
    pub choosing: Choosing,
    /// Who decides the law of chance.
    pub chance: Chance<'a, W>,
    /// Budget.
    pub eta: Eta,
    /// Discount factor.
    pub gamma: f64,
    /// Number of episodes.
    pub episodes: u64,
    /// Seed of the evaluation's streams.
    pub seed: u64,
}

/// One played episode.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Episode {
    /// Its return and its end.
    pub atom: Atom,
    /// Least distance to lava, at the ends of its steps, in the world's unit of length.
    pub clearance: f64,
    /// prod_t delta_t(o_t).
    pub likelihood_ratio: f64,
}

impl Episode {
    const START: Episode = Episode {
        atom: Atom {
            value: 0.0,
            undiscounted: 0.0,
            steps: 0,
            end: lava_envs::End::Timeout,
            mass: 1.0,
        },
        clearance: f64::INFINITY,
        likelihood_ratio: 1.0,
    };
}

/// What was played.
#[derive(Debug, Clone)]
pub struct Played {
    /// All episodes, by index.
    pub episodes: Vec<Episode>,
    /// max |`E_P[delta_t]` - 1| over all steps.
    pub normalisation_error: f64,
}

impl Played {
    /// The empirical law of the return.
    pub fn law(&self) -> ReturnLaw {
        ReturnLaw::recorded(self.episodes.iter().map(|episode| episode.atom))
    }

    /// Mean of the episodes' least distance to lava; `None` where there is no lava.
    pub fn mean_clearance(&self) -> Option<f64> {
        let sum: f64 = self.episodes.iter().map(|episode| episode.clearance).sum();
        let mean = sum / self.episodes.len() as f64;
        mean.is_finite().then_some(mean)
    }
}

/// Somebody who is shown every step of every episode. Steps of one episode come in order, those of
/// different episodes in between each other.
pub trait Watcher<W: Arena> {
    /// The world before the next step of the episode in the slot.
    fn before(&mut self, world: &W, slot: usize);

    /// What happened in that step of the episode; the world is the one after it.
    fn after(&mut self, contest: &Contest<W>, slot: usize, episode: usize);

    /// Whether the rest need not be played.
    fn has_enough(&self) -> bool {
        false
    }
}

/// Nobody.
impl<W: Arena> Watcher<W> for () {
    fn before(&mut self, _: &W, _: usize) {}

    fn after(&mut self, _: &Contest<W>, _: usize, _: usize) {}
}

/// Plays the episodes in the slots of `world`; a slot takes the next episode when its own has ended.
/// Once the watcher has enough, what was not played yet stays without meaning.
pub fn play<W: Arena>(
    world: W,
    pair: &Pair<W>,
    play: &Play<'_, W>,
    watcher: &mut impl Watcher<W>,
) -> Played {
    let slots = world.episodes();
    let mut contest =
        Contest::new(world, (0..slots as u64).map(|i| play.streams(i)).collect(), &pair.views);
    contest.audit = true;
    let mut played = vec![Episode::START; play.episodes as usize];
    // The episode in each slot.
    let mut current: Vec<usize> = (0..slots).collect();
    let mut next = slots;
    for (slot, &episode) in current.iter().enumerate() {
        contest.start(slot, play.eta);
        contest.idle[slot] = episode >= played.len();
    }
    while contest.idle.iter().any(|idle| !idle) && !watcher.has_enough() {
        for slot in (0..slots).filter(|&slot| !contest.idle[slot]) {
            watcher.before(&contest.world, slot);
        }
        contest.step(pair, play.choosing, &play.chance);
        for (slot, index) in current.iter_mut().enumerate() {
            if contest.idle[slot] {
                continue;
            }
            watcher.after(&contest, slot, *index);
            let episode = &mut played[*index];
            let step = contest.steps[slot];
            episode.atom.value += play.gamma.powi(episode.atom.steps as i32) * step.reward;
            episode.atom.undiscounted += step.reward;
            episode.atom.steps += 1;
            episode.clearance = episode.clearance.min(contest.world.clearance(slot));
            episode.likelihood_ratio *= contest.ratios[slot];
            if let Some(end) = step.end {
                episode.atom.end = end;
                *index = next;
                next += 1;
                if *index < played.len() {
                    contest.start(slot, play.eta);
                    contest.streams[slot] = play.streams(*index as u64);
                } else {
                    contest.idle[slot] = true;
                }
            }
        }
    }
    Played { episodes: played, normalisation_error: contest.normalisation_error }
}

impl<W: Arena> Play<'_, W> {
    fn streams(&self, episode: u64) -> Streams {
        Streams {
            actions: stream(self.seed, Purpose::EvaluationActions, episode),
            outcomes: stream(self.seed, Purpose::EvaluationOutcomes, episode),
        }
    }
}
