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
        sample_index(&self.probabilities, random)
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
