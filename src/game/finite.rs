//! The family of laws of finitely many outcomes: `w = softmax(logits)`, `delta^0_i = w_i / sum_j p_j w_j`,
//! `M = max_i delta^0_i`, followed by identity mixing.

use crate::game::budget::{Budget, Mixing};
use crate::game::columns::{self, Column, Loops, SAMPLES, exp, ln};
use crate::game::perturbation::{Block, Draws, Family, Perturbation};
use lava_envs::law::{FiniteLaw, Law};
use rand::Rng;

/// The finite family over `N` outcomes; its parameters are the logits, shape `[N]`.
#[derive(Debug, Clone, Copy, Default)]
pub struct FiniteFamily<const N: usize>;

/// An admissible perturbation of a finite law.
#[derive(Debug, Clone)]
pub struct FinitePerturbation<const N: usize> {
    nominal: [f64; N],
    /// delta^0; 1 where the nominal probability is 0.
    base: [f64; N],
    /// The outcome where delta^0 attains M.
    top: usize,
    mixing: Mixing,
    /// delta.
    ratio: [f64; N],
    /// P delta.
    perturbed: [f64; N],
}

impl<const N: usize> Family for FiniteFamily<N> {
    type Law = FiniteLaw<N>;
    type Perturbation = FinitePerturbation<N>;

    fn parameters(&self) -> usize {
        N
    }

    fn perturbation(
        &self,
        parameters: &[f64],
        law: &FiniteLaw<N>,
        budget: Budget,
    ) -> FinitePerturbation<N> {
        let nominal = law.probabilities;
        // The softmax's own normaliser cancels in delta^0. Outcomes that cannot happen have no say
        // in M: their ratio multiplies nothing.
        let mut top = usize::MAX;
        for i in 0..N {
            if nominal[i] > 0.0 && (top == usize::MAX || parameters[i] > parameters[top]) {
                top = i;
            }
        }
        let possible = |i: usize| nominal[i] > 0.0;
        let weights: [f64; N] = std::array::from_fn(|i| {
            if possible(i) { (parameters[i] - parameters[top]).exp() } else { 0.0 }
        });
        let sum: f64 = (0..N).map(|i| nominal[i] * weights[i]).sum();
        let base = std::array::from_fn(|i| if possible(i) { weights[i] / sum } else { 1.0 });
        let mixing = budget.mix(-sum.ln());
        let ratio = base.map(|base| mixing.likelihood_ratio(base));
        let perturbed = std::array::from_fn(|i| nominal[i] * ratio[i]);
        FinitePerturbation { nominal, base, top, mixing, ratio, perturbed }
    }

    fn draw<R: Rng>(&self, draws: Draws<'_, '_, FiniteLaw<N>, R>) {
        let Draws { parameters, laws, budgets, random, nominal, outcomes, ratios, .. } = draws;
        let [mut all, mut probabilities] = [[[0.0; SAMPLES]; N]; 2];
        columns::widest(Ratios {
            parameters,
            laws,
            budgets,
            ratios: &mut all,
            probabilities: &mut probabilities,
        });
        for (i, random) in random.iter_mut().enumerate() {
            let own: [f64; N] = std::array::from_fn(|k| probabilities[k][i]);
            let drawn_from = if nominal { laws[i].probabilities } else { own };
            let outcome = FiniteLaw { probabilities: drawn_from }.sample(random);
            outcomes.push(outcome);
            ratios[i] = all[outcome][i];
        }
        if let Some(largest) = draws.normalisation_error {
            let sums = (0..laws.len()).map(|i| probabilities.iter().map(|of| of[i]).sum::<f64>());
            *largest = sums.map(|sum| (sum - 1.0).abs()).fold(*largest, f64::max);
        }
    }

    fn learn(&self, block: Block<'_, FiniteLaw<N>>) {
        columns::widest(Learn(block));
    }
}

/// Perturbations of a block in columns, the formulas of [`FinitePerturbation`] each in a loop over the samples.
struct Perturbed<const N: usize> {
    nominal: [Column; N],
    /// The index of the top.
    top: Column,
    /// delta^0.
    base: [Column; N],
    /// rho and d rho / d log M.
    mixing: [Column; 2],
}

