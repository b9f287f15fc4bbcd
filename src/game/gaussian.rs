//! The Gaussian families (point mass): weighted sums of likelihood ratios in noise space, of one kind each.
//!
//! `delta^0 = sum_j w_j delta^0_j` with normalised ratios delta^0_j of one kind of [`Component`], such as
//! [`super::bump::Bump`], and weights w = softmax(logits). One can shift the noise; two can at once shift it a
//! little and raise the odds of a rare gust. Then `sup delta^0 <= M = sum_j w_j M_j`, with equality for one,
//! and identity mixing by this M keeps the budget. The perturbed law is the mixture of N(0, I), with weight
//! lambda, and the laws P delta^0_j, with weights (1 - lambda) w_j.

use crate::game::budget::{Budget, Mixing};
use crate::game::columns::{self, Column, Loops, SAMPLES, exp, ln};
use crate::game::normal::LOG_2_PI;
use crate::game::perturbation::{Block, Draws, Family, Perturbation};
use lava_envs::GaussianLaw;
use nalgebra::Vector2;
use rand::{Rng, RngExt};
use rand_distr::StandardNormal;
use std::marker::PhantomData;

/// The most parameters of a component.
const MOST_PARAMETERS: usize = 5;

/// The most components of a sum.
pub const MOST: usize = 3;

/// A normalised likelihood ratio delta^0_j of the standard normal law.
pub trait Component: Copy + std::fmt::Debug + Send + 'static {
    /// Number of its parameters, at most 5.
    const PARAMETERS: usize;

    /// The ratio with these parameters (any real numbers) as the component of this index in a sum. `center`
    /// bounds how far from 0 it raises the odds, in standard deviations, `curvature` how steep it is, per
    /// squared standard deviation.
    fn new(parameters: &[f64], index: usize, center: f64, curvature: f64) -> Self;

    /// log M_j, with M_j = sup delta^0_j.
    fn log_supremum(&self) -> f64;

    /// delta^0_j(xi).
    fn likelihood_ratio(&self, xi: Vector2<f64>) -> f64;

    /// Whether a draw needs a uniform number besides.
    const UNIFORM: bool;

    /// A draw from P delta^0_j, made of a standard normal draw z and a uniform number of [0, 1).
    fn draw(&self, z: Vector2<f64>, uniform: f64) -> Vector2<f64>;

    /// By how much the entropy of P delta^0_j in nats is below that of P, or an upper bound of it.
    fn lost_entropy(&self) -> f64;

    /// Writes the gradient by the parameters of `by_ratio log delta^0_j(xi) + by_supremum log M_j
    /// + by_lost lost_entropy`.
    fn pull_back(&self, xi: Vector2<f64>, by: Gradient, gradient: &mut [f64]);

    /// `E_P[delta^0_j]` - 1, evaluated in another way than the ratio itself.
    fn normalisation_error(&self) -> f64;
}

/// What a gradient is made of, see [`Component::pull_back`].
#[derive(Debug, Clone, Copy)]
pub struct Gradient {
    /// Derivative by log delta^0_j(xi).
    pub by_ratio: f64,
    /// Derivative by log M_j.
    pub by_supremum: f64,
    /// Derivative by the lost entropy.
    pub by_lost: f64,
}

/// A Gaussian family. Its parameters are those of each component and then, of several, the logits of their
/// weights.
#[derive(Debug, Clone, Copy)]
pub struct GaussianFamily<C> {
    /// Number of components, 1 to [`MOST`].
    pub count: usize,
    /// See [`Component::new`].
    pub center_bound: f64,
    /// See [`Component::new`].
    pub curvature_bound: f64,
    kind: PhantomData<C>,
}

impl<C> GaussianFamily<C> {
    /// The family of sums of so many components with these bounds.
    pub fn new(count: usize, center_bound: f64, curvature_bound: f64) -> Self {
        GaussianFamily { count, center_bound, curvature_bound, kind: PhantomData }
    }
}

/// An admissible perturbation of the standard normal law.
#[derive(Debug, Clone)]
pub struct GaussianPerturbation<C> {
    /// The components; those after the first `count` have weight 0.
    components: [C; MOST],
    weights: [f64; MOST],
    count: usize,
    /// M.
    supremum: f64,
    mixing: Mixing,
}

impl<C: Component> Family for GaussianFamily<C> {
    type Law = GaussianLaw;
    type Perturbation = GaussianPerturbation<C>;

