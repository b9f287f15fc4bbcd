//! Heads: what the outputs of an actor mean.
//!
//! PPO needs of a player's law nothing but draws, log-probabilities and the gradients of
//! log-probability and entropy by the actor's outputs; [`Head`] is just that. The protagonist's
//! heads are the categorical and the Gaussian policy. The antagonist's policy IS the perturbed law
//! of chance and its action IS the realised outcome, so its head wraps a family of perturbations.

use cvar_game::game::budget::Budget;
use cvar_game::game::bump;
use cvar_game::game::gaussian::MAX_BUMPS;
use cvar_game::game::perturbation::{Family, Perturbation};
use lava_envs::law::{Law, MOVES, sample_index};
use lava_envs::{Force, Move};
use nalgebra::Vector2;
use rand::{Rng, RngExt};
use rand_distr::StandardNormal;

/// The most parameters that a head takes: those of a sum of bumps with their weights.
pub const MAX_PARAMETERS: usize = (bump::PARAMETERS + 1) * MAX_BUMPS;

/// The law of a player's choice, given the outputs of its actor.
///
/// The head's parameters are the actor's outputs followed by the head's constants, parameters that
/// no observation moves.
pub trait Head: Clone + std::fmt::Debug {
    /// What the law depends on beside its parameters.
    type Given: Copy + std::fmt::Debug;
    /// What is chosen.
    type Choice: Copy + std::fmt::Debug;

    /// Number of outputs of the actor.
    fn outputs(&self) -> usize;

    /// Initial values of the constants.
    fn constants(&self) -> Vec<f32> {
        Vec::new()
    }

    /// log-probability (density) of the choice.
    fn log_probability(
        &self,
        parameters: &[f64],
        given: &Self::Given,
        choice: &Self::Choice,
    ) -> f64;

    /// log-probability of the choice and entropy of the law, with their gradients by the
    /// parameters.
    fn gradients(
        &self,
        parameters: &[f64],
        given: &Self::Given,
        choice: &Self::Choice,
        score: &mut [f64],
        entropy_gradient: &mut [f64],
    ) -> (f64, f64);
}

/// A protagonist's head: a law of actions.
pub trait Policy: Head<Given = ()> {
    /// Draws an action.
    fn draw(&self, parameters: &[f64], random: &mut impl Rng) -> Self::Choice;

    /// The greedy action: the mode of the law.
    fn greedy(&self, parameters: &[f64]) -> Self::Choice;
}

/// Softmax over the four moves.
#[derive(Debug, Clone, Copy, Default)]
pub struct CategoricalPolicy;

impl CategoricalPolicy {
    /// Probabilities of the moves, from logits.
    pub fn probabilities(logits: &[f64]) -> [f64; MOVES] {
        Self::softmax(logits).0
    }

    /// Probabilities and log-probabilities of the moves.
    fn softmax(logits: &[f64]) -> ([f64; MOVES], [f64; MOVES]) {
        let highest = logits[..MOVES].iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let weights: [f64; MOVES] = std::array::from_fn(|i| (logits[i] - highest).exp());
        let sum: f64 = weights.iter().sum();
        let shift = highest + sum.ln();
        (weights.map(|weight| weight / sum), std::array::from_fn(|i| logits[i] - shift))
    }
}

impl Head for CategoricalPolicy {
    type Given = ();
    type Choice = Move;

    fn outputs(&self) -> usize {
        MOVES
    }

    fn log_probability(&self, parameters: &[f64], _: &(), choice: &Move) -> f64 {
        Self::softmax(parameters).1[choice.index()]
    }

    fn gradients(
        &self,
        parameters: &[f64],
        _: &(),
        choice: &Move,
        score: &mut [f64],
        entropy_gradient: &mut [f64],
    ) -> (f64, f64) {
        let (probabilities, logs) = Self::softmax(parameters);
        let entropy: f64 = -(0..MOVES).map(|i| probabilities[i] * logs[i]).sum::<f64>();
        for i in 0..MOVES {
            score[i] = f64::from(i == choice.index()) - probabilities[i];
            entropy_gradient[i] = -probabilities[i] * (logs[i] + entropy);
        }
        (logs[choice.index()], entropy)
    }
}

