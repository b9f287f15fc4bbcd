//! Nominal laws of chance: finite, over any number of outcomes, and standard normal in the plane.

use nalgebra::Vector2;
use rand::{Rng, RngExt};
use rand_distr::StandardNormal;

/// A nominal law P_t(o) with respect to a reference measure (counting or Lebesgue).
pub trait Law: Copy + std::fmt::Debug + Send + Sync + 'static {
    /// What chance decides.
    type Outcome: Copy + std::fmt::Debug + PartialEq + Send + Sync + 'static;

    /// Draws an outcome.
    fn sample<R: Rng>(&self, random: &mut R) -> Self::Outcome;

    /// log P_t(o), in nats.
    fn log_density(&self, outcome: Self::Outcome) -> f64;

    /// The outcome of an index, where outcomes are finitely many.
    fn outcome(_index: usize) -> Option<Self::Outcome> {
        None
    }
}

/// A law over `N` outcomes, numbered from 0; some may have probability zero.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FiniteLaw<const N: usize> {
    /// Probabilities, which sum to 1.
    pub probabilities: [f64; N],
}

impl<const N: usize> Law for FiniteLaw<N> {
    type Outcome = usize;

    fn sample<R: Rng>(&self, random: &mut R) -> usize {
        // `sample_index` without branches: which outcome it is cannot be foreseen.
        let mut rest: f64 = random.random();
        let (mut chosen, mut found) = (0, false);
        for (index, &probability) in self.probabilities.iter().enumerate() {
            let open = (probability > 0.0) & !found;
            chosen = if open { index } else { chosen };
            found |= open & (rest < probability);
            rest -= probability;
        }
        chosen
    }

    fn log_density(&self, outcome: usize) -> f64 {
        self.probabilities[outcome].ln()
    }

    fn outcome(index: usize) -> Option<usize> {
        (index < N).then_some(index)
    }
}

/// Draws an index with the given probabilities by inversion of one uniform number; an index of
/// probability zero is never drawn.
pub fn sample_index<R: Rng>(probabilities: &[f64], random: &mut R) -> usize {
    let mut rest: f64 = random.random();
    let mut last = 0;
    for (index, &probability) in probabilities.iter().enumerate() {
        if probability > 0.0 {
            if rest < probability {
                return index;
            }
            rest -= probability;
            last = index;
        }
    }
    last // reached only by rounding
}

/// The standard normal law N(0, I) of the noise xi in the plane (dimensionless).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct GaussianLaw;

impl Law for GaussianLaw {
    type Outcome = Vector2<f64>;

    fn sample<R: Rng>(&self, random: &mut R) -> Vector2<f64> {
        Vector2::new(random.sample(StandardNormal), random.sample(StandardNormal))
    }

    fn log_density(&self, outcome: Vector2<f64>) -> f64 {
        -0.5 * outcome.norm_squared() - (2.0 * std::f64::consts::PI).ln()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, stream};

    /// With and without branches the same outcome is drawn, of laws with impossible outcomes and such whose
    /// probabilities do not add up to 1.
    #[test]
    fn laws_draw_as_lists_of_probabilities() {
        let random = &mut stream(7, Purpose::Actions, 0);
        for round in 0..100_000_u64 {
            let mut probabilities: [f64; 4] = std::array::from_fn(|_| random.random());
            probabilities.iter_mut().for_each(|p| *p *= f64::from(random.random_bool(0.7)));
            let sum: f64 = probabilities.iter().sum();
            let sum = if round % 3 == 0 { sum * 2.0 } else { sum };
            if sum == 0.0 {
                continue;
            }
            let law = FiniteLaw { probabilities: probabilities.map(|p| p / sum) };
            let of = |index| stream(8, Purpose::Actions, index);
            let drawn = law.sample(&mut of(round));
            assert_eq!(drawn, sample_index(&law.probabilities, &mut of(round)), "{law:?}");
            assert!(law.probabilities[drawn] > 0.0);
        }
    }
}