impl<const N: usize> Perturbed<N> {
    #[inline(always)]
    fn new<'a>(
        parameters: &[Column],
        given: impl Iterator<Item = (&'a FiniteLaw<N>, Budget)>,
    ) -> Self {
        let mut nominal = [[0.0; SAMPLES]; N];
        let mut budget = [1.0; SAMPLES];
        for (i, (law, eta)) in given.enumerate() {
            for (column, probability) in nominal.iter_mut().zip(law.probabilities) {
                column[i] = probability;
            }
            budget[i] = eta.get();
        }

        // The top is the first of the possible outcomes with the largest logit.
        let (mut highest, mut top) = ([f64::NEG_INFINITY; SAMPLES], [0.0; SAMPLES]);
        for (k, (logit, nominal)) in parameters.iter().zip(&nominal).enumerate() {
            for i in 0..SAMPLES {
                let higher = (nominal[i] > 0.0) & (logit[i] > highest[i]);
                highest[i] = if higher { logit[i] } else { highest[i] };
                top[i] = if higher { k as f64 } else { top[i] };
            }
        }

        let (mut base, mut sum) = ([[0.0; SAMPLES]; N], [0.0; SAMPLES]);
        for ((base, logit), nominal) in base.iter_mut().zip(parameters).zip(&nominal) {
            for i in 0..SAMPLES {
                base[i] = exp(logit[i] - highest[i]);
                base[i] = if nominal[i] > 0.0 { base[i] } else { 0.0 };
                sum[i] += nominal[i] * base[i];
            }
        }
        for (base, nominal) in base.iter_mut().zip(&nominal) {
            for i in 0..SAMPLES {
                base[i] = if nominal[i] > 0.0 { base[i] / sum[i] } else { 1.0 };
            }
        }
        let [mut weight, mut by_log_supremum] = [[0.0; SAMPLES]; 2];
        for i in 0..SAMPLES {
            // log M = -log sum.
            let mixing = Mixing::within(budget[i], (1.0 - sum[i]) / sum[i]);
            (weight[i], by_log_supremum[i]) = (mixing.weight, mixing.by_log_supremum);
        }
        Perturbed { nominal, top, base, mixing: [weight, by_log_supremum] }
    }

    #[inline(always)]
    fn mixing(&self, i: usize) -> Mixing {
        Mixing { weight: self.mixing[0][i], by_log_supremum: self.mixing[1][i] }
    }
}

/// The likelihood ratios of all outcomes in columns, and the perturbed probabilities.
struct Ratios<'a, const N: usize> {
    parameters: &'a [Column],
    laws: &'a [FiniteLaw<N>],
    budgets: &'a [Budget],
    ratios: &'a mut [Column; N],
    probabilities: &'a mut [Column; N],
}

impl<const N: usize> Loops for Ratios<'_, N> {
    #[inline(always)]
    fn run(self) {
        let Ratios { parameters, laws, budgets, ratios, probabilities } = self;
        let of = Perturbed::new(parameters, laws.iter().zip(budgets.iter().copied()));
        for k in 0..N {
            let (ratio, probability) = (&mut ratios[k], &mut probabilities[k]);
            let (base, nominal) = (&of.base[k], &of.nominal[k]);
            for i in 0..SAMPLES {
                ratio[i] = of.mixing(i).likelihood_ratio(base[i]);
                probability[i] = nominal[i] * ratio[i];
            }
        }
    }
}

/// [`Family::learn`] in columns.
struct Learn<'a, const N: usize>(Block<'a, FiniteLaw<N>>);

