//! Heads: what the outputs of an actor mean.
//!
//! PPO needs only draws, log-probabilities and the gradients of log-probability and entropy by
//! the actor's outputs of a player's law; [`Head`] is exactly that. The protagonist's
//! heads are the categorical and the Gaussian policy, and the one of [`super::plane`]. The antagonist's policy IS the perturbed law
//! of chance and its action IS the realised outcome, so its head wraps a family of perturbations.

use super::options::TrainOptions;
use super::policy::Mode;
use crate::game::budget::Budget;
use crate::game::columns::{self, Column, Loops, SAMPLES, exp, ln};
use crate::game::normal::LOG_2_PI;
use crate::game::perturbation::{self, Family, Perturbation};
use lava_envs::Force;
use lava_envs::action::{Action, ActionKind, Discrete, Finite};
use lava_envs::law::{FiniteLaw, GaussianLaw, Law};
use nalgebra::Vector2;
use rand::Rng;
use smallvec::SmallVec;
use std::marker::PhantomData;

/// The law of a player's choice, given the outputs of its actor.
///
/// The head's parameters are the actor's outputs followed by the head's constants, parameters that
/// do not depend on the observation.
pub trait Head: Clone + std::fmt::Debug + Send {
    /// What the law depends on besides its parameters.
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

    /// log-probabilities of the choices of a block of samples, at most `SAMPLES`. Heads override it with columns.
    fn log_probabilities(
        &self,
        parameters: &[Column],
        given: &[Self::Given],
        choices: &[Self::Choice],
        log_probability: &mut Column,
    ) {
        let mut own = vec![0.0; parameters.len()];
        for (i, (given, choice)) in given.iter().zip(choices).enumerate() {
            own.iter_mut().zip(parameters).for_each(|(own, column)| *own = column[i]);
            log_probability[i] = self.log_probability(&own, given, choice);
        }
    }

    /// [`Head::gradients`] of a block of samples. Heads override it with columns ([`crate::game::columns`]); this
    /// is their reference.
    fn gradients_of_block(&self, block: Block<'_, Self>) {
        let Block { parameters, given, choices, .. } = block;
        let count = parameters.len();
        let [mut own, mut by_choice, mut by_entropy] = [(); 3].map(|()| vec![0.0; count]);
        for (i, (given, choice)) in given.iter().zip(choices).enumerate() {
            for (own, column) in own.iter_mut().zip(parameters) {
                *own = column[i];
            }
            (block.log_probability[i], block.entropy[i]) =
                self.gradients(&own, given, choice, &mut by_choice, &mut by_entropy);
            for k in 0..count {
                block.score[k][i] = by_choice[k];
                block.entropy_gradient[k][i] = by_entropy[k];
            }
        }
    }
}

/// At most `SAMPLES` samples, and what learning needs of their laws.
pub struct Block<'a, H: Head> {
    /// The head's parameters, a column each.
    pub parameters: &'a [Column],
    /// What the laws depend on besides.
    pub given: &'a [H::Given],
    /// What was chosen.
    pub choices: &'a [H::Choice],
    /// Receives the log-probabilities of the choices.
    pub log_probability: &'a mut Column,
    /// Receives the entropies of the laws.
    pub entropy: &'a mut Column,
    /// Receives the gradient of the log-probability by the parameters.
    pub score: &'a mut [Column],
    /// Receives that of the entropy.
    pub entropy_gradient: &'a mut [Column],
}

/// A protagonist's head: a law of actions, which is a law of noise and a map from noise to actions.
pub trait PolicyHead: Head<Given = ()> {
    /// The law of the noise.
    type Noise: Law;

    /// The law of the noise with these parameters.
    fn noise(&self, parameters: &[f64]) -> Self::Noise;

    /// The action that the noise means.
    fn realise(&self, parameters: &[f64], noise: <Self::Noise as Law>::Outcome) -> Self::Choice;

    /// Draws an action.
    fn draw(&self, parameters: &[f64], random: &mut impl Rng) -> Self::Choice {
        self.realise(parameters, self.noise(parameters).sample(random))
    }

    /// The greedy action: the mode of the law.
    fn greedy(&self, parameters: &[f64]) -> Self::Choice;

    /// The probability of each action, appended to `probabilities`; `false`, without appending anything,
    /// where actions are not finitely many.
    fn probabilities(&self, parameters: &[f64], probabilities: &mut Vec<f64>) -> bool;

