//! Training and players of [`super`].

use super::quantiles::{Levels, Quantiles, Shape, quantile_huber};
use super::replay::{Minibatch, Replay, Transition};
use super::{Options, Risk};
use crate::game::budget::Eta;
use crate::game::returns::ReturnSoFar;
use crate::learn::adam::Adam;
use crate::learn::device::Device;
use crate::learn::head::HeadOf;
use crate::learn::inputs::Inputs;
use crate::learn::method::{Arena, Players, Progress, Setting, TrainError, Training};
use crate::learn::observation::Observation;
use crate::learn::policy::{Mode, Opponent, Policy, Streams};
use crate::learn::rollout::{Collector, Terms};
use crate::learn::schedule::{self, Turn};
use crate::learn::state::{GamesState, Unfit};
use crate::learn::vector_game::VectorGame;
use crate::learn::weights::{self, Weights, WeightsError};
use lava_envs::random::{ChaCha8Rng, Purpose, position, stream, stream_from};
use lava_envs::{Action, End, World};
use rand::RngExt;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::marker::PhantomData;
use tch::{Kind, Tensor};

/// Name of the protagonist in files and messages.
const PLAYER: &str = "protagonist";

/// Thresholds among which the one of the start is chosen.
const THRESHOLDS: usize = 101;

/// Levels of which the law of the return is made there, for tails as thin as 1 %.
const START_LEVELS: usize = 200;

/// What the repair needs besides the network, to the bit as a file of weights has it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Threshold {
    /// w_0.
    start: f32,
    /// What a step earns with which the episode does not end.
    running: f32,
}

/// The protagonist.
#[derive(Debug)]
pub struct IqnPlayers<W> {
    network: Quantiles,
    observation: Observation,
    /// Levels of the policy, shape `[1, K]`, and their weights, `[1, K, 1]`.
    levels: [Tensor; 2],
    own: Options,
    /// 1/eta.
    alpha: f64,
    gamma: f64,
    device: Device,
    threshold: Threshold,
    /// Least and greatest return, between which thresholds are.
    range: [f64; 2],
    world: PhantomData<fn() -> W>,
}

impl<W: Arena> IqnPlayers<W> {
    /// The protagonist as training begins with it.
    pub fn new(world: &W, setting: &Setting<'_>) -> Self {
        let Setting { eta, gamma, seed, device, options, own } = *setting;
        let own = Options::read(own);
        let time_aware = options.protagonist.time_aware;
        let view = options.observation;
        let observation = Observation::of_view(world, view, time_aware, Eta::NEUTRAL);
        let shape = Shape {
            columns: observation.protagonist_columns::<W>(),
            threshold: own.risk == Risk::Static,
            hidden: options.protagonist.hidden,
            cosines: own.cosines,
            actions: repertoire::<W>().len(),
        };
        let network =
            Quantiles::new(shape, device, &mut stream(seed, Purpose::ProtagonistWeights, 0));
        let range = world.return_range(gamma).unwrap_or([-1.0, 1.0]);
        let threshold = Threshold { start: range[1] as f32, running: 0.0 };
        let (world, alpha) = (PhantomData, eta.alpha());
        let levels = levels(&network, &own, alpha, own.policy_levels);
        IqnPlayers {
            network,
            observation,
            levels,
            own,
            alpha,
            gamma,
            device,
            threshold,
            range,
            world,
        }
    }

