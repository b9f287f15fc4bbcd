//! Proximal policy optimisation (Schulman et al. 2017), one implementation for both players.
//!
//! With the probability ratio `r = pi(choice) / pi_old(choice)` and the advantage A, normalised over
//! the minibatch, a minibatch's loss is the mean of
//!
//! ```text
//! -min(r A, clip(r, 1 - eps, 1 + eps) A) - c_entropy H + c_value (V - R)^2,    R = A_gae + V_old.
//! ```
//!
//! Its gradient by the outputs of actor and critic is written out in [`Loss`]; the networks propagate it
//! to the parameters.

use crate::game::columns::{self, Column, Loops, SAMPLES, exp};
use crate::learn::adam::Adam;
use crate::learn::budget_sensitivity::BudgetSensitivity;
use crate::learn::device::Device;
use crate::learn::gae::{self, Estimates};
use crate::learn::head::{Block, Head};
use crate::learn::inputs::{Columns, Distinct, Selection};
use crate::learn::network::{Network, Outputs, Shape};
use crate::learn::options::PlayerOptions;
use crate::learn::state::{PlayerState, Unfit};
use crate::learn::trajectories::Trajectories;
use lava_envs::random::ChaCha8Rng;
use rand::seq::SliceRandom;
use std::ops::Range;

/// A player: the head that gives its outputs a meaning, its networks and its optimiser.
#[derive(Debug)]
pub struct Player<H: Head> {
    /// What the actor's outputs mean.
    pub head: H,
    /// Actor and critic.
    pub network: Network,
    optimiser: Adam,
    workspace: Workspace<H>,
}

/// Buffers of an update; they are kept because allocating them costs more than filling them.
#[derive(Debug)]
struct Workspace<H: Head> {
    values: Vec<f32>,
    advantages: Vec<f32>,
    samples: Vec<Sample<H>>,
    order: Vec<usize>,
    gradient: Vec<f32>,
}

impl<H: Head> Default for Workspace<H> {
    fn default() -> Self {
        Workspace {
            values: Vec::new(),
            advantages: Vec::new(),
            samples: Vec::new(),
            order: Vec::new(),
            gradient: Vec::new(),
        }
    }
}

/// What an update reports, under the names that CleanRL's users know; means over its minibatches.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Losses {
    /// Clipped surrogate loss.
    pub policy_loss: f64,
    /// Mean squared error of the critic, before its coefficient.
    pub value_loss: f64,
    /// Mean entropy of the player's law in nats.
    pub entropy: f64,
    /// Schulman's low-variance estimate of KL(old || new): mean of (r - 1) - log r.
    pub approx_kl: f64,
    /// Share of samples whose ratio is outside the clip range.
    pub clip_fraction: f64,
    /// Norm of the gradient before clipping.
    pub gradient_norm: f64,
    /// Share of the returns' variance that the old values explain.
    pub explained_variance: f64,
}

impl Losses {
    /// The first quantity that is not a finite number.
    pub fn not_finite(&self) -> Option<&'static str> {
        [
            ("policy_loss", self.policy_loss),
            ("value_loss", self.value_loss),
            ("entropy", self.entropy),
            ("gradient_norm", self.gradient_norm),
        ]
        .into_iter()
        .find_map(|(name, value)| (!value.is_finite()).then_some(name))
    }

    /// The means of two updates.
    pub fn mean(of: [Losses; 2]) -> Losses {
        let mut mean = Losses::default();
        for losses in &of {
            mean.add(losses, 0.5);
            mean.explained_variance += 0.5 * losses.explained_variance;
        }
        mean
    }

    fn add(&mut self, other: &Losses, weight: f64) {
        self.policy_loss += weight * other.policy_loss;
        self.value_loss += weight * other.value_loss;
        self.entropy += weight * other.entropy;
        self.approx_kl += weight * other.approx_kl;
        self.clip_fraction += weight * other.clip_fraction;
        self.gradient_norm += weight * other.gradient_norm;
    }
}

/// Learning rate and entropy weight of one update.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rates {
    /// Adam's learning rate.
    pub learning_rate: f64,
    /// Weight of the entropy bonus.
    pub entropy: f64,
}