    /// The action of this mode.
    fn choose(&self, parameters: &[f64], mode: Mode, random: &mut impl Rng) -> Self::Choice {
        match mode {
            Mode::Greedy => self.greedy(parameters),
            Mode::Sampled => self.draw(parameters, random),
        }
    }

    /// The actions of a block of samples, one for each random stream. Heads override it with columns.
    fn choose_block<'a, R: Rng + 'a>(
        &self,
        parameters: &[Column],
        mode: Mode,
        random: impl Iterator<Item = &'a mut R>,
        actions: &mut Vec<Self::Choice>,
    ) {
        let mut own = vec![0.0; parameters.len()];
        actions.extend(random.enumerate().map(|(i, random)| {
            own.iter_mut().zip(parameters).for_each(|(own, column)| *own = column[i]);
            self.choose(&own, mode, random)
        }));
    }
}

/// A kind of action that has a head; `A` is the action.
pub trait HeadOf<A: Action>: ActionKind {
    /// The head.
    type Head: PolicyHead<Choice = A, Noise = Self::Noise>;

    /// Checks the options of the head.
    ///
    /// # Errors
    /// If one does not fit; the error says in one line why and what to do.
    fn check(options: &TrainOptions) -> Result<(), String> {
        let _ = options;
        Ok(())
    }

    /// The head with these options.
    fn head(options: &TrainOptions) -> Self::Head;

    /// Position of an action among finitely many; 0 for any other.
    fn index(action: A) -> usize;

    /// The action of a position, where actions are finitely many and it is one of theirs.
    fn from_index(index: usize) -> Option<A>;

    /// The actions among which a method chooses that compares the values of finitely many: all of them where they are,
    /// in their order.
    fn repertoire() -> Vec<A>;
}

impl<const N: usize, A: Discrete> HeadOf<A> for Finite<N> {
    type Head = CategoricalPolicy<A, N>;

    fn head(_: &TrainOptions) -> CategoricalPolicy<A, N> {
        CategoricalPolicy::default()
    }

    fn index(action: A) -> usize {
        action.index()
    }

    fn from_index(index: usize) -> Option<A> {
        (index < A::COUNT).then(|| A::from_index(index))
    }

    fn repertoire() -> Vec<A> {
        (0..A::COUNT).map(A::from_index).collect()
    }
}

/// Softmax over `N` actions.
#[derive(Debug, Clone, Copy)]
pub struct CategoricalPolicy<A, const N: usize>(PhantomData<A>);

impl<A, const N: usize> Default for CategoricalPolicy<A, N> {
    fn default() -> Self {
        CategoricalPolicy(PhantomData)
    }
}

/// Probabilities of the actions, on the stack where they are few.
pub type Probabilities = SmallVec<[f64; 8]>;

impl<A: Discrete, const N: usize> CategoricalPolicy<A, N> {
    /// Probabilities of the actions, from logits.
    pub fn softmax(logits: &[f64]) -> Probabilities {
        let highest = Self::highest(logits);
        let mut weights: Probabilities =
            logits[..A::COUNT].iter().map(|logit| (logit - highest).exp()).collect();
        let sum: f64 = weights.iter().sum();
        weights.iter_mut().for_each(|weight| *weight /= sum);
        weights
    }

    fn highest(logits: &[f64]) -> f64 {
        logits[..A::COUNT].iter().copied().fold(f64::NEG_INFINITY, f64::max)
    }
}

impl<A: Discrete, const N: usize> Head for CategoricalPolicy<A, N> {
    type Given = ();
    type Choice = A;

    fn outputs(&self) -> usize {
        A::COUNT
    }

    fn log_probability(&self, logits: &[f64], _: &(), choice: &A) -> f64 {
        let highest = Self::highest(logits);
        let sum: f64 = logits[..A::COUNT].iter().map(|logit| (logit - highest).exp()).sum();
        logits[choice.index()] - (highest + sum.ln())
    }

