//! The method `cvar-pg`: the policy gradient of CVaR (Tamar, Glassner & Mannor, AAAI 2015) on the protagonist of
//! Algorithm 1,
//!
//! ```text
//! grad CVaR_alpha = E[ sum_t grad log pi(a_t|s_t) (J - VaR_alpha) | J <= VaR_alpha ].
//! ```
//!
//! Only the worst alpha of a rollout's episodes carry gradient. Without a schedule of the risk level
//! (`train.budget_wait`, `train.budget_rise`) it may not see success before failures are rarer than alpha, its known
//! blindness (Greenberg and others, NeurIPS 2022); with one it is their soft risk. At level 1, where the tail is all
//! episodes and any baseline is right, it is PPO.
//!
//! An episode that goes on after the rollout has no return yet, and its steps carry no gradient. In longer rollouts of
//! fewer parallel episodes these are fewer.

use crate::learn::method::{Arena, Method, Metric, Players, Setting, Training};
use crate::learn::options::TrainOptions;
use crate::learn::solo::{self, Objective, Returns, Solo};
use serde::{Deserialize, Serialize};

/// The method `cvar-pg`.
#[derive(Debug, Clone, Copy)]
pub struct CvarPg;

impl Method for CvarPg {
    const NAME: &'static str = "cvar-pg";
    const METRICS: &'static [Metric] = solo::METRICS;

    fn check<W: Arena>(options: &TrainOptions, _: &toml::Table) -> Result<(), String> {
        solo::check::<W>(options)
    }

    fn begin<'a, W: Arena>(world: W, setting: &'a Setting<'a>) -> Box<dyn Training<W> + 'a> {
        Box::new(Solo::<W, Tail>::new(world, setting))
    }

    fn players<W: Arena>(world: &W, setting: &Setting<'_>) -> Box<dyn Players<W>> {
        Box::new(solo::players(world, setting))
    }
}

/// The mean of the tail, by its policy gradient.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct Tail {
    /// VaR of the last rollout; NaN before the first one.
    value_at_risk: f64,
}

impl Objective for Tail {
    fn new(_: &toml::Table) -> Self {
        Tail { value_at_risk: f64::NAN }
    }

    fn judge(&mut self, returns: &Returns<'_>, rewards: &mut [f32]) -> Option<Vec<f32>> {
        if returns.alpha == 1.0 {
            return None;
        }
        let mut reinforced = vec![0.0; rewards.len()];
        let Some(value_at_risk) = returns.value_at_risk() else { return Some(reinforced) };
        self.value_at_risk = value_at_risk;
        // J - VaR of the episode in each slot, from the end backwards.
        let mut shortfall = vec![0.0; returns.slots];
        for at in (0..rewards.len()).rev() {
            let slot = at % returns.slots;
            if returns.ended[at] {
                let whole = returns.before[at].map(|before| returns.after(&before, rewards[at]));
                shortfall[slot] = whole.map_or(0.0, |of| (of.value - value_at_risk).min(0.0));
            }
            reinforced[at] = shortfall[slot] as f32;
        }
        Some(reinforced)
    }

    fn threshold(&self) -> f64 {
        self.value_at_risk
    }
}
