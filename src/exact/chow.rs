//! The budget-augmented dynamic programme of Chow, Tamar, Mannor & Pavone (NeurIPS 2015), whose value
//! overestimates the best CVaR (Hau, Delage, Ghavamzadeh & Petrik, NeurIPS 2023).
//!
//! Their decomposition over the remaining risk level y (in the terms of the game, y = 1/eta_t), for
//! rewards:
//!
//!   V_t(s, y) = max_a min_xi sum_o P(o) xi(o) [r + gamma V_{t+1}(s', y xi(o))],
//!   0 <= xi <= 1/y, `E_P[xi]` = 1.
//!
//! It lets the protagonist see y, which is the antagonist's choice and not information the
//! protagonist has, so its value is at least max_pi CVaR_alpha and in general above it.
//!
//! # No grid of risk levels
//! They interpolate y V(s, y) between risk levels. Here it is exact. Let J be the whole return and
//! W(y) = y V(y). With z(o) = y xi(o),
//!
//!   W_t(y) = max_a min { sum_o P(o) W_{t+1}(s', z(o)) : 0 <= z <= 1, `E_P[z]` = y },
//!
//! and W = J z where the episode ends. By induction W is convex, piecewise linear on [0, 1] with
//! W(0) = 0, and its slopes are attainable returns: the minimum takes the segments of the W_{t+1} in
//! order of slope, and the maximum over actions of piecewise linear functions has no other slopes. So
//! W is the integral of the quantile function of a law over the attainable returns; it is stored as
//! the masses of that law, by return. The minimum is the P-mixture of the laws, the maximum is
//! `upper_envelope`. One pass answers for every alpha.

use super::mdp::FiniteMdp;
use super::{ExactError, require_alpha};

/// The result of the programme for all risk levels.
#[derive(Debug, Clone, PartialEq)]
pub struct Chow {
    /// Returns with the masses of the law whose CVaR is the programme's value, ascending. No policy
    /// need have this law.
    law: Vec<(f64, f64)>,
}

impl Chow {
    /// Solves the programme.
    pub fn solve(mdp: &FiniteMdp) -> Chow {
        let masses = programme(mdp);
        let law = mdp.returns().iter().copied().zip(masses).filter(|(_, mass)| *mass > 0.0);
        Chow { law: law.collect() }
    }

    /// The programme's value at risk level alpha: an upper bound of the best CVaR_alpha.
    ///
    /// # Errors
    /// If alpha is outside (0, 1].
    pub fn value(&self, alpha: f64) -> Result<f64, ExactError> {
        require_alpha(alpha)?;
        let mut rest = alpha;
        let mut integral = 0.0;
        for &(value, mass) in &self.law {
            let share = mass.min(rest);
            integral += share * value;
            rest -= share;
        }
        // The masses sum to 1 up to rounding.
        Ok(integral / (alpha - rest.max(0.0)))
    }
}

/// Masses by return, with the range of indices outside of which they are zero.
#[derive(Debug, Clone, Default)]
struct Masses {
    first: usize,
    values: Vec<f64>,
}

impl Masses {
    fn clear(&mut self) {
        self.values.clear();
    }

    fn unit(index: usize) -> Masses {
        Masses { first: index, values: vec![1.0] }
    }

    /// Makes room for the indices `first..end`.
    fn cover(&mut self, first: usize, end: usize) {
        if self.values.is_empty() {
            self.first = first;
        }
        if first < self.first {
            let missing = self.first - first;
            self.values.splice(0..0, std::iter::repeat_n(0.0, missing));
            self.first = first;
        }
        if end > self.first + self.values.len() {
            self.values.resize(end - self.first, 0.0);
        }
    }

    fn add(&mut self, weight: f64, other: &Masses) {
        self.cover(other.first, other.first + other.values.len());
        let offset = other.first - self.first;
        for (value, more) in self.values[offset..].iter_mut().zip(&other.values) {
            *value += weight * more;
        }
    }
}

fn programme(mdp: &FiniteMdp) -> Vec<f64> {
    let states = mdp.states();
    let ends: Vec<Masses> = (0..mdp.returns().len()).map(Masses::unit).collect();
    let mut next: Vec<Masses> = Vec::new();
    let (mut mixture, mut envelope) = (Masses::default(), Masses::default());
    for time in (0..mdp.horizon()).rev() {
        let mut now = vec![Masses::default(); mdp.levels(time) * states];
        for level in 0..mdp.levels(time) {
            for state in 0..states {
                let best = &mut now[level * states + state];
                for pair in mdp.pair_range(state) {
                    mixture.clear();
                    for branch in mdp.branches(pair).iter().filter(|b| b.probability > 0.0) {
                        let landing = branch.landing as usize;
                        let after = match mdp.end(time, landing) {
                            Some(_) => &ends[mdp.return_index(time, level, landing)],
                            None => {
                                let level = mdp.next_level(time, level, landing);
                                &next[level * states + mdp.landings()[landing].state]
                            }
                        };
                        mixture.add(branch.probability, after);
                    }
                    if best.values.is_empty() {
                        std::mem::swap(best, &mut mixture);
                    } else {
                        upper_envelope(best, &mixture, mdp.returns(), &mut envelope);
                        std::mem::swap(best, &mut envelope);
                    }
                }
            }
        }
        next = now;
    }
    let mut masses = vec![0.0; mdp.returns().len()];
    let start = &next[mdp.start()];
    masses[start.first..][..start.values.len()].copy_from_slice(&start.values);
    masses
}

/// The law whose integrated quantile function is the pointwise maximum of those of `a` and `b`.
///
/// Walks both along y and keeps d = W_a(y) - W_b(y). Where the sign of d changes inside a step, the
/// step is cut at the crossing.
fn upper_envelope(a: &Masses, b: &Masses, returns: &[f64], envelope: &mut Masses) {
    envelope.clear();
    envelope.cover(a.first.min(b.first), (a.first + a.values.len()).max(b.first + b.values.len()));
    let origin = envelope.first;
    let mut segments_a = segments(a);
    let mut segments_b = segments(b);
    let (mut left_a, mut left_b) = (segments_a.next(), segments_b.next());
    let mut difference = 0.0_f64;
    let mut reached = 0.0;
    while let (Some((i, length_a)), Some((k, length_b))) = (left_a, left_b) {
        let step = length_a.min(length_b);
        let slope = returns[i] - returns[k];
        let after = difference + slope * step;
        // Where both coincide, the steeper one leads from here.
        let a_leads = difference > 0.0 || (difference == 0.0 && slope >= 0.0);
        let (leader, other) = if a_leads { (i, k) } else { (k, i) };
        let crosses = if a_leads { after < 0.0 } else { after > 0.0 };
        let until = if crosses { (-difference / slope).clamp(0.0, step) } else { step };
        envelope.values[leader - origin] += until;
        envelope.values[other - origin] += step - until;
        difference = after;
        reached += step;
        left_a = if length_a > step { Some((i, length_a - step)) } else { segments_a.next() };
        left_b = if length_b > step { Some((k, length_b - step)) } else { segments_b.next() };
    }
    // What rounding left of the longer one, so that no mass is lost over many steps.
    if let Some((index, _)) = left_a.or(left_b) {
        envelope.values[index - origin] += (1.0 - reached).max(0.0);
    }
}

/// Index of the return and mass, ascending, without gaps.
fn segments(masses: &Masses) -> impl Iterator<Item = (usize, f64)> + '_ {
    let first = masses.first;
    masses
        .values
        .iter()
        .enumerate()
        .filter(|(_, mass)| **mass > 0.0)
        .map(move |(offset, &mass)| (first + offset, mass))
}