/// What an update reinforces the choices by.
#[derive(Debug, Clone, Copy)]
pub enum Signal<'a> {
    /// The advantages by the player's own critic.
    Own,
    /// The same, charged for the budget that was spent.
    Charged(&'a BudgetSensitivity),
    /// These, of shape `[steps, slots]`.
    Given(&'a [f32]),
    /// These, where the mean of the score is not 0: to subtract a constant from them would change the
    /// gradient. They are scaled by their root mean square and not centred.
    Uncentred(&'a [f32]),
}

/// One sample as the loss sees it.
#[derive(Debug, Clone)]
pub struct Sample<H: Head> {
    /// What the law depended on.
    pub given: H::Given,
    /// What was chosen.
    pub choice: H::Choice,
    /// log-probability of the choice when it was made.
    pub log_probability: f64,
    /// Advantage estimate, not normalised.
    pub advantage: f32,
    /// Target R of the critic.
    pub target: f32,
}

impl<H: Head> Player<H> {
    /// A fresh player that sees samples of these sizes.
    pub fn new(
        head: H,
        columns: Columns,
        hidden: usize,
        device: Device,
        random: &mut ChaCha8Rng,
    ) -> Self {
        let constants = head.constants();
        let shape = Shape { columns, hidden, outputs: head.outputs(), constants: constants.len() };
        Self::with_network(head, Network::new(shape, &constants, device, random))
    }

    /// A player with a given network and a fresh optimiser.
    pub fn with_network(head: H, network: Network) -> Self {
        let shape = network.shape();
        let optimiser = Adam::new(shape.parameters());
        Player { head, network, optimiser, workspace: Workspace::default() }
    }

    /// The first quantity of the player that is not a finite number, or would not be in play.
    pub fn not_finite(&self) -> Option<&'static str> {
        self.network.not_finite()
    }

    /// All that the next updates depend on.
    pub fn state(&self) -> PlayerState {
        PlayerState {
            parameters: self.network.parameters().to_vec(),
            optimiser: self.optimiser.clone(),
        }
    }

    /// Continues from a state.
    ///
    /// # Errors
    /// If it is of another network or not finite.
    pub fn restore(&mut self, state: PlayerState) -> Result<(), Unfit> {
        let PlayerState { parameters, optimiser } = state;
        let count = self.network.shape().parameters();
        if parameters.len() != count || !optimiser.fits(count) {
            return Err(Unfit("a player's"));
        }
        self.network.change(|own| own.copy_from_slice(&parameters));
        self.optimiser = optimiser;
        self.not_finite().map_or(Ok(()), |_| Err(Unfit("a player's")))
    }

    /// Writes the parameters of the head in a slot: the actor's outputs there, of shape `[k, slots]`,
    /// and the head's constants.
    pub fn parameters_in(&self, outputs: &[f32], slot: usize, parameters: &mut Vec<f64>) {
        let shape = self.network.shape();
        let slots = outputs.len() / shape.outputs;
        parameters.resize(shape.outputs + shape.constants, 0.0);
        let (own, constants) = parameters.split_at_mut(shape.outputs);
        for (parameter, row) in own.iter_mut().zip(outputs.chunks_exact(slots)) {
            *parameter = f64::from(row[slot]);
        }
        for (parameter, &constant) in constants.iter_mut().zip(self.network.constants()) {
            *parameter = f64::from(constant);
        }
    }

    /// Writes the parameters of the head in a block of at most `SAMPLES` slots, a column each: the actor's
    /// outputs there, of shape `[k, slots]`, and the head's constants.
    pub fn columns_in(&self, outputs: &[f32], block: Range<usize>, columns: &mut Vec<Column>) {
        let shape = self.network.shape();
        let slots = outputs.len() / shape.outputs;
        columns.resize(shape.outputs + shape.constants, [0.0; SAMPLES]);
        let (own, constants) = columns.split_at_mut(shape.outputs);
        for (column, row) in own.iter_mut().zip(outputs.chunks_exact(slots)) {
            column.iter_mut().zip(&row[block.clone()]).for_each(|(to, &from)| *to = from.into());
        }
        for (column, &constant) in constants.iter_mut().zip(self.network.constants()) {
            column.fill(constant.into());
        }
    }

    /// log-probabilities of choices, from outputs of the actor of shape `[k, slots]`, appended to
    /// `log_probabilities`.
    pub fn log_probabilities(
        &self,
        outputs: &[f32],
        given: &[H::Given],
        choices: &[H::Choice],
        log_probabilities: &mut Vec<f64>,
    ) {
        let (mut columns, mut column) = (Vec::new(), [0.0; SAMPLES]);
        for start in (0..choices.len()).step_by(SAMPLES) {
            let block = start..choices.len().min(start + SAMPLES);
            self.columns_in(outputs, block.clone(), &mut columns);
            let (given, choices) = (&given[block.clone()], &choices[block]);
            self.head.log_probabilities(&columns, given, choices, &mut column);
            log_probabilities.extend_from_slice(&column[..choices.len()]);
        }
    }

    /// Values and advantages along trajectories, by the critic.
    pub fn estimates(
        &self,
        trajectories: &Trajectories<H::Given, H::Choice>,
        gamma: f64,
        options: &PlayerOptions,
    ) -> Estimates {
        let Trajectories { rewards, ended, slots, .. } = trajectories;
        let (mut values, mut advantages) = (Vec::new(), Vec::new());
        self.network.values(trajectories.inputs.rows(), &mut values);
        let lambda = options.gae_lambda;
        gae::advantages(rewards, ended, &values, *slots, gamma, lambda, &mut advantages);
        Estimates { values, advantages }
    }

    /// One update on the trajectories of a rollout: epochs of minibatches in random order. The targets of
    /// the critic are always its own.
    pub fn update(
        &mut self,
        trajectories: &Trajectories<H::Given, H::Choice>,
        signal: Signal<'_>,
        gamma: f64,
        options: &PlayerOptions,
        rates: Rates,
        random: &mut ChaCha8Rng,
    ) -> Losses {
        let Workspace { values, advantages, samples, order, gradient } = &mut self.workspace;
        let width = self.network.shape().width();
        let batch = trajectories.inputs.rows();
        let distinct = Distinct::within(batch, width, options.minibatch / 2);
        match &distinct {
            Some(Distinct { inputs, of }) => {
                let mut each = Vec::new();
                self.network.values(inputs.rows(), &mut each);
                values.clear();
                values.extend(of.iter().map(|&place| each[place]));
            }
            None => self.network.values(batch, values),
        }
        gae::advantages(
            &trajectories.rewards,
            &trajectories.ended,
            values,
            trajectories.slots,
            gamma,
            options.gae_lambda,
            advantages,
        );
        samples.clear();
        samples.extend((0..advantages.len()).map(|i| Sample {
            given: trajectories.given[i],
            choice: trajectories.choices[i],
            log_probability: trajectories.log_probabilities[i],
            advantage: advantages[i],
            target: advantages[i] + values[i],
        }));
        let reinforced = match signal {
            Signal::Own => &advantages[..],
            Signal::Charged(sensitivity) => {
                sensitivity.charge(advantages, &trajectories.ended, gamma);
                &advantages[..]
            }
            Signal::Given(advantages) | Signal::Uncentred(advantages) => advantages,
        };
        for (sample, &advantage) in samples.iter_mut().zip(reinforced) {
            sample.advantage = advantage;
        }
        let centred = !matches!(signal, Signal::Uncentred(_));

        order.clear();
        order.extend(0..samples.len());
        let mut losses =
            Losses { explained_variance: explained_variance(samples, values), ..Losses::default() };
        let minibatches = samples.len().div_ceil(options.minibatch) as f64;
        let weight = 1.0 / (minibatches * f64::from(options.epochs));
        for _ in 0..options.epochs {
            order.shuffle(random);
            for indices in order.chunks(options.minibatch) {
                let constants = self.network.constants().to_vec();
                let minibatch = (&samples[..], indices);
                let mut loss = Loss::new(&self.head, minibatch, options, rates.entropy, &constants);
                if !centred {
                    loss = loss.uncentred();
                }
                let places: Vec<usize>;
                let inputs = match &distinct {
                    Some(Distinct { inputs, of }) => {
                        places = indices.iter().map(|&i| of[i]).collect();
                        Selection { all: inputs.rows(), indices: &places }
                    }
                    None => Selection { all: batch, indices },
                };
                self.network.differentiate(inputs, gradient, |block| loss.add(block));
                let at = gradient.len() - constants.len();
                let mut step = loss.finish(&mut gradient[at..]);
                step.gradient_norm = clip_norm(gradient, options.gradient_norm);
                losses.add(&step, weight);
                let optimiser = &mut self.optimiser;
                self.network.change(|parameters| {
                    optimiser.step(parameters, gradient, rates.learning_rate);
                });
            }
        }
        losses
    }
}

/// The loss of a minibatch and its gradient by the outputs of the network, block by block. All that is of single
/// samples is in columns ([`crate::game::columns`]).
pub struct Loss<'a, H: Head> {
    head: &'a H,
    samples: &'a [Sample<H>],
    indices: &'a [usize],
    terms: Terms,
    given: Vec<H::Given>,
    choices: Vec<H::Choice>,
    /// Parameters of the head; the constants are in place.
    parameters: Vec<Column>,
    score: Vec<Column>,
    entropy_gradient: Vec<Column>,
    sums: Sums,
}