    /// The policy, with a share of random actions.
    fn policy(&self, exploration: f64) -> IqnPolicy<'_, W> {
        let (starts, inputs, thresholds, chosen, known) = Default::default();
        IqnPolicy { players: self, exploration, starts, inputs, thresholds, chosen, known }
    }

    /// Aims at another risk level.
    fn aim(&mut self, alpha: f64) {
        if alpha != self.alpha {
            self.alpha = alpha;
            self.levels = levels(&self.network, &self.own, alpha, self.own.policy_levels);
        }
    }

    /// w_t of an episode that began with w_0 = `start`.
    fn threshold_at(&self, start: f64, time: u32) -> f64 {
        let mut so_far = ReturnSoFar::START;
        (0..time).for_each(|_| so_far.add(self.threshold.running.into(), self.gamma));
        so_far.missing(start)
    }

    /// A threshold as the network sees it: the range of returns becomes [-1, 1], and beyond it is its end.
    fn shown(&self, threshold: f64) -> f32 {
        let [least, greatest] = self.range;
        (2.0 * (threshold - least) / (greatest - least) - 1.0).clamp(-1.0, 1.0) as f32
    }

    /// What each action is worth to the policy, shape `[n, actions]`, by quantiles of shape `[n, k, actions]` at levels of
    /// these weights.
    fn worth(&self, quantiles: &Tensor, weights: &Tensor, thresholds: &[f32]) -> Tensor {
        let mean = |of: &Tensor| (of * weights).sum_dim_intlist(1, false, Kind::Float);
        match self.own.risk {
            Risk::Iterated => mean(quantiles),
            Risk::Static => mean(&quantiles.minimum(&self.level_of(thresholds))),
        }
    }

    /// Thresholds as the network sees them as levels of the return, shape `[n, 1, 1]`.
    fn level_of(&self, shown: &[f32]) -> Tensor {
        let [least, greatest] = self.range;
        (self.network.tensor(shown, [-1, 1, 1]) + 1.0) * (0.5 * (greatest - least)) + least
    }

    /// The best actions for these samples, shape `[n]`.
    fn best(&self, network: &Quantiles, x: &Tensor, thresholds: &[f32]) -> Tensor {
        let [levels, weights] = &self.levels;
        self.worth(&network.values(x, levels), weights, thresholds).argmax(1, false)
    }

    /// Chooses w_0 for the state in which slot 0 of `world` is.
    fn choose_start(&mut self, world: &W) {
        if self.own.risk != Risk::Static {
            return;
        }
        let mut seen = Inputs::default();
        self.observation.protagonist(world, &mut seen);
        let row = seen.rows().row(0, self.network.shape().columns.numbers + 1);
        let [least, greatest] = self.range;
        let mut rows = Inputs::default();
        let mut shown = Vec::with_capacity(THRESHOLDS);
        for i in 0..THRESHOLDS {
            rows.extend(row);
            shown.push((2 * i) as f32 / (THRESHOLDS - 1) as f32 - 1.0);
        }
        let [levels, weights] = levels(&self.network, &self.own, self.alpha, START_LEVELS);
        let worth = tch::no_grad(|| {
            let quantiles = self.network.values(&self.network.inputs(rows.rows(), &shown), &levels);
            self.worth(&quantiles, &weights, &shown).amax(1i64, false)
        });
        let worth = Vec::<f32>::try_from(worth).expect("a vector of numbers");
        let objective = |i: usize| {
            let w = least + (greatest - least) * i as f64 / (THRESHOLDS - 1) as f64;
            (w - (w - f64::from(worth[i])) / self.alpha, w)
        };
        let best = (0..THRESHOLDS).map(objective).max_by(|a, b| a.0.total_cmp(&b.0));
        self.threshold.start = best.map_or(self.threshold.start, |(_, w)| w as f32);
    }
}

/// So many levels of a policy that aims at `alpha`, shape `[1, K]`, and their weights, `[1, K, 1]`.
fn levels(network: &Quantiles, own: &Options, alpha: f64, count: usize) -> [Tensor; 2] {
    let Levels { at, weights } = match own.risk {
        Risk::Iterated => Levels::below(alpha, count),
        Risk::Static => Levels::stratified(alpha, count, own.tail),
    };
    [network.tensor(&at, [1, -1]), network.tensor(&weights, [1, -1, 1])]
}

/// The actions among which the protagonist chooses.
fn repertoire<W: Arena>() -> Vec<W::Action> {
    <W::Action as Action>::Kind::repertoire()
}

