//! A smooth step of likelihood ratio in noise space.
//!
//! Along a trajectory the exact worst case has delta_t(o) = h(s', t+1) / h(s, t), where h is the probability
//! that the episode ends among the worst. Where h rises from 0 to 1 in one direction,
//!
//! ```text
//! delta^0(xi) = Phi(w.xi - s a) / Phi(-a),    s^2 = 1 + |w|^2,
//! ```
//!
//! with Phi the standard normal distribution function. Under xi ~ N(0, I), with z ~ N(0, 1) independent of it,
//! Phi(w.xi - s a) is the probability that T = (w.xi - z)/s exceeds a, and T is standard normal. Hence
//!
//! - `E_P[Phi(w.xi - s a)] = Phi(-a)`, so that delta^0 is normalised,
//! - `log M = -log Phi(-a)`, the limit far out along w,
//! - the reweighted law is that of xi given T > a: T from a truncated normal law, and xi given T normal with
//!   mean T w/s and covariance I - w w'/s^2 (an extended skew-normal law, Azzalini 1985).

use super::gaussian::{Component, Gradient, MOST};
use super::normal::{below, density, quantile};
use super::squashed::Squashed;
use nalgebra::Vector2;

/// What zero parameters mean for each step's a, before squashing: as likely as not first, then rarer.
const NEUTRAL: [f64; MOST] = [0.0, 0.25, 0.5];

/// The largest bound of |a|: beyond it Phi(-a) is hardly a positive number.
const LARGEST: f64 = 30.0;

/// A normalised likelihood ratio delta^0 of the standard normal law that is a step.
#[derive(Debug, Clone, Copy)]
pub struct Probit {
    /// w.
    slope: Squashed<2>,
    /// a.
    threshold: Squashed<1>,
    /// s.
    scale: f64,
    /// Phi(-a), the probability that T exceeds a.
    mass: f64,
}

impl Probit {
    /// The slope w, per standard deviation of the noise.
    pub fn slope(&self) -> Vector2<f64> {
        self.slope.value.into()
    }

    /// The threshold a, in standard deviations of T.
    pub fn threshold(&self) -> f64 {
        self.threshold.value[0]
    }

    /// w.xi - s a.
    fn argument(&self, xi: Vector2<f64>) -> f64 {
        self.slope().dot(&xi) - self.scale * self.threshold()
    }
}

impl Component for Probit {
    /// Two that are squashed into the disc |w|^2 < `curvature`, and one that is squashed into |a| < `center`
    /// (at most 30).
    const PARAMETERS: usize = 3;
    const UNIFORM: bool = true;

    fn new(parameters: &[f64], index: usize, center: f64, curvature: f64) -> Self {
        let slope = Squashed::new([parameters[0], parameters[1]], curvature.sqrt());
        let bound = center.min(LARGEST);
        let threshold = Squashed::new([NEUTRAL[index] + parameters[2]], bound);
        let scale = (1.0 + Vector2::from(slope.value).norm_squared()).sqrt();
        Probit { slope, threshold, scale, mass: below(-threshold.value[0]) }
    }

    fn log_supremum(&self) -> f64 {
        -self.mass.ln()
    }

    fn likelihood_ratio(&self, xi: Vector2<f64>) -> f64 {
        below(self.argument(xi)) / self.mass
    }

    fn draw(&self, z: Vector2<f64>, uniform: f64) -> Vector2<f64> {
        // T > a: with u uniform in (0, 1], Phi(-T) = u Phi(-a).
        let beyond = (1.0 - uniform) * self.mass;
        let t = -quantile(beyond);
        // z with its part along w shrunk by 1/s has the covariance I - w w'/s^2.
        let (w, s) = (self.slope(), self.scale);
        let shrink = w.dot(&z) / (s * (s + 1.0));
        w * (t / s - shrink) + z
    }

    /// log s: given T the law is normal with a covariance of determinant 1/s^2.
    fn lost_entropy(&self) -> f64 {
        self.scale.ln()
    }

    fn pull_back(&self, xi: Vector2<f64>, by: Gradient, gradient: &mut [f64]) {
        let Gradient { by_ratio, by_supremum, by_lost } = by;
        let (w, a, s) = (self.slope(), self.threshold(), self.scale);
        let steepness = by_ratio * mills(self.argument(xi));
        // ds/dw = w/s.
        let by_slope = (xi - w * (a / s)) * steepness + w * (by_lost / (s * s));
        let by_threshold = (by_ratio + by_supremum) * mills(-a) - steepness * s;
        gradient[..2].copy_from_slice(&self.slope.pull_back(by_slope.into()));
        gradient[2..].copy_from_slice(&self.threshold.pull_back([by_threshold]));
    }

    /// With the probability that T exceeds a from that of its complement.
    fn normalisation_error(&self) -> f64 {
        (1.0 - below(self.threshold())) / self.mass - 1.0
    }
}

/// d log Phi(x) / dx = phi(x) / Phi(x); far out in the tail, where Phi(x) is hardly a number, by the first terms of
/// its expansion, which are right to 1e-8 there.
fn mills(x: f64) -> f64 {
    if x < -30.0 { -x - 1.0 / x + 2.0 / x.powi(3) } else { density(x) / below(x) }
}
