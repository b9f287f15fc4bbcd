//! The law of the return J and its risk measures.
//!
//! The return of an episode is `J = sum_{t=0}^{T-1} gamma^t r_t`. In both worlds it takes finitely
//! many values, so its law, whether exact or of recorded episodes, is a short list of atoms: nothing
//! is lost by keeping that instead of the episodes.
//!
//! CVaR_alpha(J) is the lower-tail CVaR: the mean of the worst alpha-fraction of J, an atom at the
//! quantile counting with the fraction that fits (Eq. 3 of the paper; its Eq. 2 has the sign of a
//! cost).

use lava_envs::End;
use serde::{Deserialize, Serialize};

/// Half-width of a 95 % interval in standard errors: the standard normal quantile at 0.975.
pub const NORMAL_95: f64 = 1.959_963_984_540_054;

/// One value of the return, with how the episode came to it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Atom {
    /// The return J, discounted by gamma.
    pub value: f64,
    /// The sum of the rewards, undiscounted.
    pub undiscounted: f64,
    /// Length of the episode in steps.
    pub steps: u32,
    /// How the episode ended.
    pub end: End,
    /// Probability of the atom; of recorded episodes, their share.
    pub mass: f64,
}

/// The return of an episode while it runs: `J = sum_t gamma^t r_t`, step by step.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ReturnSoFar {
    /// The sum so far, discounted.
    pub value: f64,
    /// The sum so far, undiscounted.
    pub undiscounted: f64,
    /// gamma^t.
    discount: f64,
    /// Steps t.
    pub steps: u32,
}

impl ReturnSoFar {
    /// An episode that has not begun.
    pub const START: ReturnSoFar =
        ReturnSoFar { value: 0.0, undiscounted: 0.0, discount: 1.0, steps: 0 };

    /// Adds the reward of the next step.
    pub fn add(&mut self, reward: f64, gamma: f64) {
        self.value += self.discount * reward;
        self.undiscounted += reward;
        self.discount *= gamma;
        self.steps += 1;
    }

    /// What the rest of the episode must return, discounted from now on, for the whole return to be `value`.
    pub fn missing(&self, value: f64) -> f64 {
        (value - self.value) / self.discount
    }

    /// The episode as an atom of the law of the return, of mass 1, once it has ended so.
    pub fn ended(self, end: End) -> Atom {
        let ReturnSoFar { value, undiscounted, steps, .. } = self;
        Atom { value, undiscounted, steps, end, mass: 1.0 }
    }
}

/// The law of the return J: atoms in ascending order of value, whose masses sum to 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ReturnLaw {
    atoms: Vec<Atom>,
    /// Number of recorded episodes in the law; `None` for an exact one.
    episodes: Option<u64>,
}

impl ReturnLaw {
    /// An exact law. The masses are taken as they are; atoms alike in all but mass are merged.
    pub fn exact(atoms: Vec<Atom>) -> Self {
        ReturnLaw { atoms: merged(atoms), episodes: None }
    }

    /// The empirical law of recorded episodes, whose masses are ignored.
    pub fn recorded(episodes: impl IntoIterator<Item = Atom>) -> Self {
        let mut atoms: Vec<Atom> =
            episodes.into_iter().map(|atom| Atom { mass: 1.0, ..atom }).collect();
        let count = atoms.len();
        atoms = merged(atoms);
        for atom in &mut atoms {
            atom.mass /= count as f64;
        }
        ReturnLaw { atoms, episodes: Some(count as u64) }
    }

    /// The atoms, ascending by value.
    pub fn atoms(&self) -> &[Atom] {
        &self.atoms
    }

    /// Number of recorded episodes in the law; `None` for an exact one.
    pub fn episodes(&self) -> Option<u64> {
        self.episodes
    }

    /// `E[J]`.
    pub fn mean(&self) -> f64 {
        self.atoms.iter().map(|atom| atom.mass * atom.value).sum()
    }

    /// Mean undiscounted return.
    pub fn undiscounted_mean(&self) -> f64 {
        self.atoms.iter().map(|atom| atom.mass * atom.undiscounted).sum()
    }

    /// VaR_alpha(J), the lower alpha-quantile: the least value w with P(J <= w) >= alpha.
    ///
    /// # Panics
    /// If `alpha` is outside (0, 1].
    pub fn var(&self, alpha: f64) -> f64 {
        assert!(alpha > 0.0 && alpha <= 1.0, "alpha must lie in (0, 1], got {alpha}");
        let mut below = 0.0;
        for atom in &self.atoms {
            below += atom.mass;
            // The slack keeps rounding of the sum from skipping the quantile's atom.
            if below >= alpha * (1.0 - 1e-12) {
                return atom.value;
            }
        }
        self.atoms.last().map_or(f64::NAN, |atom| atom.value)
    }

