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

use crate::learn::adam::Adam;
use crate::learn::budget_sensitivity::BudgetSensitivity;
use crate::learn::device::Device;
use crate::learn::gae::{self, Estimates};
use crate::learn::head::Head;
use crate::learn::inputs::{Columns, Inputs};
use crate::learn::network::{Network, Outputs, Shape};
use crate::learn::options::PlayerOptions;
use crate::learn::state::{PlayerState, Unfit};
use crate::learn::trajectories::Trajectories;
use lava_envs::random::ChaCha8Rng;
use rand::seq::SliceRandom;

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
    inputs: Inputs,
    batch: Vec<Sample<H>>,
    gradient: Vec<f32>,
}

impl<H: Head> Default for Workspace<H> {
    fn default() -> Self {
        Workspace {
            values: Vec::new(),
            advantages: Vec::new(),
            samples: Vec::new(),
            order: Vec::new(),
            inputs: Inputs::default(),
            batch: Vec::new(),
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
        let Workspace { values, advantages, samples, order, inputs, batch, gradient } =
            &mut self.workspace;
        self.network.values(trajectories.inputs.rows(), values);
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

        let width = self.network.shape().width();
        order.clear();
        order.extend(0..samples.len());
        let mut losses =
            Losses { explained_variance: explained_variance(samples, values), ..Losses::default() };
        let minibatches = samples.len().div_ceil(options.minibatch) as f64;
        let weight = 1.0 / (minibatches * f64::from(options.epochs));
        for _ in 0..options.epochs {
            order.shuffle(random);
            for indices in order.chunks(options.minibatch) {
                inputs.clear();
                batch.clear();
                for &i in indices {
                    inputs.extend(trajectories.inputs.rows().row(i, width));
                    batch.push(samples[i].clone());
                }
                let constants = self.network.constants().to_vec();
                let mut loss = Loss::new(&self.head, batch, options, rates.entropy, &constants);
                if !centred {
                    loss = loss.uncentred();
                }
                self.network.differentiate(inputs.rows(), gradient, |block| loss.add(block));
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

/// The loss of a minibatch and its gradient by the outputs of the network, block by block.
pub struct Loss<'a, H: Head> {
    head: &'a H,
    samples: &'a [Sample<H>],
    options: &'a PlayerOptions,
    entropy_weight: f64,
    /// Of the minibatch's advantages.
    mean: f64,
    /// 1 over their standard deviation.
    scale: f64,
    /// Parameters of the head; the constants are in place.
    parameters: Vec<f64>,
    by_constants: Vec<f64>,
    score: Vec<f64>,
    by_entropy: Vec<f64>,
    losses: Losses,
}

impl<'a, H: Head> Loss<'a, H> {
    /// The loss of these samples, with the head's constants.
    pub fn new(
        head: &'a H,
        samples: &'a [Sample<H>],
        options: &'a PlayerOptions,
        entropy_weight: f64,
        constants: &[f32],
    ) -> Self {
        let number = samples.len() as f64;
        let mean = samples.iter().map(|s| f64::from(s.advantage)).sum::<f64>() / number;
        let variance = samples.iter().map(|s| (f64::from(s.advantage) - mean).powi(2)).sum::<f64>()
            / (number - 1.0).max(1.0);
        let scale = 1.0 / (variance.sqrt() + 1e-8);
        let mut parameters = vec![0.0; head.outputs()];
        parameters.extend(constants.iter().map(|&constant| f64::from(constant)));
        let count = parameters.len();
        Loss {
            head,
            samples,
            options,
            entropy_weight,
            mean,
            scale,
            parameters,
            by_constants: vec![0.0; count],
            score: vec![0.0; count],
            by_entropy: vec![0.0; count],
            losses: Losses::default(),
        }
    }

    /// The same with advantages that are not centred, and scaled by their root mean square.
    pub fn uncentred(self) -> Self {
        let squares = self.samples.iter().map(|s| f64::from(s.advantage).powi(2)).sum::<f64>();
        let scale = 1.0 / ((squares / self.samples.len() as f64).sqrt() + 1e-8);
        Loss { mean: 0.0, scale, ..self }
    }

    /// Adds the samples of a block, whose y holds the actor's outputs and below them the values.
    pub fn add(&mut self, block: Outputs<'_>) {
        let Outputs { start, samples, y, stride } = block;
        let options = self.options;
        let share = 1.0 / self.samples.len() as f64;
        let outputs = self.head.outputs();
        let Loss { parameters, score, by_entropy, by_constants, losses, .. } = self;
        for (column, sample) in self.samples[start..start + samples].iter().enumerate() {
            for (i, parameter) in parameters[..outputs].iter_mut().enumerate() {
                *parameter = f64::from(y[i * stride + column]);
            }
            let (log_probability, entropy) =
                self.head.gradients(parameters, &sample.given, &sample.choice, score, by_entropy);
            let log_ratio = log_probability - sample.log_probability;
            let ratio = log_ratio.exp();
            let advantage = (f64::from(sample.advantage) - self.mean) * self.scale;
            let clipped = ratio.clamp(1.0 - options.clip, 1.0 + options.clip);
            let surrogate = (ratio * advantage).min(clipped * advantage);
            // Where the clipped branch is the smaller one it is constant in the parameters.
            let by_log_probability = if ratio * advantage <= clipped * advantage {
                -share * ratio * advantage
            } else {
                0.0
            };
            let value = &mut y[outputs * stride + column];
            let error = f64::from(*value) - f64::from(sample.target);
            *value = (2.0 * options.value_coefficient * share * error) as f32;

            losses.policy_loss -= share * surrogate;
            losses.value_loss += share * error * error;
            losses.entropy += share * entropy;
            losses.approx_kl += share * (ratio - 1.0 - log_ratio);
            losses.clip_fraction += share * f64::from(u8::from(ratio != clipped));

            let entropy_weight = share * self.entropy_weight;
            let gradient =
                |i: usize| by_log_probability * score[i] - entropy_weight * by_entropy[i];
            for i in 0..outputs {
                y[i * stride + column] = gradient(i) as f32;
            }
            for (i, sum) in by_constants[outputs..].iter_mut().enumerate() {
                *sum += gradient(outputs + i);
            }
        }
    }

    /// Writes the gradient by the head's constants and returns the losses.
    pub fn finish(self, by_constants: &mut [f32]) -> Losses {
        for (slot, value) in by_constants.iter_mut().zip(&self.by_constants[self.head.outputs()..])
        {
            *slot = *value as f32;
        }
        self.losses
    }
}

/// Scales the gradient down to `limit` if it is longer; returns its norm before that.
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