/// What the loss of a sample depends on besides the sample.
#[derive(Clone, Copy)]
struct Terms {
    clip: f64,
    entropy_weight: f64,
    value_coefficient: f64,
    /// Of the minibatch's advantages.
    mean: f64,
    /// 1 over their standard deviation.
    scale: f64,
    /// 1 over the number of samples.
    share: f64,
}

/// Sums over the blocks of a minibatch, to be summed over the columns.
struct Sums {
    policy_loss: Column,
    value_loss: Column,
    entropy: Column,
    approx_kl: Column,
    clipped: Column,
    /// Of the gradient by each of the head's constants.
    by_constants: Vec<Column>,
}

impl<'a, H: Head> Loss<'a, H> {
    /// The loss of a minibatch, the samples of these indices, with the head's constants.
    pub fn new(
        head: &'a H,
        (samples, indices): (&'a [Sample<H>], &'a [usize]),
        options: &'a PlayerOptions,
        entropy_weight: f64,
        constants: &[f32],
    ) -> Self {
        let number = indices.len() as f64;
        let advantages = indices.iter().map(|&i| f64::from(samples[i].advantage));
        let mean = advantages.clone().sum::<f64>() / number;
        let squares = advantages.map(|advantage| (advantage - mean).powi(2)).sum::<f64>();
        let variance = squares / (number - 1.0).max(1.0);
        let terms = Terms {
            clip: options.clip,
            entropy_weight,
            value_coefficient: options.value_coefficient,
            mean,
            scale: 1.0 / (variance.sqrt() + 1e-8),
            share: 1.0 / number,
        };
        let none = [0.0; SAMPLES];
        let mut parameters = vec![none; head.outputs()];
        parameters.extend(constants.iter().map(|&constant| [f64::from(constant); SAMPLES]));
        let count = parameters.len();
        Loss {
            head,
            samples,
            indices,
            terms,
            given: Vec::with_capacity(SAMPLES),
            choices: Vec::with_capacity(SAMPLES),
            parameters,
            score: vec![none; count],
            entropy_gradient: vec![none; count],
            sums: Sums {
                policy_loss: none,
                value_loss: none,
                entropy: none,
                approx_kl: none,
                clipped: none,
                by_constants: vec![none; constants.len()],
            },
        }
    }