    /// CVaR_alpha(J) = w - `E[(w - J)^+]` / alpha at w = VaR_alpha(J).
    ///
    /// # Panics
    /// If `alpha` is outside (0, 1].
    pub fn cvar(&self, alpha: f64) -> f64 {
        let w = self.var(alpha);
        w - self.shortfall(w) / alpha
    }

    /// `E[(w - J)^+]`.
    pub fn shortfall(&self, w: f64) -> f64 {
        self.atoms.iter().map(|atom| atom.mass * (w - atom.value).max(0.0)).sum()
    }

    /// Standard error of [`ReturnLaw::mean`] over the recorded episodes; 0 for an exact law.
    pub fn mean_standard_error(&self) -> f64 {
        self.standard_error(|value| value)
    }

    /// Standard error of [`ReturnLaw::cvar`], from the asymptotic variance of
    /// w - (w - J)^+ / alpha at the quantile w; 0 for an exact law.
    pub fn cvar_standard_error(&self, alpha: f64) -> f64 {
        let w = self.var(alpha);
        self.standard_error(|value| (w - value).max(0.0) / alpha)
    }

    fn standard_error(&self, statistic: impl Fn(f64) -> f64) -> f64 {
        let Some(episodes) = self.episodes else { return 0.0 };
        let mean: f64 = self.atoms.iter().map(|a| a.mass * statistic(a.value)).sum();
        let variance: f64 =
            self.atoms.iter().map(|a| a.mass * (statistic(a.value) - mean).powi(2)).sum();
        (variance / episodes as f64).sqrt()
    }

    /// Probability that an episode ends so.
    pub fn probability(&self, end: End) -> f64 {
        let ending = self.atoms.iter().filter(|atom| atom.end == end);
        // An empty sum of floats is -0.
        ending.map(|atom| atom.mass).sum::<f64>() + 0.0
    }

    /// Mean number of steps of the episodes that reach the goal; `None` if none does.
    pub fn steps_to_goal(&self) -> Option<f64> {
        let goal = self.probability(End::Goal);
        let steps: f64 = self
            .atoms
            .iter()
            .filter(|atom| atom.end == End::Goal)
            .map(|atom| atom.mass * f64::from(atom.steps))
            .sum();
        (goal > 0.0).then(|| steps / goal)
    }
}

/// Sorts by value (then steps and end) and joins atoms that differ only in mass.
fn merged(mut atoms: Vec<Atom>) -> Vec<Atom> {
    atoms.sort_by(|a, b| {
        a.value.total_cmp(&b.value).then(a.steps.cmp(&b.steps)).then(a.end.cmp(&b.end))
    });
    atoms.dedup_by(|next, kept| {
        let same = next.value == kept.value && next.steps == kept.steps && next.end == kept.end;
        if same {
            kept.mass += next.mass;
        }
        same
    });
    atoms
}

#[cfg(test)]
mod tests {
    use super::*;

    fn atom(value: f64, mass: f64) -> Atom {
        Atom { value, undiscounted: value, steps: 1, end: End::Timeout, mass }
    }

    #[test]
    fn an_atom_at_the_quantile_counts_with_its_fraction() {
        let law = ReturnLaw::exact(vec![atom(1.0, 0.7), atom(-1.0, 0.1), atom(0.0, 0.2)]);
        assert_eq!(law.var(0.2), 0.0);
        approx::assert_relative_eq!(law.cvar(0.2), -0.5, epsilon = 1e-12);
        approx::assert_relative_eq!(law.cvar(0.1), -1.0, epsilon = 1e-12);
        approx::assert_relative_eq!(law.cvar(1.0), law.mean(), epsilon = 1e-12);
        approx::assert_relative_eq!(law.mean(), 0.6, epsilon = 1e-12);
    }

    #[test]
    fn recorded_episodes_share_the_mass() {
        let law =
            ReturnLaw::recorded([atom(1.0, 0.0), atom(1.0, 0.0), atom(-1.0, 0.0), atom(0.5, 0.0)]);
        assert_eq!(law.episodes(), Some(4));
        assert_eq!(law.atoms().len(), 3);
        approx::assert_relative_eq!(law.cvar(0.5), -0.25, epsilon = 1e-12);
    }
}