    fn parameters(&self) -> usize {
        C::PARAMETERS * self.count + if self.count > 1 { self.count } else { 0 }
    }

    fn perturbation(
        &self,
        parameters: &[f64],
        _law: &GaussianLaw,
        budget: Budget,
    ) -> GaussianPerturbation<C> {
        let count = self.count;
        let component = |j: usize| {
            let own = &parameters[C::PARAMETERS * j..][..C::PARAMETERS];
            C::new(own, j, self.center_bound, self.curvature_bound)
        };
        let mut components = [component(0); MOST];
        let mut weights = [1.0, 0.0, 0.0];
        if count > 1 {
            let logits = &parameters[C::PARAMETERS * count..][..count];
            let highest = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            for (j, logit) in logits.iter().enumerate() {
                components[j] = component(j);
                weights[j] = (logit - highest).exp();
            }
            let sum: f64 = weights[..count].iter().sum();
            weights[..count].iter_mut().for_each(|weight| *weight /= sum);
        }
        let log_supremum = if count == 1 {
            components[0].log_supremum()
        } else {
            (0..count).map(|j| weights[j] * components[j].log_supremum().exp()).sum::<f64>().ln()
        };
        let mixing = budget.mix(log_supremum);
        GaussianPerturbation { components, weights, count, supremum: log_supremum.exp(), mixing }
    }

    fn draw<R: Rng>(&self, draws: Draws<'_, '_, GaussianLaw, R>) {
        let Draws { parameters, budgets, random, nominal, outcomes, ratios, .. } = draws;
        let mut xi = [[0.0; SAMPLES]; 2];
        let [mut level, mut uniform, mut ratio, mut error] = [[0.5; SAMPLES]; 4];
        let mut budget = [1.0; SAMPLES];
        for (i, random) in random.iter_mut().enumerate() {
            budget[i] = budgets[i].get();
            if !nominal {
                level[i] = random.random();
            }
            (xi[0][i], xi[1][i]) = (random.sample(StandardNormal), random.sample(StandardNormal));
            if C::UNIFORM && !nominal {
                uniform[i] = random.random();
            }
        }
        columns::widest(Reweight {
            family: self,
            parameters,
            budget: &budget,
            level: &mut level,
            uniform: &uniform,
            xi: &mut xi,
            nominal,
            ratio: &mut ratio,
            error: draws.normalisation_error.is_some().then_some(&mut error),
        });
        let drawn = ratios.len();
        if let Some(largest) = draws.normalisation_error {
            *largest = error[..drawn].iter().copied().fold(*largest, f64::max);
        }
        outcomes.extend((0..drawn).map(|i| Vector2::new(xi[0][i], xi[1][i])));
        ratios.copy_from_slice(&ratio[..drawn]);
    }

    fn learn(&self, block: Block<'_, GaussianLaw>) {
        columns::widest(Learn { family: self, block });
    }
}

/// Where the parameters of component j are.
#[inline(always)]
fn own<C: Component>(j: usize) -> std::ops::Range<usize> {
    C::PARAMETERS * j..C::PARAMETERS * (j + 1)
}

impl<C: Component> GaussianFamily<C> {
    /// Component j of sample i, from the columns of its parameters.
    #[inline(always)]
    fn component(&self, parameters: &[Column], i: usize, j: usize) -> C {
        let own: [f64; MOST_PARAMETERS] =
            std::array::from_fn(|k| if k < C::PARAMETERS { parameters[k][i] } else { 0.0 });
        C::new(&own[..C::PARAMETERS], j, self.center_bound, self.curvature_bound)
    }

    /// w = softmax(logits), in columns.
    #[inline(always)]
    fn weights(&self, parameters: &[Column]) -> [Column; MOST] {
        let mut weights = [[1.0; SAMPLES]; MOST];
        if self.count == 1 {
            return weights;
        }
        let logits = &parameters[C::PARAMETERS * self.count..][..self.count];
        let mut highest = logits[0];
        for logit in &logits[1..] {
            for i in 0..SAMPLES {
                highest[i] = if logit[i] > highest[i] { logit[i] } else { highest[i] };
            }
        }
        let mut sum = [0.0; SAMPLES];
        for (weight, logit) in weights.iter_mut().zip(logits) {
            for i in 0..SAMPLES {
                weight[i] = exp(logit[i] - highest[i]);
                sum[i] += weight[i];
            }
        }
        for weight in &mut weights[..self.count] {
            for i in 0..SAMPLES {
                weight[i] /= sum[i];
            }
        }
        weights
    }
}