    fn gradients(
        &self,
        logits: &[f64],
        _: &(),
        choice: &A,
        score: &mut [f64],
        entropy_gradient: &mut [f64],
    ) -> (f64, f64) {
        // First the probabilities and their logarithms, in place.
        let highest = Self::highest(logits);
        let (probabilities, logs) = (&mut score[..A::COUNT], &mut entropy_gradient[..A::COUNT]);
        for (weight, logit) in probabilities.iter_mut().zip(logits) {
            *weight = (logit - highest).exp();
        }
        let sum: f64 = probabilities.iter().sum();
        let shift = highest + sum.ln();
        for (log, logit) in logs.iter_mut().zip(logits) {
            *log = logit - shift;
        }
        probabilities.iter_mut().for_each(|weight| *weight /= sum);
        let pairs = probabilities.iter().zip(logs.iter());
        let entropy = -pairs.map(|(probability, log)| probability * log).sum::<f64>();
        let log_probability = logs[choice.index()];
        for (i, (score, by_entropy)) in probabilities.iter_mut().zip(logs).enumerate() {
            let probability = *score;
            *score = f64::from(i == choice.index()) - probability;
            *by_entropy = -probability * (*by_entropy + entropy);
        }
        (log_probability, entropy)
    }

    fn log_probabilities(
        &self,
        logits: &[Column],
        _: &[()],
        choices: &[A],
        log_probability: &mut Column,
    ) {
        let mut logs: [Column; N] = [[0.0; SAMPLES]; N];
        columns::widest(LogSoftmax { logits, logs: &mut logs, exponentials: false });
        for (i, choice) in choices.iter().enumerate() {
            log_probability[i] = logs[choice.index()][i];
        }
    }

    fn gradients_of_block(&self, block: Block<'_, Self>) {
        columns::widest(CategoricalBlock(block));
    }
}

/// The logarithms of a softmax, or the softmax, in columns.
struct LogSoftmax<'a> {
    logits: &'a [Column],
    logs: &'a mut [Column],
    exponentials: bool,
}

impl Loops for LogSoftmax<'_> {
    #[inline(always)]
    fn run(self) {
        let LogSoftmax { logits, logs, exponentials } = self;
        let shift = log_sum(logits);
        for (log, logit) in logs.iter_mut().zip(logits) {
            for i in 0..SAMPLES {
                log[i] = logit[i] - shift[i];
            }
            if exponentials {
                for entry in log.iter_mut() {
                    *entry = exp(*entry);
                }
            }
        }
    }
}

/// log sum_k exp(logit_k).
#[inline(always)]
fn log_sum(logits: &[Column]) -> Column {
    let mut highest = logits[0];
    for logit in &logits[1..] {
        for i in 0..SAMPLES {
            highest[i] = if logit[i] > highest[i] { logit[i] } else { highest[i] };
        }
    }
    let mut sum = [0.0; SAMPLES];
    for logit in logits {
        for i in 0..SAMPLES {
            sum[i] += exp(logit[i] - highest[i]);
        }
    }
    for i in 0..SAMPLES {
        sum[i] = highest[i] + ln(sum[i]);
    }
    sum
}

struct CategoricalBlock<'a, A: Discrete, const N: usize>(Block<'a, CategoricalPolicy<A, N>>);

impl<A: Discrete, const N: usize> Loops for CategoricalBlock<'_, A, N> {
    #[inline(always)]
    fn run(self) {
        let Block {
            parameters, choices, log_probability, entropy, score, entropy_gradient, ..
        } = self.0;
        let mut choice = [0.0; SAMPLES];
        for (column, chosen) in choice.iter_mut().zip(choices) {
            *column = chosen.index() as f64;
        }
        let shift = log_sum(parameters);
        entropy.fill(0.0);
        for (k, logit) in parameters.iter().enumerate() {
            let (score, log) = (&mut score[k], &mut entropy_gradient[k]);
            for i in 0..SAMPLES {
                let chosen = choice[i] == k as f64;
                log[i] = logit[i] - shift[i];
                let probability = exp(log[i]);
                entropy[i] -= probability * log[i];
                log_probability[i] = if chosen { log[i] } else { log_probability[i] };
                score[i] = if chosen { 1.0 - probability } else { -probability };
            }
        }
        for gradient in entropy_gradient {
            for i in 0..SAMPLES {
                gradient[i] = -exp(gradient[i]) * (gradient[i] + entropy[i]);
            }
        }
    }
}

impl<A: Discrete, const N: usize> PolicyHead for CategoricalPolicy<A, N> {
    type Noise = FiniteLaw<N>;

    fn noise(&self, logits: &[f64]) -> Self::Noise {
        const { assert!(A::COUNT == N, "an action's kind has another number of actions") };
        let probabilities = Self::softmax(logits);
        FiniteLaw { probabilities: std::array::from_fn(|i| probabilities[i]) }
    }

