//! The multiplicative budget (paper Eq. 5) and the identity mixing that keeps it.
//!
//! For every trajectory `delta_1(o_1) * ... * delta_T(o_T) <= eta`. The remaining budget starts at
//! `eta_1 = eta` and becomes `eta_{t+1} = eta_t / delta_t(o_t)`; a perturbation is admissible if
//! `sup_o delta_t(o) <= eta_t`. Then eta_t never falls below 1, and it may rise above eta when a
//! ratio below 1 is realised.

use crate::game::columns::exp_m1;
use serde::{Deserialize, Serialize};

/// The budget eta >= 1 of a game. The protagonist's risk level is alpha = 1/eta.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(try_from = "f64", into = "f64")]
pub struct Eta(f64);

/// A number that is not a budget.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("eta must be a finite number of at least 1, got {0}")]
pub struct NotABudget(pub f64);

impl Eta {
    /// eta = 1: risk neutral, chance as it is.
    pub const NEUTRAL: Eta = Eta(1.0);

    /// A budget, if `eta` is finite and at least 1.
    ///
    /// # Errors
    /// [`NotABudget`] otherwise.
    pub fn new(eta: f64) -> Result<Self, NotABudget> {
        if eta.is_finite() && eta >= 1.0 { Ok(Eta(eta)) } else { Err(NotABudget(eta)) }
    }

    /// The number.
    pub fn get(self) -> f64 {
        self.0
    }

    /// The risk level alpha = 1/eta.
    pub fn alpha(self) -> f64 {
        1.0 / self.0
    }

    /// Whether the game is risk neutral: no antagonist can do anything at eta = 1.
    pub fn is_neutral(self) -> bool {
        self.0 == 1.0
    }
}

impl TryFrom<f64> for Eta {
    type Error = NotABudget;
    fn try_from(eta: f64) -> Result<Self, NotABudget> {
        Eta::new(eta)
    }
}

impl From<Eta> for f64 {
    fn from(eta: Eta) -> f64 {
        eta.0
    }
}

impl std::str::FromStr for Eta {
    type Err = NotABudget;
    fn from_str(text: &str) -> Result<Self, NotABudget> {
        Eta::new(text.trim().parse().unwrap_or(f64::NAN))
    }
}

/// Without a trailing `.0`: `25`, `2.5`.
impl std::fmt::Display for Eta {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}", self.0)
    }
}

/// Remaining budgets are cut off here, which leaves the antagonist less than it has.
const LARGEST: f64 = 1e300;

/// The remaining budget eta_t >= 1 of one trajectory.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd)]
pub struct Budget(f64);

impl Budget {
    /// The budget at the start of a trajectory.
    pub fn start(eta: Eta) -> Self {
        Budget(eta.0)
    }

    /// The remaining budget of a trajectory that continues.
    ///
    /// # Errors
    /// [`NotABudget`] if it is below 1 or not finite.
    pub fn remaining(budget: f64) -> Result<Self, NotABudget> {
        Eta::new(budget).map(Budget::start)
    }

    /// The number eta_t.
    pub fn get(self) -> f64 {
        self.0
    }

    /// eta_{t+1} = eta_t / delta_t(o_t), for the realised likelihood ratio of an admissible
    /// perturbation.
    ///
    /// # Panics
    /// If the ratio is not in (0, eta_t (1 + 1e-9)]: the perturbation was not admissible, which is
    /// an error in its family.
    #[must_use]
    pub fn spend(self, likelihood_ratio: f64) -> Self {
        assert!(
            likelihood_ratio > 0.0 && likelihood_ratio <= self.0 * (1.0 + 1e-9),
            "likelihood ratio {likelihood_ratio} is not admissible within the budget {}",
            self.0
        );
        // The ratio may exceed the budget only by rounding.
        Budget((self.0 / likelihood_ratio).clamp(1.0, LARGEST))
    }

    /// Identity mixing, the paper's "convex rescaling": given log M of a normalised perturbation
    /// delta^0, the weight `1 - lambda` in `delta = lambda + (1 - lambda) delta^0` that makes it
    /// admissible, as a [`Mixing`].
    ///
    /// `1 - lambda = min(1, (eta_t - 1) / (M - 1))`, so that `E_P[delta] = 1` and
    /// `sup delta = min(M, eta_t)`. The quotient stays accurate when M is huge; log M must stay below
    /// 700, which the families' bounds see to.
    pub fn mix(self, log_supremum: f64) -> Mixing {
        Mixing::within(self.0, exp_m1(log_supremum))
    }
}

/// The weight of delta^0 in `delta = lambda + (1 - lambda) delta^0`, and how M moves it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mixing {
    /// rho = 1 - lambda, in [0, 1].
    pub weight: f64,
    /// d rho / d log M: -rho M / (M - 1) where the budget binds, else 0.
    pub by_log_supremum: f64,
}

impl Mixing {
    /// The mixing within a budget, from M - 1.
    #[inline(always)]
    pub fn within(budget: f64, excess: f64) -> Mixing {
        let room = budget - 1.0;
        let free = excess <= room;
        let weight = if free { 1.0 } else { room / excess };
        let by_log_supremum = if free { 0.0 } else { -weight * (1.0 + 1.0 / excess) };
        Mixing { weight, by_log_supremum }
    }

    /// delta(o), from delta^0(o).
    #[inline(always)]
    pub fn likelihood_ratio(&self, base: f64) -> f64 {
        let ratio = (1.0 - self.weight) + self.weight * base;
        // Positive in truth, though delta^0 far from its bump rounds to 0.
        if ratio == 0.0 { f64::MIN_POSITIVE } else { ratio }
    }

    /// Derivatives of delta(o) by log delta^0(o) and by log M, gradients flowing through lambda:
    /// d delta = rho delta^0 dlog delta^0 + (delta^0 - 1) d rho.
    #[inline(always)]
    pub fn derivatives(&self, base: f64) -> (f64, f64) {
        (self.weight * base, (base - 1.0) * self.by_log_supremum)
    }
}