impl<W: Arena> Players<W> for IqnPlayers<W> {
    fn protagonist(&self) -> Box<dyn Policy<W> + '_> {
        Box::new(self.policy(0.0))
    }

    fn opponent(&self) -> Option<Box<dyn Opponent<W> + '_>> {
        None
    }

    fn weights(&self, about: String) -> Result<Vec<u8>, WeightsError> {
        let mut tensors = self.network.tensors(PLAYER);
        let Threshold { start, running } = self.threshold;
        if self.own.risk == Risk::Static {
            tensors.push((format!("{PLAYER}.threshold"), vec![2], vec![start, running]));
        }
        weights::tensors_to_bytes(tensors, about)
    }

    fn load(&mut self, bytes: &[u8]) -> Result<(), WeightsError> {
        let file = Weights::read(bytes)?;
        if self.own.risk == Risk::Static {
            let numbers = file.numbers(&format!("{PLAYER}.threshold"), &[2])?;
            let [start, running] = [numbers[0], numbers[1]];
            if !(start.is_finite() && running.is_finite()) {
                return Err(WeightsError::NotFinite { player: PLAYER, quantity: "the threshold" });
            }
            self.threshold = Threshold { start, running };
        }
        self.network = Quantiles::read(self.network.shape(), self.device, PLAYER, &file)?;
        Ok(())
    }
}

/// The protagonist at play.
#[derive(Debug)]
struct IqnPolicy<'a, W> {
    players: &'a IqnPlayers<W>,
    exploration: f64,
    /// w_0 of each slot; that of the players where empty.
    starts: Vec<f64>,
    /// What it saw in its last step.
    inputs: Inputs,
    thresholds: Vec<f32>,
    /// Indices of the actions that it chose.
    chosen: Vec<u32>,
    /// The answers so far of a policy of one threshold in a finite world, by time and state.
    known: HashMap<(u32, usize), i64>,
}

impl<W: Arena> IqnPolicy<'_, W> {
    /// The best action of every slot.
    fn best(&mut self, world: &W) -> Vec<i64> {
        self.players.observation.protagonist(world, &mut self.inputs);
        let model = world.finite().filter(|_| self.starts.is_empty());
        let Some(model) = model else { return self.judge(world) };
        let slots = 0..world.episodes();
        let places: Vec<_> = slots.map(|slot| (world.time(slot), model.state(slot))).collect();
        let answer: Option<Vec<i64>> =
            places.iter().map(|place| self.known.get(place).copied()).collect();
        answer.unwrap_or_else(|| {
            let best = self.judge(world);
            self.known.extend(places.into_iter().zip(best.iter().copied()));
            best
        })
    }

    /// The same for what it sees already, without what is known.
    fn judge(&mut self, world: &W) -> Vec<i64> {
        let players = self.players;
        self.thresholds.clear();
        if players.own.risk == Risk::Static {
            self.thresholds.extend((0..world.episodes()).map(|slot| {
                let start =
                    self.starts.get(slot).copied().unwrap_or(players.threshold.start.into());
                players.shown(players.threshold_at(start, world.time(slot)))
            }));
        }
        tch::no_grad(|| {
            let x = players.network.inputs(self.inputs.rows(), &self.thresholds);
            let best = players.best(&players.network, &x, &self.thresholds);
            Vec::try_from(best).expect("a vector of indices")
        })
    }
}