impl<const N: usize> Loops for Learn<'_, N> {
    #[inline(always)]
    fn run(self) {
        let Block { parameters, given, outcomes, log_ratio, entropy, score, entropy_gradient } =
            self.0;
        let (score, entropy_gradient) = (&mut score[..N], &mut entropy_gradient[..N]);
        let mut outcome = [0.0; SAMPLES];
        for (column, &o) in outcome.iter_mut().zip(outcomes) {
            *column = o as f64;
        }
        let of = Perturbed::new(parameters, given.iter().map(|(law, budget)| (law, *budget)));

        // What is passed on by delta^0, and by log M, of log delta(o) and of the entropy.
        let [mut through, mut lost_through] = [[0.0; SAMPLES]; 2];
        let [mut at_top, mut lost_at_top] = [[0.0; SAMPLES]; 2];
        for k in 0..N {
            let (base, nominal) = (&of.base[k], &of.nominal[k]);
            let (score, lost) = (&mut score[k], &mut entropy_gradient[k]);
            for i in 0..SAMPLES {
                let mixing = of.mixing(i);
                let ratio = mixing.likelihood_ratio(base[i]);
                let (by_base, by_top) = mixing.derivatives(base[i]);
                let log = ln(ratio);
                let realised = outcome[i] == k as f64;
                log_ratio[i] = if realised { log } else { log_ratio[i] };
                let weight = if realised { 1.0 / ratio } else { 0.0 };
                score[i] = weight * by_base;
                through[i] += weight * (by_base + by_top);
                at_top[i] += weight * by_top;
                // H = -sum q log q; the constant 1 of its derivative drops out.
                let possible = nominal[i] > 0.0;
                let log = if possible { log + ln(nominal[i]) } else { 0.0 };
                entropy[i] = if k == 0 { 0.0 } else { entropy[i] } - nominal[i] * ratio * log;
                let weight = -nominal[i] * log;
                lost[i] = weight * by_base;
                lost_through[i] += weight * (by_base + by_top);
                lost_at_top[i] += weight * by_top;
            }
        }
        for k in 0..N {
            let (base, nominal) = (&of.base[k], &of.nominal[k]);
            let (score, lost) = (&mut score[k], &mut entropy_gradient[k]);
            for i in 0..SAMPLES {
                let is_top = if of.top[i] == k as f64 { 1.0 } else { 0.0 };
                let q = nominal[i] * base[i];
                score[i] += is_top * at_top[i] - through[i] * q;
                lost[i] += is_top * lost_at_top[i] - lost_through[i] * q;
            }
        }
    }
}

impl<const N: usize> FinitePerturbation<N> {
    /// The perturbed probabilities P_t(o) delta_t(o).
    pub fn probabilities(&self) -> &[f64; N] {
        &self.perturbed
    }

    /// Adds `weight * d delta_i / d logits` to the gradient. With q^0 = P delta^0:
    /// dlog delta^0_i / d logit_k = [i = k] - q^0_k, and the same at the top for log M.
    fn add_ratio_gradient(&self, i: usize, weight: f64, gradient: &mut [f64]) {
        let (by_base, by_supremum) = self.mixing.derivatives(self.base[i]);
        gradient[i] += weight * by_base;
        gradient[self.top] += weight * by_supremum;
        for (entry, (nominal, base)) in gradient.iter_mut().zip(self.nominal.iter().zip(self.base))
        {
            *entry -= weight * (by_base + by_supremum) * nominal * base;
        }
    }
}

impl<const N: usize> Perturbation for FinitePerturbation<N> {
    type Law = FiniteLaw<N>;

    fn likelihood_ratio(&self, outcome: usize) -> f64 {
        self.ratio[outcome]
    }

    fn supremum(&self) -> f64 {
        self.ratio[self.top]
    }

    fn infimum(&self) -> f64 {
        let possible = (0..N).filter(|&i| self.nominal[i] > 0.0);
        possible.map(|i| self.ratio[i]).fold(f64::INFINITY, f64::min)
    }

    fn sample<R: Rng>(&self, random: &mut R) -> usize {
        FiniteLaw { probabilities: self.perturbed }.sample(random)
    }

    fn score(&self, outcome: usize, gradient: &mut [f64]) -> f64 {
        gradient.fill(0.0);
        self.add_ratio_gradient(outcome, 1.0 / self.ratio[outcome], gradient);
        self.ratio[outcome]
    }

    /// H(q) = -sum q log q of the perturbed law q = P delta.
    fn entropy(&self, gradient: &mut [f64]) -> f64 {
        gradient.fill(0.0);
        let mut entropy = 0.0;
        for i in 0..N {
            let q = self.perturbed[i];
            if q > 0.0 {
                let log_q = q.ln();
                entropy -= q * log_q;
                // The constant 1 of d(q log q) drops out: sum_i P_i d delta_i = 0.
                self.add_ratio_gradient(i, -self.nominal[i] * log_q, gradient);
            }
        }
        entropy
    }

    fn normalisation_error(&self) -> f64 {
        (self.perturbed.iter().sum::<f64>() - 1.0).abs()
    }
}
