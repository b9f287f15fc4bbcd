//! The normal law N(m, s^2) restricted to the interval [-1, 1].
//!
//! With z = (x - m)/s, its bounds a = (-1-m)/s and b = (1-m)/s, Z = Phi(b) - Phi(a), and the moments
//! `M_k = E[z^k] = (k-1) M_{k-2} + (a^{k-1} phi(a) - b^{k-1} phi(b)) / Z`,
//!
//! ```text
//! log p = -z^2/2 - log(sqrt(2 pi) s Z)        H = log(sqrt(2 pi) s Z) + M_2/2
//! d log p / dm     = (z - M_1)/s              dH / dm     = (M_3 - M_1 M_2)/(2 s)
//! d log p / dlog s = z^2 - M_2                dH / dlog s = (M_4 - M_2^2)/2
//! ```
//!
//! The entropy is at most log 2, that of the uniform law, which it tends to as s grows.

use crate::game::normal::{below, density, quantile};
use std::f64::consts::PI;

/// N(m, s^2) restricted to [-1, 1], with accurate tails for |m| up to about 38 s + 1.
#[derive(Debug, Clone, Copy)]
pub struct TruncatedNormal {
    mean: f64,
    std: f64,
    /// -1 where m is negative: then everything below is that of the mirrored law, whose m is not.
    sign: f64,
    a: f64,
    b: f64,
    /// Z.
    mass: f64,
    /// M_1 to M_4.
    moments: [f64; 4],
}

/// What learning needs to know at a point x.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct At {
    /// log p(x) in nats.
    pub log_density: f64,
    /// Its derivatives by m and by log s.
    pub score: [f64; 2],
}

impl TruncatedNormal {
    /// The law with these m and s > 0.
    pub fn new(mean: f64, std: f64) -> Self {
        let sign = if mean < 0.0 { -1.0 } else { 1.0 };
        let (a, b) = ((-1.0 - mean.abs()) / std, (1.0 - mean.abs()) / std);
        let mass = below(b) - below(a);
        let (at_a, at_b) = (density(a) / mass, density(b) / mass);
        let m1 = at_a - at_b;
        let m2 = 1.0 + a * at_a - b * at_b;
        let m3 = 2.0 * m1 + a * a * at_a - b * b * at_b;
        let m4 = 3.0 * m2 + a.powi(3) * at_a - b.powi(3) * at_b;
        TruncatedNormal { mean, std, sign, a, b, mass, moments: [m1, m2, m3, m4] }
    }

    /// The point below which a share `u` in (0, 1) of the mass is.
    pub fn quantile(&self, u: f64) -> f64 {
        let u = if self.sign > 0.0 { u } else { 1.0 - u };
        let share = below(self.a) + u * self.mass;
        let z = quantile(share).clamp(self.a, self.b);
        (self.mean + self.sign * self.std * z).clamp(-1.0, 1.0)
    }

    /// The point as far up in this law as z is in the standard normal one.
    pub fn at_normal(&self, z: f64) -> f64 {
        self.quantile(below(z))
    }

    /// The share of the mass below a point of [-1, 1].
    pub fn cumulative(&self, x: f64) -> f64 {
        let share = (below(self.sign * (x - self.mean) / self.std) - below(self.a)) / self.mass;
        if self.sign > 0.0 { share } else { 1.0 - share }
    }

    /// The point of the greatest density.
    pub fn mode(&self) -> f64 {
        self.mean.clamp(-1.0, 1.0)
    }

    /// log p(x) and its derivatives at a point of [-1, 1].
    pub fn at(&self, x: f64) -> At {
        let [m1, m2, ..] = self.moments;
        let z = self.sign * (x - self.mean) / self.std;
        At {
            log_density: -0.5 * z * z - self.log_normaliser(),
            score: [self.sign * (z - m1) / self.std, z * z - m2],
        }
    }

    /// The entropy H in nats and its derivatives by m and by log s.
    pub fn entropy(&self) -> (f64, [f64; 2]) {
        let [m1, m2, m3, m4] = self.moments;
        let by_mean = self.sign * (m3 - m1 * m2) / (2.0 * self.std);
        (self.log_normaliser() + 0.5 * m2, [by_mean, 0.5 * (m4 - m2 * m2)])
    }

    /// log(sqrt(2 pi) s Z).
    fn log_normaliser(&self) -> f64 {
        0.5 * (2.0 * PI).ln() + self.std.ln() + self.mass.ln()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CASES: [(f64, f64); 8] = [
        (0.0, 1.0),
        (0.3, 0.2),
        (-0.7, 0.4),
        (1.4, 0.3),
        (-1.5, 0.06),
        (1.5, 0.05),
        (0.0, 3.0),
        (-0.9, 2.5),
    ];

    /// The integral over [-1, 1] by Simpson's rule, in which the narrowest law spans many steps.
    fn integral(of: impl Fn(f64) -> f64) -> f64 {
        const STEPS: usize = 200_000;
        let step = 2.0 / STEPS as f64;
        let weight = |i: usize| if i == 0 || i == STEPS { 1.0 } else { 2.0 + 2.0 * (i % 2) as f64 };
        (0..=STEPS).map(|i| weight(i) * of(-1.0 + i as f64 * step)).sum::<f64>() * step / 3.0
    }

    #[test]
    fn density_entropy_and_quantiles_are_those_of_quadrature() {
        for (mean, std) in CASES {
            let law = TruncatedNormal::new(mean, std);
            let log = |x: f64| law.at(x).log_density;
            let total = integral(|x| log(x).exp());
            assert!((total - 1.0).abs() < 1e-9, "{mean}, {std}: the mass is {total}");
            let (entropy, _) = law.entropy();
            let by_quadrature = integral(|x| -log(x).exp() * log(x));
            assert!(
                (entropy - by_quadrature).abs() < 1e-8,
                "{mean}, {std}: {entropy}, {by_quadrature}"
            );
            assert!(entropy <= 2f64.ln() + 1e-12);
            for u in [1e-9, 0.01, 0.3, 0.5, 0.9, 0.999_999] {
                let back = law.cumulative(law.quantile(u));
                assert!((back - u).abs() < 1e-9, "{mean}, {std}: {u} comes back as {back}");
            }
            assert!(law.at(law.mode()).log_density >= log(0.123) && law.mode().abs() <= 1.0);
        }
    }

    #[test]
    fn derivatives_are_those_of_finite_differences() {
        const STEP: f64 = 1e-5;
        for (mean, std) in CASES {
            let law = TruncatedNormal::new(mean, std);
            let shifted = |axis: usize, by: f64| match axis {
                0 => TruncatedNormal::new(mean + by, std),
                _ => TruncatedNormal::new(mean, std * by.exp()),
            };
            let slope = |axis: usize, of: &dyn Fn(TruncatedNormal) -> f64| {
                (of(shifted(axis, STEP)) - of(shifted(axis, -STEP))) / (2.0 * STEP)
            };
            for axis in [0, 1] {
                for x in [-1.0, -0.8, 0.1, 0.95] {
                    let numeric = slope(axis, &|law| law.at(x).log_density);
                    let written = law.at(x).score[axis];
                    let scale = 1e-6 * (1.0 + written.abs());
                    assert!(
                        (written - numeric).abs() < scale,
                        "{mean}, {std}: {written}, {numeric}"
                    );
                }
                let numeric = slope(axis, &|law| law.entropy().0);
                let written = law.entropy().1[axis];
                assert!((written - numeric).abs() < 1e-6, "{mean}, {std}: {written}, {numeric}");
            }
        }
    }
}