impl<W: Arena> Policy<W> for IqnPolicy<'_, W> {
    /// Greedy but for what exploration is left: sampled is the same.
    fn choose(
        &mut self,
        world: &W,
        _: Mode,
        streams: &mut [Streams],
        actions: &mut Vec<W::Action>,
    ) {
        let best = self.best(world);
        let repertoire = repertoire::<W>();
        self.chosen.clear();
        for (streams, best) in streams.iter_mut().zip(best) {
            let random = self.exploration > 0.0 && streams.actions.random_bool(self.exploration);
            let index = if random {
                streams.actions.random_range(0..repertoire.len())
            } else {
                best as usize
            };
            self.chosen.push(index as u32);
            actions.push(repertoire[index]);
        }
    }

    fn probabilities(&mut self, world: &W) -> Option<Vec<f64>> {
        let actions = world.finite()?.actions();
        let mut probabilities = vec![0.0; world.episodes() * actions];
        for (of, best) in probabilities.chunks_exact_mut(actions).zip(self.best(world)) {
            of[best as usize] = 1.0;
        }
        Some(probabilities)
    }

    fn sees_time(&self) -> bool {
        self.players.observation.protagonist_sees_time()
    }
}

/// Training, rollout by rollout: steps into the replay, then gradient steps.
pub struct IqnTraining<'a, W: Arena> {
    setting: Setting<'a>,
    turns: Vec<Turn>,
    done: usize,
    gradient_steps: u64,
    players: IqnPlayers<W>,
    target: Quantiles,
    optimiser: Adam,
    collector: Collector<W>,
    /// A world whose only slot is where episodes start.
    start: W,
    replay: Replay,
    random: ChaCha8Rng,
    minibatch: Minibatch,
    gradient: Vec<f32>,
}

/// All that later updates depend on.
#[derive(Serialize, Deserialize)]
struct State<S> {
    update: u64,
    gradient_steps: u64,
    random: u128,
    parameters: Vec<f32>,
    target: Vec<f32>,
    threshold: Threshold,
    optimiser: Adam,
    games: GamesState<S>,
    replay: Replay,
}

impl<'a, W: Arena> IqnTraining<'a, W> {
    /// Training from its beginning, on `world`, whose slots are the parallel episodes.
    pub fn new(world: W, setting: &Setting<'a>) -> Self {
        let players = IqnPlayers::new(&world, setting);
        let (shape, parameters) = (players.network.shape(), players.network.parameters());
        let start = W::new(world.constants(), 1).expect("a world of these constants is there");
        IqnTraining {
            turns: schedule::alone(setting.options, setting.eta),
            done: 0,
            gradient_steps: 0,
            target: Quantiles::from_parameters(shape, setting.device, parameters.to_vec()),
            optimiser: Adam::new(parameters.len()),
            collector: Collector::new(world, setting),
            start,
            replay: Replay::new(players.own.replay, shape.columns.numbers + 1),
            random: stream(setting.seed, Purpose::Minibatches, 0),
            minibatch: Minibatch::default(),
            gradient: Vec::new(),
            setting: setting.clone(),
            players,
        }
    }

    /// Share of random actions in an update.
    fn exploration(&self) -> f64 {
        let own = &self.players.own;
        let progress = self.done as f64 / self.turns.len() as f64;
        let left = (1.0 - progress / own.exploration_until).max(0.0);
        own.exploration + (1.0 - own.exploration) * left
    }