    fn realise(&self, _: &[f64], index: usize) -> A {
        A::from_index(index)
    }

    fn greedy(&self, logits: &[f64]) -> A {
        let best = (1..A::COUNT).fold(0, |best, i| if logits[i] > logits[best] { i } else { best });
        A::from_index(best)
    }

    fn choose_block<'a, R: Rng + 'a>(
        &self,
        logits: &[Column],
        mode: Mode,
        random: impl Iterator<Item = &'a mut R>,
        actions: &mut Vec<A>,
    ) {
        let mut probabilities: [Column; N] = [[0.0; SAMPLES]; N];
        if mode == Mode::Sampled {
            let logs = &mut probabilities;
            columns::widest(LogSoftmax { logits, logs, exponentials: true });
        }
        actions.extend(random.enumerate().map(|(i, random)| match mode {
            Mode::Greedy => {
                self.greedy(&std::array::from_fn::<_, N, _>(|action| logits[action][i]))
            }
            Mode::Sampled => {
                let own: [f64; N] = std::array::from_fn(|action| probabilities[action][i]);
                A::from_index(FiniteLaw { probabilities: own }.sample(random))
            }
        }));
    }

    fn probabilities(&self, logits: &[f64], probabilities: &mut Vec<f64>) -> bool {
        probabilities.extend(Self::softmax(logits));
        true
    }
}

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

    fn gradients_of_block(&self, block: Block<'_, Self>) {
        columns::widest(GaussianBlock(block));
    }
}

struct GaussianBlock<'a>(Block<'a, GaussianPolicy>);

impl Loops for GaussianBlock<'_> {
    #[inline(always)]
    fn run(self) {
        let Block {
            parameters, choices, log_probability, entropy, score, entropy_gradient, ..
        } = self.0;
        log_probability.fill(-LOG_2_PI);
        entropy.fill(1.0 + LOG_2_PI);
        for axis in 0..2 {
            let mut choice = [0.0; SAMPLES];
            for (column, force) in choice.iter_mut().zip(choices) {
                *column = force.0[axis];
            }
            let (mean, log_std) = (&parameters[axis], &parameters[2 + axis]);
            for i in 0..SAMPLES {
                let per_std = exp(-log_std[i]);
                let z = (choice[i] - mean[i]) * per_std;
                log_probability[i] += -0.5 * z * z - log_std[i];
                entropy[i] += log_std[i];
                score[axis][i] = z * per_std;
                score[2 + axis][i] = z * z - 1.0;
            }
            entropy_gradient[axis].fill(0.0);
            entropy_gradient[2 + axis].fill(1.0);
        }
    }
}

impl PolicyHead for GaussianPolicy {
    type Noise = GaussianLaw;

    fn noise(&self, _: &[f64]) -> GaussianLaw {
        GaussianLaw
    }

    fn realise(&self, parameters: &[f64], z: Vector2<f64>) -> Force {
        let [x, y] = std::array::from_fn(|i| parameters[i] + parameters[2 + i].exp() * z[i]);
        Force(Vector2::new(x, y))
    }

    fn greedy(&self, parameters: &[f64]) -> Force {
        Force(Vector2::new(parameters[0], parameters[1]))
    }

    fn probabilities(&self, _: &[f64], _: &mut Vec<f64>) -> bool {
        false
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

    fn log_probabilities(
        &self,
        parameters: &[Column],
        given: &[Self::Given],
        choices: &[Self::Choice],
        log_probability: &mut Column,
    ) {
        let none = [0.0; SAMPLES];
        let [mut score, mut entropy_gradient] = [(); 2].map(|()| vec![none; parameters.len()]);
        self.gradients_of_block(Block {
            parameters,
            given,
            choices,
            log_probability,
            entropy: &mut none.clone(),
            score: &mut score,
            entropy_gradient: &mut entropy_gradient,
        });
    }

    fn gradients_of_block(&self, block: Block<'_, Self>) {
        let Block { parameters, given, choices: outcomes, .. } = block;
        let Block { log_probability, entropy, score, entropy_gradient, .. } = block;
        let log_ratio = &mut *log_probability;
        self.0.learn(perturbation::Block {
            parameters,
            given,
            outcomes,
            log_ratio,
            entropy,
            score,
            entropy_gradient,
        });
        for (log, ((law, _), &outcome)) in
            log_probability.iter_mut().zip(given.iter().zip(outcomes))
        {
            *log += law.log_density(outcome);
        }
    }
}
