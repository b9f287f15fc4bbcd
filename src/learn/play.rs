//! Evaluation: whole episodes of a protagonist and an opponent, each on random streams of its own.
//!
//! The streams of an episode depend only on the evaluation's seed and the episode's index, so all
//! policies meet the same chance (common random numbers), and no episode depends on how many are
//! played at once.

use super::policy::{Draw, Mode, Opponent, Policy, Streams};
use super::vector_game::VectorGame;
use crate::game::budget::Eta;
use crate::game::returns::{Atom, ReturnLaw, ReturnSoFar};
use lava_envs::random::{Purpose, restart, stream};
use lava_envs::{End, World};

/// How episodes are played.
#[derive(Debug, Clone, Copy)]
pub struct Play {
    /// How the protagonist picks its actions.
    pub mode: Mode,
    /// The law that outcomes are drawn from.
    pub draw: Draw,
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

/// What was played.
#[derive(Debug, Clone)]
pub struct Played {
    /// All episodes, by index; none if the watcher does not keep them.
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

/// An observer of every step of every episode. Steps of one episode come in order, those of
/// different episodes are interleaved.
pub trait Watcher<W: World> {
    /// The world before the next step of the episode in the slot.
    fn before(&mut self, world: &W, slot: usize);

    /// What happened in that step of the episode; the world is the one after it. `so_far` is the
    /// episode's return up to this step, which is included.
    fn after(&mut self, game: &VectorGame<W>, slot: usize, episode: usize, so_far: &ReturnSoFar);

    /// Whether the remaining episodes need not be played.
    fn has_enough(&self) -> bool {
        false
    }

    /// Whether the episodes are returned as well. Where the watcher is all that counts, any number of them
    /// needs no memory.
    fn keeps_episodes(&self) -> bool {
        true
    }
}

/// An observer that ignores all steps.
impl<W: World> Watcher<W> for () {
    fn before(&mut self, _: &W, _: usize) {}

    fn after(&mut self, _: &VectorGame<W>, _: usize, _: usize, _: &ReturnSoFar) {}
}

/// An episode that is being played.
#[derive(Debug, Clone, Copy)]
struct Running {
    index: usize,
    so_far: ReturnSoFar,
    clearance: f64,
    likelihood_ratio: f64,
}

impl Running {
    fn start(index: usize) -> Self {
        let (clearance, likelihood_ratio) = (f64::INFINITY, 1.0);
        Running { index, so_far: ReturnSoFar::START, clearance, likelihood_ratio }
    }

    fn ended(self, end: End) -> Episode {
        let Running { so_far, clearance, likelihood_ratio, .. } = self;
        Episode { atom: so_far.ended(end), clearance, likelihood_ratio }
    }
}

/// Plays the episodes in the slots of `world`; a slot takes the next episode when its own has ended.
/// After the watcher has asked to stop, the episodes that were not played yet have no meaning.
pub fn play<W: World>(
    world: W,
    protagonist: &mut dyn Policy<W>,
    opponent: &mut dyn Opponent<W>,
    play: &Play,
    watcher: &mut dyn Watcher<W>,
) -> Played {
    let slots = world.episodes();
    let mut game = VectorGame::new(world, (0..slots as u64).map(|i| play.streams(i)).collect());
    let episodes = play.episodes as usize;
    let kept = if watcher.keeps_episodes() { episodes } else { 0 };
    let mut played = vec![Running::start(0).ended(End::Timeout); kept];
    let mut running: Vec<Running> = (0..slots).map(Running::start).collect();
    let mut next = slots;
    for (slot, episode) in running.iter().enumerate() {
        game.start(slot, play.eta);
        game.idle[slot] = episode.index >= episodes;
    }
    while game.idle.iter().any(|idle| !idle) && !watcher.has_enough() {
        for slot in (0..slots).filter(|&slot| !game.idle[slot]) {
            watcher.before(&game.world, slot);
        }
        game.step(protagonist, play.mode, opponent, play.draw);
        for (slot, episode) in running.iter_mut().enumerate() {
            if game.idle[slot] {
                continue;
            }
            let step = game.steps[slot];
            episode.so_far.add(step.reward, play.gamma);
            episode.clearance = episode.clearance.min(game.world.clearance(slot));
            episode.likelihood_ratio *= game.likelihood_ratio(slot);
            watcher.after(&game, slot, episode.index, &episode.so_far);
            if let Some(end) = step.end {
                if let Some(place) = played.get_mut(episode.index) {
                    *place = episode.ended(end);
                }
                *episode = Running::start(next);
                next += 1;
                if episode.index < episodes {
                    game.start(slot, play.eta);
                    let Streams { actions, outcomes } = &mut game.streams[slot];
                    restart(actions, Purpose::EvaluationActions, episode.index as u64);
                    restart(outcomes, Purpose::EvaluationOutcomes, episode.index as u64);
                } else {
                    game.idle[slot] = true;
                }
            }
        }
    }
    Played { episodes: played, normalisation_error: opponent.normalisation_error() }
}

impl Play {
    fn streams(&self, episode: u64) -> Streams {
        Streams {
            actions: stream(self.seed, Purpose::EvaluationActions, episode),
            outcomes: stream(self.seed, Purpose::EvaluationOutcomes, episode),
        }
    }
}