impl Policy for CategoricalPolicy {
    fn draw(&self, parameters: &[f64], random: &mut impl Rng) -> Move {
        Move::ALL[sample_index(&Self::probabilities(parameters), random)]
    }

    fn greedy(&self, parameters: &[f64]) -> Move {
        let best = (1..MOVES).fold(0, |b, i| if parameters[i] > parameters[b] { i } else { b });
        Move::ALL[best]
    }
}

/// log(2 pi).
const LOG_2_PI: f64 = 1.837_877_066_409_345_3;

/// Gaussian over forces in the plane: the actor's outputs are the mean, the constants the log
/// standard deviations. Its density is that of the draw itself, before the world scales a force
/// longer than 1 onto the unit disc.
#[derive(Debug, Clone, Copy)]
pub struct GaussianPolicy {
    /// Standard deviation at the start of training.
    pub initial_std: f64,
}

impl Head for GaussianPolicy {
    type Given = ();
    type Choice = Force;

    fn outputs(&self) -> usize {
        2
    }

    fn constants(&self) -> Vec<f32> {
        vec![self.initial_std.ln() as f32; 2]
    }

    fn log_probability(&self, parameters: &[f64], _: &(), choice: &Force) -> f64 {
        (0..2)
            .map(|i| {
                let z = (choice.0[i] - parameters[i]) / parameters[2 + i].exp();
                -0.5 * z * z - parameters[2 + i] - 0.5 * LOG_2_PI
            })
            .sum()
    }

    fn gradients(
        &self,
        parameters: &[f64],
        _: &(),
        choice: &Force,
        score: &mut [f64],
        entropy_gradient: &mut [f64],
    ) -> (f64, f64) {
        let mut entropy = 1.0 + LOG_2_PI;
        let mut log_probability = 0.0;
        for i in 0..2 {
            let std = parameters[2 + i].exp();
            let z = (choice.0[i] - parameters[i]) / std;
            score[i] = z / std;
            score[2 + i] = z * z - 1.0;
            entropy_gradient[i] = 0.0;
            entropy_gradient[2 + i] = 1.0;
            entropy += parameters[2 + i];
            log_probability += -0.5 * z * z - parameters[2 + i] - 0.5 * LOG_2_PI;
        }
        (log_probability, entropy)
    }
}

impl Policy for GaussianPolicy {
    fn draw(&self, parameters: &[f64], random: &mut impl Rng) -> Force {
        let [x, y] = std::array::from_fn(|i| {
            parameters[i] + parameters[2 + i].exp() * random.sample::<f64, _>(StandardNormal)
        });
        Force(Vector2::new(x, y))
    }

    fn greedy(&self, parameters: &[f64]) -> Force {
        Force(Vector2::new(parameters[0], parameters[1]))
    }
}

/// The antagonist's head: log-probability `log(P_t(o) delta_t(o))` of the realised outcome.
#[derive(Debug, Clone, Copy)]
pub struct AntagonistHead<F>(pub F);

impl<F: Family> Head for AntagonistHead<F> {
    type Given = (F::Law, Budget);
    type Choice = <F::Law as Law>::Outcome;

    fn outputs(&self) -> usize {
        self.0.parameters()
    }

    fn log_probability(
        &self,
        parameters: &[f64],
        (law, budget): &Self::Given,
        outcome: &Self::Choice,
    ) -> f64 {
        let perturbation = self.0.perturbation(parameters, law, *budget);
        law.log_density(*outcome) + perturbation.likelihood_ratio(*outcome).ln()
    }

    fn gradients(
        &self,
        parameters: &[f64],
        (law, budget): &Self::Given,
        outcome: &Self::Choice,
        score: &mut [f64],
        entropy_gradient: &mut [f64],
    ) -> (f64, f64) {
        let perturbation = self.0.perturbation(parameters, law, *budget);
        let ratio = perturbation.score(*outcome, score);
        let entropy = perturbation.entropy(entropy_gradient);
        (law.log_density(*outcome) + ratio.ln(), entropy)
    }
}