/// [`Family::draw`] in columns, from random numbers.
struct Reweight<'a, C> {
    family: &'a GaussianFamily<C>,
    parameters: &'a [Column],
    budget: &'a Column,
    /// A uniform number that selects a component or none, and one for it.
    level: &'a mut Column,
    uniform: &'a Column,
    /// A draw of the normal law, turned into one of the perturbed law unless that is to be left out.
    xi: &'a mut [Column; 2],
    nominal: bool,
    /// Receives delta(xi).
    ratio: &'a mut Column,
    /// Receives the error of the normalisation, if it is requested.
    error: Option<&'a mut Column>,
}

impl<C: Component> Loops for Reweight<'_, C> {
    #[inline(always)]
    fn run(self) {
        let Reweight { family, parameters, budget, level, uniform, xi, nominal, ratio, .. } = self;
        let count = family.count;
        let weights = family.weights(parameters);
        let mut supremum = [0.0; SAMPLES];
        for (j, weight) in weights[..count].iter().enumerate() {
            let of = &parameters[own::<C>(j)];
            for i in 0..SAMPLES {
                supremum[i] += weight[i] * exp(family.component(of, i, j).log_supremum());
            }
        }
        let mut mixings = [Mixing { weight: 1.0, by_log_supremum: 0.0 }; SAMPLES];
        for i in 0..SAMPLES {
            mixings[i] = Mixing::within(budget[i], supremum[i] - 1.0);
        }
        let [z, w] = *xi;
        let [x, y] = xi;
        if !nominal {
            for (j, weight) in weights[..count].iter().enumerate() {
                let of = &parameters[own::<C>(j)];
                for i in 0..SAMPLES {
                    let drawn =
                        family.component(of, i, j).draw(Vector2::new(z[i], w[i]), uniform[i]);
                    let before = level[i];
                    level[i] -= mixings[i].weight * weight[i];
                    let selected = (before >= 0.0) & (level[i] < 0.0);
                    x[i] = if selected { drawn.x } else { x[i] };
                    y[i] = if selected { drawn.y } else { y[i] };
                }
            }
        }
        let mut base = [0.0; SAMPLES];
        for (j, weight) in weights[..count].iter().enumerate() {
            let of = &parameters[own::<C>(j)];
            for i in 0..SAMPLES {
                let component = family.component(of, i, j);
                base[i] += weight[i] * component.likelihood_ratio(Vector2::new(x[i], y[i]));
            }
        }
        for i in 0..SAMPLES {
            ratio[i] = mixings[i].likelihood_ratio(base[i]);
        }
        if let Some(error) = self.error {
            *error = [0.0; SAMPLES];
            for (j, weight) in weights[..count].iter().enumerate() {
                let of = &parameters[own::<C>(j)];
                for i in 0..SAMPLES {
                    error[i] += weight[i] * family.component(of, i, j).normalisation_error();
                }
            }
            for i in 0..SAMPLES {
                error[i] = mixings[i].weight * error[i].abs();
            }
        }
    }
}

/// [`Family::learn`] in columns: the formulas of [`GaussianPerturbation`], each in a loop over the samples.
struct Learn<'a, C> {
    family: &'a GaussianFamily<C>,
    block: Block<'a, GaussianLaw>,
}