    /// Plays a rollout into the replay. The policy of the moment plays in every other slot, that of a random threshold
    /// in the others.
    fn play(&mut self, turn: &Turn) {
        let exploration = self.exploration();
        let IqnTraining { players, collector, replay, random, setting, .. } = self;
        let terms = Terms { eta: Eta::NEUTRAL, mode: Mode::Sampled, exploring: turn.exploring };
        let mut policy = players.policy(exploration);
        if players.own.risk == Risk::Static {
            let ([least, greatest], own) = (players.range, players.threshold.start.into());
            let slots = 0..setting.options.parallel_episodes;
            policy.starts.extend(slots.map(|slot| {
                if slot % 2 == 0 { own } else { random.random_range(least..=greatest) }
            }));
        }
        let width = players.network.shape().columns.numbers + 1;
        let (mut next, mut running) = (Inputs::default(), players.threshold.running);
        collector.open(terms);
        for _ in 0..setting.options.rollout_steps {
            collector.step(
                &mut policy,
                terms,
                |policy: &IqnPolicy<'_, W>, game: &VectorGame<W>| {
                    players.observation.protagonist(&game.world, &mut next);
                    for (slot, step) in game.steps.iter().enumerate() {
                        if step.end.is_none() {
                            running = step.reward as f32;
                        }
                        replay.add(Transition {
                            seen: policy.inputs.rows().row(slot, width),
                            action: policy.chosen[slot],
                            reward: step.reward as f32,
                            ended: step.end.is_some(),
                            next: next.rows().row(slot, width),
                        });
                    }
                },
            );
        }
        drop(policy);
        players.threshold.running = running;
    }

    /// A gradient step; the loss and the norm of its gradient.
    fn learn(&mut self) -> [f64; 2] {
        let Self { players, target, replay, random, minibatch, gradient, setting, .. } = self;
        let own = players.own;
        let n = own.minibatch;
        replay.gather((0..n).map(|_| random.random_range(0..replay.len())), minibatch);
        let [mut shown, mut later] = [(); 2].map(|()| Vec::new());
        if players.own.risk == Risk::Static {
            let [least, greatest] = players.range;
            for &reward in &minibatch.rewards {
                let threshold = random.random_range(least..=greatest);
                shown.push(players.shown(threshold));
                later.push(players.shown((threshold - f64::from(reward)) / setting.gamma));
            }
        }
        let alpha = players.alpha;
        let mut levels = |tail: f64| -> Vec<f32> {
            let upper = |tail: bool| if tail { alpha as f32 } else { 1.0 };
            let mut level =
                || upper(tail > 0.0 && random.random_bool(tail)) * random.random::<f32>();
            (0..n * own.levels).map(|_| level()).collect()
        };
        let (levels, target_levels) = (levels(own.tail), levels(0.0));
        let shape = [n as i64, -1];
        let column = |numbers: &[f32]| players.network.tensor(numbers, [-1, 1]);
        let targets = tch::no_grad(|| {
            let x = target.inputs(minibatch.next.rows(), &later);
            let best = players.best(target, &x, &later).view([-1, 1, 1]);
            let quantiles = target.values(&x, &target.tensor(&target_levels, shape));
            let best = best.expand([n as i64, own.levels as i64, 1], false);
            let left = quantiles.gather(2, &best, false).squeeze_dim(2);
            let discounts =
                minibatch.ended.iter().map(|&ended| if ended { 0.0 } else { setting.gamma as f32 });
            let discounts: Vec<f32> = discounts.collect();
            column(&minibatch.rewards) + column(&discounts) * left
        });
        let levels = players.network.tensor(&levels, shape);
        let chosen =
            Tensor::from_slice(&minibatch.actions).view([-1, 1, 1]).to_device(targets.device());
        let chosen = chosen.expand([n as i64, own.levels as i64, 1], false);
        let loss = |network: &Quantiles| {
            let x = network.inputs(minibatch.seen.rows(), &shown);
            let values = network.values(&x, &levels).gather(2, &chosen, false).squeeze_dim(2);
            quantile_huber(&values, &levels, &targets, own.kappa)
        };
        let loss = players.network.differentiate(loss, gradient);
        let norm = gradient.iter().map(|&by| f64::from(by).powi(2)).sum::<f64>().sqrt();
        if loss.is_finite() && norm.is_finite() {
            let all = self.turns.len() as u64 * setting.options.rollout() / own.steps_per_gradient;
            let progress = self.gradient_steps as f64 / all as f64;
            let rate = own.learning_rate * (1.0 - progress) + own.learning_rate_final * progress;
            let optimiser = &mut self.optimiser;
            players.network.change(|parameters| optimiser.step(parameters, gradient, rate));
        }
        [loss, norm]
    }
}