    /// The same with advantages that are not centred, and scaled by their root mean square.
    pub fn uncentred(mut self) -> Self {
        let advantages = self.indices.iter().map(|&i| f64::from(self.samples[i].advantage));
        let squares = advantages.map(|advantage| advantage.powi(2)).sum::<f64>();
        self.terms.mean = 0.0;
        self.terms.scale = 1.0 / ((squares * self.terms.share).sqrt() + 1e-8);
        self
    }

    /// Adds the samples of a block, whose y holds the actor's outputs and below them the values.
    pub fn add(&mut self, block: Outputs<'_>) {
        let Outputs { start, samples, y, stride } = block;
        for first in (0..samples).step_by(SAMPLES) {
            let count = SAMPLES.min(samples - first);
            self.add_columns(start + first, count, &mut y[first..], stride);
        }
    }

    fn add_columns(&mut self, start: usize, count: usize, y: &mut [f32], stride: usize) {
        let Loss { head, terms, given, choices, sums, .. } = self;
        let Loss { parameters, score, entropy_gradient, .. } = self;
        let samples = self.indices[start..start + count].iter().map(|&i| &self.samples[i]);
        given.clear();
        choices.clear();
        let none = [0.0; SAMPLES];
        let outputs = head.outputs();
        for (column, row) in parameters[..outputs].iter_mut().zip(y.chunks(stride)) {
            *column = none;
            for (parameter, &output) in column.iter_mut().zip(&row[..count]) {
                *parameter = f64::from(output);
            }
        }
        let (mut old, mut advantage, mut target, mut value) = (none, none, none, none);
        // A share of 0 leaves out what is no sample.
        let mut share = none;
        for (i, sample) in samples.enumerate() {
            given.push(sample.given);
            choices.push(sample.choice);
            old[i] = sample.log_probability;
            advantage[i] = f64::from(sample.advantage);
            target[i] = f64::from(sample.target);
            value[i] = f64::from(y[outputs * stride + i]);
            share[i] = terms.share;
        }
        let (mut log_probability, mut entropy) = (none, none);
        head.gradients_of_block(Block {
            parameters,
            given,
            choices,
            log_probability: &mut log_probability,
            entropy: &mut entropy,
            score,
            entropy_gradient,
        });
        columns::widest(Clipped {
            terms: *terms,
            share: &share,
            log_probability: &log_probability,
            old: &old,
            advantage: &advantage,
            entropy: &entropy,
            target: &target,
            value: &mut value,
            score,
            entropy_gradient,
            sums,
        });
        let gradient = self.score[..outputs].iter().chain([&value]);
        for (row, column) in y.chunks_mut(stride).zip(gradient) {
            for (entry, &by_output) in row[..count].iter_mut().zip(column) {
                *entry = by_output as f32;
            }
        }
    }