impl<C: Component> Loops for Learn<'_, C> {
    #[inline(always)]
    fn run(self) {
        let Learn { family, block } = self;
        let count = family.count;
        let Block { parameters, given, outcomes, log_ratio, entropy, score, entropy_gradient } =
            block;
        let logits = C::PARAMETERS * count;

        let [mut x, mut y, mut budget] = [[0.0; SAMPLES]; 3];
        for (i, ((_, eta), xi)) in given.iter().zip(outcomes).enumerate() {
            (x[i], y[i], budget[i]) = (xi.x, xi.y, eta.get());
        }

        let weights = family.weights(parameters);

        // M, delta^0(xi) and the lost entropy, in all and of each component.
        let [mut supremum, mut base, mut lost] = [[0.0; SAMPLES]; 3];
        let [mut suprema, mut ratios, mut losts] = [[[0.0; SAMPLES]; MOST]; 3];
        for j in 0..count {
            let (of, weight) = (&parameters[own::<C>(j)], &weights[j]);
            let (own_supremum, ratio, own_lost) = (&mut suprema[j], &mut ratios[j], &mut losts[j]);
            for i in 0..SAMPLES {
                let component = family.component(of, i, j);
                own_supremum[i] = exp(component.log_supremum());
                ratio[i] = component.likelihood_ratio(Vector2::new(x[i], y[i]));
                own_lost[i] = component.lost_entropy();
                supremum[i] += weight[i] * own_supremum[i];
                base[i] += weight[i] * ratio[i];
                lost[i] += weight[i] * own_lost[i];
            }
        }

        // delta = 1 + rho (delta^0 - 1), and rho depends on log M.
        let [mut rho, mut by_base, mut by_supremum, mut lost_by_supremum] = [[0.0; SAMPLES]; 4];
        for i in 0..SAMPLES {
            let mixing = Mixing::within(budget[i], supremum[i] - 1.0);
            let ratio = mixing.likelihood_ratio(base[i]);
            let (_, by) = mixing.derivatives(base[i]);
            log_ratio[i] = ln(ratio);
            entropy[i] = 1.0 + LOG_2_PI - mixing.weight * lost[i];
            rho[i] = mixing.weight;
            by_base[i] = mixing.weight / ratio;
            by_supremum[i] = by / (ratio * supremum[i]);
            lost_by_supremum[i] = -lost[i] * mixing.by_log_supremum / supremum[i];
        }

        // The gradients by each component's parameters and by log w_j.
        let [mut by_log, mut lost_by_log] = [[[0.0; SAMPLES]; MOST]; 2];
        let [mut sum, mut lost_sum] = [[0.0; SAMPLES]; 2];
        for j in 0..count {
            let (of, weight) = (&parameters[own::<C>(j)], &weights[j]);
            let (own_supremum, ratio, own_lost) = (&suprema[j], &ratios[j], &losts[j]);
            let (score, entropy) = (&mut score[own::<C>(j)], &mut entropy_gradient[own::<C>(j)]);
            let (by_log, lost_by_log) = (&mut by_log[j], &mut lost_by_log[j]);
            for i in 0..SAMPLES {
                let component = family.component(of, i, j);
                let share = weight[i] * own_supremum[i];
                let of_score = Gradient {
                    by_ratio: by_base[i] * weight[i] * ratio[i],
                    by_supremum: by_supremum[i] * share,
                    by_lost: 0.0,
                };
                let of_entropy = Gradient {
                    by_ratio: 0.0,
                    by_supremum: lost_by_supremum[i] * share,
                    by_lost: -rho[i] * weight[i],
                };
                let mut gradient = [0.0; MOST_PARAMETERS];
                component.pull_back(
                    Vector2::new(x[i], y[i]),
                    of_score,
                    &mut gradient[..C::PARAMETERS],
                );
                for k in 0..C::PARAMETERS {
                    score[k][i] = gradient[k];
                }
                component.pull_back(
                    Vector2::new(0.0, 0.0),
                    of_entropy,
                    &mut gradient[..C::PARAMETERS],
                );
                for k in 0..C::PARAMETERS {
                    entropy[k][i] = gradient[k];
                }
                by_log[i] = of_score.by_ratio + of_score.by_supremum;
                lost_by_log[i] = of_entropy.by_supremum + of_entropy.by_lost * own_lost[i];
                sum[i] += by_log[i];
                lost_sum[i] += lost_by_log[i];
            }
        }
        if count > 1 {
            // dlog w_j / d logit_k = [j = k] - w_k.
            for j in 0..count {
                let (score, entropy) = (&mut score[logits + j], &mut entropy_gradient[logits + j]);
                for i in 0..SAMPLES {
                    score[i] = by_log[j][i] - weights[j][i] * sum[i];
                    entropy[i] = lost_by_log[j][i] - weights[j][i] * lost_sum[i];
                }
            }
        }
    }
}

impl<C: Component> GaussianPerturbation<C> {
    /// The components with their weights w_j.
    pub fn components(&self) -> impl Iterator<Item = (f64, &C)> {
        self.weights[..self.count].iter().copied().zip(&self.components)
    }

    /// M, the bound of sup delta^0.
    pub fn base_supremum(&self) -> f64 {
        self.supremum
    }