impl<W: Arena> Training<W> for IqnTraining<'_, W> {
    fn update(&mut self) -> Result<Option<Progress>, TrainError> {
        let Some(&turn) = self.turns.get(self.done) else { return Ok(None) };
        let exploration = self.exploration();
        self.players.aim(turn.budget.alpha());
        self.play(&turn);
        let wanted =
            (turn.update * self.setting.options.rollout()) / self.players.own.steps_per_gradient;
        let (mut sums, first) = ([0.0; 2], self.gradient_steps);
        while self.gradient_steps < wanted {
            let [loss, norm] = self.learn();
            let (update, player) = (turn.update, PLAYER);
            for (number, quantity) in [(loss, "the loss"), (norm, "the gradient")] {
                if !number.is_finite() {
                    return Err(TrainError::NotFinite { update, player, quantity });
                }
            }
            sums = [sums[0] + loss, sums[1] + norm];
            self.gradient_steps += 1;
            if self.gradient_steps.is_multiple_of(self.players.own.target_every) {
                let new = self.players.network.parameters();
                self.target.change(|parameters| parameters.copy_from_slice(new));
            }
        }
        self.players.choose_start(&self.start);
        self.done += 1;
        let [loss, norm] = sums.map(|sum| sum / (self.gradient_steps - first) as f64);
        let static_risk = self.players.own.risk == Risk::Static;
        let threshold = if static_risk { self.players.threshold.start.into() } else { f64::NAN };
        let collector = &self.collector;
        let mean_return = collector.mean_return();
        let values = vec![
            turn.budget.get(),
            threshold,
            mean_return,
            collector.mean_length(),
            collector.share(End::Goal),
            collector.share(End::Lava),
            exploration,
            loss,
            norm,
        ];
        let (update, steps, player) = (turn.update, self.steps(), PLAYER);
        Ok(Some(Progress { update, steps, player, mean_return, values }))
    }

    fn updates(&self) -> u64 {
        self.done as u64
    }

    fn steps(&self) -> u64 {
        self.updates() * self.setting.options.rollout()
    }

    fn state(&self) -> Vec<u8> {
        let state = State {
            update: self.updates(),
            gradient_steps: self.gradient_steps,
            random: position(&self.random),
            parameters: self.players.network.parameters().to_vec(),
            target: self.target.parameters().to_vec(),
            threshold: self.players.threshold,
            optimiser: self.optimiser.clone(),
            games: self.collector.state(),
            replay: self.replay.clone(),
        };
        postcard::to_allocvec(&state).expect("memory takes every byte")
    }

    fn restore(&mut self, state: &[u8]) -> Result<(), Unfit> {
        let read = postcard::take_from_bytes::<State<<W as World>::Snapshot>>(state);
        let Ok((state, [])) = read else { return Err(Unfit("the method's")) };
        let done = usize::try_from(state.update).ok().filter(|&done| done <= self.turns.len());
        let done = done.ok_or(Unfit("the schedule's"))?;
        let shape = self.players.network.shape();
        let count = shape.parameters();
        let finite = |of: &[f32]| of.len() == count && of.iter().all(|number| number.is_finite());
        if !(finite(&state.parameters) && finite(&state.target) && state.optimiser.fits(count)) {
            return Err(Unfit("the protagonist's"));
        }
        if !state.replay.fits(&self.replay, shape.columns.cells, shape.actions) {
            return Err(Unfit("the replay's"));
        }
        let seed = self.setting.seed;
        self.collector.restore(&state.games, seed)?;
        self.players.network.change(|parameters| parameters.copy_from_slice(&state.parameters));
        self.target.change(|parameters| parameters.copy_from_slice(&state.target));
        self.players.threshold = state.threshold;
        self.optimiser = state.optimiser;
        self.random = stream_from(seed, Purpose::Minibatches, 0, state.random);
        self.gradient_steps = state.gradient_steps;
        self.replay = state.replay;
        self.done = done;
        Ok(())
    }

    fn players(&self) -> &dyn Players<W> {
        &self.players
    }
}