    /// Writes the gradient by the head's constants and returns the losses.
    pub fn finish(self, by_constants: &mut [f32]) -> Losses {
        let sum = |column: &Column| column.iter().sum::<f64>();
        for (slot, column) in by_constants.iter_mut().zip(&self.sums.by_constants) {
            *slot = sum(column) as f32;
        }
        Losses {
            policy_loss: sum(&self.sums.policy_loss),
            value_loss: sum(&self.sums.value_loss),
            entropy: sum(&self.sums.entropy),
            approx_kl: sum(&self.sums.approx_kl),
            clip_fraction: sum(&self.sums.clipped),
            ..Losses::default()
        }
    }
}

/// The clipped surrogate, the bonus and the critic's error of a block of samples.
struct Clipped<'a> {
    terms: Terms,
    share: &'a Column,
    log_probability: &'a Column,
    old: &'a Column,
    advantage: &'a Column,
    entropy: &'a Column,
    target: &'a Column,
    /// V, to be turned into the gradient by it.
    value: &'a mut Column,
    /// Gradients of the log-probability by the parameters, to be turned into those of the loss.
    score: &'a mut [Column],
    entropy_gradient: &'a [Column],
    sums: &'a mut Sums,
}

impl Loops for Clipped<'_> {
    #[inline(always)]
    fn run(self) {
        let Clipped { terms, share, log_probability, old, advantage, entropy, target, .. } = self;
        let Clipped { value, score, entropy_gradient, sums, .. } = self;
        let mut by_log_probability = [0.0; SAMPLES];
        for i in 0..SAMPLES {
            let log_ratio = log_probability[i] - old[i];
            let ratio = exp(log_ratio);
            let advantage = (advantage[i] - terms.mean) * terms.scale;
            let (least, most) = (1.0 - terms.clip, 1.0 + terms.clip);
            let clipped = if ratio < least { least } else { ratio };
            let clipped = if clipped > most { most } else { clipped };
            // Where the clipped branch is the smaller one it is constant in the parameters.
            let follows = ratio * advantage <= clipped * advantage;
            let surrogate = if follows { ratio } else { clipped } * advantage;
            by_log_probability[i] = if follows { -share[i] * ratio * advantage } else { 0.0 };
            let error = value[i] - target[i];
            value[i] = 2.0 * terms.value_coefficient * share[i] * error;
            sums.policy_loss[i] -= share[i] * surrogate;
            sums.value_loss[i] += share[i] * error * error;
            sums.entropy[i] += share[i] * entropy[i];
            sums.approx_kl[i] += share[i] * (ratio - 1.0 - log_ratio);
            sums.clipped[i] += if ratio == clipped { 0.0 } else { share[i] };
        }
        for (score, by_entropy) in score.iter_mut().zip(entropy_gradient) {
            for i in 0..SAMPLES {
                let bonus = terms.entropy_weight * share[i] * by_entropy[i];
                score[i] = by_log_probability[i] * score[i] - bonus;
            }
        }
        let outputs = score.len() - sums.by_constants.len();
        for (sum, column) in sums.by_constants.iter_mut().zip(&score[outputs..]) {
            for i in 0..SAMPLES {
                sum[i] += column[i];
            }
        }
    }
}

fn clip_norm(gradient: &mut [f32], limit: f64) -> f64 {
    let norm = gradient.iter().map(|&g| f64::from(g) * f64::from(g)).sum::<f64>().sqrt();
    if norm > limit {
        let scale = (limit / norm) as f32;
        gradient.iter_mut().for_each(|g| *g *= scale);
    }
    norm
}

fn explained_variance<H: Head>(samples: &[Sample<H>], values: &[f32]) -> f64 {
    let variance = |numbers: &mut dyn Iterator<Item = f64>| {
        let (mut count, mut sum, mut squares) = (0.0, 0.0, 0.0);
        for x in numbers {
            count += 1.0;
            sum += x;
            squares += x * x;
        }
        squares / count - (sum / count).powi(2)
    };
    let targets = variance(&mut samples.iter().map(|s| f64::from(s.target)));
    let pairs = samples.iter().zip(values);
    let errors = variance(&mut pairs.map(|(s, &v)| f64::from(s.target) - f64::from(v)));
    if targets > 0.0 { 1.0 - errors / targets } else { 0.0 }
}