    /// 1 - lambda, the share of the components in the mixture.
    pub fn weight(&self) -> f64 {
        self.mixing.weight
    }

    /// delta^0(xi).
    fn base(&self, xi: Vector2<f64>) -> f64 {
        self.components().map(|(weight, of)| weight * of.likelihood_ratio(xi)).sum()
    }

    /// Writes the gradient by the parameters of a sum over the components j, given how it depends on
    /// each of them, log w_j with log delta^0_j(xi) and log M_j, and on w_j alone.
    fn pull_back(
        &self,
        xi: Vector2<f64>,
        gradient: &mut [f64],
        by: impl Fn(f64, &C) -> (Gradient, f64),
    ) {
        let mut by_logarithm = [0.0; MOST];
        for (j, (weight, component)) in self.components().enumerate() {
            let (of_component, by_weight) = by(weight, component);
            let own = &mut gradient[C::PARAMETERS * j..][..C::PARAMETERS];
            component.pull_back(xi, of_component, own);
            let Gradient { by_ratio, by_supremum, .. } = of_component;
            by_logarithm[j] = by_ratio + by_supremum + by_weight * weight;
        }
        if self.count > 1 {
            // dlog w_j / d logit_k = [j = k] - w_k.
            let sum: f64 = by_logarithm.iter().sum();
            let logits = &mut gradient[C::PARAMETERS * self.count..][..self.count];
            for (k, logit) in logits.iter_mut().enumerate() {
                *logit = by_logarithm[k] - self.weights[k] * sum;
            }
        }
    }
}

impl<C: Component> Perturbation for GaussianPerturbation<C> {
    type Law = GaussianLaw;

    fn likelihood_ratio(&self, xi: Vector2<f64>) -> f64 {
        self.mixing.likelihood_ratio(self.base(xi))
    }

    fn supremum(&self) -> f64 {
        self.mixing.likelihood_ratio(self.supremum)
    }

    /// lambda: every delta^0_j tends to 0 somewhere.
    fn infimum(&self) -> f64 {
        1.0 - self.mixing.weight
    }

    /// A draw from the mixture of N(0, I) and the laws of the components.
    fn sample<R: Rng>(&self, random: &mut R) -> Vector2<f64> {
        let mut level = random.random::<f64>();
        let z = Vector2::new(random.sample(StandardNormal), random.sample(StandardNormal));
        let uniform = if C::UNIFORM { random.random() } else { 0.5 };
        for (weight, component) in self.components() {
            level -= self.mixing.weight * weight;
            if level < 0.0 {
                return component.draw(z, uniform);
            }
        }
        z
    }

    fn score(&self, xi: Vector2<f64>, gradient: &mut [f64]) -> f64 {
        let base = self.base(xi);
        let ratio = self.mixing.likelihood_ratio(base);
        // delta = 1 + rho (delta^0 - 1), and rho depends on log M.
        let (_, by_supremum) = self.mixing.derivatives(base);
        self.pull_back(xi, gradient, |weight, of| {
            let by_ratio = self.mixing.weight * weight * of.likelihood_ratio(xi) / ratio;
            let share = weight * of.log_supremum().exp() / self.supremum;
            let by_supremum = by_supremum * share / ratio;
            (Gradient { by_ratio, by_supremum, by_lost: 0.0 }, 0.0)
        });
        ratio
    }

    /// The entropy of a mixture has no closed form. By concavity it is at least
    /// `H(N(0,I)) - (1-lambda) sum_j w_j (lost entropy of P delta^0_j)`, which is the bonus.
    fn entropy(&self, gradient: &mut [f64]) -> f64 {
        let lost: f64 = self.components().map(|(weight, of)| weight * of.lost_entropy()).sum();
        let by_supremum = -lost * self.mixing.by_log_supremum;
        self.pull_back(Vector2::zeros(), gradient, |weight, of| {
            let share = weight * of.log_supremum().exp() / self.supremum;
            let by_lost = -self.mixing.weight * weight;
            let by_weight = -self.mixing.weight * of.lost_entropy();
            (Gradient { by_ratio: 0.0, by_supremum: by_supremum * share, by_lost }, by_weight)
        });
        1.0 + LOG_2_PI - self.mixing.weight * lost
    }

    fn normalisation_error(&self) -> f64 {
        let off = |(weight, of): (f64, &C)| weight * of.normalisation_error();
        self.mixing.weight * self.components().map(off).sum::<f64>().abs()
    }
}
